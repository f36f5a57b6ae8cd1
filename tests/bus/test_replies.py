"""Nobody waits for an asker that does not read, except the thread whose work that is."""

import asyncio
import threading
from collections.abc import Iterator
from typing import Any

import pytest
import zenoh

from psiu_broker.bus import queries as queries_module
from psiu_broker.bus import replies as replies_module
from psiu_broker.bus.calls import Calls
from psiu_broker.bus.keys import Keys
from psiu_broker.bus.queries import Queries
from psiu_broker.bus.replies import Replies
from psiu_broker.bus.session import JSON, Session
from psiu_broker.errors import CallError

BUSY = CallError("busy", "no room")


class Asker:
    """A query; a reply to it waits until `reads` is set."""

    key_expr = "psiu/@call/A/b"
    parameters = "100"  # bad_request, for a call
    payload = None
    attachment = None

    def __init__(self) -> None:
        self.reads = threading.Event()
        self.told: list[Any] = []
        self.ended = threading.Event()

    def __enter__(self) -> "Asker":
        return self

    def __exit__(self, *_: object) -> None:
        self.ended.set()

    def reply(self, key: str, payload: Any, *, encoding: zenoh.Encoding) -> None:
        self.reads.wait(20)
        self.told.append((key, bytes(payload)))

    def reply_err(self, payload: str, *, encoding: zenoh.Encoding) -> None:
        self.reads.wait(20)
        self.told.append(payload)


@pytest.fixture
def stuck() -> Iterator[Any]:
    asker = Asker()
    yield asker
    asker.reads.set()


@pytest.fixture
def reader() -> Any:
    asker = Asker()
    asker.reads.set()
    return asker


async def off_loop(work: Any, *arguments: Any) -> Any:
    """The result of `work`, which must not wait for an asker."""
    return await asyncio.wait_for(asyncio.to_thread(work, *arguments), 5)


async def test_a_reply_waits_for_its_asker_in_a_thread_of_its_own(session: Session, stuck: Any) -> None:
    replies = Replies(session, "test")
    sent = replies.answer(stuck, {"psiu/x": (JSON, 5)})
    assert not sent.done()
    stuck.reads.set()
    await asyncio.wait_for(replies.sent(), 5)
    assert (stuck.told, sent.done()) == ([("psiu/x", b"5")], True)


async def test_replies_of_two_queryables_do_not_wait_for_one_another(session: Session, stuck: Any, reader: Any) -> None:
    Replies(session, "calls").refuse(stuck, BUSY)
    others = Replies(session, "queries")
    others.refuse(reader, BUSY)
    await asyncio.wait_for(others.sent(), 5)
    assert reader.told
    assert not stuck.told


async def test_turning_away_never_waits_and_ends_in_silence_where_too_many_do(
    session: Session, stuck: Any, reader: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(replies_module, "TURNED_AWAY_MAX", 2)
    replies = Replies(session, "test")
    late = Asker()
    for asker in (stuck, reader, late):
        await off_loop(replies.turn_away, asker, BUSY)
    stuck.reads.set()
    assert await off_loop(reader.ended.wait, 5)
    reader.ended.clear()
    replies.turn_away(reader, BUSY)
    assert await off_loop(reader.ended.wait, 5)  # there is room again
    assert not late.ended.is_set()


async def test_the_thread_that_reads_calls_never_waits_for_one(session: Session, keys: Keys, stuck: Any) -> None:
    async def unused(*_: Any) -> Any: ...

    calls = await Calls.open(session, keys, unused, unused)
    assert await off_loop(calls._sift_query, stuck) is None
    stuck.reads.set()
    assert await off_loop(stuck.ended.wait, 5)
    assert "bad_request" in stuck.told[0]


async def test_the_thread_that_reads_queries_never_waits_for_one(
    session: Session, keys: Keys, stuck: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(queries_module, "AT_ONCE_MAX", 0)
    tables = (
        "status",
        "links",
        "trunks",
        "routes",
        "ledger",
        "robot_accounts",
        "health",
        "mesh_seen",
        "conflicts",
        "config",
    )
    source: Any = type("Source", (), dict.fromkeys(tables))
    queries = await Queries.open(session, keys, "base", source)
    assert await off_loop(queries._sift, stuck) is None
    stuck.reads.set()
    assert await off_loop(stuck.ended.wait, 5)
    assert "busy" in stuck.told[0]


async def test_a_reply_after_the_end_harms_nobody(session: Session, reader: Any) -> None:
    replies = Replies(session, "test")
    await session.close()
    assert replies.answer(reader, {}).done()
    replies.turn_away(reader, BUSY)


async def test_a_reply_that_fails_is_a_log_entry_and_stops_no_other(
    session: Session, reader: Any, caplog: pytest.LogCaptureFixture
) -> None:
    replies = Replies(session, "test")
    broken: Any = object()
    replies.refuse(broken, BUSY)
    replies.refuse(reader, BUSY)
    await asyncio.wait_for(replies.sent(), 5)
    assert reader.told
    assert "could not be answered" in caplog.text

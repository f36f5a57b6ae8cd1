import asyncio
import json
from collections.abc import Iterable, Sequence
from typing import Any

import pytest
import zenoh
from quiet import NOW, Quiet

from psiu_broker.bus import queries as queries_module
from psiu_broker.bus.keys import Keys
from psiu_broker.bus.queries import Queries
from psiu_broker.bus.session import Session
from psiu_broker.frame import Address
from psiu_broker.messages import Card, Link, Refusal, Trunk, Why


class Broker(Quiet):
    """A broker with three robots, one of them with an odd name; remembers whose cards it built."""

    def __init__(self) -> None:
        self.known = [Address.named("MNERIM"), Address.named("0x12"), Address.numbered(0x12)]
        self.built: list[Address] = []
        self.listed = False

    def links(self) -> Sequence[Link]:
        return [Link(name="radio", adapter="serial", protocol="psiu-ascii", state="open", since=NOW)]

    def trunks(self) -> Sequence[Trunk]:
        return [Trunk(name="hill", adapter="rfcomm", state="open", since=NOW, far="hill")]

    def why(self, a: Address, b: Address) -> Why:
        if a == Address.named("bug"):
            raise ZeroDivisionError
        return Why(a=str(a), b=str(b), delivered=True, verdict=f"{a!r} {b!r}", steps=[])

    def robots(self) -> Iterable[Address]:
        self.listed = True
        return self.known

    def card(self, robot: Address) -> Card | None:
        self.built.append(robot)
        if robot not in self.known:
            return None
        return Card(robot=str(robot), protocol="psiu-ascii", broker="base", link="radio", link_state="open")


@pytest.fixture
async def broker() -> Broker:
    return Broker()


@pytest.fixture
async def queries(session: Session, keys: Keys, broker: Broker) -> Queries:
    return await Queries.open(session, keys, "base", broker)


async def ask(program: zenoh.Session, key: str) -> dict[str, Any]:
    """The JSON found, by key; the errors under the empty key."""

    def get() -> dict[str, Any]:
        found: dict[str, Any] = {}
        for reply in program.get(key, timeout=5):
            if reply.ok:
                assert str(reply.ok.encoding).startswith("application/json")
                assert str(reply.ok.key_expr) not in found
                found[str(reply.ok.key_expr)] = json.loads(reply.ok.payload.to_string())
            else:
                found[""] = Refusal.model_validate_json(reply.err.payload.to_bytes())
        return found

    return await asyncio.to_thread(get)


@pytest.mark.parametrize("what", ["status", "ledger"])
async def test_a_table_is_one_object(queries: Queries, program: zenoh.Session, what: str) -> None:
    expected = json.loads(getattr(Broker(), what)().model_dump_json())
    assert await ask(program, f"psiu/@broker/base/{what}") == {f"psiu/@broker/base/{what}": expected}


async def test_lists_are_arrays_and_times_are_rfc_3339(queries: Queries, program: zenoh.Session) -> None:
    assert await ask(program, "psiu/@broker/base/routes") == {"psiu/@broker/base/routes": []}
    links = await ask(program, "psiu/@broker/base/links")
    assert links["psiu/@broker/base/links"][0]["since"] == "2026-11-22T00:00:00.000000Z"
    assert await ask(program, "psiu/@broker/base/config") == {"psiu/@broker/base/config": {"broker": {"name": "base"}}}


async def test_wildcards_get_each_answer_on_its_own_key(queries: Queries, program: zenoh.Session) -> None:
    every = {
        f"psiu/@broker/base/{what}"
        for what in (
            "status",
            "links",
            "trunks",
            "routes",
            "ledger",
            "ledger-of-robots",
            "health",
            "mesh",
            "conflicts",
            "config",
        )
    }
    assert set(await ask(program, "psiu/@broker/base/*")) == every
    assert set(await ask(program, "psiu/@broker/**")) == every
    assert set(await ask(program, "psiu/@broker/*/status")) == {"psiu/@broker/base/status"}
    assert set(await ask(program, "psiu/@broker/*/why/A/B")) == {"psiu/@broker/base/why/A/B"}
    assert await ask(program, "psiu/@broker/other/status") == {}
    assert await ask(program, "psiu/@broker/*/trace/A/B") == {}  # `Traces` answers


async def test_why_names_two_robots(queries: Queries, program: zenoh.Session) -> None:
    found = await ask(program, "psiu/@broker/base/why/ROB%C3%94/0x12")
    why = found["psiu/@broker/base/why/ROB%C3%94/0x12"]
    assert why["verdict"] == f"{Address.named('ROBÔ')!r} {Address.numbered(0x12)!r}"


@pytest.mark.parametrize(
    "key",
    [
        *(
            f"psiu/@broker/base{what}"
            for what in ("", "/nothing", "/why", "/why/A", "/why/*/B", "/why/A/B/C", "/why/%ED%A0%80/A", "/status/x")
        ),
        "**/@broker/base/nothing",
        "psiu/**/@broker/*/nothing",
    ],
)
async def test_an_unknown_question_is_told_what_may_be_asked(
    queries: Queries, program: zenoh.Session, key: str, caplog: pytest.LogCaptureFixture
) -> None:
    found = await ask(program, key)
    assert found[""].error == "bad_request"
    assert caplog.text == ""


async def test_a_bug_in_the_broker_is_an_answer_and_a_log_entry(
    queries: Queries, program: zenoh.Session, caplog: pytest.LogCaptureFixture
) -> None:
    assert (await ask(program, "psiu/@broker/base/why/bug/A"))[""].error == "impossible"
    assert "failed inside the broker" in caplog.text


@pytest.mark.parametrize("key", ["psiu/*", "psiu/**"])
async def test_all_cards_come_each_on_its_own_key(queries: Queries, program: zenoh.Session, key: str) -> None:
    found = await ask(program, key)
    assert set(found) == {"psiu/MNERIM", "psiu/%30x12", "psiu/0x12"}
    assert Card.model_validate(found["psiu/MNERIM"]).robot == "MNERIM"


async def test_one_card_comes_alone_and_a_stranger_has_none(
    queries: Queries, program: zenoh.Session, broker: Broker
) -> None:
    assert set(await ask(program, "psiu/MNERIM")) == {"psiu/MNERIM"}
    assert broker.built == [Address.named("MNERIM")]
    assert not broker.listed  # what one robot costs does not depend on how many there are
    assert set(await ask(program, "psiu/0x12")) == {"psiu/0x12"}
    assert await ask(program, "psiu/STRANGER") == {}
    assert await ask(program, "psiu/%ED%A0%80") == {}


async def test_only_the_cards_that_a_wildcard_covers_are_built(
    queries: Queries, program: zenoh.Session, broker: Broker
) -> None:
    assert set(await ask(program, "psiu/$*12")) == {"psiu/%30x12", "psiu/0x12"}
    assert set(broker.built) == {Address.named("0x12"), Address.numbered(0x12)}


async def test_many_questions_at_once_all_get_an_answer(
    queries: Queries, program: zenoh.Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert queries_module.AT_ONCE_MAX == 64
    handlers = [program.get("psiu/@broker/base/status", timeout=5) for _ in range(300)]
    replies = await asyncio.to_thread(lambda: [list(handler) for handler in handlers])
    assert all(len(each) == 1 for each in replies)
    refusals = [Refusal.model_validate_json(r.err.payload.to_bytes()).error for [r] in replies if r.err]
    assert set(refusals) <= {"busy"}
    assert set(await ask(program, "psiu/@broker/base/status")) == {"psiu/@broker/base/status"}

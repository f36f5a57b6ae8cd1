"""Every key of the bus, and what each role may do with it: tried with sessions that show their certificates."""

import asyncio
import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, suppress
from itertools import count
from pathlib import Path
from threading import Thread
from typing import Any, Final

import pytest
import zenoh
from secure_lab import REMOTE, SecureLab, in_order

from psiu_broker.bus.access import EVERYTHING

ROLES: Final = {"screen": "listener", "operator": "commander", "hill": "broker"}
ACTIONS: Final = ("put", "delete", "ask", "hear", "answer", "declare a token", "see a token")
BLOCK: Final = zenoh.CongestionControl.BLOCK
HEAR, ASK = {"hear"}, {"ask"}
NOTHING: Final[set[str]] = set()

KEYS: Final[Mapping[str, tuple[set[str], set[str]]]] = {
    # By key: what a listener may, and what a commander may besides. A broker may everything.
    "psiu/MNERIM/base/parafrente": (HEAR, NOTHING),
    "psiu/MNERIM/base/node/4": (HEAR, NOTHING),
    "psiu/MNERIM": (HEAR | ASK, NOTHING),
    "psiu/@raw/base/wifi": (HEAR, NOTHING),
    "psiu/@call/GHOST/parafrente": (NOTHING, {"put", "ask"}),
    **{
        f"psiu/@broker/base/{word}": (ASK, NOTHING)
        for word in ("status", "links", "trunks", "routes", "ledger", "ledger-of-robots", "health", "mesh", "config")
    },
    "psiu/@broker/base/conflicts": (HEAR | ASK, NOTHING),
    "psiu/@broker/base/why/base/MNERIM": (ASK, NOTHING),
    "psiu/@broker/base/trace/base/MNERIM": (NOTHING, ASK),
    "psiu/@broker/base/release/MNERIM/wifi": (NOTHING, ASK),
    "psiu/@program/somebody": (NOTHING, {"declare a token"}),
    "psiu/@program/somebody/done": (NOTHING, {"declare a token"}),
    "psiu/@alive/base": (NOTHING, NOTHING),
    "psiu/@mesh/broker/valley/1/abc/0": (NOTHING, NOTHING),
    "psiu/@mesh/robot/valley/1/MNERIM/-/psiu-ascii/wifi/9/9/1/0": (NOTHING, NOTHING),
    "psiu/@mesh/frame/valley/hill/0": (NOTHING, NOTHING),
    "psiu/@mesh/beat/valley": (NOTHING, NOTHING),
    "psiu/@mesh/notice/valley": (NOTHING, NOTHING),
    "psiu/@mesh/probe/valley/MNERIM": (NOTHING, NOTHING),
}


class Site:
    """One broker for all these tests, a session of each role, and a witness with a broker's certificate."""

    def __init__(self, folder: Path) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        self._serial = count()
        self._open = ExitStack()
        self.lab = SecureLab(folder)
        self._run(self.lab.__aenter__())
        self.witness = self._open.enter_context(self.lab.program("spy"))
        self.sessions = {name: self._open.enter_context(self.lab.program(name)) for name in ROLES}

    def close(self) -> None:
        self._open.close()
        self._run(self.lab.__aexit__())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def _run(self, work: Any) -> None:
        asyncio.run_coroutine_threadsafe(work, self._loop).result(30)

    def settled(self, session: zenoh.Session) -> None:
        """Return once all that `session` has said before has been judged by the broker."""
        until(lambda: list(session.get("psiu/@broker/base/status", timeout=10)), 60)

    def allowed(self, session: zenoh.Session, action: str, key: str) -> bool | None:
        """None: half of it, a question without its answer."""
        mark = f"psiu/mark/mark/{next(self._serial)}"
        return {
            "put": lambda: self._tells(session, key, mark, delete=False),
            "delete": lambda: self._tells(session, key, mark, delete=True),
            "hear": lambda: self._hears(session, key, mark),
            "ask": lambda: self._asks(session, self.witness, key, mark),
            "answer": lambda: self._asks(self.witness, session, key, mark),
            "declare a token": lambda: self._shows(session, self.witness, f"{key}/{mark.rpartition('/')[2]}", mark),
            "see a token": lambda: self._shows(self.witness, session, f"{key}/{mark.rpartition('/')[2]}", mark),
        }[action]()

    def _mark(self, session: zenoh.Session, mark: str, seen: Callable[[], object]) -> None:
        """Return once `mark` is seen; it is said again, as Zenoh may end a link on a busy machine."""
        for _ in range(10):
            session.put(mark, b"", attachment=mark.encode(), congestion_control=BLOCK)
            with suppress(AssertionError):
                until(seen, 3)
                return
        raise AssertionError(f"{mark} was not seen")

    def _tells(self, session: zenoh.Session, key: str, mark: str, *, delete: bool) -> bool:
        seen: list[tuple[str, bytes]] = []
        subscribers = [self.witness.declare_subscriber(each, noting(seen)) for each in (key, mark)]
        self.settled(self.witness)
        if delete:
            session.delete(key, attachment=mark.encode(), congestion_control=BLOCK)
        else:
            session.put(key, b"{}", attachment=mark.encode(), congestion_control=BLOCK)
        self.settled(session)
        # Behind what the broker let pass.
        self._mark(self.sessions["hill"], mark, lambda: (mark, mark.encode()) in seen)
        for each in subscribers:
            each.undeclare()
        return (key, mark.encode()) in seen

    def _hears(self, session: zenoh.Session, key: str, mark: str) -> bool:
        seen: list[tuple[str, bytes]] = []
        subscribers = [session.declare_subscriber(each, noting(seen)) for each in (key, mark)]
        self.settled(session)
        self.witness.put(key, b"", attachment=mark.encode(), congestion_control=BLOCK)
        self._mark(self.witness, mark, lambda: (mark, mark.encode()) in seen)
        for subscriber in subscribers:
            subscriber.undeclare()
        return (key, mark.encode()) in seen

    def _asks(self, asker: zenoh.Session, answerer: zenoh.Session, key: str, mark: str) -> bool | None:
        asked: list[str] = []

        def answer(query: zenoh.Query) -> None:
            asked.append(mark)
            query.reply(query.key_expr, mark)

        queryable = answerer.declare_queryable(key, answer, allowed_origin=REMOTE)
        self.settled(answerer)
        replies = asker.get(
            key, timeout=5, target=zenoh.QueryTarget.ALL, consolidation=zenoh.ConsolidationMode.NONE, payload="{}"
        )
        got = [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]
        queryable.undeclare()
        return None if asked and mark.encode() not in got else bool(asked)

    def _shows(self, shower: zenoh.Session, watcher: zenoh.Session, key: str, mark: str) -> bool:
        seen: list[tuple[str, bytes]] = []
        heard: list[tuple[str, bytes]] = []
        subscriber = watcher.liveliness().declare_subscriber(key, noting(seen))
        marks = watcher.declare_subscriber(mark, noting(heard))
        self.settled(watcher)
        token = shower.liveliness().declare_token(key)
        self.settled(shower)
        self._mark(self.sessions["hill"], mark, lambda: heard)
        found = [each for each in watcher.liveliness().get(key, timeout=10) if each.ok is not None]
        token.undeclare()
        subscriber.undeclare()
        marks.undeclare()
        return bool(seen or found)


def noting(seen: list[tuple[str, bytes]]) -> Any:
    def note(sample: zenoh.Sample) -> None:
        attachment = sample.attachment
        seen.append((str(sample.key_expr), b"" if attachment is None else attachment.to_bytes()))

    return in_order(note)


def until(true: Callable[[], object], timeout_s: float = 15.0) -> None:
    """What the other threads of these tests know are values, not events."""
    end = time.monotonic() + timeout_s
    while not true():
        assert time.monotonic() < end
        time.sleep(0.002)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    site = Site(tmp_path_factory.mktemp("rights"))
    try:
        yield site
    finally:
        site.close()


@pytest.mark.parametrize("name", ROLES)
@pytest.mark.parametrize("key", KEYS)
def test_each_role_may_do_with_each_key_what_is_said_here_and_nothing_else(site: Site, key: str, name: str) -> None:
    listener, commander = KEYS[key]
    may = {"listener": listener, "commander": listener | commander, "broker": set(ACTIONS)}[ROLES[name]]
    session = site.sessions[name]
    done = {action: site.allowed(session, action, key) for action in ACTIONS}
    # What is allowed may fail where Zenoh ends a link on a busy machine; what is not allowed may not pass once.
    done |= {action: site.allowed(session, action, key) for action in may if not done[action]}
    assert done == {action: action in may for action in ACTIONS}


def test_every_key_of_the_bus_is_among_those_that_are_tried(site: Site) -> None:
    words = {key.split("/")[1] for key in KEYS if "/@" in key}
    assert words == {key.partition("/")[0] for key in EVERYTHING if key.startswith("@")}
    [reply] = list(site.sessions["screen"].get("psiu/@broker/base/none-of-these", timeout=10))
    assert reply.err is not None
    text = str(json.loads(reply.err.payload.to_bytes())["message"]).partition("is none of")[2]
    served = {each.split("/")[0] for each in text.replace("psiu/@broker/base/", "").replace(" and ", ", ").split(", ")}
    assert {each.strip() for each in served} == {key.split("/")[3] for key in KEYS if "/@broker/" in key}

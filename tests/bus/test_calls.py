import asyncio
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from concurrent.futures import Future
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from psiu_broker.bus import calls as calls_module
from psiu_broker.bus import replies as replies_module
from psiu_broker.bus.calls import Calls, read_request
from psiu_broker.bus.keys import Keys
from psiu_broker.bus.session import Session
from psiu_broker.errors import CallError
from psiu_broker.frame import Address
from psiu_broker.messages import Answer, CallRequest, Refusal

Until = Callable[[Callable[[], object]], Awaitable[None]]


class Robots:
    """A backend that remembers what it was told to do."""

    def __init__(self) -> None:
        self.called: list[tuple[Address, str, CallRequest]] = []
        self.sent: list[tuple[Address, str, CallRequest]] = []
        self.hold = asyncio.Event()
        self.hold.set()

    async def call(self, robot: Address, command: str, request: CallRequest) -> Answer:
        self.called.append((robot, command, request))
        await self.hold.wait()
        if command == "bug":
            raise ZeroDivisionError
        if robot == Address.named("NOBODY"):
            raise CallError("unknown_robot", "no robot NOBODY is known")
        return Answer(status="sucesso", values=[7, "é"], elapsed_ms=12.5)

    async def send(self, robot: Address, command: str, request: CallRequest) -> None:
        self.sent.append((robot, command, request))
        if command == "bug":
            raise ZeroDivisionError
        if command == "refused" or len(command) > 100:
            raise CallError("refused", "parafrente takes 0–999, got 1200")


@pytest.fixture
async def robots() -> Robots:
    return Robots()


@pytest.fixture
async def calls(session: Session, keys: Keys, robots: Robots) -> AsyncIterator[Calls]:
    calls = await Calls.open(session, keys, robots.call, robots.send)
    yield calls
    await calls.close()


async def ask(program: zenoh.Session, key: str, payload: bytes | str | None = None, timeout_s: float = 5) -> list[Any]:
    """Get `key` as any program would: the answers, each a dict of JSON or a Refusal."""

    def get() -> list[Any]:
        found: list[Any] = []
        for reply in program.get(key, payload=payload, timeout=timeout_s, target=zenoh.QueryTarget.ALL):
            if reply.ok:
                assert str(reply.ok.encoding) == "application/json;psiu/Answer"
                found.append(json.loads(reply.ok.payload.to_string()))
            else:
                assert str(reply.err.encoding) == "application/json;psiu/Refusal"
                found.append(Refusal.model_validate_json(reply.err.payload.to_bytes()))
        return found

    return await asyncio.to_thread(get)


async def test_a_get_sends_and_waits_for_the_answer(calls: Calls, program: zenoh.Session, robots: Robots) -> None:
    [answer] = await ask(program, "psiu/@call/MNERIM/parafrente", '{"parameters": [100], "timeout_s": 4}')
    assert answer == {"status": "sucesso", "values": [7, "é"], "unit": None, "remark": None, "elapsed_ms": 12.5}
    request = CallRequest(parameters=[100], timeout_s=4)
    assert robots.called == [(Address.named("MNERIM"), "parafrente", request)]


@pytest.mark.parametrize("payload", [None, b"", "{}"])
async def test_no_payload_is_no_parameters(
    calls: Calls, program: zenoh.Session, robots: Robots, payload: bytes | None
) -> None:
    await ask(program, "psiu/@call/red.0x12/garra%20dois", payload)
    assert robots.called == [(Address.numbered(0x12, "red"), "garra dois", CallRequest())]


async def test_parameters_keep_their_types(calls: Calls, program: zenoh.Session, robots: Robots) -> None:
    await ask(program, "psiu/@call/A/b", '{"parameters": [1, 1.0, "1", -0.5]}')
    parameters = robots.called[0][2].parameters
    assert parameters == [1, 1.0, "1", -0.5]
    assert [type(value) for value in parameters] == [int, float, str, float]


async def test_a_refusal_is_an_error_reply_that_names_the_reason(calls: Calls, program: zenoh.Session) -> None:
    assert await ask(program, "psiu/@call/NOBODY/x") == [
        Refusal(error="unknown_robot", message="no robot NOBODY is known")
    ]


async def test_a_bug_in_the_broker_is_an_answer_and_a_log_entry(
    calls: Calls, program: zenoh.Session, caplog: pytest.LogCaptureFixture
) -> None:
    [refusal] = await ask(program, "psiu/@call/A/bug")
    assert refusal.error == "outcome_unknown"
    assert "failed inside the broker" in caplog.text


@pytest.mark.parametrize(
    "payload",
    [
        b"\xff\xfe",
        b"[1]",
        b"null",
        b'{"parameters": 5}',
        b'{"parameters": [[1]]}',
        b'{"parameters": [NaN]}',
        b'{"parameters": [true]}',
        b'{"parameters": [1e999]}',
        b'{"timeout_s": 0}',
        b'{"timeout_s": 1e9}',
        b'{"velocity": 5}',
        b'{"parameters": [' + b"1," * 64 + b"1]}",
        b"[" * 60_000,
        b'{"parameters": [1]}' + b" " * 65_536,
        b'{"parameters": ["\\ud800"]}',
    ],
)
async def test_a_wrong_payload_is_a_bad_request_and_moves_nothing(
    calls: Calls, program: zenoh.Session, robots: Robots, until: Until, payload: bytes
) -> None:
    [refusal] = await ask(program, "psiu/@call/A/b", payload)
    assert refusal.error == "bad_request"
    assert len(refusal.message) < 300
    program.put("psiu/@call/A/b", payload, congestion_control=zenoh.CongestionControl.BLOCK)
    program.put("psiu/@call/A/after", b"", congestion_control=zenoh.CongestionControl.BLOCK)
    await until(lambda: robots.sent)
    assert robots.called == []
    assert [command for _, command, _ in robots.sent] == ["after"]


@pytest.mark.parametrize(
    "key",
    [
        "psiu/@call/*/parafrente",
        "psiu/@call/A/*",
        "psiu/@call/**",
        "psiu/@call/*/*",
        "**/@call/A/b",
        "psiu/@call/%ED%A0%80/x",
    ],
)
async def test_a_call_to_many_robots_at_once_is_refused(
    calls: Calls, program: zenoh.Session, robots: Robots, until: Until, key: str
) -> None:
    [refusal] = await ask(program, key)
    assert refusal.error == "bad_request"
    program.put(key, b"")
    program.put("psiu/@call/A/after", b"")
    await until(lambda: robots.sent)
    assert robots.called == []
    assert [command for _, command, _ in robots.sent] == ["after"]
    assert calls.refused_puts == 1


async def test_parameters_behind_the_key_are_refused_and_not_forgotten(
    calls: Calls, program: zenoh.Session, robots: Robots
) -> None:
    [refusal] = await ask(program, "psiu/@call/A/parafrente?100")
    assert refusal.error == "bad_request"
    assert robots.called == []
    [answer] = await ask(program, "psiu/@call/A/parafrente?_anyke")
    assert answer["status"] == "sucesso"


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.one_of(
        st.binary(max_size=200),
        st.recursive(
            st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
            lambda inner: st.lists(inner) | st.dictionaries(st.sampled_from(["parameters", "timeout_s", "x"]), inner),
        ).map(lambda value: json.dumps(value).encode()),
    )
)
async def test_any_payload_at_all_gets_one_answer(calls: Calls, program: zenoh.Session, payload: bytes) -> None:
    [answer] = await ask(program, "psiu/@call/A/b", payload)
    assert isinstance(answer, dict) or answer.error == "bad_request"


@given(st.binary())
def test_reading_a_request_raises_nothing_but_a_call_error(payload: bytes) -> None:
    try:
        assert isinstance(read_request(payload), CallRequest)
    except CallError as error:
        assert error.code == "bad_request"


async def test_a_put_sends_and_goes_on(calls: Calls, program: zenoh.Session, robots: Robots, until: Until) -> None:
    program.put("psiu/@call/MNERIM/parafrente", '{"parameters": [5]}')
    await until(lambda: robots.sent)
    assert robots.sent == [(Address.named("MNERIM"), "parafrente", CallRequest(parameters=[5]))]
    assert robots.called == []


async def test_a_put_that_fails_troubles_nobody(
    calls: Calls, program: zenoh.Session, robots: Robots, until: Until, caplog: pytest.LogCaptureFixture
) -> None:
    program.delete("psiu/@call/A/deleted")
    for command in ("refused", "bug", "fine"):
        program.put(f"psiu/@call/A/{command}", b"")
    program.put("psiu/@call/A/" + "é" * 8000, b"")  # its key would be too long as we write it
    await until(lambda: len(robots.sent) == 4)
    assert calls.refused_puts == 2
    assert [record.levelname for record in caplog.records if record.levelname == "ERROR"] == ["ERROR"]


async def test_more_calls_than_are_taken_at_once_are_refused_as_busy(
    session: Session, keys: Keys, program: zenoh.Session, robots: Robots, monkeypatch: pytest.MonkeyPatch, until: Until
) -> None:
    monkeypatch.setattr(calls_module, "AT_ONCE_MAX", 3)
    calls = await Calls.open(session, keys, robots.call, robots.send)
    robots.hold.clear()
    waiting = [asyncio.create_task(ask(program, f"psiu/@call/A/c{number}")) for number in range(3)]
    await until(lambda: len(robots.called) == 3)
    [refusal] = await ask(program, "psiu/@call/A/more")
    assert refusal.error == "busy"
    waiting.append(asyncio.create_task(ask(program, "psiu/@call/A/Pare")))  # a stop is let in all the same
    await until(lambda: len(robots.called) == 4)
    robots.hold.set()
    for each in await asyncio.gather(*waiting):
        assert each[0]["status"] == "sucesso"
    [answer] = await ask(program, "psiu/@call/A/more")  # the room is given back
    assert answer["status"] == "sucesso"
    await calls.close()


async def test_a_broker_that_stops_says_so_to_everybody_who_waits(
    calls: Calls, program: zenoh.Session, robots: Robots, until: Until
) -> None:
    robots.hold.clear()
    waiting = [asyncio.create_task(ask(program, f"psiu/@call/A/c{number}")) for number in range(3)]
    await until(lambda: len(robots.called) == 3)
    await calls.close()
    for [refusal] in await asyncio.gather(*waiting):
        assert refusal.error == "shutting_down"


async def test_a_broker_that_stops_says_so_to_those_who_come_then(
    calls: Calls, program: zenoh.Session, robots: Robots, until: Until
) -> None:
    robots.hold.clear()
    earlier = asyncio.create_task(ask(program, "psiu/@call/A/earlier"))
    await until(lambda: robots.called)
    asked: Any = SimpleNamespace(query=object())
    told: list[str] = []
    calls._replies.refuse = lambda query, error: told.append(error.code) or Future()  # type: ignore[method-assign]
    calls._begin(asked)  # not even begun when the broker stops
    asyncio.get_running_loop().call_soon(calls._begin, asked)  # comes while it stops
    await calls.close()
    calls._begin(asked)
    await until(lambda: len(told) == 4)
    assert told == ["shutting_down"] * 4
    earlier.cancel()


async def test_what_comes_to_a_broker_that_stops_takes_nobodys_room(
    session: Session, keys: Keys, program: zenoh.Session, robots: Robots, monkeypatch: pytest.MonkeyPatch, until: Until
) -> None:
    monkeypatch.setattr(calls_module, "AT_ONCE_MAX", 1)
    calls = await Calls.open(session, keys, robots.call, robots.send)
    await calls.close()
    program.put("psiu/@call/A/b", b"")
    await until(lambda: calls.refused_puts)
    for _ in range(2):
        async with asyncio.timeout(5):
            while (await ask(program, "psiu/@call/A/b"))[0].error != "shutting_down":
                pass  # busy: a refusal gives its room back a moment after it has left
    assert robots.called == robots.sent == []


async def test_a_put_gives_its_room_back(
    session: Session, keys: Keys, program: zenoh.Session, robots: Robots, monkeypatch: pytest.MonkeyPatch, until: Until
) -> None:
    monkeypatch.setattr(calls_module, "AT_ONCE_MAX", 1)
    calls = await Calls.open(session, keys, robots.call, robots.send)
    program.put("psiu/@call/A/refused", b"")
    await until(lambda: robots.sent)
    [answer] = await ask(program, "psiu/@call/A/b")
    assert answer["status"] == "sucesso"
    await calls.close()


async def test_an_answer_on_its_way_is_not_lost_when_the_broker_stops(
    calls: Calls, program: zenoh.Session, robots: Robots, until: Until
) -> None:
    busy = threading.Event()
    calls._replies._worker.submit(busy.wait)  # as with an asker that does not read
    asked = asyncio.create_task(ask(program, "psiu/@call/A/b"))
    await until(lambda: calls._replies._pending)
    closing = asyncio.create_task(calls.close())
    await asyncio.sleep(0.01)
    busy.set()
    await closing
    [answer] = await asked
    assert answer["status"] == "sucesso"


async def test_askers_that_do_not_read_keep_no_broker_from_stopping(
    calls: Calls, program: zenoh.Session, robots: Robots, until: Until, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(replies_module, "SENT_S", 0.01)
    busy = threading.Event()
    calls._replies._worker.submit(busy.wait)
    asked = asyncio.create_task(ask(program, "psiu/@call/A/b"))
    await until(lambda: calls._replies._pending)
    try:
        async with asyncio.timeout(5):
            await calls.close()
    finally:
        busy.set()
    await asked


async def test_an_asker_that_gave_up_harms_nobody(
    calls: Calls, program: zenoh.Session, robots: Robots, until: Until
) -> None:
    robots.hold.clear()
    gone = program.get("psiu/@call/A/b", timeout=0.05)
    assert all(reply.err for reply in await asyncio.to_thread(lambda: list(gone)))
    robots.hold.set()
    [answer] = await ask(program, "psiu/@call/A/c")
    assert answer["status"] == "sucesso"


async def test_an_answer_to_a_stopped_program_keeps_others_waiting_for_a_moment_only(
    session: Session, calls: Calls, program: zenoh.Session, endpoint: str, robots: Robots, until: Until
) -> None:
    script = f"""
import json, time, zenoh
config = {{"mode": "client", "connect": {{"endpoints": [{endpoint!r}]}}}}
session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
subscriber = session.declare_subscriber("psiu/flood", zenoh.handlers.RingChannel(10))
replies = session.get("psiu/@call/A/held", timeout=60)
time.sleep(60)
"""
    robots.hold.clear()
    stopped = await asyncio.to_thread(subprocess.Popen, [sys.executable, "-c", script])
    try:
        await until(lambda: robots.called)
        os.kill(stopped.pid, signal.SIGSTOP)
        flood = session.zenoh.declare_publisher("psiu/flood", congestion_control=zenoh.CongestionControl.DROP)
        for _ in range(20_000):  # its queue and its socket are full now: a reply to it waits
            flood.put(b"x" * 1000)
        robots.hold.set()
        begun = time.monotonic()
        [answer] = await ask(program, "psiu/@call/A/b", timeout_s=10)
        assert answer["status"] == "sucesso"
        assert time.monotonic() - begun < 4  # Zenoh's own patience is five seconds
    finally:
        stopped.kill()
        stopped.wait()

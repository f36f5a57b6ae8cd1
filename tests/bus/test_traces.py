import asyncio
import json
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

import pytest
import zenoh

from psiu_broker.bus.keys import Keys
from psiu_broker.bus.session import Session
from psiu_broker.bus.traces import AT_ONCE_MAX, Traces
from psiu_broker.errors import BusError
from psiu_broker.frame import Address
from psiu_broker.mesh.probe import Probed
from psiu_broker.messages import Refusal, Trace

Until = Callable[[Callable[[], object]], Awaitable[None]]
Pair = tuple[Address, Address]
BETA, MNERIM = Address.named("BETA"), Address.named("MNERIM")


class Broker:
    """Has every robot but STRANGER; remembers what it was asked."""

    def __init__(self) -> None:
        self.traced: list[Pair] = []
        self.looked: list[Address] = []
        self.hold = asyncio.Event()
        self.hold.set()

    async def trace(self, a: Address, b: Address) -> Trace | None:
        self.traced.append((a, b))
        await self.hold.wait()
        if b == Address.named("bug"):
            raise ZeroDivisionError
        if a == Address.named("STRANGER"):
            return None
        return Trace(a=str(a), b=str(b), question="ping", answered=True, total_ms=1)

    async def probed(self, robot: Address) -> Probed:
        self.looked.append(robot)
        return Probed(question="ping", answered=True, took_ms=3)


@pytest.fixture
async def broker() -> Broker:
    return Broker()


@pytest.fixture
async def traces(session: Session, keys: Keys, broker: Broker) -> AsyncIterator[Traces]:
    traces = await Traces.open(session, keys, "base", broker.trace, broker.probed)
    yield traces
    await traces.close()


async def ask(program: zenoh.Session, key: str) -> dict[str, Any]:
    """The JSON found, by key; the errors under the empty key."""

    def get() -> dict[str, Any]:
        found: dict[str, Any] = {}
        for reply in program.get(key, timeout=5):
            if reply.ok:
                found[str(reply.ok.key_expr)] = json.loads(reply.ok.payload.to_string())
            else:
                found[""] = Refusal.model_validate_json(reply.err.payload.to_bytes())
        return found

    return await asyncio.to_thread(get)


async def test_a_trace_comes_on_the_broker_s_own_key(traces: Traces, program: zenoh.Session, broker: Broker) -> None:
    found = await ask(program, "psiu/@broker/*/trace/BETA/0x12")
    trace = Trace.model_validate(found["psiu/@broker/base/trace/BETA/0x12"])
    assert (trace.a, trace.b) == ("BETA", "0x12")
    assert broker.traced == [(BETA, Address.numbered(0x12))]


async def test_who_has_not_the_robot_says_nothing(traces: Traces, program: zenoh.Session) -> None:
    assert await ask(program, "psiu/@broker/*/trace/STRANGER/BETA") == {}


@pytest.mark.parametrize("key", ["psiu/@broker/**", "psiu/@broker/base/trace/*/B", "psiu/@broker/base/trace/A/*"])
async def test_wildcards_ask_no_robot(traces: Traces, program: zenoh.Session, broker: Broker, key: str) -> None:
    assert await ask(program, key) == {}
    assert broker.traced == []


async def test_what_cannot_be_read_or_fails_is_a_refusal(
    traces: Traces, program: zenoh.Session, caplog: pytest.LogCaptureFixture
) -> None:
    assert (await ask(program, "psiu/@broker/base/trace/%ED%A0%80/A"))[""].error == "bad_request"
    assert caplog.text == ""
    assert (await ask(program, "psiu/@broker/base/trace/A/bug"))[""].error == "impossible"
    assert "failed inside the broker" in caplog.text


async def test_too_many_at_once_are_refused_and_there_is_room_again(
    traces: Traces, program: zenoh.Session, broker: Broker, until: Until
) -> None:
    broker.hold.clear()
    held = [program.get("psiu/@broker/base/trace/A/B", timeout=5) for _ in range(AT_ONCE_MAX)]
    await until(lambda: len(broker.traced) == AT_ONCE_MAX)
    assert (await ask(program, "psiu/@broker/base/trace/A/B"))[""].error == "busy"
    broker.hold.set()
    replies = await asyncio.to_thread(lambda: [list(each) for each in held])
    assert all(reply.ok for [reply] in replies)
    assert await ask(program, "psiu/@broker/base/trace/A/B")


async def test_a_broker_that_stops_says_so(
    traces: Traces, program: zenoh.Session, broker: Broker, until: Until
) -> None:
    broker.hold.clear()
    asked = asyncio.create_task(ask(program, "psiu/@broker/base/trace/A/B"))
    await until(lambda: broker.traced)
    await traces.close()
    assert (await asked)[""].error == "shutting_down"


async def test_another_broker_is_asked_and_zenoh_tells_the_way(
    traces: Traces, broker: Broker, session: Session, endpoint: str, keys: Keys
) -> None:
    other = await Session.open([], connect=[endpoint])
    try:
        asker = await Traces.open(other, keys, "north", broker.trace, broker.probed)
        async with asyncio.timeout(10):
            while True:
                try:
                    probed, stamps = await asker.probe("base", MNERIM, 2)
                    break
                except BusError as error:  # not connected yet
                    assert "base did not answer" in str(error)
        assert (probed.took_ms, broker.looked) == (3, [MNERIM])
        ours, theirs = other.zenoh_id.lstrip("0"), session.zenoh_id.lstrip("0")
        passed = [(stamp.zenoh_id, stamp.point) for stamp in stamps if stamp.point != "route"]
        assert passed == [(ours, "send"), (theirs, "receive"), (theirs, "send"), (ours, "receive")]
        with pytest.raises(BusError, match="gate did not answer"):
            await asker.probe("gate", MNERIM, 1)
        await asker.close()
    finally:
        await other.close()

"""A program that asks and does not read the answers, as another process: a crashed tool, a stopped one."""

import asyncio
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Mapping
from typing import Any

import pytest
from quiet import Quiet

from psiu_broker.bus import session as session_module
from psiu_broker.bus.calls import Calls
from psiu_broker.bus.keys import Keys
from psiu_broker.bus.publisher import Publisher
from psiu_broker.bus.queries import Queries
from psiu_broker.bus.round_trip import RoundTrip
from psiu_broker.bus.session import Session
from psiu_broker.errors import BusError, CallError
from psiu_broker.frame import Address, Frame, Way

FRAME = Frame(Address.named("PC"), Address.named("A"), "pare", b"pare", "psiu-ascii", b"A 020 pare PC 00000", "x")
STUCK = """
import json, sys, time, zenoh
config = {"mode": "client", "connect": {"endpoints": [sys.argv[1]]}}
session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
subscriber = session.declare_subscriber("psiu/**", zenoh.handlers.RingChannel(10))
kept = []
while True:
    kept.append(session.get(sys.argv[2], zenoh.handlers.FifoChannel(1), timeout=60.0))
    time.sleep(0.001)
"""


class Bus:
    """All that a broker has on the bus, and a program that is stuck."""

    def __init__(self, session: Session, publisher: Publisher, queries: Queries, round_trip: RoundTrip) -> None:
        self.session = session
        self.publisher = publisher
        self.queries = queries
        self.round_trip = round_trip

    async def stuck(self) -> Any:
        """Wait until a reply has been on its way for long; its end, or that of what waits behind it."""
        async with asyncio.timeout(30):
            while True:
                behind = self.queries._replies._worker.submit(int)
                await asyncio.sleep(0.4)
                if not behind.done():
                    return behind


class Wordy(Quiet):
    """Whoever does not read what it says is soon stuck."""

    def config(self) -> Mapping[str, Any]:
        return {"long": "x" * 100_000}


async def no_robot(*_: object) -> Any:
    raise CallError("unknown_robot", "no robot is known")


@pytest.fixture
def stuck_s() -> float:
    return 30.0


@pytest.fixture
async def bus(endpoint: str, keys: Keys, stuck_s: float, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Bus]:
    monkeypatch.setattr(session_module, "STUCK_S", stuck_s)
    session = await Session.open([endpoint])
    calls = await Calls.open(session, keys, no_robot, no_robot)
    yield Bus(
        session,
        await Publisher.open(session, keys, "base", lambda frame: {"kind": "command"}),
        await Queries.open(session, keys, "base", Wordy()),
        await RoundTrip.open(session, keys, "base"),
    )
    await calls.close()
    await session.close()


@pytest.fixture
async def program(bus: Bus, endpoint: str) -> AsyncIterator[subprocess.Popen[bytes]]:
    command = [sys.executable, "-c", STUCK, endpoint, "psiu/@broker/base/**"]
    program = await asyncio.to_thread(subprocess.Popen, command)
    yield program
    program.kill()
    await asyncio.to_thread(program.wait)


def call_from_elsewhere(endpoint: str) -> str:
    """What a call from a third process is told; in ours it would share Zenoh's threads with the broker."""
    script = """
import json, sys, zenoh
config = {"mode": "client", "connect": {"endpoints": [sys.argv[1]]}}
with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
    for reply in session.get("psiu/@call/A/pare", timeout=10.0):
        print(reply.err.payload.to_string())
"""
    return subprocess.run([sys.executable, "-c", script, endpoint], capture_output=True, text=True, check=True).stdout


async def test_one_stuck_program_holds_up_neither_calls_nor_the_watchdog_nor_the_loop(
    bus: Bus, endpoint: str, program: subprocess.Popen[bytes]
) -> None:
    behind = await bus.stuck()
    assert bus.publisher.listened
    begun = time.monotonic()
    bus.publisher.publish(FRAME, Way("radio"), time.time())
    assert time.monotonic() - begun < 5
    assert await bus.round_trip.measure(10) < 5
    answers = await asyncio.wait_for(asyncio.to_thread(call_from_elsewhere, endpoint), 15)
    assert "unknown_robot" in answers
    assert not behind.done()  # all this while the reply to it was waiting
    program.kill()
    await asyncio.wait_for(asyncio.wrap_future(behind), 20)


@pytest.mark.parametrize("stuck_s", [session_module.STUCK_S])
async def test_a_stuck_program_holds_up_other_askers_for_a_moment_only(
    bus: Bus, endpoint: str, program: subprocess.Popen[bytes], stuck_s: float
) -> None:
    behind = await bus.stuck()
    await asyncio.wait_for(asyncio.wrap_future(behind), 4)  # Zenoh's own patience is five seconds


async def test_a_round_trip_goes_through_zenoh_and_the_loop(session: Session, keys: Keys) -> None:
    trip = await RoundTrip.open(session, keys, "base")
    assert 0 < await trip.measure(5) < 5
    blocked = asyncio.create_task(trip.measure(0.3))
    await asyncio.sleep(0)
    time.sleep(0.6)  # noqa: ASYNC251  a loop that makes no progress
    with pytest.raises(BusError, match="did not answer"):
        await blocked
    await session.close()
    with pytest.raises(BusError):
        await trip.measure(1)


async def test_no_other_program_is_in_the_round_trip(session: Session, keys: Keys, connect: Any) -> None:
    await RoundTrip.open(session, keys, "base")
    program = connect()
    assert await asyncio.to_thread(lambda: list(program.get("psiu/@alive/**", timeout=5))) == []

"""A broker's session on a free loopback port, and a plain Zenoh client as the other program."""

import asyncio
import json
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator

import pytest
import zenoh
from ports import free_port

from psiu_broker.bus.keys import Keys
from psiu_broker.bus.session import Session
from psiu_broker.errors import BusError

Until = Callable[[Callable[[], object]], Awaitable[None]]


@pytest.fixture
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture
def keys() -> Keys:
    return Keys()


@pytest.fixture
def losses() -> list[BusError]:
    return []


@pytest.fixture
async def session(endpoint: str, losses: list[BusError]) -> AsyncIterator[Session]:
    session = await Session.open([endpoint], lost=losses.append)
    yield session
    await session.close()


@pytest.fixture
def connect(endpoint: str) -> Iterator[Callable[[], zenoh.Session]]:
    opened: list[zenoh.Session] = []

    def open_client() -> zenoh.Session:
        config = {
            "mode": "client",
            "connect": {"endpoints": [endpoint], "timeout_ms": 3000, "exit_on_failure": True},
            "scouting": {"multicast": {"enabled": False}},
        }
        opened.append(zenoh.open(zenoh.Config.from_json5(json.dumps(config))))
        return opened[-1]

    yield open_client
    for each in opened:
        each.close()


@pytest.fixture
def program(session: Session, connect: Callable[[], zenoh.Session]) -> zenoh.Session:
    """Another program: eclipse-zenoh alone, connected to the broker."""
    return connect()


@pytest.fixture
def until() -> Until:
    """Wait until something that tells no event has come true."""

    async def wait(condition: Callable[[], object]) -> None:
        end = time.monotonic() + 5
        while not condition():
            assert time.monotonic() < end, "did not come true within 5 s"
            await asyncio.sleep(0.002)

    return wait

import asyncio
import subprocess
import sys
import threading
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, cast
from unittest.mock import MagicMock

import psutil
import pytest
import zenoh

from psiu_broker.bus.calls import Calls
from psiu_broker.bus.keys import Keys
from psiu_broker.bus.publisher import Publisher
from psiu_broker.bus.queries import Queries
from psiu_broker.bus.round_trip import RoundTrip
from psiu_broker.bus.session import Session
from psiu_broker.errors import BusError


async def test_a_busy_port_is_one_clear_line(session: Session, endpoint: str) -> None:
    with pytest.raises(BusError) as raised:
        await Session.open([endpoint])
    assert str(raised.value) == f"zenoh.listen: {endpoint} is in use (another broker?)"


@pytest.mark.parametrize("wrong", ["nonsense", "serial//dev/ttyS0", "tcp/256.0.0.1:7447", "tcp/127.0.0.1"])
async def test_an_impossible_endpoint_is_one_line_without_places_in_zenohs_source(wrong: str) -> None:
    with pytest.raises(BusError) as raised:
        await Session.open([wrong])
    assert str(raised.value).startswith("zenoh")
    assert ".rs:" not in str(raised.value)
    assert "\n" not in str(raised.value)


async def test_a_broker_that_is_not_there_yet_is_met_when_it_comes_and_when_it_returns(
    endpoint: str, until: Callable[[Callable[[], object]], Awaitable[None]]
) -> None:
    early = await Session.open([], connect=[endpoint])
    try:
        for _ in range(2):
            late = await Session.open([endpoint])
            try:
                await until(lambda: [str(peer) for peer in early.zenoh.info.peers_zid()] == [late.zenoh_id])  # noqa: B023
            finally:
                await late.close()
            await until(lambda: not early.zenoh.info.peers_zid())
    finally:
        await early.close()


async def test_closing_ends_every_thread_frees_the_port_and_is_harmless_twice(
    endpoint: str, keys: Keys, until: Callable[[Callable[[], object]], Awaitable[None]]
) -> None:
    before = set(threading.enumerate())
    for _ in range(3):
        session = await Session.open([endpoint])
        await Publisher.open(session, keys, "base", lambda frame: {})
        await asyncio.wrap_future(session.worker("bus-test").submit(lambda: None))
        assert any(thread.name.startswith("psiu-bus") for thread in threading.enumerate())
        await session.close()
        await session.close()
    await until(lambda: not any(thread.name.startswith("psiu") for thread in set(threading.enumerate()) - before))
    assert not [c for c in psutil.Process().net_connections() if c.laddr and str(c.laddr.port) in endpoint]


async def test_the_bus_works_while_every_thread_of_asyncio_waits(endpoint: str, keys: Keys) -> None:
    async def unused(*_: object) -> None: ...

    freed = threading.Event()
    with ThreadPoolExecutor(1) as taken:
        asyncio.get_running_loop().set_default_executor(taken)
        waiting = asyncio.get_running_loop().run_in_executor(None, freed.wait)
        try:
            async with asyncio.timeout(20):
                session = await Session.open([endpoint])
                await Publisher.open(session, keys, "base", lambda frame: {})
                await Calls.open(session, keys, cast("Any", unused), unused)
                await Queries.open(session, keys, "base", MagicMock())
                trip = await RoundTrip.open(session, keys, "base")
                assert await trip.measure(10) < 10
                await session.close()
        finally:
            freed.set()
            await waiting


async def test_a_panic_inside_zenoh_loses_the_session_and_another_opens_in_its_place(
    session: Session,
    endpoint: str,
    keys: Keys,
    connect: Callable[[], zenoh.Session],
    losses: list[BusError],
    until: Callable[[Callable[[], object]], asyncio.Future[None]],
) -> None:
    subscriber = connect().declare_subscriber("psiu/**", zenoh.handlers.RingChannel(4))
    publisher = await Publisher.open(session, keys, "base", lambda frame: {})
    await until(lambda: publisher.listened)
    with pytest.raises(BaseException, match="DidntWrite") as panic:  # a schema of 256 bytes is Zenoh's own trap
        session.zenoh.put("psiu/x", b"", encoding=zenoh.Encoding("a/b").with_schema("x" * 300))
    assert session.panicked(panic.value)
    assert session.panicked(panic.value)
    await until(lambda: losses)
    assert len(losses) == 1
    assert "was lost" in str(losses[0])
    await session.close()
    again = await Session.open([endpoint])
    await again.close()
    subscriber.undeclare()


def test_an_error_that_is_no_panic_is_not_taken_for_one(session: Session) -> None:
    assert not session.panicked(ValueError("x"))
    assert not session.is_lost


@pytest.mark.parametrize("end", ["raise RuntimeError('forgot to close')", "sys.exit(1)"])
def test_a_process_that_forgets_to_close_still_ends_at_once(endpoint: str, end: str) -> None:
    script = f"""
import asyncio, sys
from psiu_broker.bus.keys import Keys
from psiu_broker.bus.publisher import Publisher
from psiu_broker.bus.session import Session
async def main():
    session = await Session.open([{endpoint!r}])
    await Publisher.open(session, Keys(), "base", lambda frame: {{}})
    await asyncio.wrap_future(session.worker("bus-test").submit(lambda: None))
    {end}
asyncio.run(main())
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=20, check=False)
    assert done.returncode == 1
    assert "FATAL" not in done.stderr
    assert done.stdout == ""

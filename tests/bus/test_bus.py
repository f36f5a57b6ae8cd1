"""All that a broker has on the bus, opened and closed as one."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import pytest
from ports import free_port

from psiu_broker.broker import Broker
from psiu_broker.bus.bus import Bus
from psiu_broker.bus.client import Client
from psiu_broker.bus.round_trip import RoundTrip
from psiu_broker.bus.session import Session
from psiu_broker.config import load
from psiu_broker.errors import BusError, CallError

Until = Callable[[Callable[[], object]], Awaitable[None]]


class PanicException(BaseException):
    """As Zenoh raises it; only its name tells."""


@pytest.fixture
def broker(endpoint: str, tmp_path: Path) -> Broker:
    file = tmp_path / "base.toml"
    file.write_text(f'[broker]\nname = "base"\n[zenoh]\nlisten = ["{endpoint}"]\n')
    return Broker(load(file))


@pytest.fixture
async def bus(broker: Broker) -> AsyncIterator[Bus]:
    bus = await Bus.open(broker.configuration, broker, lambda: None)
    yield bus
    await bus.close()


async def test_a_broker_is_served_on_one_session(bus: Bus, endpoint: str) -> None:
    with Client([endpoint]) as client:
        [status] = await asyncio.to_thread(client.brokers)
        assert status.broker == "base"
        with pytest.raises(CallError) as raised:
            await asyncio.to_thread(client.call, "NOBODY", "pare")
        assert raised.value.code == "unknown_robot"
        assert (await asyncio.to_thread(client.ask, "why", "A", "base"))["base"]["b"] == "base"
    assert await bus.round_trip.measure(5) < 5


async def test_who_retires_refuses_calls_and_still_tells_of_itself(bus: Bus, endpoint: str) -> None:
    await bus.retire()
    with Client([endpoint]) as client:
        with pytest.raises(CallError) as raised:
            await asyncio.to_thread(client.call, "base", "qualseunome")
        assert raised.value.code == "shutting_down"
        assert await asyncio.to_thread(client.brokers)


@pytest.mark.parametrize("trouble", [BusError("no"), PanicException("in Rust")])
async def test_a_bus_that_opens_by_half_leaves_the_port_free(
    broker: Broker, endpoint: str, monkeypatch: pytest.MonkeyPatch, trouble: BaseException
) -> None:
    async def fail(*_: object) -> RoundTrip:
        raise trouble

    monkeypatch.setattr(RoundTrip, "open", fail)
    with pytest.raises(BusError):
        await Bus.open(broker.configuration, broker, lambda: None)
    await (await Session.open([endpoint])).close()


async def test_it_listens_where_it_is_told_to_beside_the_configuration(broker: Broker) -> None:
    more = f"tcp/127.0.0.1:{free_port()}"
    bus = await Bus.open(broker.configuration, broker, lambda: None, [more])
    with Client([more]) as client:
        assert await asyncio.to_thread(client.brokers)
    await bus.close()


async def test_it_says_once_that_zenoh_broke(broker: Broker, until: Until) -> None:
    losses: list[None] = []
    bus = await Bus.open(broker.configuration, broker, lambda: losses.append(None))
    for _ in range(2):
        bus.session.panicked(PanicException("in Rust"))
    await until(lambda: losses)
    await bus.close()
    assert losses == [None]

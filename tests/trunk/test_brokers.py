"""Two whole brokers that have nothing in common but one stream."""

import asyncio
import json
import os
import socket
import tempfile
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
import zenoh
from broker_process import BrokerProcess
from ports import free_port
from stream_relay import Relay

from psiu_broker.broker import Broker
from psiu_broker.bus.session import Session
from psiu_broker.config import load
from psiu_broker.errors import BusError

CONFIGURATION = """
[broker]
name = "{name}"
[zenoh]
listen = ["tcp/127.0.0.1:{bus}"]
[trunks.far]
adapter = "serial"
device = "socket://127.0.0.1:{stream}"
[links.wifi]
adapter = "udp"
listen = "127.0.0.1:{wifi}"
protocol = "psiu-ascii"
"""
FORWARD = b"MNERIM 034 parafrente 100 PC 02123"


async def until(true: Callable[[], object], timeout_s: float = 10.0) -> None:
    """The broker's state is values, not events: look until it is so."""
    async with asyncio.timeout(timeout_s):
        while not true():  # noqa: ASYNC110
            await asyncio.sleep(0.005)


class Lab:
    """Brokers called base and hill, with a relay between their trunks."""

    def __init__(self, folder: Path, relay: Relay) -> None:
        self.relay = relay
        self.wifi = free_port(socket.SOCK_DGRAM)
        self.files = [folder / "base.toml", folder / "hill.toml"]
        for file, stream in zip(self.files, relay.ports, strict=True):
            text = CONFIGURATION.format(name=file.stem, bus=free_port(), stream=stream, wifi=self.wifi)
            file.write_text(text if file.stem == "hill" else text.partition("[links")[0])
        self.brokers = [Broker(load(file)) for file in self.files]

    @property
    def base(self) -> Broker:
        return self.brokers[0]

    @property
    def hill(self) -> Broker:
        return self.brokers[1]

    def states(self) -> list[tuple[str, str | None]]:
        return [(trunk.state, trunk.far) for broker in self.brokers for trunk in broker.trunks()]

    def peers(self) -> list[str]:
        """The Zenoh sessions that those of the brokers are connected with, programs aside."""
        return [str(each) for broker in self.brokers for each in session_of(broker).zenoh.info.peers_zid()]

    async def known(self, broker: Broker) -> set[str]:
        """The brokers that a program at `broker` reaches."""
        return set(await asyncio.to_thread(ask, broker, "psiu/@broker/*/status"))

    async def meet(self, timeout_s: float = 10.0) -> float:
        """Wait until a program at each broker reaches both; how long that took, in s."""
        begun = time.monotonic()
        async with asyncio.timeout(timeout_s):
            for broker in self.brokers:
                while len(await self.known(broker)) < 2:  # noqa: ASYNC110
                    await asyncio.sleep(0.05)
        return time.monotonic() - begun


def session_of(broker: Broker) -> Session:
    bus = broker._bus
    assert bus is not None
    return bus.session


def lose_session(broker: Broker) -> None:
    """As after a panic inside Zenoh."""
    session = session_of(broker)
    session.is_lost = True
    broker._bus_lost.set()


def connected(broker: Broker) -> zenoh.Session:
    endpoints = list(broker.configuration.zenoh.listen)
    config = {"mode": "client", "connect": {"endpoints": endpoints}, "scouting": {"multicast": {"enabled": False}}}
    return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))


def ask(broker: Broker, key: str) -> dict[str, Any]:
    session = connected(broker)
    try:
        replies = session.get(key, target=zenoh.QueryTarget.ALL, timeout=2)
        return {str(reply.ok.key_expr): json.loads(reply.ok.payload.to_bytes()) for reply in replies if reply.ok}
    finally:
        session.close()


@pytest.fixture
async def relay() -> AsyncIterator[Relay]:
    async with Relay() as relay:
        yield relay


@pytest.fixture
async def lab(tmp_path: Path, relay: Relay) -> AsyncIterator[Lab]:
    lab = Lab(tmp_path, relay)
    try:
        for broker in lab.brokers:
            await broker.start()
        yield lab
    finally:
        for broker in lab.brokers:
            await broker.stop()


async def test_programs_at_either_end_reach_both_brokers(lab: Lab) -> None:
    await lab.meet()
    assert lab.states() == [("open", "hill"), ("open", "base")]
    for broker in lab.brokers:
        assert await lab.known(broker) == {"psiu/@broker/base/status", "psiu/@broker/hill/status"}
        assert await broker.healthy()
    assert [link.state for link in lab.hill.links()] == ["open"]


async def test_what_a_robot_says_at_one_end_is_heard_at_the_other(lab: Lab) -> None:
    await lab.meet()
    session = await asyncio.to_thread(connected, lab.base)
    heard: list[str] = []
    try:
        session.declare_subscriber("psiu/*/*/*", lambda sample: heard.append(str(sample.key_expr)))
        await until(lambda: lab.hill.exchange.bus.listened)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as robot:
            robot.sendto(FORWARD, ("127.0.0.1", lab.wifi))
            await until(lambda: "psiu/PC/MNERIM/parafrente" in heard)
    finally:
        await asyncio.to_thread(session.close)


async def test_a_cut_stream_is_noticed_at_once_and_carries_again_when_it_is_back(lab: Lab, relay: Relay) -> None:
    await lab.meet()
    for _ in range(2):
        relay.cut()
        begun = time.monotonic()
        await until(lambda: not lab.peers())
        assert time.monotonic() - begun < 1.0, "before Zenoh's lease of 2 s"
        assert [state for state, _ in lab.states()] == ["waiting", "waiting"]
        assert all(str(relay.ports[0]) in str(trunk.reason) for trunk in lab.base.trunks())
        assert await lab.base.healthy()
        await relay.restore()
        await lab.meet()
        assert lab.states() == [("open", "hill"), ("open", "base")]


async def test_a_stream_cut_in_the_middle_of_anything_carries_again(lab: Lab, relay: Relay) -> None:
    for size in (10, 45, 70, 73, 200, 501):
        relay.cut_at = relay.carried + size
        await until(lambda: relay.cut_at is None or not relay.serving)
        await relay.restore()
    await lab.meet()


async def test_a_broker_that_starts_again_is_met_again(lab: Lab) -> None:
    await lab.meet()
    for place, file in enumerate(lab.files):
        await lab.brokers[place].stop()
        lab.brokers[place] = Broker(load(file))
        await lab.brokers[place].start()
        await lab.meet()


async def test_a_session_that_was_lost_is_replaced_without_a_new_stream(lab: Lab, relay: Relay) -> None:
    await lab.meet()
    for broker in lab.brokers:
        old = broker.status().zenoh_id
        lose_session(broker)
        await until(lambda: broker.status().zenoh_id not in ("", old))  # noqa: B023
        await lab.meet()
    assert relay.joined == 1


async def test_a_broker_that_cannot_start_leaves_nothing_behind(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    with tempfile.TemporaryDirectory() as folder:
        monkeypatch.setattr(tempfile, "tempdir", folder)
        with pytest.raises(BusError, match="in use"):
            await Broker(load(lab.files[0])).start()
        assert os.listdir(folder) == []  # noqa: PTH208


async def test_two_processes_are_one_network_also_after_one_was_killed(tmp_path: Path, relay: Relay) -> None:
    device = '[trunks.far]\nadapter = "serial"\ndevice = "socket://127.0.0.1:{}"\n'
    base, hill = (
        BrokerProcess(tmp_path, name, device.format(port))
        for name, port in zip(("base", "hill"), relay.ports, strict=True)
    )
    both = {name: {"broker": name} for name in ("base", "hill")}
    async with base.running():
        for _ in range(2):
            async with hill.running() as process:
                await base.until("status", both)
                await hill.until("status", both)
                process.kill()
            await base.until("trunks", {"base": {"state": "opening", "far": None}})
    assert relay.joined == 2

"""Two whole brokers that have nothing in common but one stream."""

import asyncio
import json
import socket
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
import zenoh
from stream_relay import Relay

from psiu_broker.broker import Broker
from psiu_broker.config import load

CONFIGURATION = """
[broker]
name = "{name}"
[zenoh]
listen = ["tcp/127.0.0.1:{bus}"]
[trunks.far]
adapter = "serial"
device = "socket://127.0.0.1:{stream}"
"""


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


async def until(true: Callable[[], object], timeout_s: float = 10.0) -> None:
    """The broker's state is values, not events: look until it is so."""
    async with asyncio.timeout(timeout_s):
        while not true():  # noqa: ASYNC110
            await asyncio.sleep(0.005)


class Lab:
    """Brokers called base and hill, with a relay between their trunks."""

    def __init__(self, folder: Path, relay: Relay) -> None:
        self.relay = relay
        self.brokers = []
        for name, stream in zip(("base", "hill"), relay.ports, strict=True):
            file = folder / f"{name}.toml"
            file.write_text(CONFIGURATION.format(name=name, bus=free_port(), stream=stream))
            self.brokers.append(Broker(load(file)))
        self.base, self.hill = self.brokers

    def states(self) -> list[tuple[str, str | None]]:
        return [(trunk.state, trunk.far) for broker in self.brokers for trunk in broker.trunks()]

    async def open(self) -> None:
        await until(lambda: self.states() == [("open", "hill"), ("open", "base")])

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

"""Two robots with one name on two links of a whole broker: held back, said aloud, let in by the operator."""

import asyncio
import json
import logging
import queue
import socket
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from ports import free_port

from psiu_broker.broker import Broker
from psiu_broker.bus.client import Client
from psiu_broker.cli.tool import psiu
from psiu_broker.config import load
from psiu_broker.errors import CallError
from psiu_broker.frame import Address
from psiu_broker.messages import CallRequest, Conflict
from psiu_broker.routing.quarantine import TURNS
from psiu_broker.simulator import AsciiRobot, PtyPort, UdpPort

CONFIGURATION = """
[broker]
name = "base"
[zenoh]
listen = ["tcp/127.0.0.1:{bus}"]
[links.radio]
adapter = "serial"
device = "{radio}"
protocol = "psiu-ascii"
[links.wifi]
adapter = "udp"
listen = "127.0.0.1:{wifi}"
protocol = "psiu-ascii"
"""
PATIENCE_S = 20.0


class Shy(AsciiRobot):
    """It speaks when the test says so."""

    def hello(self) -> bytes:
        return b""


class Twins:
    """MNERIM on a serial port, another MNERIM on UDP, and the broker between them."""

    def __init__(self, folder: Path) -> None:
        bus, wifi = free_port(), free_port(socket.SOCK_DGRAM)
        self.first = PtyPort(AsciiRobot("MNERIM", answer_s=0), link=folder / "radio")
        self.second = UdpPort(Shy("MNERIM", answer_s=0), peer=f"127.0.0.1:{wifi}")
        self.endpoint = f"tcp/127.0.0.1:{bus}"
        file = folder / "base.toml"
        file.write_text(CONFIGURATION.format(bus=bus, wifi=wifi, radio=folder / "radio"))
        self.broker = Broker(load(file))
        self.said = 0

    async def say(self, port: PtyPort | UdpPort) -> None:
        """One of them speaks, and is heard."""
        link = self.broker.exchange.links["radio" if port is self.first else "wifi"]
        before, self.said = link.frames_in, self.said + 1
        assert isinstance(port.robot, AsciiRobot)
        port.send(port.robot.say("base", "distancia", self.said))
        await self.until(lambda: link.frames_in > before)

    async def by_turns(self, *ports: PtyPort | UdpPort) -> None:
        for turn in range(2 * TURNS):
            await self.say(ports[turn % 2])

    async def until(self, true: Callable[[], object]) -> None:
        async with asyncio.timeout(PATIENCE_S):
            while not true():  # noqa: ASYNC110 - the broker's state is values, not events
                await asyncio.sleep(0.005)

    async def tool(self, *words: str) -> Any:
        """What `psiu` with these words says."""
        invoke = CliRunner().invoke
        result = await asyncio.to_thread(invoke, psiu, words, env={"PSIU_CONNECT": self.endpoint}, prog_name="psiu")
        assert result.exit_code == 0, result.output
        return json.loads(result.stdout) if "--json" in words else result.stdout


@pytest.fixture
async def twins(tmp_path: Path) -> AsyncIterator[Twins]:
    twins = Twins(tmp_path)
    async with twins.first:
        await twins.broker.start()
        try:
            await twins.until(lambda: twins.broker.card(Address.named("MNERIM")) is not None)
            async with twins.second:
                yield twins
            assert twins.broker.ledger().balances
        finally:
            await twins.broker.stop()


async def test_the_newcomer_is_held_back_and_the_first_goes_on(twins: Twins) -> None:
    await twins.by_turns(twins.first, twins.second)
    await twins.say(twins.second)
    assert twins.broker.exchange.accounts["wifi"].fates["quarantined"] == 2
    answer = await twins.broker.call(Address.named("MNERIM"), "parafrente", CallRequest(parameters=[100]))
    assert answer is not None
    assert answer.status == "sucesso"
    moved = [port.robot.position.x for port in (twins.first, twins.second) if isinstance(port.robot, AsciiRobot)]
    assert moved == [100, 0]


async def test_it_is_said_aloud_once(twins: Twins, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    puts: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    with (
        await asyncio.to_thread(Client, [twins.endpoint]) as client,
        client.listening(client.keys.every_broker("conflicts"), puts.put),
    ):
        await twins.by_turns(twins.first, twins.second)
        told = await asyncio.to_thread(puts.get, timeout=PATIENCE_S)
        for _ in range(3):
            await twins.say(twins.second)
        await twins.tool("conflicts", "--release", "MNERIM", "wifi")
        assert json.loads(await asyncio.to_thread(puts.get, timeout=PATIENCE_S)) == []
    (alarm,) = (Conflict.model_validate(each) for each in json.loads(told))
    assert (alarm.robot, alarm.brokers, alarm.link, alarm.held_back) == ("MNERIM", ["base"], "radio", ["wifi"])
    assert [record.getMessage() for record in caplog.records if "MNERIM" in record.getMessage()] == [
        "more than one is called MNERIM: radio has the name, wifi is held back: rename that one, or let it in: "
        "psiu conflicts --release MNERIM wifi"
    ]


async def test_the_operator_lets_it_in_and_the_first_is_the_newcomer_then(twins: Twins) -> None:
    await twins.by_turns(twins.first, twins.second)
    await twins.say(twins.second)
    (told,) = await twins.tool("conflicts", "--json")
    assert (told["robot"], told["link"], told["held_back"], told["frames"]) == ("MNERIM", "radio", ["wifi"], 1)
    row = (await twins.tool("conflicts")).split("\t")
    assert row[:5] == ["MNERIM", "base", "radio", "wifi", "1"]
    assert await twins.tool("conflicts", "--json", "--release", "MNERIM", "wifi") == []
    await twins.by_turns(twins.second, twins.first)
    (told,) = await twins.tool("conflicts", "--json")
    assert (told["link"], told["held_back"]) == ("wifi", ["radio"])


async def test_who_is_not_held_back_cannot_be_released(twins: Twins) -> None:
    with (
        await asyncio.to_thread(Client, [twins.endpoint]) as client,
        pytest.raises(CallError, match="no MNERIM is held back on wifi: psiu conflicts lists who is"),
    ):
        await asyncio.to_thread(client.ask, "release", "MNERIM", "wifi")


async def test_a_robot_that_moves_to_the_other_link_is_followed(twins: Twins) -> None:
    await twins.say(twins.first)
    for _ in range(2 * TURNS):
        await twins.say(twins.second)
    assert await twins.tool("conflicts", "--json") == []
    card = twins.broker.card(Address.named("MNERIM"))
    assert card is not None
    assert card.link == "wifi"


async def test_why_tells_of_it(twins: Twins) -> None:
    await twins.by_turns(twins.first, twins.second)
    assert "a robot on another link has that name: psiu conflicts" in await twins.tool("why", "MNERIM", "base")

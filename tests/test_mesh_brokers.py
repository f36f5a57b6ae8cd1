"""Several whole brokers in this process, joined by real Zenoh sessions, and robots that roam among them."""

import asyncio
import json
import socket
import time
from collections.abc import AsyncIterator, Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import zenoh
from ports import free_port

from psiu_broker.broker import Broker
from psiu_broker.bus.client import Client
from psiu_broker.codecs import psiu_ascii
from psiu_broker.codecs.codec import Directory
from psiu_broker.codecs.psiu_ascii import PsiuAscii
from psiu_broker.config import load
from psiu_broker.errors import CallError
from psiu_broker.frame import Address, Frame
from psiu_broker.messages import CallRequest
from psiu_broker.simulator import HexaRobot, PtyPort

CONFIGURATION = """
[broker]
name = "{name}"
[zenoh]
listen = ["tcp/127.0.0.1:{bus}"]
[mesh]
mode = "{mode}"
connect = {connect}
[links.wifi]
adapter = "udp"
listen = "127.0.0.1:{wifi}"
protocol = "psiu-ascii"
timeout_s = 0.5
"""
ARM = """
[links.arm]
adapter = "serial"
device = "{arm}"
baudrate = 115200
protocol = "psiu-hexa"
topology = "point-to-point"
timeout_s = 0.5
[robots.BRACO]
address = 0x12
link = "arm"
nodes.garra = {{ node = 4, type = "servo" }}
"""


async def until(true: Callable[[], object], timeout_s: float = 10.0) -> float:
    """The brokers' state is values, not events: look until it is so. How long it took, in seconds."""
    begun = time.monotonic()
    async with asyncio.timeout(timeout_s):
        while not true():  # noqa: ASYNC110
            await asyncio.sleep(0.005)
    return time.monotonic() - begun


class Rover(asyncio.DatagramProtocol):
    """A robot that speaks to whichever brokers are in `reach`, and answers every command with sucesso."""

    def __init__(self, name: str, *reach: int) -> None:
        self.name = name
        self.reach: Sequence[int] = reach
        self.heard: list[str] = []
        """The messages that came, with their senders' names behind them."""
        self._codec = PsiuAscii(PsiuAscii.Options(), Directory())
        self._transport: Any = None
        self._asked = False

    async def open(self) -> "Rover":
        loop = asyncio.get_running_loop()
        self._transport, _ = await loop.create_datagram_endpoint(lambda: self, local_addr=("127.0.0.1", 0))
        return self

    def close(self) -> None:
        self._transport.close()

    def says(self, destination: str, *words: str) -> None:
        self._asked = words == ("qualseunome",) and destination == "??"
        frame = psiu_ascii.message(Address.named(self.name), Address.named(destination), *words)
        for port in self.reach:
            self._transport.sendto(self._codec.encode(frame), ("127.0.0.1", port))

    def datagram_received(self, data: bytes, addr: Any) -> None:
        [frame] = self._codec.decode(data, 0.0)
        if addr[1] not in self.reach or not isinstance(frame, Frame):
            return  # out of reach
        words = frame.payload.decode()
        self.heard.append(f"{words} {frame.source}")
        if "sucesso" in words or "falha" in words:
            return
        if frame.subject != "qualseunome":
            self.says(str(frame.source), frame.subject, "sucesso")
        elif not self._asked:  # who asked takes the same words for an answer
            self.says(str(frame.source), "qualseunome")


class Net:
    """Brokers B1, B2, … of which each connects to all before it (or, as routers, to the one before it)."""

    def __init__(self, folder: Path, size: int, mode: str = "peer", extra: str = "") -> None:
        self.bus = [free_port() for _ in range(size)]
        self.wifi = [free_port(socket.SOCK_DGRAM) for _ in range(size)]
        self.rovers: list[Rover] = []
        self._files = []
        for at in range(size):
            others = range(at) if mode == "peer" else range(max(at - 1, 0), at)
            file = folder / f"B{at + 1}.toml"
            text = CONFIGURATION.format(
                name=f"B{at + 1}",
                bus=self.bus[at],
                wifi=self.wifi[at],
                mode=mode,
                connect=json.dumps([f"tcp/127.0.0.1:{self.bus[other]}" for other in others]),
            )
            file.write_text(text + (extra if at == size - 1 else ""))
            self._files.append(file)
        self.brokers = [Broker(load(file)) for file in self._files]

    async def __aenter__(self) -> "Net":
        for broker in self.brokers:
            await broker.start()
        await until(lambda: all(len(broker.mesh_seen().brokers) == len(self.brokers) - 1 for broker in self.brokers))
        await until(lambda: all(link.state == "open" for broker in self.brokers for link in broker.links()))
        return self

    async def __aexit__(self, *_: object) -> None:
        for rover in self.rovers:
            rover.close()
        for broker in self.brokers:
            await broker.stop()

    async def rover(self, name: str, *at: int) -> Rover:
        """A robot in reach of the brokers with these numbers, known to all."""
        rover = await Rover(name, *(self.wifi[number - 1] for number in at)).open()
        self.rovers.append(rover)
        rover.says(f"B{at[0]}", "quantoscomandos")
        await until(lambda: self.owners(name) == {f"B{at[0]}"})
        return rover

    def owners(self, robot: str) -> set[str]:
        """Who owns the robot, as the brokers see it: one name where they agree."""
        seen = [{each.robot: each.owner for each in broker.mesh_seen().robots} for broker in self.brokers]
        return {owners.get(robot, "nobody") for owners in seen}

    def balanced(self) -> bool:
        """The books of each broker, and between each two of them."""
        between = {
            (broker.configuration.broker.name, other.name): other
            for broker in self.brokers
            for other in broker.mesh_seen().brokers
        }
        crossed = all(
            seen.frames_out == between[there, here].frames_in + between[there, here].lost
            for (here, there), seen in between.items()
        )
        return crossed and all(broker.ledger().balances for broker in self.brokers)

    async def call(self, at: int, robot: str, command: str, *parameters: int) -> Any:
        """A program at broker `at` calls a robot."""
        request = CallRequest(parameters=list(parameters), timeout_s=3.0)

        def call() -> Any:
            with Client([f"tcp/127.0.0.1:{self.bus[at - 1]}"]) as client:
                return client.call(robot, command, request)

        return await asyncio.to_thread(call)


@pytest.fixture
async def net(tmp_path: Path) -> AsyncIterator[Net]:
    async with Net(tmp_path, 3) as net:
        yield net
        await until(net.balanced)


class Program:
    """A Zenoh client at one broker that notes what is put and deleted under a key."""

    def __init__(self, bus: int, key: str) -> None:
        config = {"mode": "client", "connect": {"endpoints": [f"tcp/127.0.0.1:{bus}"]}}
        self._session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
        self.puts: list[str] = []
        self.deletes: list[str] = []
        self._subscriber = self._session.declare_subscriber(key, self._note)

    def _note(self, sample: zenoh.Sample) -> None:
        (self.puts if sample.kind == zenoh.SampleKind.PUT else self.deletes).append(str(sample.key_expr))

    def close(self) -> None:
        self._session.close()


@pytest.fixture
async def program(net: Net) -> AsyncIterator[Callable[[int, str], Program]]:
    opened: list[Program] = []

    def make(at: int, key: str) -> Program:
        opened.append(Program(net.bus[at - 1], key))
        return opened[-1]

    yield make
    for each in opened:
        await asyncio.to_thread(each.close)


async def test_a_robot_commands_another_at_another_broker_and_hears_its_answer(net: Net) -> None:
    mnerim, beta = await net.rover("MNERIM", 1), await net.rover("BETA", 3)
    mnerim.says("BETA", "parafrente", "100")
    await until(lambda: "parafrente sucesso BETA" in mnerim.heard)
    assert beta.heard.count("parafrente 100 MNERIM") == 1


async def test_a_program_calls_a_robot_whichever_broker_it_is_connected_to(net: Net) -> None:
    beta = await net.rover("BETA", 3)
    for at in (1, 2, 3):
        answer = await net.call(at, "BETA", "parafrente", at)
        assert answer.status == "sucesso"
        assert beta.heard.count(f"parafrente {at} B3") == 1


async def test_a_robot_that_nobody_knows_is_said_to_be_unknown(net: Net) -> None:
    with pytest.raises(CallError) as raised:
        await net.call(1, "NINGUEM", "parafrente", 1)
    assert raised.value.code == "unknown_robot"


async def test_a_question_to_everyone_reaches_each_robot_once_and_all_answers_come_back(net: Net) -> None:
    mnerim = await net.rover("MNERIM", 1)
    others = [await net.rover(name, at) for name, at in (("BETA", 2), ("GAMA", 3))]
    mnerim.heard.clear()
    mnerim.says("??", "qualseunome")
    names = {"B1", "B2", "B3", "BETA", "GAMA"}
    await until(lambda: {words.split()[-1] for words in mnerim.heard} >= names)
    await asyncio.sleep(0.3)  # nothing more comes
    assert all(robot.heard.count("qualseunome MNERIM") == 1 for robot in others)
    assert sorted(mnerim.heard) == sorted(f"qualseunome {name}" for name in names)


async def test_a_robot_finds_another_broker_by_its_name(net: Net) -> None:
    mnerim = await net.rover("MNERIM", 1)
    mnerim.says("B3", "quantoscomandos")
    await until(lambda: any(words.startswith("quantoscomandos") and words.endswith("B3") for words in mnerim.heard))


async def test_a_robot_that_drives_to_another_broker_is_owned_there_within_a_second(
    net: Net, program: Callable[[int, str], Program]
) -> None:
    mnerim, beta = await net.rover("MNERIM", 1), await net.rover("BETA", 3)
    cards = await asyncio.to_thread(program, 2, "psiu/MNERIM")
    mnerim.reach = [net.wifi[1]]
    mnerim.says("BETA", "parafrente", "7")  # the first frame at the new broker, and the only one
    assert await until(lambda: net.owners("MNERIM") == {"B2"}) < 1.0
    assert beta.heard.count("parafrente 7 MNERIM") == 1
    beta.says("MNERIM", "paratras", "8")
    await until(lambda: "paratras sucesso MNERIM" in beta.heard)
    answer = await net.call(1, "MNERIM", "parafrente", 9)
    assert answer.status == "sucesso"
    await until(lambda: cards.puts)
    assert not cards.deletes
    assert [str(each.robot) for broker in net.brokers for each in broker.cards().values()].count("MNERIM") == 1


async def test_a_robot_on_one_radio_with_two_brokers_has_one_owner_and_is_told_and_commanded_once(
    net: Net, program: Callable[[int, str], Program]
) -> None:
    mnerim, beta = await net.rover("MNERIM", 1), await net.rover("BETA", 3)
    mnerim.reach = [net.wifi[0], net.wifi[1]]
    listener = await asyncio.to_thread(program, 3, "psiu/MNERIM/**")
    await until(lambda: all(broker.exchange.bus.listened for broker in net.brokers))
    for number in range(30):
        mnerim.says("BETA", "parafrente", str(number))
        await asyncio.sleep(0.03)
        assert net.owners("MNERIM") == {"B1"}
    await until(lambda: beta.heard.count("parafrente 29 MNERIM") == 1)
    assert [beta.heard.count(f"parafrente {number} MNERIM") for number in range(30)] == [1] * 30
    await until(lambda: listener.puts.count("psiu/MNERIM/BETA/parafrente") >= 30)
    assert (await net.call(2, "MNERIM", "parafrente", 500)).status == "sucesso"
    assert sum(words.startswith("parafrente 500") for words in mnerim.heard) == 1
    assert listener.puts.count("psiu/MNERIM/BETA/parafrente") == 30
    assert not net.brokers[0].mesh_seen().conflicts


async def test_a_robot_that_two_brokers_find_at_once_is_commanded_by_one_of_them(net: Net) -> None:
    mnerim, beta = await net.rover("MNERIM", 1), await net.rover("BETA", 2)
    for name in ("GAMA", "DELTA"):
        robot = await Rover(name, net.wifi[0], net.wifi[1]).open()
        net.rovers.append(robot)
        mnerim.heard.clear()
        beta.heard.clear()
        called = asyncio.create_task(net.call(3, name, "parafrente", 7))
        await until(lambda: "qualseunome B1" in mnerim.heard and "qualseunome B2" in beta.heard)
        robot.says("B1", "vivo")
        assert (await called).status == "sucesso"
        commands = [words for words in robot.heard if words.startswith("parafrente")]
        assert commands in (["parafrente 7 B1"], ["parafrente 7 B2"])


async def test_two_robots_of_one_name_are_shown_as_a_conflict(net: Net) -> None:
    first = await net.rover("MNERIM", 1)
    second = await Rover("MNERIM", net.wifi[1]).open()
    net.rovers.append(second)

    def shown() -> list[str]:
        return [each.robot for broker in net.brokers for each in broker.mesh_seen().conflicts]

    async with asyncio.timeout(10):
        while not shown():
            first.says("B1", "quantoscomandos")
            second.says("B2", "quantoscomandos")
            await asyncio.sleep(0.05)
    assert shown() == ["MNERIM"]
    [conflict] = [each for broker in net.brokers for each in broker.mesh_seen().conflicts]
    assert conflict.brokers == ["B1", "B2"]


async def test_the_robots_of_a_broker_that_leaves_vanish_at_once(
    net: Net, program: Callable[[int, str], Program]
) -> None:
    await net.rover("MNERIM", 1)
    cards = await asyncio.to_thread(program, 3, "psiu/MNERIM")
    await net.brokers.pop(0).stop()
    assert await until(lambda: net.owners("MNERIM") == {"nobody"}) < 1.0
    assert all(not [route for route in broker.routes() if route.robot == "MNERIM"] for broker in net.brokers)
    await until(lambda: cards.deletes)


async def test_the_robots_of_a_broker_that_dies_without_a_word_are_withdrawn_by_one_that_is_left(
    net: Net, program: Callable[[int, str], Program]
) -> None:
    await net.rover("MNERIM", 1)
    cards = await asyncio.to_thread(program, 3, "psiu/MNERIM")
    dead = net.brokers.pop(0)
    bus = dead._bus
    assert bus is not None
    bus.publisher.forget_card(Address.named("MNERIM"))  # as if it had been killed: it says nothing
    await dead.stop()
    await until(lambda: cards.deletes)
    assert len(cards.deletes) == 1


async def test_a_robot_heard_elsewhere_is_taken_over_when_its_broker_leaves(net: Net) -> None:
    mnerim = await net.rover("MNERIM", 1)
    mnerim.reach = [net.wifi[0], net.wifi[1]]
    mnerim.says("B3", "quantoscomandos")
    await until(lambda: any(words.endswith("B3") for words in mnerim.heard))
    await net.brokers.pop(0).stop()
    assert await until(lambda: net.owners("MNERIM") == {"B2"}) < 1.0


async def test_every_broker_knows_how_far_the_others_are_and_whether_a_link_leads_there(net: Net) -> None:
    def known() -> bool:
        seen = [other for broker in net.brokers for other in broker.mesh_seen().brokers]
        return all(other.rtt_ms is not None and other.linked for other in seen)

    await until(known)


async def test_words_for_a_robot_of_bytes_at_another_broker_are_translated_there(tmp_path: Path) -> None:
    port = PtyPort(HexaRobot(0x12, topology="point-to-point", actuators=(4,)), link=tmp_path / "arm")
    await port.open()
    async with Net(tmp_path, 2, extra=ARM.format(arm=port.path)) as net:
        mnerim = await net.rover("MNERIM", 1)
        await until(lambda: net.owners("BRACO") == {"B2"})
        mnerim.says("BRACO", "garra", "45")
        await until(lambda: "garra sucesso BRACO" in mnerim.heard)
        assert (await net.call(1, "BRACO", "garra", 90)).status == "sucesso"
    await port.close()


async def test_routers_in_a_line_relay_between_brokers_that_have_no_link(tmp_path: Path) -> None:
    async with Net(tmp_path, 3, mode="router") as net:
        mnerim, beta = await net.rover("MNERIM", 1), await net.rover("BETA", 3)
        mnerim.says("BETA", "parafrente", "100")
        await until(lambda: "parafrente sucesso BETA" in mnerim.heard)
        assert beta.heard.count("parafrente 100 MNERIM") == 1
        assert (await net.call(3, "MNERIM", "parafrente", 5)).status == "sucesso"
        first = {each.name: each for each in net.brokers[0].mesh_seen().brokers}
        await until(lambda: {e.name: e.linked for e in net.brokers[0].mesh_seen().brokers} == {"B2": True, "B3": False})
        assert set(first) == {"B2", "B3"}
        await until(net.balanced)

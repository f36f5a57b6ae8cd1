"""Relaying where there is no IP: three whole brokers in a ring of ptys, a robot behind A and one behind C."""

import asyncio
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Final

import pytest
from cable import Cable
from ports import free_port
from test_broker import until

from psiu_broker.broker import Broker
from psiu_broker.config import load
from psiu_broker.frame import Address
from psiu_broker.messages import CallRequest
from psiu_broker.simulator import AsciiRobot, HexaRobot, PtyPort
from psiu_broker.simulator.robot import Robot

BROKERS: Final = {"A": ("ab", "ca"), "B": ("ab", "bc"), "C": ("bc", "ca")}
MAX_AGE_S: Final = 0.2
ROUTE_AGE_S: Final = 2.4
"""Longer than doubles are remembered, which is 2 s more than `MAX_AGE_S`, as by the defaults."""
QUIET_S: Final = 0.3

HEAD: Final = """
[broker]
name = "{broker}"
address = {number}
[zenoh]
listen = ["tcp/127.0.0.1:{bus}"]
"""
LINK: Final = """
[links.{name}]
adapter = "serial"
device = "{device}"
baudrate = 115200
protocol = "{protocol}"
route_age_s = {route_age_s}
max_age_s = {max_age_s}
question_max_age_s = {max_age_s}
"""


class Ring:
    """Brokers A, B and C with a cable between each two."""

    def __init__(
        self, folder: Path, near: Robot, far: Robot, route_age_s: float = 300.0, max_age_s: float = 2.0
    ) -> None:
        self.near, self.far = near, far
        self.cables = {name: Cable(folder, name) for name in ("ab", "bc", "ca")}
        self.ports = {"A": PtyPort(near, link=folder / "near"), "C": PtyPort(far, link=folder / "far")}
        self.brokers: dict[str, Broker] = {}
        for number, (broker, names) in enumerate(BROKERS.items()):
            devices = {name: self.cables[name].ends[name.index(broker.lower())] for name in names}
            devices |= {"robot": Path(self.ports[broker].path)} if broker in self.ports else {}
            tables = [
                LINK.format(
                    name=name, device=device, protocol=near.protocol, route_age_s=route_age_s, max_age_s=max_age_s
                )
                for name, device in devices.items()
            ]
            head = (
                f'[broker]\nname = "{broker}"\naddress = {number}\n[zenoh]\nlisten = ["tcp/127.0.0.1:{free_port()}"]\n'
            )
            file = folder / f"{broker}.toml"
            file.write_text(head + "".join(tables))
            self.brokers[broker] = Broker(load(file))

    async def __aenter__(self) -> "Ring":
        for cable in self.cables.values():
            cable.plug()
        for port in self.ports.values():
            await port.open()
        for broker in self.brokers.values():
            await broker.start()
        await self.joined()
        return self

    async def __aexit__(self, *_: object) -> None:
        for broker in self.brokers.values():
            await broker.stop()
        for port in self.ports.values():
            await port.close()
        for cable in self.cables.values():
            cable.cut()

    async def joined(self) -> None:
        """Every link is open and nothing is on its way."""
        await until(lambda: all(link.state == "open" for broker in self.brokers.values() for link in broker.links()))
        await self.quiet()

    async def quiet(self) -> None:
        """Return when nothing has gone over any cable for a while; what circulates never lets it."""
        async with asyncio.timeout(5):
            before = -1
            while before != (carried := sum(len(cable.carried) for cable in self.cables.values())):
                before = carried
                await asyncio.sleep(QUIET_S)

    def says(self, data: bytes) -> None:
        """The robot behind C puts `data` on its line."""
        self.ports["C"].send(data)

    async def heard_by_near(self, true: Callable[[], object]) -> None:
        await self.ports["A"].until(lambda: bool(true()))

    async def heard_by_far(self, true: Callable[[], object]) -> None:
        await self.ports["C"].until(lambda: bool(true()))

    def way(self, broker: str, robot: Address) -> str | None:
        """The link that leads from `broker` to `robot`."""
        route = self.brokers[broker].exchange.router.find(robot)
        return None if route is None else route.way.link


class Words:
    """MNERIM behind A, PC behind C."""

    def __init__(self) -> None:
        self.near, self.far = AsciiRobot("MNERIM"), AsciiRobot("PC")
        self.address = Address.named("MNERIM")

    def order(self, number: int) -> bytes:
        return self.far.command("MNERIM", "parafrente", number)

    def obeyed(self) -> list[int]:
        return [int(heard.parameters[0]) for heard in self.near.heard if heard.subject == "parafrente"]

    def answers(self) -> int:
        return sum(heard.parameters == ("sucesso",) for heard in self.far.heard)


class Bytes:
    """0x12 behind A, 0x05 behind C."""

    def __init__(self) -> None:
        self.near, self.far = HexaRobot(0x12), HexaRobot(0x05)
        self.address = Address.numbered(0x12)

    def order(self, number: int) -> bytes:
        return self.far.node(0x12, 4, number)

    def obeyed(self) -> list[int]:
        return [int(heard.parameters[0]) for heard in self.near.heard if heard.subject == "node/4"]

    def answers(self) -> int:
        return sum(heard.subject == "ack" for heard in self.far.heard)


Robots = Words | Bytes


@pytest.fixture(params=[Words, Bytes], ids=["ascii", "hexa"])
def robots(request: pytest.FixtureRequest) -> Robots:
    made: Robots = request.param()
    return made


@pytest.fixture
async def ring(robots: Robots, tmp_path: Path) -> AsyncIterator[Ring]:
    async with Ring(tmp_path, robots.near, robots.far) as ring:
        yield ring
        await ring.quiet()
        assert all(broker.ledger().balances for broker in ring.brokers.values())


async def obeyed(ring: Ring, robots: Robots, number: int) -> None:
    """The far robot's order `number` arrives, and its answer comes back."""
    answers = robots.answers()
    ring.says(robots.order(number))
    await ring.heard_by_near(lambda: number in robots.obeyed())
    await ring.heard_by_far(lambda: robots.answers() > answers)


async def test_an_order_crosses_the_ring_once_and_so_does_its_answer(ring: Ring, robots: Robots) -> None:
    for number in range(1, 6):
        await obeyed(ring, robots, number)
    await ring.quiet()
    assert robots.obeyed() == [1, 2, 3, 4, 5]
    assert robots.answers() == 5


async def test_who_presses_again_after_200_ms_is_obeyed_again(ring: Ring, robots: Robots) -> None:
    await obeyed(ring, robots, 1)
    for _ in range(3):
        await asyncio.sleep(0.2)
        ring.says(robots.order(1))
    await ring.heard_by_near(lambda: len(robots.obeyed()) >= 4)
    await ring.quiet()
    assert robots.obeyed() == [1] * 4


async def test_when_a_cable_is_pulled_frames_go_the_other_way_round_and_when_it_is_back_they_still_go(
    ring: Ring, robots: Robots
) -> None:
    await obeyed(ring, robots, 1)
    await ring.quiet()
    used = ring.way("C", robots.address)
    assert used is not None
    ring.cables[used].cut()
    await until(lambda: ring.way("C", robots.address) != used)
    await obeyed(ring, robots, 2)
    assert ring.way("C", robots.address) not in (None, used)
    await obeyed(ring, robots, 3)
    ring.cables[used].plug()
    await ring.joined()
    await obeyed(ring, robots, 4)
    await ring.quiet()
    assert robots.obeyed() == [1, 2, 3, 4]


async def test_a_radio_that_went_deaf_is_gone_round_once_its_routes_have_aged(robots: Robots, tmp_path: Path) -> None:
    async with Ring(tmp_path, robots.near, robots.far, ROUTE_AGE_S, MAX_AGE_S) as ring:
        await obeyed(ring, robots, 1)
        used = ring.way("C", robots.address)
        assert used is not None
        ring.cables[used].deaf = True
        ring.says(robots.order(2))
        await until(lambda: ring.way("C", robots.address) is None)
        await obeyed(ring, robots, 3)
        assert ring.way("C", robots.address) not in (None, used)
        ring.cables[used].deaf = False
        await obeyed(ring, robots, 4)
        await ring.quiet()
        assert robots.obeyed() == [1, 3, 4]


@pytest.mark.parametrize("robots", [Words], indirect=True)
async def test_a_question_to_everyone_passes_each_cable_once_and_everyone_answers_once(
    ring: Ring, robots: Words
) -> None:
    robots.far.heard.clear()
    question = robots.far.command("??", "qualseunome")
    before = {name: cable.count(question) for name, cable in ring.cables.items()}
    ring.says(question)
    await ring.quiet()
    names = sorted(heard.source for heard in robots.far.heard if heard.subject == "qualseunome")
    assert names == ["A", "B", "C", "MNERIM"]
    assert sum(heard.source == "PC" for heard in robots.near.heard) == 1
    passed = {name: cable.count(question) - before[name] for name, cable in ring.cables.items()}
    # Between A and B it may cross itself: each has it from C, and tells the other.
    assert (passed["bc"], passed["ca"]) == (1, 1)
    assert 1 <= passed["ab"] <= 2


@pytest.mark.parametrize("robots", [Words], indirect=True)
async def test_a_robot_that_is_nowhere_is_looked_for_once_and_the_question_ends(ring: Ring, robots: Words) -> None:
    carried = sum(len(cable.carried) for cable in ring.cables.values())
    ring.says(robots.far.command("NINGUEM", "parafrente", 1))
    await until(lambda: ring.brokers["C"].exchange.accounts["robot"].fates["no_route"] == 1)
    await ring.quiet()
    assert sum(len(cable.carried) for cable in ring.cables.values()) - carried <= 6


@pytest.mark.parametrize("robots", [Words], indirect=True)
async def test_a_program_at_c_calls_the_robot_behind_a_and_the_other_brokers(ring: Ring, robots: Words) -> None:
    broker = ring.brokers["C"]
    moved = await broker.call(robots.address, "parafrente", CallRequest(parameters=[10], timeout_s=5))
    assert moved.status == "sucesso"
    for other in ("A", "B"):
        told = await broker.call(Address.named(other), "quantoscomandos", CallRequest(timeout_s=5))
        assert told.values == [3]

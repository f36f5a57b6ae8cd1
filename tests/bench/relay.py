"""What relaying over slow radios costs: python -m tests.bench.relay

What brokers add to the robots' own bytes is counted in simulated time, with the real exchange, links, routes and
codecs; the delay of a hop is measured in real time, with whole brokers on paced ptys.
"""

import asyncio
import os
import selectors
import socket
import tempfile
import tty
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import AsyncExitStack, contextmanager
from pathlib import Path
from statistics import median
from typing import Any, Final

from psiu_broker.adapter import Adapter, Peer, Receiver, Transport
from psiu_broker.broker import Broker
from psiu_broker.codecs import psiu_ascii
from psiu_broker.codecs.codec import Directory
from psiu_broker.codecs.identity import identity
from psiu_broker.codecs.psiu_ascii import PsiuAscii
from psiu_broker.config import Configuration, LinkConfiguration, LinkOptions, load
from psiu_broker.config.tables import BrokerConfiguration, ZenohConfiguration
from psiu_broker.errors import LinkLost
from psiu_broker.exchange import Exchange
from psiu_broker.frame import Address, Frame
from psiu_broker.link import Link
from psiu_broker.resident import Resident
from psiu_broker.routing.router import Router
from psiu_broker.routing.table import Route
from psiu_broker.simulator import AsciiRobot
from tests.cable import Cable

BAUD: Final = 9600
BYTE_S: Final = 10 / BAUD
MINUTES: Final = 10
TICK_S: Final = 0.1
ORDERS: Final = 25
RING: Final = {"A": ("ab", "ca", "mnerim"), "B": ("ab", "bc"), "C": ("bc", "ca", "pc")}


# Simulated time.


class QuickLoop(asyncio.SelectorEventLoop):
    """Never waits: where nothing is to be done before a timer, it is that timer's time at once."""

    def __init__(self) -> None:
        super().__init__(selectors.DefaultSelector())
        self._now = 1000.0
        select = self._selector.select  # type: ignore[attr-defined]

        def jump(timeout: float | None) -> Any:
            events = select(0)
            if not events and timeout:
                self._now += timeout
            return events

        self._selector.select = jump  # type: ignore[attr-defined]

    def time(self) -> float:
        return self._now


class Line(Adapter):
    @property
    def bits_per_second(self) -> int:
        return BAUD

    async def open(self, receiver: Receiver) -> Transport:
        raise NotImplementedError


class Wire(Transport):
    """One direction of a line: what is written arrives when its last bit would."""

    def __init__(self, loop: QuickLoop, arrives: Callable[[bytes], None], writable: Callable[[], None]) -> None:
        self._loop = loop
        self._arrives = arrives
        self._writable = writable
        self._begins = self._free = 0.0
        self.cut = False

    def write(self, data: bytes, peer: Peer) -> bool:
        now = self._loop.time()
        if self._begins > now:
            self._loop.call_at(self._begins, self._writable)
            return False
        self._begins = max(now, self._free)
        self._free = self._begins + len(data) * BYTE_S
        self._loop.call_at(self._free, self._deliver, data)
        return True

    def _deliver(self, data: bytes) -> None:
        if not self.cut:
            self._arrives(data)

    @property
    def peers(self) -> Collection[Peer]:
        return (None,)

    async def close(self) -> None: ...


class Ring:
    """Three brokers, a line between each two, MNERIM on a line of A and PC on one of C; counts all that is sent."""

    def __init__(self, loop: QuickLoop) -> None:
        self.loop = loop
        self.bytes: Counter[tuple[str, str]] = Counter()
        """By direction of a line (``ab from A``) and kind."""
        self.exchanges: dict[str, Exchange] = {}
        self.robots = {"mnerim": AsciiRobot("MNERIM"), "pc": AsciiRobot("PC")}
        self._codec = PsiuAscii(PsiuAscii.Options(), Directory())
        self._wires: dict[tuple[str, str], Wire] = {}
        for broker, names in RING.items():
            links = {
                name: LinkConfiguration(
                    name, "line", Line(), "psiu-ascii", PsiuAscii.Options(), LinkOptions.model_validate({})
                )
                for name in names
            }
            own = Address.named(broker)
            router = Router({own: "psiu-ascii"}, (), identity, self._releaser(broker))
            exchange = self.exchanges[broker] = Exchange(own, router)
            exchange.resident = Resident(
                Configuration(BrokerConfiguration(name=broker), ZenohConfiguration(), links, {}), exchange, loop.time
            )
            for link in links.values():
                made = Link(link, lambda: PsiuAscii(PsiuAscii.Options(), Directory()), exchange, clock=loop.time)
                exchange.add(made)
        for broker, names in RING.items():
            for name in names:
                self.join(broker, name)
        for name, robot in self.robots.items():
            self._wires[name, ""] = Wire(loop, self._to_broker(name, "A" if name == "mnerim" else "C"), lambda: None)
            self.say(robot.hello(), name)
        loop.call_later(TICK_S, self._tick)

    def join(self, broker: str, name: str) -> None:
        """Open the broker's end of a line."""
        link = self.exchanges[broker].links[name]
        others = [other for other, names in RING.items() if name in names and other != broker]
        arrives = self._to_broker(name, others[0]) if others else self._to_robot(name)
        wire = self._wires[name, broker] = Wire(self.loop, self._counted(name, broker, arrives), link.writable)
        link.connected(wire)

    def cut(self, name: str) -> None:
        for broker, names in RING.items():
            if name in names:
                self._wires[name, broker].cut = True
                self.exchanges[broker].links[name].lost(LinkLost("cut"))

    def say(self, data: bytes, name: str) -> None:
        """The robot on the line `name` speaks."""
        self.bytes[f"{name} from the robot", self._kind(data, "")] += len(data)
        self._wires[name, ""].write(data, None)

    @property
    def doubles(self) -> int:
        return sum(a.fates["duplicate"] for exchange in self.exchanges.values() for a in exchange.accounts.values())

    @property
    def unasked(self) -> int:
        return sum(each.refused for exchange in self.exchanges.values() for each in exchange.allowances.values())

    def _tick(self) -> None:
        for exchange in self.exchanges.values():
            exchange.expire(self.loop.time())
        self.loop.call_later(TICK_S, self._tick)

    def _releaser(self, broker: str) -> Callable[[Route], None]:
        return lambda route: self.exchanges[broker].release(route.robot, self.loop.time())

    def _to_broker(self, name: str, broker: str) -> Callable[[bytes], None]:
        return lambda data: self.exchanges[broker].links[name].received(data, None)

    def _to_robot(self, name: str) -> Callable[[bytes], None]:
        def hear(data: bytes) -> None:
            for delay_s, reply in self.robots[name].receive(data, self.loop.time()):
                self.loop.call_later(delay_s, self.say, reply, name)

        return hear

    def _counted(self, name: str, broker: str, arrives: Callable[[bytes], None]) -> Callable[[bytes], None]:
        def count(data: bytes) -> None:
            self.bytes[f"{name} from {broker}", self._kind(data, broker)] += len(data)
            arrives(data)

        return count

    def _kind(self, data: bytes, sender: str) -> str:
        [frame] = self._codec.decode(data, 0.0)
        assert isinstance(frame, Frame)
        source, destination = str(frame.source), str(frame.destination)
        if frame.subject != "qualseunome":
            return "robots"
        if destination in RING:
            return "answers"
        return "own" if source == sender else "passed on" if source in RING else "robots"


async def presence(ring: Ring) -> None:
    """MNERIM tells its place every 2 s, PC orders it about every 5 s."""
    mnerim, pc = ring.robots["mnerim"], ring.robots["pc"]
    assert isinstance(mnerim, AsciiRobot)
    assert isinstance(pc, AsciiRobot)
    for second in range(MINUTES * 60):
        if second % 2 == 0:
            ring.say(mnerim.say("PC", "posicao", second, 20, 90), "mnerim")
        if second % 5 == 0:
            ring.say(pc.command("MNERIM", "parafrente", 10), "pc")
        await asyncio.sleep(1)


async def absence(ring: Ring) -> None:
    """As before, and PC sends orders to robots that are not there, 5 a second."""
    pc = ring.robots["pc"]
    assert isinstance(pc, AsciiRobot)
    others = asyncio.ensure_future(presence(ring))
    for fifth in range(MINUTES * 300):
        ring.say(pc.command(f"NINGUEM{fifth % 10}", "parafrente", 1), "pc")
        await asyncio.sleep(0.2)
    await others


async def flapping(ring: Ring) -> None:
    """As at first, and a line between brokers breaks every 5 s for a moment."""
    others = asyncio.ensure_future(presence(ring))
    for number in range(MINUTES * 12):
        await asyncio.sleep(4)
        name = ("ab", "bc", "ca")[number % 3]
        ring.cut(name)
        await asyncio.sleep(1)
        for broker, names in RING.items():
            if name in names:
                ring.join(broker, name)
    await others


def overhead(what: Callable[[Ring], Any]) -> tuple[Ring, str]:
    """Run `what` and return the ring, and the direction in which the questions of the broker there were most."""
    loop = QuickLoop()
    asyncio.set_event_loop(loop)
    try:

        async def run() -> Ring:
            ring = Ring(loop)
            await what(ring)
            return ring

        ring = loop.run_until_complete(run())
        for task in asyncio.all_tasks(loop):
            task.cancel()
    finally:
        asyncio.set_event_loop(None)
        loop.close()
    return ring, max({direction for direction, _ in ring.bytes}, key=lambda direction: ring.bytes[direction, "own"])


# Real time.


class TimedCable(Cable):
    """Bytes take their time; `spent_s` is what the last ones took, which is more where a timer was late."""

    def __init__(self, folder: Path, name: str) -> None:
        super().__init__(folder, name)
        self.spent_s = 0.0
        self._free = [0.0, 0.0]

    def _put(self, side: int, data: bytes) -> None:
        loop = asyncio.get_running_loop()
        now = loop.time()
        self._free[side] = max(now, self._free[side]) + len(data) * BYTE_S
        loop.call_at(self._free[side], self._arrive, side, data, now)

    def _arrive(self, side: int, data: bytes, begun: float) -> None:
        self.spent_s = asyncio.get_running_loop().time() - begun
        super()._put(side, data)


@contextmanager
def opened(end: Path) -> Iterator[int]:
    descriptor = os.open(end, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        tty.setraw(descriptor)
        yield descriptor
    finally:
        os.close(descriptor)


async def crossing_s(near: int, far: int, data: bytes) -> float:
    """How long `data` needs from one open end to the other, to its last byte."""
    loop = asyncio.get_running_loop()
    whole: asyncio.Future[float] = loop.create_future()
    heard = b""

    def read() -> None:
        nonlocal heard
        heard += os.read(far, 4096)
        if data in heard and not whole.done():
            whole.set_result(loop.time())

    loop.add_reader(far, read)
    try:
        begun = loop.time()
        os.write(near, data)
        async with asyncio.timeout(5):
            return await whole - begun
    finally:
        loop.remove_reader(far)


def order(number: int) -> bytes:
    codec = PsiuAscii(PsiuAscii.Options(), Directory())
    return codec.encode(psiu_ascii.message(Address.named("PC"), Address.named("MNERIM"), "parafrente", str(number)))


CHAIN: Final = {"C": ("pc", "bc"), "B": ("bc", "ab"), "A": ("ab", "mnerim")}


async def delays_s(folder: Path) -> list[float]:
    """What each of three brokers in a row adds to the time that an order is on the wire; sorted."""
    async with AsyncExitStack() as stack:
        cables = {name: TimedCable(folder, name) for name in ("pc", "bc", "ab", "mnerim")}
        for cable in cables.values():
            cable.plug()
            stack.callback(cable.cut)
        for broker, names in CHAIN.items():
            file = folder / f"{broker}.toml"
            with socket.socket() as probe:
                probe.bind(("127.0.0.1", 0))
                bus = probe.getsockname()[1]
            text = f'[broker]\nname = "{broker}"\n[zenoh]\nlisten = ["tcp/127.0.0.1:{bus}"]\n'
            for name, end in zip(names, (1, 0), strict=True):
                text += f'[links.{name}]\nadapter = "serial"\ndevice = "{cables[name].ends[end]}"\n'
                text += f'baudrate = {BAUD}\nprotocol = "psiu-ascii"\ngreet = false\n'
            file.write_text(text)
            made = Broker(load(file))
            await made.start()
            stack.push_async_callback(made.stop)
            async with asyncio.timeout(5):
                while not all(link.state == "open" for link in made.links()):  # noqa: ASYNC110
                    await asyncio.sleep(0.01)
        pc, mnerim = (stack.enter_context(opened(cables[name].ends[end])) for name, end in (("pc", 0), ("mnerim", 1)))
        hello = PsiuAscii(PsiuAscii.Options(), Directory()).encode(
            psiu_ascii.message(Address.named("MNERIM"), Address.named("??"), "qualseunome")
        )
        await crossing_s(mnerim, pc, hello)
        await asyncio.sleep(1)  # the brokers' answers are on the lines
        added_s = []
        for number in range(ORDERS):
            through_s = await crossing_s(pc, mnerim, order(100 + number))
            added_s.append((through_s - sum(cable.spent_s for cable in cables.values())) / len(CHAIN))
    return sorted(added_s)


HEADS: Final = ("in the line", "robots'", "own", "passed on", "answers", "doubles", "unasked")
ABOUT: Final = f"""\
Brokers A, B and C in a simulated ring of {BAUD}-baud lines, MNERIM on a line of A, PC on one of C; {MINUTES} minutes.
Shown is the direction of a line with most questions of the broker's own, in % of the bit rate. Passed on: questions
of other brokers; answers: names said to brokers. Of the whole ring: frames dropped as doubles, and questions that
brokers left unasked, to stay within their allowance.
"""


def main() -> None:
    bits = BAUD * 60 * MINUTES
    print(ABOUT)
    print("{:38} {:14}{:>8}{:>8}{:>11}{:>9}{:>9}{:>9}".format("", *HEADS))
    for name, what in (
        ("all there, all well", presence),
        ("5 orders/s to 10 robots that are not", absence),
        ("a line between two breaks every 5 s", flapping),
    ):
        ring, line = overhead(what)
        shares = [1000 * ring.bytes[line, kind] / bits for kind in ("robots", "own", "passed on", "answers")]
        percents = "{:7.2f}%{:7.2f}%{:10.2f}%{:8.2f}%".format(*shares)
        print(f"{name:38} {line:14}{percents}{ring.doubles:9}{ring.unasked:9}")
    with tempfile.TemporaryDirectory() as folder:
        added_s = asyncio.run(delays_s(Path(folder)))
    size = len(order(100))
    print(f"\nAn order of {size} bytes is on such a line for {1000 * size * BYTE_S:.1f} ms, and goes on once whole.")
    print(f"Three brokers in a row, real time on ptys: each adds {1000 * median(added_s):.2f} ms,", end=" ")
    print(f"{1000 * added_s[-1]:.2f} ms at most, of {ORDERS} orders.")


if __name__ == "__main__":
    main()

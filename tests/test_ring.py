"""Three brokers in a ring of radios, and a robot behind one of them: real exchanges, and time told by the test."""

import heapq
from itertools import count

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from memory_adapter import MemoryAdapter, MemoryTransport, codec_of, configuration

from psiu_broker.adapter import Peer
from psiu_broker.codecs import psiu_ascii
from psiu_broker.codecs.identity import identity
from psiu_broker.errors import LinkLost
from psiu_broker.exchange import Exchange
from psiu_broker.frame import Address, Frame, Malformed, Way
from psiu_broker.link import Link
from psiu_broker.profiles import Responder
from psiu_broker.routing.duplicates import Duplicates
from psiu_broker.routing.router import Router
from psiu_broker.routing.verdicts import REFUSED, Verdict


class Wire(MemoryTransport):
    """Carries what is written to the other end after a delay."""

    def __init__(self, ring: "Ring", to: tuple[str, str], delay_s: float) -> None:
        super().__init__()
        self._ring = ring
        self._to = to
        self._delay_s = delay_s

    def write(self, data: bytes, peer: Peer) -> bool:
        self._ring.carry(self._to, data, self._delay_s)
        return super().write(data, peer)


class Resident:
    """Says its name to who asks, and nothing else."""

    def __init__(self, name: str, exchange: Exchange) -> None:
        self._responder = Responder(name)
        self._exchange = exchange

    def answer(self, frame: Frame, way: Way, now: float) -> None:
        reply = self._responder.answer(frame, now)
        if reply is not None:
            self._exchange.send(reply, now)

    def translate(self, frame: Frame, way: Way, now: float) -> Verdict:
        return REFUSED

    def malformed(self, malformed: Malformed, way: Way, now: float) -> None: ...
    def asked_names(self, ways: object, now: float) -> None: ...
    def delivered(self, frame: Frame, now: float) -> None: ...
    def undelivered(self, frame: Frame, verdict: Verdict) -> None: ...
    def peer_came(self, way: Way, now: float) -> None: ...
    def peer_lost(self, way: Way, now: float) -> None: ...
    def link_opened(self, link: Link, now: float) -> None: ...
    def link_closed(self, link: Link, now: float) -> None: ...


class Ring:
    """Brokers A, B and C, each with a radio to the two others; MNERIM on a radio of A, PC on one of C."""

    def __init__(self, delays_s: tuple[float, float, float]) -> None:
        self.now = 100.0
        self._due: list[tuple[float, int, tuple[str, str], bytes]] = []
        self._order = count()
        self.exchanges: dict[str, Exchange] = {}
        self.heard: dict[str, list[bytes]] = {"MNERIM": [], "PC": []}
        self.transmissions = 0
        links = {"A": ["AB", "AC", "robot"], "B": ["AB", "BC"], "C": ["AC", "BC", "robot"]}
        delay_s = dict(zip(("AB", "BC", "AC"), delays_s, strict=True))
        for broker, names in links.items():
            own = Address.named(broker)
            router = Router({own: "psiu-ascii"}, (), identity, self._releaser(broker), duplicates=Duplicates(4.0))
            exchange = self.exchanges[broker] = Exchange(own, router)
            exchange.resident = Resident(broker, exchange)
            for name in names:
                made = configuration(name, adapter=MemoryAdapter())
                link = Link(made, lambda made=made: codec_of(made), exchange, clock=lambda: self.now)  # type: ignore[misc]
                exchange.add(link)
                to = (name.replace(broker, ""), name) if name in delay_s else (f"robot of {broker}", "")
                link.connected(Wire(self, to, delay_s.get(name, 0.01)))

    def _releaser(self, broker: str):  # type: ignore[no-untyped-def]
        return lambda route: self.exchanges[broker].release(route.robot, self.now)

    def carry(self, to: tuple[str, str], data: bytes, delay_s: float) -> None:
        self.transmissions += 1
        assert self.transmissions < 1000, "frames go round"
        heapq.heappush(self._due, (self.now + delay_s, next(self._order), to, data))

    def says(self, robot: str, destination: str, *words: str) -> bytes:
        """`robot` puts a frame on its radio."""
        frame = psiu_ascii.message(Address.named(robot), Address.named(destination), *words)
        data = codec_of(configuration()).encode(frame)
        broker = {"MNERIM": "A", "PC": "C"}[robot]
        self.exchanges[broker].links["robot"].received(data, None)
        return data

    def run(self, seconds: float) -> None:
        until = self.now + seconds
        while self._due and self._due[0][0] <= until:
            self.now, _, (place, link), data = heapq.heappop(self._due)
            if link:
                self.exchanges[place].links[link].received(data, None)
            else:
                self._robot_hears("MNERIM" if place.endswith("A") else "PC", data)
            for exchange in self.exchanges.values():
                exchange.expire(self.now)
        self.now = until
        for exchange in self.exchanges.values():
            exchange.expire(self.now)

    def _robot_hears(self, robot: str, data: bytes) -> None:
        """MNERIM says its name to who asks, also where that is an answer; PC is a program and does not."""
        self.heard[robot].append(data)
        if robot == "PC":
            return
        [frame] = codec_of(configuration()).decode(data, self.now)
        if isinstance(frame, Frame) and frame.subject == "qualseunome" and str(frame.destination) in (robot, "??"):
            self.says(robot, str(frame.source), "qualseunome")

    def silent(self) -> bool:
        return not self._due


delays = st.tuples(*[st.floats(0.001, 1.9)] * 3)


@settings(max_examples=40, deadline=None)
@given(delays)
def test_a_question_to_everyone_reaches_everyone_once_and_does_not_circulate(
    delays_s: tuple[float, float, float],
) -> None:
    ring = Ring(delays_s)
    question = ring.says("PC", "??", "qualseunome")
    ring.run(60)
    assert ring.silent()
    assert ring.heard["MNERIM"].count(question) == 1
    assert ring.transmissions < 200


@settings(max_examples=40, deadline=None)
@given(delays)
def test_a_command_arrives_once_whichever_way_is_quicker(delays_s: tuple[float, float, float]) -> None:
    ring = Ring(delays_s)
    ring.says("MNERIM", "??", "qualseunome")
    ring.run(20)
    command = ring.says("PC", "MNERIM", "parafrente", "100")
    ring.run(20)
    assert ring.silent()
    assert ring.heard["MNERIM"].count(command) == 1


def test_a_person_who_presses_twice_is_obeyed_twice() -> None:
    ring = Ring((0.05, 0.05, 0.05))
    ring.says("MNERIM", "??", "qualseunome")
    ring.run(5)
    command = ring.says("PC", "MNERIM", "parafrente", "100")
    ring.run(0.2)
    ring.says("PC", "MNERIM", "parafrente", "100")
    ring.run(5)
    assert ring.heard["MNERIM"].count(command) == 2


def test_a_neighbour_whose_way_led_through_us_finds_another_when_we_lost_ours() -> None:
    ring = Ring((0.02, 0.02, 0.02))
    ring.says("PC", "MNERIM", "parafrente", "1")
    ring.run(5)
    told = codec_of(configuration()).encode(psiu_ascii.message(Address.named("MNERIM"), Address.named("B"), "luz"))
    ring.exchanges["B"].links["BC"].received(told, None)  # B heard MNERIM by C last
    for broker in ("A", "C"):
        ring.exchanges[broker].links["AC"].lost(LinkLost("cut"))
    command = ring.says("PC", "MNERIM", "parafrente", "2")
    ring.run(5)
    assert ring.heard["MNERIM"].count(command) == 1
    assert ring.silent()


def test_what_comes_round_of_our_own_question_is_a_double() -> None:
    ring = Ring((0.02, 0.02, 0.02))
    exchange = ring.exchanges["A"]
    exchange.ask_names(exchange.links["AB"], ring.now)
    ring.run(5)
    assert exchange.accounts["AC"].fates["duplicate"] == 1
    assert exchange.accounts["AC"].fates["refused"] == 0


def test_a_robot_that_nobody_has_heard_is_found_across_the_ring() -> None:
    ring = Ring((0.02, 0.02, 0.02))
    ring.says("PC", "C", "quantoscomandos")
    ring.run(5)
    command = ring.says("PC", "MNERIM", "parafrente", "100")
    ring.run(5)
    assert ring.heard["MNERIM"].count(command) == 1
    assert ring.silent()


@settings(max_examples=40, deadline=None)
@given(delays)
def test_the_search_for_a_robot_that_is_nowhere_ends(delays_s: tuple[float, float, float]) -> None:
    ring = Ring(delays_s)
    ring.says("PC", "GHOST", "parafrente", "1")
    ring.run(60)
    assert ring.silent()
    assert ring.transmissions < 50


@pytest.mark.parametrize("broker", ["A", "B", "C"])
def test_the_books_of_every_broker_balance(broker: str) -> None:
    ring = Ring((0.1, 0.7, 0.3))
    for number in range(20):
        ring.says("PC", "??", "qualseunome")
        ring.says("PC", "MNERIM", "parafrente", str(number))
        ring.run(0.4)
    ring.run(20)
    exchange = ring.exchanges[broker]
    waiting = exchange.waiting()
    for name, account in exchange.accounts.items():
        assert account.arrived == account.settled() + waiting[name]

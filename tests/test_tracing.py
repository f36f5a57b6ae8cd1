"""Traces, with a robot and another broker that answer what the test says."""

from collections.abc import Sequence

import pytest
from memory_adapter import MemoryAdapter, MemoryTransport, codec_of, configuration

from psiu_broker.codecs.identity import identity
from psiu_broker.codecs.psiu_ascii import message
from psiu_broker.errors import BusError, CallError
from psiu_broker.exchange import Exchange, Resident
from psiu_broker.frame import MESH, Address, Frame, Way
from psiu_broker.link import Link
from psiu_broker.mesh.probe import Probed, Stamp
from psiu_broker.messages import Answer, CallRequest, TraceHop
from psiu_broker.routing.router import ANY, Port, Router
from psiu_broker.routing.table import Binding
from psiu_broker.tracing import Tracing

BASE, BETA, MNERIM, FAR = (Address.named(name) for name in ("base", "BETA", "MNERIM", "FAR"))
ARM = Address.numbered(0x12)


class Mute(Resident):
    def answer(self, frame: Frame, way: Way, now: float) -> None: ...
    def link_opened(self, link: Link, now: float) -> None: ...


class World:
    """base has MNERIM and an arm of bytes on two links; FAR is at north."""

    def __init__(self) -> None:
        self.now = 100.0
        router = Router({BASE: "psiu-ascii"}, (Binding(ARM, None, Way("arm"), "psiu-hexa"),), identity)
        self.exchange = Exchange(BASE, router)
        self.exchange.resident = Mute()
        for name, protocol in (("radio", "psiu-ascii"), ("arm", "psiu-hexa")):
            made = configuration(name, protocol, MemoryAdapter())
            link = Link(made, lambda made=made: codec_of(made), self.exchange, clock=lambda: self.now)
            self.exchange.add(link)
            link.connected(MemoryTransport())
        router.route(message(MNERIM, BASE, "qualseunome"), Way("radio"), self.now)
        north = Way(MESH, "north")
        router.link_up(Port(MESH, ANY, lambda: (north,)))
        router.announced((FAR,), north, "psiu-ascii", self.now)
        self.asked: list[tuple[Address, str]] = []
        self.fault: CallError | None = None
        self.probed: Probed | BusError = BusError("broker north did not answer")
        self.tracing = Tracing("base", self.exchange, self.call, str, lambda: self.now)

    async def call(self, robot: Address, command: str, request: CallRequest) -> Answer:
        self.asked.append((robot, command))
        self.now += 0.001
        if self.fault is not None:
            raise self.fault
        self.exchange.send(message(BASE, robot, command), self.now)
        self.now += 0.009
        return Answer(values=[str(robot)], elapsed_ms=10)

    async def probe(self, owner: str, robot: Address, timeout_s: float) -> tuple[Probed, Sequence[Stamp]]:
        assert (owner, robot) == ("north", FAR)
        self.now += 0.014
        if isinstance(self.probed, BusError):
            raise self.probed
        return self.probed, []


@pytest.fixture
def world() -> World:
    return World()


async def test_a_robot_of_our_own_is_asked_what_moves_nothing(world: World) -> None:
    trace = await world.tracing.trace(BETA, MNERIM, world.probe)
    assert world.asked == [(MNERIM, "quantoscomandos")]
    assert (trace.a, trace.b, trace.answered, trace.total_ms) == ("BETA", "MNERIM", True, 10)
    assert [(hop.at, hop.event, hop.elapsed_ms) for hop in trace.hops] == [
        ("base", "sent", 0),
        ("base/radio", "written", 1),
        ("MNERIM", "answered", 10),
    ]


async def test_a_robot_of_bytes_is_pinged(world: World) -> None:
    world.fault = CallError("no_answer", "silent after 3 tries")
    trace = await world.tracing.trace(MNERIM, ARM, world.probe)
    assert world.asked == [(ARM, "ping")]
    assert (trace.question, trace.answered, trace.reason) == ("ping", False, "silent after 3 tries")
    assert [hop.event for hop in trace.hops] == ["sent"]


async def test_the_broker_itself_answers_at_once(world: World) -> None:
    trace = await world.tracing.trace(MNERIM, BASE, world.probe)
    assert trace.answered
    assert [(hop.at, hop.event) for hop in trace.hops] == [("base", "sent"), ("base", "answered")]
    assert world.asked == []


async def test_a_robot_of_another_broker_is_asked_there(world: World) -> None:
    answered = TraceHop(at="FAR", event="answered", elapsed_ms=10)
    world.probed = Probed(question="qualseunome", answered=True, hops=[answered], took_ms=10)
    trace = await world.tracing.trace(MNERIM, FAR, world.probe)
    assert [(hop.at, hop.event, hop.elapsed_ms) for hop in trace.hops] == [
        ("base", "sent", 0),
        ("north", "received", 2),
        ("FAR", "answered", 12),
        ("base", "received", 14),
    ]
    assert world.asked == []


async def test_a_broker_that_does_not_answer_is_the_reason(world: World) -> None:
    trace = await world.tracing.trace(MNERIM, FAR, world.probe)
    assert (trace.answered, trace.reason) == (False, "broker north did not answer")
    assert [hop.at for hop in trace.hops] == ["base"]


async def test_a_question_is_never_handed_on(world: World) -> None:
    probed = await world.tracing.probed(FAR)
    assert (probed.answered, probed.reason) == (False, "FAR has just gone to broker north")
    assert world.asked == []


async def test_a_robot_of_a_protocol_that_only_a_newer_broker_knows_is_not_asked() -> None:
    world = World()
    world.exchange.router.announced((FAR,), Way(MESH, "north"), "lamp/9", world.now)
    trace = await world.tracing.trace(MNERIM, FAR, world.probe)
    assert (trace.answered, trace.question) == (False, "nothing")
    assert (await world.tracing.probed(FAR)).reason == "FAR speaks lamp/9, in which nothing can be asked without harm"

"""The exchange with real links, routes and codecs; only the far ends are lists."""

from collections.abc import Callable, Iterable

import pytest
from balanced import assert_balanced
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from memory_adapter import MemoryAdapter, MemoryDatagrams, MemoryTransport, codec_of, configuration

from psiu_broker.codecs import psiu_ascii, psiu_hexa
from psiu_broker.codecs.identity import identity
from psiu_broker.errors import LinkLost
from psiu_broker.exchange import Exchange
from psiu_broker.frame import EVERYONE, MESH, Address, Frame, Malformed, Way
from psiu_broker.link import Link
from psiu_broker.messages import RawFrame
from psiu_broker.routing.outbox import Fate
from psiu_broker.routing.policy import Policy, Rule
from psiu_broker.routing.quarantine import TURNS
from psiu_broker.routing.router import SELF, Router
from psiu_broker.routing.table import Binding, Route
from psiu_broker.routing.verdicts import ANSWERED, DELIVERED, Verdict

BASE = Address.named("base")
ROBOTS = tuple(Address.named(name) for name in ("PC", "MNERIM", "OUTRO", "base", "??", "ROBO UM"))
PEERS = (("127.0.0.1", 9001), ("127.0.0.1", 9002))


class Resident:
    """Counts everything; translates by saying that it did; answers `reply` at once where there is one."""

    def __init__(self, exchange: Exchange) -> None:
        self.reply: str | None = None
        self._exchange = exchange
        self.answered: list[Frame] = []
        self.translated: list[Frame] = []
        self.delivered_frames: list[Frame] = []
        self.undelivered_frames: list[tuple[Frame, Verdict]] = []

    def answer(self, frame: Frame, way: Way, now: float) -> None:
        self.answered.append(frame)
        if self.reply and not frame.source.is_numbered:
            self._exchange.send(psiu_ascii.message(BASE, frame.source, *self.reply.split()), now)

    def translate(self, frame: Frame, way: Way, now: float) -> Verdict:
        self.translated.append(frame)
        return ANSWERED

    def malformed(self, malformed: Malformed, way: Way, now: float) -> None: ...
    def asked_names(self, ways: Iterable[Way], now: float) -> None: ...
    def delivered(self, frame: Frame, now: float) -> None:
        self.delivered_frames.append(frame)

    def undelivered(self, frame: Frame, verdict: Verdict) -> None:
        self.undelivered_frames.append((frame, verdict))

    def link_opened(self, link: Link, now: float) -> None: ...
    def link_closed(self, link: Link, now: float) -> None: ...
    def peer_came(self, way: Way, now: float) -> None: ...
    def peer_lost(self, way: Way, now: float) -> None: ...


class Bus:
    """Listens to everything."""

    listened = raw_listened = True

    def __init__(self) -> None:
        self.frames: list[Frame] = []
        self.raw: list[RawFrame] = []

    def publish(self, frame: Frame, way: Way, received: float) -> None:
        self.frames.append(frame)

    def tapped(self, link: str) -> bool:
        return True

    def publish_raw(self, raw: RawFrame) -> None:
        self.raw.append(raw)


class QuietLink(Link):
    """A link whose silences come when the test says so."""

    def _watch_silence(self, end: object, silence_s: float) -> None: ...

    def fall_silent(self) -> None:
        for end in list(self._ends.values()):
            self._silence(end)


class World:
    """An exchange with a radio, a UDP link with two peers, a second radio, and an arm that speaks bytes."""

    def __init__(self) -> None:
        self.now = 100.0
        arm = Address.numbered(0x12)
        bindings = (Binding(Address.named("BRACO"), arm, Way("arm"), "psiu-hexa"),)
        own = {BASE: "psiu-ascii", Address.numbered(0): "psiu-hexa"}
        router = Router(own, bindings, identity, heard=self._heard)
        self.exchange = Exchange(BASE, router)
        self.resident = self.exchange.resident = Resident(self.exchange)
        self.links: dict[str, QuietLink] = {}
        self._add("radio", MemoryAdapter())
        self._add("wifi", MemoryDatagrams(ends=PEERS))
        self._add("second", MemoryAdapter())
        self._add("arm", MemoryAdapter(), "psiu-hexa", topology="point-to-point", remote=0x12, local=0)
        self.transports: dict[str, MemoryTransport] = {}

    def _add(
        self, name: str, adapter: MemoryAdapter, protocol: str = "psiu-ascii", max_age_s: float = 2.0, **codec: object
    ) -> None:
        made = configuration(name, protocol, adapter, codec, queue_frames=3, max_age_s=max_age_s, route_age_s=30.0)
        unaddressed = "topology" in codec
        self.links[name] = QuietLink(
            made, lambda: codec_of(made), self.exchange, unaddressed=unaddressed, clock=lambda: self.now
        )
        self.exchange.add(self.links[name])

    def _heard(self, route: Route) -> None:
        for address in route.addresses:
            self.exchange.release(address, self.now)

    def connect(self, *names: str) -> None:
        for name in names:
            peers = PEERS if name == "wifi" else (None,)
            self.transports[name] = MemoryTransport(peers)
            self.links[name].connected(self.transports[name])

    def wires(self, name: str) -> list[bytes]:
        return self.transports[name].wires

    def verdicts(self, link: str) -> dict[str, int]:
        return {verdict: count for verdict, count in self.exchange.accounts[link].fates.items() if count}

    def balances(self) -> None:
        assert_balanced(self.exchange)


def wire(source: str, destination: str, *words: str) -> bytes:
    frame = psiu_ascii.message(Address.named(source), Address.named(destination), *words)
    return codec_of(configuration()).encode(frame)


def arm_says(payload: bytes) -> bytes:
    """What the robot at the far end of the point-to-point link puts on the wire."""
    far_end = configuration("arm", "psiu-hexa", codec={"topology": "point-to-point", "remote": 0, "local": 0x12})
    return codec_of(far_end).encode(psiu_hexa.packet(Address.numbered(0x12), Address.numbered(0), payload))


@pytest.fixture
def world() -> World:
    world = World()
    world.connect("radio", "wifi", "second", "arm")
    return world


def test_a_command_crosses_from_udp_to_a_radio_unchanged(world: World) -> None:
    world.links["radio"].received(wire("MNERIM", "base", "qualseunome"), None)
    command = wire("PC", "MNERIM", "parafrente", "100")
    world.links["wifi"].received(command, PEERS[0])
    assert world.wires("radio") == [command]
    assert world.verdicts("wifi") == {"delivered": 1}
    world.balances()


def test_a_robot_that_must_be_left_alone_hears_the_broker_and_nobody_else(world: World) -> None:
    world.links["radio"].received(wire("MNERIM", "base", "qualseunome"), None)
    world.exchange.alone = {Address.named("MNERIM")}
    world.links["wifi"].received(wire("PC", "MNERIM", "parafrente", "100"), PEERS[0])
    assert world.wires("radio") == []
    assert world.verdicts("wifi") == {"refused": 1}
    ours = psiu_ascii.message(BASE, Address.named("MNERIM"), "quantoscomandos")
    assert world.exchange.send(ours, world.now) == "delivered"
    world.balances()


def test_a_robot_that_must_be_left_alone_hears_of_frames_to_everyone_only_stops(world: World) -> None:
    world.links["radio"].received(wire("MNERIM", "base", "qualseunome"), None)
    world.exchange.alone = {Address.named("MNERIM"), Address.named("NOBODY")}
    world.links["wifi"].received(wire("PC", "??", "anda", "100"), PEERS[0])
    assert world.wires("radio") == []
    assert world.wires("second") == [wire("PC", "??", "anda", "100")]
    assert world.transports["wifi"].written == [(wire("PC", "??", "anda", "100"), PEERS[1])]
    world.links["wifi"].received(wire("PC", "??", "pare"), PEERS[0])
    assert world.wires("radio") == [wire("PC", "??", "pare")]
    ours = psiu_ascii.message(BASE, EVERYONE, "qualseunome")
    assert world.exchange.send(ours, world.now) == "delivered"
    assert len(world.wires("radio")) == 2
    assert world.verdicts("wifi") == {"delivered": 2}
    world.balances()


@pytest.mark.parametrize(
    ("peer", "heard_by"), [(PEERS[0], [PEERS[1]]), (("127.0.0.1", 9003), [])], ids=["far end", "member of a group"]
)
def test_what_is_told_everyone_passes_a_far_end_where_one_must_be_left_alone(
    world: World, peer: tuple[str, int], heard_by: list[tuple[str, int]]
) -> None:
    world.links["wifi"].received(wire("MNERIM", "base", "qualseunome"), peer)
    world.exchange.alone = {Address.named("MNERIM")}
    world.links["radio"].received(wire("PC", "??", "anda", "100"), None)
    assert [each for _, each in world.transports["wifi"].written] == heard_by
    world.links["wifi"].received(wire("MNERIM", "??", "oi"), peer)
    assert [each for data, each in world.transports["wifi"].written if b"oi" in data] == [
        each for each in PEERS if each != peer
    ], "of what it says itself it hears nothing new"
    world.balances()


def test_what_would_be_told_only_those_who_must_be_left_alone_is_refused_and_answered(world: World) -> None:
    world.links["radio"].received(wire("MNERIM", "base", "qualseunome"), None)
    for link in ("wifi", "second"):
        world.links[link].lost(LinkLost("unplugged"))
    world.exchange.alone = {Address.named("MNERIM")}
    way = Way(MESH, "hill")
    frame = psiu_ascii.message(Address.named("PC"), EVERYONE, "qualseunome")
    world.exchange.join(NoMesh(), 2.0)
    assert world.exchange.relayed(frame, way, world.now, 0.0) == "refused"
    assert world.resident.answered[-1] is frame
    assert world.wires("radio") == []
    world.balances()


class NoMesh:
    """Other brokers, none of whom is there."""

    def offer(
        self, frame: Frame, peer: object, arrived: Way, now: float, patience_s: float = 0.0, fate: Fate | None = None
    ) -> Verdict | None:
        return "link_down"

    def ways(self) -> tuple[Way, ...]:
        return ()


def test_a_frame_with_a_wrong_size_is_forwarded_with_the_true_one(world: World) -> None:
    world.links["radio"].received(wire("MNERIM", "base", "qualseunome"), None)
    world.links["wifi"].received(b"MNERIM 131 parafrente 100 PC 02121", PEERS[0])
    assert world.wires("radio") == [b"MNERIM 034 parafrente 100 PC 02123"]


def test_the_answer_goes_to_the_peer_that_asked_and_to_no_other(world: World) -> None:
    world.links["wifi"].received(wire("PC", "base", "qualseunome"), PEERS[0])
    world.links["wifi"].received(wire("OUTRO", "base", "qualseunome"), PEERS[1])
    answer = wire("MNERIM", "PC", "parafrente", "sucesso")
    world.links["radio"].received(answer, None)
    assert world.transports["wifi"].written == [(answer, PEERS[0])]


def test_a_frame_for_an_unknown_robot_waits_while_the_robot_is_asked_for(world: World) -> None:
    command = wire("PC", "MNERIM", "parafrente", "100")
    world.links["wifi"].received(command, PEERS[0])
    world.links["wifi"].received(wire("PC", "MNERIM", "paratras", "1"), PEERS[0])
    question = wire("base", "MNERIM", "qualseunome")
    assert world.wires("radio") == world.wires("second") == [question], "asked once, by name"
    world.balances()
    world.links["second"].received(wire("MNERIM", "base", "qualseunome"), None)
    assert world.wires("second") == [question, command, wire("PC", "MNERIM", "paratras", "1")]
    assert world.wires("radio") == [question]
    assert world.verdicts("wifi") == {"delivered": 2}
    world.balances()


def test_a_robot_that_does_not_answer_to_its_name_has_no_route(world: World) -> None:
    world.links["wifi"].received(wire("PC", "MNERIM", "parafrente", "100"), PEERS[0])
    world.exchange.expire(world.now + 0.6)
    assert world.verdicts("wifi") == {"no_route": 1}
    world.balances()


def test_a_robot_searched_for_by_the_way_that_leads_to_it_is_looked_for_elsewhere(world: World) -> None:
    world.links["radio"].received(wire("MNERIM", "base", "parafrente", "sucesso"), None)
    search = wire("relay", "MNERIM", "qualseunome")
    world.links["radio"].received(search, None)
    assert world.wires("second") == [wire("base", "MNERIM", "qualseunome")]
    assert world.wires("radio") == []
    world.links["second"].received(wire("MNERIM", "base", "qualseunome"), None)
    assert world.wires("second")[1:] == [search]
    world.balances()


def test_where_it_is_nowhere_else_the_search_was_heard_by_the_robot_itself(world: World) -> None:
    world.links["radio"].received(wire("MNERIM", "base", "qualseunome"), None)
    world.links["radio"].received(wire("PC", "MNERIM", "qualseunome"), None)
    world.links["radio"].received(wire("PC", "MNERIM", "parafrente", "1"), None)
    world.exchange.expire(world.now + 1)
    assert world.verdicts("radio") == {"answered": 1, "same_way": 2}
    route = world.exchange.router.find(Address.named("MNERIM"))
    assert route is not None
    assert route.way == Way("radio")
    world.balances()


def test_when_a_radio_is_lost_the_same_order_by_another_is_no_double(world: World) -> None:
    world.links["wifi"].received(wire("MNERIM", "base", "qualseunome"), PEERS[0])
    order = wire("PC", "MNERIM", "parafrente", "1")
    world.links["radio"].received(order, None)
    world.now += 1
    world.links["radio"].lost(LinkLost("unplugged"))
    world.links["second"].received(order, None)
    assert world.transports["wifi"].written == [(order, PEERS[0])] * 2


def test_a_packet_for_an_unknown_number_waits_while_the_number_is_pinged() -> None:
    world = World()
    for name, domain in (("field", ""), ("yard", ""), ("theirs", "red")):
        world._add(name, MemoryAdapter(), "psiu-hexa", topology="ad-hoc", domain=domain)
    world.connect("arm", "field", "yard", "theirs")
    plain = codec_of(configuration(protocol="psiu-hexa"))
    own, one, other = (Address.numbered(number) for number in (0, 1, 9))
    command = plain.encode(psiu_hexa.packet(one, other, b"\x04\x7f"))
    world.links["field"].received(command, None)
    assert world.wires("yard") == [plain.encode(psiu_hexa.packet(own, other, b""))], "a ping moves nobody"
    assert world.wires("theirs") == world.wires("arm") == world.wires("field") == []
    world.balances()
    world.links["yard"].received(plain.encode(psiu_hexa.packet(other, own, b"")), None)
    assert world.wires("yard")[1:] == [command]
    assert world.verdicts("field") == {"delivered": 1}
    world.balances()


class Hill:
    """Another broker: takes every frame."""

    def __init__(self) -> None:
        self.taken: list[Frame] = []

    def ways(self) -> tuple[Way, ...]:
        return (Way(MESH, "hill"),)

    def offer(
        self, frame: Frame, peer: object, arrived: Way, now: float, patience_s: float = 0.0, fate: Fate | None = None
    ) -> Verdict | None:
        self.taken.append(frame)
        return DELIVERED


@pytest.mark.parametrize("denied", [True, False])
def test_a_rule_by_name_holds_for_a_number_of_which_it_is_told_only_later_whose_it_is(denied: bool) -> None:
    world = World()
    for name in ("field", "yard"):
        world._add(name, MemoryAdapter(), "psiu-hexa", topology="ad-hoc")
    world.connect("field", "yard")
    hill = Hill()
    world.exchange.join(hill, 2.0)
    world.exchange.router.obey(Policy((Rule(False, destination=("ARM" if denied else "LEG",)),)))
    bus = world.exchange.bus = Bus()
    nine, one = Address.numbered(9), Address.numbered(1)
    plain = codec_of(configuration(protocol="psiu-hexa"))
    world.links["field"].received(plain.encode(psiu_hexa.packet(one, nine, b"\x04\x7f")), None)
    assert sum(world.exchange.waiting().values()) == 1
    world.exchange.router.announced((Address.named("ARM"), nine), Way(MESH, "hill"), "psiu-hexa", world.now)
    assert [frame.payload for frame in hill.taken] == ([] if denied else [b"\x04\x7f"])
    assert world.verdicts("field") == ({"denied": 1} if denied else {"delivered": 1})
    assert [raw.verdict for raw in bus.raw if raw.link == "field"] == ["denied" if denied else "delivered"]
    refusal = world.exchange.router.guard.last_refusal(one)
    assert (refusal and (refusal.verdict, refusal.count)) == (("denied", 1) if denied else None)
    world.balances()


def test_whoever_is_held_back_moves_nobody_by_what_waited_nor_is_a_stop_kept_from_anybody(world: World) -> None:
    order, stop = wire("PC", "LATE", "parafrente", "1"), wire("PC", "LATE", "pare")
    for turn in range(TURNS):
        world.now += 0.01
        world.links["wifi"].received(wire("PC", "base", "parafrente", f"1{turn}"), PEERS[0])
        if turn == TURNS - 2:
            world.links["radio"].received(order, None)
            world.links["radio"].received(stop, None)
        else:
            world.links["radio"].received(wire("PC", "base", "parafrente", f"2{turn}"), None)
    assert world.verdicts("radio") == {"answered": TURNS - 2, "quarantined": 1}
    world.balances()
    world.links["second"].received(wire("LATE", "base", "qualseunome"), None)
    assert world.wires("second")[1:] == [stop]
    assert world.verdicts("radio") == {"answered": TURNS - 2, "quarantined": 2, "delivered": 1}
    world.balances()


def test_a_robot_that_must_be_left_alone_when_it_turns_up_is(world: World) -> None:
    world.links["wifi"].received(wire("PC", "LATE", "parafrente", "1"), PEERS[0])
    world.exchange.alone = {Address.named("LATE")}
    world.links["second"].received(wire("LATE", "base", "qualseunome"), None)
    assert wire("PC", "LATE", "parafrente", "1") not in world.wires("second")
    assert world.verdicts("wifi") == {"refused": 1}
    world.balances()


class Line(MemoryAdapter):
    """A line of 9,600 bits a second."""

    @property
    def bits_per_second(self) -> int:
        return 9600


def test_our_own_questions_take_less_than_two_percent_of_a_line_whatever_others_look_for() -> None:
    world = World()
    world._add("line", Line())
    world.connect("wifi", "second", "line")
    minutes = 10
    for number in range(minutes * 600):
        world.now += 0.1
        world.exchange.expire(world.now)
        world.links["wifi"].received(wire("PC", f"GHOST{number % 50}", "parafrente", "1"), PEERS[0])
    bits = 10 * sum(map(len, world.wires("line")))
    assert 0.014 < bits / (9600 * 60 * minutes) < 0.02
    assert len(world.wires("line")) + world.exchange.allowances["line"].refused == len(world.wires("second"))
    world.balances()


def test_who_is_told_to_ask_asks() -> None:
    world = World()
    world._add("line", Line())
    world.connect("line")
    for _ in range(100):
        world.exchange.ask_names(world.links["line"], world.now, told=True)
    assert len(world.wires("line")) == 100
    world.exchange.ask_names(world.links["line"], world.now)
    assert len(world.wires("line")) == 101, "nor is it charged for"


def test_the_time_spent_waiting_for_a_route_counts_towards_the_age_limit(world: World) -> None:
    world.transports["second"].full = True
    world.links["wifi"].received(wire("PC", "MNERIM", "parafrente", "100"), PEERS[0])
    world.now += 0.4
    world.links["second"].received(wire("MNERIM", "base", "qualseunome"), None)
    world.now += 1.7
    world.transports["second"].full = False
    world.links["second"].writable()
    assert not any(b"parafrente" in each for each in world.wires("second"))
    assert world.verdicts("wifi") == {"expired": 1}
    world.balances()


def test_a_frame_older_than_its_link_allows_is_not_sent_even_if_the_wire_is_free() -> None:
    world = World()
    world._add("hasty", MemoryAdapter(), max_age_s=0.1)
    world.connect("wifi", "hasty")
    command = wire("PC", "MNERIM", "parafrente", "100")
    world.links["wifi"].received(command, PEERS[0])
    world.now += 0.4
    world.links["hasty"].received(wire("MNERIM", "base", "qualseunome"), None)
    assert command not in world.wires("hasty")
    assert world.verdicts("wifi") == {"expired": 1}


def test_a_question_for_a_robot_that_is_sought_may_be_older_than_a_command(world: World) -> None:
    world._add("hasty", MemoryAdapter(), max_age_s=0.1)
    world.connect("wifi", "hasty")
    question, command = wire("PC", "MNERIM", "exibecomandos"), wire("PC", "MNERIM", "parafrente", "100")
    for each in (question, command):
        world.links["wifi"].received(each, PEERS[0])
    world.now += 0.4
    world.links["hasty"].received(wire("MNERIM", "base", "qualseunome"), None)
    assert question in world.wires("hasty")
    assert command not in world.wires("hasty")


def test_a_callers_patience_holds_on_every_way_to_a_robot_that_is_sought(world: World) -> None:
    world.exchange.router.table.learn(Address.named("SOUGHT"), Way("wifi"), "psiu-ascii", world.now)
    world.transports["wifi"].full = True
    command = psiu_ascii.message(BASE, Address.named("SOUGHT"), "parafrente", "1")
    assert world.exchange.send(command, world.now, 0.3) is None
    world.now += 0.4
    world.transports["wifi"].full = False
    world.links["wifi"].writable()
    assert world.wires("wifi") == []
    assert world.resident.undelivered_frames == [(command, "expired")]


def test_the_resident_is_told_when_its_frame_leaves_and_no_sooner(world: World) -> None:
    world.exchange.router.table.learn(ROBOTS[1], Way("radio"), "psiu-ascii", world.now)
    first, second = (psiu_ascii.message(BASE, ROBOTS[1], "parafrente", distance) for distance in "12")
    world.exchange.send(first, world.now)
    assert world.resident.delivered_frames == [first]
    world.transports["radio"].full = True
    world.exchange.send(second, world.now)
    assert world.resident.delivered_frames == [first]
    world.transports["radio"].full = False
    world.links["radio"].writable()
    assert world.resident.delivered_frames == [first, second]


def test_a_frame_has_left_with_its_first_copy(world: World) -> None:
    world.exchange.router.table.learn(ROBOTS[1], Way("wifi"), "psiu-ascii", world.now)
    world.transports["wifi"].full_peers = {PEERS[1]}
    command = psiu_ascii.message(BASE, ROBOTS[1], "parafrente", "1")
    assert world.exchange.send(command, world.now) is None
    assert world.resident.delivered_frames == [command]


def test_an_answer_goes_to_who_was_heard_by_the_robot_not_to_who_only_tried() -> None:
    world = World()
    world._add("field", MemoryAdapter(), "psiu-hexa", topology="ad-hoc")
    world.connect("arm", "field")
    plain = codec_of(configuration(protocol="psiu-hexa"))
    arm = Address.numbered(0x12)
    world.links["field"].received(plain.encode(psiu_hexa.packet(Address.numbered(3), arm, b"\x04\x01")), None)
    world.transports["arm"].full = True
    world.links["field"].received(plain.encode(psiu_hexa.packet(Address.numbered(7), arm, b"\x04\x09")), None)
    world.links["arm"].received(arm_says(b"A"), None)
    assert world.wires("field") == [plain.encode(psiu_hexa.packet(arm, Address.numbered(3), b"A"))]


def test_who_passes_for_the_broker_is_not_published(world: World) -> None:
    bus = world.exchange.bus = Bus()
    world.links["radio"].received(wire("base", "MNERIM", "parafrente", "9"), None)
    assert world.verdicts("radio") == {"spoofed": 1}
    assert bus.frames == []
    assert [raw.verdict for raw in bus.raw] == ["spoofed"]


def test_the_brokers_own_frames_are_published_with_the_bytes_that_left(world: World) -> None:
    world.links["radio"].received(wire("MNERIM", "base", "qualseunome"), None)
    bus = world.exchange.bus = Bus()
    world.exchange.send(psiu_ascii.message(BASE, Address.named("MNERIM"), "parafrente", "1"), world.now)
    arm = psiu_hexa.packet(Address.numbered(0), Address.numbered(0x12), b"")
    world.exchange.send(arm, world.now)
    assert [frame.wire for frame in bus.frames] == [world.wires("radio")[-1], world.wires("arm")[-1]]


def test_a_question_to_everyone_goes_to_all_others_and_is_answered_here_too(world: World) -> None:
    question = wire("PC", "??", "qualseunome")
    world.links["wifi"].received(question, PEERS[0])
    assert world.wires("radio") == world.wires("second") == [question]
    assert world.transports["wifi"].written == [(question, PEERS[1])]
    assert world.wires("arm") == []
    assert [frame.destination for frame in world.resident.answered] == [EVERYONE]
    assert world.verdicts("wifi") == {"delivered": 1}


def test_a_robot_heard_on_two_radios_is_heard_once(world: World) -> None:
    world.links["wifi"].received(wire("PC", "base", "qualseunome"), PEERS[0])
    answer = wire("MNERIM", "PC", "parafrente", "sucesso")
    world.links["radio"].received(answer, None)
    world.links["second"].received(answer, None)
    assert world.transports["wifi"].wires == [answer]
    assert world.verdicts("second") == {"duplicate": 1}
    world.now += 0.2
    world.links["radio"].received(answer, None)
    assert world.transports["wifi"].wires == [answer, answer], "a real repeat passes"
    world.balances()


def test_what_the_broker_sent_and_hears_again_does_not_go_round(world: World) -> None:
    world.links["radio"].received(wire("MNERIM", "base", "qualseunome"), None)
    command = psiu_ascii.message(BASE, Address.named("MNERIM"), "parafrente", "1")
    assert world.exchange.send(command, world.now) == "delivered"
    world.links["second"].received(wire("base", "MNERIM", "parafrente", "1"), None)
    assert world.wires("radio") == [wire("base", "MNERIM", "parafrente", "1")]
    assert world.verdicts("second") == {"duplicate": 1}
    world.now += 5
    world.links["second"].received(wire("base", "MNERIM", "parafrente", "1"), None)
    assert world.verdicts("second") == {"duplicate": 1, "spoofed": 1}


def test_bytes_travel_between_links_of_different_topologies_and_back_to_the_asker() -> None:
    world = World()
    world._add("field", MemoryAdapter(), "psiu-hexa", topology="ad-hoc")
    world.connect("arm", "field")
    plain = codec_of(configuration(protocol="psiu-hexa"))
    one, arm = Address.numbered(1), Address.numbered(0x12)
    world.links["field"].received(plain.encode(psiu_hexa.packet(one, arm, bytes((4, 0x7F)))), None)
    assert world.wires("arm") == [bytes.fromhex("06047f") + world.wires("arm")[0][3:]]
    world.links["arm"].received(arm_says(b"A"), None)
    assert world.wires("field") == [plain.encode(psiu_hexa.packet(arm, one, b"A"))]
    world.balances()


def test_words_for_a_robot_of_bytes_are_translated(world: World) -> None:
    world.links["wifi"].received(wire("PC", "BRACO", "garra", "45"), PEERS[0])
    assert [frame.subject for frame in world.resident.translated] == ["garra"]
    assert world.verdicts("wifi") == {"answered": 1}


def test_noise_is_counted(world: World) -> None:
    world.links["wifi"].received(b"\x00\xff noise", PEERS[0])
    assert world.verdicts("wifi") == {"malformed": 1}
    world.balances()


def test_what_waited_for_a_lost_link_is_told_to_whoever_sent_it(world: World) -> None:
    world.links["radio"].received(wire("MNERIM", "base", "qualseunome"), None)
    world.transports["radio"].full = True
    command = psiu_ascii.message(BASE, Address.named("MNERIM"), "parafrente", "1")
    assert world.exchange.send(command, world.now) is None
    world.balances()
    world.links["radio"].lost(LinkLost("unplugged"))
    assert world.resident.undelivered_frames == [(command, "link_down")]
    world.balances()


def test_listeners_hear_each_frame_once_and_tappers_hear_every_frame_with_its_verdict(world: World) -> None:
    bus = world.exchange.bus = Bus()
    world.links["wifi"].received(wire("PC", "base", "qualseunome"), PEERS[0])
    answer = wire("MNERIM", "PC", "parafrente", "sucesso")
    world.links["radio"].received(answer, None)
    world.links["second"].received(answer, None)
    world.links["second"].received(b"\x00", None)
    world.now += 10
    world.links["second"].fall_silent()
    assert [frame.subject for frame in bus.frames] == ["qualseunome", "parafrente"]
    told = [(raw.direction, raw.link, raw.verdict) for raw in bus.raw]
    assert told == [
        ("in", "wifi", "answered"),
        ("out", "wifi", "delivered"),
        ("in", "radio", "delivered"),
        ("in", "second", "duplicate"),
        ("in", "second", "malformed"),
    ]
    assert bus.raw[1].wire == bus.raw[2].wire == answer.hex()


class FramesAreConserved(RuleBasedStateMachine):
    """Whatever links, robots and time do: arrived = delivered + answered + dropped + waiting, on every link."""

    names = st.sampled_from(("radio", "wifi", "second", "arm"))
    robots = st.sampled_from([str(robot) for robot in ROBOTS] + ["BRACO", "GHOST"])
    words = st.sampled_from(
        (("qualseunome",), ("parafrente", "100"), ("pare",), ("parafrente", "sucesso"), ("garra", "45"))
    )

    @initialize()
    def begin(self) -> None:
        self.world = World()

    def _peer(self, name: str, second: bool) -> object:
        return PEERS[second] if name == "wifi" else None

    @rule(name=names, source=robots, destination=robots, words=words, second=st.booleans())
    def a_robot_speaks(self, name: str, source: str, destination: str, words: tuple[str, ...], second: bool) -> None:
        if name != "arm":
            self._count(
                lambda: self.world.links[name].received(wire(source, destination, *words), self._peer(name, second))
            )

    @rule(payload=st.sampled_from((b"", b"A", b"\x04\x7f", b"\x00\x2a")))
    def the_arm_speaks(self, payload: bytes) -> None:
        self._count(lambda: self.world.links["arm"].received(arm_says(payload), None))

    @rule(destination=robots, words=words, patience=st.floats(0, 3))
    def the_broker_speaks(self, destination: str, words: tuple[str, ...], patience: float) -> None:
        frame = psiu_ascii.message(BASE, Address.named(destination), *words)
        before = self.world.exchange.accounts[SELF.link].arrived
        self.world.exchange.send(frame, self.world.now, patience)
        assert self.world.exchange.accounts[SELF.link].arrived == before + 1

    @rule(reply=st.sampled_from(("quantoscomandos 3", None)))
    def the_broker_answers_or_does_not(self, reply: str | None) -> None:
        self.world.resident.reply = reply

    @rule(name=names, noise=st.binary(max_size=40), second=st.booleans())
    def noise_arrives(self, name: str, noise: bytes, second: bool) -> None:
        self.world.links[name].received(noise, self._peer(name, second))
        self.world.now += 0.3
        self.world.links[name].fall_silent()

    @rule(name=names)
    def a_link_comes(self, name: str) -> None:
        if self.world.links[name].state != "open":
            self.world.connect(name)

    @rule(name=names)
    def a_link_goes(self, name: str) -> None:
        self.world.links[name].lost(LinkLost("unplugged"))

    @rule(second=st.booleans())
    def a_peer_goes(self, second: bool) -> None:
        self.world.links["wifi"].peer_lost(PEERS[second])

    @rule(name=names)
    def a_wire_fills(self, name: str) -> None:
        if name in self.world.transports:
            self.world.transports[name].full = True

    @rule(name=names)
    def a_wire_has_room(self, name: str) -> None:
        if name in self.world.transports:
            self.world.transports[name].full = False
            self.world.links[name].writable()

    @rule(seconds=st.sampled_from((0.1, 0.6, 1.5, 40.0)))
    def time_passes(self, seconds: float) -> None:
        self.world.now += seconds
        self.world.exchange.expire(self.world.now)
        for link in self.world.links.values():
            link.fall_silent()

    @invariant()
    def the_books_balance(self) -> None:
        self.world.balances()

    @invariant()
    def nothing_waits_for_a_link_that_is_down(self) -> None:
        for link in self.world.links.values():
            assert link.state == "open" or not link.outbox.size

    @invariant()
    def outboxes_stay_within_their_bounds(self) -> None:
        assert all(link.outbox.size <= 3 for link in self.world.links.values())

    def _count(self, speak: Callable[[], None]) -> None:
        """One whole frame arrives: the books show one more arrival, and only what the broker says of it besides."""
        others = sum(account.arrived for name, account in self.world.exchange.accounts.items() if name != SELF.link)
        speak()
        accounts = self.world.exchange.accounts.items()
        assert sum(account.arrived for name, account in accounts if name != SELF.link) == others + 1


TestFramesAreConserved = FramesAreConserved.TestCase
TestFramesAreConserved.settings = settings(max_examples=60, stateful_step_count=40, deadline=None)

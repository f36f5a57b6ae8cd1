"""Why a frame would arrive, or not: an exchange with real links and routes; nothing is sent."""

import pytest
from memory_adapter import MemoryAdapter, MemoryTransport, codec_of, configuration

from psiu_broker.codecs.identity import identity
from psiu_broker.codecs.psiu_ascii import message
from psiu_broker.errors import LinkLost
from psiu_broker.exchange import Exchange, Resident
from psiu_broker.frame import EVERYONE, MESH, Address, Frame, Way
from psiu_broker.link import Link
from psiu_broker.messages import Why
from psiu_broker.report import Report
from psiu_broker.routing.policy import Policy, Rule
from psiu_broker.routing.quarantine import TURNS
from psiu_broker.routing.router import ANY, SELF, Port, Router
from psiu_broker.routing.table import Binding

BASE, PC, MNERIM, FAR = (Address.named(name) for name in ("base", "PC", "MNERIM", "FAR"))
ARM = Address.numbered(0x12)


class Line(MemoryAdapter):
    """A line of 9,600 bits a second."""

    @property
    def bits_per_second(self) -> int:
        return 9600


class Mute(Resident):
    """Answers nobody."""

    def answer(self, frame: Frame, way: Way, now: float) -> None: ...
    def link_opened(self, link: Link, now: float) -> None: ...
    def link_closed(self, link: Link, now: float) -> None: ...


class World:
    """base has PC on wifi, MNERIM on a slow radio, an arm of bytes, and the brokers north and gate; FAR is at north."""

    def __init__(self) -> None:
        self.now = 100.0
        bindings = (Binding(Address.named("BRACO"), ARM, Way("arm"), "psiu-hexa"),)
        self.router = Router({BASE: "psiu-ascii"}, bindings, identity)
        self.exchange = Exchange(BASE, self.router)
        self.exchange.resident = Mute()
        self.transports: dict[str, MemoryTransport] = {}
        self.report = Report("base", self.exchange, lambda _: (), clock=lambda: self.now)
        self._add("wifi", MemoryAdapter())
        self._add("radio", Line(), wildcard=False)
        self._add("arm", Line(), "psiu-hexa", topology="point-to-point", remote=0x12)
        brokers = [Way(MESH, "north"), Way(MESH, "gate")]
        self.router.link_up(Port(MESH, ANY, lambda: brokers))
        self.router.announced((FAR,), brokers[0], "psiu-ascii", self.now)
        self.router.announced((Address.named("north"),), brokers[0], "psiu-ascii", self.now)
        for robot, link in ((PC, "wifi"), (MNERIM, "radio")):
            self.router.route(message(robot, BASE, "qualseunome"), Way(link), self.now)
        self.now += 3

    def _add(self, name: str, adapter: MemoryAdapter, protocol: str = "psiu-ascii", **more: object) -> None:
        wildcard = more.pop("wildcard", True)
        made = configuration(name, protocol, adapter, more, wildcard=wildcard, max_age_s=2.0)
        link = Link(made, lambda: codec_of(made), self.exchange, unaddressed=bool(more), clock=lambda: self.now)
        self.exchange.add(link)
        self.transports[name] = MemoryTransport()
        link.connected(self.transports[name])

    def why(self, a: Address, b: Address) -> Why:
        why = self.report.why(a, b)
        assert (why.a, why.b, why.broker) == (str(a), str(b), "base")
        return why


@pytest.fixture
def world() -> World:
    return World()


def test_a_hop_over_a_link_has_its_age_its_limit_and_its_cost(world: World) -> None:
    why = world.why(PC, MNERIM)
    assert (why.delivered, why.entry, why.via, why.link, why.age_s) == (True, "wifi", None, "radio", 3.0)
    assert why.filter == "max_age_s = 2: dropped if it has to wait longer for radio"
    assert why.cost_ms == pytest.approx(40 * 10 / 9.6, abs=0.001)


def test_what_waits_adds_to_the_cost(world: World) -> None:
    link = world.exchange.links["radio"]
    world.transports["radio"].full = True
    before = world.why(PC, MNERIM).cost_ms
    frame = message(PC, MNERIM, "parafrente", "100")
    link.offer(frame, None, Way("wifi"), world.now)
    assert before is not None
    assert world.why(PC, MNERIM).cost_ms == pytest.approx(before + len(link.codec.encode(frame)) * 10 / 9.6, abs=0.01)


def test_a_wire_that_is_no_limit_costs_nothing(world: World) -> None:
    assert world.why(MNERIM, PC).cost_ms == 0


def test_a_robot_of_another_broker_is_handed_to_it(world: World) -> None:
    why = world.why(PC, FAR)
    assert (why.delivered, why.entry, why.via, why.link, why.cost_ms) == (True, "wifi", "north", None, None)
    assert "FAR is with broker north" in why.steps
    assert "north is a broker" in world.why(PC, Address.named("north")).steps


def test_what_comes_from_a_broker_goes_to_no_other(world: World) -> None:
    here = world.why(FAR, MNERIM)
    assert (here.delivered, here.entry, here.link) == (True, MESH, "radio")
    on = world.why(FAR, Address.named("north"))
    assert (on.delivered, on.verdict, on.via) == (False, "same_way", None)
    assert on.filter == "split horizon: what comes from a broker is not handed to a broker"


def test_everyone_is_on_several_ways_but_where_wildcard_is_false(world: World) -> None:
    why = world.why(PC, EVERYONE)
    assert (why.delivered, why.via, why.link) == (True, "*", None)
    assert why.filter == "wildcard = false: not on radio"
    from_afar = world.why(FAR, EVERYONE)
    assert (from_afar.via, from_afar.link) == (None, "wifi")


@pytest.mark.parametrize(
    ("a", "b", "verdict", "said"),
    [
        (MNERIM, MNERIM, "same_way", "split horizon: what comes on radio does not leave on it"),
        (BASE, BASE, "same_way", "a broker sends itself nothing"),
        (ARM, MNERIM, "refused", "no translation from psiu-hexa to psiu-ascii"),
        (PC, Address.numbered(0x77), "no_route", "nobody knows it, and there is no open link to ask on"),
    ],
)
def test_what_stops_a_frame_is_named(world: World, a: Address, b: Address, verdict: str, said: str) -> None:
    why = world.why(a, b)
    assert (why.delivered, why.verdict, why.filter, why.cost_ms, why.via) == (False, verdict, said, None, None)


def test_a_link_that_is_down_stops_it(world: World) -> None:
    world.exchange.links["arm"].lost(LinkLost("unplugged"))
    for a in (PC, Address.numbered(0)):
        why = world.why(a, ARM)
        assert (why.verdict, why.link, why.filter, why.cost_ms) == ("link_down", "arm", "arm is waiting", None)
        assert not why.delivered
        assert why.steps[-1] == "dropped (link_down): its link is down"


def test_what_the_broker_answers_leaves_on_no_link(world: World) -> None:
    why = world.why(PC, BASE)
    assert (why.delivered, why.verdict, why.link, why.filter) == (True, "answered", None, None)
    assert world.why(BASE, PC).entry == SELF.link
    assert world.why(Address.named("NOBODY"), PC).entry is None


def test_translation_is_told_with_its_link(world: World) -> None:
    why = world.why(PC, ARM)
    assert (why.verdict, why.link, why.cost_ms) == ("answered", "arm", pytest.approx(6 * 10 / 9.6))
    assert str(why.filter).startswith("translation: what psiu-hexa cannot say")


def test_routes_tell_of_the_robots_of_other_brokers(world: World) -> None:
    routes = {route.robot: route for route in world.report.routes()}
    assert {name: route.origin for name, route in routes.items()} == {
        "BRACO": "static", "FAR": "mesh", "north": "mesh", "PC": "learned", "MNERIM": "learned",
    }  # fmt: skip
    assert (routes["FAR"].link, routes["FAR"].peer, routes["FAR"].expires_in_s) == (MESH, "north", None)


def test_what_to_do_about_two_robots_of_one_name_can_be_typed_as_it_is_told(world: World) -> None:
    robot = Address.named("ROBO; reboot")
    for turn in range(2 * TURNS):
        frame = Frame(robot, BASE, "oi", b"oi %d" % turn, "psiu-ascii")
        world.router.route(frame, Way(("wifi", "radio")[turn % 2]), world.now)
    (told,) = (world.report._held(held) for held in world.router.quarantine)
    assert told.detail.endswith("psiu conflicts --release 'ROBO; reboot' radio")


# Who may command whom.


def deny(world: World, *rules: Rule) -> None:
    world.router.obey(Policy(rules, {BASE}))


def test_a_rule_that_denies_all_commands_stops_them_and_is_quoted(world: World) -> None:
    deny(world, Rule(False, source=("P*",), where="policy[0]"))
    why = world.why(PC, MNERIM)
    assert (why.delivered, why.verdict, why.cost_ms) == (False, "denied", None)
    assert why.filter == "policy[0] denies source P*"
    assert why.steps[-1] == "commands are denied, not answers and questions: policy[0] denies source P*"
    assert world.why(MNERIM, PC).delivered
    assert world.why(PC, BASE).delivered


def test_rules_for_single_commands_are_told_and_the_rest_is_delivered(world: World) -> None:
    deny(world, Rule(False, command=("para*",), where="policy[0]"), Rule(True, link=("wifi",), where="policy[1]"))
    why = world.why(PC, MNERIM)
    assert why.delivered
    assert why.steps[-1] == "some commands: policy[0] denies command para*"


def test_what_keeps_programs_on_the_bus_from_a_robot_is_told(world: World) -> None:
    deny(world, Rule(False, source=("base",), where="policy[0]"))
    assert world.why(BASE, MNERIM).verdict == "denied"


def test_the_last_that_was_turned_away_is_told_with_its_reason(world: World) -> None:
    deny(world, Rule(False, source=("RUIM",), where="policy[0]"))
    for number in range(3):
        world.router.route(message(Address.named("RUIM"), MNERIM, "parafrente", str(number)), Way("wifi"), world.now)
    world.now += 2
    why = world.why(Address.named("RUIM"), MNERIM)
    assert (why.verdict, why.filter) == ("denied", "policy[0] denies source RUIM")
    assert why.steps[-1] == (
        "turned away: 3 frames of RUIM, the last 2.0 s ago, parafrente for MNERIM from wifi (denied):"
        " policy[0] denies source RUIM"
    )


def test_a_name_that_is_used_elsewhere_is_told_with_where_it_belongs(world: World) -> None:
    world.router.route(message(Address.named("BRACO"), MNERIM, "parafrente", "1"), Way("wifi"), world.now)
    world.router.route(message(BASE, MNERIM, "parafrente", "1"), Way("wifi"), world.now)
    assert world.why(Address.named("BRACO"), MNERIM).steps[-1] == (
        "turned away: a frame of BRACO 0.0 s ago, parafrente for MNERIM from wifi (spoofed):"
        " the configuration puts BRACO on arm"
    )
    assert world.why(BASE, MNERIM).steps[-1].endswith("(spoofed): base is this broker itself")


def test_storms_and_names_too_many_are_told(world: World) -> None:
    for number in range(60):
        world.router.route(message(PC, EVERYONE, "qualseunome", str(number)), Way("wifi"), world.now)
    assert world.why(PC, MNERIM).steps[-1].endswith("(storm): too many frames to everyone came from that link")
    for number in range(60):
        world.router.route(message(Address.named(f"R{number}"), BASE, "qualseunome"), Way("wifi"), world.now)
    assert (
        world.why(Address.named("R59"), MNERIM)
        .steps[-1]
        .endswith("(too_many_names): more new names than new_names_per_minute came on that link")
    )


def test_who_says_to_be_everyone_is_nobody(world: World) -> None:
    world.router.route(message(EVERYONE, MNERIM, "parafrente", "1"), Way("wifi"), world.now)
    assert (
        world.why(EVERYONE, MNERIM).steps[-1].endswith("parafrente for MNERIM from wifi (refused): nobody is called ??")
    )


def test_a_name_that_went_from_the_table_was_still_used_elsewhere_than_it_may_be(world: World) -> None:
    far = Address.named("AFAR")
    world.router.guard.refused(message(far, MNERIM, "pare"), "spoofed", Way("wifi"), world.now)
    assert world.why(far, MNERIM).steps[-1].endswith("(spoofed): the configuration puts its source elsewhere")

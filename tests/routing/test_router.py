import pytest

from psiu_broker.frame import EVERYONE, MESH, Address, Frame, Way
from psiu_broker.routing.router import ANY, SELF, Decision, Port, Router
from psiu_broker.routing.table import Binding, Route, Table

BASE, PC, MNERIM, BRACO = (Address.named(name) for name in ("base", "PC", "MNERIM", "BRACO"))
BROKER_NUMBER, ARM_NUMBER = Address.numbered(0), Address.numbered(0x12)
RADIO, ARM = Way("radio"), Way("arm")
PHONE, LAPTOP = Way("wifi", ("127.0.0.1", 9001)), Way("wifi", ("127.0.0.1", 9002))


def text(source: Address, destination: Address, word: str = "parafrente", serial: int = 0) -> Frame:
    wire = f"{destination} {word} {source} {serial}".encode()
    return Frame(source, destination, word, word.encode(), "psiu-ascii", wire, "psiu-ascii/1")


def packet(source: Address, destination: Address, payload: bytes = b"") -> Frame:
    return Frame(source, destination, "ping", payload, "psiu-hexa", b"%d %d" % (source.number, destination.number), "h")


def wire(frame: Frame) -> bytes:
    return frame.wire


@pytest.fixture
def heard() -> list[Route]:
    return []


@pytest.fixture
def gone() -> list[Route]:
    return []


@pytest.fixture
def router(heard: list[Route], gone: list[Route]) -> Router:
    router = Router(
        {BASE: "psiu-ascii", BROKER_NUMBER: "psiu-hexa"},
        (Binding(BRACO, ARM_NUMBER, ARM, "psiu-hexa"),),
        identity=wire,
        heard=heard.append,
        withdrawn=gone.append,
    )
    router.link_up(Port("radio", "psiu-ascii", lambda: (RADIO,)))
    router.link_up(Port("wifi", "psiu-ascii", lambda: (PHONE, LAPTOP)))
    router.link_up(Port("arm", "psiu-hexa", lambda: (ARM,)))
    return router


def test_a_frame_goes_to_where_its_destination_was_heard(router: Router) -> None:
    router.route(text(MNERIM, PC), RADIO, 0.0)
    decision = router.route(text(PC, MNERIM), PHONE, 1.0)
    assert (decision.action, decision.hops) == ("forward", (RADIO,))


def test_each_udp_peer_is_its_own_way_so_answers_go_to_the_right_one(router: Router) -> None:
    router.route(text(PC, BASE), PHONE, 0.0)
    router.route(text(MNERIM, BASE), LAPTOP, 0.0)
    assert router.route(text(MNERIM, PC), LAPTOP, 1.0).hops == (PHONE,)
    assert router.route(text(PC, MNERIM), PHONE, 1.0).hops == (LAPTOP,)


def test_a_robot_that_moved_is_followed_at_its_first_frame(router: Router, heard: list[Route]) -> None:
    router.route(text(MNERIM, PC, serial=1), RADIO, 0.0)
    router.route(text(MNERIM, PC, serial=2), LAPTOP, 1.0)
    assert router.route(text(PC, MNERIM), PHONE, 2.0).hops == (LAPTOP,)
    assert [route.robot for route in heard] == [MNERIM, MNERIM, PC]


def test_a_double_teaches_nothing(router: Router) -> None:
    router.route(text(MNERIM, BASE), RADIO, 0.0)
    assert router.route(text(MNERIM, BASE), LAPTOP, 0.1).verdict == "duplicate"
    assert router.route(text(PC, MNERIM), PHONE, 0.2).hops == (RADIO,)


def test_a_frame_never_goes_back_where_it_came_from(router: Router) -> None:
    router.route(text(MNERIM, BASE), RADIO, 0.0)
    assert router.route(text(PC, MNERIM), RADIO, 1.0).verdict == "same_way"


def test_a_question_to_everyone_goes_everywhere_but_back(router: Router) -> None:
    decision = router.route(text(PC, EVERYONE, "qualseunome"), PHONE, 0.0)
    assert decision.action == "flood"
    assert set(decision.hops) == {RADIO, LAPTOP}


def test_a_question_to_everyone_spares_the_links_that_want_none(router: Router) -> None:
    router.link_up(Port("radio", "psiu-ascii", lambda: (RADIO,), wildcard=False))
    assert router.route(text(PC, EVERYONE, "qualseunome"), PHONE, 0.0).hops == (LAPTOP,)


def test_a_frame_for_the_broker_is_answered_here(router: Router) -> None:
    assert router.route(text(PC, BASE), PHONE, 0.0).action == "answer"
    assert router.route(packet(ARM_NUMBER, BROKER_NUMBER), ARM, 0.0).action == "answer"


def test_the_broker_does_not_talk_to_itself(router: Router) -> None:
    assert router.route(text(BASE, BASE), SELF, 0.0).verdict == "same_way"


@pytest.mark.parametrize(("liar", "verdict"), [(BASE, "spoofed"), (EVERYONE, "refused")])
def test_nobody_can_pass_for_the_broker_or_for_everyone(router: Router, liar: Address, verdict: str) -> None:
    assert router.route(text(liar, MNERIM), PHONE, 0.0).verdict == verdict
    assert router.route(text(MNERIM, BASE), RADIO, 0.0).action == "answer"
    assert router.route(text(PC, EVERYONE), PHONE, 0.0).action == "flood"


def test_an_unknown_robot_is_asked_for_on_the_links_that_speak_its_protocol(router: Router) -> None:
    decision = router.route(text(PC, MNERIM), PHONE, 0.0)
    assert decision.action == "ask"
    assert set(decision.hops) == {RADIO, LAPTOP}


def test_a_number_cannot_be_asked_for_where_packets_name_nobody(router: Router) -> None:
    assert router.decide(Address.numbered(9), "psiu-hexa", PHONE).verdict == "no_route"


def test_a_number_is_asked_for_on_the_other_links_of_its_domain(router: Router) -> None:
    for name, domain in (("field", ""), ("yard", ""), ("theirs", "red")):
        router.link_up(Port(name, "psiu-hexa", lambda name=name: (Way(name),), domain=domain))  # type: ignore[misc]
    decision = router.decide(Address.numbered(9), "psiu-hexa", Way("field"))
    assert (decision.action, decision.hops) == ("ask", (Way("yard"),))
    assert router.decide(Address.numbered(9, "red"), "psiu-hexa", SELF).hops == (Way("theirs"),)


def test_without_anybody_to_ask_there_is_no_route(router: Router) -> None:
    router.link_down("radio", 0.0)
    router.link_down("wifi", 0.0)
    assert router.decide(MNERIM, "psiu-ascii", PHONE).verdict == "no_route"


def test_what_a_lost_link_taught_is_forgotten_and_its_robots_are_named(router: Router, gone: list[Route]) -> None:
    router.route(text(MNERIM, BASE), RADIO, 0.0)
    router.link_down("radio", 5.0)
    assert [route.robot for route in gone] == [MNERIM]
    assert router.find(MNERIM) is None
    departed = router.table.departed(MNERIM)
    assert departed is not None
    assert (departed.link, departed.at) == ("radio", 5.0)


def test_only_the_robots_of_a_lost_peer_are_forgotten(router: Router) -> None:
    router.route(text(PC, BASE), PHONE, 0.0)
    router.route(text(MNERIM, BASE), LAPTOP, 0.0)
    router.peer_lost(PHONE, 1.0)
    assert router.find(PC) is None
    assert router.find(MNERIM) is not None


def test_routes_age_by_the_limit_of_their_link(router: Router, gone: list[Route]) -> None:
    router.route(text(MNERIM, BASE), RADIO, 0.0)
    router.route(text(PC, BASE), PHONE, 0.0)
    limits = {"radio": 10.0, "wifi": 100.0, "arm": 100.0}
    router.table.age(limits, 50.0)
    assert [route.robot for route in gone] == [MNERIM]
    assert router.find(BRACO) is not None


def test_a_robot_of_the_configuration_is_known_before_it_speaks(router: Router) -> None:
    assert router.route(packet(Address.numbered(3), ARM_NUMBER), LAPTOP, 0.0).hops == (ARM,)


def test_when_its_link_is_down_a_robot_of_the_configuration_is_not_forgotten(router: Router) -> None:
    router.link_down("arm", 0.0)
    assert router.decide(ARM_NUMBER, "psiu-hexa", LAPTOP) == Decision("drop", verdict="link_down")
    assert router.decide(BRACO, "psiu-ascii", PHONE) == Decision("translate", verdict="link_down")
    router.link_up(Port("arm", "psiu-hexa", lambda: (ARM,)))
    assert router.decide(ARM_NUMBER, "psiu-hexa", LAPTOP).hops == (ARM,)


def test_a_robot_of_the_configuration_keeps_its_link_whoever_uses_its_name(router: Router) -> None:
    router.route(packet(ARM_NUMBER, BROKER_NUMBER), LAPTOP, 0.0)
    assert router.decide(ARM_NUMBER, "psiu-hexa", PHONE).hops == (ARM,)


def test_a_configured_robot_on_a_udp_link_is_sought_at_every_peer_until_it_is_heard() -> None:
    router = Router({BASE: "psiu-ascii"}, (Binding(MNERIM, None, Way("wifi"), "psiu-ascii"),), identity=wire)
    router.link_up(Port("wifi", "psiu-ascii", lambda: (PHONE, LAPTOP)))
    assert router.route(text(BASE, MNERIM), SELF, 0.0).hops == (PHONE, LAPTOP)
    router.route(text(MNERIM, BASE), LAPTOP, 1.0)
    assert router.route(text(BASE, MNERIM), SELF, 2.0).hops == (LAPTOP,)
    router.peer_lost(LAPTOP, 3.0)
    assert router.route(text(BASE, MNERIM), SELF, 4.0).hops == (PHONE, LAPTOP)


def test_a_robot_has_one_route_under_its_name_and_its_number(router: Router) -> None:
    assert router.find(BRACO) is router.find(ARM_NUMBER)
    assert [route.robot for route in router.robots()] == [BRACO]


def test_words_for_a_robot_of_bytes_are_translated_and_the_other_way_is_refused(router: Router) -> None:
    assert router.route(text(PC, BRACO, "garra"), PHONE, 0.0).action == "translate"
    router.route(text(MNERIM, BASE), RADIO, 0.0)
    assert router.decide(MNERIM, "psiu-hexa", ARM).verdict == "refused"


def test_two_domains_may_use_the_same_number() -> None:
    red, blue = Address.numbered(3, "red"), Address.numbered(3, "blue")
    router = Router({BASE: "psiu-ascii"}, (), identity=lambda frame: (frame.source, frame.destination, frame.payload))
    router.link_up(Port("red", "psiu-hexa", lambda: (Way("red"),)))
    router.link_up(Port("blue", "psiu-hexa", lambda: (Way("blue"),)))
    router.route(packet(red, Address.numbered(1, "red")), Way("red"), 0.0)
    router.route(packet(blue, Address.numbered(1, "blue")), Way("blue"), 0.0)
    assert router.decide(red, "psiu-hexa", SELF).hops == (Way("red"),)
    assert router.decide(blue, "psiu-hexa", SELF).hops == (Way("blue"),)


def test_a_configured_peer_that_the_link_does_not_have_is_not_reached_and_nobody_can_take_its_place() -> None:
    binding = Binding(MNERIM, None, PHONE, "psiu-ascii")
    router = Router({BASE: "psiu-ascii"}, (binding,), identity=wire)
    there = [LAPTOP]
    router.link_up(Port("wifi", "psiu-ascii", lambda: there))
    assert router.route(text(BASE, MNERIM), SELF, 0.0).verdict == "link_down"
    router.route(text(MNERIM, BASE), LAPTOP, 1.0)
    assert router.route(text(BASE, MNERIM), SELF, 2.0).verdict == "link_down"
    there.append(PHONE)
    assert router.route(text(BASE, MNERIM), SELF, 3.0).hops == (PHONE,)


def test_a_full_table_makes_room_for_a_new_robot_and_never_forgets_a_configured_one() -> None:
    gone: list[Route] = []
    table = Table((Binding(BRACO, ARM_NUMBER, ARM, "psiu-hexa"),), gone.append, capacity=10)
    for number in range(25):
        table.learn(Address.named(f"R{number}"), RADIO, "psiu-ascii", 0.0)
    assert len(table.routes) == 10
    assert {str(route.robot) for route in table} == {"BRACO", *(f"R{number}" for number in range(17, 25))}
    assert [str(route.robot) for route in gone] == [f"R{number}" for number in range(17)]


def test_deciding_changes_nothing(router: Router) -> None:
    before = {address: route.way for address, route in router.table.routes.items()}
    router.decide(MNERIM, "psiu-ascii", PHONE)
    router.decide(EVERYONE, "psiu-ascii", PHONE)
    assert {address: route.way for address, route in router.table.routes.items()} == before


# Other brokers.

NORTH, SOUTH = Way(MESH, "north"), Way(MESH, "south")


class Owners:
    """Says of robots that live elsewhere what the test says."""

    def __init__(self) -> None:
        self.taken = False
        self.overheard: list[Address] = []
        self.radio: dict[Address, str] = {}

    def takes(self, route: Route, frame: Frame, arrived: Way, now: float) -> bool:
        return self.taken

    def overhear(self, route: Route, frame: Frame, arrived: Way, now: float) -> None:
        self.overheard.append(route.robot)

    def heard_on(self, robot: Address) -> str | None:
        return self.radio.get(robot)


@pytest.fixture
def owners() -> Owners:
    return Owners()


@pytest.fixture
def joined(heard: list[Route], gone: list[Route], owners: Owners) -> Router:
    """A broker with two radios and an arm, and two other brokers."""
    router = Router(
        {BASE: "psiu-ascii"},
        (Binding(BRACO, ARM_NUMBER, ARM, "psiu-ascii"),),
        identity=wire,
        heard=heard.append,
        withdrawn=gone.append,
        ownership=owners,  # type: ignore[arg-type]
    )
    for way in (RADIO, ARM, Way("second")):
        router.link_up(Port(way.link, "psiu-ascii", lambda way=way: (way,)))  # type: ignore[misc]
    router.link_up(Port(MESH, ANY, lambda: (NORTH, SOUTH)))
    router.announced((MNERIM,), NORTH, "psiu-ascii", 0.0)
    return router


def test_a_frame_for_a_robot_of_another_broker_goes_to_that_broker(joined: Router) -> None:
    assert joined.route(text(PC, MNERIM), RADIO, 1.0).hops == (NORTH,)
    assert joined.is_elsewhere(MNERIM)
    assert not joined.is_here(MNERIM)


def test_nothing_goes_from_one_broker_to_the_next(joined: Router) -> None:
    assert joined.route(text(PC, MNERIM), SOUTH, 1.0).verdict == "same_way"
    assert joined.route(text(PC, MNERIM, serial=1), NORTH, 1.0).verdict == "same_way"
    assert {way.link for way in joined.decide(EVERYONE, "psiu-ascii", SOUTH).hops} == {"radio", "second", "arm"}
    assert {way.link for way in joined.decide(Address.named("GHOST"), "psiu-ascii", SOUTH).hops} == {
        "radio",
        "second",
        "arm",
    }


def test_a_question_to_everyone_goes_to_every_broker_and_every_other_link(joined: Router) -> None:
    assert set(joined.decide(EVERYONE, "psiu-ascii", RADIO).hops) == {Way("second"), ARM, NORTH, SOUTH}


def test_a_frame_on_the_radio_on_which_its_robot_was_overheard_has_reached_it(joined: Router, owners: Owners) -> None:
    owners.radio[MNERIM] = "radio"
    assert joined.decide(MNERIM, "psiu-ascii", RADIO).verdict == "same_way"
    assert joined.decide(MNERIM, "psiu-ascii", Way("second")).hops == (NORTH,)


def test_what_another_broker_relays_teaches_nothing(joined: Router) -> None:
    joined.route(text(PC, BASE), SOUTH, 1.0)
    assert joined.find(PC) is None


def test_a_robot_of_another_broker_that_is_heard_here_stays_there_until_it_is_ours(
    joined: Router, owners: Owners, heard: list[Route]
) -> None:
    joined.route(text(MNERIM, BASE), RADIO, 1.0)
    assert joined.is_elsewhere(MNERIM)
    owners.taken = True
    heard.clear()
    joined.route(text(MNERIM, BASE, serial=1), RADIO, 2.0)
    assert joined.is_here(MNERIM)
    assert [route.robot for route in heard] == [MNERIM]


def test_a_double_of_a_robot_of_another_broker_is_overheard_all_the_same(joined: Router, owners: Owners) -> None:
    joined.route(text(MNERIM, BASE), NORTH, 1.0)
    assert joined.route(text(MNERIM, BASE), RADIO, 1.1).verdict == "duplicate"
    assert owners.overheard == [MNERIM]


def test_a_robot_that_other_brokers_announce_in_turn_is_one_robot(
    joined: Router, heard: list[Route], gone: list[Route]
) -> None:
    heard.clear()
    joined.announced((MNERIM,), NORTH, "psiu-ascii", 1.0)
    assert heard == [], "that is no news"
    joined.announced((MNERIM,), SOUTH, "psiu-ascii", 2.0)
    assert joined.decide(MNERIM, "psiu-ascii", RADIO).hops == (SOUTH,)
    assert [route.robot for route in heard] == [MNERIM]
    assert gone == []
    joined.unannounced(MNERIM, 3.0)
    assert joined.find(MNERIM) is None
    assert [route.robot for route in gone] == [MNERIM]


def test_a_robot_of_ours_is_not_withdrawn_because_no_other_broker_has_it(joined: Router) -> None:
    joined.route(text(PC, BASE), RADIO, 1.0)
    joined.unannounced(PC, 2.0)
    assert joined.is_here(PC)


def test_a_robot_is_taken_where_it_was_overheard_unless_that_link_is_down(joined: Router) -> None:
    joined.link_down("second", 1.0)
    assert not joined.take(MNERIM, Way("second"), "psiu-ascii", 2.0)
    assert joined.is_elsewhere(MNERIM)
    assert joined.take(MNERIM, RADIO, "psiu-ascii", 2.0)
    route = joined.find(MNERIM)
    assert route is not None
    assert (route.way, route.heard_at) == (RADIO, 2.0)


def test_a_configured_robot_stays_though_another_broker_has_it_in_its_configuration_too(joined: Router) -> None:
    joined.announced((BRACO,), NORTH, "psiu-ascii", 1.0, heard=False)
    assert joined.decide(BRACO, "psiu-ascii", RADIO).hops == (ARM,)


def test_a_configured_robot_follows_to_the_broker_that_hears_it_and_comes_home(
    joined: Router, heard: list[Route], gone: list[Route]
) -> None:
    joined.announced((BRACO, ARM_NUMBER), NORTH, "psiu-ascii", 1.0)
    assert joined.decide(BRACO, "psiu-ascii", RADIO).hops == (NORTH,)
    assert joined.find(ARM_NUMBER) is joined.find(BRACO)
    heard.clear()
    joined.unannounced(BRACO, 2.0)
    assert joined.decide(BRACO, "psiu-ascii", RADIO).hops == (ARM,)
    assert [route.robot for route in heard] == [BRACO], "its card is ours again"
    joined.announced((BRACO,), NORTH, "psiu-ascii", 3.0)
    joined.peer_lost(NORTH, 4.0)
    assert joined.decide(BRACO, "psiu-ascii", RADIO).hops == (ARM,)
    assert BRACO not in [route.robot for route in gone]


def test_a_configured_robot_is_taken_on_its_own_link_only(joined: Router, owners: Owners) -> None:
    joined.announced((BRACO,), NORTH, "psiu-ascii", 1.0)
    owners.taken = True
    joined.route(text(BRACO, BASE), RADIO, 2.0)
    assert joined.is_elsewhere(BRACO)
    joined.route(text(BRACO, BASE, serial=1), ARM, 3.0)
    assert joined.is_here(BRACO)


def test_nobody_can_announce_a_robot_with_our_name(joined: Router) -> None:
    joined.announced((BASE,), NORTH, "psiu-ascii", 1.0)
    assert joined.decide(BASE, "psiu-ascii", RADIO).action == "answer"


# Table.place: robots with a name and a number.

NINE = Address.numbered(9)


def addresses(table: Table) -> set[tuple[Address, ...]]:
    return {route.addresses for route in table}


def test_a_placed_robot_is_found_by_its_name_and_its_number() -> None:
    table = Table()
    route = table.place((MNERIM, NINE), NORTH, "psiu-hexa", 0.0)
    assert table.routes == {MNERIM: route, NINE: route}


def test_a_bare_number_gets_its_name_when_that_is_known_and_does_not_lose_it_again() -> None:
    gone: list[Route] = []
    table = Table(withdrawn=gone.append)
    table.learn(NINE, RADIO, "psiu-hexa", 0.0)
    table.place((MNERIM, NINE), NORTH, "psiu-hexa", 1.0)
    assert addresses(table) == {(MNERIM, NINE)}
    assert [route.robot for route in gone] == [NINE]
    assert table.place((NINE,), SOUTH, "psiu-hexa", 2.0) is None
    assert addresses(table) == {(MNERIM, NINE)}


def test_a_number_that_two_names_claim_stays_with_the_first() -> None:
    table = Table()
    table.place((MNERIM, NINE), NORTH, "psiu-hexa", 0.0)
    table.place((PC, NINE), SOUTH, "psiu-hexa", 1.0)
    table.place((MNERIM, NINE), NORTH, "psiu-hexa", 2.0)
    assert addresses(table) == {(MNERIM, NINE), (PC,)}


def test_a_number_of_the_configuration_stays_with_the_robot_that_has_it_there() -> None:
    table = Table((Binding(BRACO, ARM_NUMBER, ARM, "psiu-hexa"),))
    table.place((MNERIM, ARM_NUMBER), NORTH, "psiu-hexa", 0.0)
    assert table.place((ARM_NUMBER,), NORTH, "psiu-hexa", 0.0) is None
    assert addresses(table) == {(BRACO, ARM_NUMBER), (MNERIM,)}

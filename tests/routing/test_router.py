import pytest

from psiu_broker.frame import EVERYONE, Address, Frame, Way
from psiu_broker.routing.router import SELF, Decision, Port, Router
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


@pytest.mark.parametrize("liar", [BASE, EVERYONE])
def test_nobody_can_pass_for_the_broker_or_for_everyone(router: Router, liar: Address) -> None:
    assert router.route(text(liar, MNERIM), PHONE, 0.0).verdict == "refused"
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

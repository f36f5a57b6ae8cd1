"""Robots of one name, with a name and a number, and in the configurations of several brokers."""

import itertools

import pytest
from mesh.scenes import MNERIM, NUMBER, changes_of_owner, commanded, pinned
from mesh.simulated import RADIO, Simulation, Station

from psiu_broker.frame import MESH, Address, Way
from psiu_broker.routing.table import Binding


@pytest.mark.parametrize("every_s", [0.25, 0.7, 1.0, 2.0])
def test_two_robots_of_one_name_are_shown_as_a_conflict_and_their_name_stays_with_one_broker(
    mesh: Simulation, every_s: float
) -> None:
    def talk(seconds: float) -> int:
        owners = []
        until = mesh.now + seconds
        while mesh.now < until:
            mesh.talks("MNERIM", "A", every_s / 2, every_s / 2)
            mesh.talks("MNERIM", "B", every_s / 2, every_s / 2)
            owners.append(mesh.stations["C"].owner("MNERIM"))
        return sum(one != other for one, other in itertools.pairwise(owners))

    def shown() -> list[tuple[str, set[str]]]:
        return [(robot, brokers) for it in mesh.stations.values() for robot, brokers, *_ in it.mesh.conflicts(it.now)]

    talk(10 * every_s + 2)
    assert ("MNERIM", {"A", "B"}) in shown()
    assert talk(60) == 0
    assert ("MNERIM", {"A", "B"}) in shown()
    rest = {"A": "B", "B": "A"}[str(mesh.owner("MNERIM"))]
    mesh.talks("MNERIM", rest, 8, every_s)
    assert mesh.owner("MNERIM") == rest, "the other robot is switched off"
    mesh.talks("MNERIM", rest, 150, every_s)
    assert shown() == []


def test_a_robot_that_moves_once_is_no_conflict(mesh: Simulation) -> None:
    mesh.talks("MNERIM", "B", 30)
    assert not any(it.ownership.conflicts for it in mesh.stations.values())


def test_two_brokers_of_one_name_are_shown() -> None:
    mesh = Simulation("ABC")
    mesh.run(1)
    mesh.stations["A"].mesh.broker_came("A", 1234, "another", "0", mesh.stations["A"].now)
    mesh.run(4)
    assert [name for name, *_ in mesh.stations["A"].mesh.conflicts(mesh.stations["A"].now)] == ["A"]
    mesh.stations["A"].mesh.broker_went("A", 1234, "0", mesh.stations["A"].now)
    assert not list(mesh.stations["A"].mesh.conflicts(mesh.stations["A"].now))


def test_a_robot_with_the_name_of_a_broker_does_not_take_its_place(mesh: Simulation) -> None:
    mesh.talks("C", "B", 5)
    route = mesh.stations["B"].route("C")
    assert route is not None
    assert route.way == Way(MESH, "C")
    assert mesh.says("MNERIM", "A", "C", "oi")
    mesh.run(0.1)
    assert mesh.stations["C"].answered[-1].payload == b"oi"


def test_a_broker_that_comes_later_gets_its_name_from_the_robot_that_had_it(mesh: Simulation) -> None:
    mesh.talks("D", "B", 1)
    assert mesh.owner("D") == "B"
    mesh.start("D")
    mesh.talks("D", "B", 5)
    for name in "ABC":
        route = mesh.stations[name].route("D")
        assert route is not None
        assert route.way == Way(MESH, "D"), name
    assert mesh.stations["B"].owner("D") is None


def routes_to(station: Station, *addresses: Address) -> list[Way | None]:
    found = (station.router.find(address) for address in addresses)
    return [None if route is None else route.way for route in found]


def test_a_robot_with_a_name_and_a_number_is_reached_by_both_from_everywhere() -> None:
    mesh = Simulation("ABC", bindings=pinned("A", number=NUMBER))
    mesh.run(1)
    assert routes_to(mesh.stations["B"], MNERIM, NUMBER) == [Way(MESH, "A")] * 2


@pytest.mark.parametrize("later", "ABC")
def test_a_broker_that_knows_only_its_number_gives_the_robot_its_name_once_that_is_known(later: str) -> None:
    """The configuration of A names 0x12; B hears 0x12, and one of the brokers starts last."""
    mesh = Simulation([name for name in "ABC" if name != later], bindings=pinned("A", number=NUMBER))
    mesh.run(1)
    if later == "B":
        mesh.start("B")
    hear_number(mesh.stations["B"])
    mesh.run(0.1)
    if later not in mesh.stations:
        mesh.start(later)
    mesh.run(2)
    for _ in range(10):
        hear_number(mesh.stations["B"])
        mesh.run(0.3)
    for name, way in {"A": Way(MESH, "B"), "B": Way(RADIO), "C": Way(MESH, "B")}.items():
        assert routes_to(mesh.stations[name], MNERIM, NUMBER) == [way] * 2, name
    assert mesh.owner("MNERIM") == "B"
    before = mesh.sent["token"]
    mesh.run(4)
    assert mesh.sent["token"] == before


def hear_number(station: Station) -> None:
    """A packet of bytes from 0x12 comes by the broker's radio, which in truth speaks words."""
    from psiu_broker.codecs import psiu_hexa  # noqa: PLC0415

    packet = psiu_hexa.packet(NUMBER, Address.numbered(1), b"")
    station.router.route(packet, Way(RADIO), station.now)


def test_two_configurations_that_name_one_number_differently_do_not_dispute_it_for_ever() -> None:
    bindings = {
        "A": (Binding(MNERIM, NUMBER, Way(RADIO), "psiu-ascii"),),
        "B": (Binding(Address.named("BRACO"), NUMBER, Way(RADIO), "psiu-ascii"),),
    }
    mesh = Simulation("ABC", bindings=bindings)
    mesh.run(2)
    withdrawn: list[Address] = []
    gone = mesh.stations["C"]._gone
    mesh.stations["C"].router.table._withdrawn = lambda route: (withdrawn.append(route.robot), gone(route))  # type: ignore[func-returns-value]
    mesh.run(10)
    assert withdrawn == []
    assert mesh.owner("MNERIM") == "A"
    assert mesh.owner("BRACO") == "B"


def test_a_configured_robot_is_announced_before_it_speaks() -> None:
    mesh = Simulation("ABC", bindings=pinned("A"))
    mesh.run(1)
    assert mesh.owner("MNERIM") == "A"
    assert mesh.transmitted(commanded(mesh)) == 1


def test_a_configured_robot_stays_where_it_is_heard_though_others_hear_it_too() -> None:
    mesh = Simulation("ABC", bindings=pinned("A"))
    mesh.run(1)
    assert changes_of_owner(mesh, "MNERIM", "AB", 30) == 0
    assert mesh.owner("MNERIM") == "A"


@pytest.mark.parametrize("names", ["A", "AB", "ABC"])
def test_a_configured_robot_that_drives_off_is_followed_and_published_once(names: str) -> None:
    mesh = Simulation("ABC", bindings=pinned(*names))
    mesh.run(1)
    for place in "ABA":
        mesh.talks("MNERIM", place, 4)
        assert mesh.owner("MNERIM") == place
        assert mesh.transmitted(commanded(mesh)) == 1
        assert mesh.stations[place].antennas[RADIO].wires[-1].startswith(b"MNERIM")
        said = mesh.talks("MNERIM", place, 2)
        mesh.run(0.1)
        assert [mesh.published(data) for data in said] == [1] * len(said)
    mesh.kill("A")
    mesh.run(3)
    if names != "A":
        assert mesh.owner("MNERIM") in set(names) - {"A"}


def test_a_robot_configured_at_both_brokers_of_one_radio_has_one_owner() -> None:
    mesh = Simulation("ABC", bindings=pinned("A", "B"))
    mesh.run(1)
    mesh.talks("MNERIM", "AB", 2)
    assert changes_of_owner(mesh, "MNERIM", "AB", 60) == 0
    said = mesh.talks("MNERIM", "AB", 2)
    mesh.run(0.1)
    assert [mesh.published(data) for data in said] == [1] * len(said)
    assert mesh.transmitted(commanded(mesh)) == 1


def test_a_configured_robot_whose_broker_for_the_moment_died_is_at_home_again() -> None:
    mesh = Simulation("ABC", bindings=pinned("A"))
    mesh.run(1)
    mesh.talks("MNERIM", "B", 2)
    assert mesh.owner("MNERIM") == "B"
    mesh.kill("B")
    mesh.run(1)
    assert mesh.owner("MNERIM") == "A"
    route = mesh.stations["A"].route("MNERIM")
    assert route is not None
    assert route.way == Way(RADIO)

"""Which robots are claimed and where routes lead, beyond what `test_mesh` promises of several brokers together."""

import pytest
from mesh.simulated import RADIO, WIFI, Simulation


@pytest.fixture
def mesh() -> Simulation:
    """Two brokers; MNERIM is a robot at A."""
    mesh = Simulation("AB")
    mesh.run(2)
    mesh.talks("MNERIM", "A", 1)
    assert mesh.owner("MNERIM") == "A"
    return mesh


def test_a_link_that_hears_a_little_better_or_worse_by_turns_changes_no_claim(mesh: Simulation) -> None:
    before = mesh.sent["token"]
    for turn in range(20):
        mesh.stations["A"].quality[RADIO] = 10 - turn % 2
        mesh.talks("MNERIM", "A", 1)
    assert mesh.sent["token"] == before
    mesh.stations["A"].quality[RADIO] = 8
    mesh.talks("MNERIM", "A", 1)
    assert mesh.sent["token"] == before + 1


def test_a_robot_that_was_given_is_not_taken_back_while_the_other_broker_takes_it(mesh: Simulation) -> None:
    """The other's claim needs half a second to come."""
    mesh.delay_of["token"] = 0.5
    mesh.says("MNERIM", "B", "PC", "cheguei")
    mesh.run_until(lambda: mesh.stations["A"].owner("MNERIM") is None, 1.0)
    seen = set()
    while mesh.stations["A"].owner("MNERIM") != "B":
        mesh.run(0.01)
        seen.add(mesh.stations["A"].owner("MNERIM"))
    assert seen == {None, "B"}
    assert mesh.stations["A"].route("MNERIM") is not None, "what is said to it meanwhile goes where it went"


def test_a_robot_that_was_given_and_that_nobody_took_is_looked_for_where_it_was(mesh: Simulation) -> None:
    mesh.says("MNERIM", "B", "PC", "cheguei")
    mesh.run(0.2)
    mesh.stations["B"].unplug(RADIO)
    mesh.run(0.2)
    assert mesh.stations["A"].owner("MNERIM") is None
    mesh.run(2)
    assert mesh.owner("MNERIM") == "A"


def test_a_robot_on_two_links_of_one_broker_is_claimed_once(mesh: Simulation) -> None:
    mesh.says("MNERIM", "A", "PC", "oi")
    mesh.says("MNERIM", "A", "PC", "de novo", link=WIFI)
    mesh.run(1)
    [claim] = mesh.stations["A"].mesh.claims.of("A").values()
    assert claim.link == WIFI
    assert mesh.owner("MNERIM") == "A"


def test_a_broker_that_lost_its_own_session_says_of_no_robot_that_it_is_gone(mesh: Simulation) -> None:
    mesh.partition("A", "B")
    mesh.reopen("B")
    mesh.run(5)
    assert mesh.stations["B"].owner("MNERIM") is None
    assert mesh.stations["B"].orphans == []

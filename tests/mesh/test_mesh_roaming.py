"""Robots that move from broker to broker, or are heard by two at once."""

import pytest
from mesh.scenes import changes_of_owner, commanded
from mesh.simulated import RADIO, WIFI, Simulation

from psiu_broker.frame import MESH, Address, Way


def test_a_robot_that_moved_is_owned_by_the_new_broker_within_a_second_of_its_first_frame(mesh: Simulation) -> None:
    gone: list[Address] = []
    mesh.says("MNERIM", "B", "PC", "cheguei")
    assert mesh.run_until(lambda: mesh.owner("MNERIM") == "B", 1.0) <= 1.0
    for name in "AC":
        route = mesh.stations[name].route("MNERIM")
        assert route is not None
        assert route.way == Way(MESH, "B"), "the old route is withdrawn"
    command = commanded(mesh)
    assert mesh.stations["B"].antennas[RADIO].wires.count(command) == 1
    assert mesh.transmitted(command) == 1
    assert gone == []
    mesh.run(30)
    assert mesh.owner("MNERIM") == "B"
    mesh.balances()


@pytest.mark.parametrize("moment", [0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.39])
@pytest.mark.parametrize("old", ["killed", "cut", "stopped"])
def test_the_old_broker_may_be_dead_cut_off_or_busy(old: str, moment: float) -> None:
    """Whenever between two beats it happens, and though the robot says one thing only."""
    mesh = Simulation("ABC", seed=int(moment * 100))
    mesh.run(2)
    mesh.talks("MNERIM", "A", 1 + moment)
    if old == "killed":
        mesh.kill("A")
    elif old == "cut":
        mesh.partition("A", "BC")
    else:
        mesh.stop("A")
    mesh.says("MNERIM", "B", "PC", "cheguei")
    others = [mesh.stations[name] for name in "BC"]
    took_s = mesh.run_until(lambda: all(it.owner("MNERIM") == "B" for it in others), 1.1)
    assert took_s <= 1.05
    if old == "stopped":
        mesh.resume("A")
    mesh.heal()
    mesh.run(3)
    assert mesh.owner("MNERIM") == "B"
    mesh.balances()


def test_a_robot_that_says_the_same_all_the_time_is_handed_over_as_quickly(mesh: Simulation) -> None:
    for _ in range(20):
        mesh.says("MNERIM", "A", "PC", "vivo")
        mesh.run(0.5)
    mesh.says("MNERIM", "B", "PC", "vivo")
    assert mesh.run_until(lambda: mesh.owner("MNERIM") == "B", 1.0) <= 1.0


def test_a_robot_that_drives_on_and_back_is_followed_each_time(mesh: Simulation) -> None:
    for place in "BCBA":
        mesh.talks("MNERIM", place, 20, every_s=0.5)
        assert mesh.owner("MNERIM") == place
    assert not any(it.ownership.conflicts for it in mesh.stations.values())


def test_where_it_was_does_not_keep_frames_from_where_it_is(mesh: Simulation) -> None:
    """Another robot on the radio that it left speaks to it."""
    mesh.says("MNERIM", "B", "PC", "cheguei")
    mesh.run(1)
    command = mesh.says("IRMAO", "A", "MNERIM", "vem")
    mesh.run(0.1)
    assert mesh.stations["B"].antennas[RADIO].wires.count(command) == 1


def test_a_robot_that_moved_and_vanished_there_is_not_thought_to_be_where_it_was(mesh: Simulation) -> None:
    mesh.says("MNERIM", "B", "PC", "cheguei")
    mesh.run(1)
    mesh.stations["B"].unplug(RADIO)
    mesh.run(3)
    assert mesh.owner("MNERIM") is None
    assert mesh.stations["A"].route("MNERIM") is None


def test_two_brokers_that_hear_the_robot_arrive_do_not_both_keep_it(mesh: Simulation) -> None:
    mesh.start("D")
    mesh.run(1)
    said = mesh.talks("MNERIM", "BCD", 5)
    assert mesh.owner("MNERIM") in ("B", "C", "D")
    assert sum(mesh.published(data) for data in said[5:]) == len(said[5:])
    owner = mesh.owner("MNERIM")
    mesh.talks("MNERIM", "BCD", 60, every_s=0.5)
    assert mesh.owner("MNERIM") == owner
    assert not any(it.ownership.conflicts for it in mesh.stations.values())


def test_of_two_brokers_on_one_radio_one_owns_the_robot_publishes_it_and_commands_it(mesh: Simulation) -> None:
    assert changes_of_owner(mesh, "MNERIM", "AB", 120) == 0
    assert mesh.owner("MNERIM") == "A"
    said = mesh.talks("MNERIM", "AB", 2)
    mesh.run(0.1)
    for data in said:
        assert mesh.published(data) == 1
        assert mesh.stations["C"].antennas[WIFI].wires.count(data) == 1
    for broker in "ABC":
        assert mesh.transmitted(commanded(mesh, broker)) == 1
    assert not any(it.ownership.conflicts for it in mesh.stations.values())
    mesh.balances()


@pytest.mark.parametrize("every_s", [0.2, 1.0, 3.0])
def test_a_frame_that_the_owner_misses_now_and_then_changes_nothing(mesh: Simulation, every_s: float) -> None:
    changes = 0
    for _ in range(10):
        changes += changes_of_owner(mesh, "MNERIM", "AB", 3 * every_s, every_s)
        mesh.says("MNERIM", "B", "PC", "aqui", str(mesh.now))
        mesh.run(every_s)
    assert changes == 0
    assert mesh.owner("MNERIM") == "A"
    assert not any(it.ownership.conflicts for it in mesh.stations.values())


def test_a_broker_that_hears_clearly_better_for_a_while_gets_the_robot_once(mesh: Simulation) -> None:
    mesh.stations["A"].quality[RADIO] = 7
    assert changes_of_owner(mesh, "MNERIM", "AB", 2) == 0
    assert changes_of_owner(mesh, "MNERIM", "AB", 120) == 1
    assert mesh.owner("MNERIM") == "B"


def test_a_broker_that_hears_better_for_a_moment_does_not(mesh: Simulation) -> None:
    for _ in range(10):
        mesh.stations["A"].quality[RADIO] = 7
        assert changes_of_owner(mesh, "MNERIM", "AB", 2) == 0
        mesh.stations["A"].quality[RADIO] = 9
        assert changes_of_owner(mesh, "MNERIM", "AB", 1) == 0


def test_what_the_other_broker_brings_sooner_than_our_own_radio_is_published_all_the_same(mesh: Simulation) -> None:
    """B hears the frame and hands it on to A, whose own serial line is slower."""
    mesh.says("OUTRO", "A", "PC", "oi")
    mesh.run(1)
    said = mesh.says("MNERIM", "B", "OUTRO", "oi")
    mesh.run(0.05)
    mesh.says("MNERIM", "A", "OUTRO", "oi")
    mesh.run(0.1)
    assert mesh.published(said) == 1
    assert mesh.owner("MNERIM") == "A"

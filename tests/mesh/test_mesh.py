"""What several brokers promise together, over a simulated network; times are the simulation's."""

from collections.abc import Callable

import pytest
from mesh.scenes import MNERIM, commanded
from mesh.simulated import RADIO, WIFI, Simulation, Station, wire

from psiu_broker.codecs import psiu_ascii
from psiu_broker.frame import MESH, Address, Frame, Way
from psiu_broker.routing.router import SELF


@pytest.mark.parametrize("broker", "ABC")
def test_a_frame_for_a_robot_reaches_it_once_whichever_broker_hears_it(mesh: Simulation, broker: str) -> None:
    command = commanded(mesh, broker)
    assert mesh.transmitted(command) == 1
    assert mesh.stations["A"].antennas[RADIO].wires.count(command) == 1
    assert mesh.published(command) == 1
    mesh.balances()


def test_what_a_robot_says_reaches_a_program_at_another_broker_once_and_is_published_once(mesh: Simulation) -> None:
    said = mesh.talks("MNERIM", "A", 2, to="PC")
    mesh.run(0.1)
    for data in said:
        assert mesh.stations["C"].antennas[WIFI].wires.count(data) == 1
        assert mesh.published(data) == 1
    mesh.balances()


def test_a_robot_that_nobody_knows_is_asked_for_at_every_broker_and_found(mesh: Simulation) -> None:
    command = mesh.says("PC", "C", "OUTRO", "parafrente", "1", link=WIFI)
    mesh.run(0.1)
    assert all(any(b"OUTRO" in each for each in it.antennas[RADIO].wires) for it in mesh.stations.values())
    mesh.says("OUTRO", "B", "C", "qualseunome")
    mesh.run(0.3)
    assert mesh.stations["B"].antennas[RADIO].wires.count(command) == 1
    assert mesh.transmitted(command) == 1
    mesh.run(5)
    mesh.balances()


def test_a_question_to_everyone_is_heard_once_on_every_radio(mesh: Simulation) -> None:
    question = mesh.says("PC", "C", "??", "qualseunome", link=WIFI)
    mesh.run(1)
    assert [it.antennas[RADIO].wires.count(question) for it in mesh.stations.values()] == [1, 1, 1]
    assert mesh.sent["frame"] < 40
    mesh.balances()


def test_frames_lost_between_brokers_are_counted_where_they_did_not_arrive(mesh: Simulation) -> None:
    lost = iter([True, False, True, False, False])
    mesh.loses = lambda kind, *_: kind == "frame" and next(lost)
    commands = [commanded(mesh) for _ in range(5)]
    assert [mesh.transmitted(command) for command in commands] == [0, 1, 0, 1, 1]
    neighbour = mesh.stations["A"].neighbours.find("C")
    assert neighbour is not None
    assert (neighbour.lost, neighbour.doubles) == (2, 0)
    there = mesh.stations["C"].neighbours.find("A")
    assert there is not None
    assert there.sent[1] == neighbour.received[1].received + neighbour.lost
    mesh.balances()


def test_a_frame_that_waited_in_a_stopped_broker_moves_no_robot_later(mesh: Simulation) -> None:
    mesh.stop("A")
    command = mesh.says("PC", "C", "MNERIM", "parafrente", "100", link=WIFI)
    mesh.run(3)
    mesh.resume("A")
    mesh.run(1)
    assert mesh.transmitted(command) == 0
    assert mesh.stations["A"].exchange.accounts[MESH].fates["expired"] == 1
    mesh.balances()


@pytest.fixture
def ages(mesh: Simulation) -> list[float]:
    """How old the frames were said to be that came to B."""
    ages: list[float] = []
    relayed = mesh.stations["B"].relayed

    def note(frame: Frame, way: Way, now: float, age_s: float) -> object:
        ages.append(age_s)
        return relayed(frame, way, now, age_s)

    mesh.stations["B"].relayed = note  # type: ignore[method-assign]
    return ages


def test_a_frame_that_waited_until_its_robot_was_found_is_said_to_be_so_old(
    mesh: Simulation, ages: list[float]
) -> None:
    command = mesh.says("PC", "C", "OUTRO", "parafrente", "1", link=WIFI)
    mesh.run(0.4)
    ages.clear()
    mesh.says("OUTRO", "B", "C", "oi")
    mesh.run(0.1)
    assert mesh.transmitted(command) == 1
    assert ages == [pytest.approx(0.4, abs=0.05)]


@pytest.mark.parametrize(("patience_s", "age_s"), [(0.5, 1.5), (2.0, 0.0), (10.0, 0.0), (float("inf"), 0.0)])
def test_another_broker_waits_no_longer_than_who_sends_would(
    mesh: Simulation, ages: list[float], patience_s: float, age_s: float
) -> None:
    station = mesh.stations["A"]
    frame = psiu_ascii.message(Address.named("A"), MNERIM, "parafrente", "1")
    assert station.mesh.offer(frame, "B", SELF, station.now, patience_s) == "delivered"
    mesh.run(0.1)
    assert ages == [pytest.approx(age_s, abs=0.01)]


def test_frames_and_tokens_are_few_where_nothing_happens(mesh: Simulation) -> None:
    mesh.run(200)
    mesh.sent.clear()
    mesh.run(60)
    assert set(mesh.sent) == {"beat"}
    assert mesh.sent["beat"] <= 3 * 2 * 60 / 0.4 + 6


def test_the_robots_of_a_broker_that_leaves_vanish_at_once(mesh: Simulation) -> None:
    mesh.leave("A")
    mesh.run(0.1)
    assert mesh.owners("MNERIM") == {"B": None, "C": None}
    assert mesh.stations["B"].route("MNERIM") is None
    mesh.run(2)
    assert [it.orphans for it in mesh.stations.values()] == [[MNERIM], []], "one of the others says so"


def test_the_robots_of_a_broker_that_is_cut_off_vanish_within_its_lease(mesh: Simulation) -> None:
    mesh.partition("A", "BC")
    mesh.run(2.1)
    assert mesh.owners("MNERIM") == {"A": "A", "B": None, "C": None}
    mesh.heal()
    mesh.run(1)
    assert mesh.owner("MNERIM") == "A"
    assert mesh.transmitted(commanded(mesh)) == 1
    mesh.balances()


def test_after_a_partition_the_series_of_frames_go_on(mesh: Simulation) -> None:
    for _ in range(3):
        assert mesh.transmitted(commanded(mesh)) == 1
        mesh.partition("A", "BC")
        commanded(mesh)
        mesh.run(5)
        mesh.heal()
        mesh.run(1)
    assert mesh.transmitted(commanded(mesh)) == 1
    neighbour = mesh.stations["A"].neighbours.find("C")
    assert neighbour is not None
    assert (neighbour.lost, neighbour.doubles) == (3, 0)
    mesh.balances()


@pytest.mark.parametrize("broker", "AC")
def test_a_new_session_begins_new_series(mesh: Simulation, broker: str) -> None:
    for _ in range(5):
        commanded(mesh)
    mesh.reopen(broker)
    mesh.run(1)
    mesh.says("PC", "C", "C", "oi", link=WIFI)
    mesh.says("MNERIM", "A", "PC", "oi")
    mesh.run(0.1)
    command = commanded(mesh)
    assert mesh.transmitted(command) == 1
    neighbour = mesh.stations["A"].neighbours.find("C")
    assert neighbour is not None
    assert (neighbour.lost, neighbour.doubles) == (0, 0)
    mesh.balances()


def test_a_frame_for_a_former_life_moves_no_robot(mesh: Simulation) -> None:
    mesh.delay_of["frame"] = 0.3
    command = mesh.says("PC", "C", "MNERIM", "parafrente", "1", link=WIFI)
    mesh.reopen("A")
    mesh.run(1)
    assert mesh.transmitted(command) == 0
    assert mesh.stations["A"].exchange.accounts[MESH].fates["refused"] == 1
    mesh.balances()


def test_a_robot_that_moved_while_the_network_was_parted_is_where_it_is_heard(mesh: Simulation) -> None:
    mesh.partition("A", "BC")
    mesh.run(3)
    mesh.talks("MNERIM", "B", 5)
    mesh.talks("MNERIM", "A", 5)
    mesh.heal()
    mesh.run(0.5)
    mesh.says("MNERIM", "A", "PC", "oi")
    mesh.run(1)
    assert mesh.owner("MNERIM") == "A"


def test_a_killed_broker_that_returns_has_its_robots_again(mesh: Simulation) -> None:
    for _ in range(3):
        mesh.kill("A")
        mesh.run(0.7)
        mesh.start("A")
        mesh.run(0.5)
        mesh.says("MNERIM", "A", "PC", "oi")
        mesh.run(0.1)
        assert mesh.owner("MNERIM") == "A"
        assert mesh.transmitted(commanded(mesh)) == 1
    mesh.balances()


def test_a_link_that_fails_withdraws_its_robots_everywhere(mesh: Simulation) -> None:
    mesh.stations["A"].unplug(RADIO)
    mesh.run(0.1)
    assert mesh.owner("MNERIM") is None
    mesh.stations["A"].plug(RADIO)
    mesh.says("MNERIM", "A", "PC", "oi")
    mesh.run(0.1)
    assert mesh.owner("MNERIM") == "A"


def test_a_computer_that_slept_holds_nobody_for_silent(mesh: Simulation) -> None:
    """All brokers sleep; nobody was there to notice."""
    for name in mesh.stations:
        mesh.stop(name)
    for station in mesh.stations.values():
        station.waiting.clear()
    mesh.run(60)
    for name in mesh.stations:
        mesh.resume(name)
    mesh.run(10)
    assert mesh.declared_anew == 0
    assert mesh.owner("MNERIM") == "A"


@pytest.mark.parametrize(
    "spoil",
    [
        lambda it: it.mesh.frame_came("A", 1, b"", it.now),
        lambda it: it.mesh.frame_came("A", 1, b"\x01" * 200, it.now),
        lambda it: it.mesh.frame_came("nobody", 1, wire("A", "B", "x"), it.now),
    ],
)
def test_what_is_no_frame_for_us_is_counted_and_dropped(mesh: Simulation, spoil: Callable[[Station], None]) -> None:
    station = mesh.stations["B"]
    before = station.exchange.accounts[MESH].arrived
    spoil(station)
    assert station.exchange.accounts[MESH].arrived == before + 1
    mesh.balances()


def test_a_frame_that_the_bus_does_not_take_is_not_called_delivered() -> None:
    simulation = Simulation(("base1", "base2"))
    simulation.says("PC", ["base1"], "base1", "qualseunome", link=WIFI)
    simulation.says("MNERIM", ["base2"], "base2", "qualseunome")
    simulation.run(1.0)
    simulation.session("base1").refuses = True
    simulation.says("PC", ["base1"], "MNERIM", "parafrente", "1", link=WIFI)
    simulation.run(0.1)
    assert simulation.stations["base1"].exchange.accounts[WIFI].fates["link_down"] == 1
    simulation.session("base1").refuses = False
    said = simulation.says("PC", ["base1"], "MNERIM", "parafrente", "2", link=WIFI)
    simulation.run(2.0)
    assert simulation.transmitted(said) == 1
    assert [each.lost for each in simulation.stations["base2"].neighbours] == [0], "nothing was counted as sent"
    simulation.balances()

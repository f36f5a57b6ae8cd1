"""What several brokers promise together, over a simulated network; times are the simulation's."""

import itertools
from collections.abc import Callable

import pytest
from mesh.simulated import RADIO, TICK_S, WIFI, Simulation, Station, wire

from psiu_broker.codecs import psiu_ascii
from psiu_broker.frame import MESH, Address, Frame, Way
from psiu_broker.mesh.beat import Beat, Notice
from psiu_broker.mesh.mesh import ASKED_S, FORMER_MAX
from psiu_broker.mesh.neighbour import ALIVE_S
from psiu_broker.routing.claims import Claim
from psiu_broker.routing.router import SELF
from psiu_broker.routing.table import Binding

MNERIM = Address.named("MNERIM")
NUMBER = Address.numbered(0x12)


@pytest.fixture
def mesh() -> Simulation:
    """Three brokers; PC is a program at C, MNERIM a robot at A."""
    mesh = Simulation("ABC")
    mesh.run(2)
    mesh.says("PC", "C", "C", "oi", link=WIFI)
    mesh.talks("MNERIM", "A", 1)
    assert mesh.owner("MNERIM") == "A"
    return mesh


def commanded(mesh: Simulation, at: str = "C") -> bytes:
    """A program says something new to MNERIM."""
    command = mesh.says(f"PC{at}", at, "MNERIM", "parafrente", str(int(mesh.now * 1000) % 10**9), link=WIFI)
    mesh.run(0.1)
    return command


# Frames.


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


# Roaming.


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


# One radio, heard by two brokers.


def changes_of_owner(mesh: Simulation, robot: str, at: str, seconds: float, every_s: float = 0.2) -> int:
    owners = []
    until = mesh.now + seconds
    while mesh.now < until:
        mesh.talks(robot, at, every_s, every_s)
        owners.append(mesh.stations[at[0]].owner(robot))
    return sum(one != other for one, other in itertools.pairwise(owners))


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


# Two robots of one name.


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


# Brokers come and go.


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


# The lives of a broker: Zenoh may tell of a new one before the old one is gone.


@pytest.fixture
def alone() -> Station:
    return Simulation("Z").stations["Z"]


def life_of_a(station: Station) -> int | None:
    neighbour = station.neighbours.find("A")
    return None if neighbour is None else neighbour.epoch


def beat_of_a(station: Station, epoch: int) -> None:
    station.mesh.beat_came(Beat(broker="A", epoch=epoch, sent_us=0), station.now)


def test_a_broker_that_lives_is_not_displaced_by_an_announcement_alone(alone: Station) -> None:
    alone.mesh.broker_came("A", 5, "old", "0", alone.now)
    alone.mesh.broker_came("A", 6, "new", "0", alone.now)
    assert life_of_a(alone) == 5
    beat_of_a(alone, 6)
    assert life_of_a(alone) == 6


def test_a_broker_that_fell_silent_is_displaced_by_its_next_announcement_and_not_by_an_older_one(
    alone: Station,
) -> None:
    alone.mesh.broker_came("A", 5, "old", "0", alone.now)
    later = alone.now + ALIVE_S + 0.1
    alone.mesh.broker_came("A", 4, "older", "0", later)
    assert life_of_a(alone) == 5
    alone.mesh.broker_came("A", 6, "new", "0", later)
    assert life_of_a(alone) == 6


def test_when_one_life_goes_the_next_is_there_at_once(alone: Station) -> None:
    alone.mesh.broker_came("A", 5, "old", "0", alone.now)
    alone.mesh.broker_came("A", 6, "new", "0", alone.now)
    alone.mesh.broker_went("A", 5, "0", alone.now)
    assert life_of_a(alone) == 6
    alone.mesh.broker_went("A", 6, "0", alone.now)
    assert life_of_a(alone) is None


def test_what_a_former_life_claimed_is_not_the_new_one_s(alone: Station) -> None:
    alone.mesh.broker_came("A", 5, "old", "0", alone.now)
    alone.mesh.claimed("A", 5, Claim(MNERIM, None, "psiu-ascii", RADIO, 1, 10, 0), alone.now)
    alone.mesh.broker_came("A", 6, "new", "0", alone.now)
    assert alone.owner("MNERIM") == "A"
    beat_of_a(alone, 6)
    assert alone.owner("MNERIM") is None
    assert alone.route("MNERIM") is None


def test_memory_of_those_who_went_is_bounded(alone: Station) -> None:
    for epoch in range(FORMER_MAX + 50):
        alone.mesh.broker_came("A", epoch, "id", "0", alone.now)
        alone.mesh.broker_went("A", epoch, "0", alone.now)
    assert len(alone.mesh._former) == FORMER_MAX


def test_who_comes_hears_of_us_at_once(mesh: Simulation) -> None:
    before = mesh.beat
    mesh.run_until(lambda: mesh.beat is not before and mesh.beat is not None and mesh.beat.broker == "B", 1.0)
    newest = mesh.beat
    mesh.loses = lambda *_: True
    station = mesh.stations["B"]
    station.mesh.broker_came("D", 5, "id", "0", station.now)
    began = mesh.now
    mesh.run_until(lambda: mesh.beat is not newest and mesh.beat is not None and mesh.beat.broker == "B", 1.0)
    assert mesh.now - began <= TICK_S + 0.02


# Lost messages.


@pytest.mark.parametrize(
    "ask",
    [
        lambda it: it.mesh.beat_came(Beat(broker="A", epoch=5, sent_us=0, unseen=["Z"]), it.now),
        lambda it: it.mesh.notice_came(Notice(broker="A"), it.now),
    ],
)
def test_everything_is_declared_anew_for_a_broker_that_asks_for_it(ask: Callable[[Station], None]) -> None:
    mesh = Simulation("Z")
    station = mesh.stations["Z"]
    mesh.run(2)
    station.mesh.broker_came("A", 5, "id", "0", station.now)
    ask(station)
    assert mesh.declared_anew == 1


def test_a_broker_that_does_not_answer_is_asked_seldom_what_it_claims() -> None:
    mesh = Simulation("Z")
    station = mesh.stations["Z"]
    station.mesh.broker_came("A", 5, "id", "0", station.now)
    begun = mesh.now
    while mesh.now - begun < 7 * ASKED_S:
        told = Beat(broker="A", epoch=5, sent_us=int(mesh.now * 1e6), heard={"Z": (0, 0)}, claims="of others")
        station.mesh.beat_came(told, station.now)
        mesh.run(0.4)
    assert 4 <= mesh.sent["notice"] <= 7


@pytest.mark.parametrize("kind", ["token", "untoken", "beat", "notice", "any"])
@pytest.mark.parametrize("seed", range(3))
def test_whatever_is_lost_for_a_while_heals_by_itself_within_seconds(kind: str, seed: int) -> None:
    mesh = Simulation("ABCD", seed=seed)
    mesh.run(2)
    lost = iter(range(10**6))
    mesh.loses = lambda which, *_: which != "frame" and kind in (which, "any") and (next(lost) + seed) % 2 == 0
    for place in "ABCA":
        mesh.talks("MNERIM", place, 2)
        mesh.talks("OUTRO", "D", 0.5)
    mesh.loses = lambda *_: False
    mesh.talks("MNERIM", "A", 12)
    assert mesh.disagreements(["MNERIM", "OUTRO"]) == []
    assert mesh.owner("MNERIM") == "A"
    if seed:
        return
    mesh.run(130)  # claims grow older: what was withdrawn unseen comes to light
    before = mesh.declared_anew
    mesh.run(60)
    assert mesh.declared_anew == before, "and then there is rest"


@pytest.mark.parametrize("kind", ["token", "untoken", "notice"])
def test_one_lost_message_of_a_handover_costs_seconds_only(kind: str) -> None:
    mesh = Simulation("ABC")
    mesh.run(2)
    mesh.talks("MNERIM", "A", 1)
    lost = iter([True])
    mesh.loses = lambda which, *_: which == kind and next(lost, False)
    mesh.talks("MNERIM", "B", 6)
    assert mesh.owner("MNERIM") == "B"


def test_a_lost_notice_of_a_single_frame_is_repeated(mesh: Simulation) -> None:
    lost = iter([True])
    mesh.loses = lambda kind, *_: kind == "notice" and next(lost, False)
    mesh.says("MNERIM", "B", "PC", "cheguei")
    mesh.run(2)
    assert mesh.owner("MNERIM") == "B"


@pytest.mark.parametrize("reborn", "AB")
def test_a_notice_from_or_for_a_former_life_gives_no_robot_away(mesh: Simulation, reborn: str) -> None:
    """It comes when the robot is back at A, whose session or the teller's is another by then."""
    mesh.delay_of["notice"] = 3.0
    mesh.says("MNERIM", "B", "PC", "cheguei")
    del mesh.delay_of["notice"]
    mesh.reopen(reborn)
    mesh.talks("MNERIM", "A", 2)
    assert mesh.owner("MNERIM") == "A"
    until = mesh.now + 4
    while mesh.now < until:
        mesh.run(0.1)
        assert mesh.owners("MNERIM") == {"A": "A", "B": "A", "C": "A"}


def test_a_broker_that_nobody_sees_announces_itself_anew() -> None:
    mesh = Simulation("AB")
    mesh.run(2)
    mesh.loses = lambda kind, *_: kind == "token"
    station = mesh.start("C")
    mesh.run(1)
    assert not list(station.neighbours)
    mesh.loses = lambda *_: False
    mesh.run(8)
    assert {each.name for each in station.neighbours} == {"A", "B"}
    assert {each.name for each in mesh.stations["A"].neighbours} == {"B", "C"}


def test_claims_that_come_before_their_broker_count_once_it_is_there(mesh: Simulation) -> None:
    station = mesh.stations["B"]
    claims = list(mesh.stations["A"].mesh.claims.of("A").values())
    epoch = mesh.stations["A"].mesh.epoch
    other = Simulation("Z").stations["Z"]
    for claim in claims:
        other.mesh.claimed("A", epoch, claim, other.now)
    assert other.owner("MNERIM") is None
    other.mesh.broker_came("A", epoch, "zid", "0", other.now)
    assert other.owner("MNERIM") == "A"
    assert other.route("MNERIM") is not None
    assert station.owner("MNERIM") == "A"


def test_a_healthy_mesh_never_declares_anew() -> None:
    mesh = Simulation("ABCDE", delay_s=0.1)
    mesh.run(1)
    for second in range(300):
        mesh.says("MNERIM", "A", "PC", "oi", str(second))
        mesh.says("OUTRO", "B", "PC", "oi", str(second)) if second % 7 == 0 else None
        mesh.says("RARO", "C", "PC", "oi", str(second)) if second % 40 == 0 else None
        mesh.run(1)
    assert mesh.declared_anew == 0


# Robots of the configuration.


def pinned(*names: str, number: Address | None = None) -> dict[str, tuple[Binding, ...]]:
    return {name: (Binding(MNERIM, number, Way(RADIO), "psiu-ascii"),) for name in names}


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


# Names and numbers.


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


# Hostile brokers.


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

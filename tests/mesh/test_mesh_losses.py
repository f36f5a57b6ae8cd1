"""What heals by itself after messages between brokers were lost."""

from collections.abc import Callable

import pytest
from mesh.simulated import Simulation, Station

from psiu_broker.mesh.beat import Beat, Notice
from psiu_broker.mesh.mesh import ASKED_S


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

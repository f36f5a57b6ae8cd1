"""What is done where brokers have lost sight of one another, step by step."""

import pytest

from psiu_broker.mesh.beat import Beat, Notice
from psiu_broker.mesh.bus import NoBus
from psiu_broker.mesh.neighbour import BEAT_S, NEWCOMER_S, SILENT_S, STEP_EVERY_S, Neighbour, Neighbours
from psiu_broker.mesh.remedies import ANEW_EVERY_S, CUT_ALL_MAX, DIFFERS_S, STRANGERS_MAX, Remedies


class Bus(NoBus):
    """Notes what is done, and when."""

    def __init__(self) -> None:
        self.linked: set[str] = set()
        self.done: list[str] = []

    def put_notice(self, to: str, notice: Notice) -> None:
        assert notice.frame is None
        self.done.append(f"ask {to}")

    def declare_anew(self) -> None:
        self.done.append("declare anew")

    def hang_up(self, zenoh_id: str | None) -> None:
        self.done.append(f"hang up {zenoh_id}")


class World:
    """A, which is we, and B, which is announced and has said one thing: that it hears us."""

    def __init__(self) -> None:
        self.bus = Bus()
        self.unclear: list[str] = []
        self.neighbours = Neighbours()
        self.remedies = Remedies("A", self.neighbours, lambda neighbour, now: self.unclear.append(neighbour.name))
        self.remedies.attach(self.bus, 0.0)
        self.b = Neighbour("B", 7, "idB", 0.0)
        self.neighbours.add(self.b)
        self.now = 0.0
        self.beat()

    def beat(self, *, hears_us: bool = True, sent: int = 0) -> None:
        """B's beat, which says that it has sent us so many frames."""
        heard = {"A": (int(self.now * 1e6), 0)} if hears_us else {}
        told = {"A": (1, {1: sent})} if sent else {}
        self.b.beat(Beat(broker="B", epoch=7, sent_us=int(self.now * 1e6), heard=heard, sent=told), "A", 1, self.now)

    def stranger(self, name: str = "C") -> None:
        self.remedies.stranger(Beat(broker=name, epoch=7, zenoh_id=f"id{name}", sent_us=0), self.now)

    def run(self, seconds: float, *, beats: bool = False, hears_us: bool = True) -> list[str]:
        """What was done meanwhile."""
        self.bus.done.clear()
        until = self.now + seconds
        while self.now < until:
            self.now += BEAT_S
            if beats:
                self.beat(hears_us=hears_us)
            self.remedies.tick(self.now)
        return self.bus.done


@pytest.fixture
def world() -> World:
    return World()


def test_nothing_is_done_while_everybody_is_heard(world: World) -> None:
    assert world.run(60, beats=True) == []
    assert world.remedies.declared_anew == 0


def test_the_link_to_a_broker_that_fell_silent_is_ended_before_anything_is_declared_that_would_wait_in_it(
    world: World,
) -> None:
    world.bus.linked = {"idB"}
    assert world.run(SILENT_S - BEAT_S) == []
    assert world.run(3 * STEP_EVERY_S) == ["hang up idB", "declare anew", "hang up idB"]


def test_a_silent_broker_without_a_link_is_told_of_us_twice(world: World) -> None:
    world.run(SILENT_S - BEAT_S)
    assert world.run(2 * STEP_EVERY_S) == ["declare anew", "declare anew"]


def test_every_link_is_ended_for_a_silent_broker_without_one_and_twice_at_most(world: World) -> None:
    done = world.run(120)
    assert done.count("hang up None") == CUT_ALL_MAX
    assert done.index("hang up None") == 2
    assert set(done) == {"declare anew", "hang up None"}


def test_for_a_broker_that_is_only_deaf_no_link_of_others_is_ended(world: World) -> None:
    assert set(world.run(60, beats=True, hears_us=False)) == {"declare anew"}


def test_a_trouble_that_is_over_begins_with_the_mildest_remedy_when_it_comes_back(world: World) -> None:
    assert "hang up None" in world.run(10)
    world.run(5, beats=True)
    assert set(world.run(SILENT_S + STEP_EVERY_S)) == {"declare anew"}


def test_nobody_was_silent_while_we_were_asleep(world: World) -> None:
    world.now += 3600
    world.remedies.woke(world.now)
    assert world.run(SILENT_S - BEAT_S) == []
    assert world.run(2 * BEAT_S) == ["declare anew"]


def test_a_broker_that_is_heard_and_not_announced_is_asked_and_said_to_be_unseen(world: World) -> None:
    world.stranger()
    assert world.remedies.unseen(world.now + NEWCOMER_S) == []
    assert world.remedies.unseen(world.now + NEWCOMER_S + 0.1) == ["C"]
    assert world.run(4 * BEAT_S, beats=True) == ["ask C", "declare anew"]
    world.remedies.known("C")
    assert world.remedies.unseen(world.now) == []


def test_a_stranger_that_is_heard_no_more_is_forgotten(world: World) -> None:
    world.stranger()
    world.run(SILENT_S + BEAT_S, beats=True)
    assert world.remedies.unseen(world.now) == []


def test_strangers_are_bounded(world: World) -> None:
    for number in range(STRANGERS_MAX + 50):
        world.stranger(f"S{number}")
    assert len(world.remedies.unseen(world.now + 1)) == STRANGERS_MAX


def test_a_broker_whose_claims_are_not_what_it_says_is_unseen_and_looked_into(world: World) -> None:
    world.b.differs_since = 0.0
    assert world.remedies.unseen(DIFFERS_S) == []
    assert world.remedies.unseen(DIFFERS_S + 0.1) == ["B"]
    world.run(STEP_EVERY_S, beats=True)
    assert world.unclear == ["B"]


def test_everything_is_declared_anew_once_however_many_ask_and_later_when_it_just_was(world: World) -> None:
    for _ in range(5):
        world.remedies.declare_anew(ANEW_EVERY_S / 2, "B does not see all of it")
    assert world.bus.done == [], "all was just declared for the first time"
    assert world.run(10, beats=True) == ["declare anew"]
    assert world.remedies.declared_anew == 1


def test_without_a_bus_nothing_is_done(world: World) -> None:
    world.remedies.detach()
    assert world.run(60) == []


def test_a_broker_whose_beats_come_and_whose_frames_do_not_is_told_of_us_anew(world: World) -> None:
    world.bus.linked = {"idB"}
    done: list[str] = []
    for sent in range(1, 20):
        world.now += 2 * BEAT_S
        world.beat(sent=sent)
        world.remedies.tick(world.now)
        done += world.bus.done
        world.bus.done.clear()
    assert done[:3] == ["declare anew", "declare anew", "hang up idB"]


def test_a_frame_that_is_still_under_way_when_it_is_counted_is_no_trouble(world: World) -> None:
    for sent in range(1, 60):
        world.now += 2 * BEAT_S
        world.beat(sent=sent)
        world.b.take(1, sent)
        world.remedies.tick(world.now)
    assert world.bus.done == []


def test_what_was_lost_of_a_broker_that_sends_no_more_is_forgotten(world: World) -> None:
    for sent in (1, 2, 2, 2, 2, 2, 2, 2):
        world.now += 2 * BEAT_S
        world.beat(sent=sent)
    assert world.run(10, beats=True) == []

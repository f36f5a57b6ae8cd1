"""Each decision by itself; what comes of them among several brokers is in tests/mesh/test_mesh_roaming.py."""

import pytest

from psiu_broker.frame import MESH, Address, Frame, Way
from psiu_broker.routing.claims import Claim
from psiu_broker.routing.ownership import (
    ALTERNATIONS_WITHIN_S,
    BETTER_FOR_S,
    CONFLICT_KEPT_S,
    CONFLICT_QUIET_S,
    MISSES,
    NOTICE_EVERY_S,
    OVERHEARD_MAX,
    RECENT_S,
    REMIND_S,
    SETTLED_S,
    SHARED_FOR_S,
    Ownership,
)
from psiu_broker.routing.table import Route

MNERIM, PC = Address.named("MNERIM"), Address.named("PC")
RADIO = Way("radio")
FRAME = Frame(MNERIM, PC, "oi", b"oi", "psiu-ascii", b"PC oi MNERIM")
AFTER_S = SETTLED_S + 0.01


class World:
    """A is we; B is another broker that lives."""

    def __init__(self) -> None:
        self.alive = {"B", "C"}
        self.heard: dict[object, float] = {}
        self.notices: list[str] = []
        self.ownership = Ownership(
            "A",
            lambda name, _: name in self.alive,
            lambda key, since: self.heard.get(key, -1e9) >= since,
            lambda owner, *_: self.notices.append(owner),
        )
        self.theirs = Route((MNERIM,), Way(MESH, "B"), "psiu-ascii", pinned=False)
        self.ours = Route((MNERIM,), RADIO, "psiu-ascii", pinned=False)
        self.ours.heard_at = 0.0

    def claimed(self, broker: str, term: int = 1) -> None:
        self.ownership.claims.set(broker, Claim(MNERIM, None, "psiu-ascii", "radio", term, 10, 0))

    def takes(self, now: float) -> bool:
        return self.ownership.takes(self.theirs, FRAME, RADIO, now)

    def noticed(
        self, key: object, now: float, better_by: int = 0, broker: str = "B", heard_at: float | None = None
    ) -> bool:
        heard_at = now if heard_at is None else heard_at
        return self.ownership.noticed(self.ours, broker, key, better_by, heard_at, now)

    def due(self, now: float) -> list[str]:
        return [broker for _, broker in self.ownership.due(lambda _: self.ours, now)]


@pytest.fixture
def world() -> World:
    return World()


# We hear a robot that lives at another broker.


def test_a_robot_that_nobody_owns_is_ours(world: World) -> None:
    assert world.takes(0.0)
    assert world.notices == []


def test_the_owner_of_a_robot_that_we_hear_is_told_at_the_first_frame_whatever_the_time(world: World) -> None:
    world.claimed("B")
    for now in (0.0, 1.1, 1000.3, 123456.7, 1e7 + 0.1):
        world.ownership.overheard.clear()
        world.notices.clear()
        assert not world.takes(now)
        assert world.notices == ["B"], now


def test_the_owner_is_told_now_and_then_only(world: World) -> None:
    world.claimed("B")
    for number in range(1000):
        world.takes(number / 100)
    assert len(world.notices) <= 10 / NOTICE_EVERY_S + 1


def test_a_robot_whose_owner_is_silent_is_ours_at_once(world: World) -> None:
    world.claimed("B")
    world.alive.remove("B")
    assert world.takes(0.0)


def test_a_robot_heard_before_its_owner_fell_silent_is_ours_when_that_is_known(world: World) -> None:
    world.claimed("B")
    world.takes(0.0)
    assert world.ownership.abandoned(0.5) == []
    world.alive.remove("B")
    assert world.ownership.abandoned(0.5) == [MNERIM]
    assert world.ownership.abandoned(RECENT_S + 1) == [], "that was too long ago"


def test_what_we_only_had_before_is_not_taken_from_an_owner_that_is_silent_for_a_moment(world: World) -> None:
    world.ownership.remember(world.ours)
    world.claimed("B")
    world.alive.remove("B")
    assert world.ownership.abandoned(0.5) == []
    assert world.ownership.heard_on(MNERIM) is None


def test_a_robot_cannot_be_a_broker(world: World) -> None:
    route = Route((Address.named("B"),), Way(MESH, "B"), "psiu-ascii", pinned=False)
    assert not world.ownership.takes(route, FRAME, RADIO, 0.0)
    world.ownership.overhear(route, FRAME, RADIO, 0.0)
    assert world.ownership.overheard == {}


def test_what_we_overheard_lately_tells_where_the_robot_is(world: World) -> None:
    world.claimed("B")
    world.takes(0.0)
    assert world.ownership.heard_on(MNERIM) == "radio"
    assert world.ownership.recent(MNERIM, RECENT_S) is not None
    assert world.ownership.recent(MNERIM, RECENT_S + 0.1) is None
    world.ownership.expire(RECENT_S + 0.1)
    assert world.ownership.overheard == {}


def test_a_robot_that_fell_silent_is_told_of_once_more(world: World) -> None:
    world.claimed("B")
    world.takes(0.0)
    assert list(world.ownership.reminders(REMIND_S / 2)) == []
    assert list(world.ownership.reminders(REMIND_S)) == [("B", FRAME, RADIO, 0.0)]
    assert list(world.ownership.reminders(2 * REMIND_S)) == []


def test_memory_of_what_was_overheard_is_bounded(world: World) -> None:
    for number in range(OVERHEARD_MAX + 50):
        route = Route((Address.named(f"R{number}"),), Way(MESH, "B"), "psiu-ascii", pinned=False)
        world.ownership.overhear(route, FRAME, RADIO, 0.0)
    assert len(world.ownership.overheard) == OVERHEARD_MAX


# Another broker hears a robot of ours.


def test_a_robot_that_only_the_other_heard_is_given_up_when_our_copy_would_have_come(world: World) -> None:
    assert not world.noticed("frame", 10.0)
    assert world.due(10.0 + SETTLED_S / 2) == []
    assert world.due(10.0 + AFTER_S) == ["B"]
    assert world.due(10.0 + 2 * AFTER_S) == []


def test_a_frame_that_we_heard_too_is_no_reason_and_may_come_a_little_later(world: World) -> None:
    world.noticed("frame", 10.0)
    world.heard["frame"] = 10.2
    assert world.due(10.0 + AFTER_S) == []
    world.heard["next"] = 11.0
    assert not world.noticed("next", 11.1)
    assert world.due(12.0) == []


def test_the_same_words_of_long_before_are_another_frame(world: World) -> None:
    world.heard["frame"] = 5.0
    assert not world.noticed("frame", 10.0)
    assert world.due(10.0 + AFTER_S) == ["B"]


def test_a_robot_that_we_heard_since_is_not_given_up(world: World) -> None:
    world.noticed("frame", 10.0)
    world.ours.heard_at = 10.1
    assert world.due(10.0 + AFTER_S) == []


def test_while_both_hear_one_radio_several_frames_must_be_missed(world: World) -> None:
    world.heard["common"] = 10.0
    world.noticed("common", 10.0)
    for number in range(MISSES - 1):
        world.noticed(f"missed {number}", 11.0 + number / 2)
        assert world.due(11.0 + number / 2 + AFTER_S) == []
    world.noticed("missed too", 13.0)
    assert world.due(13.0 + AFTER_S) == ["B"]


def test_a_missed_frame_counts_once_however_often_it_is_told(world: World) -> None:
    world.heard["common"] = 10.0
    world.noticed("common", 10.0)
    for number in range(MISSES):
        world.noticed("missed", 11.0 + number * REMIND_S, heard_at=11.0 + number / 100)
        assert world.due(11.0 + number * REMIND_S + AFTER_S) == []


def test_the_same_words_missed_several_times_count_each_time(world: World) -> None:
    world.heard["common"] = 10.0
    world.noticed("common", 10.0)
    for number in range(MISSES):
        world.noticed("vivo", 11.0 + number * NOTICE_EVERY_S)
    assert world.due(11.0 + MISSES * NOTICE_EVERY_S) == ["B"]


def test_a_reminder_of_where_the_robot_was_is_no_alternation(world: World) -> None:
    for second in range(1, 3):
        world.ours.heard_at = second - 0.5
        world.noticed(second, float(second))
        world.ours.heard_at = second + 0.2
        world.noticed(second, second + REMIND_S, heard_at=float(second))
    assert world.ownership.conflicts == {}


def test_when_both_heard_it_long_ago_one_frame_is_enough(world: World) -> None:
    world.heard["common"] = 10.0
    world.noticed("common", 10.0)
    world.noticed("far away", 11.0 + SHARED_FOR_S)
    assert world.due(11.0 + SHARED_FOR_S + AFTER_S) == ["B"]


def test_only_who_hears_clearly_better_for_a_while_gets_a_robot_that_both_hear(world: World) -> None:
    yields = []
    for tenth in range(100):
        world.heard[tenth] = now = tenth / 10
        yields.append(world.noticed(tenth, now, better_by=2))
    assert yields.index(True) == pytest.approx(10 * BETTER_FOR_S, abs=1)
    for tenth in range(100, 200):
        world.heard[tenth] = now = tenth / 10
        assert not world.noticed(tenth, now, better_by=1)
        assert not world.noticed(tenth, now, better_by=2 if tenth % 20 < 10 else 0)


def test_robots_of_one_name_that_talk_by_turns_are_a_conflict_and_stay_where_they_are(world: World) -> None:
    for second in range(1, 4):
        world.ours.heard_at = second - 0.5
        world.noticed(second, float(second))
    conflict = world.ownership.conflicts[MNERIM]
    assert conflict.brokers == {"A", "B"}
    assert world.due(3.0 + AFTER_S) == []
    world.noticed("again", 4.0, broker="C")
    assert world.due(3.0 + CONFLICT_QUIET_S) == ["C"], "ours is silent, another is not"


def test_a_robot_that_goes_away_and_stays_is_no_conflict(world: World) -> None:
    for second in range(1, 20):
        world.noticed(second, float(second))
        world.due(second + AFTER_S)
    assert world.ownership.conflicts == {}


def test_a_robot_that_comes_and_goes_seldom_is_no_conflict(world: World) -> None:
    for number in range(1, 6):
        at = number * (ALTERNATIONS_WITHIN_S / 2 + 1)
        world.ours.heard_at = at - 0.5
        world.noticed(number, at)
        world.ownership.expire(at + 1)
    assert world.ownership.conflicts == {}


def test_a_conflict_that_is_over_is_forgotten(world: World) -> None:
    for second in range(1, 4):
        world.ours.heard_at = second - 0.5
        world.noticed(second, float(second))
    world.due(10.0)
    world.ownership.expire(3.0 + CONFLICT_KEPT_S)
    assert MNERIM in world.ownership.conflicts
    world.ownership.expire(3.1 + CONFLICT_KEPT_S + ALTERNATIONS_WITHIN_S)
    assert world.ownership.conflicts == {}
    assert world.ownership._rivals == {}


def test_a_robot_whose_route_is_gone_is_nobodys_to_give(world: World) -> None:
    world.noticed("frame", 10.0)
    assert list(world.ownership.due(lambda _: None, 10.0 + AFTER_S)) == []

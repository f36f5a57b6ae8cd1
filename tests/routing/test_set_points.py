from collections import Counter

from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.frame import NOBODY, Address, Frame, Way
from psiu_broker.routing.outbox import COMMAND_LANE, STOP_LANE, Fate, Parcel
from psiu_broker.routing.set_points import SetPoints


def parcel(robot: int, lane: int = COMMAND_LANE, expires: float = 9.0, peer: object = None) -> Parcel:
    frame = Frame(NOBODY, Address.numbered(robot), "rodas", b"", "soccer")
    return Parcel(b"", peer, lane, 0.0, expires, Fate(frame, Way("wifi")))


def test_a_newer_set_point_takes_the_place_of_its_robot_s_older_one() -> None:
    waiting = SetPoints(3)
    older, other, newer = parcel(1), parcel(2), parcel(1)
    assert waiting.replace(older) == waiting.replace(other) == []
    assert waiting.replace(newer) == [older]
    assert waiting.due() == {1: newer, 2: other}
    assert waiting.size == 2


def test_a_set_point_waits_behind_a_stop_and_a_stop_for_nothing() -> None:
    waiting = SetPoints(3)
    before, stop, after = parcel(1), parcel(1, STOP_LANE), parcel(1)
    waiting.replace(before)
    assert waiting.replace(stop) == [before]
    assert waiting.replace(after) == []
    assert waiting.due() == {1: stop}
    waiting.remove([stop])
    assert waiting.due() == {1: after}
    waiting.remove([after])
    assert waiting.size == 0


def test_nothing_leaves_by_looking() -> None:
    waiting = SetPoints(1)
    waiting.replace(parcel(1))
    assert waiting.due() == waiting.due() != {}


@given(
    offered=st.lists(
        st.tuples(st.integers(1, 3), st.sampled_from([STOP_LANE, COMMAND_LANE]), st.integers(0, 5)), max_size=30
    ),
    sent_after=st.sets(st.integers(0, 30)),
    now=st.integers(0, 5),
)
def test_each_set_point_comes_out_exactly_once(
    offered: list[tuple[int, int, int]], sent_after: set[int], now: int
) -> None:
    waiting = SetPoints(3)
    out: Counter[int] = Counter()
    kept = [parcel(robot, lane, expires) for robot, lane, expires in offered]
    for place, each in enumerate(kept):
        out.update(map(id, waiting.replace(each)))
        if place in sent_after:
            due = waiting.due()
            assert len(due) == len({parcel.fate.frame.destination for parcel in waiting})
            waiting.remove(due.values())
            out.update(map(id, due.values()))
        assert waiting.size <= 6
    out.update(map(id, waiting.expire(now)))
    out.update(map(id, waiting.clear()))
    assert out == Counter(map(id, kept))
    assert waiting.size == 0

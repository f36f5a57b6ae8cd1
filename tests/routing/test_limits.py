from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.frame import NOBODY, Address, Frame, Way
from psiu_broker.routing.limits import BURST_S, SUBJECTS_KEPT, Bucket, Gate, Limits, Rate
from psiu_broker.routing.outbox import COMMAND_LANE, STOP_LANE, Fate, Parcel

FREE = Rate()


def parcel(limits: Limits, subject: str, size: int = 10, lane: int = COMMAND_LANE) -> Parcel:
    frame = Frame(NOBODY, Address.named("MNERIM"), subject, b"", "psiu-ascii")
    return Parcel(bytes(size), None, lane, 0.0, 9.0, Fate(frame, Way("wifi")), limits.of(subject))


def passed(limits: Limits, waiting: Sequence[Parcel], now: float) -> list[int]:
    """The places of those that may leave at `now`, one after the other."""
    gate = Gate(limits, now)
    left = []
    for place, each in enumerate(waiting):
        if not gate.holds(each):
            limits.spend(each, now)
            left.append(place)
    return left


# Buckets.


def test_a_bucket_that_rested_gives_its_burst_at_once_and_then_keeps_its_rate() -> None:
    bucket = Bucket(rate=10.0, burst=2.0)
    for _ in range(2):
        assert bucket.ready(1, 5.0) == 5.0
        bucket.spend(1, 5.0)
    assert bucket.ready(1, 5.0) == pytest.approx(5.1)
    assert bucket.ready(1, 5.05) == pytest.approx(5.1)
    assert bucket.ready(1, 1e6) == 1e6
    bucket.spend(2, 1e6)
    assert bucket.ready(1, 1e6) > 1e6, "an age of rest is worth no more than the burst"


def test_what_is_longer_than_the_burst_leaves_all_the_same_and_the_next_pays_for_it() -> None:
    bucket = Bucket(rate=100.0, burst=25.0)
    assert bucket.ready(200, 0.0) == 0.0
    bucket.spend(200, 0.0)
    assert bucket.ready(1, 0.0) == pytest.approx(1.76)


@given(
    rate=st.floats(0.1, 1e6),
    burst=st.floats(0.1, 1e5),
    wanted=st.lists(st.tuples(st.floats(0, 3), st.floats(0.1, 1e4), st.booleans()), max_size=60),
)
def test_no_window_ever_sees_more_than_the_rate_and_one_burst(
    rate: float, burst: float, wanted: list[tuple[float, float, bool]]
) -> None:
    bucket = Bucket(rate, burst)
    now = 0.0
    spent: list[tuple[float, float]] = []
    for pause_s, cost, waits in wanted:
        now += pause_s
        ready = bucket.ready(cost, now)
        assert ready >= now
        if waits:
            now = ready
        if bucket.ready(cost, now) <= now:
            bucket.spend(cost, now)
            spent.append((now, cost))
        else:
            assert not waits or now + 1e-9 >= bucket.ready(cost, now), "when it is told to come, it may go"
    for first, (since, _) in enumerate(spent):
        total = longest = 0.0
        for at, cost in spent[first:]:
            total += cost
            longest = max(longest, cost)
            assert total <= (rate * (at - since) + max(burst, longest)) * (1 + 1e-9) + 1e-6


# Limits.


def test_a_limit_is_found_by_its_pattern_in_any_case_and_the_first_that_fits_counts() -> None:
    limits = Limits(FREE, {"node/4": Rate(1.0), "NODE/*": Rate(2.0), "parafrente": Rate(3.0)})
    assert [limits.of(word) for word in ("node/4", "Node/5", "PARAFRENTE", "parafrente2")] == [
        "node/4",
        "node/*",
        "parafrente",
        None,
    ]


def test_words_without_end_take_no_memory_without_end() -> None:
    limits = Limits(FREE, {"node/*": Rate(1.0)})
    assert {limits.of(f"node/{number}") for number in range(3 * SUBJECTS_KEPT)} == {"node/*"}
    assert len(limits._known) <= SUBJECTS_KEPT


def test_the_subjects_of_one_pattern_share_its_limit_and_others_pass_them() -> None:
    limits = Limits(FREE, {"node/*": Rate(frames_s=2.0)})
    waiting = [parcel(limits, subject) for subject in ("node/1", "node/2", "parafrente", "node/1")]
    assert passed(limits, waiting, 0.0) == [0, 2]
    assert passed(limits, waiting[1:2], 0.4) == []
    assert passed(limits, waiting[1:2], 0.5) == [0]


def test_bytes_count_as_frames_do_and_the_tighter_of_both_holds() -> None:
    limits = Limits(Rate(frames_s=100.0, bytes_s=400.0), {})
    waiting = [parcel(limits, "parafrente", 50) for _ in range(4)]
    assert passed(limits, waiting, 0.0) == [0, 1]
    gate = Gate(limits, 0.0)
    assert gate.holds(waiting[2])
    assert gate.opens == pytest.approx(50 / 400)


def test_what_is_short_does_not_overtake_what_is_long_for_lack_of_tokens() -> None:
    for limits in (Limits(Rate(bytes_s=400.0), {}), Limits(FREE, {"para*": Rate(bytes_s=400.0)})):
        limits.spend(parcel(limits, "parafrente", 90), 0.0)
        long, short = parcel(limits, "parafrente", 90), parcel(limits, "paratras", 5)
        assert passed(limits, [short], 0.0) == [0]
        assert passed(limits, [long, short], 0.0) == []


def test_a_stop_waits_for_no_limit_and_counts_for_none() -> None:
    limits = Limits(Rate(frames_s=1.0, bytes_s=100.0), {"pare": Rate(frames_s=1.0)})
    stops = [parcel(limits, "pare", lane=STOP_LANE) for _ in range(9)]
    move = parcel(limits, "parafrente")
    assert passed(limits, [*stops, move, move, stops[0]], 0.0) == [*range(9), 9, 11]


@given(
    frames_s=st.floats(0.5, 50),
    bytes_s=st.floats(10, 2000),
    node_s=st.floats(0.5, 20),
    arriving=st.lists(
        st.tuples(st.floats(0, 0.5), st.sampled_from(["node/1", "node/2", "parafrente", "pare"]), st.integers(1, 90)),
        max_size=40,
    ),
)
def test_a_link_that_looks_when_it_is_told_to_keeps_every_limit_and_loses_no_time(
    frames_s: float, bytes_s: float, node_s: float, arriving: list[tuple[float, str, int]]
) -> None:
    limits = Limits(Rate(frames_s, bytes_s), {"node/*": Rate(node_s)})
    waiting: list[Parcel] = []
    left: list[tuple[float, Parcel]] = []
    now = 0.0

    def look(now: float) -> float:
        gate = Gate(limits, now)
        for each in list(waiting):
            if not gate.holds(each):
                limits.spend(each, now)
                waiting.remove(each)
                left.append((now, each))
        return gate.opens

    for pause_s, subject, size in arriving:
        until = now + pause_s
        while waiting and (opens := look(now)) <= until:
            now = max(opens, now)
        now = until
        waiting.append(parcel(limits, subject, size, STOP_LANE if subject == "pare" else COMMAND_LANE))
        look(now)
        assert not any(each.lane == STOP_LANE for each in waiting)
    looks = 0
    while waiting:
        now = max(look(now), now) if waiting else now
        looks += 1
        assert looks <= 4 * len(arriving) + 4, "each look lets something go"
    limited = [(at, each) for at, each in left if each.lane != STOP_LANE]
    for rate, cost, of in (
        (frames_s, lambda _: 1, limited),
        (bytes_s, lambda each: len(each.wire), limited),
        (node_s, lambda _: 1, [(at, each) for at, each in limited if each.limit]),
    ):
        for first, (since, _) in enumerate(of):
            sizes = [cost(each) for _, each in of[first:]]
            burst = max(rate * BURST_S, *sizes) if sizes else 0.0
            for count, (at, _) in enumerate(of[first:], 1):
                assert sum(sizes[:count]) <= rate * (at - since) + burst + 1e-6

import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.frame import MESH, Way
from psiu_broker.mesh.beat import Beat
from psiu_broker.mesh.neighbour import ALIVE_S, BEAT_S, Neighbour, Neighbours

FAR_S = 123_456.0
"""What the other broker's clock reads more than ours."""


def beat(sent: float, heard: dict[str, tuple[int, int]] | None = None) -> Beat:
    return Beat(broker="B", epoch=7, sent_us=int(sent * 1e6), heard=heard or {})


@pytest.fixture
def neighbour() -> Neighbour:
    """B, whose clock is far ahead of ours, and whose beats take 2 ms."""
    neighbour = Neighbour("B", 7, "zid", 100.0)
    for number in range(10):
        sent = 100 + number * BEAT_S
        neighbour.beat(beat(FAR_S + sent), "A", 0, sent + 0.002)
    return neighbour


def late_s(neighbour: Neighbour, sent: float, came: float) -> float:
    """For a frame sent at `sent` by our clock."""
    return neighbour.late_s(int((FAR_S + sent) * 1e6), came)


def test_a_frame_as_quick_as_the_beats_is_not_late_however_far_apart_the_clocks_are(neighbour: Neighbour) -> None:
    assert late_s(neighbour, 104.0, 104.002) == pytest.approx(0, abs=1e-4)


def test_a_frame_that_stood_still_on_its_way_is_as_late_as_that(neighbour: Neighbour) -> None:
    """One of the two brokers was stopped for 3 s, or the network held the frame back."""
    assert late_s(neighbour, 104.0, 107.002) == pytest.approx(3, abs=1e-4)


def test_beats_that_were_held_back_do_not_make_a_frame_seem_quick(neighbour: Neighbour) -> None:
    for number in range(30):
        neighbour.beat(beat(FAR_S + 104 + number * BEAT_S), "A", 0, 107 + number * BEAT_S)
    assert late_s(neighbour, 116.0, 119.0) == pytest.approx(2.998, abs=1e-3)


def test_before_the_first_beat_nothing_is_known_to_be_late() -> None:
    assert Neighbour("B", 7, "zid", 0.0).late_s(5, 1000.0) == 0


def test_a_clock_that_stood_still_while_its_broker_slept_counts_anew(neighbour: Neighbour) -> None:
    neighbour.returned(3700.0)
    neighbour.beat(beat(FAR_S + 104), "A", 0, 3700.502)
    assert late_s(neighbour, 104.1, 3700.602) == pytest.approx(0, abs=1e-4)


def test_a_clock_that_stood_still_for_less_than_the_lease_counts_anew_with_the_next_echo(neighbour: Neighbour) -> None:
    """B's clock reads 104.0 at 105.5 of ours; its answer to our beat took 4 ms there and back."""
    neighbour.beat(beat(FAR_S + 104, {"A": (105_400_000, 98_000)}), "A", 0, 105.502)
    assert late_s(neighbour, 104.1, 105.602) == pytest.approx(0, abs=0.005)
    assert late_s(neighbour, 104.1, 107.602) == pytest.approx(2, abs=0.005)


def test_a_network_that_has_become_slow_does_not_make_a_frame_seem_quick(neighbour: Neighbour) -> None:
    """Both ways take 0.4 s now."""
    for number in range(30):
        sent = 104 + number * BEAT_S
        ours_us = int((sent - 0.5) * 1e6)
        neighbour.beat(beat(FAR_S + sent, {"A": (ours_us, 100_000)}), "A", 0, sent + 0.4)
        assert late_s(neighbour, sent, sent + 0.4) == pytest.approx(0.398, abs=1e-4)


def test_the_round_trip_is_measured_by_our_own_clock(neighbour: Neighbour) -> None:
    """Our beat left at 104.0; B held its answer back for 0.3 s; the whole took 0.31 s."""
    assert neighbour.round_trip_s is None
    neighbour.beat(beat(FAR_S + 104.305, {"A": (104_000_000, 300_000)}), "A", 0, 104.310)
    assert neighbour.round_trip_s == pytest.approx(0.010)
    neighbour.beat(beat(FAR_S + 104.8, {"A": (104_400_000, 300_000)}), "A", 0, 104.8)
    assert neighbour.round_trip_s == pytest.approx(0.010), "the quickest of the last few"


@pytest.mark.parametrize("echo", [(2**62, 0), (0, 0), (104_000_000, 2**62)])
def test_an_echo_that_cannot_be_is_no_round_trip(neighbour: Neighbour, echo: tuple[int, int]) -> None:
    neighbour.beat(beat(FAR_S + 104.3, {"A": echo}), "A", 0, 104.31)
    assert neighbour.round_trip_s is None


def test_our_own_beat_says_when_we_heard_it(neighbour: Neighbour) -> None:
    assert neighbour.echo(104.0) == (int((FAR_S + 103.6) * 1e6), pytest.approx(398_000, abs=2))
    assert Neighbour("B", 7, "zid", 0.0).echo(1.0) is None


def test_a_broker_that_does_not_mention_us_is_deaf_until_it_does(neighbour: Neighbour) -> None:
    assert neighbour.deaf_since == pytest.approx(100.002)
    neighbour.beat(beat(FAR_S + 105, {"A": (104_000_000, 0)}), "A", 0, 105.0)
    assert neighbour.deaf_since is None
    neighbour.beat(beat(FAR_S + 105.4), "A", 0, 105.4)
    assert neighbour.deaf_since == 105.4


def test_a_broker_is_alive_while_its_beats_come() -> None:
    known = Neighbours()
    assert not known.alive("B", 0.0)
    neighbour = Neighbour("B", 7, "zid", 0.0)
    known.add(neighbour)
    assert known.alive("B", 0.8), "it came a moment ago"
    assert not known.alive("B", 2 * ALIVE_S)
    neighbour.beat(beat(1), "A", 0, 2.0)
    assert known.alive("B", 2 + 2 * BEAT_S), "one beat may be lost"
    known.remove("B")
    assert not known.alive("B", 2.0)


def test_the_far_ends_of_the_mesh_are_the_brokers_that_are_there() -> None:
    known = Neighbours()
    for name in "BCB":
        known.add(Neighbour(name, 1, "zid", 0.0))
    assert known.ways == (Way(MESH, "B"), Way(MESH, "C"))
    known.remove("B")
    known.remove("nobody")
    assert known.ways == (Way(MESH, "C"),)


def test_the_series_of_each_lane_go_on_when_a_broker_was_only_out_of_sight(neighbour: Neighbour) -> None:
    assert [neighbour.number(1), neighbour.number(1), neighbour.number(2)] == [1, 2, 1]
    assert neighbour.take(1, 1)
    neighbour.returned(200.0)
    assert neighbour.number(1) == 3
    assert not neighbour.take(1, 1)
    assert neighbour.take(1, 4)
    assert neighbour.take(0, 1)
    assert (neighbour.frames_out, neighbour.frames_in, neighbour.lost, neighbour.doubles) == (4, 3, 2, 1)


@given(st.lists(st.tuples(st.floats(0, 1e6), st.floats(0, 1e6))), st.floats(0, 1e6), st.floats(0, 1e6))
def test_no_frame_is_early(beats: list[tuple[float, float]], sent: float, now: float) -> None:
    neighbour = Neighbour("B", 7, "zid", 0.0)
    for sent_at, came in beats:
        neighbour.beat(beat(sent_at), "A", 0, came)
    assert neighbour.late_s(int(sent * 1e6), now) >= 0


def test_frames_that_were_sent_and_never_came_are_missed_at_the_next_beat() -> None:
    neighbour = Neighbour("B", 7, "id", 0.0)
    neighbour.take(1, 1)
    said = Beat(broker="B", epoch=7, sent_us=1, heard={}, sent={"A": (5, {1: 4, 9: 100})})
    neighbour.beat(said, "A", 5, 1.0)
    assert (neighbour.frames_in, neighbour.lost) == (1, 3)
    assert neighbour.take(1, 3)  # late after all
    assert (neighbour.frames_in, neighbour.lost) == (2, 2)


def test_what_was_sent_to_a_former_life_of_ours_is_not_missed() -> None:
    neighbour = Neighbour("B", 7, "id", 0.0)
    neighbour.beat(Beat(broker="B", epoch=7, sent_us=1, heard={}, sent={"A": (4, {1: 500})}), "A", 5, 1.0)
    assert neighbour.lost == 0

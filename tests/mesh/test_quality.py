from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.mesh.quality import Qualities


def test_a_link_on_which_nothing_was_heard_is_as_good_as_any() -> None:
    assert Qualities().of("radio") == 10


def test_a_link_is_as_good_as_the_share_of_what_is_heard_that_checks_out() -> None:
    qualities = Qualities()
    for second in range(1, 100):
        qualities.count("radio", 7 * second, 3 * second)
        qualities.count("wifi", 10 * second, 0)
    assert (qualities.of("radio"), qualities.of("wifi")) == (7, 10)


def test_one_bad_frame_says_little_and_many_say_all() -> None:
    qualities = Qualities()
    qualities.count("radio", 100, 0)
    qualities.count("radio", 100, 1)
    assert qualities.of("radio") == 10
    qualities.count("radio", 100, 200)
    assert qualities.of("radio") == 0


def test_a_link_that_got_better_is_better_again_after_some_frames() -> None:
    qualities = Qualities()
    qualities.count("radio", 0, 100)
    assert qualities.of("radio") == 0
    qualities.count("radio", 20, 100)
    assert 5 <= qualities.of("radio") <= 7
    qualities.count("radio", 120, 100)
    assert qualities.of("radio") == 10


def test_silence_changes_nothing() -> None:
    qualities = Qualities()
    qualities.count("radio", 50, 50)
    before = qualities.of("radio")
    for _ in range(100):
        qualities.count("radio", 50, 50)
    assert qualities.of("radio") == before


@given(st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 10**6))))
def test_it_is_always_in_tenths(counts: list[tuple[int, int]]) -> None:
    qualities = Qualities()
    good = bad = 0
    for more_good, more_bad in counts:
        good, bad = good + more_good, bad + more_bad
        qualities.count("radio", good, bad)
        assert 0 <= qualities.of("radio") <= 10

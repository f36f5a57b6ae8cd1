from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.routing.sequence import WINDOW, Sequence


def test_numbers_in_their_order_are_all_new() -> None:
    series = Sequence()
    assert all(series.take(number) for number in range(1, 1000))
    assert (series.received, series.lost) == (999, 0)


def test_a_number_that_came_before_is_a_double() -> None:
    series = Sequence()
    assert [series.take(number) for number in (1, 1, 2, 1, 2, 3)] == [True, False, True, False, False, True]
    assert (series.received, series.lost) == (3, 0)


def test_what_is_missing_is_lost_until_it_comes_late() -> None:
    series = Sequence()
    assert series.take(1)
    assert series.take(4)
    assert series.lost == 2
    assert series.take(3)
    assert series.lost == 1


def test_the_first_that_came_need_not_be_the_first_that_was_sent() -> None:
    series = Sequence()
    assert series.take(5)
    assert series.lost == 4
    assert series.take(2)
    assert series.lost == 3


def test_what_is_too_old_to_tell_is_not_taken_for_new() -> None:
    series = Sequence()
    series.take(1000)
    assert series.take(1000 - WINDOW + 1)
    assert not series.take(1000 - WINDOW)
    assert not series.take(1000 - WINDOW + 1)


def test_no_series_counts_from_nought_or_below() -> None:
    series = Sequence()
    assert not series.take(0)
    assert series.take(1)
    assert not series.take(0)
    assert not series.take(-1)
    assert (series.received, series.lost) == (1, 0)


@given(st.lists(st.one_of(st.integers(-5, 200), st.integers(0, 2**64))))
def test_nothing_is_taken_twice_and_what_is_taken_and_lost_is_what_was_sent(numbers: list[int]) -> None:
    series = Sequence()
    taken = [number for number in numbers if series.take(number)]
    assert len(taken) == len(set(taken)) == series.received
    assert series.lost == max(taken, default=0) - len(taken) >= 0


@given(st.permutations(range(1, WINDOW + 1)))
def test_within_the_window_the_order_does_not_matter(numbers: list[int]) -> None:
    series = Sequence()
    assert all(series.take(number) for number in numbers)
    assert not any(series.take(number) for number in numbers)
    assert series.lost == 0

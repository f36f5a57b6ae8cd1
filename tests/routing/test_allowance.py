from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.routing.allowance import AT_ONCE_S, SHARE, Allowance

QUESTION = 340
"""The bits of ``MNERIM 034 qualseunome base 02123``."""


def test_a_link_without_a_rate_has_no_limit() -> None:
    allowance = Allowance(None)
    assert all(allowance.may(QUESTION, 0.0) for _ in range(10_000))


def test_a_few_questions_go_at_once_and_then_one_in_a_while() -> None:
    allowance = Allowance(9600)
    at_once = sum(allowance.may(QUESTION, 0.0) for _ in range(100))
    assert at_once == 9
    assert allowance.refused == 91
    assert not allowance.may(QUESTION, 1.0)
    assert allowance.may(QUESTION, 3.0)
    assert not allowance.may(QUESTION, 3.0)


def test_even_the_slowest_line_is_greeted_and_then_it_rests() -> None:
    allowance = Allowance(110)
    assert allowance.may(QUESTION, 0.0)
    assert not allowance.may(QUESTION, 100.0)
    assert allowance.may(QUESTION, 250.0)


def test_what_was_not_used_is_not_saved_up_for_ever() -> None:
    allowance = Allowance(9600)
    allowance.may(QUESTION, 0.0)
    assert sum(allowance.may(QUESTION, 86400.0) for _ in range(100)) == 9


def test_a_minute_never_sees_more_than_two_percent_and_the_end_of_a_frame() -> None:
    allowance = Allowance(9600)
    passed = [tenth / 10 for tenth in range(6000) if allowance.may(QUESTION, tenth / 10)]
    for since in range(540):
        bits = sum(QUESTION for at in passed if since <= at < since + 60)
        assert bits <= 0.02 * 9600 * 60 + QUESTION


@given(
    st.integers(1, 1_000_000),
    st.lists(st.tuples(st.floats(0, 100), st.integers(1, 10_000)), max_size=200),
)
def test_whoever_asks_however_often_the_share_is_kept(rate: int, asked: list[tuple[float, int]]) -> None:
    allowance = Allowance(rate)
    now = sent = longest = 0.0
    for pause_s, bits in asked:
        now += pause_s
        if allowance.may(bits, now):
            sent += bits
            longest = max(longest, bits)
    assert sent <= SHARE * rate * (now + AT_ONCE_S) * 1.000001 + longest

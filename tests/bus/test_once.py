"""A call is carried out once, whatever routers make of it."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.bus.once import CAPACITY, ID_MAX, KEPT_S, SAME_WORDS_S, Once


@pytest.fixture
def now() -> list[float]:
    return [100.0]


@pytest.fixture(params=[True, False], ids=["router", "peer"])
def once(request: pytest.FixtureRequest, now: list[float]) -> Once:
    return Once(relayed=request.param, clock=lambda: now[0])


def test_a_call_with_an_id_that_came_before_is_a_double_for_half_a_minute(once: Once, now: list[float]) -> None:
    assert not once.is_double(b"1", "k", b"p")
    now[0] += KEPT_S - 1
    assert once.is_double(b"1", "k", b"p")
    now[0] += 2
    assert not once.is_double(b"1", "k", b"p")


def test_the_same_words_with_another_id_are_another_call(once: Once) -> None:
    assert not once.is_double(b"1", "k", b"p")
    assert not once.is_double(b"2", "k", b"p")


def test_without_an_id_the_same_words_are_a_double_for_a_moment_where_routers_relay(now: list[float]) -> None:
    once = Once(relayed=True, clock=lambda: now[0])
    assert not once.is_double(b"", "k", b"p")
    assert once.is_double(b"", "k", b"p")
    assert not once.is_double(b"", "k", b"q")
    assert not once.is_double(b"", "l", b"p")
    now[0] += SAME_WORDS_S + 0.1
    assert not once.is_double(b"", "k", b"p")


def test_without_an_id_and_without_routers_every_call_is_a_new_one(now: list[float]) -> None:
    once = Once(relayed=False, clock=lambda: now[0])
    assert not any(once.is_double(b"", "k", b"p") for _ in range(3))


def test_an_id_that_is_too_long_is_none(now: list[float]) -> None:
    once = Once(relayed=False, clock=lambda: now[0])
    assert not any(once.is_double(b"x" * (ID_MAX + 1), "k", b"p") for _ in range(2))


@given(st.lists(st.binary(min_size=1, max_size=3), max_size=50))
def test_each_id_passes_once(ids: list[bytes]) -> None:
    once = Once(relayed=True, clock=lambda: 0.0)
    passed = [call_id for call_id in ids if not once.is_double(call_id, "k", b"")]
    assert passed == list(dict.fromkeys(ids))


def test_its_memory_is_bounded(now: list[float]) -> None:
    once = Once(relayed=True, clock=lambda: now[0])
    for number in range(CAPACITY + 100):
        once.is_double(b"%d" % number, "k", b"")
    assert len(once._seen) <= CAPACITY

import tracemalloc

from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.routing.delays import FRAMES_KEPT, Delays


def test_before_the_first_frame_there_is_no_delay() -> None:
    assert Delays().ms(0) is None


def test_what_left_at_once_counts_as_no_delay() -> None:
    delays = Delays()
    delays.note(5, 0.040)
    assert delays.ms(100) == (0.0, 40.0)
    assert delays.ms(1000 + 4) == (0.0, 0.0), "one in a thousand is beyond p99"
    for number in range(1, 21):
        delays.note(number, 0.040)
    assert delays.ms(1000 + 9) == (0.0, 40.0)
    assert delays.ms(1000 + 20) == (0.0, 0.0), "all are too long ago"
    delays = Delays()
    delays.note(1, 0.002)
    assert delays.ms(1) == (2.0, 2.0)


def test_it_takes_no_more_memory_however_many_frames_waited() -> None:
    delays = Delays()
    tracemalloc.start()
    try:
        for number in range(1, 2 * FRAMES_KEPT):
            delays.note(number, number / 1000)
        kept, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert kept < FRAMES_KEPT, "less than a byte a frame"


@given(st.lists(st.one_of(st.none(), st.integers(1, 100)), min_size=1, max_size=50), st.integers(0, FRAMES_KEPT + 20))
def test_the_figures_are_those_of_the_last_thousand(waited: list[int | None], more: int) -> None:
    delays = Delays()
    every = [*waited, *[None] * more]
    for number, each in enumerate(every, 1):
        if each is not None:
            delays.note(number, each / 1000)
    last = sorted(float(each or 0) for each in every[-FRAMES_KEPT:])
    told = delays.ms(len(every))
    assert told is not None
    assert [round(ms, 6) for ms in told] == [last[len(last) // 2], last[min(len(last) - 1, len(last) * 99 // 100)]]

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.codecs.codec import Event
from psiu_broker.codecs.noise import LONGEST_RUN, Noise
from psiu_broker.frame import MALFORMED_KEPT, Malformed


def test_a_run_is_one_malformed_with_its_beginning_and_its_whole_size() -> None:
    noise = Noise()
    events: list[Event] = []
    noise.add(b"a" * 60, events)
    noise.add(b"b" * 60, events)
    assert events == []
    noise.end("checksum", events)
    assert events == [Malformed("checksum", b"a" * 60 + b"b" * (MALFORMED_KEPT - 60), 120)]


def test_no_noise_is_no_event() -> None:
    noise = Noise()
    events: list[Event] = []
    noise.add(b"", events)
    noise.end("noise", events)
    assert events == []


@given(cuts=st.lists(st.integers(0, 9000), max_size=6))
def test_endless_noise_is_reported_in_pieces_wherever_it_is_cut(cuts: list[int]) -> None:
    data = bytes(range(250)) * 40
    noise = Noise()
    events: list[Event] = []
    places = [0, *sorted(cuts), len(data)]
    for start, end in pairwise(places):
        noise.add(data[start:end], events)
        assert noise.size <= LONGEST_RUN
        assert len(noise.kept) <= LONGEST_RUN
    noise.end("noise", events)
    assert [event.size for event in events if isinstance(event, Malformed)] == [4096, 4096, 10000 - 8192]
    assert [event.wire for event in events] == [data[at : at + MALFORMED_KEPT] for at in (0, 4096, 8192)]

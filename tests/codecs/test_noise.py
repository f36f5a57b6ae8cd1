from itertools import pairwise
from typing import Any

import pytest
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


class _Counted(bytes):
    """Bytes that count how many of them are copied when they are cut."""

    copied = 0

    def __getitem__(self, place: Any) -> Any:
        cut = super().__getitem__(place)
        if isinstance(cut, bytes):
            type(self).copied += len(cut)
            return _Counted(cut)
        return cut


def test_noise_of_any_length_is_copied_once_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_Counted, "copied", 0)
    data = _Counted(100 * LONGEST_RUN)
    events: list[Event] = []
    Noise().add(data, events)
    assert len(events) == 99
    assert _Counted.copied <= len(data)

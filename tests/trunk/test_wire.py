"""What travels on a trunk: whole greetings and chunks, however the stream cuts them."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.errors import LinkAbsent, LinkBusy, LinkLost
from psiu_broker.trunk.wire import CHUNK_MAX, END, ENDED, LINE_MAX, Greeting, Reader, chunk

BASE = Greeting("base", "1f", many=False)
HILL = Greeting("hill", "2e", many=False)
PHONES = Greeting("a", "3d", many=True)

words = st.text(st.characters(min_codepoint=33, max_codepoint=126), min_size=1, max_size=30)


def joined(found: list[Greeting | bytes]) -> list[Greeting | bytes]:
    """The pieces between two ends as one: where a chunk was cut does not matter."""
    whole: list[Greeting | bytes] = []
    for each in found:
        if whole and isinstance(each, bytes) and isinstance(whole[-1], bytes) and ENDED not in (each, whole[-1]):
            whole[-1] += each
        else:
            whole.append(each)
    return whole


@given(
    st.builds(Greeting, words, words, st.booleans()),
    st.lists(st.binary(max_size=300) | st.just(b"x" * CHUNK_MAX), max_size=6),
    st.data(),
)
def test_a_stream_cut_anywhere_says_the_same(greeting: Greeting, contents: list[bytes], data: st.DataObject) -> None:
    stream = greeting.line + b"".join(chunk(each) for each in contents)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=12)))
    reader = Reader()
    found = [each for a, b in itertools.pairwise([0, *cuts, len(stream)]) for each in reader.feed(stream[a:b])]
    assert joined(found) == joined([greeting, *contents])


def test_a_stream_of_single_bytes_says_the_same() -> None:
    reader = Reader()
    stream = BASE.line + chunk(b"abc") + END + chunk(b"d")
    found = [each for byte in stream for each in reader.feed(bytes([byte]))]
    assert joined(found) == [BASE, b"abc", ENDED, b"d"]


@pytest.mark.parametrize("said", [b"MNERIM 034 parafrente 100 PC 02123", b"\x00\x12\x06", b"\n", b"PSIU TRUNK\n", END])
def test_who_says_something_else_is_quoted(said: bytes) -> None:
    with pytest.raises(LinkAbsent, match="the far end is no psiu-broker with a trunk: it says") as stranger:
        Reader().feed(said)
    assert str(stranger.value).isprintable()


def test_a_stranger_is_known_before_its_line_ends_and_never_gathered() -> None:
    reader = Reader()
    assert reader.feed(b"PSI") == []
    with pytest.raises(LinkAbsent):
        reader.feed(b"O")
    with pytest.raises(LinkAbsent):
        Reader().feed(b"PSIU TRUNK 1 " + b"x" * LINE_MAX)


def test_another_version_is_named() -> None:
    with pytest.raises(LinkAbsent, match="the far end speaks version 2 of trunks and we version 1; update one"):
        Reader().feed(b"PSIU TRUNK 2 whatever comes then\n")


def test_words_of_a_later_broker_are_passed_over() -> None:
    assert Reader().feed(b"PSIU TRUNK 1 base 1f one and more\n") == [BASE]


def test_a_greeting_in_the_middle_of_chunks_is_noticed() -> None:
    reader = Reader()
    reader.feed(BASE.line + chunk(b"abc"))
    with pytest.raises(LinkLost, match="begun anew"):
        reader.feed(BASE.line)


def test_one_end_dials_and_the_other_does_not() -> None:
    for one, other in itertools.permutations((BASE, HILL, PHONES), 2):
        assert one.dials(other) is not other.dials(one)
    assert BASE.dials(HILL)
    assert BASE.dials(PHONES), "who takes callers listens for all of them in one place"


def test_ourselves_and_our_namesakes_are_refused() -> None:
    with pytest.raises(LinkBusy, match="the stream leads back to this broker itself"):
        BASE.dials(BASE)
    with pytest.raises(LinkBusy, match="the broker at the far end is called base too; rename one of them"):
        BASE.dials(BASE._replace(epoch="77"))

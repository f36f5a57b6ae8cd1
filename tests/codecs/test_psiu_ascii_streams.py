import time
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.codecs.codec import Directory, Event
from psiu_broker.codecs.psiu_ascii import PsiuAscii, message
from psiu_broker.frame import MALFORMED_KEPT, Address, Frame, Malformed

NAMES = ["PC", "MNERIM", "ROBO UM", "??"]
COMPLAINT = b"CHECKSUM NAO BATEU!"


def ascii_codec(strict: bool = False) -> PsiuAscii:
    return PsiuAscii(PsiuAscii.Options(strict=strict), Directory(names=set(NAMES)))


def read(codec: PsiuAscii, *pieces: bytes) -> list[Event]:
    events: list[Event] = []
    for piece in pieces:
        events += codec.decode(piece, 0.0)
    events += codec.flush(0.0)
    return events


def wire(source: str, destination: str, words: list[str]) -> bytes:
    return ascii_codec().encode(message(Address.named(source), Address.named(destination), *words))


def claiming(size: int, text: bytes = b"A %03d b C ") -> bytes:
    body = text % size
    return body + b"%05d" % (sum(body) & 0xFFFF)


def mutated(frame: bytes, place: int, byte: int) -> bytes:
    place %= len(frame)
    return frame[:place] + bytes((byte,)) + frame[place + 1 :]


printable = st.characters(min_codepoint=0x20, max_codepoint=0x7E)
word = st.text(printable.filter(lambda char: char != " "), min_size=1, max_size=12)
name = st.one_of(st.sampled_from(NAMES), word)
good = st.builds(wire, name, name, st.lists(word, min_size=1, max_size=8))
number = st.sampled_from(["100", "999", "034", "02123", "12345"])
busy = st.builds(wire, name, name, st.lists(st.one_of(word, number), min_size=1, max_size=60).map(lambda w: ["x", *w]))
loose = st.builds(claiming, st.sampled_from([0, 14, 16, 30, 100, 500, 999]))
unpadded = loose.map(lambda frame: frame[:-5] + frame[-4:])
spoiled = st.builds(mutated, good, st.integers(0, 100), st.integers(0, 255))
between = st.sampled_from(
    [b"", b" ", b"\r\n", b"\n", b"7 ", b" 123 ", b" 12345", b" 1234", b"\x00", COMPLAINT, b" 999 "]
)
junk = st.one_of(st.binary(max_size=40), word.map(str.encode))
stream = st.lists(st.one_of(good, busy, loose, unpadded, spoiled, between, junk), max_size=14).map(b"".join)


@given(source=name, destination=name, words=st.lists(word, min_size=1, max_size=20))
def test_what_is_encoded_is_decoded_as_it_was(source: str, destination: str, words: list[str]) -> None:
    frame = message(Address.named(source), Address.named(destination), *words)
    codec = ascii_codec()
    encoded = codec.encode(frame)
    for _ in range(2):
        (heard,) = read(codec, encoded)
        assert isinstance(heard, Frame)
        if not any(known.endswith(" " + source) for known in NAMES):
            assert heard._replace(wire=b"", dialect="") == frame
        assert (heard.wire, heard.dialect, heard.remark) == (encoded, codec.dialect, "")


@given(data=stream, cuts=st.lists(st.integers(0, 1500), max_size=12), strict=st.booleans())
def test_any_cut_of_the_bytes_gives_the_same_events(data: bytes, cuts: list[int], strict: bool) -> None:
    places = [0, *sorted(place for place in cuts if place < len(data)), len(data)]
    pieces = [data[start:end] for start, end in pairwise(places)]
    assert read(ascii_codec(strict), *pieces) == read(ascii_codec(strict), data)


@given(data=stream, strict=st.booleans())
def test_one_byte_at_a_time_gives_the_same_events(data: bytes, strict: bool) -> None:
    assert read(ascii_codec(strict), *(bytes((byte,)) for byte in data)) == read(ascii_codec(strict), data)


@given(
    data=st.one_of(good, busy, loose, unpadded, spoiled, stream),
    end=st.sampled_from([b"", b"\r\n", b"\r\n\r\n", b"\n", b" "]),
    strict=st.booleans(),
)
def test_what_is_told_at_a_glance_is_what_reading_tells(data: bytes, end: bytes, strict: bool) -> None:
    codec = ascii_codec(strict)
    read(codec, data)
    frame = codec.whole(data + end)
    assert not codec.pending
    if frame is not None:
        assert read(ascii_codec(strict), *(bytes((byte,)) for byte in data + end)) == [frame]


@given(
    source=word, destination=word, words=st.lists(word, min_size=1, max_size=20), end=st.sampled_from([b"", b"\r\n"])
)
def test_a_frame_heard_before_is_told_at_a_glance(source: str, destination: str, words: list[str], end: bytes) -> None:
    frame = wire(source, destination, words)
    codec = PsiuAscii(PsiuAscii.Options(), Directory())
    assert codec.whole(frame + end) is None
    (heard,) = read(codec, frame)
    if len(frame + end) <= 999:
        assert codec.whole(frame + end) == heard


@given(before=st.lists(good, max_size=4), noise=st.integers(0, 1200), data=stream)
def test_cuts_far_into_long_noise_give_the_same_events(before: list[bytes], noise: int, data: bytes) -> None:
    whole = b"".join(before) + b"x 999 y" * noise + data + b" 12345 " * 700 + data
    pieces = [whole[at : at + 97] for at in range(0, len(whole), 97)]
    assert read(ascii_codec(), *pieces) == read(ascii_codec(), whole)


@pytest.mark.parametrize("step", [1, 97, 1000, 100_000])
@pytest.mark.parametrize("claim", [1, 16, 30])
def test_loose_frames_without_end_and_without_anything_between_are_all_heard(claim: int, step: int) -> None:
    data = claiming(claim) * 800
    pieces = [data[at : at + step] for at in range(0, len(data), step)]
    events = read(ascii_codec(), *pieces)
    assert [event.wire for event in events if isinstance(event, Frame)] == [claiming(claim)] * 800


@given(data=stream, warm=good)
def test_what_was_heard_before_changes_nothing(data: bytes, warm: bytes) -> None:
    codec = ascii_codec()
    read(codec, warm)
    events = read(codec, data)
    assert events == read(ascii_codec(), data)
    assert read(codec, data) == events


@given(pieces=st.lists(st.one_of(stream, st.binary(max_size=300)), max_size=8), strict=st.booleans())
def test_nothing_is_raised_and_every_event_holds_what_it_promises(pieces: list[bytes], strict: bool) -> None:
    codec = ascii_codec(strict)
    data = b"".join(pieces)
    for event in read(codec, *pieces):
        if isinstance(event, Malformed):
            assert event.reason in {"noise", "checksum", "size", "unfinished", "complaint"}
            assert 0 < len(event.wire) == min(event.size, MALFORMED_KEPT)
        else:
            assert event.wire in data
            assert event.payload
            assert event.subject.encode() == event.payload.split(b" ")[0]
            assert event.source.name
            assert event.destination.name
            assert event.wire.startswith(event.destination.name.encode() + b" ")
            assert ascii_codec().encode(event)
            canonical = event.dialect == "psiu-ascii/1"
            assert canonical == (event.remark == "")
            assert canonical or not strict
    assert not codec.pending


@given(noise=st.binary(max_size=60), frame=good)
def test_after_noise_and_a_silence_the_next_good_frame_is_found(noise: bytes, frame: bytes) -> None:
    codec = ascii_codec()
    read(codec, noise)
    assert [event.wire for event in read(codec, frame) if isinstance(event, Frame)] == [frame]


@given(noise=st.binary(max_size=60).filter(lambda noise: b" " not in noise), frame=good)
def test_right_behind_noise_a_good_frame_is_found(noise: bytes, frame: bytes) -> None:
    found = [event.wire for event in read(ascii_codec(), noise + frame) if isinstance(event, Frame)]
    assert len(found) == 1
    assert (noise + frame).endswith(found[0])


@given(claim=st.integers(0, 999), frames=st.lists(good, min_size=1, max_size=20))
def test_no_corrupt_size_swallows_the_good_frames_behind_it(claim: int, frames: list[bytes]) -> None:
    spoiled_frame = b"MNERIM %03d parafrente 100 PC 02000" % claim
    found = [event.wire for event in read(ascii_codec(), spoiled_frame + b"".join(frames)) if isinstance(event, Frame)]
    assert found == frames


ENDLESS = {
    "letters": b"a",
    "spaces": b" ",
    "binary": bytes(range(256)),
    "sizes": b" 123",
    "claims": b"A 999 ",
    "endings": b" 12345",
    "sizes and endings": b" 123 12345",
    "frames that claim too much": claiming(999),
    "frames that claim too little": claiming(1),
    "good frames": claiming(15),
    "good frames behind a claim": b"A 999 " + claiming(15) * 80,
    "complaints": COMPLAINT,
    "letters between binary": b"a\x00",
    "lines": b"a\n",
}


@pytest.mark.parametrize("pattern", ENDLESS.values(), ids=ENDLESS.keys())
@pytest.mark.parametrize("step", [1, 1000, 65536])
def test_endless_input_holds_bounded_memory(pattern: bytes, step: int) -> None:
    codec = ascii_codec()
    data = (pattern * 65536)[: 40 * step if step == 1000 else max(step, 20_000)]
    for at in range(0, len(data), step):
        codec.decode(data[at : at + step], 0.0)
        assert len(codec._run.text) <= 4096 + 1024
        assert len(codec._run._sums) == len(codec._run.text) + 1
        assert len(codec._run.fits) <= 800
        assert codec._noise.size <= 4096


def test_endless_new_names_and_words_hold_bounded_memory() -> None:
    codec = ascii_codec()
    for number in range(5000):
        read(codec, wire(f"R{number}", f"S{number}", [f"w{number}"]))
        assert len(codec._names) <= 1025
        assert len(codec._subjects) <= 1025


@pytest.mark.parametrize("pattern", ENDLESS.values(), ids=ENDLESS.keys())
def test_a_byte_of_a_long_input_costs_no_more_than_one_of_a_short_input(pattern: bytes) -> None:
    def cost_s(size: int, rounds: int) -> float:
        data = (pattern * (size // len(pattern) + 1))[:size]
        costs = []
        for _ in range(rounds):
            codec = ascii_codec()
            start = time.process_time()
            codec.decode(data, 0.0)
            codec.flush(0.0)
            costs.append((time.process_time() - start) / size)
        return min(costs)

    assert cost_s(256_000, 1) < 16 * cost_s(2_000, 20)

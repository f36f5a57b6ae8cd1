import random
import time
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.codecs.checksums import CHECKS
from psiu_broker.codecs.codec import Directory, Event
from psiu_broker.codecs.fragments import join_fields
from psiu_broker.codecs.psiu_hexa import PsiuHexa, packet
from psiu_broker.frame import MALFORMED_KEPT, Address, Frame, Malformed

KNOWN = {1, 2, 3, 5, 255}
BEGINNINGS = [1, 2, 3, 4, 5, 6, 9, 30, 200, 254, 255]
"""Bytes of which nearly each may begin a packet for a known robot."""

forms = st.fixed_dictionaries(
    {
        "topology": st.sampled_from(["ad-hoc", "master-slave", "point-to-point"]),
        "size": st.sampled_from(["nominal", "real"]),
        "crc": st.sampled_from(sorted(CHECKS)),
        "resync": st.booleans(),
        "fragment": st.booleans(),
        "remote": st.sampled_from([None, 2]),
    }
)
some_fields = st.lists(st.binary(max_size=60), min_size=1, max_size=3).filter(lambda parts: sum(map(len, parts)) > 0)
payloads = st.one_of(st.binary(max_size=2), some_fields.map(join_fields))
packets = st.builds(packet, st.just(Address.numbered(1)), st.just(Address.numbered(2)), payloads)
junk = st.one_of(
    st.binary(max_size=12),
    st.lists(st.sampled_from([0, 1, 2, 4, 5, 6, 7, 255]), max_size=12).map(bytes),
    st.just(bytes((2, 2, 255))),
)


def hexa_codec(options: dict[str, Any] | None = None) -> PsiuHexa:
    return PsiuHexa(PsiuHexa.Options(**(options or {})), Directory(numbers=set(KNOWN)))


def read(codec: PsiuHexa, *pieces: bytes) -> list[Event]:
    events: list[Event] = []
    for piece in pieces:
        events += codec.decode(piece, 0.0)
    events += codec.flush(0.0)
    return events


def wires(events: list[Event]) -> list[bytes]:
    return [event.wire for event in events if isinstance(event, Frame)]


@st.composite
def streams(draw: st.DrawFn) -> tuple[dict[str, Any], bytes]:
    options = draw(forms)
    codec = hexa_codec(options)
    parts = draw(st.lists(st.one_of(packets.map(codec.encode), junk), max_size=10))
    data = bytearray(b"".join(parts))
    for place in draw(st.lists(st.integers(0, 400), max_size=2)):
        if place < len(data):
            data[place] ^= 1 << draw(st.integers(0, 7))
    return options, bytes(data)


@given(options=forms, frame=packets)
def test_what_is_encoded_is_decoded_as_it_was(options: dict[str, Any], frame: Frame) -> None:
    codec = hexa_codec(options)
    wire = codec.encode(frame)
    (heard,) = read(codec, wire)
    assert isinstance(heard, Frame)
    assert (heard.subject, heard.payload, heard.wire) == (frame.subject, frame.payload, wire)
    if options["topology"] == "ad-hoc":
        assert heard._replace(wire=b"", dialect="") == frame
    if options["topology"] == "master-slave":
        assert heard.source == frame.destination
    assert codec.encode(frame._replace(payload=heard.payload)) == wire


@given(
    parts=st.lists(st.sampled_from([0, 1, 100, 255]).map(bytes), min_size=3, max_size=20).map(
        lambda p: [*p, bytes(252)]
    )
)
def test_what_is_broken_is_whole_again(parts: list[bytes]) -> None:
    codec = hexa_codec({"fragment": True})
    frame = packet(Address.numbered(1), Address.numbered(2), join_fields(parts))
    heard = read(codec, codec.encode(frame))
    assert [event.payload for event in heard if isinstance(event, Frame)] == [frame.payload]
    assert len(heard) == 1


@given(stream=streams(), cuts=st.lists(st.integers(0, 400), max_size=10))
def test_any_cut_of_the_bytes_gives_the_same_events(stream: tuple[dict[str, Any], bytes], cuts: list[int]) -> None:
    options, data = stream
    places = [0, *sorted(place for place in cuts if place < len(data)), len(data)]
    pieces = [data[start:end] for start, end in pairwise(places)]
    assert read(hexa_codec(options), *pieces) == read(hexa_codec(options), data)


@given(stream=streams())
def test_one_byte_at_a_time_gives_the_same_events(stream: tuple[dict[str, Any], bytes]) -> None:
    options, data = stream
    assert read(hexa_codec(options), *(bytes((byte,)) for byte in data)) == read(hexa_codec(options), data)


@given(options=forms, seed=st.integers(0, 2**32), size=st.integers(1, 300))
def test_finds_are_the_same_as_where_each_is_checked_byte_by_byte(
    options: dict[str, Any], seed: int, size: int
) -> None:
    data = bytes(random.Random(seed).choices(BEGINNINGS, k=900))
    pieces = [data[at : at + size] for at in range(0, len(data), size)]
    codec, plain = hexa_codec(options), hexa_codec(options)
    plain._parts = None
    for _ in range(2):
        assert read(codec, *pieces) == read(plain, *pieces)


@given(options=forms, pieces=st.lists(st.binary(max_size=300), max_size=8))
def test_nothing_is_raised_and_every_byte_is_accounted_for(options: dict[str, Any], pieces: list[bytes]) -> None:
    codec = hexa_codec({**options, "fragment": False})
    counted = 0
    for event in read(codec, *pieces):
        if isinstance(event, Malformed):
            assert event.reason in {"noise", "size", "crc", "unfinished"}
            assert 0 < len(event.wire) == min(event.size, MALFORMED_KEPT)
            counted += event.size
        else:
            counted += len(event.wire)
            assert len(event.payload) <= 251
    assert counted == len(b"".join(pieces))
    assert not codec.pending


@given(noise=st.binary(max_size=300), options=forms, frame=packets)
def test_after_noise_and_a_silence_the_next_good_packet_is_found(
    noise: bytes, options: dict[str, Any], frame: Frame
) -> None:
    codec = hexa_codec({**options, "fragment": False})
    read(codec, noise)
    wire = codec.encode(frame)
    assert wires(read(codec, wire)) == [wire]


@given(
    options=forms.filter(lambda form: form["topology"] != "point-to-point"),
    noise=st.integers(4, 300).map(bytes),
    frame=packets,
)
def test_right_behind_noise_a_good_packet_is_found(options: dict[str, Any], noise: bytes, frame: Frame) -> None:
    codec = hexa_codec({**options, "resync": True, "fragment": False})
    wire = codec.encode(frame)
    assert wires(read(codec, noise + wire)) == [wire]


def test_random_noise_is_hardly_ever_a_packet() -> None:
    noise = random.Random(20120309).randbytes(65536)
    assert len(wires(read(hexa_codec(), noise))) <= 5


ENDLESS = {
    "zeros": bytes(1),
    "known robots with long sizes": b"\xff",
    "random": random.Random(1).randbytes(4096),
    "every byte": bytes(range(256)),
    "good packets": bytes.fromhex("010206038085"),
}


@pytest.mark.parametrize("pattern", ENDLESS.values(), ids=ENDLESS.keys())
@pytest.mark.parametrize("topology", ["ad-hoc", "master-slave", "point-to-point"])
def test_endless_input_holds_bounded_memory(pattern: bytes, topology: str) -> None:
    codec = hexa_codec({"topology": topology})
    data = (pattern * 20_000)[:20_000]
    for at in range(0, len(data), 100):
        codec.decode(data[at : at + 100], 0.0)
        assert len(codec._begun) < 257
        assert codec._noise.size <= 4096


@pytest.mark.parametrize("pattern", ENDLESS.values(), ids=ENDLESS.keys())
def test_a_byte_of_a_long_input_costs_no_more_than_one_of_a_short_input(pattern: bytes) -> None:
    def cost_s(size: int, rounds: int) -> float:
        data = (pattern * (size // len(pattern) + 1))[:size]
        costs = []
        for _ in range(rounds):
            codec = hexa_codec()
            start = time.process_time()
            codec.decode(data, 0.0)
            codec.flush(0.0)
            costs.append((time.process_time() - start) / size)
        return min(costs)

    assert cost_s(256_000, 1) < 16 * cost_s(2_000, 20)

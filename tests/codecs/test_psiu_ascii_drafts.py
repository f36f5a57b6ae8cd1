"""Drafts 0 and 0.5 of PSIU ASCII: no spaces around the size, and in 0 no sender."""

import json
import time
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from psiu_broker.codecs.codec import Directory, Event
from psiu_broker.codecs.draft_run import LONGEST_NAME
from psiu_broker.codecs.psiu_ascii import RIPE_S, PsiuAscii, message
from psiu_broker.errors import EncodeError
from psiu_broker.frame import COMPLAINT, MALFORMED_KEPT, NOBODY, Address, Frame, Malformed

VECTORS = json.loads((Path(__file__).parents[1] / "vectors" / "psiu-ascii.json").read_text())
DRAFTS = [vector for vector in VECTORS["frames"] if vector["dialect"] in ("v0", "v0.5")]
NAMES = ["PC", "MNERIM", "ROBO UM", "R2", "R2031"]
VERSIONS = ["0.5", "0"]
FRAMES = {"0.5": b"MNERIM031parafrente 100 PC02024", "0": b"MNERIM029parafrente 100 01884"}
MNERIM, PC = Address.named("MNERIM"), Address.named("PC")


def draft(version: str, *names: str, **options: Any) -> PsiuAscii:
    known = set(names or NAMES)
    directory = Directory(names={name for name in known if " " in name}, all_names=known)
    return PsiuAscii(PsiuAscii.Options(version=version, **options), directory)


def read(codec: PsiuAscii, *pieces: bytes) -> list[Event]:
    events: list[Event] = []
    for piece in pieces:
        events += codec.decode(piece, 0.0)
    events += codec.flush(0.0)
    assert not codec.pending
    return events


def frames(events: Sequence[Event]) -> list[Frame]:
    return [event for event in events if isinstance(event, Frame)]


def wires(events: Sequence[Event]) -> list[bytes]:
    return [frame.wire for frame in frames(events)]


def reasons(events: Sequence[Event]) -> list[str]:
    return [event.reason for event in events if isinstance(event, Malformed)]


def cut(data: bytes) -> list[bytes]:
    return [bytes((byte,)) for byte in data]


def summed(text: bytes) -> bytes:
    return text + b"%05d" % (sum(text) & 0xFFFF)


def of(vector: dict[str, Any]) -> str:
    return str(vector["dialect"]).removeprefix("v")


@pytest.mark.parametrize("strict", [False, True], ids=["tolerant", "strict"])
@pytest.mark.parametrize(
    "around", [(b"", b""), (b"\r\n", b"\r\n"), (b"7 ", b"\r\n"), (b"zz\xe1", b"\x00"), (b"7", b"")]
)
@pytest.mark.parametrize("vector", DRAFTS, ids=lambda vector: vector["wire"])
def test_each_golden_frame_whole_cut_and_in_noise(
    vector: dict[str, Any], strict: bool, around: tuple[bytes, bytes]
) -> None:
    before, after = around
    data = before + bytes.fromhex(vector["hex"]) + after
    events = read(draft(of(vector), strict=strict), data)
    assert read(draft(of(vector), strict=strict), *cut(data)) == events
    valid = vector["verdict"] == "valid"
    assert len(frames(events)) == (valid or not strict)
    for frame in frames(events):
        assert frame.destination == Address.named(vector["destination"])
        assert frame.source == (Address.named(vector["source"]) if vector["source"] else NOBODY)
        assert frame.subject == vector["command"]
        assert frame.payload == " ".join([vector["command"], *vector["params"]]).encode()
        assert frame.wire == vector["wire"].encode()
        assert frame.dialect == f"psiu-ascii/{of(vector)}{'' if valid else '/loose'}"
        assert bool(frame.remark) == (not valid)


@pytest.mark.parametrize("vector", DRAFTS, ids=lambda vector: vector["wire"])
def test_each_golden_frame_is_sent_with_its_true_size(vector: dict[str, Any]) -> None:
    codec = draft(of(vector))
    source = Address.named(vector["source"] or "ANYBODY")
    wire = codec.encode(message(source, Address.named(vector["destination"]), vector["command"], *vector["params"]))
    assert (wire == vector["wire"].encode()) == (vector["verdict"] == "valid")
    (again,) = frames(read(codec, wire))
    assert (again.payload.split(b" ")[0].decode(), again.remark) == (vector["command"], "")


def test_only_draft_0_leaves_the_sender_to_the_link() -> None:
    assert not draft("0").addressed
    assert draft("0.5").addressed
    assert draft("1").addressed


def test_a_frame_of_the_document_is_translated_and_one_of_the_same_draft_forwarded_as_it_came() -> None:
    (heard,) = frames(read(draft("1"), b"MNERIM 034 parafrente 100 PC 02123"))
    for version, wire in FRAMES.items():
        codec = draft(version)
        assert codec.encode(heard) == wire
        (again,) = frames(read(codec, wire))
        assert codec.encode(again) is again.wire
        assert draft(version, line_end="crlf").encode(again) == wire + b"\r\n"
    (of_half,) = frames(read(draft("0.5"), FRAMES["0.5"]))
    assert draft("1").encode(of_half) == heard.wire


@pytest.mark.parametrize("version", VERSIONS)
def test_frames_without_anything_between_are_all_heard_at_once(version: str) -> None:
    codec = draft(version)
    assert wires(codec.decode(FRAMES[version] * 3, 0.0)) == [FRAMES[version]] * 3
    assert not codec.pending


@pytest.mark.parametrize("version", VERSIONS)
def test_a_message_may_quote_a_whole_frame(version: str) -> None:
    quoting = draft(version).encode(message(PC, MNERIM, "texto", *FRAMES[version].decode().split(" "), "fim"))
    for pieces in ([quoting], cut(quoting)):
        assert wires(read(draft(version), *pieces)) == [quoting]


@pytest.mark.parametrize("version", VERSIONS)
def test_a_corrupt_size_swallows_no_frame_behind_it(version: str) -> None:
    codec = draft(version)
    good = FRAMES[version]
    assert codec.decode(b"MNERIM999parafrente 100 00001" + good, 0.0) == []
    assert codec.silence_s == RIPE_S
    assert wires(codec.flush(0.0)) == [good]
    assert wires(codec.decode(b"MNERIM999parafrente 100 00001" + good * 40, 0.0)) == [good] * 40


@pytest.mark.parametrize(
    ("version", "wire"), [("0.5", summed(b"PC026parafrente ROBO UM")), ("0.5", summed(b"PC028parafrente ROBO UM"))]
)
def test_a_known_sender_may_have_a_space(version: str, wire: bytes) -> None:
    (frame,) = frames(read(draft(version), wire))
    assert (frame.source, frame.payload) == (Address.named("ROBO UM"), b"parafrente")


def test_a_senders_digits_are_no_part_of_the_checksum() -> None:
    codec = draft("0.5")
    for digits in range(1000):
        sender = Address.named(f"R{digits}")
        wire = codec.encode(message(sender, PC, "ola"))
        assert [frame.source for frame in frames(codec.decode(wire, 0.0))] == [sender]


def test_the_name_ends_where_three_digits_follow_a_known_one() -> None:
    loose = summed(b"R2031ola PC")
    assert [f.destination.name for f in frames(read(draft("0.5", "R2", "PC"), loose))] == ["R2"]
    assert frames(read(draft("0.5", "R2031", "PC"), loose)) == []
    exact = summed(b"R2031019ola PC")
    assert [f.destination.name for f in frames(read(draft("0.5", "R2", "R2031", "PC"), exact))] == ["R2031"]
    assert [f.destination.name for f in frames(read(draft("0.5", "R2", "PC"), exact))] == ["R2"]


@pytest.mark.parametrize("version", VERSIONS)
def test_behind_a_name_that_nobody_knows_only_the_true_length_is_a_size(version: str) -> None:
    codec = draft(version, "OTHER")
    assert wires(read(codec, FRAMES[version])) == [FRAMES[version]]
    assert frames(read(codec, summed(FRAMES[version][:-5].replace(b"MNERIM0", b"MNERIM1")))) == []


def test_a_name_learned_between_two_frames_counts_for_the_second() -> None:
    directory = Directory()
    codec = PsiuAscii(PsiuAscii.Options(version="0.5"), directory)
    reply = b"PC033parafrente sucesso MNERIM02654"
    assert frames(read(codec, reply)) == []
    directory.all_names.add("PC")
    assert wires(read(codec, reply)) == [reply]


@pytest.mark.parametrize("version", VERSIONS)
def test_an_unpadded_checksum_counts_only_at_a_boundary(version: str) -> None:
    unpadded = FRAMES[version][:-5] + FRAMES[version][-4:]
    codec = draft(version)
    assert codec.decode(unpadded, 0.0) == []
    assert [frame.remark for frame in frames(codec.flush(0.0))] == ["checksum not padded"]
    assert frames(read(codec, unpadded + b"\x00")) == []
    assert reasons(read(draft(version, strict=True), unpadded)) == ["checksum"]


@pytest.mark.parametrize("version", VERSIONS)
def test_what_is_no_frame_is_told_with_its_reason(version: str) -> None:
    good = FRAMES[version]
    lines = [b"hello", good[:20], good[:-1] + b"0", b"CHECKSUM NAO BATEU!", summed(b"PC 099ola ")]
    assert reasons(read(draft(version, strict=True), b"\r\n".join(lines))) == [
        "noise", "unfinished", "checksum", COMPLAINT, "noise",
    ]  # fmt: skip
    assert reasons(read(draft(version, strict=True), summed(good[:-5].replace(b"0", b"1", 1)))) == ["size"]


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize(
    "frame",
    [
        message(PC, Address.named(""), "a"),
        message(PC, Address.numbered(3), "a"),
        message(PC, Address.named("A "), "a"),
        message(PC, Address.named("A" * (LONGEST_NAME + 1)), "a"),
        message(PC, MNERIM),
        message(PC, MNERIM, " a"),
        message(PC, MNERIM, "a\r\nb"),
        message(PC, MNERIM, "a" * 990),
        message(PC, MNERIM, "a")._replace(protocol="psiu-hexa"),
    ],
    ids=repr,
)
def test_what_no_frame_can_say_is_refused(version: str, frame: Frame) -> None:
    with pytest.raises(EncodeError):
        draft(version).encode(frame)


def test_a_name_that_would_be_read_as_another_and_its_size_is_refused() -> None:
    frame = message(PC, Address.named("R2031"), "x" * 15)
    assert len(draft("0.5", "R2031").encode(frame)) == 31
    with pytest.raises(EncodeError, match="would be read as R2"):
        draft("0.5", "R2", "R2031").encode(frame)


def test_a_sender_that_cannot_be_written_matters_only_where_it_is() -> None:
    frame = message(Address.numbered(3), MNERIM, "parafrente", "100")
    assert draft("0").encode(frame) == FRAMES["0"]
    with pytest.raises(EncodeError):
        draft("0.5").encode(frame)


@pytest.mark.parametrize("version", VERSIONS)
def test_bytes_that_are_no_text_may_stand_before_digits(version: str) -> None:
    codec = draft(version, "PC", "")
    assert reasons(read(codec, b"\xe1\xff123 45678\xe1PC")) == ["noise"]
    assert wires(codec.decode(b"123" + FRAMES[version], 0.0)) == [FRAMES[version]]


printable = st.characters(min_codepoint=0x20, max_codepoint=0x7E)
word = st.text(printable.filter(lambda char: char != " "), min_size=1, max_size=12)
name = st.sampled_from([*NAMES, "??"])
version = st.sampled_from(VERSIONS)


@st.composite
def streams(draw: st.DrawFn) -> tuple[str, bytes]:
    chosen = draw(version)
    codec = draft(chosen)

    def wire(source: str, destination: str, words: list[str]) -> bytes:
        try:
            return codec.encode(message(Address.named(source), Address.named(destination), *words))
        except EncodeError:
            return b""

    good = st.builds(wire, name, name, st.lists(word, min_size=1, max_size=6))
    loose = good.map(lambda frame: summed(frame[:-5].replace(b"0", b"1", 1)))
    unpadded = good.map(lambda frame: frame[:-5] + frame[-4:])
    junk = st.one_of(
        st.binary(max_size=30),
        st.sampled_from([b" ", b"\r\n", b"7 ", b"PC999", b"12345", b" 12345", b"\x00", b"CHECKSUM NAO BATEU!"]),
    )
    return chosen, b"".join(draw(st.lists(st.one_of(good, loose, unpadded, junk), max_size=12)))


@given(stream=streams(), cuts=st.lists(st.integers(0, 600), max_size=10), strict=st.booleans())
def test_any_cut_of_the_bytes_gives_the_same_events(stream: tuple[str, bytes], cuts: list[int], strict: bool) -> None:
    chosen, data = stream
    places = [0, *sorted(place for place in cuts if place < len(data)), len(data)]
    pieces = [data[start:end] for start, end in pairwise(places)]
    events = read(draft(chosen, strict=strict), data)
    assert read(draft(chosen, strict=strict), *pieces) == events
    assert read(draft(chosen, strict=strict), *cut(data)) == events
    warm = draft(chosen, strict=strict)
    assert read(warm, data) == read(warm, data) == events


@given(stream=streams(), strict=st.booleans())
@example(stream=("0.5", b"~12345"), strict=False)
@example(stream=("0.5", b"PC0140 PC00523\x00000"), strict=False)
def test_robots_that_are_not_spoken_of_change_nothing_however_many(stream: tuple[str, bytes], strict: bool) -> None:
    chosen, data = stream[0], stream[1].replace(b"\0", b"\1")
    others = ["\0" * size for size in range(1, LONGEST_NAME)]  # of which `data` does not speak
    assert read(draft(chosen, *NAMES, *others, strict=strict), data) == read(draft(chosen, strict=strict), data)


@given(stream=streams(), strict=st.booleans())
def test_every_event_holds_what_it_promises(stream: tuple[str, bytes], strict: bool) -> None:
    chosen, data = stream
    for event in read(draft(chosen, strict=strict), data):
        if isinstance(event, Malformed):
            assert 0 < len(event.wire) == min(event.size, MALFORMED_KEPT)
        else:
            assert event.wire in data
            assert event.subject.encode() == event.payload.split(b" ")[0]
            assert event.wire.startswith(event.destination.name.encode())
            assert bool(event.source.name) == (chosen == "0.5")
            assert (event.dialect == f"psiu-ascii/{chosen}") == (event.remark == "")
            assert not (strict and event.remark)


@given(chosen=version, source=name, destination=name, words=st.lists(word, min_size=1, max_size=10))
def test_what_is_encoded_is_decoded_as_it_was(chosen: str, source: str, destination: str, words: list[str]) -> None:
    codec = draft(chosen)
    frame = message(Address.named(source), Address.named(destination), *words)
    try:
        wire = codec.encode(frame)
    except EncodeError as error:
        assert "would be read as" in str(error)
        return
    (heard,) = read(codec, wire)
    assert isinstance(heard, Frame)
    if chosen == "0":
        frame = frame._replace(source=NOBODY)
    if " ".join([*words[1:], source]).endswith("ROBO UM") and source != "ROBO UM":
        return
    assert heard._replace(wire=b"", dialect="") == frame
    assert codec.whole(wire) is None


@given(chosen=version, noise=st.binary(max_size=60))
def test_after_noise_and_a_silence_the_next_good_frame_is_found(chosen: str, noise: bytes) -> None:
    codec = draft(chosen)
    read(codec, noise)
    assert wires(read(codec, FRAMES[chosen])) == [FRAMES[chosen]]


ENDLESS = [
    b"a",
    b" ",
    bytes(range(256)),
    b"PC123",
    b"12345",
    b" 12345",
    b"PC999 ",
    *FRAMES.values(),
    b"PC999" + FRAMES["0"],
]


@pytest.mark.parametrize("pattern", ENDLESS, ids=lambda pattern: repr(pattern[:20]))
@pytest.mark.parametrize("chosen", VERSIONS)
def test_endless_input_holds_bounded_memory(chosen: str, pattern: bytes) -> None:
    codec = draft(chosen)
    data = (pattern * 40_000)[:40_000]
    for at in range(0, len(data), 1000):
        codec.decode(data[at : at + 1000], 0.0)
        assert len(codec._run.text) <= 4096 + 1024
        assert len(codec._run._sums) == len(codec._run.text) + 1
        assert len(codec._run.fits) <= 800
        assert codec._noise.size <= 4096
    codec.flush(0.0)


@pytest.mark.parametrize("pattern", ENDLESS, ids=lambda pattern: repr(pattern[:20]))
@pytest.mark.parametrize("chosen", VERSIONS)
def test_a_byte_of_a_long_input_costs_no_more_than_one_of_a_short_input(chosen: str, pattern: bytes) -> None:
    def cost_s(size: int, rounds: int) -> float:
        data = (pattern * (size // len(pattern) + 1))[:size]
        costs = []
        for _ in range(rounds):
            codec = draft(chosen)
            start = time.process_time()
            codec.decode(data, 0.0)
            codec.flush(0.0)
            costs.append((time.process_time() - start) / size)
        return min(costs)

    assert cost_s(64_000, 1) < 16 * cost_s(2_000, 10)


class _Counted(set[str]):
    """Names that count how often each of them is looked at."""

    looked_at = 0

    def __iter__(self) -> Iterator[str]:
        for name in super().__iter__():
            self.looked_at += 1
            yield name

    def __contains__(self, name: object) -> bool:
        self.looked_at += 1
        return super().__contains__(name)


@pytest.mark.parametrize("version", VERSIONS)
def test_digits_cost_no_more_among_thousands_of_robots_whatever_their_names(version: str) -> None:
    def looks(many: int) -> int:
        names = _Counted("N" * length for length in range(1, many + 1))
        codec = PsiuAscii(PsiuAscii.Options(version=version), Directory(all_names=names))
        for _ in range(200):
            codec.decode(b"7", 0.0)
        codec.flush(0.0)
        return names.looked_at

    assert looks(900) <= looks(LONGEST_NAME)

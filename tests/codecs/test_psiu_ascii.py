import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from psiu_broker.codecs.codec import Directory, Event
from psiu_broker.codecs.psiu_ascii import RIPE_S, PsiuAscii, message
from psiu_broker.errors import EncodeError
from psiu_broker.frame import COMPLAINT, EVERYONE, MALFORMED_KEPT, Address, Frame, Malformed
from psiu_broker.protocols import CODECS

VECTORS = json.loads((Path(__file__).parents[1] / "vectors" / "psiu-ascii.json").read_text())
V1 = [vector for vector in VECTORS["frames"] if vector["dialect"] == "v1"]
TOLERATED = {"valid", "wrong-size", "unpadded-checksum"}
FRAME = b"MNERIM 034 parafrente 100 PC 02123"
OTHER = b"PC 038 parafrente sucesso MNERIM 02755"
DISCOVERY = b"?? 027 qualseunome PC 01753"
MNERIM, PC = Address.named("MNERIM"), Address.named("PC")


def ascii_codec(*names: str, **options: Any) -> PsiuAscii:
    return PsiuAscii(PsiuAscii.Options(**options), Directory(names=set(names)))


def read(codec: PsiuAscii, *pieces: bytes) -> list[Event]:
    events: list[Event] = []
    for piece in pieces:
        events += codec.decode(piece, 0.0)
    events += codec.flush(0.0)
    assert not codec.pending
    return events


def frames(events: Sequence[Event]) -> list[Frame]:
    return [event for event in events if isinstance(event, Frame)]


def reasons(events: Sequence[Event]) -> list[str]:
    return [event.reason for event in events if isinstance(event, Malformed)]


def cut(data: bytes) -> list[bytes]:
    return [bytes((byte,)) for byte in data]


def summed(text: bytes) -> bytes:
    """`text`, which ends in a space, with its checksum."""
    return text + b"%05d" % (sum(text) & 0xFFFF)


def check(vector: dict[str, Any], frame: Frame) -> None:
    assert frame.destination == Address.named(vector["destination"])
    assert frame.source == Address.named(vector["source"])
    assert frame.subject == vector["command"]
    assert frame.payload == " ".join([vector["command"], *vector["params"]]).encode()
    assert frame.wire == vector["wire"].encode()
    assert frame.protocol == "psiu-ascii"
    canonical = vector["verdict"] == "valid"
    assert frame.dialect == ("psiu-ascii/1" if canonical else "psiu-ascii/1/loose")
    assert bool(frame.remark) == (not canonical)


def accepted(vector: dict[str, Any], *, strict: bool) -> bool:
    return vector["verdict"] == "valid" if strict else vector["verdict"] in TOLERATED


@pytest.mark.parametrize("strict", [False, True], ids=["tolerant", "strict"])
@pytest.mark.parametrize("vector", V1, ids=lambda vector: vector["wire"][:40])
class TestEachGoldenFrame:
    def test_whole(self, vector: dict[str, Any], strict: bool) -> None:
        codec = ascii_codec("ROBO UM", strict=strict)
        for _ in range(2):  # with nothing remembered, and again when its words are
            events = read(codec, bytes.fromhex(vector["hex"]))
            assert len(events) == 1
            assert len(frames(events)) == accepted(vector, strict=strict)
            for frame in frames(events):
                check(vector, frame)

    def test_byte_by_byte(self, vector: dict[str, Any], strict: bool) -> None:
        wire = bytes.fromhex(vector["hex"])
        assert read(ascii_codec("ROBO UM", strict=strict), *cut(wire)) == read(
            ascii_codec("ROBO UM", strict=strict), wire
        )

    @pytest.mark.parametrize("trailing", [b"\r\n", b"\n", b"\r\n7 ", b"\x00", b"\r\n" + OTHER, OTHER])
    def test_with_trailing_bytes(self, vector: dict[str, Any], strict: bool, trailing: bytes) -> None:
        at_boundary = trailing[:1] in {b"\r", b"\n"}
        expected = accepted(vector, strict=strict) and (at_boundary or vector["verdict"] != "unpadded-checksum")
        events = read(ascii_codec("ROBO UM", strict=strict), bytes.fromhex(vector["hex"]) + trailing)
        heard = frames(events)
        assert len(heard) == expected + trailing.endswith(OTHER)
        if expected:
            check(vector, heard[0])

    @pytest.mark.parametrize("noise", [b"\xff\x00\x80", b"7 ", b"\x86 034 ", b"\r\n", b"xyz\r\n", b"zz\xe1"])
    def test_with_noise_around(self, vector: dict[str, Any], strict: bool, noise: bytes) -> None:
        around = b"\r\n" if vector["verdict"] == "unpadded-checksum" else noise
        events = read(ascii_codec("ROBO UM", strict=strict), noise + bytes.fromhex(vector["hex"]) + around)
        heard = frames(events)
        assert len(heard) == accepted(vector, strict=strict)
        if heard:
            check(vector, heard[0])


@pytest.mark.parametrize("stream", VECTORS["streams"], ids=lambda stream: stream["name"])
def test_each_golden_stream_whole_and_byte_by_byte(stream: dict[str, Any]) -> None:
    data = bytes.fromhex(stream["hex"])
    events = read(ascii_codec(), data)
    assert [frame.wire.decode() for frame in frames(events)] == stream["frames"]
    assert read(ascii_codec(), *cut(data)) == events


@pytest.mark.parametrize("vector", V1, ids=lambda vector: vector["wire"][:40])
def test_each_accepted_golden_frame_is_sent_with_its_true_size_and_whole_checksum(vector: dict[str, Any]) -> None:
    if vector["verdict"] == "refused":
        return
    codec = ascii_codec("ROBO UM")
    (heard,) = frames(read(codec, bytes.fromhex(vector["hex"])))
    wire = codec.encode(heard)
    assert wire == codec.encode(heard._replace(wire=b"", dialect=""))
    (again,) = frames(read(codec, wire))
    assert (again.source, again.destination, again.payload, again.remark) == (*heard[:2], heard.payload, "")
    assert (wire == heard.wire) == (vector["verdict"] == "valid")


def test_a_frame_is_heard_before_any_silence() -> None:
    codec = ascii_codec()
    assert len(codec.decode(FRAME, 0.0)) == 1
    assert not codec.pending
    assert codec.flush(0.0) == ()


def test_a_message_may_quote_a_whole_frame() -> None:
    quoting = ascii_codec().encode(message(PC, MNERIM, "texto", *OTHER.decode().split(), "fim"))
    for pieces in ([quoting], cut(quoting)):
        (frame,) = read(ascii_codec(), *pieces)
        assert isinstance(frame, Frame)
        assert frame.wire == quoting


def test_a_frame_held_back_by_a_corrupt_size_needs_only_a_short_silence() -> None:
    codec = ascii_codec(silence_ms=500)
    assert codec.silence_s == 0.5
    assert codec.decode(b"MNERIM 999 parafrente 100 PC 02123", 0.0) == []
    assert codec.silence_s == 0.5
    assert codec.decode(OTHER, 0.0) == []
    assert (codec.pending, codec.silence_s) == (True, RIPE_S)
    assert [frame.wire for frame in frames(codec.flush(0.0))] == [OTHER]
    assert (codec.pending, codec.silence_s) == (False, 0.5)


def test_frames_behind_a_corrupt_size_come_without_any_silence_once_its_claim_has_failed() -> None:
    codec = ascii_codec()
    heard = frames(codec.decode(b"MNERIM 999 parafrente 100 PC 02123" + OTHER * 40, 0.0))
    assert [frame.wire for frame in heard] == [OTHER] * 40


def test_a_size_too_large_by_a_client_is_forgiven_at_once_behind_a_line_end() -> None:
    codec = ascii_codec()
    (frame,) = codec.decode(b"MNERIM 131 parafrente 100 PC 02121\r\n", 0.0)
    assert isinstance(frame, Frame)
    assert frame.remark == "size 131, not 034"


def test_an_unpadded_checksum_counts_only_at_a_boundary() -> None:
    unpadded = FRAME.replace(b"02123", b"2123")
    codec = ascii_codec()
    assert codec.decode(unpadded, 0.0) == []
    (frame,) = codec.flush(0.0)
    assert isinstance(frame, Frame)
    assert frame.remark == "checksum not padded"
    assert len(frames(codec.decode(unpadded + b"\r", 0.0))) == 1
    assert [frame.wire for frame in frames(read(codec, unpadded + OTHER))] == [OTHER]
    assert frames(read(codec, unpadded + b"\x00")) == []
    assert reasons(read(ascii_codec(strict=True), unpadded)) == ["checksum"]


def test_an_unpadded_checksum_is_remarked_upon_even_where_the_size_agrees() -> None:
    (frame,) = frames(read(ascii_codec(), b"MNERIM 033 parafrente 100 PC 2122"))
    assert (frame.dialect, frame.remark) == ("psiu-ascii/1/loose", "checksum not padded")
    assert ascii_codec().encode(frame) == FRAME
    assert frames(read(ascii_codec(strict=True), frame.wire)) == []


def test_half_a_frame_is_given_up_by_silence() -> None:
    codec = ascii_codec()
    assert codec.decode(FRAME[:20], 0.0) == []
    assert codec.pending
    assert codec.flush(0.0) == [Malformed("unfinished", FRAME[:20], 20)]
    assert [frame.wire for frame in frames(read(codec, FRAME))] == [FRAME]


@pytest.mark.parametrize("parameters", [b"1\x1f0", b"1\x7f0", b"1\xb20", b"\xe9\xe9\xe9", b"1\n0"])
def test_no_frame_with_a_byte_that_is_not_printable_is_told_at_a_glance(parameters: bytes) -> None:
    codec = ascii_codec()
    read(codec, FRAME)
    assert codec.whole(FRAME) is not None
    assert codec.whole(summed(b"MNERIM 034 parafrente %b PC " % parameters)) is None


def test_the_complaint_of_a_robot_is_told_apart_from_noise() -> None:
    complaint = Malformed(COMPLAINT, b"CHECKSUM NAO BATEU!", 19)
    assert ascii_codec().decode(b"CHECKSUM NAO BATEU!\r\n", 0.0) == [complaint]
    assert read(ascii_codec(), *cut(b"7 CHECKSUM NAO BATEU!")) == [Malformed("noise", b"7 ", 2), complaint]
    heard = read(ascii_codec(), b"CHECKSUM NAO BATEU!" + FRAME + b"CHECKSUM NAO BATEU!")
    assert [event if isinstance(event, Malformed) else event.wire for event in heard] == [complaint, FRAME, complaint]
    assert read(ascii_codec(strict=True), b"CHECKSUM NAO BATEU!") == [complaint]


def test_a_complaint_before_a_frame_with_a_wrong_size_is_not_part_of_its_name() -> None:
    events = read(ascii_codec(), b"CHECKSUM NAO BATEU!?? 029 qualseunome PC 01755")
    assert reasons(events) == [COMPLAINT]
    assert [frame.destination for frame in frames(events)] == [EVERYONE]


def test_line_ends_and_spaces_between_frames_are_nothing() -> None:
    assert len(read(ascii_codec(), b"\r\n  \r\n" + FRAME + b"  \r\n \n" + OTHER + b"   ")) == 2


def test_each_line_of_junk_is_one_malformed_with_its_reason() -> None:
    lines = [b"hello", b"MNERIM 034 para", FRAME[:-1] + b"4", b"x" * 1500]
    events = read(ascii_codec(), b"\r\n".join(lines))
    assert reasons(events) == ["noise", "unfinished", "checksum", "noise"]
    assert [(len(event.wire), event.size) for event in events if isinstance(event, Malformed)] == [
        (5, 5), (15, 15), (34, 34), (MALFORMED_KEPT, 1500),
    ]  # fmt: skip


def test_binary_junk_is_one_malformed_with_the_text_in_it() -> None:
    assert read(ascii_codec(), b"\xffab\x00cd" + FRAME)[0] == Malformed("noise", b"\xffab\x00cd", 6)


@pytest.mark.parametrize("byte", [0x00, 0x09, 0x1F, 0x7F, 0x80, 0xE1, 0xFF])
def test_a_frame_with_a_byte_that_is_not_printable_is_refused(byte: int) -> None:
    wire = summed(b"PC 029 texto a%cb MNERIM " % byte)
    codec = ascii_codec()
    read(codec, ascii_codec().encode(message(MNERIM, PC, "texto", "axb")))
    assert frames(read(codec, wire)) == []


@pytest.mark.parametrize(
    "wire",
    [
        b" 020 texto PC ",  # no destination
        b"PC 017 texto ",  # no message, or no sender
        b"PC 020 texto  ",  # an empty sender
        b"PC  022 texto PC ",  # a destination that ends in a space
        b"PC 022  texto PC ",  # a message that begins with a space
    ],
)
def test_a_right_sum_does_not_make_a_frame_of_what_lacks_a_part(wire: bytes) -> None:
    assert frames(read(ascii_codec(), summed(wire))) == []


def test_a_sum_above_65535_is_said_modulo_65536_or_not_at_all() -> None:
    body = b"ROBO 724 texto %b PC " % (b"z" * 700)
    assert sum(body) > 65536
    assert len(frames(read(ascii_codec(), summed(body)))) == 1
    assert frames(read(ascii_codec(), body + b"%05d" % sum(body))) == []


def test_a_frame_of_more_than_999_bytes_is_none_whatever_its_size_says() -> None:
    for letters, expected in ((979, 1), (980, 0)):
        wire = summed(b"ROBO 001 a %b PC " % (b"z" * letters))
        assert len(wire) == 999 + (1 - expected)
        assert len(frames(read(ascii_codec(), wire))) == expected


@pytest.mark.parametrize(
    ("names", "source", "payload"),
    [
        ((), "UM", b"parafrente sucesso ROBO"),
        (("ROBO UM",), "ROBO UM", b"parafrente sucesso"),
        (("UM", "ROBO UM"), "ROBO UM", b"parafrente sucesso"),
        (("ROBO UM", "sucesso ROBO UM"), "sucesso ROBO UM", b"parafrente"),
        (("parafrente sucesso ROBO UM",), "UM", b"parafrente sucesso ROBO"),
    ],
)
def test_the_sender_is_the_longest_known_name_that_leaves_a_message(
    names: tuple[str, ...], source: str, payload: bytes
) -> None:
    codec = ascii_codec(*names)
    for _ in range(2):
        (frame,) = frames(read(codec, b"PC 039 parafrente sucesso ROBO UM 02800"))
        assert (frame.source, frame.payload, frame.subject) == (Address.named(source), payload, "parafrente")


def test_a_name_learned_between_two_frames_counts_for_the_second() -> None:
    directory = Directory()
    codec = PsiuAscii(PsiuAscii.Options(), directory)
    wire = b"PC 039 parafrente sucesso ROBO UM 02800"
    assert frames(codec.decode(wire, 0.0))[0].source == Address.named("UM")
    assert frames(codec.decode(wire, 0.0))[0].source == Address.named("UM")
    directory.names.add("ROBO UM")
    assert frames(codec.decode(wire, 0.0))[0].source == Address.named("ROBO UM")


def test_a_message_of_our_own_is_sent_as_the_document_prints_it() -> None:
    codec = ascii_codec()
    assert codec.encode(message(PC, MNERIM, "parafrente", "100")) == FRAME
    assert codec.encode(message(PC, EVERYONE, "qualseunome")) == DISCOVERY
    frame = message(PC, MNERIM, "parafrente", "100")
    assert frame == Frame(PC, MNERIM, "parafrente", b"parafrente 100", "psiu-ascii")


def test_a_canonical_frame_is_forwarded_as_it_came_and_a_loose_one_mended() -> None:
    codec = ascii_codec()
    (heard,) = frames(read(codec, OTHER))
    assert heard.dialect == codec.dialect
    assert codec.encode(heard) is heard.wire
    (loose,) = frames(read(codec, b"?? 029 qualseunome PC 01755"))
    assert loose.dialect != codec.dialect
    assert codec.encode(loose) == DISCOVERY


def test_a_line_end_is_added_only_where_the_options_say_so() -> None:
    codec = ascii_codec(line_end="crlf")
    (heard,) = frames(read(codec, OTHER))
    assert heard.dialect != codec.dialect  # else a link would forward it without its line end
    assert codec.encode(heard) == OTHER + b"\r\n"
    assert codec.encode(message(PC, MNERIM, "parafrente", "100")) == FRAME + b"\r\n"


@pytest.mark.parametrize(
    "frame",
    [
        message(PC, Address.named(""), "a"),
        message(Address.named(""), PC, "a"),
        message(PC, Address.numbered(3), "a"),
        message(Address.numbered(3), PC, "a"),
        message(PC, Address.named("ROBÔ"), "a"),
        message(PC, Address.named("A\nB"), "a"),
        message(PC, Address.named(" A"), "a"),
        message(PC, Address.named("A "), "a"),
        message(PC, Address.named("A 100"), "a"),
        message(PC, Address.named("A 100 B"), "a"),
        message(PC, MNERIM),
        message(PC, MNERIM, ""),
        message(PC, MNERIM, " a"),
        message(PC, MNERIM, "maçã"),
        message(PC, MNERIM, "a\r\nb"),
        message(PC, MNERIM, "\ud800"),
        message(PC, MNERIM, "a")._replace(protocol="psiu-hexa"),
    ],
    ids=repr,
)
def test_what_no_frame_can_say_is_refused(frame: Frame) -> None:
    with pytest.raises(EncodeError):
        ascii_codec().encode(frame)


def test_the_longest_frame_has_999_bytes() -> None:
    codec = ascii_codec()
    wire = codec.encode(message(PC, MNERIM, "a" * 979))
    assert len(wire) == 999
    assert [frame.wire for frame in frames(read(codec, wire))] == [wire]
    with pytest.raises(EncodeError, match="1000"):
        codec.encode(message(PC, MNERIM, "a" * 980))


def test_digits_alone_in_a_senders_name_are_no_size() -> None:
    codec = ascii_codec("R 100")
    wire = codec.encode(message(Address.named("R 100"), PC, "ok"))
    assert [frame.source.name for frame in frames(read(codec, wire))] == ["R 100"]


def test_the_codec_is_found_by_its_protocol() -> None:
    assert CODECS["psiu-ascii"] is PsiuAscii

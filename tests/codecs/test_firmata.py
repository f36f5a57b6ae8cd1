"""Firmata's stream, both ways, and its messages by name (firmata/protocol, protocol.md)."""

import time
from itertools import pairwise
from typing import get_args

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from psiu_broker.codecs import firmata_messages as fm
from psiu_broker.codecs.codec import Directory, Event
from psiu_broker.codecs.firmata import LONGEST, Firmata, Role, message, messages, subject
from psiu_broker.errors import EncodeError
from psiu_broker.frame import MALFORMED_KEPT, NOBODY, Frame, Malformed

ROLES: list[Role] = list(get_args(Role))
OTHER: dict[Role, Role] = {"host": "board", "board": "host"}

seven = st.integers(0, 127)
short = st.integers(0, (1 << 14) - 1)
low = st.integers(0, 15)
texts = st.text(max_size=12)
either = st.one_of(
    st.builds(fm.AnalogMessage, low, short),
    st.builds(fm.DigitalMessage, low, short),
    st.builds(fm.Text, texts),
    st.builds(fm.Sysex, st.integers(0, 0x50), st.lists(seven, max_size=12).map(bytes)),
)
from_board = st.one_of(
    either,
    st.builds(fm.Version, seven, seven),
    st.builds(fm.Firmware, seven, seven, texts),
    st.builds(
        fm.Capabilities,
        st.lists(st.dictionaries(st.integers(0, 126), seven, max_size=4), max_size=6).map(tuple),
    ),
    st.builds(fm.AnalogMapping, st.lists(st.one_of(st.none(), low), max_size=20).map(tuple)),
    st.builds(fm.PinState, seven, seven, st.integers(0, 1 << 20)),
    st.builds(fm.PinState, seven, st.none()),
    st.builds(fm.Identity, seven),
)
from_host = st.one_of(
    either,
    st.builds(fm.AnalogMessage, seven, st.integers(0, 1 << 30)),
    st.builds(fm.ReportAnalog, low, st.booleans()),
    st.builds(fm.ReportDigital, low, st.booleans()),
    st.builds(fm.PinMode, seven, seven),
    st.builds(fm.PinValue, seven, st.booleans()),
    st.builds(fm.AskPinState, seven),
    st.builds(fm.ServoConfig, seven, short, short),
    st.builds(fm.Sampling, short),
    st.sampled_from(
        [
            fm.ASK_VERSION_MESSAGE,
            fm.RESET_MESSAGE,
            fm.ASK_FIRMWARE_MESSAGE,
            fm.ASK_CAPABILITIES_MESSAGE,
            fm.ASK_MAPPING_MESSAGE,
            fm.ASK_ID_MESSAGE,
        ]
    ),
)
said_by = {"board": from_board, "host": from_host}
junk = st.one_of(
    st.binary(max_size=12),
    st.lists(st.sampled_from([0, 1, 127, 0x90, 0xA0, 0xC0, 0xE0, 0xF0, 0xF4, 0xF7, 0xF9, 0xFE, 0xFF]), max_size=12).map(
        bytes
    ),
)


def firmata(role: Role = "host") -> Firmata:
    return Firmata(Firmata.Options(role=role), Directory())


def read(codec: Firmata, *pieces: bytes) -> list[Event]:
    events: list[Event] = []
    for piece in pieces:
        events += codec.decode(piece, 0.0)
    events += codec.flush(0.0)
    return events


def heard(role: Role, data: str) -> list[tuple[str, str]]:
    return [
        (event.subject, event.wire.hex()) if isinstance(event, Frame) else (f"?{event.reason}", event.wire.hex())
        for event in read(firmata(role), bytes.fromhex(data))
    ]


@st.composite
def streams(draw: st.DrawFn) -> tuple[Role, bytes]:
    role = draw(st.sampled_from(ROLES))
    parts = draw(st.lists(st.one_of(said_by[OTHER[role]].map(lambda each: each.wire), junk), max_size=12))
    return role, b"".join(parts)


@pytest.mark.parametrize(
    ("wire", "told", "expected"),
    [
        ("e07f07", "analog/0", fm.AnalogMessage(0, 1023)),
        ("ef0000", "analog/15", fm.AnalogMessage(15, 0)),
        ("910001", "digital/1", fm.DigitalMessage(1, 0x80)),
        ("f90205", "version", fm.Version(2, 5)),
        ("f0790205530074006400f7", "firmware", fm.Firmware(2, 5, "Std")),
        ("f06c7f000101017f02" + "0a7ff7", "capabilities", fm.Capabilities(({}, {0: 1, 1: 1}, {2: 10}))),
        ("f06a7f0001f7", "mapping", fm.AnalogMapping((None, 0, 1))),
        ("f06e09045af7", "pin-state/9", fm.PinState(9, 4, 90)),
        ("f06e09043401f7", "pin-state/9", fm.PinState(9, 4, 180)),
        ("f06e63f7", "pin-state/99", fm.PinState(99, None)),
        ("f0716f006900f7", "string", fm.Text("oi")),
        ("f05203f7", "id", fm.Identity(3)),
        ("f07768000100f7", "sysex/77", fm.Sysex(0x77, bytes((0x68, 0, 1, 0)))),
        ("f000010203f7", "sysex/00", fm.Sysex(0, bytes((1, 2, 3)))),
    ],
)
def test_what_a_board_says_is_told_by_its_word(wire: str, told: str, expected: fm.Message) -> None:
    assert heard("host", wire) == [(told, wire)]
    assert fm.read(bytes.fromhex(wire)) == expected
    assert expected.wire.hex() == wire


@pytest.mark.parametrize(
    ("wire", "told", "expected"),
    [
        ("e95a00", "write-analog/9", fm.AnalogMessage(9, 90)),
        ("f06f165a00f7", "write-analog/22", fm.AnalogMessage(22, 90)),
        ("f06f09000001f7", "write-analog/9", fm.AnalogMessage(9, 1 << 14)),
        ("912000", "write-digital/1", fm.DigitalMessage(1, 0x20)),
        ("c001", "report-analog/0", fm.ReportAnalog(0, True)),
        ("d100", "report-digital/1", fm.ReportDigital(1, False)),
        ("f40d01", "pin-mode/13", fm.PinMode(13, 1)),
        ("f50d01", "write-pin/13", fm.PinValue(13, True)),
        ("f9", "ask/version", fm.ASK_VERSION_MESSAGE),
        ("ff", "reset", fm.RESET_MESSAGE),
        ("f079f7", "ask/firmware", fm.ASK_FIRMWARE_MESSAGE),
        ("f06bf7", "ask/capabilities", fm.ASK_CAPABILITIES_MESSAGE),
        ("f069f7", "ask/mapping", fm.ASK_MAPPING_MESSAGE),
        ("f06d0df7", "ask/pin-state", fm.AskPinState(13)),
        ("f051f7", "ask/id", fm.ASK_ID_MESSAGE),
        ("f07a1300f7", "sampling", fm.Sampling(19)),
        ("f07009200460" + "12f7", "servo/9", fm.ServoConfig(9, 544, 2400)),
    ],
)
def test_what_a_program_says_is_told_by_its_word(wire: str, told: str, expected: fm.Message) -> None:
    assert heard("board", wire) == [(told, wire)]
    assert fm.read(bytes.fromhex(wire)) == expected
    assert expected.wire.hex() == wire


def test_the_first_words_of_a_board_are_two_messages() -> None:
    boot = "f90205f0790205530074006400f7"
    assert heard("host", boot) == [("version", boot[:6]), ("firmware", boot[6:])]


def test_a_version_without_numbers_is_a_question_and_only_programs_ask() -> None:
    assert heard("board", "f9 02 05") == [("ask/version", "f9"), ("?noise", "0205")]
    assert heard("host", "f9 e07f07") == [("?unfinished", "f9"), ("analog/0", "e07f07")]


@pytest.mark.parametrize("wire", ["c001", "d001", "f40d01", "f50d01", "ff"])
def test_what_only_programs_say_is_noise_from_a_board(wire: str) -> None:
    assert heard("host", wire) == [("?noise", wire)]


@pytest.mark.parametrize(
    ("data", "events"),
    [
        ("0102", [("?noise", "0102")]),
        ("0102e07f070304", [("?noise", "0102"), ("analog/0", "e07f07"), ("?noise", "0304")]),
        ("a0010280f6f7", [("?noise", "a0010280f6f7")]),
        ("e07f", [("?unfinished", "e07f")]),
        ("e07fe10102", [("?unfinished", "e07f"), ("analog/1", "e10102")]),
        ("f07902e10102f7", [("?unfinished", "f07902"), ("analog/1", "e10102"), ("?noise", "f7")]),
        ("f0f0510cf7", [("?unfinished", "f0"), ("ask/id", "f0510cf7")]),
        ("f0f7", [("?empty", "f0f7")]),
        ("e07f8207", [("?noise", "e07f8207")]),
        ("e0e0e0e00102", [("?noise", "e0e0e0"), ("analog/0", "e00102")]),
    ],
)
def test_what_is_no_message_is_said_to_be_none(data: str, events: list[tuple[str, str]]) -> None:
    assert heard("host", data) == events


@pytest.mark.parametrize("step", [1, 7, 5000])
def test_a_message_without_an_end_is_given_up_and_the_next_one_is_heard(step: int) -> None:
    data = b"\xf0\x71" + bytes(5000) + b"\xf7" + b"\xe0\x01\x02"
    events = read(firmata(), *(data[at : at + step] for at in range(0, len(data), step)))
    assert events[0] == Malformed("too long", data[:MALFORMED_KEPT], LONGEST)
    assert events[1] == Malformed("noise", bytes(MALFORMED_KEPT), len(data) - 3 - LONGEST)
    assert [event.subject for event in events[2:] if isinstance(event, Frame)] == ["analog/0"]


def test_the_longest_message_is_heard() -> None:
    wire = b"\xf0\x71" + bytes(LONGEST - 3) + b"\xf7"
    assert [event.wire for event in read(firmata(), wire) if isinstance(event, Frame)] == [wire]


@given(stream=streams(), cuts=st.lists(st.integers(0, 200), max_size=12))
def test_any_cut_of_the_bytes_gives_the_same_events(stream: tuple[Role, bytes], cuts: list[int]) -> None:
    role, data = stream
    places = [0, *sorted(place for place in cuts if place < len(data)), len(data)]
    expected = read(firmata(role), data)
    assert read(firmata(role), *(data[start:end] for start, end in pairwise(places))) == expected
    assert read(firmata(role), *(bytes((byte,)) for byte in data)) == expected


@given(stream=streams())
@example(stream=("board", fm.Text("more than StandardFirmata has room for").wire))
def test_every_byte_is_in_one_event_and_every_event_holds_what_it_promises(stream: tuple[Role, bytes]) -> None:
    role, data = stream
    codec = firmata(role)
    events = read(codec, data)
    assert not codec.pending
    sizes = [len(event.wire) if isinstance(event, Frame) else event.size for event in events]
    assert sum(sizes) == len(data)
    at = 0
    for event, size in zip(events, sizes, strict=True):
        if isinstance(event, Frame):
            assert event.payload == event.wire == data[at : at + size]
            assert (event.source, event.destination, event.protocol) == (NOBODY, NOBODY, "firmata")
            assert messages(event.payload, OTHER[role]) == [event.wire]
            assert event.subject == subject(event.wire, OTHER[role])
            assert 1 <= len(event.subject.split("/")) <= 2
            roomy = Firmata(Firmata.Options(role=OTHER[role], buffer=LONGEST), Directory())
            assert roomy.encode(event) == event.wire
        else:
            assert event.reason in {"noise", "unfinished", "empty"}
            assert event.wire == data[at : at + size][:MALFORMED_KEPT]
        at += size


@given(st.data(), st.sampled_from(ROLES))
def test_messages_come_through_whole_and_in_order(data: st.DataObject, role: Role) -> None:
    said = data.draw(st.lists(said_by[OTHER[role]], max_size=12))
    events = read(firmata(role), b"".join(each.wire for each in said))
    assert [fm.read(event.wire) for event in events if isinstance(event, Frame)] == said
    assert len(events) == len(said)


@given(noise=junk, role=st.sampled_from(ROLES))
def test_behind_any_noise_the_next_message_is_heard(noise: bytes, role: Role) -> None:
    *_, last = read(firmata(role), noise + b"\xe0\x7f\x07")
    assert isinstance(last, Frame)
    assert last.wire == b"\xe0\x7f\x07"


@given(st.one_of(st.binary(max_size=6), streams().map(lambda stream: stream[1][:6])), st.sampled_from(ROLES))
def test_what_is_told_at_a_glance_is_what_reading_tells(data: bytes, role: Role) -> None:
    frame = firmata(role).whole(data)
    assert frame is None or read(firmata(role), data) == [frame]


def test_analog_and_digital_messages_are_told_at_a_glance() -> None:
    assert [firmata().whole(bytes.fromhex(each)) is None for each in ("e07f07", "9f0001", "e07f", "c001")] == [
        False,
        False,
        True,
        True,
    ]


@given(st.data(), st.sampled_from(ROLES))
def test_what_one_side_sends_the_other_hears(data: st.DataObject, role: Role) -> None:
    said = data.draw(st.lists(said_by[role], min_size=1, max_size=5))
    payload = b"".join(each.wire for each in said)
    frame = message(payload, role)
    assert firmata(role).encode(frame) == payload
    first, *_ = read(firmata(OTHER[role]), payload)
    assert isinstance(first, Frame)
    assert first.subject == frame.subject


@pytest.mark.parametrize(
    ("payload", "role"),
    [
        ("", "host"),
        ("01", "host"),
        ("e07f", "host"),
        ("e07f80", "host"),
        ("e07f0701", "host"),
        ("f90205", "host"),
        ("f079", "host"),
        ("f0f7", "host"),
        ("f079e0f7", "host"),
        ("f9", "board"),
        ("ff", "board"),
        ("c001", "board"),
    ],
)
def test_what_is_no_message_of_ours_is_not_sent(payload: str, role: Role) -> None:
    with pytest.raises(EncodeError):
        message(bytes.fromhex(payload), role)
    with pytest.raises(EncodeError):
        firmata(role).encode(Frame(NOBODY, NOBODY, "x", bytes.fromhex(payload), "firmata"))


def test_other_protocols_and_more_than_the_board_has_room_for_are_not_sent() -> None:
    with pytest.raises(EncodeError, match="a frame of psiu-ascii cannot be sent as firmata"):
        firmata().encode(Frame(NOBODY, NOBODY, "x", b"\xff", "psiu-ascii"))
    text = message(fm.Text("x" * 32).wire)
    with pytest.raises(EncodeError, match=r"65 bytes are more than the board has room for \(64\)"):
        firmata().encode(text)
    assert Firmata(Firmata.Options(buffer=128)).encode(text)
    assert firmata("board").encode(message(text.payload, "board"))


def test_a_codec_can_be_made_without_options() -> None:
    assert read(Firmata(), b"\xe0\x01\x01")
    assert not Firmata.addressed


@given(st.binary(max_size=40), st.booleans())
def test_reading_a_message_never_raises_and_what_is_read_can_be_written(data: bytes, framed: bool) -> None:
    wire = b"\xf0" + bytes(byte & 0x7F for byte in data) + b"\xf7" if framed else data
    told = fm.read(wire)
    assert told is None or fm.read(told.wire) == told


@pytest.mark.parametrize(
    "wire", ["", "e0", "f0", "f0f7", "f06c00f7", "f06c0001f7", "f07902f7", "f06ef7", "f06ff7", "a0"]
)
def test_what_makes_no_sense_is_no_message(wire: str) -> None:
    assert fm.read(bytes.fromhex(wire)) is None


@given(st.integers(0, 1 << 40), st.integers(0, 6))
def test_numbers_in_seven_bits_come_back(value: int, least: int) -> None:
    data = fm.seven_bit(value, least)
    assert data.isascii()
    assert len(data) >= least
    assert fm.from_seven_bit(data) == value


@given(st.text())
def test_text_comes_back(text: str) -> None:
    assert fm.from_text_bytes(fm.text_bytes(text)) == text


@given(st.lists(seven, max_size=20).map(bytes))
def test_any_text_can_be_read(data: bytes) -> None:
    assert len(fm.from_text_bytes(data)) <= len(data)


def test_modes_have_names() -> None:
    assert [fm.mode_name(mode) for mode in (0, 3, 11, 14)] == ["input", "pwm", "pullup", "mode 14"]


ENDLESS = {
    "data": b"\x01",
    "begun": b"\xf0",
    "statuses": b"\xe0",
    "sysex": b"\xf0" + b"\x01" * 20_000,
    "good": b"\xe0\x01\x02",
}


@pytest.mark.parametrize("pattern", ENDLESS.values(), ids=ENDLESS.keys())
@pytest.mark.parametrize("step", [1, 1000])
def test_endless_input_holds_bounded_memory(pattern: bytes, step: int) -> None:
    codec = firmata()
    data = (pattern * (30_000 // len(pattern) + 1))[:30_000]
    for at in range(0, len(data), step):
        codec.decode(data[at : at + step], 0.0)
        assert len(codec._begun) <= LONGEST
        assert codec._noise.size <= 4096


@pytest.mark.parametrize("pattern", ENDLESS.values(), ids=ENDLESS.keys())
def test_a_byte_of_a_long_input_costs_no_more_than_one_of_a_short_input(pattern: bytes) -> None:
    def cost_s(size: int, rounds: int) -> float:
        data = (pattern * (size // len(pattern) + 1))[:size]
        costs = []
        for _ in range(rounds):
            codec = firmata()
            start = time.process_time()
            codec.decode(data, 0.0)
            codec.flush(0.0)
            costs.append((time.process_time() - start) / size)
        return min(costs)

    assert cost_s(256_000, 1) < 16 * cost_s(4_000, 20)


@pytest.mark.parametrize("head", [(0x6E, 3, 3), (0x6F, 3)])
def test_a_value_of_more_bits_than_any_pin_has_is_none(head: tuple[int, ...]) -> None:
    assert fm.read(bytes((0xF0, *head)) + b"\x7f" * 5 + b"\xf7") is not None
    assert fm.read(bytes((0xF0, *head)) + b"\x7f" * 4000 + b"\xf7") is None

from collections.abc import Sequence
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from psiu_broker.codecs.amarino import (
    LONGEST_MESSAGE,
    LONGEST_TEXT,
    Amarino,
    Role,
    flag_subject,
    flag_trouble,
    text_trouble,
    values,
    values_text,
)
from psiu_broker.codecs.codec import Event
from psiu_broker.errors import EncodeError
from psiu_broker.frame import NOBODY, Frame, Malformed

ROLES: list[Role] = ["phone", "board"]


def amarino(role: Role = "phone") -> Amarino:
    return Amarino(Amarino.Options(role=role))


def other(role: Role) -> Amarino:
    return amarino("board" if role == "phone" else "phone")


def read(codec: Amarino, *pieces: bytes) -> list[Event]:
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


def order(message: bytes) -> Frame:
    return Frame(NOBODY, NOBODY, flag_subject(message[0]) if message else "flag/", message, "amarino")


def text(payload: bytes) -> Frame:
    return Frame(NOBODY, NOBODY, "text", payload, "amarino")


def test_a_board_hears_a_flag_a_text_and_an_end() -> None:
    assert amarino("phone").encode(order(b"A180;45")) == b"A180;45\x13"
    (frame,) = read(amarino("board"), b"A180;45\x13")
    assert frame == order(b"A180;45")._replace(wire=b"A180;45\x13", dialect="amarino/phone")


def test_a_phone_hears_a_text_between_a_start_and_an_end() -> None:
    assert amarino("board").encode(text(b"21.50;3")) == b"\x1221.50;3\x13"
    (frame,) = read(amarino("phone"), b"\x1221.50;3\x13")
    assert frame == text(b"21.50;3")._replace(wire=b"\x1221.50;3\x13", dialect="amarino/board")


def test_its_messages_name_nobody() -> None:
    assert not Amarino.addressed


def test_a_message_is_whole_before_any_silence() -> None:
    for role, data in (("phone", b"\x12ok\x13"), ("board", b"A\x13")):
        codec = Amarino(Amarino.Options.model_validate({"role": role}))
        assert len(codec.decode(data, 0.0)) == 1
        assert not codec.pending


@pytest.mark.parametrize("flag", [chr(flag) for flag in range(0x30, 0x7B)])
def test_every_flag_from_0_to_z_goes_there_and_back(flag: str) -> None:
    wire = amarino("phone").encode(order(flag.encode() + b"1"))
    (frame,) = frames(read(amarino("board"), wire))
    assert (frame.subject, frame.payload) == (f"flag/{flag}", flag.encode() + b"1")


@pytest.mark.parametrize("message", [b"", *(bytes((flag,)) for flag in range(0x30)), b"/1", b" A", b"-5"])
def test_a_message_that_crashes_a_board_is_never_sent(message: bytes) -> None:
    with pytest.raises(EncodeError, match="crashes"):
        amarino("phone").encode(order(message))


@pytest.mark.parametrize("message", [b"", *(bytes((flag,)) for flag in range(0x30) if flag not in b"\x11\x13\x1b")])
def test_a_message_that_crashes_a_board_is_none_when_a_phone_says_it(message: bytes) -> None:
    events = read(amarino("board"), message + b"\x13" + b"A1\x13")
    assert reasons(events) == ["flag"]
    assert [frame.payload for frame in frames(events)] == [b"A1"]


def test_a_phone_that_says_that_it_is_alive_is_heard_and_never_sent_on_to_a_board() -> None:
    (frame,) = frames(read(amarino("board"), b"\x11\x13"))
    assert frame.subject == "alive"
    assert frame.dialect != amarino("phone").dialect
    with pytest.raises(EncodeError):
        amarino("phone").encode(frame)


@pytest.mark.parametrize("byte", [0x11, 0x12, 0x13, 0x1B])
def test_no_text_holds_a_mark(byte: int) -> None:
    for role, frame in (("phone", order(b"A%c" % byte)), ("board", text(b"A%c" % byte))):
        with pytest.raises(EncodeError, match=f"0x{byte:02x}"):
            Amarino(Amarino.Options.model_validate({"role": role})).encode(frame)


def test_a_board_keeps_64_bytes_and_is_sent_no_more() -> None:
    assert len(amarino("phone").encode(order(b"A" * LONGEST_MESSAGE))) == 65
    with pytest.raises(EncodeError, match="65 bytes"):
        amarino("phone").encode(order(b"A" * 65))
    assert frames(read(amarino("board"), b"A" * 65 + b"\x13")) == []
    with pytest.raises(EncodeError):
        amarino("board").encode(text(b"x" * (LONGEST_TEXT + 1)))


@pytest.mark.parametrize("role", ROLES)
def test_each_side_says_only_what_is_its_own(role: Role) -> None:
    frame = text(b"A1") if role == "phone" else order(b"A1")
    with pytest.raises(EncodeError):
        amarino(role).encode(frame)
    with pytest.raises(EncodeError):
        amarino(role).encode(frame._replace(protocol="psiu-ascii"))
    (heard,) = frames(read(amarino(role), other(role).encode(frame)))
    assert heard.dialect != amarino(role).dialect  # else a link would send it back as it came
    assert other(role).encode(heard) is heard.wire


@pytest.mark.parametrize(
    ("role", "data", "expected"),
    [
        ("phone", b"BEGIN\r\n\x12a\x13", ["noise", b"a"]),
        ("phone", b"\x12a\x12b\x13", ["unfinished", b"b"]),
        ("phone", b"\x12a\x1bc\x13\x12b\x13", ["control", b"b"]),
        ("phone", b"\x13\x12b\x13", ["noise", b"b"]),
        ("phone", b"\x12a", ["unfinished"]),
        ("phone", b"\x12\x13", [b""]),
        ("phone", b"\x12" + b"x" * 1025 + b"\x13\x12b\x13", ["too long", b"b"]),
        ("board", b"A1\x1bB2\x13", ["aborted", b"B2"]),
        ("board", b"\x1b\x1bB2\x13\x1b", [b"B2"]),
        ("board", b"\x13\x13A\x13", ["flag", "flag", b"A"]),
        ("board", b"A\x12\x13B\x13", ["control", b"B"]),
        ("board", b"A1", ["unfinished"]),
        ("board", b"A" * 70 + b"\x13B\x13", ["too long", b"B"]),
        ("board", b"A" * 70 + b"\x1bB\x13", ["too long", b"B"]),
    ],
)
def test_what_is_no_message_is_told_with_its_reason(role: Role, data: bytes, expected: list[str | bytes]) -> None:
    for pieces in ([data], [bytes((byte,)) for byte in data]):
        events = read(amarino(role), *pieces)
        assert [event.payload if isinstance(event, Frame) else event.reason for event in events] == expected


def test_an_abort_clears_what_a_board_heard_and_is_nothing_by_itself() -> None:
    abort = Frame(NOBODY, NOBODY, "abort", b"", "amarino")
    assert amarino("phone").encode(abort) == b"\x1b"
    assert read(amarino("board"), b"\x1b") == []
    with pytest.raises(EncodeError):
        amarino("board").encode(abort)


def test_values_are_joined_and_numbers_with_a_point_have_two_decimals() -> None:
    assert values_text([180, 2.5, "on"]) == "180;2.50;on"
    assert values_text([]) == ""
    for wrong in ("a;b", "a\x13", float("nan"), float("inf")):
        with pytest.raises(ValueError, match="a"):
            values_text([wrong])


def test_values_are_read_as_the_numbers_that_they_spell() -> None:
    assert values(b"180;2.50;on;-7;1.0E10") == (180, 2.5, "on", -7, 1e10)
    assert values(b"") == values(b"\r\n") == ()
    assert values(b";") == ("", "")
    assert values("²;٣;é\xff".encode("latin-1", "replace")) is not None


def test_only_known_roles_can_be_written() -> None:
    with pytest.raises(ValidationError):
        Amarino.Options.model_validate({"role": "tablet"})


chunk = st.one_of(
    st.binary(max_size=80),
    st.sampled_from(
        [b"\x12", b"\x13", b"\x1b", b"\x11", b"\x11\x13", b"\x12ok\x13", b"A1;2\x13", b"\x13\x13", b"x" * 90]
    ),
)
stream = st.lists(chunk, max_size=25).map(b"".join)


@given(role=st.sampled_from(ROLES), data=stream, cuts=st.lists(st.integers(0, 800), max_size=10))
def test_any_cut_of_the_bytes_gives_the_same_events(role: Role, data: bytes, cuts: list[int]) -> None:
    places = [0, *sorted(place for place in cuts if place < len(data)), len(data)]
    pieces = [data[start:end] for start, end in pairwise(places)]
    assert read(amarino(role), *pieces) == read(amarino(role), data)


@given(role=st.sampled_from(ROLES), data=stream)
def test_every_byte_is_in_one_event_but_an_abort_of_nothing(role: Role, data: bytes) -> None:
    events = read(amarino(role), data)
    told = sum(len(event.wire) if isinstance(event, Frame) else event.size for event in events)
    assert told <= len(data)
    assert len(data) - told <= (data.count(b"\x1b") if role == "board" else 0)
    for frame in frames(events):
        assert frame.wire in data
        if frame.subject != "alive":
            assert other(role).encode(frame._replace(wire=b"", dialect="")) == frame.wire


@given(message=st.binary(max_size=80))
def test_what_may_be_sent_to_a_board_arrives_and_nothing_else_does(message: bytes) -> None:
    if flag_trouble(message) or text_trouble(message):
        with pytest.raises(EncodeError):
            amarino("phone").encode(order(message))
        return
    wire = amarino("phone").encode(order(message))
    (heard,) = frames(read(amarino("board"), wire))
    assert heard.payload == message


@given(payload=st.binary(max_size=1100), noise=st.binary(max_size=30))
def test_a_text_arrives_behind_any_noise(payload: bytes, noise: bytes) -> None:
    if text_trouble(payload) or len(payload) > LONGEST_TEXT:
        return
    events = read(amarino("phone"), noise + amarino("board").encode(text(payload)))
    assert isinstance(events[-1], Frame)
    assert events[-1].payload == payload


@given(given=st.lists(st.one_of(st.integers(-(10**9), 10**9), st.sampled_from(["on", "a b"])), min_size=1, max_size=9))
def test_values_go_there_and_back(given: list[int | str]) -> None:
    assert values(values_text(given).encode()) == tuple(given)


@pytest.mark.parametrize("pattern", [b"a", b"\x12", b"\x12a", b"\x13", b"\x1b", b"\x11", bytes(range(256))], ids=repr)
@pytest.mark.parametrize("role", ROLES)
def test_endless_input_holds_bounded_memory(role: Role, pattern: bytes) -> None:
    codec = amarino(role)
    data = (pattern * 20_000)[:20_000]
    for at in range(0, len(data), 777):
        codec.decode(data[at : at + 777], 0.0)
        assert len(codec._message or b"") <= LONGEST_TEXT
        assert codec._noise.size <= 4096

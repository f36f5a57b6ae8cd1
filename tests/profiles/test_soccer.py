"""Robots of a soccer team: set-points by the speeds of the wheels, by bytes and by name, and a stop."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from psiu_broker.codecs.paced import Rest
from psiu_broker.codecs.soccer import LIMITS, Soccer, value_of
from psiu_broker.errors import CallError
from psiu_broker.frame import NOBODY, Address, Frame
from psiu_broker.messages import Value
from psiu_broker.profiles.profile import Profile
from psiu_broker.profiles.soccer import RESERVED, SoccerProfile, robot_trouble

PELE = Address.numbered(1)


def profile(codec: dict[str, Any] | None = None, **robot: Any) -> SoccerProfile:
    return SoccerProfile.make(Soccer.Options(**(codec or {})), SoccerProfile.Options(**robot), 2.0)


def trouble(codec: dict[str, Any] | None = None, **robot: Any) -> str | None:
    return robot_trouble(Soccer.Options(**(codec or {})), SoccerProfile.Options(**robot))


def error(made: SoccerProfile, command: str, *parameters: Value) -> CallError:
    with pytest.raises(CallError) as caught:
        made.request(command, parameters)
    return caught.value


def heard(subject: str, payload: bytes) -> Frame:
    return Frame(NOBODY, PELE, subject, payload, "soccer")


RAW = {"preset": "f180"}
INT8 = {"preset": "plymouth", "byte_codec": "int8"}


@pytest.mark.parametrize(
    ("codec", "command", "parameters", "subject", "payload"),
    [
        ({}, "rodas", [15, 15], "rodas", "3e3e"),
        ({}, "rodas", [-31, 31], "rodas", "fc7e"),
        ({}, "rodas", ["-31", "31"], "rodas", "fc7e"),
        ({}, "rodas", [15.0, "15.0"], "rodas", "3e3e"),
        ({}, "bytes", ["0x3eFC"], "rodas", "3efc"),
        ({}, "bytes", ["0x81", "03"], "rodas", "8103"),
        ({}, "pare", [], "pare", "0303"),
        (RAW, "rodas", [1, 2, 3, 255], "bytes", "010203ff"),
        (RAW, "bytes", ["0x01020304"], "bytes", "01020304"),
        (RAW, "pare", [], "pare", "00000000"),
        (INT8, "rodas", [-128, 127, -1], "bytes", "807fff"),
        (INT8, "pare", [], "pare", "000000"),
    ],
)
def test_a_call_becomes_the_robot_s_share(
    codec: dict[str, Any], command: str, parameters: list[Value], subject: str, payload: str
) -> None:
    request = profile(codec).request(command, parameters)
    assert (request.subject, request.payload.hex(), request.question) == (subject, payload, False)


@pytest.mark.parametrize(
    ("codec", "command", "parameters", "message"),
    [
        ({}, "rodas", [32, 0], "rodas takes 2 whole numbers, -31 to 31, left and right wheel, got 32 0"),
        ({}, "rodas", [0, -32], "rodas takes 2 whole numbers, -31 to 31, left and right wheel, got 0 -32"),
        ({}, "rodas", [], "rodas takes 2 whole numbers, -31 to 31, left and right wheel, got nothing"),
        ({}, "rodas", [1.5, 0], "rodas takes 2 whole numbers, -31 to 31, left and right wheel, got 1.5 0"),
        ({}, "rodas", ["x", 0], "rodas takes 2 whole numbers, -31 to 31, left and right wheel, got x 0"),
        (RAW, "rodas", [1, 2, 3, 256], "rodas takes 4 whole numbers, 0–255, got 1 2 3 256"),
        (INT8, "rodas", [1, 2], "rodas takes 3 whole numbers, -128 to 127, got 1 2"),
        ({"preset": "guarana"}, "rodas", [-1], "rodas takes a whole number, 0–255, got -1"),
        ({}, "bytes", [], "bytes takes 2 bytes in hexadecimal such as 0x0303, got nothing"),
        ({}, "bytes", ["0x3e"], "bytes takes 2 bytes in hexadecimal such as 0x0303, got 0x3e"),
        ({}, "bytes", [3], "bytes takes 2 bytes in hexadecimal such as 0x0303, got 3"),
        ({}, "bytes", ["0x3 e3e"], "bytes takes 2 bytes in hexadecimal such as 0x0303, got 0x3 e3e"),
        ({}, "bytes", ["0x3e40"], "bytes takes bytes whose check bits are right, got 0x40; rodas makes them"),
        ({"preset": "guarana"}, "bytes", ["7"], "bytes takes 1 byte in hexadecimal such as 0x00, got 7"),
        ({}, "pare", [1], "pare takes no parameters, got 1"),
    ],
)
def test_what_does_not_fit_is_refused_with_the_range(
    codec: dict[str, Any], command: str, parameters: list[Value], message: str
) -> None:
    caught = error(profile(codec), command, *parameters)
    assert (caught.code, str(caught)) == ("refused", message)


def test_an_unknown_command_is_told_with_those_that_there_are() -> None:
    caught = error(profile(), "paree")
    assert (caught.code, str(caught)) == (
        "unknown_command",
        "no command paree: did you mean pare? It has rodas, bytes, pare",
    )


def test_silence_is_the_answer_and_comes_soon() -> None:
    request = profile().request("rodas", [1, 1])
    assert request.silence is not None
    assert (request.silence.status, request.silence.remark) == (None, "sent; this robot does not answer")
    assert 1 / 30 < request.timeout_s < 0.1
    slow = profile({"preset": "cendori"}).request("pare", [])
    assert slow.timeout_s > 1 / 11, "the next packet must have time to leave"


def test_commands_are_listed_with_their_ranges() -> None:
    wheels, raw, stop, turn = profile(commands={"gira": {"rodas": (-9, 9), "description": "turn left"}}).commands()
    assert (wheels.name, wheels.ints, wheels.minimum, wheels.maximum) == ("rodas", 2, -31, 31)
    assert wheels.description == "speeds of the left and the right wheel"
    assert (raw.name, raw.chars) == ("bytes", 1)
    assert (stop.name, stop.ints) == ("pare", 0)
    assert (turn.name, turn.description) == ("gira", "turn left")
    (values, *_) = profile(RAW).commands()
    assert (values.ints, values.minimum, values.maximum) == (4, 0, 255)


def test_a_set_point_can_have_a_name() -> None:
    made = profile(commands={"frente": {"rodas": (15, 15)}, "chuta": {"bytes": "0x7e7e"}})
    assert made.request("frente", []).payload.hex() == "3e3e"
    assert made.request("chuta", []).payload.hex() == "7e7e"
    assert str(error(made, "chuta", 1)) == "chuta takes no parameters, got 1"


def test_a_named_set_point_that_is_a_stop_overtakes_as_one() -> None:
    made = profile(commands={"parar": {"rodas": (0, 0)}, "frente": {"rodas": (9, 9)}})
    assert (made.request("parar", []).subject, made.request("frente", []).subject) == ("pare", "rodas")


def test_a_robot_may_have_another_stop_and_another_patience() -> None:
    made = profile({"preset": "guarana"}, stop="0x80", hold_s=2.0)
    assert made.rest == Rest(b"\x80", 2.0)
    assert made.request("pare", []).payload == b"\x80"
    assert profile().rest == Rest(b"\x03\x03", 0.5)
    assert profile({"hold_s": 1.0}).rest.hold_s == 1.0


@pytest.mark.parametrize(
    ("codec", "robot", "says"),
    [
        ({}, {"stop": "0x00"}, "stop takes 2 bytes in hexadecimal such as 0x0303, got 0x00"),
        ({}, {"stop": "0x0000"}, "stop takes bytes whose check bits are right, got 0x00; rodas makes them"),
        ({}, {"hold_s": 0.01}, "hold_s = 0.01 is shorter than two packets take at rate_hz = 30, 0.0667 s"),
        (
            {},
            {"commands": {"vai": {"rodas": (99, 0)}}},
            "commands.vai takes 2 whole numbers, -31 to 31, left and right",
        ),
        (RAW, {"commands": {"vai": {"bytes": "0x01"}}}, "commands.vai takes 4 bytes in hexadecimal"),
        (
            {},
            {"commands": {"pare": {"rodas": (0, 0)}}},
            "commands.pare: expected one word, none of bytes, exibecomando",
        ),
        ({}, {"commands": {"vai la": {"rodas": (0, 0)}}}, "commands.vai la: expected one word"),
    ],
)
def test_options_that_do_not_fit_the_packets_are_told(codec: dict[str, Any], robot: dict[str, Any], says: str) -> None:
    told = trouble(codec, **robot)
    assert told is not None
    assert told.startswith(says)
    with pytest.raises(ValueError, match=r"expected|takes|shorter"):
        profile(codec, **robot)


def test_options_that_fit_are_no_trouble() -> None:
    assert trouble(stop="0x0381", hold_s=1, commands={"vai": {"rodas": (1, 1)}}) is None


@pytest.mark.parametrize("set_point", [{}, {"rodas": (1, 1), "bytes": "0x0707"}])
def test_a_named_set_point_is_said_in_one_way(set_point: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match="expected either rodas or bytes"):
        profile(commands={"vai": set_point})


@pytest.mark.parametrize("name", sorted(RESERVED))
def test_what_every_robot_has_cannot_be_named_anew(name: str) -> None:
    assert trouble(commands={name: {"rodas": (0, 0)}}) is not None


def test_nothing_that_is_heard_answers_a_request() -> None:
    made = profile()
    request = made.request("pare", [])
    assert made.read(request, heard("rodas", b"\x03\x03")) is None
    assert made.answers_to(request) == made.answers_to(made.request("rodas", [1, 1]))
    assert (made.greeting(), made.learn(heard("rodas", b"\x03\x03"))) == ((), False)


@pytest.mark.parametrize(
    ("codec", "subject", "payload", "command", "parameters"),
    [
        ({}, "rodas", "3efc", "rodas", [15, -31]),
        ({}, "pare", "0303", "pare", None),
        (RAW, "bytes", "01020304", "bytes", ["0x01020304"]),
        ({}, "rodas", "4040", "bytes", ["0x4040"]),
    ],
)
def test_a_packet_is_said_in_the_words_of_a_call(
    codec: dict[str, Any], subject: str, payload: str, command: str, parameters: list[Value] | None
) -> None:
    told = profile(codec).describe(heard(subject, bytes.fromhex(payload)))
    assert (told["kind"], told["command"], told.get("parameters")) == ("command", command, parameters)


@given(codec=st.sampled_from([{}, RAW, INT8]), subject=st.text(max_size=5), payload=st.binary(max_size=9))
def test_describing_never_raises(codec: dict[str, Any], subject: str, payload: bytes) -> None:
    assert profile(codec).describe(heard(subject, payload))["kind"] == "command"


@given(data=st.data(), byte_codec=st.sampled_from(sorted(LIMITS)))
def test_what_was_called_is_what_is_heard(data: st.DataObject, byte_codec: str) -> None:
    codec = Soccer.Options(byte_codec=byte_codec)
    low, high = LIMITS[codec.byte_codec]
    values = data.draw(st.lists(st.integers(low, high), min_size=2, max_size=2))
    request = SoccerProfile(codec).request("rodas", values)
    assert [value_of(byte, codec.byte_codec) for byte in request.payload] == values
    (first, *_) = Soccer(codec).decode(Soccer(codec).packet([request.payload] * 3), 0.0)
    assert isinstance(first, Frame)
    assert (first.subject, first.payload) == (request.subject, request.payload)


values = st.one_of(st.integers(), st.floats(), st.text(max_size=8))


@given(command=st.sampled_from(["rodas", "bytes", "pare", "x"]), parameters=st.lists(values, max_size=4))
def test_a_request_is_made_or_refused_and_nothing_else(command: str, parameters: list[Value]) -> None:
    made: Profile = profile()
    try:
        assert len(made.request(command, parameters).payload) == 2
    except CallError as caught:
        assert caught.code in {"refused", "unknown_command"}

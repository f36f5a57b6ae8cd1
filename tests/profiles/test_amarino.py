from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from psiu_broker.codecs.amarino import Amarino, flag_subject
from psiu_broker.errors import CallError
from psiu_broker.frame import NOBODY, Frame
from psiu_broker.messages import Command
from psiu_broker.profiles.amarino import AmarinoProfile
from psiu_broker.profiles.profile import Reply, Request
from psiu_broker.routing.outbox import STOP_LANE, lane
from psiu_broker.simulator.amarino import AmarinoBoard

COMMANDS = {
    "brilho": {"flag": "b", "parameters": ["int"], "minimum": 0, "maximum": 255, "description": "the lamp"},
    "cor": {"flag": "c", "parameters": ["int", "int", "int"]},
    "mede": {"flag": "t", "answer": True, "unit": "C"},
    "soma": {"flag": "s", "parameters": ["int", "float"], "answer": True},
    "escreve": {"flag": "e", "parameters": ["text"]},
    "ganho": {"flag": "g", "parameters": ["float"], "minimum": 0, "unit": "dB"},
    "pare": {"flag": "p"},
}


def board(**options: Any) -> AmarinoProfile:
    options.setdefault("commands", COMMANDS)
    return AmarinoProfile.make(Amarino.Options(), AmarinoProfile.Options.model_validate(options), 2.0)


def said(text: bytes) -> Frame:
    return Frame(NOBODY, NOBODY, "text", text, "amarino")


def refused(command: str, *parameters: Any) -> str:
    with pytest.raises(CallError) as error:
        board().request(command, parameters)
    assert error.value.code == "refused"
    return str(error.value)


@pytest.mark.parametrize(
    ("command", "parameters", "payload"),
    [
        ("brilho", (128,), b"b128"),
        ("brilho", ("128",), b"b128"),
        ("brilho", (12.0,), b"b12"),
        ("cor", (1, 2, 3), b"c1;2;3"),
        ("mede", (), b"t"),
        ("soma", (2, 0.5), b"s2;0.50"),
        ("ganho", (3,), b"g3.00"),
        ("escreve", ("ola mundo",), b"eola mundo"),
        ("escreve", (7,), b"e7"),
        ("send", ("A",), b"A"),
        ("send", (7, 180, 45.5, "on"), b"7180;45.50;on"),
    ],
)
def test_a_call_is_a_flag_and_its_values(command: str, parameters: tuple[Any, ...], payload: bytes) -> None:
    request = board().request(command, parameters)
    assert (request.subject, request.payload, request.question) == (flag_subject(payload[0]), payload, False)


@pytest.mark.parametrize(
    ("command", "parameters", "why"),
    [
        ("brilho", (), "int (0 to 255), got nothing"),
        ("brilho", (256,), "int (0 to 255), got 256"),
        ("brilho", (-1,), "0 to 255"),
        ("brilho", (1.5,), "got 1.5"),
        ("brilho", ("alto",), "got alto"),
        ("brilho", (1, 2), "got 1 2"),
        ("ganho", (-0.5,), "float (from 0 dB)"),
        ("ganho", (float("nan"),), "got nan"),
        ("ganho", (float("inf"),), "got inf"),
        ("mede", (1,), "no parameters"),
        ("escreve", ("a;b",), "two"),
        ("escreve", ("a\x13b",), "0x13"),
        ("escreve", ("\x1b",), "0x1b"),
        ("escreve", ("x" * 64,), "65 bytes"),
        ("escreve", ("é" * 32,), "65 bytes"),
        ("send", (), "got nothing"),
        ("send", ("",), "got "),
        ("send", ("/", 1), "from 0 to z, got /"),
        ("send", ("{",), "got {"),
        ("send", ("AB",), "got AB"),
        ("send", (-5,), "got -5"),
        ("send", ("A", "a;b"), "two"),
    ],
)
def test_what_a_board_would_not_understand_or_live_through_is_refused(
    command: str, parameters: tuple[Any, ...], why: str
) -> None:
    assert why in refused(command, *parameters)


def test_an_unknown_command_names_those_that_there_are() -> None:
    with pytest.raises(CallError, match="did you mean brilho") as error:
        board().request("brilha", (1,))
    assert error.value.code == "unknown_command"


@given(command=st.sampled_from([*COMMANDS, "send"]), data=st.data())
def test_no_call_crashes_a_board(command: str, data: st.DataObject) -> None:
    value = st.one_of(st.integers(-300, 300), st.floats(), st.text(max_size=70), st.sampled_from(["A", "b", "1"]))
    parameters = data.draw(st.lists(value, max_size=4))
    try:
        request = board().request(command, parameters)
    except CallError as error:
        assert error.code == "refused"
        return
    wire = Amarino().encode(Frame(NOBODY, NOBODY, request.subject, request.payload, "amarino"))
    robot = AmarinoBoard()
    robot.receive(wire, 0.0)
    assert not robot.crashed
    assert len(wire) <= 65


def test_commands_are_listed_as_they_were_declared_and_send_last() -> None:
    first, *_, last = board().commands()
    assert first == Command(name="brilho", ints=1, minimum=0, maximum=255, description="the lamp")
    assert [each.name for each in board().commands()] == [*COMMANDS, "send"]
    assert last.name == "send"
    assert AmarinoProfile().commands() == (last,)


def test_a_command_that_is_answered_waits_for_a_text_and_any_other_is_sent_and_that_is_all() -> None:
    profile = board()
    asked = profile.request("mede", ())
    assert asked.silence is None
    assert profile.read(asked, said(b"21.50")) == Reply(None, (21.5,), "C")
    assert profile.read(profile.request("soma", (1, 2)), said(b"3;ok")) == Reply(None, (3, "ok"))
    told = profile.request("brilho", (1,))
    assert told.silence == Reply(None, remark="sent; this robot does not answer")
    assert told.timeout_s < asked.timeout_s
    assert profile.read(told, said(b"21.50")) is None
    assert profile.read(asked, Frame(NOBODY, NOBODY, "flag/t", b"t", "amarino")) is None


@pytest.mark.parametrize("text", [b"Flag not registered: ", b"Flag out of bounds: "])
@pytest.mark.parametrize("command", ["mede", "pare"])
def test_a_board_without_such_a_function_is_heard(command: str, text: bytes) -> None:
    profile = board()
    reply = profile.read(profile.request(command, ()), said(text))
    assert isinstance(reply, Reply)
    assert (reply.status, reply.values) == ("falha", ())
    assert reply.remark is not None
    assert profile.describe(said(text))["kind"] == "error"


def test_answers_do_not_say_to_what() -> None:
    profile = board()
    assert profile.answers_to(profile.request("mede", ())) == profile.answers_to(profile.request("soma", (1, 2)))


def test_a_stop_overtakes_what_waits() -> None:
    request = board().request("pare", ())
    frame = Frame(NOBODY, NOBODY, request.subject, request.payload, "amarino")
    assert lane(frame) == STOP_LANE
    assert Amarino().encode(frame) == b"p\x13"


def test_a_board_is_greeted_with_what_clears_half_a_message() -> None:
    (request,) = board().greeting()
    robot = AmarinoBoard(functions={"e": ""})
    robot.receive(b"/", 0.0)
    robot.receive(Amarino().encode(Frame(NOBODY, NOBODY, request.subject, request.payload, "amarino")), 0.0)
    assert robot.receive(b"eola\x13", 0.0) == [(0.0, b"\x12ola\x13")]
    assert not robot.crashed


def test_what_a_board_tells_is_an_event_with_its_values() -> None:
    assert board().describe(said(b"21.50;on;3")) == {
        "kind": "event", "command": None, "parameters": [21.5, "on", 3],
    }  # fmt: skip
    assert board().describe(said(b"7"))["value"] == 7
    assert board().describe(said(b""))["parameters"] == []


def test_its_values_have_names_where_they_were_named() -> None:
    profile = board(readings=[{"name": "x", "unit": "g"}, {"name": "y", "unit": "g"}])
    told = profile.describe(said(b"0.50;-1.00"))
    assert (told["readings"], told["unit"]) == ({"x": 0.5, "y": -1.0}, "g")
    assert "readings" not in profile.describe(said(b"0.50"))
    mixed = board(readings=[{"name": "t", "unit": "C"}, {"name": "on"}])
    assert mixed.describe(said(b"21.50;1"))["unit"] is None


def test_what_is_said_to_a_board_is_told_by_its_name() -> None:
    def frame(payload: bytes) -> Frame:
        return Frame(NOBODY, NOBODY, flag_subject(payload[0]), payload, "amarino")

    assert board().describe(frame(b"c1;2;3")) == {"kind": "command", "command": "cor", "parameters": [1, 2, 3]}
    assert board().describe(frame(b"X"))["command"] == "flag/X"


@pytest.mark.parametrize(
    "options",
    [
        {"commands": {"a": {"flag": "/"}}},
        {"commands": {"a": {"flag": "{"}}},
        {"commands": {"a": {"flag": ""}}},
        {"commands": {"a": {"flag": "AB"}}},
        {"commands": {"a": {"flag": "A\n"}}},
        {"commands": {"a": {}}},
        {"commands": {"send": {"flag": "A"}}},
        {"commands": {"qualseunome": {"flag": "A"}}},
        {"commands": {"a": {"flag": "A", "minimum": 1}}},
        {"commands": {"a": {"flag": "A", "parameters": ["int"], "minimum": 2, "maximum": 1}}},
        {"commands": {"a": {"flag": "A", "parameters": ["bool"]}}},
        {"readings": [{"name": "x"}, {"name": "x"}]},
        {"readings": [{"name": ""}]},
    ],
)
def test_what_cannot_be_is_refused_in_the_configuration(options: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        AmarinoProfile.Options.model_validate(options)


@given(payload=st.binary(max_size=80), subject=st.sampled_from(["text", "alive", "abort", "flag/A"]))
def test_nothing_that_a_board_says_raises(payload: bytes, subject: str) -> None:
    profile = board(readings=[{"name": "x"}])
    frame = Frame(NOBODY, NOBODY, subject, payload, "amarino")
    profile.describe(frame)
    profile.learn(frame)
    for request in (profile.request("mede", ()), profile.request("pare", ())):
        assert isinstance(request, Request)
        profile.read(request, frame)


def test_a_number_beyond_all_floats_is_refused() -> None:
    assert "got 1000" in refused("ganho", 10**400)

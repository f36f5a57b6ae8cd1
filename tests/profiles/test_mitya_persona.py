"""A program that knows Robot Mitya drives another robot: what each letter becomes, and what the program hears."""

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from psiu_broker.codecs.mitya import BY_WORD, VERSIONS, Mitya, Version
from psiu_broker.errors import EncodeError
from psiu_broker.frame import NOBODY, Frame
from psiu_broker.messages import Answer
from psiu_broker.profiles.mitya_persona import COMPLAIN_EVERY_S, MityaPersona, Rule
from psiu_broker.profiles.persona import Call, Say
from psiu_broker.profiles.profile import Description

VECTORS = json.loads((Path(__file__).parents[1] / "vectors" / "mitya.json").read_text())
MAP: dict[str, Any] = {
    "drive": {"command": "parafrente", "below_zero": "paratras", "scale": 0.4},
    "left": {"command": "giradireita", "below_zero": "giraesquerda", "at_zero": "pare", "scale": 1},
    "H": {"command": "garra", "scale": 1, "offset": -90, "minimum": -90, "maximum": 90},
    "nod": {"command": "acena"},
    "tail": {"command": "cauda", "scale": 0.01, "decimals": 2},
    "r": {"command": "executa", "scale": 1, "offset": 1},
}


def persona(version: Version = "2012", rules: dict[str, Any] | None = None) -> MityaPersona:
    options = MityaPersona.Options.model_validate(MAP if rules is None else rules)
    return MityaPersona("MNERIM", Mitya.Options(version=version), options)


class Program:
    """A program at the far end, and what its messages lead to."""

    def __init__(self, version: Version = "2012", rules: dict[str, Any] | None = None) -> None:
        self.persona = persona(version, rules)
        self.codec = Mitya(Mitya.Options(version=version))
        self.calls: list[Call] = []

    def sends(self, *texts: str, now: float = 0.0) -> list[tuple[Any, ...]]:
        """The calls, as (command, parameter…), and what is said to the program, as (text,)."""
        done: list[tuple[Any, ...]] = []
        for text in texts:
            for frame in self.codec.decode(text.encode(), now):
                assert isinstance(frame, Frame)
                for action in self.persona.heard(frame, now):
                    if isinstance(action, Call):
                        assert action.asked is frame
                        self.calls.append(action)
                        done.append((action.command, *action.parameters))
                    else:
                        done.append((self.hears(action),))
        return done

    def hears(self, say: Say) -> str:
        frame = Frame(NOBODY, NOBODY, say.subject, say.payload, "mitya")
        assert self.codec.encode(frame).startswith(say.payload)
        return say.payload.decode()


def answer(status: Any = "sucesso") -> Answer:
    return Answer(status=status, elapsed_ms=1.0)


@pytest.mark.parametrize(
    ("sent", "told"),
    [
        ("D0064", ("parafrente", 40)),
        ("DFF9C", ("paratras", 40)),
        ("D0000", ("parafrente", 0)),
        ("D8000", ("paratras", 13107)),
        ("L005A", ("giradireita", 90)),
        ("LFFA6", ("giraesquerda", 90)),
        ("L0000", ("pare",)),
        ("H005A", ("garra", 0)),
        ("H0000", ("garra", -90)),
        ("y0001", ("acena",)),
        ("T0019", ("cauda", 0.25)),
        ("r0003", ("executa", 4)),
    ],
)
def test_a_letter_becomes_the_command_that_the_map_says(sent: str, told: tuple[Any, ...]) -> None:
    assert Program().sends(sent) == [told]


def test_letters_are_those_of_the_version_and_words_those_of_any() -> None:
    assert Program("2013").sends("G0064") == [("parafrente", 40), ("#0000",)]
    assert Program("2013", {"G": {"command": "anda", "scale": 1}}).sends("G0001") == [("anda", 1), ("#0000",)]
    assert Program("2013", {"D": {"command": "anda", "scale": 1}}).sends("G0001") == [("#0002",)]


def test_whole_numbers_are_whole_and_others_are_not() -> None:
    for text, kind in (("D0064", int), ("T0019", float)):
        program = Program()
        program.sends(text)
        assert type(program.calls[0].parameters[0]) is kind


@pytest.mark.parametrize("letter", "LRDHV")
def test_a_repeated_set_point_is_ignored_as_on_the_phone(letter: str) -> None:
    program = Program(rules={letter: {"command": "x", "scale": 1}})
    sent = [f"{letter}0001", f"{letter}0001", f"{letter}0002", f"{letter}0001", f"{letter}0001"]
    assert program.sends(*sent) == [("x", 1), ("x", 2), ("x", 1)]


@pytest.mark.parametrize("letter", "LRGHVM")
def test_of_2013_a_mood_too(letter: str) -> None:
    program = Program("2013", {letter: {"command": "x", "scale": 1}})
    assert [told for told in program.sends(*[f"{letter}0001"] * 3) if told != ("#0000",)] == [("x", 1)]


@pytest.mark.parametrize("letter", "FTI")
def test_what_is_not_in_the_table_of_the_phone_is_done_each_time(letter: str) -> None:
    program = Program(rules={letter: {"command": "x", "scale": 1}})
    assert program.sends(*[f"{letter}0001"] * 2) == [("x", 1)] * 2


def test_a_set_point_gives_way_to_a_newer_one_and_a_gesture_does_not() -> None:
    program = Program()
    program.sends("D0064", "H005A", "T0019", "y0001", "r0003")
    assert [call.newest for call in program.calls] == [True, True, True, False, False]


def test_a_burst_is_one_gesture_whatever_was_lost_of_it() -> None:
    rules = {"f": {"command": "atira"}}
    burst = VECTORS["datagrams"]["fire_2012"]
    assert Program(rules=rules).sends(*burst) == [("atira",)]
    assert Program(rules=rules).sends(*burst[1:4]) == [("atira",)]
    assert Program(rules=rules).sends(*burst[3:]) == []
    assert Program(rules=rules).sends(*burst, *burst) == [("atira",)] * 2


def test_a_void_message_is_no_command() -> None:
    assert Program().sends("n0000", "y0000") == []


@pytest.mark.parametrize(("version", "text"), [("2012", "E0102"), ("2013", "#0002")])
def test_a_letter_without_a_rule_is_an_unknown_command(version: Version, text: str) -> None:
    program = Program(version)
    assert program.sends("V0001", now=0.0) == [(text,)]
    assert program.sends("V0002", "V0003", now=1.0) == []
    assert program.sends("V0004", now=COMPLAIN_EVERY_S + 1) == [(text,)]
    assert program.sends("Q0001", now=COMPLAIN_EVERY_S + 1) == [(text,)]


@pytest.mark.parametrize(("version", "text"), [("2012", "E0101"), ("2014", "#0001")])
def test_a_value_that_the_map_does_not_allow_is_refused(version: Version, text: str) -> None:
    assert Program(version).sends("H00B5") == [(text,)]


def test_a_value_too_great_for_a_number_is_refused() -> None:
    assert Program(rules={"D": {"command": "x", "scale": 1e308}}).sends("D0064") == [("E0101",)]


@pytest.mark.parametrize(("version", "text"), [("2012", "E0105"), ("2013", "#0005")])
def test_a_script_is_not_recorded_and_nothing_of_it_is_done(version: Version, text: str) -> None:
    drive = BY_WORD[version]["drive"]
    script = ["r0100", "Z0002", f"{drive}0064", "W0064", "y0001", "W0064", "Z0000"]
    assert Program(version).sends(*script) == [(text,)]


def test_what_only_a_robot_says_is_ignored() -> None:
    assert Program().sends("E0001") == []
    assert Program("2013").sends("#0000", "#0002", "~01F6") == []


def test_the_program_hears_that_it_was_not_done_and_may_send_the_same_again() -> None:
    program = Program()
    program.sends("D0064")
    (say,) = program.persona.answered(program.calls[-1], None, "parafrente takes 0-30 cm, got 40", 0.0)
    assert program.hears(say) == "E0101"
    assert program.sends("D0064") == [("parafrente", 40)]
    (say,) = program.persona.answered(program.calls[-1], answer("falha"), "", COMPLAIN_EVERY_S)
    assert program.hears(say) == "E0101"


def test_success_is_silent_in_2012_and_done_later() -> None:
    old, new = Program(), Program("2013")
    for program in (old, new):
        assert program.sends("y0001") == [("acena",)]
    assert list(old.persona.answered(old.calls[0], answer(), "", 0.0)) == []
    assert [new.hears(say) for say in new.persona.answered(new.calls[0], answer(None), "", 0.0)] == ["#0000"]


class TestWhatTheRobotSaysUnasked:
    @staticmethod
    def hears(version: Version, description: Description) -> list[str]:
        program = Program(version)
        return [program.hears(say) for say in program.persona.told(description, 0.0)]

    @pytest.mark.parametrize(("version", "text"), [("2012", "h0001"), ("2013", "*0001"), ("2014", "*0001")])
    def test_a_hit_is_a_hit(self, version: Version, text: str) -> None:
        assert self.hears(version, {"kind": "event", "command": "hit", "parameters": [1]}) == [text]
        assert self.hears(version, {"kind": "command", "command": "hit"}) == []

    @pytest.mark.parametrize(("version", "texts"), [("2012", []), ("2013", ["~01F6"]), ("2014", ["~01F6"])])
    def test_a_battery_in_volts_is_telemetry_where_there_is_such(self, version: Version, texts: list[str]) -> None:
        told: Description = {"kind": "event", "command": "x", "unit": "V", "readings": {"a": 1.0, "battery": 5.02}}
        assert self.hears(version, told) == texts

    @pytest.mark.parametrize("reading", [-0.1, 40.96, float("nan"), float("inf"), "full"])
    def test_no_other_battery_is(self, reading: float | str) -> None:
        told: Description = {"kind": "event", "unit": "V", "readings": {"battery": reading}}
        assert self.hears("2013", told) == []

    def test_nor_one_in_another_unit(self) -> None:
        assert self.hears("2013", {"kind": "event", "unit": "%", "readings": {"battery": 5.0}}) == []

    def test_anything_else_has_no_letter(self) -> None:
        assert self.hears("2013", {"kind": "error", "command": "error", "remark": "it fell over"}) == []
        assert self.hears("2013", {}) == []


def test_without_a_map_nothing_is_guessed() -> None:
    one = MityaPersona("MNERIM", None, None)
    (frame,) = Mitya().decode(b"D0064", 0.0)
    assert isinstance(frame, Frame)
    assert list(one.heard(frame, 0.0)) == [Say("error", b"E0102")]


@pytest.mark.parametrize(
    ("rules", "text"),
    [
        ({"Q": {"command": "x"}}, "Q is no letter of a Robot Mitya; those of 2012 are L"),
        ({"D": {"command": "x", "scale": 0}}, "scale 0"),
        ({"D": {"command": "x", "offset": 1}}, "mean nothing without a scale"),
        ({"D": {"command": "x", "scale": 1, "minimum": 2, "maximum": 1}}, "minimum 2 is above maximum 1"),
        ({"D": {"command": "x", "speed": 1}}, "Extra inputs"),
        ({"D": {"command": ""}}, "at least 1 character"),
        ({"D": {}}, "Field required"),
        ({"D": 1}, "valid dictionary"),
    ],
)
def test_a_map_that_makes_no_sense_is_refused(rules: dict[str, Any], text: str) -> None:
    with pytest.raises(ValidationError, match=text):
        MityaPersona.Options.model_validate(rules)


def test_the_schema_of_the_map_tells_its_rules() -> None:
    schema = MityaPersona.Options.model_json_schema()
    assert schema["additionalProperties"] == {"$ref": "#/$defs/Rule"}
    assert all("description" in field for field in schema["$defs"]["Rule"]["properties"].values())


@given(st.lists(st.from_regex(r"\A[A-Za-z#*~=][0-9A-F]{4}\Z"), max_size=20), st.sampled_from(VERSIONS))
def test_whatever_a_program_sends_no_more_comes_of_it_than_it_sent(sent: list[str], version: Version) -> None:
    one = persona(version)
    codec = Mitya(Mitya.Options(version=version))
    for frame in codec.decode("".join(sent).encode(), 0.0):
        if isinstance(frame, Frame):
            actions = one.heard(frame, 0.0)
            assert len([action for action in actions if isinstance(action, Call)]) <= 1
            assert len(actions) <= 2


@given(st.text(max_size=8), st.binary(max_size=8))
def test_no_frame_is_too_odd(subject: str, payload: bytes) -> None:
    frame = Frame(NOBODY, NOBODY, subject, payload, "mitya")
    for version in VERSIONS:
        one, codec = persona(version), Mitya(Mitya.Options(version=version))
        for action in one.heard(frame, 0.0):
            if isinstance(action, Say):
                try:
                    codec.encode(Frame(NOBODY, NOBODY, action.subject, action.payload, "mitya"))
                except EncodeError as error:
                    pytest.fail(str(error))


@given(st.integers(-0x8000, 0x7FFF), st.floats(0.01, 10), st.integers(-100, 100))
def test_a_parameter_is_the_value_times_the_scale_plus_the_offset(value: int, scale: float, offset: int) -> None:
    _, (parameter,) = Rule(command="x", scale=scale, offset=offset).call(value)
    assert isinstance(parameter, int)
    assert abs(parameter - (value * scale + offset)) <= 0.5 + 1e-6

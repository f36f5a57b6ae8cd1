"""A robot played as a Firmata board: what a program finds, what it makes the robot do, and what it hears of it."""

from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from psiu_broker.codecs import firmata
from psiu_broker.codecs.firmata import Firmata
from psiu_broker.codecs.firmata_messages import (
    ASK_CAPABILITIES_MESSAGE,
    ASK_FIRMWARE_MESSAGE,
    ASK_ID_MESSAGE,
    ASK_MAPPING_MESSAGE,
    ASK_VERSION_MESSAGE,
    MODES,
    RESET_MESSAGE,
    AnalogMapping,
    AnalogMessage,
    AskPinState,
    Capabilities,
    DigitalMessage,
    Firmware,
    Identity,
    Message,
    PinMode,
    PinState,
    PinValue,
    ReportAnalog,
    ReportDigital,
    Sampling,
    ServoConfig,
    Sysex,
    Text,
    Version,
    read,
)
from psiu_broker.frame import NOBODY, Frame
from psiu_broker.messages import Answer, Value
from psiu_broker.profiles.firmata_map import FirmataMap
from psiu_broker.profiles.firmata_persona import FirmataPersona
from psiu_broker.profiles.persona import Call, Say
from psiu_broker.profiles.profile import Description

OPTIONS = Firmata.Options(role="board")
MAP = {
    "2": {"reading": "toque"},
    "3": {"command": "roda", "mode": "pwm", "scale": 0.5},
    "5": {"reading": "porta", "on": ["aberta"]},
    "9": {"command": "garra", "mode": "servo", "offset": -90, "minimum": -45, "maximum": 45},
    "10": {"command": "braço", "mode": "servo"},
    "12": {"command": "sirene"},
    "13": {"command": "farol", "on": [255], "off": [0]},
    "A0": {"reading": "luz", "scale": 10, "poll_s": 0.5},
    "A2": {"reading": "bateria", "scale": 100},
}


class Board:
    """A persona, and a program's view of it."""

    def __init__(self, pins: dict[str, object] | None = None) -> None:
        self.persona = FirmataPersona("MNERIM", OPTIONS, FirmataMap(**(MAP if pins is None else pins)))
        self.now = 100.0

    def hears(self, *messages: Message) -> list[Call | Message | None]:
        """What comes of these messages of the program."""
        return [
            each
            for message in messages
            for each in seen(self.persona.heard(firmata.message(message.wire, "host"), self.now))
        ]

    def robot_tells(self, **description: object) -> list[Call | Message | None]:
        return seen(self.persona.told(Description(**description), self.now))  # type: ignore[typeddict-item]

    def robot_answers(self, call: Call, *values: Value, status: object = None) -> list[Call | Message | None]:
        answer = Answer(status=status, values=list(values), elapsed_ms=1)
        return seen(self.persona.answered(call, answer, "", self.now))

    def time_passes(self) -> list[Call | Message | None]:
        """What is done at the moment that it waits for."""
        until = self.persona.waits_until()
        assert until is not None
        self.now = max(self.now, until)
        return seen(self.persona.due(self.now))


def seen(actions: Sequence[Say | Call]) -> list[Call | Message | None]:
    found: list[Call | Message | None] = []
    for action in actions:
        if isinstance(action, Say):
            assert action.subject == firmata.subject(action.payload, "board")
            found.append(read(action.payload))
        else:
            found.append(action)
    return found


@pytest.fixture
def board() -> Board:
    return Board()


class TestForItself:
    def test_it_greets_as_a_board_does_that_was_reset_once_the_program_has_set_up_its_port(self, board: Board) -> None:
        assert board.persona.opened(100.0) == []
        assert board.persona.waits_until() == pytest.approx(100.25)
        assert board.persona.due(100.2) == []
        said = board.persona.due(100.25)
        assert b"".join(say.payload for say in said if isinstance(say, Say)) == (
            b"\xf9\x02\x05\xf0\x79\x02\x05M\0N\0E\0R\0I\0M\0\xf7"
        )
        assert board.persona.waits_until() is None

    def test_it_tells_its_versions_and_the_name_of_the_robot(self, board: Board) -> None:
        assert board.hears(ASK_VERSION_MESSAGE) == [Version(2, 5)]
        assert board.hears(ASK_FIRMWARE_MESSAGE) == [Firmware(2, 5, "MNERIM")]

    def test_programs_of_firmata_express_find_the_board_they_look_for(self, board: Board) -> None:
        assert board.hears(ASK_ID_MESSAGE) == [Identity(1)]
        assert Board({"id": 7}).hears(ASK_ID_MESSAGE) == [Identity(7)]
        assert Identity(1).wire == bytes.fromhex("F0 52 01 F7")

    def test_its_pins_can_what_the_map_says_and_others_nothing(self, board: Board) -> None:
        either, pwm, servo = {0: 1, 1: 1}, {3: 8}, {4: 14}
        (capabilities,) = board.hears(ASK_CAPABILITIES_MESSAGE)
        assert isinstance(capabilities, Capabilities)
        assert len(capabilities.pins) == 17
        assert {number: pin for number, pin in enumerate(capabilities.pins) if pin} == {
            2: {**either, 11: 1},
            3: {**either, **pwm},
            5: {**either, 11: 1},
            9: {**either, **servo},
            10: {**either, **servo},
            12: either,
            13: either,
            14: {2: 10},
            15: {2: 10},
            16: {2: 10},
        }

    def test_analog_channels_are_the_pins_behind_the_digital_ones(self, board: Board) -> None:
        assert board.hears(ASK_MAPPING_MESSAGE) == [AnalogMapping((None,) * 14 + (0, 1, 2))]
        (mapping,) = Board({"20": {"command": "x"}, "A0": {"reading": "y"}}).hears(ASK_MAPPING_MESSAGE)
        assert mapping == AnalogMapping((None,) * 21 + (0,))

    def test_it_tells_what_was_written_to_a_pin(self, board: Board) -> None:
        assert board.hears(AskPinState(9)) == [PinState(9, MODES["output"], 0)]
        board.hears(PinMode(9, MODES["servo"]), AnalogMessage(9, 120))
        assert board.hears(AskPinState(9)) == [PinState(9, MODES["servo"], 120)]
        board.hears(PinMode(2, MODES["pullup"]))
        assert board.hears(AskPinState(2)) == [PinState(2, MODES["pullup"], 1)]
        assert board.hears(AskPinState(14)) == [PinState(14, MODES["analog"], 0)]
        assert board.hears(AskPinState(99)) == [PinState(99, None)]

    def test_what_no_board_of_ours_can_is_passed_over(self, board: Board) -> None:
        assert board.hears(Sysex(0x76, b"\x10\x00"), Text("hello")) == []


class TestWriting:
    def test_a_servo_is_told_in_the_robots_own_degrees(self, board: Board) -> None:
        assert board.hears(PinMode(9, MODES["servo"])) == []
        assert board.hears(AnalogMessage(9, 120)) == [Call("garra", (30,), newest=True)]

    def test_an_angle_beyond_what_a_servo_can_stops_at_its_end(self, board: Board) -> None:
        assert board.hears(AnalogMessage(10, 181)) == [Call("braço", (180,), newest=True)]

    @pytest.mark.parametrize(("pulse_us", "angle_deg"), [(544, 0), (1472, 90), (2400, 180), (9999, 180)])
    def test_the_length_of_a_pulse_is_an_angle(self, board: Board, pulse_us: int, angle_deg: int) -> None:
        assert board.hears(AnalogMessage(10, pulse_us)) == [Call("braço", (angle_deg,), newest=True)]

    def test_pulses_are_read_as_the_program_configured_the_servo(self, board: Board) -> None:
        board.hears(ServoConfig(10, 1000, 2000))
        assert board.hears(AnalogMessage(10, 1500)) == [Call("braço", (90,), newest=True)]
        assert board.hears(AnalogMessage(10, 600)) == [Call("braço", (0,), newest=True)]
        assert board.hears(AskPinState(10)) == [PinState(10, MODES["servo"], 0)]

    def test_pulses_count_for_a_pin_that_was_something_else_before(self, board: Board) -> None:
        board.hears(PinMode(10, MODES["output"]), PinValue(10, True))
        board.hears(ServoConfig(10, 1000, 2000))
        assert board.hears(AnalogMessage(10, 1500)) == [Call("braço", (90,), newest=True)]

    def test_pulses_for_a_pin_that_is_not_there_are_refused_however_often(self, board: Board) -> None:
        said = [board.hears(ServoConfig(100, 1000, 2000)) for _ in range(10)]
        assert said[0] == [Text("pin 100 cannot be servo")]
        assert said[-1] == []

    def test_a_scale_beyond_all_numbers_is_refused_like_any_other_value(self) -> None:
        board = Board({"3": {"command": "roda", "mode": "pwm", "scale": 1e308}})
        assert board.hears(AnalogMessage(3, 255)) == [Text("roda takes any number, got inf")]

    def test_a_value_out_of_range_is_refused_with_the_range(self, board: Board) -> None:
        assert board.hears(AnalogMessage(9, 170)) == [Text("garra takes -45 to 45, got 80")]

    @pytest.mark.parametrize(
        ("limits", "takes"),
        [
            ({"minimum": 100}, "at least 100"),
            ({"maximum": 20}, "at most 20"),
            ({"minimum": 10, "maximum": 20}, "10–20"),
        ],
    )
    def test_a_range_may_be_open_at_one_end(self, limits: dict[str, object], takes: str) -> None:
        board = Board({"9": {"command": "x", "mode": "servo", **limits}})
        assert board.hears(AnalogMessage(9, 90)) == [Text(f"x takes {takes}, got 90")]

    def test_a_level_is_scaled_as_declared(self, board: Board) -> None:
        assert board.hears(PinMode(3, MODES["pwm"]), AnalogMessage(3, 200)) == [Call("roda", (100,), newest=True)]
        assert board.hears(AnalogMessage(3, 16383)) == [Call("roda", (128,), newest=True)]

    def test_digits_behind_the_point_are_declared_too(self) -> None:
        board = Board({"3": {"command": "roda", "mode": "pwm", "scale": 0.01, "decimals": 2}})
        assert board.hears(AnalogMessage(3, 128)) == [Call("roda", (1.28,), newest=True)]

    def test_a_level_can_come_after_other_parameters(self) -> None:
        board = Board({"3": {"command": "node", "mode": "pwm", "before": [4]}})
        assert board.hears(AnalogMessage(3, 128)) == [Call("node", (4, 128), newest=True)]

    def test_two_pins_of_one_command_are_no_set_points_of_each_other(self) -> None:
        board = Board(
            {
                "3": {"command": "node", "mode": "pwm", "before": [4]},
                "5": {"command": "node", "mode": "pwm", "before": [5]},
            }
        )
        assert board.hears(AnalogMessage(3, 1), AnalogMessage(5, 2)) == [Call("node", (4, 1)), Call("node", (5, 2))]

    def test_a_pin_beyond_15_is_written_by_the_longer_message(self) -> None:
        board = Board({"20": {"command": "roda", "mode": "pwm"}})
        assert board.hears(AnalogMessage(20, 255)) == [Call("roda", (255,), newest=True)]

    def test_of_a_port_only_what_changed_is_told(self, board: Board) -> None:
        board.hears(PinMode(12, 1), PinMode(13, 1))
        on, off = Call("farol", (255,), newest=True), Call("farol", (0,), newest=True)
        assert board.hears(DigitalMessage(1, 1 << 4)) == [Call("sirene", (1,), newest=True), off]
        assert board.hears(DigitalMessage(1, 1 << 4)) == []
        assert board.hears(DigitalMessage(1, 1 << 4 | 1 << 5)) == [on]
        assert board.hears(DigitalMessage(1, 0)) == [Call("sirene", (0,), newest=True), off]

    def test_the_rest_of_a_port_is_left_alone_until_the_program_speaks_of_it(self, board: Board) -> None:
        board.hears(PinMode(13, MODES["output"]))
        assert board.hears(DigitalMessage(1, 0)) == [Call("farol", (0,), newest=True)]
        assert board.hears(DigitalMessage(1, 1 << 4)) == [Call("sirene", (1,), newest=True)], (
            "an output is what a pin is until told"
        )

    def test_a_pin_that_was_made_an_input_is_not_written(self, board: Board) -> None:
        board.hears(PinMode(13, MODES["input"]))
        assert board.hears(DigitalMessage(1, 1 << 5)) == []

    def test_a_single_pin_is_written_whatever_it_was(self, board: Board) -> None:
        assert board.hears(PinValue(13, False)) == [Call("farol", (0,), newest=True)]
        assert board.hears(PinValue(13, False)) == [Call("farol", (0,), newest=True)]

    def test_a_level_pin_used_as_an_output_is_all_or_nothing(self, board: Board) -> None:
        board.hears(PinMode(3, MODES["output"]))
        assert board.hears(DigitalMessage(0, 1 << 3)) == [Call("roda", (128,), newest=True)]
        assert board.hears(DigitalMessage(0, 0)) == [Call("roda", (0,), newest=True)]

    def test_a_mode_that_a_pin_cannot_have_is_refused_in_words(self, board: Board) -> None:
        assert board.hears(PinMode(13, MODES["servo"])) == [Text("pin 13 cannot be servo")]
        assert board.hears(PinMode(7, MODES["output"])) == [Text("pin 7 cannot be output")]
        assert board.hears(PinMode(14, MODES["output"])) == [Text("pin A0 cannot be output")]
        assert board.hears(ServoConfig(13, 544, 2400)) == [Text("pin 13 cannot be servo")]
        assert board.hears(PinMode(120, 0x2A)) == [Text("pin 120 cannot be mode 42")]

    def test_writing_to_what_is_no_such_pin_is_refused_in_words(self, board: Board) -> None:
        assert board.hears(AnalogMessage(13, 90)) == [Text("pin 13 takes neither a level nor an angle")]
        assert board.hears(PinValue(2, True)) == [Text("pin 2 is no output")]
        assert board.hears(PinValue(9, True)) == [Text("pin 9 is no output")]
        assert board.hears(PinValue(99, True)) == [Text("pin 99 is no output")]

    def test_a_program_that_does_not_listen_is_not_told_for_ever(self, board: Board) -> None:
        said = [board.hears(AnalogMessage(13, 90)) for _ in range(100)]
        assert sum(map(len, said)) == 3
        board.now += 1
        assert len(board.hears(AnalogMessage(13, 90))) == 1

    def test_a_reset_switches_off_what_is_on_and_forgets_the_rest(self, board: Board) -> None:
        board.hears(AnalogMessage(3, 200), AnalogMessage(9, 90), PinMode(13, 1), DigitalMessage(1, 1 << 5))
        board.hears(ReportAnalog(0, True))
        assert board.hears(RESET_MESSAGE) == [Call("roda", (0,), newest=True), Call("farol", (0,), newest=True)]
        assert board.hears(AskPinState(13)) == [PinState(13, MODES["output"], 0)]
        assert board.persona.waits_until() is None


class TestOutcome:
    def test_what_the_robot_did_is_not_told(self, board: Board) -> None:
        (call,) = board.hears(AnalogMessage(9, 90))
        assert isinstance(call, Call)
        assert board.robot_answers(call, status="sucesso") == []

    def test_what_the_robot_did_not_do_is_told_in_words(self, board: Board) -> None:
        (call,) = board.hears(AnalogMessage(9, 90))
        assert isinstance(call, Call)
        assert board.robot_answers(call, 3, status="falha") == [Text("garra 0 falha 3")]
        assert seen(board.persona.answered(call, None, "no answer within 2 s", board.now)) == [
            Text("no answer within 2 s")
        ]

    def test_the_words_of_the_robot_are_told_where_it_has_any(self, board: Board) -> None:
        answer = Answer(status="falha", remark="arm blocked", elapsed_ms=1)
        assert seen(board.persona.answered(Call("garra", (0,)), answer, "", 0.0)) == [Text("arm blocked")]

    def test_what_failed_can_be_written_again(self, board: Board) -> None:
        board.hears(PinMode(13, 1))
        (call,) = board.hears(DigitalMessage(1, 1 << 5))
        assert isinstance(call, Call)
        board.persona.answered(call, None, "link_down", board.now)
        assert board.hears(DigitalMessage(1, 1 << 5)) == [call]

    def test_what_a_pin_drove_goes_off_when_it_becomes_something_else(self, board: Board) -> None:
        board.hears(PinMode(13, 1))
        board.hears(DigitalMessage(1, 1 << 5))
        assert board.hears(PinMode(13, 0)) == [Call("farol", (0,), newest=True)]

    def test_what_could_not_be_switched_off_is_switched_off_by_the_next_word(self, board: Board) -> None:
        board.hears(PinMode(13, 1))
        board.hears(DigitalMessage(1, 1 << 5))
        (off,) = board.hears(DigitalMessage(1, 0))
        assert isinstance(off, Call)
        board.persona.answered(off, None, "queue_full", board.now)
        assert board.hears(DigitalMessage(1, 0)) == [off]
        board.persona.answered(off, None, "queue_full", board.now)
        assert off in board.hears(RESET_MESSAGE)


class TestReading:
    def test_nothing_is_reported_before_it_is_wanted_or_known(self, board: Board) -> None:
        assert board.robot_tells(readings={"bateria": 7.4}) == []
        assert Board().hears(ReportAnalog(2, True), ReportDigital(0, True)) == []

    def test_what_is_known_is_reported_as_soon_as_it_is_wanted(self, board: Board) -> None:
        board.robot_tells(readings={"bateria": 7.4, "toque": 1})
        assert board.hears(ReportAnalog(2, True)) == [AnalogMessage(2, 740)]
        assert board.hears(ReportDigital(0, True)) == [DigitalMessage(0, 1 << 2)]

    def test_what_the_robot_tells_is_reported_in_each_of_its_forms(self, board: Board) -> None:
        board.hears(ReportAnalog(2, True), Sampling(1))
        forms: list[dict[str, object]] = [
            {"kind": "event", "readings": {"bateria": 0.0}},
            {"kind": "node", "command": "bateria", "value": 1.0, "parameters": []},
            {"kind": "command", "command": "bateria", "parameters": [2, 99]},
        ]
        for value, described in enumerate(forms):
            board.now += 1
            assert board.robot_tells(**described) == [AnalogMessage(2, 100 * value)]
        assert board.robot_tells(kind="command", command="bateria", parameters=[]) == []
        assert board.robot_tells(kind="event", readings={"outra": 1}) == []

    @pytest.mark.parametrize(("reading", "level"), [(-5, 0), (3, 300), (99.0, 1023)])
    def test_a_channel_shows_as_far_as_it_goes(self, board: Board, reading: float, level: int) -> None:
        board.hears(ReportAnalog(2, True))
        assert board.robot_tells(readings={"bateria": reading}) == [AnalogMessage(2, level)]

    @pytest.mark.parametrize("reading", ["cheia", float("nan"), float("inf")])
    def test_what_a_channel_cannot_show_is_told_in_words(self, board: Board, reading: Value) -> None:
        board.hears(ReportAnalog(2, True))
        assert board.robot_tells(readings={"bateria": reading}) == [
            Text(f"bateria reads {reading}, which pin A2 cannot show")
        ]

    def test_reports_of_a_channel_keep_the_interval_and_the_newest_is_not_lost(self, board: Board) -> None:
        board.hears(ReportAnalog(2, True), Sampling(100))
        assert board.robot_tells(readings={"bateria": 1}) == [AnalogMessage(2, 100)]
        board.now += 0.03
        assert board.robot_tells(readings={"bateria": 2}) == []
        assert board.robot_tells(readings={"bateria": 3}) == []
        assert board.persona.waits_until() == pytest.approx(100.1)
        assert seen(board.persona.due(100.05)) == []
        assert board.time_passes() == [AnalogMessage(2, 300)]
        assert board.persona.waits_until() is None

    def test_a_digital_input_reports_its_changes_alone(self, board: Board) -> None:
        board.hears(ReportDigital(0, True))
        assert board.robot_tells(readings={"toque": 0}) == [DigitalMessage(0, 0)]
        assert board.robot_tells(readings={"toque": 0}) == []
        assert board.robot_tells(readings={"toque": 5}) == [DigitalMessage(0, 1 << 2)]
        assert board.robot_tells(command="porta", parameters=["aberta"]) == [DigitalMessage(0, 1 << 2 | 1 << 5)]
        assert board.robot_tells(command="porta", parameters=["fechada"]) == [DigitalMessage(0, 1 << 2)]

    def test_high_begins_where_it_is_declared(self) -> None:
        board = Board({"2": {"reading": "distancia", "above": 30}})
        board.hears(ReportDigital(0, True))
        assert board.robot_tells(readings={"distancia": 30}) == [DigitalMessage(0, 0)]
        assert board.robot_tells(readings={"distancia": 30.5}) == [DigitalMessage(0, 4)]

    def test_a_pin_that_was_made_an_output_is_not_reported(self, board: Board) -> None:
        board.hears(ReportDigital(0, True), PinMode(2, MODES["output"]))
        assert board.robot_tells(readings={"toque": 1}) == []

    def test_nothing_is_reported_once_it_is_no_longer_wanted(self, board: Board) -> None:
        board.hears(ReportAnalog(2, True), ReportDigital(0, True), ReportAnalog(2, False), ReportDigital(0, False))
        assert board.robot_tells(readings={"bateria": 7, "toque": 1}) == []

    def test_a_channel_where_nothing_is_read_is_silent(self, board: Board) -> None:
        assert board.hears(ReportAnalog(1, True), ReportAnalog(15, True), ReportDigital(15, True)) == []


class TestAsking:
    QUESTION = Call("luz")

    def test_the_robot_is_asked_only_while_a_program_wants_it(self, board: Board) -> None:
        assert board.persona.waits_until() is None
        board.hears(ReportAnalog(0, True))
        assert board.persona.waits_until() is not None
        assert board.time_passes() == [self.QUESTION]
        board.robot_answers(self.QUESTION, 5)
        board.hears(ReportAnalog(0, False))
        assert board.persona.waits_until() is None

    def test_its_answer_is_what_the_channel_reads(self, board: Board) -> None:
        board.hears(ReportAnalog(0, True))
        board.time_passes()
        assert board.robot_answers(self.QUESTION, 51.2) == [AnalogMessage(0, 512)]

    def test_it_is_asked_again_in_time_but_never_twice_at_once(self, board: Board) -> None:
        board.hears(ReportAnalog(0, True))
        begun = board.now
        board.time_passes()
        assert board.persona.waits_until() is None
        board.now += 0.1
        board.robot_answers(self.QUESTION, 1)
        assert board.persona.waits_until() == pytest.approx(begun + 0.5)
        board.now += 10
        assert board.time_passes() == [self.QUESTION]

    def test_a_question_without_an_answer_is_asked_again_and_told_of(self, board: Board) -> None:
        board.hears(ReportAnalog(0, True))
        board.time_passes()
        told = seen(board.persona.answered(self.QUESTION, None, "MNERIM did not answer", board.now))
        assert told == [Text("MNERIM did not answer")]
        assert board.time_passes() == [self.QUESTION]
        assert board.robot_answers(self.QUESTION, status="falha") == [Text("luz falha")]

    def test_pins_that_read_the_same_share_a_question(self) -> None:
        board = Board(
            {
                "2": {"reading": "luz", "poll_s": 2, "ask": "sensor", "before": [7], "above": 50},
                "A0": {"reading": "luz", "poll_s": 1, "ask": "sensor", "before": [7]},
            }
        )
        board.hears(ReportDigital(0, True), ReportAnalog(0, True))
        assert board.time_passes() == [Call("sensor", (7,))]
        assert board.robot_answers(Call("sensor", (7,)), 60) == [DigitalMessage(0, 4), AnalogMessage(0, 60)]
        assert board.persona.waits_until() == pytest.approx(101)


class TestMap:
    @pytest.mark.parametrize(
        ("pins", "complaint"),
        [
            ({"D9": {"command": "x"}}, "D9 is no pin: expected 0–111 or A0–A15"),
            ({"112": {"command": "x"}}, "112 is no pin"),
            ({"09": {"command": "x"}}, "09 is no pin"),
            ({"A16": {"reading": "x"}}, "A16 is no pin"),
            ({"A0": {"command": "x"}}, "A0 is an input, and can have a reading but no command"),
            ({"9": {}}, "give either a command, for an output, or a reading, for an input"),
            ({"9": {"command": "x", "reading": "y"}}, "give either a command"),
            ({"9": {"command": "x", "scale": 2}}, "9: scale has no meaning for such a pin"),
            ({"9": {"command": "x", "mode": "servo", "on": [1]}}, "9: on has no meaning for such a pin"),
            ({"9": {"reading": "x", "mode": "output"}}, "9: mode has no meaning for such a pin"),
            ({"A0": {"reading": "x", "above": 1}}, "A0: above has no meaning for such a pin"),
            ({"A0": {"reading": "x", "ask": "y"}}, "ask needs poll_s"),
            ({"9": {"command": "x", "mode": "pwm", "scale": 0}}, "a scale of 0"),
            (
                {"9": {"command": "x", "mode": "pwm", "minimum": 2}},
                "a program switches a pwm pin off by 0, but x takes at least 2, got 0; widen minimum to maximum",
            ),
            ({"9": {"command": "x", "mode": "pwm", "offset": 9, "maximum": 8}}, "but x takes at most 8, got 9"),
            ({"9": {"command": "x", "mode": "pwm", "minimum": 2, "maximum": 1}}, "minimum is above maximum"),
            ({"9": {"command": "x", "mode": "pmw"}}, "'output', 'pwm' or 'servo'"),
        ],
    )
    def test_what_no_board_can_be_is_refused_by_name(self, pins: dict[str, object], complaint: str) -> None:
        with pytest.raises(ValidationError, match=complaint):
            FirmataMap(**pins)

    def test_a_board_without_any_pin_answers_all_the_same(self) -> None:
        board = Board({})
        assert board.hears(ASK_CAPABILITIES_MESSAGE) == [Capabilities(({},) * 14)]
        assert board.hears(ASK_MAPPING_MESSAGE) == [AnalogMapping((None,) * 14)]

    def test_every_setting_is_described(self) -> None:
        schema = FirmataMap.model_json_schema()
        for properties in (schema["properties"], schema["$defs"]["PlayedPin"]["properties"]):
            assert all(each.get("description") for each in properties.values())


number, wide = st.integers(0, 127), st.integers(0, 16383)
channel, switch = st.integers(0, 15), st.booleans()
wires = st.one_of(
    st.builds(AnalogMessage, number, wide),
    st.builds(PinMode, number, number),
    st.builds(PinValue, number, switch),
    st.builds(DigitalMessage, channel, wide),
    st.builds(ServoConfig, number, wide, wide),
    st.builds(ReportAnalog, channel, switch),
    st.builds(ReportDigital, channel, switch),
    st.builds(Sampling, wide),
).map(lambda message: message.wire)
values = st.one_of(st.integers(-(10**18), 10**18), st.floats(), st.text(max_size=8))


@given(
    st.lists(st.one_of(wires, st.binary(max_size=6))),
    st.lists(st.tuples(st.sampled_from(["luz", "toque", "porta", "bateria"]), values), max_size=4),
)
def test_whatever_a_program_and_a_robot_say_nothing_raises_and_all_that_is_said_is_firmata(
    pieces: list[bytes], told: list[tuple[str, Value]]
) -> None:
    board, codec = Board(), Firmata(OPTIONS)
    actions = list(board.persona.opened(board.now))
    for frame in [each for each in codec.decode(b"".join(pieces), 0.0) if isinstance(each, Frame)]:
        board.now += 0.01
        actions += board.persona.heard(frame, board.now)
        actions += board.persona.told(Description(readings=dict(told)), board.now)
        if board.persona.waits_until() is not None:
            actions += board.persona.due(board.now)
    for action in actions:
        if isinstance(action, Say):
            codec.encode(Frame(NOBODY, NOBODY, action.subject, action.payload, "firmata"))
        else:
            assert action.command in {"roda", "garra", "braço", "sirene", "farol", "luz"}
            assert -45 <= action.parameters[0] <= 45 if action.command == "garra" else True  # type: ignore[operator]


@given(st.binary())
def test_a_payload_that_is_no_message_is_passed_over(payload: bytes) -> None:
    Board().persona.heard(Frame(NOBODY, NOBODY, "", payload, "firmata"), 0.0)

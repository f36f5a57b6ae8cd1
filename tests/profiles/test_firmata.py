"""Boards as robots: calls by pin name, what their answers mean, and how a board is set up, against a simulated Uno."""

from collections.abc import Sequence
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from psiu_broker.codecs import firmata_messages as fm
from psiu_broker.codecs.codec import Directory
from psiu_broker.codecs.firmata import Firmata, messages
from psiu_broker.errors import CallError
from psiu_broker.frame import NOBODY, Frame
from psiu_broker.messages import Value
from psiu_broker.profiles.firmata import AT_ONCE_S, RESERVED, FirmataOptions, FirmataProfile
from psiu_broker.profiles.profile import SENT, Reply, Request
from psiu_broker.simulator.firmata import FirmataBoard

PINS: dict[str, Any] = {
    "led": {"pin": 13, "mode": "output"},
    "garra": {"pin": 9, "mode": "servo", "minimum": 10, "maximum": 170},
    "motor": {"pin": 5, "mode": "pwm", "unit": "%"},
    "brilho": {"pin": 6, "mode": "pwm"},
    "botao": {"pin": 2, "mode": "pullup"},
    "fim": {"pin": 4, "mode": "input"},
    "luz": {"pin": "A0", "mode": "analog", "scale": 0.1, "unit": "lx"},
    "bateria": {"pin": "A1", "mode": "analog", "unit": "%"},
}


def profile(pins: dict[str, Any] | None = None, **options: Any) -> FirmataProfile:
    return FirmataProfile(FirmataOptions.model_validate({"pins": PINS if pins is None else pins, **options}))


class Bench:
    """A profile and a simulated board at the two ends of a line, without a broker."""

    def __init__(self, robot: FirmataProfile, board: FirmataBoard) -> None:
        self.robot = robot
        self.board = board
        self.codec = Firmata(Firmata.Options(), Directory())
        self.now = 0.0
        self.greetings = 0
        self.frames: list[Frame] = []
        self.sent: list[Request] = []
        board.advance(0.0)
        board.telemetry()

    def hear(self, data: bytes) -> list[Frame]:
        frames = [event for event in self.codec.decode(data, self.now) if isinstance(event, Frame)]
        self.frames += frames
        news = [frame for frame in frames if self.robot.learn(frame)]
        if news:
            self.greet()
        return frames

    def send(self, request: Request) -> list[Frame]:
        request = self.robot.sending(request)
        self.sent.append(request)
        frame = Frame(NOBODY, NOBODY, request.subject, request.payload, "firmata")
        told = b"".join(reply for _, reply in self.board.receive(self.codec.encode(frame), self.now))
        return self.hear(told)

    def greet(self) -> None:
        self.greetings += 1
        assert self.greetings < 10
        for request in self.robot.greeting():
            self.send(request)

    def passes(self, seconds: float) -> list[Frame]:
        self.now += seconds
        self.board.advance(self.now)
        return self.hear(self.board.telemetry())

    def call(self, command: str, *parameters: Value) -> Reply | None:
        request = self.robot.request(command, parameters)
        readings = [self.robot.read(request, frame) for frame in self.send(request)]
        answers = [reading for reading in readings if reading is not None]
        return answers[0] if answers else request.silence


def bench(pins: dict[str, Any] | None = None, **options: Any) -> Bench:
    made = Bench(profile(pins, **options), FirmataBoard())
    made.greet()
    return made


def refusal(robot: FirmataProfile, command: str, *parameters: Value) -> tuple[str, str]:
    with pytest.raises(CallError) as caught:
        robot.request(command, parameters)
    return caught.value.code, str(caught.value)


def frame(wire: str) -> Frame:
    (heard,) = Firmata().decode(bytes.fromhex(wire), 0.0)
    assert isinstance(heard, Frame)
    return heard


def test_the_greeting_asks_who_it_is_and_makes_the_pins_what_they_are_for() -> None:
    *questions, setting = profile().greeting()
    assert [(each.subject, each.payload.hex(), each.question) for each in questions] == [
        ("ask/firmware", "f079f7", True),
        ("ask/capabilities", "f06bf7", True),
        ("ask/mapping", "f069f7", True),
    ]
    assert setting.payload.hex(" ", 0) == ("f07a6400f7f40d01f40904f40503f40603f4020bf40400d001c001c101")
    assert setting.silence == SENT


def test_a_greeted_board_is_set_up_and_reports() -> None:
    at = bench()
    assert [at.board.modes[pin] for pin in (13, 9, 5, 6, 2, 4, 14, 15)] == [1, 4, 3, 3, 11, 0, 2, 2]
    at.board.set_pin("A0", 300)
    told = [at.robot.describe(each) for each in at.passes(0.1)]
    assert told[-2:] == [
        {"kind": "event", "command": "luz", "parameters": [], "value": 30.0, "unit": "lx", "readings": {"luz": 30.0}},
        {
            "kind": "event",
            "command": "bateria",
            "parameters": [],
            "value": 0.0,
            "unit": "%",
            "readings": {"bateria": 0},
        },
    ]
    at.board.set_pin(2, 0)
    at.board.set_pin(4, 1)
    (event, *_) = at.passes(0.02)
    assert at.robot.describe(event) == {
        "kind": "event", "command": "digital/0", "parameters": [], "readings": {"botao": 0, "fim": 1},
    }  # fmt: skip


def test_a_board_is_set_up_once_more_when_it_has_told_where_its_analog_pins_are_and_no_more() -> None:
    at = Bench(profile(), FirmataBoard())
    at.greet()
    assert at.greetings == 2
    assert "f40e02f40f02c001c101" in [each.payload.hex() for each in at.sent]
    at.greet()
    assert at.greetings == 3


def test_a_pin_known_by_its_channel_is_set_up_once_the_board_has_told_its_number() -> None:
    at = bench({"rele": {"pin": "A3", "mode": "output"}, "pot": {"pin": 18, "mode": "analog"}})
    assert (at.board.modes[17], at.board.modes[18]) == (1, 2)
    assert at.call("rele", "on") == Reply("sucesso")
    assert at.board.states[17] == 1
    at.board.set_pin("A4", 7)
    assert at.call("pot") == Reply(None, (7,))


def test_a_board_that_was_reset_is_greeted_again() -> None:
    at = bench()
    at.passes(0.1)
    before = at.greetings
    at.board.press_reset()
    assert at.board.modes[9] == 1
    at.passes(0.1)
    assert at.greetings == before + 1
    assert at.board.modes[9] == 4


def test_answers_to_questions_are_no_reset() -> None:
    robot = profile()
    assert not robot.learn(frame("f90205"))
    assert not robot.learn(frame("e00000"))
    assert not robot.learn(frame("f0790205f7"))
    assert not robot.learn(frame("f90205"))
    assert robot.learn(frame("f0790205f7"))


@pytest.mark.parametrize(
    ("command", "parameters", "pin", "mode", "state"),
    [
        ("led", ["on"], 13, 1, 1),
        ("led", ["off"], 13, 1, 0),
        ("led", [1], 13, 1, 1),
        ("led", ["0"], 13, 1, 0),
        ("garra", [90], 9, 4, 90),
        ("garra", ["170"], 9, 4, 170),
        ("motor", [50], 5, 3, 128),
        ("motor", ["33.3"], 5, 3, 85),
        ("motor", [100], 5, 3, 255),
        ("brilho", [255], 6, 3, 255),
        ("digital", [12, 1], 12, 1, 1),
        ("digital", ["led", "on"], 13, 1, 1),
        ("digital", ["D12", 1], 12, 1, 1),
        ("analog", [9, 45], 9, 4, 45),
        ("analog", ["brilho", "200"], 6, 3, 200),
        ("mode", [11, "pwm"], 11, 3, 0),
        ("mode", ["A5", "pullup"], 19, 11, 1),
    ],
)
def test_an_order_is_done_and_confirmed(command: str, parameters: list[Value], pin: int, mode: int, state: int) -> None:
    at = bench()
    assert at.call(command, *parameters) == Reply("sucesso")
    assert (at.board.modes[pin], at.board.states[pin]) == (mode, state)


def test_an_order_that_the_board_did_not_follow_has_failed_and_says_what_the_pin_is() -> None:
    at = bench()
    at.call("mode", 13, "input")
    at.call("mode", 9, "output")
    assert at.call("led", "on") == Reply("falha", remark="pin 13 is input with 0, not output with 1")
    assert at.call("garra", 90) == Reply("falha", remark="pin 9 is output with 0, not pwm or servo with 90")


def test_without_confirmation_an_order_is_only_sent() -> None:
    at = bench(confirm=False)
    request = at.robot.request("led", [1])
    assert (request.payload.hex(), request.timeout_s, request.silence) == ("f50d01", AT_ONCE_S, SENT)
    assert at.call("led", 1) == SENT
    assert at.board.states[13] == 1


def test_an_order_is_not_repeated_and_a_question_may_be() -> None:
    robot = profile()
    assert [robot.request("led", [1]).question, robot.request("luz", []).question] == [False, True]
    assert [robot.request("state", [13]).question, robot.request("reset", []).question] == [True, False]
    assert robot.request("led", [1]).silence is None


def test_an_input_is_asked_and_not_remembered() -> None:
    at = bench()
    at.board.set_pin("A0", 512)
    at.board.set_pin("A1", 1023)
    at.board.set_pin(4, 1)
    assert at.call("luz") == Reply(None, (51.2,), "lx")
    assert at.call("bateria") == Reply(None, (100,), "%")
    assert at.call("fim") == Reply(None, (1,))
    assert at.call("botao") == Reply(None, (1,))
    at.board.set_pin(2, 0)
    assert at.call("botao") == Reply(None, (0,))


def test_a_state_is_a_mode_and_what_was_written() -> None:
    at = bench()
    at.call("garra", 120)
    assert at.call("state", "garra") == Reply(None, ("servo", 120))
    assert at.call("state", 2) == Reply(None, ("pullup", 1))
    assert FirmataProfile().read(FirmataProfile().request("state", [99]), frame("f06e63f7")) == Reply(
        "falha", remark="the board has no pin 99"
    )


def test_a_reset_puts_the_pins_in_order_again() -> None:
    at = bench()
    at.call("led", 1)
    at.call("mode", 9, "output")
    assert at.call("reset") == Reply("sucesso")
    assert (at.board.resets, at.board.states[13], at.board.modes[9], at.board.modes[2]) == (1, 0, 4, 11)


def test_a_text_is_sent_and_the_firmware_tells_its_name() -> None:
    at = bench()
    assert at.call("text", "bom", "dia", 7) == SENT
    assert at.board.texts == ["bom dia 7"]
    assert at.call("firmware") == Reply(None, ("StandardFirmata.ino", "2.5"))


@pytest.mark.parametrize(
    ("command", "parameters", "message"),
    [
        ("led", ["talvez"], "led takes on or off, got talvez"),
        ("led", [2], "led takes on or off, got 2"),
        ("led", [0.5], "led takes on or off, got 0.5"),
        ("led", [], "led takes one value, on or off, got nothing"),
        ("garra", [5], "garra takes 10–170 deg, got 5"),
        ("garra", [45.5], "garra takes 10–170 deg, got 45.5"),
        ("garra", ["on"], "garra takes 10–170 deg, got on"),
        ("garra", [float("nan")], "garra takes 10–170 deg, got nan"),
        ("garra", [1, 2], "garra takes one value, 10–170 deg, got 1 2"),
        ("motor", [101], "motor takes 0–100 %, got 101"),
        ("brilho", [256], "brilho takes 0–255, got 256"),
        ("luz", [1], "luz is an input and takes no parameters, got 1"),
        ("digital", [13, 2], "digital takes a pin, and 1 or 0 (on or off), got 13 2"),
        ("digital", ["x", 1], "there is no pin x: it is a number, A0, D13 or one of its names"),
        ("digital", [128, 1], "there is no pin 128: it is a number, A0, D13 or one of its names"),
        ("digital", [20, 1], "the board has pins 0–19, not 20"),
        ("digital", ["A7", 1], "the board tells no pin A7"),
        ("analog", [13, 1], "pin 13 cannot be pwm or servo; it can be: input, pullup, output, servo"),
        ("analog", [3, -1], "analog takes a pin and a number 0–16383, got 3 -1"),
        ("mode", [0, "input"], "pin 0 cannot be input; it can be: nothing"),
        ("mode", [13, "pwm"], "pin 13 cannot be pwm; it can be: input, pullup, output, servo"),
        ("mode", [13, "saida"], "mode takes a pin and one of input, output, analog, pwm, servo, shift, i2c, onewire,"
            " stepper, encoder, serial, pullup, got 13 saida"),
        ("text", ["x" * 31], "text takes 1–30 bytes, got 31: a board has room for no more"),
        ("text", [], "text takes words, got nothing"),
        ("reset", [1], "reset takes no parameters, got 1"),
    ],
)  # fmt: skip
def test_what_a_pin_cannot_do_is_refused_and_says_why(command: str, parameters: list[Value], message: str) -> None:
    at = bench()
    if command == "analog" and parameters == [13, 1]:
        # An Uno's pin 13 is a servo; a board that cannot do that either says so.
        at.hear(fm.Capabilities(({},) * 13 + ({0: 1, 11: 1, 1: 1},)).wire)
        message = "pin 13 cannot be pwm or servo; it can be: input, pullup, output"
    assert refusal(at.robot, command, *parameters) == ("refused", message)


def test_a_named_pin_that_the_board_cannot_use_so_is_refused_by_name_of_what_it_can() -> None:
    at = bench({"vela": {"pin": 12, "mode": "pwm"}})
    assert refusal(at.robot, "vela", 1) == (
        "refused",
        "pin 12 cannot be pwm; it can be: input, pullup, output, servo",
    )


def test_before_a_board_has_told_anything_nothing_is_refused_for_that() -> None:
    robot = profile()
    assert robot.request("digital", [77, 1]).payload.hex() == "f54d01f06d4df7"
    assert robot.request("luz", []).payload.hex() == "c001"
    assert refusal(robot, "digital", "A3", 1) == ("refused", "the board tells no pin A3 (yet)")
    assert refusal(profile({"pot": {"pin": 14, "mode": "analog"}}), "pot") == (
        "refused",
        "the board tells no analog channel of pin 14; write A0 to A15",
    )


def test_an_unknown_command_names_those_that_there_are() -> None:
    code, text = refusal(profile(), "gara", 1)
    assert code == "unknown_command"
    assert text.startswith("no command gara: did you mean garra? It has led, garra, motor,")


def test_boards_before_firmata_2_5_get_their_outputs_by_the_port_and_keep_the_others() -> None:
    robot = profile({"a": {"pin": 12, "mode": "output"}, "b": {"pin": 13, "mode": "output"}})

    def sent(command: str, value: str) -> str:
        return robot.sending(robot.request(command, [value])).payload.hex()

    robot.learn(frame("f90203"))
    assert sent("a", "on") == "911000f06d0cf7"
    assert sent("b", "on") == "913000f06d0df7"
    request = robot.request("b", ["on"])
    assert robot.read(request, frame("f06e0d0101f7")) == Reply("sucesso")
    assert robot.read(request, frame("f06e0d0100f7")) == Reply(
        "falha", remark="pin 13 is output with 0, not output with 1"
    )
    assert robot.sending(robot.request("b", ["on"])).subject == "write-digital/1"
    robot.learn(frame("f06e0d0101f7"))
    assert sent("a", "off") == "912000f06d0cf7"
    assert robot.learn(frame("f90203")) or robot.learn(frame("f0790203f7"))
    assert sent("a", "off") == "910000f06d0cf7"


class OldBoard(FirmataBoard):
    """Firmata 2.3, which the link does not reset when it opens; it knows no single pins."""

    def hello(self) -> bytes:
        return super().hello() and b""

    def receive(self, data: bytes, now: float) -> list[tuple[float, bytes]]:
        kept = b"".join(wire for wire in messages(data, "host") if wire[0] != 0xF5)
        return [
            (delay_s, said.replace(b"\xf9\x02\x05", b"\xf9\x02\x03")) for delay_s, said in super().receive(kept, now)
        ]


OUTPUTS = {name: {"pin": pin, "mode": "output"} for name, pin in (("a", 10), ("b", 11), ("c", 12))}


@pytest.mark.parametrize("confirm", [True, False])
def test_a_board_that_did_not_begin_anew_is_asked_for_its_version_once_and_gets_its_outputs_by_the_port(
    confirm: bool,
) -> None:
    at = Bench(profile(OUTPUTS, confirm=confirm), OldBoard())
    at.greet()
    done = Reply("sucesso") if confirm else SENT
    assert at.call("a", "on") == at.call("b", "on") == at.call("a", "off") == done
    assert [at.board.states[pin] for pin in (10, 11, 12)] == [0, 1, 0]
    greetings = at.greetings
    assert at.call("firmware") == Reply(None, ("StandardFirmata.ino", "2.5"))
    assert at.greetings == greetings, "its answer was taken for a new beginning"
    assert [each.subject for each in at.sent].count("ask/version") == 1


def test_an_old_board_that_begins_anew_after_it_was_asked_is_greeted_again() -> None:
    at = Bench(profile(OUTPUTS), OldBoard())
    at.greet()
    at.call("a", "on")
    assert not at.robot.learn(frame("f90203"))
    assert at.robot.learn(frame("f0790203f7"))
    assert at.robot.sending(at.robot.request("b", [1])).payload.hex() == "910800f06d0bf7"


@pytest.mark.parametrize("confirm", [True, False])
def test_an_output_that_was_not_switched_after_all_is_not_switched_with_another(confirm: bool) -> None:
    at = Bench(profile(OUTPUTS, confirm=confirm), OldBoard())
    at.greet()
    at.call("c", "on")
    at.robot.request("a", ["on"])  # denied, or too late before its turn came
    dropped = at.robot.sending(at.robot.request("b", ["on"]))
    at.robot.unsent(Frame(NOBODY, NOBODY, dropped.subject, dropped.payload, "firmata"))
    at.call("c", "off")
    at.call("c", "on")
    assert [at.board.states[pin] for pin in (10, 11, 12)] == [0, 0, 1]


def test_pins_that_are_set_up_again_are_off_and_are_not_switched_on_with_another() -> None:
    at = Bench(profile(OUTPUTS), OldBoard())
    at.greet()
    at.call("a", "on")
    at.greet()
    assert at.board.states[10] == 0
    at.call("b", "on")
    assert [at.board.states[pin] for pin in (10, 11, 12)] == [0, 1, 0]


def test_answers_about_other_pins_are_not_taken() -> None:
    robot = profile()
    robot.learn(frame("f06a" + "7f" * 14 + "000102030405f7"))
    asked = {command: robot.request(command, []) for command in ("luz", "botao", "firmware")}
    led = robot.request("led", [1])
    for request in (*asked.values(), led):
        for wire in ("f06e0c0101f7", "e20100", "910100", "f90205", "f0716f00f7"):
            assert robot.read(request, frame(wire)) is None
    assert [robot.answers_to(each) for each in (*asked.values(), led)] == [
        "analog/0",
        "digital/0",
        "firmware",
        "pin-state/13",
    ]
    assert robot.answers_to(robot.request("text", ["oi"])) == ""


def test_the_commands_tell_their_range_and_unit() -> None:
    told = {each.name: each for each in bench().robot.commands()}
    garra, motor, luz = told["garra"], told["motor"], told["luz"]
    assert (garra.ints, garra.floats, garra.minimum, garra.maximum, garra.unit) == (1, 0, 10, 170, "deg")
    assert (motor.ints, motor.floats, motor.minimum, motor.maximum, motor.unit) == (0, 1, 0, 100, "%")
    assert (luz.ints, luz.floats, luz.unit, luz.description) == (0, 0, "lx", "what A0 (analog) reads")
    assert garra.description == "pin 9 (servo): 10–170 deg"
    assert {*told} == {*PINS, "digital", "analog", "mode", "state", "text", "reset", "firmware"}
    assert {*told} - {*PINS} <= RESERVED


@pytest.mark.parametrize(
    ("wire", "expected"),
    [
        ("f90205", {"kind": "event", "command": "version", "parameters": [2, 5]}),
        ("f0790205530074006400f7", {"kind": "event", "command": "firmware", "parameters": ["Std", "2.5"]}),
        ("f0716f006900f7", {"kind": "event", "command": "string", "parameters": ["oi"]}),
        ("e36400", {"kind": "event", "command": "A3", "parameters": [], "value": 100, "unit": None,
            "readings": {"A3": 100}}),
        ("920300", {"kind": "event", "command": "digital/2", "parameters": [3]}),
        ("f06e09045af7", {"kind": "response", "command": "pin-state/9", "parameters": ["servo", 90],
            "readings": {"garra": 90}}),
        ("f06e63f7", {"kind": "response", "command": "pin-state/99", "parameters": []}),
        ("f06a7ff7", {"kind": "response", "command": "mapping", "parameters": []}),
        ("f0770102f7", {"kind": "event", "command": "sysex/77", "parameters": ["0102"]}),
    ],
)  # fmt: skip
def test_what_a_board_says_is_told_in_words(wire: str, expected: dict[str, Any]) -> None:
    assert profile().describe(frame(wire)) == expected


def test_what_is_said_to_a_board_is_a_command() -> None:
    (heard,) = Firmata(Firmata.Options(role="board")).decode(bytes.fromhex("e95a00"), 0.0)
    assert isinstance(heard, Frame)
    assert profile().describe(heard) == {"kind": "command", "command": "write-analog/9", "parameters": [90]}


@pytest.mark.parametrize(
    ("pins", "text"),
    [
        ({"reset": {"pin": 3, "mode": "output"}}, "a pin cannot be called reset"),
        ({"A0": {"pin": 3, "mode": "output"}}, "a pin cannot be called A0"),
        ({"a": {"pin": 3, "mode": "output"}, "b": {"pin": 3, "mode": "pwm"}}, "pin 3 has two names"),
        ({"a": {"pin": 128, "mode": "output"}}, "less than or equal to 127"),
        ({"a": {"pin": "A16", "mode": "analog"}}, "should match pattern"),
        ({"a": {"pin": 3, "mode": "output", "unit": "V"}}, "scale, offset and unit have no meaning for output"),
        ({"a": {"pin": "A0", "mode": "analog", "minimum": 3}}, "minimum and maximum have no meaning for analog"),
        ({"a": {"pin": 3, "mode": "pwm", "pulses_us": [1, 2]}}, "pulses_us is for servos"),
        ({"a": {"pin": 3, "mode": "servo", "pulses_us": [2400, 544]}}, "pulses_us is the shortest, then the longest"),
        ({"a": {"pin": 3, "mode": "servo", "scale": 0}}, "scale cannot be 0"),
        ({"a": {"pin": 3, "mode": "servo", "minimum": 5, "maximum": 5}}, "minimum must be less than maximum"),
        ({"a b": {"pin": 3, "mode": "output"}}, "should match pattern"),
    ],
)
def test_pins_that_make_no_sense_are_refused_when_they_are_read(pins: dict[str, Any], text: str) -> None:
    with pytest.raises(ValidationError, match=text):
        FirmataOptions.model_validate({"pins": pins})


def test_a_servo_may_have_its_own_pulses_and_its_own_angles() -> None:
    pins = {"leme": {"pin": 10, "mode": "servo", "offset": -90, "pulses_us": [600, 2300]}}
    at = bench(pins)
    assert at.board.pulses == {10: (600, 2300)}
    assert refusal(at.robot, "leme", 91) == ("refused", "leme takes -90 to 90 deg, got 91")
    assert at.call("leme", -45) == Reply("sucesso")
    assert at.board.states[10] == 45
    (event,) = [each for each in at.frames if each.subject == "pin-state/10"]
    assert at.robot.describe(event)["readings"] == {"leme": -45}


def test_limits_that_the_wire_cannot_carry_are_refused_with_a_remedy() -> None:
    robot = profile({"x": {"pin": 3, "mode": "pwm", "minimum": 0, "maximum": 300}})
    code, text = refusal(robot, "x", 256)
    assert (code, text) == (
        "refused",
        "x would need 256 on the wire, which is 0–255: mend scale, offset or limits",
    )


def test_so_is_a_scale_by_which_a_value_is_beyond_all_numbers() -> None:
    robot = profile({"x": {"pin": 3, "mode": "pwm", "minimum": 0, "maximum": 1e308, "scale": 1e-300}})
    code, text = refusal(robot, "x", 1e300)
    assert (code, text) == ("refused", "x would need inf on the wire, which is 0–255: mend scale, offset or limits")


@given(mode=st.sampled_from(["pwm", "servo"]), percent=st.booleans(), value=st.floats(-500, 500))
def test_any_value_is_refused_or_confirmed(mode: str, percent: bool, value: float) -> None:
    pins = {"x": {"pin": 3, "mode": mode, **({"unit": "%"} if percent else {})}}
    at = bench(pins)
    try:
        assert at.call("x", value) == Reply("sucesso")
    except CallError as error:
        assert error.code == "refused"
        low, high = (0, 100) if percent else (0, 255) if mode == "pwm" else (0, 180)
        assert not low <= value <= high or (not percent and value != int(value))


values = st.one_of(
    st.integers(-300, 20_000), st.floats(), st.text(max_size=5), st.sampled_from(["on", "A0", "D13", "pwm"])
)
commands = st.sampled_from([*PINS, "digital", "analog", "mode", "state", "text", "reset", "firmware", "x"])


@given(command=commands, parameters=st.lists(values, max_size=3), greeted=st.booleans())
def test_a_call_is_refused_or_can_be_sent(command: str, parameters: Sequence[Value], greeted: bool) -> None:
    robot = GREETED if greeted else profile()
    try:
        request = robot.request(command, parameters)
    except CallError as error:
        assert error.code in ("refused", "unknown_command")
        return
    assert Firmata().encode(Frame(NOBODY, NOBODY, request.subject, request.payload, "firmata")) == request.payload
    (first, *_) = Firmata(Firmata.Options(role="board")).decode(request.payload, 0.0)
    assert isinstance(first, Frame)
    assert first.subject == request.subject
    assert request.silence is not None or robot.answers_to(request)


GREETED = bench().robot


@given(st.lists(st.binary(max_size=30).map(lambda data: bytes(byte & 0x7F for byte in data)), max_size=6), st.data())
def test_whatever_a_board_says_nothing_is_raised(said: list[bytes], data: st.DataObject) -> None:
    robot = profile()
    for contents in said:
        command = data.draw(st.sampled_from([0x6A, 0x6C, 0x6E, 0x71, 0x79, 0x77]))
        for heard in Firmata().decode(b"\xf0%c%b\xf7\xe0\x01\x02" % (command, contents), 0.0):
            assert isinstance(heard, Frame)
            if robot.learn(heard):
                assert robot.greeting()
            assert robot.describe(heard)["kind"] in ("event", "response", "command")
            for command_word in ("luz", "botao", "led"):
                try:
                    request = robot.request(command_word, [1] if command_word == "led" else [])
                except CallError:
                    continue
                robot.read(request, heard)
    assert robot.greeting()
    assert robot.commands()


def test_an_order_is_told_with_its_parameters_though_a_question_follows_it() -> None:
    robot = profile({"farol": {"pin": 13, "mode": "output"}})
    request = robot.request("farol", ["on"])
    sent = Frame(NOBODY, NOBODY, request.subject, request.payload, "firmata")
    assert robot.describe(sent)["parameters"] == [1]

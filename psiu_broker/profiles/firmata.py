"""Boards that speak Firmata as robots: pins by name, in their own units.

An order is followed by a question for the pin's state, so that it has an answer. What an input reads is asked by
turning its report on, upon which a board reports at once (Firmata 2.4); a pin's state would not tell it.
"""

import difflib
import math
import re
from collections import deque
from collections.abc import Iterable, Mapping, Sequence, Set
from typing import Annotated, Any, Final, Self

from pydantic import Field, model_validator

from psiu_broker.codecs import firmata
from psiu_broker.codecs.firmata_messages import (
    ASK_CAPABILITIES_MESSAGE,
    ASK_FIRMWARE_MESSAGE,
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
    mode_name,
    read,
    text_bytes,
)
from psiu_broker.errors import CallError, EncodeError
from psiu_broker.frame import Frame
from psiu_broker.messages import Command, Value
from psiu_broker.profiles.firmata_pin import Pin, switch
from psiu_broker.profiles.profile import SENT, Description, Profile, Reply, Request, RobotOptions
from psiu_broker.profiles.psiu import COUNT, NAME, SHOW, SHOW_PRINTED, typed

__all__ = ["RESERVED", "FirmataOptions", "FirmataProfile", "Pin"]


RESERVED: Final = frozenset({
    "digital", "analog", "mode", "state", "text", "reset", "firmware", NAME, COUNT, SHOW, SHOW_PRINTED,
})  # fmt: skip
"""What no pin can be called: commands that every board has, and those that the broker answers for it."""

AT_ONCE_S: Final = 0.05
"""How long is waited for the answer to what has none."""
TEXT_BYTES: Final = 30
"""What StandardFirmata has room for in a string."""

_SINGLE_PINS_SINCE: Final = (2, 5)
_SWITCHED_KEPT: Final = 64
_MOST_PINS: Final = 128
_LIKE_A_PIN: Final = re.compile(r"[AD][0-9]+")


PinName = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_-]*$")]


class FirmataOptions(RobotOptions):
    """What ``[robots.NAME]`` may hold for a board that speaks Firmata."""

    pins: dict[PinName, Pin] = Field({}, description="names for its pins, each with what it is for")
    sampling_ms: int = Field(100, ge=1, le=16383, description="how often analog inputs are reported")
    confirm: bool = Field(
        True, description="ask for a pin's state after each order, and so know that it was done; false: only send"
    )

    @model_validator(mode="after")
    def _names_are_free(self) -> "FirmataOptions":
        for name in self.pins:
            if name in RESERVED or _LIKE_A_PIN.fullmatch(name):
                raise ValueError(f"a pin cannot be called {name}: that word has a meaning of its own")
        numbers = [pin.pin for pin in self.pins.values()]
        twice = next((number for number in numbers if numbers.count(number) > 1), None)
        if twice is not None:
            raise ValueError(f"pin {twice} has two names")
        return self


class FirmataProfile(Profile):
    """A board. What its pins can do it tells itself; until then nothing is refused for that reason."""

    protocol = firmata.PROTOCOL
    harmless = "firmware"
    Options = FirmataOptions

    def __init__(self, options: FirmataOptions | None = None, timeout_s: float = 2.0) -> None:
        self._options = options or FirmataOptions()
        self._pins = self._options.pins
        self._timeout_s = timeout_s
        self._version: tuple[int, int] | None = None
        self._capabilities: Sequence[Mapping[int, int]] = ()
        self._channels: Sequence[int | None] = ()
        self._on: set[int] = set()
        """The outputs that were switched on, for boards that know no single pins."""
        self._switched: deque[tuple[bytes, Set[int], Set[int]]] = deque(maxlen=_SWITCHED_KEPT)
        """What such a board was sent, the outputs that this changed, and those that were on before."""
        self._just_told_version = False
        self._version_asked = False
        self._rest: Sequence[Request] | None = None
        """What the next greeting is limited to."""

    @classmethod
    def make(cls, codec: Any, robot: FirmataOptions, timeout_s: float, *, datagrams: bool = False) -> Self:
        return cls(robot, timeout_s)

    def commands(self) -> Sequence[Command]:
        return (*(self._command(name, pin) for name, pin in self._pins.items()), *_RAW)

    def request(self, command: str, parameters: Sequence[Value]) -> Request:
        pin = self._pins.get(command)
        if pin is not None:
            return self._ask(command, pin, parameters) if pin.is_input else self._tell(command, pin, parameters)
        values = [typed(value) if isinstance(value, str) else value for value in parameters]
        match command, *values:
            case ("digital", place, value) if switch(value) in (0, 1):
                return self._write(self._place(place, "output"), int(switch(value) == 1), digital=True)
            case ("analog", place, int(value)) if 0 <= value < 1 << 14:
                return self._write(self._place(place, "pwm", "servo"), value)
            case ("mode", place, str(mode)) if mode in MODES:
                number = self._place(place, mode)
                return self._order(number, PinMode(number, MODES[mode]))
            case ("state", place):
                return self._request([AskPinState(self._place(place))], question=True)
            case ("text", _, *_):
                return self._text(parameters)
            case ("reset",):
                setting = (RESET_MESSAGE, Sampling(self._options.sampling_ms), *self._setting(self._pins))
                return self._request([*setting, ASK_FIRMWARE_MESSAGE])
            case ("firmware",):
                return self._request([ASK_FIRMWARE_MESSAGE], question=True)
        if command not in _TAKES:
            raise CallError("unknown_command", self._unknown(command))
        raise CallError("refused", f"{command} takes {_TAKES[command]}, got {_shown(parameters)}")

    def read(self, request: Request, frame: Frame) -> Reply | None:
        if frame.subject != self.answers_to(request):
            return None
        asked = _messages(request)
        match asked[0], read(frame.payload):
            case first, PinState() as state:
                return _confirmed(None if len(asked) == 1 else first, state)
            case _, AnalogMessage(channel, raw):
                pin = self._pins.get(self._channel_name(channel))
                return None if pin is None else Reply(None, (self._value(pin, raw),), pin.shown_unit)
            case AskPinState(number), DigitalMessage(_, mask):
                return Reply(None, (mask >> number % 8 & 1,))
            case first, Firmware(major, minor, name):
                return Reply("sucesso") if first == RESET_MESSAGE else Reply(None, (name, f"{major}.{minor}"))
            case _, Capabilities() | AnalogMapping():
                return Reply("sucesso")
        return None

    def sending(self, request: Request) -> Request:
        """A board before Firmata 2.5 knows no single pins: it is told the whole port, as it is by then."""
        if self._version is None or self._version >= _SINGLE_PINS_SINCE:
            return request
        before = frozenset(self._on)
        payload = b"".join(map(self._for_old_board, firmata.messages(request.payload, "host")))
        self._switched.append((payload, before ^ self._on, before))
        return request._replace(subject=firmata.message(payload).subject, payload=payload)

    def unsent(self, frame: Frame) -> None:
        for each in self._switched:
            payload, changed, before = each
            if payload is frame.payload:
                self._on = (self._on - changed) | (before & changed)
                self._switched.remove(each)
                return

    def answers_to(self, request: Request) -> str:
        """The subject of the answer; nothing where there is none."""
        match _messages(request)[-1]:
            case AskPinState(pin):
                return f"pin-state/{pin}"
            case ReportAnalog(channel):
                return f"analog/{channel}"
            case ReportDigital(port):
                return f"digital/{port}"
            case last:
                return _ANSWERS.get(last.wire, "")

    def greeting(self) -> Sequence[Request]:
        """Who it is and what its pins can do; what the named ones are to be; which to report."""
        if self._rest is not None:
            rest, self._rest = self._rest, None
            return rest
        questions = (ASK_FIRMWARE_MESSAGE, ASK_CAPABILITIES_MESSAGE, ASK_MAPPING_MESSAGE)
        setting = [Sampling(self._options.sampling_ms), *self._setting(self._pins)]
        return (*(self._request([each], question=True) for each in questions), self._request(setting, silence=SENT))

    def learn(self, frame: Frame) -> bool:
        after_version, self._just_told_version = self._just_told_version, False
        match read(frame.payload):
            case Version(major, minor):
                self._version = (major, minor)
                self._just_told_version, self._version_asked = not self._version_asked, False
            case Firmware() if after_version:
                # Nobody asks for both at once: it has begun anew.
                self._on.clear()
                self._rest = None
                return True
            case PinState(number, mode, state) if mode == MODES["output"]:
                self._note(number, on=state == 1)
            case Capabilities(pins):
                self._capabilities = pins[:_MOST_PINS]
            case AnalogMapping(channels):
                return self._learn_mapping(channels[:_MOST_PINS])
        return False

    def describe(self, frame: Frame) -> Description:
        if frame.subject.startswith(_TOLD):
            return {"kind": "command", "command": frame.subject, "parameters": _parameters(_first(frame.payload))}
        message = read(frame.payload)
        told: Description = {"kind": "event", "command": frame.subject, "parameters": _parameters(message)}
        match message:
            case AnalogMessage(channel, raw):
                name = self._channel_name(channel)
                pin = self._pins.get(name)
                value = raw if pin is None else self._value(pin, raw)
                told |= {"command": name, "parameters": [], "value": value, "readings": {name: value}}
                told["unit"] = None if pin is None else pin.shown_unit
            case DigitalMessage(port, mask):
                inputs = {name: number for name, number in self._inputs() if number // 8 == port}
                if inputs:
                    told["parameters"] = []
                    told["readings"] = {name: mask >> number % 8 & 1 for name, number in inputs.items()}
            case PinState(number, mode, raw) if mode is not None:
                told["kind"] = "response"
                for name, pin in self._pins.items():
                    if not pin.is_input and mode == MODES[pin.mode] and self._number_of(pin.pin) == number:
                        told["readings"] = {name: self._value(pin, raw)}
            case PinState() | Capabilities() | AnalogMapping():
                told["kind"] = "response"
        return told

    def _command(self, name: str, pin: Pin) -> Command:
        bits = self._resolution(pin)
        where = pin.pin if isinstance(pin.pin, str) else f"pin {pin.pin}"
        if pin.is_input:
            return Command(name=name, unit=pin.shown_unit, description=f"what {where} ({pin.mode}) reads")
        low, high = pin.limits(bits)
        return Command(
            name=name, ints=int(pin.whole), floats=int(not pin.whole), unit=pin.shown_unit,
            minimum=math.ceil(low), maximum=math.floor(high), description=f"{where} ({pin.mode}): {pin.takes(bits)}",
        )  # fmt: skip

    def _tell(self, name: str, pin: Pin, parameters: Sequence[Value]) -> Request:
        if len(parameters) != 1:
            takes = pin.takes(self._resolution(pin))
            raise CallError("refused", f"{name} takes one value, {takes}, got {_shown(parameters)}")
        number = self._place(pin.pin, pin.mode)
        try:
            raw = pin.raw(parameters[0], self._resolution(pin))
        except ValueError as error:
            raise CallError("refused", f"{name} {error}") from None
        return self._write(number, raw, digital=pin.mode == "output")

    def _ask(self, name: str, pin: Pin, parameters: Sequence[Value]) -> Request:
        """What makes the board report this input at once."""
        if parameters:
            raise CallError("refused", f"{name} is an input and takes no parameters, got {_shown(parameters)}")
        if pin.mode == "analog":
            channel = self._channel_of(pin.pin)
            if channel is None:
                raise CallError("refused", f"the board tells no analog channel of pin {pin.pin}; write A0 to A15")
            self._check(self._number_of(pin.pin), pin.mode)
            return self._request([ReportAnalog(channel, True)], question=True)
        number = self._place(pin.pin, pin.mode)
        # The first question only tells this pin from others of the port.
        return self._request([AskPinState(number), ReportDigital(number // 8, True)], question=True)

    def _write(self, number: int, raw: int, *, digital: bool = False) -> Request:
        if not digital:
            return self._order(number, AnalogMessage(number, raw))
        return self._order(number, PinValue(number, raw == 1))

    def _order(self, number: int, order: Message) -> Request:
        if self._options.confirm:
            return self._request([order, AskPinState(number)])
        return self._request([order], silence=SENT)

    def _text(self, parameters: Sequence[Value]) -> Request:
        text = " ".join(map(str, parameters))
        size = len(text_bytes(text)) // 2
        if not 1 <= size <= TEXT_BYTES:
            raise CallError("refused", f"text takes 1–{TEXT_BYTES} bytes, got {size}: a board has room for no more")
        return self._request([Text(text)], silence=SENT)

    def _request(self, what: Iterable[Message], *, question: bool = False, silence: Reply | None = None) -> Request:
        payload = b"".join(each.wire for each in what)
        timeout_s = self._timeout_s if silence is None else min(AT_ONCE_S, self._timeout_s)
        return Request(firmata.message(payload).subject, payload, question, timeout_s, silence)

    def _setting(self, names: Iterable[str]) -> Sequence[Message]:
        """What makes these pins what they are for, as far as the board can, and the inputs reported."""
        setting: list[Message] = []
        reports: dict[Message, None] = {}
        for name in names:
            pin = self._pins[name]
            number = self._number_of(pin.pin)
            if number is not None and self._can(number, pin.mode):
                if pin.pulses_us is not None:
                    setting.append(ServoConfig(number, *pin.pulses_us))
                setting.append(PinMode(number, MODES[pin.mode]))
                if pin.mode in ("input", "pullup"):
                    reports[ReportDigital(number // 8, True)] = None
            if pin.mode == "analog" and (channel := self._channel_of(pin.pin)) is not None:
                reports[ReportAnalog(channel, True)] = None
        return (*setting, *reports)

    def _learn_mapping(self, channels: Sequence[int | None]) -> bool:
        """Take the channels of the pins; whether that tells where pins are that could not be set before."""
        before = {name: self._found(pin) for name, pin in self._pins.items()}
        self._channels = channels
        news = [name for name, pin in self._pins.items() if self._found(pin) != before[name]]
        setting = self._setting(news)
        rest = [self._request(setting, silence=SENT)] if setting else []
        if self._version is None:
            # It did not begin anew when the link opened. Asked any sooner, it would seem to in its answers.
            self._version_asked = True
            rest.append(self._request([ASK_VERSION_MESSAGE], question=True))
        self._rest = rest or None
        return bool(rest)

    def _for_old_board(self, wire: bytes) -> bytes:
        """What is sent in the place of a message to a board that knows no single pins."""
        match read(wire):
            case PinValue(number, on):
                self._note(number, on=on)
                port = number // 8
                return DigitalMessage(port, sum(1 << each % 8 for each in self._on if each // 8 == port)).wire
            case PinMode(number, _):
                self._note(number, on=False)
            case message if message == RESET_MESSAGE:
                self._on.clear()
        return wire

    def _note(self, number: int, *, on: bool) -> None:
        (self._on.add if on else self._on.discard)(number)

    def _found(self, pin: Pin) -> tuple[int | None, int | None]:
        return self._number_of(pin.pin), self._channel_of(pin.pin) if pin.mode == "analog" else None

    def _number_of(self, place: int | str) -> int | None:
        """The number of the pin ``A0``; None while the board has not told it."""
        if isinstance(place, int):
            return place
        channel = int(place[1:])
        return self._channels.index(channel) if channel in self._channels else None

    def _channel_of(self, place: int | str) -> int | None:
        if isinstance(place, str):
            return int(place[1:])
        channel = self._channels[place] if place < len(self._channels) else None
        return channel if channel is None or channel < 16 else None

    def _channel_name(self, channel: int) -> str:
        """The name of what the board calls analog channel `channel`."""
        for name, pin in self._pins.items():
            if pin.mode == "analog" and self._channel_of(pin.pin) == channel:
                return name
        return f"A{channel}"

    def _inputs(self) -> Iterable[tuple[str, int]]:
        for name, pin in self._pins.items():
            number = self._number_of(pin.pin)
            if pin.mode in ("input", "pullup") and number is not None:
                yield name, number

    def _value(self, pin: Pin, raw: int) -> int | float:
        return pin.value(raw, self._resolution(pin))

    def _resolution(self, pin: Pin) -> int | None:
        """In bits, as far as the board has told it and it makes sense."""
        number = self._number_of(pin.pin)
        if number is None or number >= len(self._capabilities):
            return None
        bits = self._capabilities[number].get(MODES[pin.mode], 0)
        return bits if 1 <= bits <= 32 else None

    def _place(self, place: Value, *modes: str) -> int:
        """The number of a pin, told by number, name, ``A0`` or ``D13``.

        Raises:
            CallError: refused, since there is no such pin or it can be none of `modes`.
        """
        named = self._pins.get(place) if isinstance(place, str) else None
        where = place if named is None else named.pin
        if isinstance(where, str) and _LIKE_A_PIN.fullmatch(where):
            number = int(where[1:]) if where[0] == "D" else self._number_of(where)
            if number is None:
                raise CallError("refused", f"the board tells no pin {where}" + ("" if self._channels else " (yet)"))
            where = number
        if not isinstance(where, int) or not 0 <= where <= 127:
            raise CallError("refused", f"there is no pin {place}: it is a number, A0, D13 or one of its names")
        self._check(where, *modes)
        return where

    def _check(self, number: int | None, *modes: str) -> None:
        """Raises: CallError refused, naming what the pin can do."""
        if number is None or not self._capabilities:
            return
        if number >= len(self._capabilities):
            raise CallError("refused", f"the board has pins 0–{len(self._capabilities) - 1}, not {number}")
        if modes and not any(self._can(number, mode) for mode in modes):
            able = ", ".join(map(mode_name, self._capabilities[number])) or "nothing"
            raise CallError("refused", f"pin {number} cannot be {' or '.join(modes)}; it can be: {able}")

    def _can(self, number: int, mode: str) -> bool:
        if not self._capabilities:
            return True
        return number < len(self._capabilities) and MODES[mode] in self._capabilities[number]

    def _unknown(self, command: str) -> str:
        names = [each.name for each in self.commands()]
        close = difflib.get_close_matches(command, names, 1)
        return f"no command {command}: {f'did you mean {close[0]}? ' if close else ''}It has {', '.join(names)}"


_TAKES: Final = {
    "digital": "a pin, and 1 or 0 (on or off)",
    "analog": "a pin and a number 0–16383",
    "mode": f"a pin and one of {', '.join(MODES)}",
    "state": "a pin",
    "text": "words",
    "reset": "no parameters",
    "firmware": "no parameters",
}
_RAW: Final = (
    Command(name="digital", ints=2, description="set an output, told by number, A0, D13 or name, to 1 or 0"),
    Command(name="analog", ints=2, description="set a PWM or servo pin to a number as it is on the wire"),
    Command(name="mode", ints=1, chars=1, description=f"make a pin one of {', '.join(MODES)}"),
    Command(name="state", ints=1, description="a pin's mode and what was last written to it"),
    Command(name="text", chars=1, description="a string for the sketch"),
    Command(name="reset", description="forget everything, then make the named pins what they are for"),
    Command(name="firmware", description="the sketch's name and version"),
)
_ANSWERS: Final = {
    ASK_FIRMWARE_MESSAGE.wire: "firmware",
    ASK_CAPABILITIES_MESSAGE.wire: "capabilities",
    ASK_MAPPING_MESSAGE.wire: "mapping",
}
_TOLD: Final = ("write-", "report-", "pin-mode/", "ask/", "servo/", "sampling", "reset")
"""How the subjects of what is said to a board begin."""


def _messages(request: Request) -> Sequence[Message]:
    try:
        wires = firmata.messages(request.payload, "host")
    except EncodeError:
        return (Sysex(0),)
    return [read(wire) or Sysex(0) for wire in wires]


def _confirmed(order: Message | None, state: PinState) -> Reply:
    """What a pin's state says of the `order` before it, or by itself."""
    if state.mode is None:
        return Reply("falha", remark=f"the board has no pin {state.pin}")
    told = f"{mode_name(state.mode)} with {state.state}"
    match order:
        case PinMode(_, mode):
            done, wanted = state.mode == mode, mode_name(mode)
        case PinValue(_, on):
            done, wanted = (state.mode, state.state) == (MODES["output"], on), f"output with {on:d}"
        case AnalogMessage(_, value):
            done = state.mode in (MODES["pwm"], MODES["servo"]) and state.state == value
            wanted = f"pwm or servo with {value}"
        case _:
            return Reply(None, (mode_name(state.mode), state.state))
    return Reply("sucesso") if done else Reply("falha", remark=f"pin {state.pin} is {told}, not {wanted}")


def _parameters(message: Message | None) -> list[Value]:  # noqa: PLR0911 - one for each message
    match message:
        case AnalogMessage(_, value) | DigitalMessage(_, value):
            return [value]
        case PinState(_, int(mode), state):
            return [mode_name(mode), state]
        case PinMode(_, mode):
            return [mode_name(mode)]
        case PinValue(_, on) | ReportAnalog(_, on) | ReportDigital(_, on):
            return [int(on)]
        case Version(major, minor):
            return [major, minor]
        case Firmware(major, minor, name):
            return [name, f"{major}.{minor}"]
        case Text(text):
            return [text]
        case AskPinState(number) | Identity(number) | Sampling(number):
            return [number]
        case ServoConfig(_, shortest, longest):
            return [shortest, longest]
        case Sysex(_, data):
            return [data.hex()]
    return []


def _shown(parameters: Sequence[Value]) -> str:
    return " ".join(str(value) for value in parameters) or "nothing"


def _first(payload: bytes) -> Message | None:
    """The first of the messages that a program says in one go, which a question about its outcome may follow."""
    try:
        return read(firmata.messages(payload, "host")[0])
    except EncodeError:
        return None

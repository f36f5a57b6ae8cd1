"""The pins of a board that the broker plays, and what each of them means to the robot behind it."""

import math
import re
from collections.abc import Mapping
from typing import Final, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, StrictFloat, StrictInt, StrictStr, model_validator

from psiu_broker.codecs.firmata_messages import MODES
from psiu_broker.messages import Value
from psiu_broker.profiles.persona import PersonaOptions

ADC_GREATEST: Final = 1023
PWM_GREATEST: Final = 255
SERVO_GREATEST_DEG: Final = 180
SHORTEST_PULSE_US: Final = 544
"""What is written to a servo is degrees below, and the length of a pulse from here on (Arduino's Servo library)."""

DIGITAL_LEAST: Final = 14
"""Pins before A0, even if none of them means anything: as on most Arduinos, A0 is pin 14."""

_DIGITAL: Final = re.compile(r"0|[1-9][0-9]{0,2}")
_ANALOG: Final = re.compile(r"A(0|[1-9][0-9]?)")
_LAST_DIGITAL: Final = 111
_LAST_CHANNEL: Final = 15
_BITS: Final = {"pwm": 8, "servo": 14, "analog": 10}

_OUTPUT: Final = frozenset({"command", "mode", "on", "off"})
_SCALED: Final = frozenset({"command", "mode", "before", "scale", "offset", "decimals", "minimum", "maximum"})
_READING: Final = frozenset({"reading", "ask", "before", "poll_s"})
_ANALOG_READING: Final = _READING | {"scale", "offset"}
_DIGITAL_READING: Final = _READING | {"on", "above"}

Word = StrictInt | StrictFloat | StrictStr


class PlayedPin(BaseModel):
    """What one pin does to the robot (`command`) or reads of it (`reading`)."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    command: str | None = Field(None, min_length=1, description="what the robot is told when the pin is written")
    mode: Literal["output", "pwm", "servo"] = Field(
        "output", description="what programs use the pin as: on or off, a level 0–255, or degrees 0–180"
    )
    on: tuple[Word, ...] | None = Field(
        None, description="output: the parameters for on, 1 unless told; input: the readings that are high"
    )
    off: tuple[Word, ...] | None = Field(None, description="output: the parameters for off, 0 unless told")
    before: tuple[Word, ...] = Field((), description="parameters before the value, or those of a question")
    scale: float = Field(
        1,
        allow_inf_nan=False,
        description="the robot's value is the pin's times this; a reading times this is the pin's",
    )
    offset: float = Field(0, allow_inf_nan=False, description="what is added after `scale`")
    decimals: int = Field(0, ge=0, le=6, description="digits behind the point of the robot's value; 0: whole numbers")
    minimum: float | None = Field(
        None, allow_inf_nan=False, description="a smaller value is refused, in the robot's unit"
    )
    maximum: float | None = Field(
        None, allow_inf_nan=False, description="a greater value is refused, in the robot's unit"
    )
    reading: str | None = Field(None, min_length=1, description="what the pin reads, by the name that the robot tells")
    ask: str | None = Field(None, min_length=1, description="the question for it, if it is not named as the reading")
    poll_s: float | None = Field(
        None, ge=0.02, le=3600, description="ask for it so often while a program wants it; else it waits to be told"
    )
    above: float = Field(0, description="input: a greater reading is high")

    @model_validator(mode="after")
    def _is_one_thing(self) -> Self:
        if (self.command is None) == (self.reading is None):
            raise ValueError("give either a command, for an output, or a reading, for an input")
        if self.scale == 0:
            raise ValueError("a scale of 0 makes every value the same")
        if self.ask is not None and self.poll_s is None:
            raise ValueError("ask needs poll_s: how often")
        if self.minimum is not None and self.maximum is not None and self.minimum > self.maximum:
            raise ValueError("minimum is above maximum")
        if self.command is not None and self.mode == "pwm":
            try:
                self.scaled(0)
            except ValueError as error:
                raise ValueError(
                    f"a program switches a pwm pin off by 0, but {error}; widen minimum to maximum"
                ) from None
        return self

    @property
    def question(self) -> tuple[str, tuple[Value, ...]] | None:
        """The command that asks for what it reads, and its parameters; None where nobody asks."""
        if self.reading is None or self.poll_s is None:
            return None
        return self.ask or self.reading, self.before

    def switched(self, on: bool) -> tuple[Value, ...]:
        """The robot's parameters for on and off, of an output."""
        if on:
            return (1,) if self.on is None else self.on
        return (0,) if self.off is None else self.off

    def scaled(self, value: float) -> tuple[Value, ...]:
        """The robot's parameters for a level or an angle.

        Raises:
            ValueError: it is out of range; the text says of which.
        """
        number = round(value * self.scale + self.offset, self.decimals)
        low = -math.inf if self.minimum is None else self.minimum
        high = math.inf if self.maximum is None else self.maximum
        if not (math.isfinite(number) and low <= number <= high):
            raise ValueError(f"{self.command} takes {_span(low, high)}, got {number:g}")
        return (*self.before, int(number) if self.decimals == 0 else number)

    def level(self, reading: Value) -> int | None:
        """What an analog channel shows of `reading`, as far as it goes: 0–1023; None where it is no number."""
        if isinstance(reading, str) or not math.isfinite(reading):
            return None
        return round(min(max(reading * self.scale + self.offset, 0), ADC_GREATEST))

    def high(self, reading: Value) -> int | None:
        """What a digital input shows of `reading`, 0 or 1; None where it is neither."""
        if self.on is not None:
            return int(reading in self.on)
        return None if isinstance(reading, str) else int(reading > self.above)


def _span(low: float, high: float) -> str:
    if (low, high) == (-math.inf, math.inf):
        return "any number"
    if low == -math.inf:
        return f"at most {high:g}"
    if high == math.inf:
        return f"at least {low:g}"
    return f"{low:g} to {high:g}" if low < 0 else f"{low:g}–{high:g}"


class FirmataMap(PersonaOptions):
    """The pins by number, 0–111, or A0–A15, and the board's own settings; other pins mean nothing."""

    model_config = ConfigDict(extra="allow", frozen=True)
    __pydantic_extra__: dict[str, PlayedPin]

    id: int = Field(1, ge=0, le=127, description="what FirmataExpress programs are told that they look for")

    @property
    def pins(self) -> Mapping[str, PlayedPin]:
        """By name."""
        return self.__pydantic_extra__ or {}

    @model_validator(mode="after")
    def _fit_their_pins(self) -> Self:
        for name, pin in self.pins.items():
            analog = _ANALOG.fullmatch(name)
            known = (
                int(analog[1]) <= _LAST_CHANNEL if analog else _DIGITAL.fullmatch(name) and int(name) <= _LAST_DIGITAL
            )
            if not known:
                raise ValueError(f"{name} is no pin: expected 0–{_LAST_DIGITAL} or A0–A{_LAST_CHANNEL}")
            if analog and pin.command is not None:
                raise ValueError(f"{name} is an input, and can have a reading but no command")
            surplus = sorted(pin.model_fields_set - _meant(pin, analog=analog is not None))
            if surplus:
                raise ValueError(f"{name}: {', '.join(surplus)} has no meaning for such a pin")
        return self


def _meant(pin: PlayedPin, *, analog: bool) -> frozenset[str]:
    if pin.command is not None:
        return _OUTPUT if pin.mode == "output" else _SCALED
    return _ANALOG_READING if analog else _DIGITAL_READING


class Layout:
    """The board: digital pins first, then the analog ones, each by the number that Firmata gives it."""

    def __init__(self, options: FirmataMap) -> None:
        digital = {int(name): pin for name, pin in options.pins.items() if not name.startswith("A")}
        analog = {int(name[1:]): pin for name, pin in options.pins.items() if name.startswith("A")}
        self.digital = max(DIGITAL_LEAST, *(number + 1 for number in digital), 0)
        self.channels = max((channel + 1 for channel in analog), default=0)
        self.pins: Mapping[int, PlayedPin] = {
            **digital, **{self.digital + channel: pin for channel, pin in analog.items()}
        }  # fmt: skip
        self.names: Mapping[int, str] = {
            **{number: str(number) for number in range(self.digital)},
            **{self.digital + channel: f"A{channel}" for channel in range(self.channels)},
        }

    def channel(self, number: int) -> int | None:
        """The analog channel of a pin, if it has one."""
        channel = number - self.digital
        return channel if 0 <= channel < self.channels else None

    def modes(self, number: int) -> Mapping[int, int]:
        """What a pin can be used as, with the resolution in bits; nothing for pins without a meaning.

        Every pin with one can be an input and an output, told in this order, as on an Arduino: pyFirmata2 counts
        only such pins. Channels before the last have theirs even if nothing is read there, lest it count wrongly.
        """
        if self.channel(number) is not None:
            return {MODES["analog"]: _BITS["analog"]}
        pin = self.pins.get(number)
        if pin is None:
            return {}
        modes = {MODES["input"]: 1, MODES["output"]: 1}
        if pin.reading is not None:
            return {**modes, MODES["pullup"]: 1}
        return modes if pin.mode == "output" else {**modes, MODES[pin.mode]: _BITS[pin.mode]}

    def first_mode(self, number: int) -> int:
        """What a pin is until a program says otherwise."""
        if self.channel(number) is not None:
            return MODES["analog"]
        pin = self.pins.get(number)
        return MODES["input"] if pin is not None and pin.reading is not None else MODES["output"]

"""A pin of a board: what it is for, and what the numbers on the wire mean in its unit."""

import math
from typing import Annotated, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from psiu_broker.messages import Value
from psiu_broker.profiles.psiu import typed

PinModeName = Literal["output", "input", "pullup", "pwm", "servo", "analog"]

CHANNEL: Final = "A([0-9]|1[0-5])"
_INPUTS: Final = frozenset({"input", "pullup", "analog"})
_SCALED: Final = frozenset({"pwm", "servo", "analog"})
_SWITCH: Final = {"on": 1, "off": 0}
_BITS: Final = {"pwm": 8, "servo": 14, "analog": 10}
_GREATEST_DEG: Final = 180


class Pin(BaseModel):
    """One pin of a board, what it is for and in which unit it is told."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    pin: Annotated[int, Field(ge=0, le=127)] | Annotated[str, Field(pattern=f"^{CHANNEL}$")] = Field(
        description="its number, or A0 to A15 for an analog channel"
    )
    mode: PinModeName = Field(description="what it is; pullup is an input that reads 1 with nothing connected")
    minimum: float | None = Field(
        None, allow_inf_nan=False, description="pwm, servo: the least value to allow, in the pin's unit"
    )
    maximum: float | None = Field(
        None,
        allow_inf_nan=False,
        description="pwm, servo: the greatest value to allow; a servo goes to 180 unless told",
    )
    scale: float | None = Field(
        None, description="pwm, servo, analog: value = scale * (what is on the wire) + offset; 1 unless told"
    )
    offset: float = Field(0.0, description="see scale")
    unit: str | None = Field(
        None, description="the unit to show; % without a scale makes 0–100 of the whole range; servo is in deg"
    )
    pulses_us: tuple[int, int] | None = Field(
        None, description="servo: its shortest and longest pulse, in microseconds; 544 and 2400 unless told"
    )

    @model_validator(mode="after")
    def _fits_its_mode(self) -> "Pin":
        if self.mode not in _SCALED and (self.scale is not None or self.offset or self.unit is not None):
            raise ValueError(f"scale, offset and unit have no meaning for {self.mode}: it is 0 or 1")
        if self.mode not in ("pwm", "servo") and not (self.minimum is None and self.maximum is None):
            raise ValueError(f"minimum and maximum have no meaning for {self.mode}")
        if self.pulses_us is not None:
            shortest, longest = self.pulses_us
            if self.mode != "servo":
                raise ValueError("pulses_us is for servos")
            if not 0 < shortest < longest < 1 << 14:
                raise ValueError("pulses_us is the shortest, then the longest, at most 16383")
        if self.scale == 0 or not all(map(math.isfinite, (self.scale or 1, self.offset))):
            raise ValueError("scale cannot be 0, and scale and offset are finite")
        if self.minimum is not None and self.maximum is not None and self.minimum >= self.maximum:
            raise ValueError("minimum must be less than maximum")
        return self

    @property
    def is_input(self) -> bool:
        return self.mode in _INPUTS

    @property
    def shown_unit(self) -> str | None:
        return self.unit or ("deg" if self.mode == "servo" else None)

    @property
    def whole(self) -> bool:
        """Whether its values are what is on the wire."""
        return self.scale is None and not self.offset and not self._percent

    @property
    def _percent(self) -> bool:
        return self.unit == "%" and self.scale is None

    def value(self, raw: int, bits: int | None) -> int | float:
        """What `raw` means in its unit; `bits` is the resolution that the board tells."""
        if self.mode not in _SCALED:
            return int(raw != 0)
        if self.whole:
            return raw
        scale = 100 / self._top(bits) if self._percent else 1 if self.scale is None else self.scale
        return round(scale * raw + self.offset, 4)

    def limits(self, bits: int | None) -> tuple[float, float]:
        """The least and the greatest value that a caller may give."""
        if self.mode == "output":
            return 0, 1
        greatest = _GREATEST_DEG if self.mode == "servo" and not self._percent else self._top(bits)
        low, high = sorted((self.value(0, bits), self.value(greatest, bits)))
        return (low if self.minimum is None else self.minimum), (high if self.maximum is None else self.maximum)

    def raw(self, value: Value, bits: int | None) -> int:
        """What is on the wire for `value`.

        Raises:
            ValueError: out of range or of the wrong kind; the text says what the pin takes.
        """
        number = switch(value) if self.mode == "output" else typed(value) if isinstance(value, str) else value
        low, high = self.limits(bits)
        fits = not isinstance(number, str) and low <= number <= high
        if isinstance(number, str) or not fits or (self.whole and number != int(number)):
            raise ValueError(f"takes {self.takes(bits)}, got {value}")
        if self.mode == "output":
            return int(number)
        scale = 100 / self._top(bits) if self._percent else 1 if self.scale is None else self.scale
        exact = (number - self.offset) / scale
        if not math.isfinite(exact) or not 0 <= round(exact) <= self._top(bits):
            raise ValueError(
                f"would need {exact:.0f} on the wire, which is 0–{self._top(bits)}: mend scale, offset or limits"
            )
        return round(exact)

    def takes(self, bits: int | None) -> str:
        """Its range for a person: ``0–180 deg``, ``on or off``."""
        if self.mode == "output":
            return "on or off"
        low, high = self.limits(bits)
        span = f"{low:g} to {high:g}" if low < 0 else f"{low:g}–{high:g}"
        return f"{span} {self.shown_unit}" if self.shown_unit else span

    def _top(self, bits: int | None) -> int:
        """The greatest number on the wire."""
        return (1 << (bits or _BITS[self.mode])) - 1


def switch(value: Value) -> Value:
    """`value` as a number, where it is one or on or off."""
    if not isinstance(value, str):
        return value
    return _SWITCH.get(value.lower(), typed(value))

"""A node of a PSIU HEXA robot: what its signal byte means, by its declared type (PSIU HEXA 1.2.1)."""

from typing import Final, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from psiu_broker.messages import Value
from psiu_broker.profiles.psiu import typed

NodeType = Literal[
    "servo", "dc-open", "dc", "stepper", "linear", "on-off",
    "luminosity", "angle", "distance", "speed", "acceleration", "switch",
]  # fmt: skip
_ACTUATORS: Final = frozenset({"servo", "dc-open", "dc", "stepper", "linear", "on-off"})
_EITHER_SIGN: Final = frozenset(
    {"dc-open", "dc", "stepper", "luminosity", "angle", "distance", "speed", "acceleration"}
)
_UNITS: Final = {"servo": "deg", "stepper": "steps"}
_SWITCH: Final = {"on": 1, "off": 0}


class Node(BaseModel):
    """One actuator or sensor of a PSIU HEXA robot."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    node: int = Field(ge=1, le=255, description="its number; 0 is kept for sensors' answers")
    type: NodeType = Field(description="what it is, and so what its signal means")
    signed: bool = Field(False, description="the signal runs from -127 to 127 instead of 0 to 255")
    unit: str | None = Field(None, description="the unit to show; servo is in deg and stepper in steps unless told")

    @model_validator(mode="after")
    def _sign_has_a_meaning(self) -> "Node":
        if self.signed and self.type not in _EITHER_SIGN:
            raise ValueError(f"signed has no meaning for a node of type {self.type}")
        return self

    @property
    def is_actuator(self) -> bool:
        return self.type in _ACTUATORS

    @property
    def shown_unit(self) -> str | None:
        return self.unit or _UNITS.get(self.type)

    @property
    def limits(self) -> tuple[int, int]:
        """The lowest and highest value that a caller may give."""
        if self.type == "servo":
            return -90, 90
        if self.type in ("on-off", "switch"):
            return 0, 1
        return (-127, 127) if self.signed else (0, 255)

    def signal(self, value: Value) -> int:
        """The byte 0–255 that says `value`.

        Raises:
            ValueError: out of range or of the wrong kind; the text says what the node takes.
        """
        number = _number(value, self.type)
        low, high = self.limits
        if isinstance(number, str) or not low <= number <= high or (self.type != "servo" and number != int(number)):
            raise ValueError(f"takes {self._takes}, got {value}")
        if self.type == "servo":
            return round(number * (127 if number >= 0 else 128) / 90) & 0xFF
        if self.type == "on-off":
            return 255 if number else 0
        return int(number) & 0xFF

    def value(self, signal: int) -> int | float:
        """What the byte `signal` says, in `shown_unit`; servo degrees are rounded to hundredths."""
        if self.type in ("on-off", "switch"):
            return int(signal != 0)
        number = signal - 256 if signal > 127 and (self.signed or self.type == "servo") else signal
        if self.type == "servo":
            return round(number * 90 / (127 if number >= 0 else 128), 2)
        return number

    @property
    def _takes(self) -> str:
        if self.type == "on-off":
            return "on or off"
        low, high = self.limits
        span = f"{low} to {high}" if low < 0 else f"{low}–{high}"
        return f"{span} {self.shown_unit}" if self.shown_unit else span


def _number(value: Value, kind: NodeType) -> Value:
    if not isinstance(value, str):
        return value
    if kind == "on-off":
        return _SWITCH.get(value.lower(), typed(value))
    return typed(value)

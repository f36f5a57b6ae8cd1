"""Boards with Amarino's library: their functions by name, and what they tell.

A board has a function for some flags, and says nothing of which. The configuration names them:

    [robots.LAMPADA.commands]
    brilho = {flag = "b", parameters = ["int"], minimum = 0, maximum = 255}
    temperatura = {flag = "t", answer = true, unit = "C"}

What a board tells unasked may be several values; ``readings = [{name = "x", unit = "g"}, …]`` names them in turn.
"""

import difflib
import math
from collections.abc import Sequence
from typing import Any, ClassVar, Final, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from psiu_broker.codecs import amarino
from psiu_broker.codecs.amarino import ABORT, TEXT, flag_subject, flag_trouble, text_trouble, values, values_text
from psiu_broker.errors import CallError
from psiu_broker.frame import Frame
from psiu_broker.messages import Command, Value
from psiu_broker.profiles.profile import SENT, Description, Profile, Reply, Request, RobotOptions
from psiu_broker.profiles.psiu import COUNT, NAME, SHOW, SHOW_PRINTED, typed
from psiu_broker.routing.outbox import is_stop

__all__ = ["RESERVED", "AmarinoCommand", "AmarinoProfile", "BoardReading"]

SEND: Final = "send"
RESERVED: Final = frozenset({SEND, NAME, COUNT, SHOW, SHOW_PRINTED})
"""What no command of the user's can be called: those that every board has, and those that the broker answers for it."""

OBJECTS_S: Final = 0.3
"""How soon a board that has no such function says so; one that has it need not answer."""

NOT_REGISTERED: Final = "Flag not registered: "
OUT_OF_BOUNDS: Final = "Flag out of bounds: "
"""What the library itself says of a message, before a text that is the flag's number."""
_TROUBLES: Final = {
    NOT_REGISTERED.strip(): "the board has no function for this flag",
    OUT_OF_BOUNDS.strip(): "the board has no function for so high a flag",
}

Kind = Literal["int", "float", "text"]
FLAG_PATTERN: Final = "^[0-z]$"

_SEND: Final = Command(name=SEND, chars=1, description="a flag, 0 to z, and the values that go with it")


class AmarinoCommand(BaseModel):
    """A function of the board."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    flag: str = Field(pattern=FLAG_PATTERN, description="the flag that the board registered it for, 0 to z")
    parameters: tuple[Kind, ...] = Field(
        (), description='what it takes, in this order: "int", "float" (two decimals are sent), "text"'
    )
    minimum: int | None = Field(None, description="the least number that a caller may give")
    maximum: int | None = Field(None, description="the greatest number that a caller may give")
    unit: str | None = Field(None, description="the unit of its numbers, or of its answer if it takes none")
    answer: bool = Field(False, description="the board answers with a text; else it is sent and that is all")
    description: str | None = Field(None, description="what the board then does, for a person")

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.minimum is not None and self.maximum is not None and self.minimum > self.maximum:
            raise ValueError(f"minimum {self.minimum} is above maximum {self.maximum}")
        if not {"int", "float"} & set(self.parameters) and (self.minimum is not None or self.maximum is not None):
            raise ValueError("minimum and maximum mean nothing without a number among the parameters")
        return self

    def command(self, name: str) -> Command:
        """It as callers see it."""
        return Command(
            name=name,
            ints=self.parameters.count("int"),
            floats=self.parameters.count("float"),
            chars=self.parameters.count("text"),
            minimum=self.minimum,
            maximum=self.maximum,
            unit=self.unit,
            description=self.description,
        )

    @property
    def takes(self) -> str:
        """Its parameters for a person: ``int, int (0 to 255 deg)``."""
        if not self.parameters:
            return "no parameters"
        low, high = self.minimum, self.maximum
        span = ""
        if low is not None or high is not None:
            span = f"from {low}" if high is None else f"up to {high}" if low is None else f"{low} to {high}"
        notes = " ".join(filter(None, (span, self.unit)))
        return ", ".join(self.parameters) + (f" ({notes})" if notes else "")

    def text(self, parameters: Sequence[Value]) -> str:
        """What follows the flag.

        Raises:
            ValueError: `parameters` are not what it takes, or cannot be sent.
        """
        fitting = [_fitting(value, kind) for value, kind in zip(parameters, self.parameters, strict=False)]
        if len(parameters) != len(self.parameters) or None in fitting:
            raise ValueError("")
        for value in fitting:
            if isinstance(value, str) or value is None:
                continue
            if (self.minimum is not None and value < self.minimum) or (
                self.maximum is not None and value > self.maximum
            ):
                raise ValueError("")
        return values_text([value for value in fitting if value is not None])


class BoardReading(BaseModel):
    """One of the values that a board tells."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str = Field(min_length=1, description="what it is called")
    unit: str | None = Field(None, description="its unit")


class AmarinoProfile(Profile):
    """A board. A message that it would not live through is refused before anything is sent."""

    protocol: ClassVar[str] = amarino.PROTOCOL

    class Options(RobotOptions):
        """What ``[robots.NAME]`` may hold for a board."""

        commands: dict[str, AmarinoCommand] = Field({}, description="names for its functions")
        readings: tuple[BoardReading, ...] = Field((), description="names for the values of what it tells, in turn")

        @model_validator(mode="after")
        def _names_are_free(self) -> Self:
            for name in self.commands:
                if name in RESERVED:
                    raise ValueError(f"{name} is a command that every robot has; choose another name")
            names = [reading.name for reading in self.readings]
            if len(set(names)) < len(names):
                raise ValueError("two readings have one name")
            return self

    def __init__(self, robot: Options | None = None, timeout_s: float = 2.0) -> None:
        robot = robot or self.Options()
        self._named = robot.commands
        self._readings = robot.readings
        self._timeout_s = timeout_s
        self._by_flag = {each.flag: name for name, each in reversed(robot.commands.items())}

    @classmethod
    def make(cls, codec: Any, robot: Any, timeout_s: float, *, datagrams: bool = False) -> Self:
        return cls(robot, timeout_s)

    def commands(self) -> Sequence[Command]:
        return (*(each.command(name) for name, each in self._named.items()), _SEND)

    def request(self, command: str, parameters: Sequence[Value]) -> Request:
        named = self._named.get(command)
        if named is not None:
            try:
                message = named.flag + named.text(parameters)
            except (ValueError, OverflowError) as error:
                why = (
                    str(error) if isinstance(error, ValueError) else ""
                ) or f"it takes {named.takes}, got {_shown(parameters)}"
                raise CallError("refused", f"{command}: {why}") from None
        elif command == SEND:
            message = _raw(parameters)
        else:
            raise CallError("unknown_command", self._unknown(command))
        payload = message.encode("utf-8", "surrogatepass")
        trouble = flag_trouble(payload) or text_trouble(payload)
        if trouble is not None:
            raise CallError("refused", f"{command}: {trouble}")
        # The word by which a stop overtakes what waits, whatever its flag.
        subject = command if is_stop(command) else flag_subject(payload[0])
        if named is not None and named.answer:
            return Request(subject, payload, False, self._timeout_s)
        return Request(subject, payload, False, min(OBJECTS_S, self._timeout_s), SENT)

    def read(self, request: Request, frame: Frame) -> Reply | None:
        if frame.subject != TEXT:
            return None
        trouble = _TROUBLES.get(_words(frame))
        if trouble is not None:
            return Reply("falha", (), remark=trouble)
        if request.silence is not None:
            return None
        named = self._named.get(self._by_flag.get(chr(request.payload[0]), ""))
        unit = named.unit if named is not None and not named.parameters else None
        return Reply(None, values(frame.payload), unit)

    def greeting(self) -> Sequence[Request]:
        """Half a message from before would go before the next, or its first byte be taken for a flag."""
        return (Request(ABORT, b"", False, min(OBJECTS_S, self._timeout_s), SENT),)

    def answers_to(self, request: Request) -> str:
        """All alike: a text does not say what it answers."""
        return ""

    def describe(self, frame: Frame) -> Description:
        if frame.subject == ABORT:
            return {"kind": "command", "command": ABORT}
        if frame.subject != TEXT:
            told = values(frame.payload[1:])
            flag = frame.payload[:1].decode("latin-1")
            return {"kind": "command", "command": self._by_flag.get(flag, frame.subject), "parameters": list(told)}
        told = values(frame.payload)
        trouble = _TROUBLES.get(_words(frame))
        if trouble is not None:
            return {"kind": "error", "command": None, "parameters": list(told), "remark": trouble}
        description = Description(kind="event", command=None, parameters=list(told))
        if self._readings and len(told) == len(self._readings):
            description["readings"] = {each.name: value for each, value in zip(self._readings, told, strict=True)}
            units = {each.unit for each in self._readings}
            description["unit"] = units.pop() if len(units) == 1 else None
        if len(told) == 1 and not isinstance(told[0], str):
            description["value"] = told[0]
        return description

    def _unknown(self, command: str) -> str:
        names = [*self._named, SEND]
        close = difflib.get_close_matches(command, names, 1)
        return f"no command {command}: {f'did you mean {close[0]}? ' if close else ''}It has {', '.join(names)}"


def _raw(parameters: Sequence[Value]) -> str:
    try:
        flag, *rest = parameters
        text = values_text(rest)
    except ValueError as error:
        trouble = str(error) if parameters else f"{SEND} takes a flag and its values, got nothing"
        raise CallError("refused", trouble) from None
    if not "0" <= str(flag) <= "z" or len(str(flag)) != 1:
        raise CallError("refused", f"{SEND} takes a flag, one character from 0 to z, got {flag}")
    return f"{flag}{text}"


def _fitting(value: Value, kind: Kind) -> Value | None:
    """`value` as a parameter of this kind; None where it is none."""
    if kind == "text":
        return value if isinstance(value, str) else str(value)
    number = typed(value) if isinstance(value, str) else value
    if isinstance(number, str) or not math.isfinite(number):
        return None
    if kind == "float":
        return float(number)
    return int(number) if number == int(number) else None


def _words(frame: Frame) -> str:
    return frame.payload.decode("utf-8", "replace").strip()


def _shown(parameters: Sequence[Value]) -> str:
    return " ".join(str(value) for value in parameters) or "nothing"

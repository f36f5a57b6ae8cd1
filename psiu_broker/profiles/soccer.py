"""Robots of a soccer team: the speeds of their wheels, their raw bytes, and a stop. They never answer."""

import difflib
from collections.abc import Sequence
from typing import Any, ClassVar, Final, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from psiu_broker.codecs.paced import Rest
from psiu_broker.codecs.soccer import BYTES, LIMITS, STOP, WHEELS, Soccer, byte_of, hold_trouble, value_of
from psiu_broker.errors import CallError
from psiu_broker.frame import Frame
from psiu_broker.messages import Command, Value
from psiu_broker.profiles.profile import SENT, Description, Profile, Reading, Request, RobotOptions
from psiu_broker.profiles.psiu import COUNT, NAME, SHOW, SHOW_PRINTED, typed
from psiu_broker.routing.outbox import is_stop

__all__ = ["RESERVED", "SetPoint", "SoccerProfile", "robot_trouble"]

RESERVED: Final = frozenset({WHEELS, BYTES, STOP, NAME, COUNT, SHOW, SHOW_PRINTED})
"""What no set-point of the user's can be called: commands that every robot has, and those that the broker answers."""

SLACK_S: Final = 0.02


class SetPoint(BaseModel):
    """A set-point with a name of its own, in values or in bytes."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    rodas: tuple[int, ...] | None = Field(None, description="the value of each byte, as the command rodas takes them")
    bytes: str | None = Field(None, description="the bytes themselves, such as 0x3e3e")
    description: str | None = Field(None, description="what the robot then does, for a person")

    @model_validator(mode="after")
    def _is_one(self) -> Self:
        if (self.rodas is None) == (self.bytes is None):
            raise ValueError('expected either rodas or bytes; write rodas = [15, 15] or bytes = "0x3e3e"')
        return self


class SoccerProfile(Profile):
    """One robot of a team. Each set-point holds for a while only: `rest` is what comes then."""

    protocol: ClassVar[str] = "soccer"

    class Options(RobotOptions):
        """What ``[robots.NAME]`` may hold for a robot of a soccer team."""

        hold_s: float | None = Field(
            None, gt=0, le=3600, allow_inf_nan=False,
            description="how long it goes on with what it was told last; left out: as its link says",
        )  # fmt: skip
        stop: str | None = Field(None, description="the bytes that stop it, such as 0x0303; left out: every value 0")
        commands: dict[str, SetPoint] = Field({}, description="names for set-points, as frente = {rodas = [15, 15]}")

    def __init__(self, codec: Soccer.Options | None = None, robot: Options | None = None) -> None:
        """Make the robot.

        Raises:
            ValueError: `robot` does not fit the packets of `codec`.
        """
        codec, robot = codec or Soccer.Options(), robot or SoccerProfile.Options()
        trouble = robot_trouble(codec, robot)
        if trouble is not None:
            raise ValueError(trouble)
        self._codec = codec
        self._timeout_s = 2 / codec.rate_hz + SLACK_S
        """A set-point leaves with the next packet, or with the one after it where the line has no room."""
        stop = codec.stop if robot.stop is None else _of_text(robot.stop, codec)
        self.rest = Rest(stop, robot.hold_s or codec.hold_s)
        self._named = {name: _share(set_point, codec) for name, set_point in robot.commands.items()}
        low, high = LIMITS[codec.byte_codec]
        self._commands = (
            Command(
                name=WHEELS, ints=codec.bytes_per_robot, minimum=low, maximum=high,
                description="speeds of the left and the right wheel"
                if codec.subject == WHEELS
                else "the value of each byte of its share",
            ),
            Command(name=BYTES, chars=1, description=f"its share as it is: 0x and {codec.bytes_per_robot} bytes"),
            Command(name=STOP, description="stop"),
            *(Command(name=name, description=each.description) for name, each in robot.commands.items()),
        )  # fmt: skip

    @classmethod
    def make(cls, codec: Any, robot: Any, timeout_s: float, *, datagrams: bool = False) -> Self:
        return cls(codec, robot)

    def commands(self) -> Sequence[Command]:
        return self._commands

    def request(self, command: str, parameters: Sequence[Value]) -> Request:
        subject = self._codec.subject
        try:
            if command == WHEELS:
                payload = _of_values([_typed(value) for value in parameters], self._codec)
            elif command == BYTES:
                payload = _of_text("".join(map(_hexadecimal, parameters)), self._codec)
            else:
                payload = self._stop_or_named(command, parameters)
                # The word by which a stop overtakes what waits, whatever its bytes.
                subject = STOP if is_stop(command) else subject
        except ValueError as error:
            raise CallError("refused", f"{command} {error}") from None
        return Request(subject, payload, False, self._timeout_s, SENT)

    def read(self, request: Request, frame: Frame) -> Reading | None:
        """Nothing: what is heard of such a robot was said to it."""
        return None

    def answers_to(self, request: Request) -> str:
        return ""

    def describe(self, frame: Frame) -> Description:
        if frame.subject == STOP:
            return {"kind": "command", "command": STOP}
        values = [value_of(byte, self._codec.byte_codec) for byte in frame.payload]
        if frame.subject != WHEELS or None in values:
            return {"kind": "command", "command": BYTES, "parameters": [f"0x{frame.payload.hex()}"]}
        return {"kind": "command", "command": WHEELS, "parameters": [value for value in values if value is not None]}

    def _stop_or_named(self, command: str, parameters: Sequence[Value]) -> bytes:
        if command != STOP and command not in self._named:
            names = [each.name for each in self._commands]
            close = difflib.get_close_matches(command, names, 1)
            meant = f"did you mean {close[0]}? " if close else ""
            raise CallError("unknown_command", f"no command {command}: {meant}It has {', '.join(names)}")
        if parameters:
            raise ValueError(f"takes no parameters, got {_shown(parameters)}")
        return self.rest.stop if command == STOP else self._named[command]


def robot_trouble(codec: Soccer.Options, robot: SoccerProfile.Options) -> str | None:
    """What in `robot` does not fit the packets of its link, with the option that says it; None where all does."""
    if robot.hold_s is not None and (trouble := hold_trouble(robot.hold_s, codec.rate_hz)) is not None:
        return trouble
    if robot.stop is not None:
        try:
            _of_text(robot.stop, codec)
        except ValueError as error:
            return f"stop {error}"
    for name, set_point in robot.commands.items():
        if name in RESERVED or not name.isascii() or not name.isprintable() or " " in name or not name:
            taken = ", ".join(sorted(RESERVED))
            return f"commands.{name}: expected one word, none of {taken}; call it something else"
        try:
            _share(set_point, codec)
        except ValueError as error:
            return f"commands.{name} {error}"
    return None


def _share(set_point: SetPoint, codec: Soccer.Options) -> bytes:
    """Raises: ValueError, a text that begins with what the share takes."""
    if set_point.rodas is not None:
        return _of_values(set_point.rodas, codec)
    return _of_text(set_point.bytes or "", codec)


def _of_values(values: Sequence[Value], codec: Soccer.Options) -> bytes:
    """Raises: ValueError, a text that begins with what the share takes."""
    limits = LIMITS[codec.byte_codec]
    share = [
        byte_of(value, codec.byte_codec)
        for value in values
        if isinstance(value, int) and limits.low <= value <= limits.high
    ]
    if len(share) != len(values) or len(share) != codec.bytes_per_robot:
        count = codec.bytes_per_robot
        each = "a whole number" if count == 1 else f"{count} whole numbers"
        which = ", left and right wheel" if codec.subject == WHEELS else ""
        raise ValueError(f"takes {each}, {limits}{which}, got {_shown(values)}")
    return bytes(share)


def _of_text(text: str, codec: Soccer.Options) -> bytes:
    """Raises: ValueError, a text that begins with what the share takes."""
    digits = text[2:] if text[:2] in ("0x", "0X") else ""
    try:
        share = bytes.fromhex(digits)
    except ValueError:
        share = b""
    if len(share) != codec.bytes_per_robot or 2 * len(share) != len(digits):
        count = codec.bytes_per_robot
        size = "1 byte" if count == 1 else f"{count} bytes"
        raise ValueError(f"takes {size} in hexadecimal such as 0x{codec.stop.hex()}, got {text or 'nothing'}")
    for byte in share:
        if value_of(byte, codec.byte_codec) is None:
            raise ValueError(f"takes bytes whose check bits are right, got 0x{byte:02x}; rodas makes them")
    return share


def _typed(value: Value) -> Value:
    value = typed(value) if isinstance(value, str) else value
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _hexadecimal(value: Value) -> str:
    return value if isinstance(value, str) else str(value)


def _shown(values: Sequence[Value]) -> str:
    return " ".join(str(value) for value in values) or "nothing"

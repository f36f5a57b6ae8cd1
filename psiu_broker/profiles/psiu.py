"""PSIU ASCII robots: the document's commands, an open vocabulary, and answers told by their command word."""

import math
import re
from collections.abc import Mapping, Sequence
from decimal import Decimal
from types import MappingProxyType
from typing import Any, Final, NamedTuple, Self

from pydantic import BaseModel, ConfigDict, Field

from psiu_broker.errors import CallError
from psiu_broker.frame import EVERYONE, Frame
from psiu_broker.messages import Command, Value
from psiu_broker.profiles.profile import Profile, Reading, Reply, Request, RobotOptions, Status

NAME: Final = "qualseunome"
COUNT: Final = "quantoscomandos"
SHOW: Final = "exibecomando"
SHOW_PRINTED: Final = "exibecomandos"
"""The document prints both; robots know the singular."""

QUESTIONS: Final = (
    Command(name=NAME),
    Command(name=COUNT),
    Command(name=SHOW, ints=1, minimum=1),
)
MOTIONS: Final = (
    Command(name="parafrente", ints=1, minimum=0, maximum=999, unit="cm"),
    Command(name="paratras", ints=1, minimum=0, maximum=999, unit="cm"),
    Command(name="giradireita", ints=1, minimum=0, maximum=360, unit="deg"),
    Command(name="giraesquerda", ints=1, minimum=0, maximum=360, unit="deg"),
)
_QUESTIONS: Final[Mapping[str, Command]] = {command.name: command for command in QUESTIONS}
_MOTIONS: Final[Mapping[str, Command]] = {command.name: command for command in MOTIONS}
_STATUS: Final[Mapping[str, Status]] = {
    "sucesso": "sucesso", "ok": "sucesso", "respok": "sucesso",
    "falha": "falha", "respfalha": "falha",
}  # fmt: skip
_WHOLE: Final = re.compile(r"[+-]?[0-9]{1,18}")
_POINTED: Final = re.compile(r"[+-]?(?:[0-9]{1,18}\.[0-9]{0,18}|\.[0-9]{1,18})")
_WORD: Final = re.compile(r"[!-~]+")
LEARNED_KEPT: Final = 128
"""A robot that lists commands without end teaches us no more than these."""
_PARAMETERS_KEPT: Final = 64
_LONGEST_MOTION: Final = 999


def typed(word: str) -> Value:
    """`word` as the int or float it spells, else as it is."""
    if _WHOLE.fullmatch(word):
        return int(word)
    if _POINTED.fullmatch(word):
        return float(word)
    return word


def text(value: Value) -> str:
    """`value` as one PSIU word: floats with a point and without an exponent (PSIU ASCII, Parâmetro).

    Raises:
        ValueError: it holds a space or a character outside printable ASCII, is empty, or is no finite number.
    """
    if isinstance(value, str):
        if not _WORD.fullmatch(value):
            raise ValueError(f"{value!r} is not one word of printable ASCII")
        return value
    if isinstance(value, float):
        if not math.isfinite(value):
            raise ValueError(f"{value} is not a number that a robot can read")
        return format(Decimal(repr(value)), "f")
    return str(int(value))


class Said(NamedTuple):
    """A message in words: ``parafrente sucesso`` has a status and no values, ``quantoscomandos 6`` one value."""

    command: str
    status: Status | None
    values: tuple[Value, ...]
    answer: bool
    """False for what is a command or a question."""


def said(frame: Frame) -> Said:
    """Read the words of a PSIU ASCII frame; never raises."""
    words = frame.payload.decode("ascii", "replace").split()
    command = words[0] if words else frame.subject
    status = _STATUS.get(words[1].lower()) if len(words) > 1 else None
    values = tuple(typed(word) for word in words[2 if status else 1 :])
    return Said(command, status, values, status is not None or _tells(command, values, frame))


def _tells(command: str, values: tuple[Value, ...], frame: Frame) -> bool:
    word = canonical(command)
    if word == NAME:
        return frame.destination != EVERYONE
    if word == COUNT:
        return bool(values) and isinstance(values[0], int)
    if word == SHOW:
        return bool(values) and isinstance(values[0], str)
    return False


def canonical(command: str) -> str:
    """The command word by which questions and answers are told apart: any case, exibecomandos as exibecomando."""
    word = command.lower()
    return SHOW if word == SHOW_PRINTED else word


def listed(values: Sequence[Value]) -> Command | None:
    """The command that the values of an exibecomando answer describe; None for anything else (row 11: garbage)."""
    match values:
        case [str(name), int(ints), int(floats), int(chars)] if min(ints, floats, chars) >= 0:
            if ints + floats + chars > _PARAMETERS_KEPT:
                return None
            return Command(name=name, ints=ints, floats=floats, chars=chars)
        case _:
            return None


class DeclaredCommand(BaseModel):
    """A command that the configuration knows of: exibecomando tells neither ranges nor units."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    ints: int = Field(0, ge=0, le=_PARAMETERS_KEPT, description="how many whole numbers it takes")
    floats: int = Field(0, ge=0, le=_PARAMETERS_KEPT, description="how many numbers with a point it takes")
    chars: int = Field(0, ge=0, le=_PARAMETERS_KEPT, description="how many words it takes")
    minimum: int | None = Field(None, description="the least that a number may be")
    maximum: int | None = Field(None, description="the most that a number may be")
    unit: str | None = Field(None, description="the unit of its numbers")
    description: str | None = Field(None, description="what it does")


class PsiuOptions(RobotOptions):
    """What ``[robots.NAME]`` may hold for a PSIU ASCII robot."""

    commands: dict[str, DeclaredCommand] = Field({}, description="what it can be told, with ranges and units")


class PsiuProfile(Profile):
    """A PSIU ASCII robot. Words that neither the document, the configuration nor the robot has told of are sent on.

    What the configuration says of a command goes before what the robot says of it.
    """

    protocol = "psiu-ascii"
    harmless = COUNT  # a question for the name looks like an answer to one
    Options = PsiuOptions

    def __init__(
        self,
        timeout_s: float = 2.0,
        per_unit_s: float = 0.012,
        declared: Mapping[str, DeclaredCommand] = MappingProxyType({}),
    ) -> None:
        self._timeout_s = timeout_s
        self._per_unit_s = per_unit_s
        self._declared = {name: Command(name=name, **each.model_dump()) for name, each in declared.items()}
        self._learned: dict[str, Command] = dict(self._declared)

    @classmethod
    def make(cls, codec: Any, robot: PsiuOptions, timeout_s: float, *, datagrams: bool = False) -> Self:
        return cls(timeout_s, declared=robot.commands)

    def learn_command(self, command: Command) -> None:
        """Take what the robot itself said of one command; the document's range stays where the robot's count fits."""
        if command.name in _QUESTIONS or command.name in self._declared:
            return
        if command.name not in self._learned and len(self._learned) >= LEARNED_KEPT:
            return
        motion = _MOTIONS.get(command.name)
        if motion is not None and (command.ints + command.floats, command.chars) == (1, 0):
            known = {"minimum": motion.minimum, "maximum": motion.maximum, "unit": motion.unit}
            command = command.model_copy(update=known)
        self._learned[command.name] = command

    def commands(self) -> Sequence[Command]:
        """The document's questions, then what the robot listed, or the document's motions until it has."""
        return (*QUESTIONS, *(self._learned.values() or MOTIONS))

    def request(self, command: str, parameters: Sequence[Value]) -> Request:
        word = SHOW if command == SHOW_PRINTED else command
        try:
            words = [text(word), *(text(value) for value in parameters)]
        except ValueError as error:
            raise CallError("refused", f"{command!r} cannot be sent: {error}") from None
        values = [typed(each) for each in words[1:]]
        known = _QUESTIONS.get(word) or self._learned.get(word) or _MOTIONS.get(word)
        if known is not None:
            _check(known, values)
        first = next((value for value in values if not isinstance(value, str)), 0)
        timeout_s = self._timeout_s + self._per_unit_s * min(abs(first), _LONGEST_MOTION)
        return Request(word, " ".join(words).encode("ascii"), word in _QUESTIONS, timeout_s)

    def read(self, request: Request, frame: Frame) -> Reading | None:
        words = said(frame)
        asked = canonical(request.subject)
        if canonical(words.command) != asked:
            return None
        if words.status is not None:
            return Reply(words.status, words.values)
        if asked == NAME:
            return Reply(None, (str(frame.source),))
        # These words with a number and no status are the robot commanding us, not answering.
        if (asked in _QUESTIONS and not words.answer) or asked in _MOTIONS:
            return None
        return Reply(None, words.values)

    def answers_to(self, request: Request) -> str:
        return canonical(request.subject)

    def moves(self, frame: Frame) -> bool:
        words = said(frame)
        return not words.answer and canonical(words.command) not in _QUESTIONS and super().moves(frame)


def _check(command: Command, values: Sequence[Value]) -> None:
    """Raises: CallError refused, naming what `command` takes. exibecomando tells counts, not their order."""
    strings = sum(isinstance(value, str) for value in values)
    pointed = sum(isinstance(value, float) for value in values)
    fits = (
        len(values) == command.ints + command.floats + command.chars
        and strings <= command.chars
        and strings + pointed <= command.chars + command.floats
    )
    if fits and command.minimum is not None:
        fits = all(value >= command.minimum for value in values if not isinstance(value, str))
    if fits and command.maximum is not None:
        fits = all(value <= command.maximum for value in values if not isinstance(value, str))
    if not fits:
        got = " ".join(text(value) for value in values) or "nothing"
        raise CallError("refused", f"{command.name} takes {takes(command)}, got {got}")


def takes(command: Command) -> str:
    """The parameters of `command` for a person: ``0–999 cm``, ``2 ints and 1 float``, ``no parameters``."""
    if command.minimum is not None:
        unit = f" {command.unit}" if command.unit else ""
        if command.maximum is None:
            return f"a number from {command.minimum}{unit}"
        return f"{command.minimum}–{command.maximum}{unit}"
    counts = [(command.ints, "int"), (command.floats, "float"), (command.chars, "char")]
    parts = [f"{count} {name}{'s' if count > 1 else ''}" for count, name in counts if count]
    return " and ".join(parts) or "no parameters"

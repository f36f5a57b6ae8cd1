"""What every persona is: the broker playing a robot to a program that speaks another protocol than the robot. Pure.

The link of the program says whom it plays, as ``plays = "MNERIM"``; `Persona.Options` is what its ``map`` may hold.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

from pydantic import BaseModel, ConfigDict

from psiu_broker.frame import Frame
from psiu_broker.messages import Answer, Value
from psiu_broker.profiles.profile import Description


class Say(NamedTuple):
    """Something for the program, as a frame's subject and payload."""

    subject: str
    payload: bytes


class Call(NamedTuple):
    """Something for the robot that is played. `asked` is the frame that it is done for, which may want an answer.

    Of those that are `newest`, only the newest of each subject of `asked` counts; without one, of each command.
    """

    command: str
    parameters: tuple[Value, ...] = ()
    newest: bool = False
    asked: Frame | None = None


class PersonaOptions(BaseModel):
    """What ``[links.NAME.map]`` may hold for one protocol."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Persona(ABC):
    """One robot played to one program. `now` is in seconds on any steady clock."""

    Options: ClassVar[type[PersonaOptions]] = PersonaOptions

    @abstractmethod
    def __init__(self, name: str, codec: Any, options: Any) -> None:
        """`name` is that of the robot; `codec` the options of the link's codec; `options` this class's `Options`."""

    @abstractmethod
    def heard(self, frame: Frame, now: float) -> Sequence[Say | Call]:
        """What is to be done about a frame of the program; never raises."""

    def answered(self, call: Call, answer: Answer | None, error: str, now: float) -> Sequence[Say]:
        """What the program hears of the outcome of `call`: its answer, or else what kept it from one."""
        return ()

    def opened(self, now: float) -> Sequence[Say | Call]:
        """The program has come: what it is told, and what is asked on its behalf."""
        return ()

    def told(self, description: Description, now: float) -> Sequence[Say]:
        """The robot said something unasked, or to somebody else: what the program is told of it."""
        return ()

    def waits_until(self) -> float | None:
        """When `due` wants to be called; None: not now."""
        return None

    def due(self, now: float) -> Sequence[Say | Call]:
        """The moment of `waits_until` has come."""
        return ()

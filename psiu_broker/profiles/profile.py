"""What every profile is: a robot's commands, what a call becomes on the wire, and what counts as its answer. Pure."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from enum import Enum
from typing import ClassVar, Literal, NamedTuple

from psiu_broker.frame import Frame
from psiu_broker.messages import Command, Value

Status = Literal["sucesso", "falha"]


class Request(NamedTuple):
    """One call in a protocol's words; with two addresses around them, `subject` and `payload` are a frame.

    `question` is true where asking again does no harm: anything else may have moved the robot,
    and is never repeated on silence alone. `timeout_s` is how long one try waits.
    """

    subject: str
    payload: bytes
    question: bool
    timeout_s: float


class Reply(NamedTuple):
    """A robot's answer: how it went, or what it told, or both."""

    status: Status | None
    values: tuple[Value, ...] = ()
    unit: str | None = None


class Notice(Enum):
    """What a robot may say of a request instead of answering it."""

    AGAIN = "it did not understand: send it again"
    BUSY = "it was not done: ask when the robot is free"
    FREE = "the robot is free again"
    IMPOSSIBLE = "it was understood and cannot be done"


Reading = Reply | Notice


class Profile(ABC):
    """One robot as callers see it."""

    protocol: ClassVar[str]
    poll: Request | None = None
    """What asks a robot that said BUSY whether it is free; None where the protocol has no such question."""

    @abstractmethod
    def commands(self) -> Sequence[Command]:
        """What the robot can be told, in the order in which quantoscomandos counts them."""

    @abstractmethod
    def request(self, command: str, parameters: Sequence[Value]) -> Request:
        """What this call is on the wire.

        Raises:
            CallError: refused, unknown_command or bad_request, before anything is sent.
        """

    @abstractmethod
    def read(self, request: Request, frame: Frame) -> Reading | None:
        """What `frame`, sent to us by the robot, says about `request`; None where it is about something else."""

    @abstractmethod
    def answers_to(self, request: Request) -> str:
        """What tells the answers to `request` from others: requests for which it is the same are mistaken for another.

        PSIU numbers no message, so that a late answer to one such request reads as the answer to the next.
        """

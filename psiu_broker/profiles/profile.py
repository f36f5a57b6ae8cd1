"""What every profile is: a robot's commands, what a call becomes on the wire, and what counts as its answer. Pure."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from enum import Enum
from typing import Any, ClassVar, Final, Literal, NamedTuple, Self, TypedDict

from pydantic import BaseModel, ConfigDict

from psiu_broker.frame import Frame
from psiu_broker.messages import Command, Kind, Value
from psiu_broker.routing.outbox import is_stop

Status = Literal["sucesso", "falha"]


class Reply(NamedTuple):
    """A robot's answer: how it went, or what it told, or both; `remark` is for a person."""

    status: Status | None
    values: tuple[Value, ...] = ()
    unit: str | None = None
    remark: str | None = None


SENT: Final = Reply(None, remark="sent; this robot does not answer")
"""What silence means where the protocol has no answers."""


class Step(NamedTuple):
    """One message of a procedure, `place` being where it stands in what the caller wrote: a line from 1, or 0.

    `pause_s` is how long the robot may take to object before the next one is sent; `name` is for a person.
    """

    subject: str
    payload: bytes
    name: str
    place: int = 0
    pause_s: float = 0.0


class Procedure(NamedTuple):
    """Messages between which a robot must hear nothing else, as when it records a script.

    It answers the last of them; whatever it answers earlier says that it has ended the procedure itself.
    `ending` gets it out from wherever it is, does no harm where it is not in it, is answered, and may be sent
    in one go; `ended` says in what state it then is. Without steps there is only the ending.
    """

    steps: tuple[Step, ...]
    ending: tuple[Step, ...]
    ended: str

    @property
    def takes_s(self) -> float:
        """How long it takes if the robot does not object."""
        return sum(step.pause_s for step in self.steps)


class Request(NamedTuple):
    """One call in a protocol's words; with two addresses around them, `subject` and `payload` are a frame.

    `question` is true where asking again does no harm: anything else may have moved the robot,
    and is never repeated on silence alone. `timeout_s` is how long one try waits. `silence` is what it
    means that nothing comes in that time; None: that there is no answer. With a `procedure` its steps
    are what is sent, and `subject` and `payload` never are.
    """

    subject: str
    payload: bytes
    question: bool
    timeout_s: float
    silence: Reply | None = None
    procedure: Procedure | None = None


class Notice(Enum):
    """What a robot may say of a request instead of answering it."""

    AGAIN = "it did not understand: send it again"
    BUSY = "it was not done: ask when the robot is free"
    FREE = "the robot is free again"
    IMPOSSIBLE = "it was understood and cannot be done"


Reading = Reply | Notice


class Description(TypedDict, total=False):
    """The fields of `messages.Decoded` that a frame alone tells."""

    kind: Kind
    command: str | None
    parameters: list[Value]
    status: Status | None
    node: int | None
    signal: int | None
    value: float | None
    unit: str | None
    fields: list[str] | None
    readings: dict[str, Value]
    remark: str | None


class RobotOptions(BaseModel):
    """What ``[robots.NAME]`` may hold for one protocol, beside link, address and peer."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Profile(ABC):
    """One robot as callers see it."""

    protocol: ClassVar[str]
    Options: ClassVar[type[RobotOptions]] = RobotOptions
    """What the user may write for such a robot in ``[robots.NAME]``."""
    harmless: ClassVar[str | None] = None
    """A command that only asks and that every such robot answers; None where the protocol has none."""
    poll: Request | None = None
    """What asks a robot that said BUSY whether it is free; None where the protocol has no such question."""

    @classmethod
    @abstractmethod
    def make(cls, codec: Any, robot: Any, timeout_s: float, *, datagrams: bool = False) -> Self:
        """The robot that `robot`, this class's `Options`, tells of, on a link whose codec has the options `codec`.

        `timeout_s` is how long it may take to answer; `datagrams` whether its link carries datagrams.
        """

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

    def sending(self, request: Request) -> Request:
        """`request` as it is sent now; it may depend on what was sent before, of which `unsent` has not told.

        Never raises.
        """
        return request

    def unsent(self, frame: Frame) -> None:  # noqa: B027 - most have nothing to take back
        """Take note that `frame`, made of what `sending` told, was dropped; never raises."""

    def moves(self, frame: Frame) -> bool:
        """Whether `frame`, sent to the robot, may set it in motion; never raises. Stops do not."""
        return not is_stop(frame.subject)

    def greeting(self) -> Sequence[Request]:
        """What to tell or ask the robot when its link has opened, in this order."""
        return ()

    def learn(self, frame: Frame) -> bool:
        """Take note of what the robot says, answer or not; never raises.

        True when it has begun anew and wants its `greeting` again.
        """
        return False

    def describe(self, frame: Frame) -> Description:
        """What a frame from or to the robot says; never raises."""
        return {"kind": "command", "command": frame.subject}

"""What every simulated robot is: bytes in, answers with their delays out; no I/O and no clock of its own."""

from abc import ABC, abstractmethod
from typing import ClassVar, NamedTuple

Reply = tuple[float, bytes]
"""How many seconds from now, and what is sent then: always one whole frame."""

HEARD_KEPT = 1000


class Heard(NamedTuple):
    """One frame that a robot took as meant for it.

    `subject` is the command word (``parafrente``) or, in PSIU HEXA, ``ping``, ``ack``, ``node/4``,
    ``command/200``, ``complex``; `source` is empty where the packet names none.
    """

    now: float
    source: str
    subject: str
    parameters: tuple[str, ...] = ()


class Robot(ABC):
    """One simulated robot. `now` is in seconds on any steady clock."""

    protocol: ClassVar[str]
    name: str
    telemetry_s: float | None = None
    """How often it speaks unasked; None: never."""

    def __init__(self) -> None:
        self.heard: list[Heard] = []

    @abstractmethod
    def receive(self, data: bytes, now: float) -> list[Reply]:
        """Take the next bytes of the line; return the answers that they call for, in order. Never raises."""

    @abstractmethod
    def boundary(self) -> None:
        """Forget a frame that has only begun: a datagram ended, or the line went down."""

    @abstractmethod
    def hello(self) -> bytes:
        """A frame by which the other side learns that this robot exists."""

    @abstractmethod
    def telemetry(self) -> bytes:
        """The frame that is sent every `telemetry_s`."""

    def advance(self, now: float) -> None:  # noqa: B027 - most robots do not move
        """Bring what a person sees of the robot to `now`."""

    def note(self, heard: Heard) -> None:
        """Remember the newest `HEARD_KEPT` frames, so that a robot may run for ever."""
        if len(self.heard) >= 2 * HEARD_KEPT:
            del self.heard[:HEARD_KEPT]
        self.heard.append(heard)

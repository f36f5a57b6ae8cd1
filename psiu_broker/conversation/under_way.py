"""A call whose turn it is: what it is to send, how far it has come, and what it has heard."""

import asyncio
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from psiu_broker.conversation.complaints import Sending
from psiu_broker.errors import CallError
from psiu_broker.frame import Address, Frame
from psiu_broker.profiles.profile import Profile, Reading, Reply, Request
from psiu_broker.routing.outbox import is_stop

_HEARD_KEPT: Final = 8


@dataclass(frozen=True, slots=True)
class Robot:
    """A robot as calls reach it: its name, who we are to it, who it is to us, what it understands, and where it is."""

    name: str
    own: Address
    address: Address
    profile: Profile
    build: Callable[[Request], Frame]
    link: str
    peer: object = None


class Offer(NamedTuple):
    """A frame that its link has taken and that may wait there."""

    frame: Frame
    until: float
    """When it is dropped."""
    needed: bool
    """The call is over if it is dropped: it is no poll."""


@dataclass(slots=True, eq=False)
class UnderWay:
    """A call, from when it waits for its turn."""

    robot: Robot
    command: str
    request: Request
    begun: float
    deadline: float
    leave_by: float
    """After this it is too late for it to leave, and for a motion to be sent again."""
    patience_s: float = 0.0
    retries: int = 0
    busy_poll_s: float = 0.0
    repeatable: bool = False
    """It may be sent again on silence, although it moves the robot."""
    urgent: bool = False
    """It is a stop, whatever its word."""
    waiting: list[Offer] = field(default_factory=list)
    sent: int = 0
    """How many frames have left, the last of them, and when it did."""
    frame: Frame | None = None
    sent_at: float = 0.0
    answered: int = 0
    overtaken: bool = False
    """A stop came meanwhile: it is not sent again."""
    sending: Sending | None = None
    """The last frame among the others on its link; None where it had to wait."""
    heard: deque[tuple[Reading | CallError, float]] = field(default_factory=deque)
    woken: asyncio.Event = field(default_factory=asyncio.Event)

    @property
    def is_stop(self) -> bool:
        return self.urgent or is_stop(self.request.subject)

    @property
    def may_repeat(self) -> bool:
        """Whether it may be sent again where nobody knows what became of it."""
        return self.request.question or self.repeatable

    @property
    def again_by(self) -> float:
        """Until when it is not too late for it to be sent again."""
        return self.deadline if self.request.question else min(self.deadline, self.leave_by)

    @property
    def is_motion(self) -> bool:
        """It may move the robot."""
        return not (self.request.question or self.is_stop or self.is_ending)

    @property
    def is_ending(self) -> bool:
        """It only gets the robot out of whatever procedure it is in."""
        return self.request.procedure is not None and not self.request.procedure.steps

    @property
    def has_reply(self) -> bool:
        return any(isinstance(reading, Reply) for reading, _ in self.heard)

    def put_off(self, seconds: float) -> None:
        """Let it leave, and be answered, so much later."""
        self.leave_by += seconds
        self.deadline += seconds

    def taken(self, frame: Frame) -> Offer | None:
        """What `frame`, itself and not one like it, was offered as, which waits no more; None if it did not wait."""
        offer = next((each for each in self.waiting if each.frame is frame), None)
        if offer is not None:
            self.waiting = [each for each in self.waiting if each is not offer]
        return offer

    def delivered(self, frame: Frame, now: float) -> None:
        """Take note that `frame` has left, if it is one of these."""
        if self.taken(frame) is not None:
            self.frame, self.sent_at, self.sent = frame, now, self.sent + 1
            self.woken.set()

    def answer(self, reading: Reading, now: float) -> None:
        """Hear what can only be about a frame of this call."""
        self.answered = min(self.sent, self.answered + 1)
        self.hear(reading, now)

    def hear(self, reading: Reading | CallError, now: float) -> None:
        """Keep it for `next`; when a robot talks faster than that, the first words count."""
        if len(self.heard) < _HEARD_KEPT or isinstance(reading, CallError):
            self.heard.append((reading, now))
            self.woken.set()

    async def next(self, until: float) -> tuple[Reading | None, float]:
        """The next thing heard and when, or None at `until`.

        Raises:
            CallError: the call was ended from outside.
        """
        loop = asyncio.get_running_loop()
        while not self.heard and loop.time() < until:
            await self.rest(until)
        if not self.heard:
            return None, loop.time()
        reading, at = self.heard.popleft()
        if isinstance(reading, CallError):
            raise reading
        return reading, at

    async def rest(self, until: float) -> None:
        """Wait until woken, at most until `until`."""
        self.woken.clear()
        try:
            async with asyncio.timeout_at(until):
                await self.woken.wait()
        except TimeoutError:
            pass

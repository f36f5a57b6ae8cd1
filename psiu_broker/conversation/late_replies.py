"""Replies that robots still owe: to calls that have ended, to tries before the last, and to what was only told.

Of a frame that still waits in an outbox a reply will be owed, and none can be to it yet.

PSIU numbers no message, so that a late reply would read as the answer to the next request like it.
"""

from typing import Final, NamedTuple

from psiu_broker.frame import Address, Frame
from psiu_broker.profiles.profile import Profile, Request

OWED_KEPT: Final = 64
"""By one robot; of more than these the oldest are forgotten."""


class _Owed(NamedTuple):
    frame: Frame
    """What was sent, and when a reply to it is no longer to come."""
    until: float
    profile: Profile
    request: Request
    left: bool


class LateReplies:
    """What each robot owes. Pure: told the time, in seconds of any steady clock."""

    def __init__(self) -> None:
        self._owed: dict[Address, list[_Owed]] = {}

    def __bool__(self) -> bool:
        return bool(self._owed)

    def expect(self, frame: Frame, profile: Profile, request: Request, count: int, now: float, until: float) -> None:
        """`count` replies to `frame`, which has left for `request`, may come up to `until`."""
        self._owe(_Owed(frame, until, profile, request, left=True), count, now)

    def expect_waiting(self, frame: Frame, profile: Profile, request: Request, now: float, leaves_by: float) -> None:
        """`frame` for `request` waits in an outbox: until `delivered` or `undelivered` nobody knows what is owed."""
        self._owe(_Owed(frame, leaves_by + request.timeout_s, profile, request, left=False), 1, now)

    def delivered(self, frame: Frame, now: float) -> None:
        """`frame` has left, if it is one that waited."""
        owed = self._owed.get(frame.destination, [])
        for place, each in enumerate(owed):
            if each.frame is frame and not each.left:
                owed[place] = each._replace(until=now + each.request.timeout_s, left=True)

    def _owe(self, debt: _Owed, count: int, now: float) -> None:
        robot = debt.frame.destination
        if robot not in self._owed:
            for other in list(self._owed):
                self._prune(other, now)
        self._prune(robot, now)
        if count > 0 and debt.until > now:
            owed = self._owed.setdefault(robot, [])
            owed += [debt] * count
            del owed[:-OWED_KEPT]

    def take(self, frame: Frame, now: float) -> bool:
        """Whether `frame` is a reply that its sender owes; then it is owed no more."""
        if frame.source not in self._owed:
            return False
        for owed in self._prune(frame.source, now):
            ours = owed.left and owed.frame.source == frame.destination
            if ours and owed.profile.read(owed.request, frame) is not None:
                self._forget(owed)
                return True
        return False

    def owed_until(self, robot: Address, profile: Profile, request: Request, now: float) -> float | None:
        """Until when replies may come from `robot` that could be mistaken for the answer to `request`."""
        if robot not in self._owed:
            return None
        like = profile.answers_to(request)
        untils = [owed.until for owed in self._prune(robot, now) if owed.profile.answers_to(owed.request) == like]
        return max(untils, default=None)

    def undelivered(self, frame: Frame) -> None:
        """`frame` never left: nothing is owed for it."""
        for owed in self._owed.get(frame.destination, []):
            if owed.frame is frame:
                self._forget(owed)
                return

    def _prune(self, robot: Address, now: float) -> list[_Owed]:
        owed = [each for each in self._owed.get(robot, []) if each.until > now]
        if owed:
            self._owed[robot] = owed
        else:
            self._owed.pop(robot, None)
        return owed

    def _forget(self, owed: _Owed) -> None:
        robot = owed.frame.destination
        self._owed[robot].remove(owed)
        if not self._owed[robot]:
            del self._owed[robot]

"""Whose frame a complaint is about: ``CHECKSUM NAO BATEU!`` names neither the robot nor the frame (PSIU row 9)."""

from typing import Final, NamedTuple

COMPLAINT_WITHIN_S: Final = 0.5
"""How long after a frame has left a complaint about it may come."""


class Traffic(NamedTuple):
    """How many frames have left on a link so far, how many were heard, and when the last of all these passed."""

    frames: int
    last_at: float
    heard: int = 0
    """None where each far end is told apart: what another one was told is not what this one complains of."""


class Sending(NamedTuple):
    """A frame of ours among the others on its link."""

    link: str
    traffic: Traffic
    """What had passed, this one included."""
    alone: bool
    """It is the last of `traffic`."""
    others_at: float
    """When the last frame before it passed of which nobody knows how it fared."""

    def is_last(self, traffic: Traffic, replies: int = 0) -> bool:
        """Whether nothing has passed since but `replies`, where these are counted at all."""
        since = traffic.heard - self.traffic.heard
        return self.alone and traffic.frames == self.traffic.frames and since <= replies


class Complaints:
    """Knows of each link up to which frame complaints are settled. Pure: told the time."""

    def __init__(self) -> None:
        self._settled: dict[str, Traffic] = {}

    def sending(self, link: str, before: Traffic, after: Traffic) -> Sending:
        """Take note of a frame that was sent between `before` and `after`."""
        settled = self._settled.get(link)
        known = settled is not None and (settled.frames, settled.heard) == (before.frames, before.heard)
        others_at = settled.last_at if settled is not None and known else before.last_at
        return Sending(link, after, after.frames == before.frames + 1, others_at)

    def settle(self, sending: Sending, traffic: Traffic, replies: int = 0) -> None:
        """The robot has said how it fared with that frame, in `replies`: no later complaint is about it."""
        if sending.is_last(traffic, replies):
            self._settled[sending.link] = traffic._replace(last_at=sending.others_at)

    def blame(self, sending: Sending, traffic: Traffic, now: float) -> bool:
        """Whether a complaint at `now` can be about no other frame: none passed since, and none shortly before."""
        soon = now - sending.traffic.last_at <= COMPLAINT_WITHIN_S
        return soon and sending.is_last(traffic) and now - sending.others_at >= COMPLAINT_WITHIN_S

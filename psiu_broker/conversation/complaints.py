"""Whose frame a complaint is about: ``CHECKSUM NAO BATEU!`` names neither the robot nor the frame (PSIU row 9)."""

from typing import Final, NamedTuple

COMPLAINT_WITHIN_S: Final = 0.5
"""How long after a frame has left a complaint about it may come."""


class Traffic(NamedTuple):
    """How many frames have left on a link so far, and when the last one did."""

    frames: int
    last_at: float


class Sending(NamedTuple):
    """A frame of ours among the others on its link."""

    link: str
    frames: int
    """How many had left, this one included."""
    at_once: bool
    """It did not have to wait, so that the last of `frames` is this one."""
    others_at: float
    """When the last frame before it left of which nobody knows how it fared."""


class Complaints:
    """Knows of each link up to which frame complaints are settled. Pure: told the time."""

    def __init__(self) -> None:
        self._settled: dict[str, Traffic] = {}

    def sending(self, link: str, before: Traffic, after: Traffic) -> Sending:
        """Take note of a frame that was sent between `before` and `after`."""
        settled = self._settled.get(link)
        others_at = settled.last_at if settled is not None and settled.frames == before.frames else before.last_at
        return Sending(link, after.frames, after.frames == before.frames + 1, others_at)

    def settle(self, sending: Sending, traffic: Traffic) -> None:
        """The robot has said how it fared with that frame: no later complaint is about it."""
        if sending.at_once and traffic.frames == sending.frames:
            self._settled[sending.link] = Traffic(sending.frames, sending.others_at)

    def blame(self, sending: Sending, traffic: Traffic, now: float) -> bool:
        """Whether a complaint at `now` can be about no other frame: none left since, and none shortly before."""
        alone = sending.at_once and traffic.frames == sending.frames
        return alone and now - sending.others_at >= COMPLAINT_WITHIN_S

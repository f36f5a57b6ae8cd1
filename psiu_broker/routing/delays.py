"""How long frames waited for their link before they left."""

from collections import deque
from typing import Final

FRAMES_KEPT: Final = 1000
"""Of how many of the last frames the delay is told."""


class Delays:
    """Only frames that had to wait are noted, so that those that left at once cost nothing."""

    __slots__ = ("_waited",)

    def __init__(self) -> None:
        self._waited: deque[tuple[int, float]] = deque(maxlen=FRAMES_KEPT)

    def note(self, count: int, waited_s: float) -> None:
        """The frame that left as number `count`, from 1 on, had waited."""
        self._waited.append((count, waited_s))

    def ms(self, count: int) -> tuple[float, float] | None:
        """p50 and p99 over the last `FRAMES_KEPT` of the `count` frames that left, in ms; None before the first."""
        frames = min(count, FRAMES_KEPT)
        if not frames:
            return None
        ordered = sorted(waited_s for number, waited_s in self._waited if number > count - frames)
        at_once = frames - len(ordered)
        p50, p99 = (
            0.0 if place < at_once else ordered[place - at_once] * 1000
            for place in (frames // 2, min(frames - 1, frames * 99 // 100))
        )
        return p50, p99

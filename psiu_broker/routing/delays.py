"""How long frames waited for their link before they left."""

from array import array
from typing import Final

FRAMES_KEPT: Final = 1000
"""Of how many of the last frames the delay is told."""


class Delays:
    """Only frames that had to wait are noted, so that those that left at once cost nothing; takes 16 bytes for each."""

    __slots__ = ("_numbers", "_waited_s")

    def __init__(self) -> None:
        # Each frame has its place by its number: what is found there of an older one is not of the last.
        self._numbers = array("q", bytes(8 * FRAMES_KEPT))
        self._waited_s = array("d", bytes(8 * FRAMES_KEPT))

    def note(self, count: int, waited_s: float) -> None:
        """The frame that left as number `count`, from 1 on, had waited."""
        place = count % FRAMES_KEPT
        self._numbers[place] = count
        self._waited_s[place] = waited_s

    def ms(self, count: int) -> tuple[float, float] | None:
        """p50 and p99 over the last `FRAMES_KEPT` of the `count` frames that left, in ms; None before the first."""
        frames = min(count, FRAMES_KEPT)
        if not frames:
            return None
        noted = zip(self._numbers, self._waited_s, strict=True)
        ordered = sorted(waited_s for number, waited_s in noted if number > count - frames)
        at_once = frames - len(ordered)
        p50, p99 = (
            0.0 if place < at_once else ordered[place - at_once] * 1000
            for place in (frames // 2, min(frames - 1, frames * 99 // 100))
        )
        return p50, p99

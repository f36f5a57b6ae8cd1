"""Whether the broker stood still: its process was stopped, the computer slept, or the loop was held up."""

from math import inf
from typing import Final

STOOD_STILL_S: Final = 1.0
"""A pause between beats that is no mere load: the process was stopped, or the computer slept."""
STALE_S: Final = 0.3
"""How long after that calls may still come that had waited meanwhile."""


class Pulse:
    """Beats with each tick of the loop. Told the time: seconds, any steady clock."""

    def __init__(self, now: float) -> None:
        self._beat = now
        self._stale_until = -inf

    def beat(self, now: float) -> float:
        """The loop goes round; returns for how many seconds it stood still before, 0 for none."""
        pause_s, self._beat = now - self._beat, now
        if pause_s <= STOOD_STILL_S:
            return 0.0
        self._stale_until = now + STALE_S
        return pause_s

    def since_s(self, now: float) -> float:
        """How long the last beat is past."""
        return now - self._beat

    def stale(self, now: float) -> bool:
        """Whether what comes now may have waited while the broker stood still, nobody knows how long."""
        return now < self._stale_until or self.since_s(now) > STOOD_STILL_S

"""How well each link hears: of what comes in, the share that checks out."""

from math import exp
from typing import Final

from psiu_broker.routing.claims import BEST

MEMORY_FRAMES: Final = 20
"""After so many frames the share of before counts for a third."""


class Qualities:
    """The quality of each link, from counters that only grow."""

    def __init__(self) -> None:
        self._counted: dict[str, tuple[int, int]] = {}
        self._share: dict[str, float] = {}

    def count(self, link: str, good: int, bad: int) -> None:
        """Note the counters of `link` as they are now."""
        good_before, bad_before = self._counted.get(link, (0, 0))
        self._counted[link] = good, bad
        more_good, more = good - good_before, good - good_before + bad - bad_before
        if more > 0:
            share = self._share.get(link, 1.0)
            weight = 1 - exp(-more / MEMORY_FRAMES)
            self._share[link] = share + weight * (more_good / more - share)

    def of(self, link: str) -> int:
        """In tenths; the best where nothing was heard."""
        return round(BEST * self._share.get(link, 1.0))

"""How much the broker may say of itself on one link: questions that nobody told it to ask.

Answers, calls and what others send are not charged to it: they are what the link is for.
"""

from math import inf
from typing import Final

SHARE: Final = 0.015
"""Of the bit rate, in the long run."""
AT_ONCE_S: Final = 20.0
"""So many seconds' share may be used at once, as when a link opens; in any minute that is 2 % of the line."""


class Allowance:
    """A bucket of bits that fills at `SHARE` of the link's rate; a link without a rate has no limit.

    A question passes while there is anything left, however long it is: what it takes too much is
    paid before the next, so that a slow line too is greeted.
    """

    __slots__ = ("_at", "_bits_per_second", "_left", "refused")

    def __init__(self, bits_per_second: int | None) -> None:
        self._bits_per_second = None if bits_per_second is None else bits_per_second * SHARE
        self._left = 0.0
        self._at = -inf
        self.refused = 0
        """Questions that were not asked."""

    def may(self, bits: int, now: float) -> bool:
        """Whether `bits` may be sent now; if so, they are charged. `now` is in seconds on any steady clock."""
        rate = self._bits_per_second
        if rate is None:
            return True
        self._left = min(rate * AT_ONCE_S, self._left + (now - self._at) * rate)
        self._at = now
        if self._left <= 0:
            self.refused += 1
            return False
        self._left -= bits
        return True

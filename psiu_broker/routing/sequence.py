"""What came of a numbered series: nothing twice, and how many are missing."""

from typing import Final

WINDOW: Final = 64
"""How far behind the newest a number may come and still be known as new or as a double."""


class Sequence:
    """The numbers of one series, which counts from 1."""

    __slots__ = ("_newest", "_seen", "received")

    def __init__(self) -> None:
        self.received = 0
        self._newest = 0
        self._seen = 0
        """One bit for each of the last `WINDOW` numbers; the newest is bit 0."""

    @property
    def lost(self) -> int:
        """How many that should have come by now did not; one that comes late after all is taken off."""
        return self._newest - self.received

    def expect(self, number: int) -> None:
        """`number` has been sent: if it has not come, it is late or lost."""
        ahead = number - self._newest
        if ahead > 0:
            self._seen = self._seen << ahead & ((1 << WINDOW) - 1) if ahead < WINDOW else 0
            self._newest = number

    def take(self, number: int) -> bool:
        """Note `number`; False if it came before, or is too old to tell."""
        ahead = number - self._newest
        if ahead > 0:
            self.expect(number)
            self._seen |= 1
        else:
            if ahead <= -WINDOW or number < 1 or self._seen >> -ahead & 1:
                return False
            self._seen |= 1 << -ahead
        self.received += 1
        return True

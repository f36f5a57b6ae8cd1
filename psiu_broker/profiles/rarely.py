"""What may be done to each of many only once in a while."""

from collections.abc import Hashable
from typing import Final

REMEMBERED: Final = 256


class Rarely:
    """A short memory of the turns that each key has left: the latest `REMEMBERED` keys."""

    def __init__(self) -> None:
        self._left: dict[Hashable, tuple[float, float]] = {}

    def __len__(self) -> int:
        return len(self._left)

    def may(self, key: Hashable, now: float, every_s: float, burst: int = 1) -> bool:
        """True at most `burst` times at once, and once every `every_s` in the long run, for one key.

        `now` is in seconds on any steady clock.
        """
        left, at = self._left.pop(key, (float(burst), now))
        left = min(float(burst), left + (now - at) / every_s)
        may = left >= 1.0
        if len(self._left) >= REMEMBERED:
            del self._left[next(iter(self._left))]
        self._left[key] = (left - may, now)
        return may

"""What may be done to each of many only once in a while."""

from collections.abc import Hashable
from typing import Final

REMEMBERED: Final = 256


class Rarely:
    """A short memory of when each key last had its turn: the latest `REMEMBERED` keys."""

    def __init__(self) -> None:
        self._last: dict[Hashable, float] = {}

    def __len__(self) -> int:
        return len(self._last)

    def may(self, key: Hashable, now: float, every_s: float) -> bool:
        """True at most once every `every_s` for one key; `now` is in seconds on any steady clock."""
        last = self._last.get(key)
        if last is not None and now - last < every_s:
            return False
        self._last.pop(key, None)
        if len(self._last) >= REMEMBERED:
            del self._last[next(iter(self._last))]
        self._last[key] = now
        return True

"""Whom an answer without a destination is for.

On point-to-point and master-slave links (PSIU HEXA), and where packets name nobody at all, a packet does not
say to whom it goes. What a robot sends there shortly after somebody addressed it is for the one who addressed it last.
"""

from typing import Final

from psiu_broker.frame import Address

ROBOTS_KEPT: Final = 256


class Askers:
    """The last one to address each robot of one link: of the latest `ROBOTS_KEPT` robots."""

    __slots__ = ("_last", "_window_s")

    def __init__(self, window_s: float = 2.0) -> None:
        self._window_s = window_s
        self._last: dict[Address, tuple[Address, float]] = {}

    def __len__(self) -> int:
        return len(self._last)

    def note(self, robot: Address, asker: Address, now: float) -> None:
        self._last[robot] = (asker, now)
        if len(self._last) > ROBOTS_KEPT:
            # Half of them at once, the ones addressed longest ago, so that the next ones cost nothing.
            latest = sorted(self._last.items(), key=lambda item: item[1][1])[ROBOTS_KEPT // 2 :]
            self._last = dict(latest)

    def of(self, robot: Address, now: float) -> Address | None:
        """Who addressed `robot` within the window, if anybody did."""
        asked = self._last.get(robot)
        return asked[0] if asked is not None and now - asked[1] <= self._window_s else None

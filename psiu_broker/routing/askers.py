"""Whom an answer without a destination is for.

On point-to-point and master-slave links (PSIU HEXA) a packet does not say to whom it goes. What a
robot sends there shortly after somebody addressed it is for the one who addressed it last.
"""

from psiu_broker.frame import Address


class Askers:
    """The last one to address each robot of one link; bounded by the 256 addresses there are."""

    __slots__ = ("_last", "_window_s")

    def __init__(self, window_s: float = 2.0) -> None:
        self._window_s = window_s
        self._last: dict[Address, tuple[Address, float]] = {}

    def note(self, robot: Address, asker: Address, now: float) -> None:
        self._last[robot] = (asker, now)

    def of(self, robot: Address, now: float) -> Address | None:
        """Who addressed `robot` within the window, if anybody did."""
        asked = self._last.get(robot)
        return asked[0] if asked is not None and now - asked[1] <= self._window_s else None

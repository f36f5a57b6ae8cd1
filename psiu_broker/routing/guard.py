"""How many new names, and frames to everyone, each link may bring; and the last that was turned away from whom."""

from collections.abc import Hashable
from dataclasses import dataclass
from math import inf
from typing import Final

from psiu_broker.frame import Address, Frame, Way
from psiu_broker.routing.policy import Rule
from psiu_broker.routing.verdicts import Verdict

TO_EVERYONE_EVERY_S: Final = 0.2
TO_EVERYONE_AT_ONCE: Final = 20
"""As when many robots are switched on together, and each asks who is there."""
REFUSALS_KEPT: Final = 256
MINUTE_S: Final = 60.0


class Bucket:
    """Turns that come back at a steady rate, up to `most`."""

    __slots__ = ("_at", "_left", "_most", "_rate")

    def __init__(self, most: float, rate: float) -> None:
        self._most = self._left = most
        self._rate = rate
        self._at = inf

    def take(self, now: float) -> bool:
        """Use a turn, if there is one. `now` is in seconds on any steady clock."""
        self._left = min(self._most, self._left + max(now - self._at, 0.0) * self._rate)
        self._at = now
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True


@dataclass(slots=True)
class Refusal:
    """The last frame of a source that was turned away, and how many were."""

    verdict: Verdict
    destination: Address
    subject: str
    way: Way
    rule: Rule | None
    at: float
    count: int = 1


class Guard:
    """Counts for each link, bounded; a link without a limit is told by no number."""

    def __init__(self) -> None:
        self._limits: dict[str, int] = {}
        self._names: dict[str, Bucket] = {}
        self._storms: dict[str, Bucket] = {}
        self._refusals: dict[Hashable, Refusal] = {}

    def limit(self, link: str, new_names_per_minute: int) -> None:
        """So many new names may come on `link` in a minute; counting goes on where it was when the link was down."""
        if self._limits.get(link) != new_names_per_minute:
            self._limits[link] = new_names_per_minute
            self._names[link] = Bucket(new_names_per_minute, new_names_per_minute / MINUTE_S)

    def may_name(self, link: str, now: float) -> bool:
        """Whether one more new name may come on `link` now."""
        bucket = self._names.get(link)
        return bucket is None or bucket.take(now)

    def may_tell_everyone(self, link: str, now: float) -> bool:
        """Whether one more frame to everyone may come from `link` now."""
        bucket = self._storms.get(link)
        if bucket is None:
            bucket = self._storms[link] = Bucket(TO_EVERYONE_AT_ONCE, 1 / TO_EVERYONE_EVERY_S)
        return bucket.take(now)

    def refused(self, frame: Frame, verdict: Verdict, way: Way, now: float, rule: Rule | None = None) -> None:
        """Note what was turned away, to tell of it."""
        last = self._refusals.pop(frame.source, None)
        count = 1 if last is None else last.count + 1
        if len(self._refusals) >= REFUSALS_KEPT:
            del self._refusals[next(iter(self._refusals))]
        self._refusals[frame.source] = Refusal(verdict, frame.destination, frame.subject, way, rule, now, count)

    def last_refusal(self, source: Address) -> Refusal | None:
        return self._refusals.get(source)

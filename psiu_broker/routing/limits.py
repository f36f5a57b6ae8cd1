"""How much may leave on a link: so many frames and bytes a second, in all and of some subjects. Told the time.

What is over a limit waits in the outbox. A stop neither waits for a limit nor counts for one.
"""

from collections.abc import Mapping
from fnmatch import fnmatchcase
from math import inf
from typing import Final, NamedTuple

from psiu_broker.routing.outbox import STOP_LANE, Parcel

BURST_S: Final = 0.25
"""So many seconds' share of a limit may leave at once, after a rest."""
SUBJECTS_KEPT: Final = 256
"""Of so many subjects it is remembered which limit is theirs."""


class Rate(NamedTuple):
    """How much a second; None: as much as there is."""

    frames_s: float | None = None
    bytes_s: float | None = None


class Bucket:
    """Tokens that come at `rate` a second, up to `burst` of them.

    In any t seconds no more than rate · t + burst are spent. What costs more than `burst` needs a full bucket, and
    what it takes too much is paid before the next: then the longest one takes the place of `burst` in that sum.
    """

    __slots__ = ("_at", "_left", "burst", "rate")

    def __init__(self, rate: float, burst: float) -> None:
        self.rate = rate
        self.burst = burst
        self._left = burst
        self._at = -inf

    def ready(self, cost: float, now: float) -> float:
        """From when on `cost` may be spent; `now` if it may be at once."""
        missing = min(cost, self.burst) - self._filled(now)
        return now + missing / self.rate if missing > 0 else now

    def spend(self, cost: float, now: float) -> None:
        self._left = self._filled(now) - cost
        self._at = now

    def _filled(self, now: float) -> float:
        return min(self.burst, self._left + (now - self._at) * self.rate)


class _Limit:
    """The buckets of one rate."""

    __slots__ = ("_bytes", "_frames")

    def __init__(self, rate: Rate) -> None:
        self._frames = None if rate.frames_s is None else Bucket(rate.frames_s, max(rate.frames_s * BURST_S, 1.0))
        self._bytes = None if rate.bytes_s is None else Bucket(rate.bytes_s, rate.bytes_s * BURST_S)

    def ready(self, size: int, now: float) -> float:
        by_frames = now if self._frames is None else self._frames.ready(1, now)
        return by_frames if self._bytes is None else max(by_frames, self._bytes.ready(size, now))

    def spend(self, size: int, now: float) -> None:
        if self._frames is not None:
            self._frames.spend(1, now)
        if self._bytes is not None:
            self._bytes.spend(size, now)


class Limits:
    """The limits of one link: that of `whole`, and those of `subjects`, by patterns such as ``node/*``.

    All subjects that one pattern fits share its limit; the first that fits counts, in any case of letters.
    """

    def __init__(self, whole: Rate, subjects: Mapping[str, Rate]) -> None:
        self._whole = _Limit(whole)
        self._limits = {pattern.lower(): _Limit(rate) for pattern, rate in subjects.items()}
        self._known: dict[str, str | None] = {}

    def of(self, subject: str) -> str | None:
        """Which of the patterns limits `subject`, if any does."""
        try:
            return self._known[subject]
        except KeyError:
            word = subject.lower()
            limit = next((pattern for pattern in self._limits if fnmatchcase(word, pattern)), None)
            if len(self._known) >= SUBJECTS_KEPT:
                self._known.clear()
            self._known[subject] = limit
            return limit

    def ready(self, limit: str | None, size: int, now: float) -> float:
        """From when on the limit of a subject lets a frame of `size` bytes go."""
        return now if limit is None else self._limits[limit].ready(size, now)

    def ready_whole(self, size: int, now: float) -> float:
        """From when on the limit of the whole link does."""
        return self._whole.ready(size, now)

    def spend(self, parcel: Parcel, now: float) -> None:
        """`parcel` leaves."""
        if parcel.lane != STOP_LANE:
            self._whole.spend(len(parcel.wire), now)
            if parcel.limit is not None:
                self._limits[parcel.limit].spend(len(parcel.wire), now)


class Gate:
    """One look, at `now`, through what waits: asked of each parcel in its turn, it says which a limit holds back.

    Behind one that the link's limit holds back nothing but a stop goes; behind one that its subject's limit does,
    nothing of that limit: what is short does not starve what is long.
    """

    __slots__ = ("_held", "_limits", "_now", "_shut", "opens")

    def __init__(self, limits: Limits, now: float) -> None:
        self.opens = inf
        """When the first of what it held back may go."""
        self._limits = limits
        self._now = now
        self._shut = False
        self._held: set[str] = set()

    def holds(self, parcel: Parcel) -> bool:
        if parcel.lane == STOP_LANE:
            return False
        if self._shut or parcel.limit in self._held:
            return True
        size = len(parcel.wire)
        ready = self._limits.ready(parcel.limit, size, self._now)
        if parcel.limit is not None and ready > self._now:
            self._held.add(parcel.limit)
        else:
            ready = self._limits.ready_whole(size, self._now)
            self._shut = ready > self._now
        if ready <= self._now:
            return False
        self.opens = min(self.opens, ready)
        return True

"""How many new names, and frames to everyone, each link may bring; and the last that was turned away from whom.

Stops to everyone have turns of their own, more of them, and no far end has those of another.
"""

from collections.abc import Hashable
from dataclasses import dataclass
from typing import Final

from psiu_broker.frame import Address, Frame, Way
from psiu_broker.routing.limits import Bucket
from psiu_broker.routing.outbox import STOP_WORDS
from psiu_broker.routing.policy import Rule
from psiu_broker.routing.verdicts import Verdict

TO_EVERYONE_EVERY_S: Final = 0.2
TO_EVERYONE_AT_ONCE: Final = 20
"""As when many robots are switched on together, and each asks who is there."""
STOP_EVERYONE_EVERY_S: Final = 0.05
STOP_EVERYONE_AT_ONCE: Final = 50
STOPPING_KEPT: Final = 1024
REFUSALS_KEPT: Final = 256
MINUTE_S: Final = 60.0

_PLAIN_STOPS: Final = frozenset(word.encode() for word in STOP_WORDS)
_OTHER_STOPS: Final = b""


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
        self._stopping: dict[tuple[Way, bytes], Bucket] = {}
        self._refusals: dict[Hashable, Refusal] = {}

    def limit(self, link: str, new_names_per_minute: int) -> None:
        """So many new names may come on `link` in a minute; counting goes on where it was when the link was down."""
        if self._limits.get(link) != new_names_per_minute:
            self._limits[link] = new_names_per_minute
            self._names[link] = Bucket(new_names_per_minute / MINUTE_S, new_names_per_minute)

    def may_name(self, link: str, now: float) -> bool:
        """Whether one more new name may come on `link` now."""
        bucket = self._names.get(link)
        return bucket is None or _take(bucket, now)

    def may_tell_everyone(self, link: str, now: float) -> bool:
        """Whether one more frame to everyone may come from `link` now."""
        bucket = self._storms.get(link)
        if bucket is None:
            bucket = self._storms[link] = Bucket(1 / TO_EVERYONE_EVERY_S, TO_EVERYONE_AT_ONCE)
        return _take(bucket, now)

    def may_stop_everyone(self, stop: bytes, way: Way, now: float) -> bool:
        """Whether one more frame to everyone with the payload `stop` may come by `way` now.

        A stop word alone may not only where its equal by the same way, which goes to the same robots, was let through
        less than `STOP_EVERYONE_EVERY_S` ago. Those that say more, or say it in capitals, share the turns of one word:
        anybody can make up any number of them.
        """
        key = way, stop if stop in _PLAIN_STOPS else _OTHER_STOPS
        bucket = self._stopping.get(key)
        if bucket is None:
            if len(self._stopping) >= STOPPING_KEPT:
                del self._stopping[next(iter(self._stopping))]
            bucket = self._stopping[key] = Bucket(1 / STOP_EVERYONE_EVERY_S, STOP_EVERYONE_AT_ONCE)
        return _take(bucket, now)

    def refused(self, frame: Frame, verdict: Verdict, way: Way, now: float, rule: Rule | None = None) -> None:
        """Note what was turned away, to tell of it."""
        last = self._refusals.pop(frame.source, None)
        count = 1 if last is None else last.count + 1
        if len(self._refusals) >= REFUSALS_KEPT:
            del self._refusals[next(iter(self._refusals))]
        self._refusals[frame.source] = Refusal(verdict, frame.destination, frame.subject, way, rule, now, count)

    def last_refusal(self, source: Address) -> Refusal | None:
        return self._refusals.get(source)


def _take(bucket: Bucket, now: float) -> bool:
    """Use one turn of `bucket`, if there is one."""
    if bucket.ready(1, now) > now:
        return False
    bucket.spend(1, now)
    return True

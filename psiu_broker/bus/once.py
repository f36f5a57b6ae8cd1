"""A call is carried out once, also where Zenoh's routers deliver it several times.

While routers find new ways to each other, a query can come many times over within a second. Calls
of `Client` carry an id. A call without one, from a program in plain Zenoh, is told from its double
by its words, for a moment and only where routers relay.
"""

import threading
import time
from collections.abc import Callable
from typing import Final

KEPT_S: Final = 30.0
SAME_WORDS_S: Final = 1.0
ID_MAX: Final = 64
"""Bytes of an id; a longer attachment is none."""
CAPACITY: Final = 16_384


class Once:
    """Remembers the calls of the last `KEPT_S`. For any thread."""

    def __init__(self, *, relayed: bool, clock: Callable[[], float] = time.monotonic) -> None:
        """`relayed`: routers stand between us and programs."""
        self._relayed = relayed
        self._clock = clock
        self._seen: dict[bytes, float] = {}
        self._lock = threading.Lock()

    def is_double(self, call_id: bytes, key: str, payload: bytes) -> bool:
        """Whether this call came before; an empty `call_id` means that it has none."""
        now = self._clock()
        with self._lock:
            self._forget(now)
            if call_id and len(call_id) <= ID_MAX:
                return self._came_before(b"id:" + call_id, now, KEPT_S)
            words = b"\0".join((b"words:", key.encode(), payload))
            return self._relayed and self._came_before(words, now, SAME_WORDS_S)

    def _came_before(self, what: bytes, now: float, within_s: float) -> bool:
        at = self._seen.get(what)
        if at is not None and now - at <= within_s:
            return True
        self._seen.pop(what, None)
        self._seen[what] = now  # at the end: the oldest is always first
        return False

    def _forget(self, now: float) -> None:
        while self._seen:
            oldest = next(iter(self._seen))
            if now - self._seen[oldest] <= KEPT_S and len(self._seen) < CAPACITY:
                return
            del self._seen[oldest]

"""From Zenoh's threads into the event loop: nothing that arrives can stall either.

Zenoh fills a ring that never blocks it, one thread of ours empties the ring, and the loop is woken
once for a batch.
"""

import asyncio
import logging
import threading
from collections import deque
from collections.abc import Callable, Iterable
from typing import Final, Generic, TypeVar

T = TypeVar("T")
Kept = TypeVar("Kept")

logger = logging.getLogger(__name__)

WAITING_MAX: Final = 4096
"""What may wait for the loop; the oldest gives way (a query that gives way ends unanswered)."""

TURN_MAX: Final = 256
"""What one turn of the loop handles where each item is little work, so that links are not starved."""


class Bridge(Generic[T, Kept]):
    """Iterates `source` in a thread of its own and hands what `sift` keeps to `handle` on the loop.

    `sift` runs in that thread: it may wait, and answers None for what needs no handling. The
    thread ends with `source` (undeclared, or its session closed). `failed` hears, in that thread,
    what broke the source.
    """

    def __init__(
        self,
        source: Iterable[T],
        sift: Callable[[T], Kept | None],
        handle: Callable[[Kept], None],
        *,
        name: str,
        failed: Callable[[BaseException], None],
        turn_max: int = TURN_MAX,
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._source = source
        self._sift = sift
        self._handle = handle
        self._failed = failed
        self._turn_max = turn_max
        self._waiting: deque[Kept] = deque(maxlen=WAITING_MAX)
        self._idle = True
        self._thread = threading.Thread(target=self._read, name=f"psiu-{name}", daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Whether its source goes on."""
        return self._thread.is_alive()

    def join(self, timeout_s: float) -> None:
        """Wait for the thread to end, once the source has."""
        if self._thread is not threading.current_thread():
            self._thread.join(timeout_s)

    def _read(self) -> None:
        try:
            for item in self._source:
                try:
                    kept = self._sift(item)
                except Exception:
                    logger.exception("what arrived on the bus could not be read")
                    kept = None
                # A query ends for its asker when nothing holds it: not when the next one comes.
                del item
                if kept is not None and not self._pass_on(kept):
                    return
                del kept
        except BaseException as error:
            self._failed(error)

    def _pass_on(self, kept: Kept) -> bool:
        self._waiting.append(kept)
        if self._idle:
            self._idle = False
            try:
                self._loop.call_soon_threadsafe(self._drain)
            except RuntimeError:  # the loop is closed: nobody will ever handle it
                return False
        return True

    def _drain(self) -> None:
        self._idle = True
        for _ in range(min(len(self._waiting), self._turn_max)):
            try:
                self._handle(self._waiting.popleft())
            except Exception:
                logger.exception("what arrived on the bus could not be handled")
        if self._waiting and self._idle:
            self._idle = False
            self._loop.call_soon(self._drain)

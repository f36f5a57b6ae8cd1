"""Blocking calls that may hang (a name server that is silent, a driver that is stuck) and must hold up nothing else."""

import asyncio
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from typing import Any, TypeVar

T = TypeVar("T")


class Aside:
    """Blocking work, one piece at a time, each in a daemon thread.

    The event loop's own executor is shared with everything, and the end of the process waits for
    its threads; for these nothing waits.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._last: Future[Any] | None = None

    async def run(self, work: Callable[[], T], unwanted: Callable[[T], object] = lambda _: None) -> T:
        """What `work` returns or raises; `unwanted` takes what it returns after a cancellation, in a thread as well.

        Waits first for work that was begun before and is still under way, cancelled or not.
        """
        while self._last is not None and not self._last.done():
            with suppress(Exception):  # it has been told to whom it concerns
                await asyncio.wrap_future(self._last)
        begun = self._begin(work)
        try:
            return await asyncio.wrap_future(begun)
        except asyncio.CancelledError:
            with suppress(RuntimeError):  # no thread to be had: the cancellation counts
                self._begin(lambda: unwanted(begun.result()))
            raise

    def _begin(self, work: Callable[[], T]) -> "Future[T]":
        """Raises RuntimeError where the system has no thread for it."""
        begun: Future[T] = Future()
        # From now on a cancellation reaches the waiting only, not the work.
        begun.set_running_or_notify_cancel()
        threading.Thread(target=_carry_out, args=(work, begun), name=f"aside: {self._name}", daemon=True).start()
        self._last = begun
        return begun


def _carry_out(work: Callable[[], T], begun: "Future[T]") -> None:
    try:
        result = work()
    except BaseException as error:  # all of it is for whoever waits
        begun.set_exception(error)
    else:
        begun.set_result(result)

"""What the loop does for the programs that ask, until the broker stops."""

import asyncio
from collections.abc import Coroutine
from typing import Any

from psiu_broker.bus.replies import Replies


class Work:
    """Tasks that end with replies by `replies`. On the loop. Nobody ends those that begin once it is `closed`."""

    def __init__(self, replies: Replies) -> None:
        self.closed = False
        self._replies = replies
        self._tasks: set[asyncio.Task[None]] = set()

    def begin(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def close(self) -> None:
        """Cancel what is under way and wait for its replies to be sent; before `Session.close`."""
        self.closed = True
        await asyncio.sleep(0)  # a task that is cancelled before its first step says nothing
        for task in tuple(self._tasks):
            task.cancel()
        if self._tasks:
            await asyncio.wait(self._tasks)
        await self._replies.sent()

"""What a link and a trunk have in common: an adapter opens it, it is kept open, and its trouble stays its own."""

import asyncio
import logging
import random
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar, Final, Literal

from psiu_broker.adapter import Adapter, Peer, Transport
from psiu_broker.errors import LinkError

State = Literal["waiting", "opening", "open", "closed"]

FIRST_PAUSE_S: Final = 0.25
LONGEST_PAUSE_S: Final = 15.0
SHORTEST_PAUSE_S: Final = 0.05
"""Between two attempts, whatever the adapter says has changed."""

log = logging.getLogger(__name__)


class Kept(ABC):
    """Kept open by `run`, for ever; it is the adapter's `Receiver`."""

    kind: ClassVar[str]
    """What the log calls it."""

    def __init__(self, name: str, adapter: Adapter, clock: Callable[[], float] = time.monotonic) -> None:
        self.name = name
        self.adapter = adapter
        self.state: State = "waiting"
        self.reason: str | None = "not opened yet"
        """What it waits for, in words; None while it is open."""
        self.since = clock()
        self.pause_s = FIRST_PAUSE_S
        """The next pause between two attempts; to be set back by who sees the far end alive."""
        self._told: tuple[State, str | None] = (self.state, self.reason)
        self._clock = clock
        self._transport: Transport | None = None
        self._lost: asyncio.Future[LinkError] | None = None

    @abstractmethod
    def received(self, data: bytes, peer: Peer) -> None: ...

    @abstractmethod
    def writable(self) -> None: ...

    @abstractmethod
    def peer_lost(self, peer: Peer) -> None: ...

    def lost(self, error: LinkError) -> None:
        if self._lost is not None and not self._lost.done():
            self._lost.set_result(error)
        self._down(str(error))

    @abstractmethod
    def connected(self, transport: Transport) -> None:
        """The adapter has opened `transport`."""

    @abstractmethod
    def _down(self, reason: str) -> None:
        """Forget the connection, if there is one: it is of no more use. Neither waits nor raises."""

    async def _leave(self, transport: Transport) -> None:  # noqa: B027 - most have nothing to say
        """Wait, not for long, until what is to be said last on `transport` has been taken; it is closed then."""

    async def run(self) -> None:
        """Keep it open for ever: what fails waits and is tried again. Ends only when cancelled."""
        try:
            while True:
                try:
                    await self._live()
                except LinkError as error:
                    self._set_state("waiting", str(error))
                except Exception as error:  # an adapter's own mistake must not reach another link
                    log.exception("%s %s: its adapter failed", self.kind, self.name)
                    self._set_state("waiting", f"its adapter failed: {error!r}")
                await self._pause()
        finally:
            self._set_state("closed", None)

    async def _live(self) -> None:
        """Open it once, and serve it until it is lost.

        Raises:
            LinkError: it cannot be opened, or was lost; the text says why.
        """
        self._lost = asyncio.get_running_loop().create_future()
        self._set_state("opening", self.reason)
        transport = await self.adapter.open(self)
        try:
            if not self._lost.done():
                self.connected(transport)
            raise await self._lost
        finally:
            self._down("closed")
            try:
                try:
                    if self._lost.cancelled():  # it was told to end, and the transport is alive
                        await self._leave(transport)
                finally:
                    await transport.close()
            except Exception:  # it must not hide why the link ends, least of all that it was told to
                log.exception("%s %s: its adapter failed to close", self.kind, self.name)

    async def _pause(self) -> None:
        """Wait before the next attempt: less when the adapter sees something change, longer each time in vain."""
        pause_s = self.pause_s * random.uniform(0.5, 1.0)  # noqa: S311 - jitter is no secret
        self.pause_s = min(self.pause_s * 2, LONGEST_PAUSE_S)
        changed = asyncio.ensure_future(self.adapter.changed())
        try:
            await asyncio.sleep(SHORTEST_PAUSE_S)
            await asyncio.wait({changed}, timeout=pause_s - SHORTEST_PAUSE_S)
            if changed.done() and changed.exception() is not None:
                log.warning("%s %s: cannot watch for its return: %r", self.kind, self.name, changed.exception())
                await asyncio.sleep(pause_s)
        finally:
            changed.cancel()
            await asyncio.wait({changed})  # a cancellation that comes now is ours, not that of `changed`
            if not changed.cancelled():
                changed.exception()  # has been told, or comes too late to matter

    def _set_state(self, state: State, reason: str | None) -> None:
        """Attempts to open are no news while they end as the last one did."""
        self.state, self.reason = state, reason
        if state != "opening" and (state, reason) != self._told:
            self._told = state, reason
            self.since = self._clock()
            log.info("%s %s: %s%s", self.kind, self.name, state, f": {reason}" if reason else "")

"""One link's life: open, back off, read, write, fall silent, come back.

A link is an adapter, a codec and an outbox, kept alive by `Link.run`. Between `received` and
`offer` nothing waits; only `run` does.
"""

import asyncio
import contextlib
import logging
import random
import time
from collections.abc import Callable, Sequence
from math import inf
from typing import Final, Literal, Protocol

from psiu_broker.adapter import Peer, Transport
from psiu_broker.codecs.avr import avr_trouble
from psiu_broker.codecs.codec import Codec, Event
from psiu_broker.config import LinkConfiguration
from psiu_broker.errors import EncodeError, LinkError
from psiu_broker.frame import Address, Frame, Malformed, Way
from psiu_broker.routing.askers import Askers
from psiu_broker.routing.outbox import Fate, Outbox, Parcel, lane
from psiu_broker.routing.verdicts import DELIVERED, EXPIRED, LINK_DOWN, QUEUE_FULL, REFUSED, Verdict

State = Literal["waiting", "opening", "open", "closed"]

FIRST_PAUSE_S: Final = 0.25
LONGEST_PAUSE_S: Final = 15.0
SHORTEST_PAUSE_S: Final = 0.05
"""Between two attempts, whatever the adapter says has changed."""
WARNED_KEPT: Final = 256

log = logging.getLogger(__name__)


class Tap(Protocol):
    raw_listened: bool


class Hub(Protocol):
    """Where links meet: the broker's side of each of them. None of these waits or raises."""

    @property
    def bus(self) -> Tap:
        """Tells whether anybody wants to hear of what is `sent`."""

    def sent(self, frame: Frame, wire: bytes, way: Way) -> None: ...
    def heard(self, frame: Frame, way: Way, now: float) -> object: ...
    def malformed(self, malformed: Malformed, way: Way, now: float) -> None: ...
    def settled(self, fate: Fate, verdict: Verdict, now: float) -> None: ...
    def opened(self, link: "Link", now: float) -> None: ...
    def closed(self, link: "Link", now: float) -> None: ...
    def peer_lost(self, way: Way, now: float) -> None: ...


class _End:
    """One far end of the link: its way, its stream's codec, and the clock of its silence."""

    __slots__ = ("codec", "last", "silence_s", "timer", "way")

    def __init__(self, way: Way, codec: Codec) -> None:
        self.way = way
        self.codec = codec
        self.last = 0.0
        self.silence_s = 0.0
        self.timer: asyncio.TimerHandle | None = None


class Link:
    """A link that keeps itself alive and never lets its trouble out."""

    def __init__(
        self,
        configuration: LinkConfiguration,
        codec: Callable[[], Codec],
        hub: Hub,
        *,
        unaddressed: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.name = configuration.name
        self.adapter = configuration.adapter
        self.configuration = configuration
        self.codec = codec()
        """Encodes what leaves; decodes too where each datagram stands alone."""
        self.state: State = "waiting"
        self.reason: str | None = "not opened yet"
        """What it waits for, in words; None while it is open."""
        self.since = clock()
        self._told: tuple[State, str | None] = (self.state, self.reason)
        self.frames_in = self.frames_out = self.malformed = self.opened = 0
        self.last_heard: float | None = None
        self.last_sent = -inf
        self.outbox = Outbox(configuration.options.queue_frames)
        self._askers = Askers() if unaddressed else None
        self._make_codec = codec
        self._hub = hub
        self._warned: set[Address] = set()
        self._avr_limits = configuration.options.avr_limits
        self._max_age_s = configuration.options.max_age_s
        self._clock = clock
        self._transport: Transport | None = None
        self._ends: dict[Peer, _End] = {}
        self._lost: asyncio.Future[LinkError] | None = None
        self._empty: asyncio.Event = asyncio.Event()
        self.pause_s = FIRST_PAUSE_S

    # What the transport tells us: adapter.Receiver.

    def received(self, data: bytes, peer: Peer) -> None:
        now = self._clock()
        self.pause_s = FIRST_PAUSE_S
        end = self._ends.get(peer) or self._end(peer)
        codec = end.codec
        events = codec.decode(data, now)
        if codec.pending:
            if self.adapter.datagrams:
                events = [*events, *codec.flush(now)]
            else:
                end.last = now
                self._watch_silence(end, codec.silence_s)
        self._take(events, end.way, now)

    def writable(self) -> None:
        now = self._clock()
        self.expire(now)
        full: set[Peer] = set()
        while self._transport is not None and (parcel := self.outbox.take(full)) is not None:
            if self._transport.write(parcel.wire, parcel.peer):
                self._sent(parcel.fate.frame, parcel.wire, parcel.peer, now)
                self._hub.settled(parcel.fate, DELIVERED, now)
            elif self._transport is not None:
                self.outbox.put_back(parcel)
                full.add(parcel.peer)
            else:
                self._hub.settled(parcel.fate, LINK_DOWN, now)
        self._note_empty()

    def peer_lost(self, peer: Peer) -> None:
        now = self._clock()
        end = self._ends.pop(peer, None)
        for parcel in self.outbox.remove_peer(peer):
            self._hub.settled(parcel.fate, LINK_DOWN, now)
        self._note_empty()
        if end is not None:
            if end.timer is not None:
                end.timer.cancel()
            self._hub.peer_lost(end.way, now)

    def lost(self, error: LinkError) -> None:
        if self._lost is not None and not self._lost.done():
            self._lost.set_result(error)
        self._down(str(error))

    def connected(self, transport: Transport) -> None:
        """The adapter has opened `transport`: frames may go."""
        self._transport = transport
        self.opened += 1
        self._set_state("open", None)
        self._hub.opened(self, self._clock())

    # What the broker asks of us.

    def offer(
        self, frame: Frame, peer: Peer, arrived: Way, now: float, patience_s: float = inf, fate: Fate | None = None
    ) -> Verdict | None:
        """Send `frame` to `peer`, or queue it for at most `patience_s` and the link's own age limit.

        Never waits. Returns the verdict; None if the frame is queued, and then `Hub.settled` will be told.
        """
        transport = self._transport
        if transport is None:
            return LINK_DOWN
        if frame.dialect == self.codec.dialect:
            wire = frame.wire
        else:
            try:
                wire = self.codec.encode(frame)
            except EncodeError as error:
                log.debug("%s: %s", self.name, error)
                return REFUSED
        if self._avr_limits:
            self._warn_of_avr(frame, wire)
        if not (self.outbox.size and self.outbox.waits_for(peer)) and transport.write(wire, peer):
            self._sent(frame, wire, peer, now)
            return DELIVERED
        if self._transport is None:
            return LINK_DOWN
        parcel = Parcel(wire, peer, lane(frame), now + min(self._max_age_s, patience_s), fate or Fate(frame, arrived))
        evicted = self.outbox.put(parcel)
        self._empty.clear()
        if evicted is parcel:
            return QUEUE_FULL
        if evicted is not None:
            self._hub.settled(evicted.fate, QUEUE_FULL, now)
        return None

    def ways(self) -> tuple[Way, ...]:
        """Every far end there is now."""
        if self._transport is None:
            return ()
        return tuple((self._ends.get(peer) or self._end(peer)).way for peer in self._transport.peers)

    def expire(self, now: float) -> None:
        """Drop what has waited too long."""
        if self.outbox.size:
            for parcel in self.outbox.expire(now):
                self._hub.settled(parcel.fate, EXPIRED, now)
            self._note_empty()

    def details(self) -> dict[str, str | int | float]:
        return {} if self._transport is None else dict(self._transport.status())

    async def run(self) -> None:
        """Keep the link open for ever: what fails waits and is tried again. Ends only when cancelled."""
        try:
            while True:
                try:
                    await self._live()
                except LinkError as error:
                    self._set_state("waiting", str(error))
                except Exception as error:  # an adapter's own mistake must not reach another link
                    log.exception("link %s: its adapter failed", self.name)
                    self._set_state("waiting", f"its adapter failed: {error!r}")
                await self._pause()
        finally:
            self._set_state("closed", None)

    async def _live(self) -> None:
        """Open the link once, and serve it until it is lost.

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
                await transport.close()
            except Exception:  # it must not hide why the link ends, least of all that it was told to
                log.exception("link %s: its adapter failed to close", self.name)

    async def drained(self) -> None:
        """Return when nothing waits to be sent."""
        if self.outbox.size:
            await self._empty.wait()

    # Inside.

    def _sent(self, frame: Frame, wire: bytes, peer: Peer, now: float) -> None:
        self.frames_out += 1
        self.last_sent = now
        if self._askers is not None:
            self._askers.note(frame.destination, frame.source, now)
        if self._hub.bus.raw_listened:
            self._hub.sent(frame, wire, Way(self.name, peer))

    def _note_empty(self) -> None:
        if not self.outbox.size:
            self._empty.set()

    def _take(self, events: Sequence[Event], way: Way, now: float) -> None:
        ends = self._ends
        for event in events:
            if self._ends is not ends:
                return  # The link went down at an earlier frame; the rest must not teach routes to it.
            if isinstance(event, Frame):
                self.frames_in += 1
                self.last_heard = now
                self._hub.heard(event if self._askers is None else self._addressed(event, now), way, now)
            else:
                self.malformed += 1
                self._hub.malformed(event, way, now)

    def _addressed(self, frame: Frame, now: float) -> Frame:
        """`frame` of a link whose packets do not say for whom they are: for who asked last, if anybody did."""
        asker = self._askers.of(frame.source, now) if self._askers is not None else None
        return frame if asker is None else frame._replace(destination=asker)

    def _warn_of_avr(self, frame: Frame, wire: bytes) -> None:
        trouble = avr_trouble(wire) if frame.protocol == "psiu-ascii" else None
        if trouble is not None and frame.destination not in self._warned:
            if len(self._warned) < WARNED_KEPT:
                self._warned.add(frame.destination)
            log.warning("link %s: %s may not understand %s: %s", self.name, frame.destination, frame.subject, trouble)

    def _end(self, peer: Peer) -> _End:
        codec = self.codec if self.adapter.datagrams else self._make_codec()
        end = self._ends[peer] = _End(Way(self.name, peer), codec)
        return end

    def _watch_silence(self, end: _End, silence_s: float) -> None:
        """Have `_silence` called after `silence_s`, or sooner if it was to be sooner and nothing changed."""
        if end.timer is not None:
            if end.silence_s == silence_s:
                return
            end.timer.cancel()
        end.silence_s = silence_s
        end.timer = asyncio.get_running_loop().call_later(silence_s, self._silence, end)

    def _silence(self, end: _End) -> None:
        end.timer = None
        now = self._clock()
        rest_s = end.last + end.codec.silence_s - now
        if not end.codec.pending:
            return
        if rest_s > 0:
            self._watch_silence(end, rest_s)
        else:
            self._take(end.codec.flush(now), end.way, now)

    def _down(self, reason: str) -> None:
        """Forget the connection: nothing of it may reach a robot later."""
        if self._transport is None:
            return
        now = self._clock()
        self._transport = None
        self._set_state("waiting", reason)
        for end in self._ends.values():
            if end.timer is not None:
                end.timer.cancel()
        self._ends = {}
        if self.adapter.datagrams:
            self.codec = self._make_codec()
        for parcel in self.outbox.clear():
            self._hub.settled(parcel.fate, LINK_DOWN, now)
        self._empty.set()
        self._hub.closed(self, now)

    async def _pause(self) -> None:
        """Wait before the next attempt: less when the adapter sees something change, longer each time in vain."""
        pause_s = self.pause_s * random.uniform(0.5, 1.0)  # noqa: S311 - jitter is no secret
        self.pause_s = min(self.pause_s * 2, LONGEST_PAUSE_S)
        changed = asyncio.ensure_future(self.adapter.changed())
        try:
            await asyncio.sleep(SHORTEST_PAUSE_S)
            await asyncio.wait({changed}, timeout=pause_s - SHORTEST_PAUSE_S)
            if changed.done() and changed.exception() is not None:
                log.warning("link %s: cannot watch for its return: %r", self.name, changed.exception())
                await asyncio.sleep(pause_s)
        finally:
            changed.cancel()
            with contextlib.suppress(asyncio.CancelledError, Exception):
                await changed

    def _set_state(self, state: State, reason: str | None) -> None:
        """Attempts to open are no news while they end as the last one did."""
        self.state, self.reason = state, reason
        if state != "opening" and (state, reason) != self._told:
            self._told = state, reason
            self.since = self._clock()
            log.info("link %s: %s%s", self.name, state, f": {reason}" if reason else "")

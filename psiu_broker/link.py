"""One link's life: open, back off, read, write, fall silent, come back.

A link is an adapter, a codec and an outbox, kept alive by `Link.run`. Between `received` and
`offer` nothing waits; only `run` does.

What leaves goes at once, or waits in the outbox for room in the transport or for a limit to let it go. A stop waits for
no limit and behind nothing but another stop; yet a frame that the transport has taken cannot be called back, and
`Transport.write` takes at most one ahead of the wire.
"""

import asyncio
import logging
import time
from collections.abc import Callable, Hashable, Sequence
from fnmatch import fnmatchcase
from math import inf
from typing import ClassVar, Final, Protocol

from psiu_broker.adapter import Peer, Transport
from psiu_broker.codecs.avr import avr_trouble
from psiu_broker.codecs.codec import Codec, Event
from psiu_broker.config import LinkConfiguration, LinkOptions
from psiu_broker.config.who import Ends
from psiu_broker.errors import EncodeError
from psiu_broker.frame import MALFORMED_KEPT, NOBODY, Address, Frame, Malformed, Way
from psiu_broker.kept import FIRST_PAUSE_S, Kept
from psiu_broker.routing.askers import Askers
from psiu_broker.routing.limits import Gate, Limits, Rate
from psiu_broker.routing.outbox import COMMAND_LANE, QUESTION_LANE, STOP_LANE, Fate, Outbox, Parcel, is_answer, lane
from psiu_broker.routing.verdicts import DELIVERED, EXPIRED, LINK_DOWN, QUEUE_FULL, REFUSED, SUPERSEDED, Verdict

WARNED_KEPT: Final = 256

CUT_OFF: Final = "cut off: the connection ended"
"""The reason of a `Malformed` that might have been heard, had the connection lasted."""

log = logging.getLogger(__name__)


class Tap(Protocol):
    raw_listened: bool


class Watch(Protocol):
    """Who watches over robots on a link. None of these waits or raises."""

    def stops(self, frame: Frame) -> bool:
        """Whether `frame` stops its robot, though its word may be that of any command."""

    def left(self, link: str, frame: Frame, now: float) -> None:
        """`frame` has left on that link."""


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
    def peer_came(self, way: Way, now: float) -> None: ...
    def peer_lost(self, way: Way, now: float) -> None: ...


class Timer(Protocol):
    def cancel(self) -> None: ...


CallAt = Callable[[float, Callable[[], None]], Timer]


class _Alarm:
    """Calls `ring` once, at the earliest of the moments that it is set to; then it may be set again."""

    __slots__ = ("_call_at", "_ring", "_timer", "_when")

    def __init__(self, ring: Callable[[], None], call_at: CallAt | None) -> None:
        self._ring = ring
        self._call_at = call_at
        self._when = inf
        self._timer: Timer | None = None

    def set(self, when: float) -> None:
        if when < self._when:
            self.cancel()
            self._when = when
            self._timer = (self._call_at or asyncio.get_running_loop().call_at)(when, self._rings)

    def cancel(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._when = inf

    def _rings(self) -> None:
        self._timer = None
        self._when = inf
        self._ring()


class _End:
    """One far end of the link: its way, its stream's codec, and the clock of its silence."""

    __slots__ = ("codec", "last", "silence_s", "timer", "way")

    def __init__(self, way: Way, codec: Codec) -> None:
        self.way = way
        self.codec = codec
        self.last = 0.0
        self.silence_s = 0.0
        self.timer: asyncio.TimerHandle | None = None


class Link(Kept):
    """A link that keeps itself alive and never lets its trouble out.

    It sets no more than 29 attributes of its own: with more, CPython 3.11 is a quarter slower at each frame.
    """

    kind: ClassVar[str] = "link"
    watch: Watch | None = None

    def __init__(
        self,
        configuration: LinkConfiguration,
        codec: Callable[[], Codec],
        hub: Hub,
        *,
        unaddressed: bool = False,
        ends: Ends | None = None,
        clock: Callable[[], float] = time.monotonic,
        call_at: CallAt | None = None,
    ) -> None:
        """Make the link, closed.

        `unaddressed`: answers do not say for whom they are; `ends`: who is there, where packets do not say it.
        `call_at` sets a timer by `clock`; default: the event loop's, whose clock that has to be.
        """
        super().__init__(configuration.name, configuration.adapter, clock)
        self.configuration = configuration
        self.codec = codec()
        """Encodes what leaves; decodes too where each datagram stands alone."""
        self.frames_in = self.frames_out = self.malformed = self.opened = 0
        self.last_heard: float | None = None
        self.last_sent = -inf
        options = configuration.options
        self.outbox = Outbox(options.queue_frames)
        self._ends_named = None if self.codec.addressed else ends
        self._askers = Askers() if unaddressed or self._ends_named is not None else None
        self._make_codec = codec
        self._in_pieces = configuration.adapter.datagrams and type(self.codec).pieces is not Codec.pieces
        self._hub = hub
        self._warned: set[Address] | None = set() if options.avr_limits else None
        self._limits = _limits(options)
        self._opening = _Alarm(self.writable, call_at)
        """When a limit lets the first of what it holds back go."""
        self._ends: dict[Peer, _End] = {}
        self._empty: asyncio.Event = asyncio.Event()

    # What the transport tells us: adapter.Receiver.

    def received(self, data: bytes, peer: Peer) -> None:
        now = self._clock()
        self.pause_s = FIRST_PAUSE_S
        end = self._ends.get(peer) or self._end(peer)
        if not data:
            self._hub.peer_came(end.way, now)
            return
        codec = end.codec
        frame = None if codec.pending else codec.whole(data)
        if frame is not None and self._askers is None:
            # What `_take` does with a single frame, without the list: nearly all that is heard comes this way.
            self.frames_in += 1
            self.last_heard = now
            self._hub.heard(frame, end.way, now)
            return
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
        gate = None if self._limits is None else Gate(self._limits, now)
        held = None if gate is None else gate.holds
        full: set[Peer] = set()
        while self._transport is not None and (parcel := self.outbox.take(full, held)) is not None:
            write = self._write_pieces if self._in_pieces else self._transport.write
            if write(parcel.wire, parcel.peer):
                self._left(parcel, now)
                self._hub.settled(parcel.fate, DELIVERED, now)
            elif self._transport is not None:
                self.outbox.put_back(parcel)
                full.add(parcel.peer)
            else:
                self._hub.settled(parcel.fate, LINK_DOWN, now)
        self._wait_for(gate)
        self._note_empty()

    def peer_lost(self, peer: Peer) -> None:
        now = self._clock()
        end = self._ends.pop(peer, None)
        for parcel in self.outbox.remove_peer(peer):
            self._hub.settled(parcel.fate, LINK_DOWN, now)
        self._note_empty()
        if end is not None:
            self._give_up(end, now)
            self._hub.peer_lost(end.way, now)

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
        A stop, and a set-point of which the newest wins, take the place of what waits: that is `superseded`.
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
        if self._warned is not None:
            self._warn_of_avr(frame, wire, self._warned)
        # Called at once where nothing is in pieces: nearly all that leaves goes this way.
        write = self._write_pieces if self._in_pieces else transport.write
        if not (self.outbox.size or self._limits):
            if write(wire, peer):
                self._sent(frame, wire, peer, now)
                return DELIVERED
            parcel = self._parcel(frame, wire, peer, now, patience_s, fate or Fate(frame, arrived))
        else:
            parcel = self._parcel(frame, wire, peer, now, patience_s, fate or Fate(frame, arrived))
            if parcel.lane == STOP_LANE:
                self._supersede(self.outbox.overtaken(parcel), now)
            if self._is_next(parcel, now) and write(wire, peer):
                self._left(parcel, now)
                self._note_empty()
                return DELIVERED
        if self._transport is None:
            return LINK_DOWN
        return self._queue(parcel, now)

    def is_named(self, peer: Peer) -> bool:
        """As `Transport.is_named`."""
        return self._transport is not None and self._transport.is_named(peer)

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

    async def drained(self) -> None:
        """Return when nothing waits to be sent."""
        while self.outbox.size:
            await self._empty.wait()

    # Inside.

    def _parcel(self, frame: Frame, wire: bytes, peer: Peer, now: float, patience_s: float, fate: Fate) -> Parcel:
        urgency = self._urgency(frame)
        options = self.configuration.options
        longest_s = options.question_max_age_s if urgency == QUESTION_LANE else options.max_age_s
        limit = None if self._limits is None else self._limits.of(frame.subject)
        key: Hashable = None
        if urgency == STOP_LANE:
            key = peer, frame.destination, frame.payload
        elif options.newest_wins and urgency == COMMAND_LANE and not is_answer(frame):
            word = frame.subject.lower()
            if any(fnmatchcase(word, pattern.lower()) for pattern in options.newest_wins):
                key = peer, frame.destination, word
        return Parcel(wire, peer, urgency, now, now + min(longest_s, patience_s), fate, limit, key)

    def _urgency(self, frame: Frame) -> int:
        """The lane of `frame`, also where only who watches over its robot knows that it stops it."""
        return STOP_LANE if self.watch is not None and self.watch.stops(frame) else lane(frame)

    def _is_next(self, parcel: Parcel, now: float) -> bool:
        """Whether `parcel` need not wait behind any other, nor for a limit; if for a limit, it will be looked at."""
        if self._limits is None:
            return not self.outbox.waits_for(parcel.peer, parcel.lane)
        gate = Gate(self._limits, now)
        for older in self.outbox.before(parcel.lane):
            if not gate.holds(older) and older.peer == parcel.peer:
                return False  # for which there is no room: `writable` will be told
        held = gate.holds(parcel)
        self._wait_for(gate)
        return not held

    def _wait_for(self, gate: Gate | None) -> None:
        """Look again when `gate` opens, and not before."""
        if gate is not None and self._transport is not None:
            self._opening.set(gate.opens)

    def _queue(self, parcel: Parcel, now: float) -> Verdict | None:
        if parcel.key is not None and (older := self.outbox.swap(parcel)) is not None:
            self._supersede((older,), now)
            return None
        evicted = self.outbox.put(parcel)
        self._empty.clear()
        if evicted is parcel:
            return QUEUE_FULL
        if evicted is not None:
            self._hub.settled(evicted.fate, QUEUE_FULL, now)
        return None

    def _supersede(self, parcels: Sequence[Parcel], now: float) -> None:
        for parcel in parcels:
            self._hub.settled(parcel.fate, SUPERSEDED, now)

    def _left(self, parcel: Parcel, now: float) -> None:
        """As `_sent`, of what may have waited."""
        self._sent(parcel.fate.frame, parcel.wire, parcel.peer, now)
        if self._limits is not None:
            self._limits.spend(parcel, now)
        if now > parcel.since:
            self.outbox.delays.note(self.frames_out, now - parcel.since)

    def _sent(self, frame: Frame, wire: bytes, peer: Peer, now: float) -> None:
        self.frames_out += 1
        self.last_sent = now
        if self.watch is not None:
            self.watch.left(self.name, frame, now)
        if self._askers is not None:
            self._askers.note(frame.destination, frame.source, now)
        if self._hub.bus.raw_listened:
            self._hub.sent(frame, wire, Way(self.name, peer))

    def _note_empty(self) -> None:
        if not self.outbox.size:
            self._empty.set()

    def _take(self, events: Sequence[Event], way: Way, now: float) -> None:
        ends = self._ends
        for place, event in enumerate(events):
            if self._ends is not ends:
                self._cut_off(events[place:], way, now)  # by an earlier frame; the rest must not teach routes to it
                return
            if isinstance(event, Frame):
                self.frames_in += 1
                self.last_heard = now
                self._hub.heard(event if self._askers is None else self._addressed(event, way, now), way, now)
            else:
                self.malformed += 1
                self._hub.malformed(event, way, now)

    def _give_up(self, end: _End, now: float) -> None:
        if end.timer is not None:
            end.timer.cancel()
        if end.codec.pending:
            self._cut_off(end.codec.flush(now), end.way, now)

    def _cut_off(self, events: Sequence[Event], way: Way, now: float) -> None:
        """Count what the end of the connection left unfinished or unheard."""
        for event in events:
            size = len(event.wire) if isinstance(event, Frame) else event.size
            self.malformed += 1
            self._hub.malformed(Malformed(CUT_OFF, event.wire[:MALFORMED_KEPT], size), way, now)

    def _addressed(self, frame: Frame, way: Way, now: float) -> Frame:
        """`frame` of a link whose packets do not say for whom they are: for who asked last, if anybody did."""
        ends = self._ends_named
        if ends is not None:
            signed, frame = frame.source != NOBODY, ends.named(frame, way.peer)
            if ends.plays or signed or frame.destination.is_numbered:
                return frame
        asker = self._askers.of(frame.source, now) if self._askers is not None else None
        return frame if asker is None else frame._replace(destination=asker)

    def _write_pieces(self, wire: bytes, peer: Peer) -> bool:
        """As `Transport.write`, for a frame that leaves in several datagrams: those after the first may be lost."""
        first, *rest = self.codec.pieces(wire) or (wire,)
        if self._transport is None or not self._transport.write(first, peer):
            return False
        for piece in rest:
            if self._transport is not None:
                self._transport.write(piece, peer)
        return True

    def _warn_of_avr(self, frame: Frame, wire: bytes, warned: set[Address]) -> None:
        trouble = avr_trouble(wire) if frame.protocol == "psiu-ascii" else None
        if trouble is not None and frame.destination not in warned:
            if len(warned) < WARNED_KEPT:
                warned.add(frame.destination)
            log.warning("link %s: %s may not understand %s: %s", self.name, frame.destination, frame.subject, trouble)

    def _end(self, peer: Peer) -> _End:
        codec = self.codec if self.adapter.datagrams and not self.codec.remembers else self._make_codec()
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
        ends, self._ends = self._ends.values(), {}
        for end in ends:
            self._give_up(end, now)
        if self.adapter.datagrams:
            self.codec = self._make_codec()
        self._opening.cancel()
        for parcel in self.outbox.clear():
            self._hub.settled(parcel.fate, LINK_DOWN, now)
        self._empty.set()
        self._hub.closed(self, now)


def _limits(options: LinkOptions) -> Limits | None:
    whole = Rate(options.max_frames_s, options.max_bytes_s)
    subjects = {subject: Rate(limit.frames_s, limit.bytes_s) for subject, limit in options.limits.items()}
    return Limits(whole, subjects) if whole != Rate() or subjects else None

"""A link to robots that only listen: whole packets at a fixed rate, with the newest set-point of each robot.

A frame that is offered waits for the next packet and is delivered with it. Its robot goes on with it, in
every packet, until a newer one comes or it is too old; then, and while nobody has told the robot anything,
its share is what stops it. So the packets go on, whether there is news or not, for as long as the link is
open: from its opening, or, where the codec is not `steady`, from the first set-point that it was ever
offered. The last packet before the link is closed stops every robot; closing waits until the line has room for it.

A line is one team: the packet goes to all its far ends, and a robot is known by its number alone.
"""

import asyncio
import time
from collections import deque
from collections.abc import Callable, Mapping
from math import inf
from typing import Final

from psiu_broker.adapter import Peer, Transport
from psiu_broker.codecs.paced import PacedCodec, Rest
from psiu_broker.config import LinkConfiguration
from psiu_broker.config.who import Ends
from psiu_broker.errors import EncodeError
from psiu_broker.frame import EVERYONE, NOBODY, Frame, Way
from psiu_broker.link import CallAt, Hub, Link, Timer, log
from psiu_broker.routing.outbox import COMMAND_LANE, Fate, Parcel
from psiu_broker.routing.set_points import SetPoints
from psiu_broker.routing.verdicts import DELIVERED, LINK_DOWN, REFUSED, SUPERSEDED, Verdict

PACKET: Final = "packet"
"""The subject under which a packet without anything new is shown to who watches the link."""

PERIODS_KEPT: Final = 1000
"""Over how many of the last packets the jitter is told: half a minute at 30 Hz."""

LAST_PACKET_S: Final = 0.5
"""How long closing waits for room."""


class Pace:
    """Slots at a fixed rate from `begin` on, without drift, and how well packets kept to it. Told the time."""

    def __init__(self, rate_hz: float) -> None:
        self.missed = 0
        """Slots that passed before we came to them."""
        self.due = inf
        """When the next slot is."""
        self._period_s = 1 / rate_hz
        self._origin = 0.0
        self._slot = 0
        self._last: float | None = None
        self._deviations_ms: deque[float] = deque(maxlen=PERIODS_KEPT)

    def begin(self, now: float) -> None:
        """The first slot is now."""
        self._origin = self.due = now
        self._slot = 0
        self._last = None

    def reached(self, now: float) -> None:
        """The slot that was due has come: the next one is the first of those that are not past."""
        following = max(self._slot, int((now - self._origin) / self._period_s)) + 1
        self.missed += following - self._slot - 1
        self._slot = following
        self.due = self._origin + following * self._period_s

    def sent(self, now: float) -> None:
        """A packet leaves."""
        if self._last is not None:
            self._deviations_ms.append(abs(now - self._last - self._period_s) * 1000)
        self._last = now

    def jitter_ms(self) -> tuple[float, float] | None:
        """p50 and p99 of how far the time between two packets was from the nominal one; None before there are two."""
        ordered = sorted(self._deviations_ms)
        if not ordered:
            return None
        return ordered[len(ordered) // 2], ordered[min(len(ordered) - 1, len(ordered) * 99 // 100)]


class PacedLink(Link):
    """A link whose codec is `paced`."""

    outbox: SetPoints

    def __init__(
        self,
        configuration: LinkConfiguration,
        codec: Callable[[], PacedCodec],
        hub: Hub,
        *,
        rests: Mapping[int, Rest] | None = None,
        ends: Ends | None = None,
        clock: Callable[[], float] = time.monotonic,
        call_at: CallAt | None = None,
    ) -> None:
        """Make the link, closed.

        `rests` are those of the robots, by number, for which the codec's own is not right. `call_at` sets a timer
        by `clock`; default: the event loop's, whose clock that has to be.

        Raises:
            EncodeError: a rest does not fit the packets.
        """
        super().__init__(configuration, codec, hub, ends=ends, clock=clock)
        self._packets = codec()
        self._rests = dict.fromkeys(range(1, self._packets.robots + 1), self._packets.rest) | dict(rests or {})
        self.outbox = SetPoints(self._packets.robots)
        self.packets = 0
        self.no_room = 0
        """Slots in which the transport took no packet."""
        self._pace = Pace(self._packets.rate_hz)
        self._begun = self._packets.steady
        self._ages: dict[tuple[int, int], float] = {}
        """Until when what waits for a robot in a lane will hold once it is sent."""
        self._held: dict[int, tuple[bytes, float]] = {}
        """What each robot was told last, and until when it holds."""
        self._call_at = call_at
        self._timer: Timer | None = None
        self._unstopped: list[Peer] = []
        """Far ends for which the last packet found no room."""
        self._room: asyncio.Event = asyncio.Event()
        self._stops = self._packets.packet([self._rests[robot].stop for robot in sorted(self._rests)])

    def connected(self, transport: Transport) -> None:
        super().connected(transport)
        if self._begun:
            self._begin()

    def writable(self) -> None:
        """Nothing but for the last packet: any other that found no room is not sent late, the next one is newer."""
        self._room.set()

    def offer(
        self, frame: Frame, peer: Peer, arrived: Way, now: float, patience_s: float = inf, fate: Fate | None = None
    ) -> Verdict | None:
        """Have the next packet carry `frame`, within `patience_s` and the age that a set-point may have.

        As `Link.offer`; what waits may also be `superseded` by what is offered later for the same robot.
        """
        if self._transport is None:
            return LINK_DOWN
        try:
            robot, payload = self._packets.share(frame)
        except EncodeError as error:
            log.debug("%s: %s", self.name, error)
            return REFUSED
        hold_s = self._rests[robot].hold_s
        expires = now + min(self.configuration.options.max_age_s, patience_s, hold_s)
        # A set-point is no question, whatever its word; there is room for a stop and one other.
        urgency = min(self._urgency(frame), COMMAND_LANE)
        parcel = Parcel(payload, peer, urgency, now, expires, fate or Fate(frame, arrived))
        superseded = self.outbox.replace(parcel)
        if parcel.lane < COMMAND_LANE:
            self._held.pop(robot, None)  # whatever becomes of the stop, the robot does not go on
        self._ages[robot, parcel.lane] = now + hold_s
        self._empty.clear()
        for older in superseded:
            self._hub.settled(older.fate, SUPERSEDED, now)
        self._begun = True
        self._begin()
        return None

    def details(self) -> dict[str, str | int | float]:
        """What the transport says, and how steadily the packets leave."""
        details = super().details() | {
            "rate_hz": self._packets.rate_hz,
            "packets": self.packets,
            "no_room": self.no_room,
            "missed": self._pace.missed,
        }
        jitter_ms = self._pace.jitter_ms()
        if jitter_ms is not None:
            details["jitter_p50_ms"], details["jitter_p99_ms"] = (round(each, 3) for each in jitter_ms)
        return details

    def _begin(self) -> None:
        """Let the packets flow, the first one at once, unless they do."""
        if self._timer is None and self._transport is not None:
            self._pace.begin(self._clock())
            self._set_timer()

    def _set_timer(self) -> None:
        call_at = self._call_at or asyncio.get_running_loop().call_at
        self._timer = call_at(self._pace.due, self._slot)

    def _slot(self) -> None:
        """A slot has come."""
        transport, now = self._transport, self._clock()
        if transport is None:
            return
        self._pace.reached(now)
        self._set_timer()
        self.expire(now)
        due = self.outbox.due()
        wire = self._packets.packet(
            [due[robot].wire if robot in due else self._holding(robot, now) for robot in sorted(self._rests)]
        )
        peers = tuple(transport.peers)
        took = [peer for peer in peers if transport.write(wire, peer)]
        if self._transport is not transport:
            return  # It was lost in the middle, and so was everything that waited.
        if not took:
            self.no_room += len(peers) > 0
            return
        self.packets += 1
        self._pace.sent(now)
        self.outbox.remove(due.values())
        for robot, parcel in due.items():
            self._held[robot] = parcel.wire, self._ages[robot, parcel.lane]
            self._sent(parcel.fate.frame, wire, parcel.peer if parcel.peer in took else took[0], now)
            self.outbox.delays.note(self.frames_out, now - parcel.since)
            self._hub.settled(parcel.fate, DELIVERED, now)
        if not due and self._hub.bus.raw_listened:
            self._hub.sent(Frame(NOBODY, EVERYONE, PACKET, b"", self.codec.protocol), wire, Way(self.name, took[0]))
        self._note_empty()

    def _holding(self, robot: int, now: float) -> bytes:
        """What the robot is told where there is nothing new."""
        share, until = self._held.get(robot, (b"", -inf))
        return share if now < until else self._rests[robot].stop

    def _down(self, reason: str) -> None:
        transport = self._transport
        if transport is not None and self._timer is not None:
            self._timer.cancel()
            self._timer = None
            # Robots that do not stop by themselves in a silence would go on for ever.
            self._unstopped = list(transport.peers)
            self._stop_all(transport)
        self._held.clear()
        super()._down(reason)

    async def _leave(self, transport: Transport) -> None:
        try:
            async with asyncio.timeout(LAST_PACKET_S):
                while self._unstopped:
                    await self._room.wait()
                    self._stop_all(transport)
        except TimeoutError:
            log.warning("link %s: closed without room for the packet that stops its robots", self.name)

    def _stop_all(self, transport: Transport) -> None:
        """Tell to stop who was not told yet, as far as there is room."""
        self._room.clear()
        self._unstopped = [peer for peer in self._unstopped if not transport.write(self._stops, peer)]

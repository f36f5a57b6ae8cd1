"""What one broker knows of another: whether it lives, how far it is, and what came of each other's frames."""

from collections import deque
from collections.abc import Iterator
from math import inf
from typing import Final

from psiu_broker.frame import MESH, Way
from psiu_broker.mesh.beat import Beat
from psiu_broker.routing.outbox import LANES
from psiu_broker.routing.sequence import Sequence

BEAT_S: Final = 0.4
ALIVE_S: Final = 0.9
"""A broker whose last beat is older may be gone: its robots are anybody's who hears them."""
SILENT_S: Final = 2.2
"""A broker that is announced and yet so long silent has lost sight of us: longer than a Zenoh session's lease."""
NEWCOMER_S: Final = 0.9
"""Of a broker that has just been announced, a beat should have come by then."""
STEP_EVERY_S: Final = 1.5
UNHEARD_MAX: Final = 2
"""Frames may be under way when they are counted. When none of the count before has come either, they are lost."""
IDLE_MAX: Final = 4
"""After so many counts without a new frame nobody knows whether one would come."""
OFFSETS: Final = 64
ROUND_TRIPS: Final = 8


class Remedy:
    """How far we have gone against a trouble with another broker."""

    __slots__ = ("_at", "cut_all", "steps")

    def __init__(self) -> None:
        self.steps = 0
        self.cut_all = 0
        """How often every link was ended because of it."""
        self._at = -inf

    def is_due(self, now: float) -> bool:
        """Whether it is time for the next step, which is then `steps`."""
        if now - self._at < STEP_EVERY_S:
            return False
        self._at = now
        self.steps += 1
        return True

    def over(self) -> None:
        self.steps = self.cut_all = 0


class Neighbour:
    """Another broker, in one of its lives (`epoch`)."""

    def __init__(self, name: str, epoch: int, zenoh_id: str, now: float) -> None:
        self.name = name
        self.epoch = epoch
        self.zenoh_id = zenoh_id
        self.way = Way(MESH, name)
        self.since = now
        self.beat_at: float | None = None
        self.deaf_since: float | None = None
        """Since when its beats do not mention ours."""
        self.differs_since: float | None = None
        """Since when what it says that it claims is not what we have seen announced."""
        self.unheard = 0
        """Of how many counts in a row nothing that it sent has come; see `UNHEARD_MAX`."""
        self.remedy = Remedy()
        self.sent: dict[int, int] = {}
        """How many frames we sent it, by lane."""
        self.received: dict[int, Sequence] = {}
        self.doubles = 0
        self._sent_us = 0
        self._counted = self._come = self._idle = 0
        self._offsets: deque[float] = deque(maxlen=OFFSETS)
        self._round_trips: deque[float] = deque(maxlen=ROUND_TRIPS)

    def alive(self, now: float) -> bool:
        return now - self.last_sign() <= ALIVE_S

    def last_sign(self) -> float:
        return self.since if self.beat_at is None else self.beat_at

    @property
    def round_trip_s(self) -> float | None:
        """The quickest of the last few."""
        return min(self._round_trips) if self._round_trips else None

    @property
    def frames_out(self) -> int:
        return sum(self.sent.values())

    @property
    def frames_in(self) -> int:
        return sum(series.received for series in self.received.values())

    @property
    def lost(self) -> int:
        return sum(series.lost for series in self.received.values())

    def returned(self, now: float) -> None:
        """It was only out of sight, and the series of frames go on."""
        self.since = now
        self.beat_at = self.deaf_since = self.differs_since = None
        self.unheard = 0
        self._offsets.clear()  # its clock stands still while it sleeps

    def beat(self, beat: Beat, own: str, own_epoch: int, now: float) -> None:
        """Note a beat that came now to the broker `own` in its life `own_epoch`."""
        self.beat_at = now
        self._sent_us = beat.sent_us
        self._offsets.append(now - beat.sent_us / 1e6)
        meant_for, counts = beat.sent.get(own, (own_epoch, {}))
        if meant_for == own_epoch:
            for lane in LANES & counts.keys():
                self._series(lane).expect(counts[lane])
        if beat.heard is None:
            return
        if meant_for == own_epoch:
            self._note_unheard(sum(counts.values()))
        echo = beat.heard.get(own)
        if echo is None:
            self.deaf_since = now if self.deaf_since is None else self.deaf_since
        else:
            self.deaf_since = None
            ours_us, held_us = echo
            round_trip_s = now - (ours_us + held_us) / 1e6
            if 0 <= round_trip_s < SILENT_S:
                self._round_trips.append(round_trip_s)
                self._correct_offsets(now - beat.sent_us / 1e6 - round_trip_s)

    def echo(self, now: float) -> tuple[int, int] | None:
        """What our own beat says of this broker's."""
        return None if self.beat_at is None else (self._sent_us, int((now - self.beat_at) * 1e6))

    def late_s(self, sent_us: int, now: float) -> float:
        """How much longer than the quickest beat a frame took; the clocks of two brokers may differ at will."""
        offset = now - sent_us / 1e6
        quickest = min(self._offsets, default=offset)
        return max(offset - quickest, 0.0)

    def number(self, lane: int) -> int:
        """The place of the next frame to it in the series of `lane`."""
        self.sent[lane] = number = self.sent.get(lane, 0) + 1
        return number

    def take(self, lane: int, number: int) -> bool:
        """Note a frame from it; False for one that came before."""
        new = self._series(lane).take(number)
        self.doubles += not new
        return new

    def _note_unheard(self, sent: int) -> None:
        """It says that it has sent us so many frames by now."""
        come = self.frames_in
        if come > self._come or sent < self._counted:
            self.unheard = self._idle = 0
        elif sent > self._counted:
            self.unheard += 1
            self._idle = 0
        else:
            self._idle += 1
            if self._idle > IDLE_MAX:
                self.unheard = 0
        self._counted, self._come = sent, come

    def _correct_offsets(self, least: float) -> None:
        """Its clock reads at least so much less than ours, as no beat takes longer than a whole round trip.

        Offsets below that are of a time before its clock stood still, in a sleep too short for anybody to miss it.
        """
        if min(self._offsets) < least:
            self._offsets = deque((each for each in self._offsets if each >= least), OFFSETS)

    def _series(self, lane: int) -> Sequence:
        series = self.received.get(lane)
        if series is None:
            series = self.received[lane] = Sequence()
        return series


class Neighbours:
    """The other brokers that are announced now, by name."""

    def __init__(self) -> None:
        self._known: dict[str, Neighbour] = {}
        self.ways: tuple[Way, ...] = ()

    def __iter__(self) -> Iterator[Neighbour]:
        return iter(self._known.values())

    def find(self, name: str) -> Neighbour | None:
        return self._known.get(name)

    def add(self, neighbour: Neighbour) -> None:
        """A broker, or a new life of one that was known."""
        self._known[neighbour.name] = neighbour
        self._count()

    def remove(self, name: str) -> None:
        self._known.pop(name, None)
        self._count()

    def alive(self, name: str, now: float) -> bool:
        neighbour = self._known.get(name)
        return neighbour is not None and neighbour.alive(now)

    def _count(self) -> None:
        self.ways = tuple(neighbour.way for neighbour in self._known.values())

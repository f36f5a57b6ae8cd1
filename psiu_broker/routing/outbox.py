"""What waits for one link: bounded, urgent first, and never late.

Stops leave by turns of the ways by which they came, and where no more fit, the way that has the most of them waiting
gives one up: names can be made up, ways hardly.
"""

from collections import Counter, deque
from collections.abc import Callable, Collection, Hashable, Iterator
from itertools import chain
from typing import Final, NamedTuple

from psiu_broker.frame import EVERYONE, Frame, Way
from psiu_broker.routing.delays import Delays
from psiu_broker.routing.verdicts import DELIVERED, Verdict

STOP_LANE: Final = 0
COMMAND_LANE: Final = 1
QUESTION_LANE: Final = 2

LANES: Final = frozenset({STOP_LANE, COMMAND_LANE, QUESTION_LANE})

STOP_WORDS: Final = frozenset({"pare", "parar", "para", "stop"})
"""Command words that stop a robot, as `is_stop` knows them."""

QUESTION_WORDS: Final = frozenset({"qualseunome", "quantoscomandos", "exibecomando", "exibecomandos"})

STATUS_WORDS: Final = frozenset({b"sucesso", b"ok", b"respok", b"falha", b"respfalha"})
"""What follows the command word in an answer of PSIU ASCII."""


def is_stop(command: str) -> bool:
    """Whether `command`, in any case, overtakes everything that waits."""
    return command.lower() in STOP_WORDS


def is_question(command: str) -> bool:
    """Whether `command`, in any case, asks about a robot, which moves none."""
    return command.lower() in QUESTION_WORDS


def is_answer(frame: Frame) -> bool:
    """Whether `frame` says how a command went: it moves nobody, and each is awaited by somebody."""
    return frame.protocol == "psiu-ascii" and any(
        word.lower() in STATUS_WORDS for word in frame.payload.split(maxsplit=2)[1:2]
    )


def lane(frame: Frame) -> int:
    """The lane of `frame`: stops before commands and answers, these before questions about a robot."""
    word = frame.subject.lower()
    if word in STOP_WORDS and not is_answer(frame):
        return STOP_LANE
    return QUESTION_LANE if word in QUESTION_WORDS else COMMAND_LANE


class Fate:
    """What became of one frame that goes several ways, or that has to wait.

    It is settled once, when the last of its copies is: delivered if any copy was, else dropped for
    the reason of the first copy that failed.
    """

    __slots__ = ("_copies", "_verdict", "arrived", "frame")

    def __init__(self, frame: Frame, arrived: Way, copies: int = 1) -> None:
        self.frame = frame
        self.arrived = arrived
        self._copies = copies
        self._verdict: Verdict | None = None

    def settle(self, verdict: Verdict) -> Verdict | None:
        """One copy ended as `verdict`; the verdict of the whole frame once this was the last."""
        if self._verdict is None or verdict == DELIVERED:
            self._verdict = verdict
        self._copies -= 1
        return self._verdict if self._copies == 0 else None


class Parcel(NamedTuple):
    """One copy of a frame, encoded for its link; since when it waits, and until when it is worth sending."""

    wire: bytes
    peer: object
    lane: int
    since: float
    expires: float
    fate: Fate
    limit: str | None = None
    """The limit that its subject shares, if any does."""
    key: Hashable = None
    """Of a set-point, and of a stop where no more fit: a newer one with the same key takes its place."""


class Outbox:
    """A bounded queue of parcels in three lanes.

    Every parcel that goes in comes out exactly once: taken, evicted, expired or cleared.
    """

    __slots__ = ("_capacity", "_lanes", "delays", "size")

    def __init__(self, capacity: int = 64) -> None:
        self._capacity = capacity
        self._lanes: tuple[deque[Parcel], ...] = (deque(), deque(), deque())
        self.size = 0
        self.delays = Delays()
        """How long what left had waited, by the number of the frame."""

    def __iter__(self) -> Iterator[Parcel]:
        """What waits, in the order in which it would leave."""
        return chain(*self._lanes)

    def put(self, parcel: Parcel) -> Parcel | None:
        """Queue `parcel`; if there was no room, the one that had to go: the oldest of the least urgent lane.

        Of a box full of stops, it is one of the way that has the most, `parcel` included, and among these the oldest
        for the robot that has most.
        """
        evicted = None
        if self.size >= self._capacity:
            least = next(lane for lane in reversed(self._lanes) if lane)
            if least[0].lane < parcel.lane:
                return parcel
            evicted = self._surplus_stop(parcel) if least[0].lane == STOP_LANE else least[0]
            least.remove(evicted)
            self.size -= 1
        if parcel.lane == STOP_LANE:
            self._line_up(parcel)
        else:
            self._lanes[parcel.lane].append(parcel)
        self.size += 1
        return evicted

    def swap(self, newer: Parcel) -> Parcel | None:
        """Put `newer` where one with its key waits, and return that; None, and nothing changed, where none does.

        The newer one leaves when the older would have, so that a stream of set-points starves nobody and is not
        starved by itself; its age is its own. Stops are swapped only where no more fit: each has its own answer.
        """
        waiting = self._lanes[newer.lane]
        if newer.lane == STOP_LANE and len(waiting) < self._capacity:
            return None
        for place, older in enumerate(waiting):
            if older.key == newer.key:
                waiting[place] = newer
                return older
        return None

    def overtaken(self, stop: Parcel) -> list[Parcel]:
        """Take out all that waits and would, behind `stop`, move a robot again that it is for.

        That goes for what is for everyone, too: it is better not to move some robots than to move one that was stopped.
        """
        robot = stop.fate.frame.destination
        return self._take_out(
            lambda older: (
                older.lane == COMMAND_LANE
                and older.peer == stop.peer
                and (robot == EVERYONE or older.fate.frame.destination in (robot, EVERYONE))
                and not is_answer(older.fate.frame)
            )
        )

    def before(self, lane: int) -> Iterator[Parcel]:
        """What would leave before a parcel that is put into `lane` now."""
        return chain(*self._lanes[: lane + 1])

    def waits_for(self, peer: object, lane: int) -> bool:
        """Whether anything waits for `peer` that what comes later in `lane` must wait behind."""
        return any(parcel.peer == peer for parcel in self.before(lane))

    def take(
        self, passing_over: Collection[object] = (), held: Callable[[Parcel], bool] | None = None
    ) -> Parcel | None:
        """The next parcel to send, to a peer that is not among `passing_over`, and that is not `held` back."""
        for lane in self._lanes:
            for place, parcel in enumerate(lane):
                if parcel.peer not in passing_over and not (held is not None and held(parcel)):
                    del lane[place]
                    self.size -= 1
                    return parcel
        return None

    def put_back(self, parcel: Parcel) -> None:
        """Return what was just taken to the head of its lane."""
        self._lanes[parcel.lane].appendleft(parcel)
        self.size += 1

    def expire(self, now: float) -> list[Parcel]:
        """Take out what is too late to send."""
        return self._take_out(lambda parcel: parcel.expires <= now)

    def remove_peer(self, peer: object) -> list[Parcel]:
        """Take out what waits for a peer that is gone."""
        return self._take_out(lambda parcel: parcel.peer == peer)

    def clear(self) -> list[Parcel]:
        """Take out everything: the link went down, and nothing of it may move a robot later."""
        return self._take_out(lambda _: True)

    def _line_up(self, stop: Parcel) -> None:
        """Put `stop` before the second one of a way if it is its own way's first, and so on."""
        waiting = self._lanes[STOP_LANE]
        way = stop.fate.arrived
        turn = sum(each.fate.arrived == way for each in waiting)
        if turn == len(waiting):  # a flood by one way alone
            waiting.append(stop)
            return
        before: Counter[Way] = Counter()
        for place, each in enumerate(waiting):
            if before[each.fate.arrived] > turn:
                waiting.insert(place, stop)
                return
            before[each.fate.arrived] += 1
        waiting.append(stop)

    def _surplus_stop(self, newcomer: Parcel) -> Parcel:
        waiting = self._lanes[STOP_LANE]
        ways = Counter(each.fate.arrived for each in waiting)
        ways[newcomer.fate.arrived] += 1
        way = max(ways, key=ways.__getitem__)
        crowd = [each for each in waiting if each.fate.arrived == way]
        robots = Counter(each.fate.frame.destination for each in crowd)
        if newcomer.fate.arrived == way:
            robots[newcomer.fate.frame.destination] += 1
        robot = max(robots, key=robots.__getitem__)
        return next(each for each in crowd if each.fate.frame.destination == robot)

    def _take_out(self, unwanted: Callable[[Parcel], bool]) -> list[Parcel]:
        taken: list[Parcel] = []
        for lane in self._lanes:
            if any(map(unwanted, lane)):
                taken += [parcel for parcel in lane if unwanted(parcel)]
                kept = [parcel for parcel in lane if not unwanted(parcel)]
                lane.clear()
                lane.extend(kept)
        self.size -= len(taken)
        return taken

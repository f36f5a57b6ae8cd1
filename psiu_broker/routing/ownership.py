"""One owner for each robot, however many brokers hear it.

The owner publishes what the robot says, carries out its calls and sends to it. A broker that hears
a robot that another one owns tells the owner so, with the frame itself (a *notice*). If the owner
heard that very frame, both hear one radio: it stays the owner unless the other hears clearly
better for a while, or it misses several frames on end. If it did not, the robot has moved, and the
owner gives it up. Should the robot be heard again by the owner before it could, there is more than
one robot of that name: after a few such alternations this is a conflict, which is shown, and the
owner stays who it is as long as it hears its robot.

Pure: told the time. It decides; `psiu_broker.mesh` does.
"""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from math import inf
from typing import Final

from psiu_broker.frame import MESH, Address, Frame, Way
from psiu_broker.routing.claims import Claims
from psiu_broker.routing.table import Route

NOTICE_EVERY_S: Final = 0.2
SETTLED_S: Final = 0.3
"""How far apart two brokers may hear one frame, and how long the owner waits for its own copy."""
REMIND_S: Final = 0.5
"""A robot that fell silent when its owner had been told is told of once more: the notice may be lost."""
MISSES: Final = 3
SHARED_FOR_S: Final = 5.0
"""A robot that both heard so lately is given up after so many frames that only the other heard, not after one."""
BETTER_BY: Final = 2
BETTER_FOR_S: Final = 3.0
"""A robot on one radio with two brokers changes hands when the other hears better by 2 tenths for this long."""
RECENT_S: Final = 10.0
"""A robot overheard this recently is taken over when nobody owns it any more."""
ALTERNATIONS: Final = 3
ALTERNATIONS_WITHIN_S: Final = 60.0
CONFLICT_KEPT_S: Final = 60.0
CONFLICT_QUIET_S: Final = 5.0
"""Even in a conflict the owner yields when it has not heard its robot for so long, and another broker has."""
OVERHEARD_MAX: Final = 4096


@dataclass(slots=True)
class Overheard:
    """The last that we heard of a robot that another broker owns."""

    way: Way
    protocol: str
    at: float
    frame: Frame | None = None
    """None: it was ours then."""
    noticed_at: float = -inf
    """When we told its owner."""
    reminded: bool = False


@dataclass(slots=True)
class _Rival:
    """What the owner knows of another broker that hears one of its robots."""

    asked_at: float | None = None
    """When the notice came that is not settled yet."""
    key: object = None
    heard_at: float = 0.0
    """When the other heard that frame."""
    shared_at: float = -inf
    """When we last heard the same frame as it."""
    told: tuple[object, float] | None = None
    """The last frame that it told us of and we did not hear, and when it heard that."""
    misses: int = 0
    """How many of its frames since then we did not hear."""
    strange_at: float | None = None
    """When it last heard the robot where we did not."""
    better_since: float | None = None
    alternations: deque[float] = field(default_factory=lambda: deque(maxlen=ALTERNATIONS))


@dataclass(slots=True)
class Conflict:
    """Robots of one name that are alive at several brokers."""

    robot: Address
    brokers: set[str]
    since: float
    last: float


class Ownership:
    """What one broker knows of who owns what.

    Args:
        own: this broker's name.
        alive: whether another broker was heard a moment ago.
        heard_here: whether one of our own links brought the frame with that identity, and not before a certain time.
        notify: called with the owner, the frame that we heard of its robot, and where.
    """

    def __init__(
        self,
        own: str,
        alive: Callable[[str, float], bool],
        heard_here: Callable[[object, float], bool],
        notify: Callable[[str, Frame, Way], None],
    ) -> None:
        self.claims = Claims()
        self.overheard: dict[Address, Overheard] = {}
        self.conflicts: dict[Address, Conflict] = {}
        self._own = own
        self._alive = alive
        self._heard_here = heard_here
        self._notify = notify
        self._rivals: dict[tuple[Address, str], _Rival] = {}

    def owner(self, robot: Address) -> str | None:
        held = self.claims.owner(robot)
        return None if held is None else held[0]

    def takes(self, route: Route, frame: Frame, arrived: Way, now: float) -> bool:
        """A robot that lives at another broker was heard on a link of ours: whether it is ours now."""
        robot = route.robot
        if str(robot) == route.way.peer:
            return False  # a robot cannot be a broker
        owner = self.owner(robot)
        if owner is None or owner == self._own or not self._alive(owner, now):
            self.overheard.pop(robot, None)
            return True
        self.overhear(route, frame, arrived, now)
        return False

    def overhear(self, route: Route, frame: Frame, arrived: Way, now: float) -> None:
        """Note what was heard of a robot of another broker, and tell its owner now and then."""
        robot = route.robot
        if str(robot) == route.way.peer:
            return
        owner = self.owner(robot)
        known = self.overheard.get(robot)
        noticed_at = -inf if known is None else known.noticed_at
        if owner is not None and now - noticed_at >= NOTICE_EVERY_S:
            noticed_at = now
            self._notify(owner, frame, arrived)
        self._note(robot, Overheard(arrived, frame.protocol, now, frame, noticed_at))

    def remember(self, route: Route) -> None:
        """Note a robot that we give up, so that it can be ours again should nobody take it."""
        if route.heard_at is not None and route.way.link != MESH:
            self._note(route.robot, Overheard(route.way, route.protocol, route.heard_at))

    def forget(self, robot: Address) -> None:
        """Somebody has taken it: of where we had it nothing is left, only of where we overheard it since."""
        known = self.overheard.get(robot)
        if known is not None and known.frame is None:
            del self.overheard[robot]

    def reminders(self, now: float) -> Iterator[tuple[str, Frame, Way, float]]:
        """What is to be told to an owner once more: the owner, the frame, where and when we heard it."""
        for robot, known in self.overheard.items():
            if known.frame is not None and not known.reminded and now - known.at >= REMIND_S:
                known.reminded = True
                owner = self.owner(robot)
                if owner is not None and owner != self._own:
                    yield owner, known.frame, known.way, known.at

    def abandoned(self, now: float) -> list[Address]:
        """Robots that we overheard of late and whose owner has fallen silent."""
        return [
            robot
            for robot, known in self.overheard.items()
            if known.frame is not None and now - known.at <= RECENT_S
            if (owner := self.owner(robot)) not in (None, self._own) and not self._alive(str(owner), now)
        ]

    def heard_on(self, robot: Address) -> str | None:
        """The link of ours on which a robot of another broker was overheard of late."""
        known = self.overheard.get(robot)
        return None if known is None or known.frame is None else known.way.link

    def recent(self, robot: Address, now: float) -> Overheard | None:
        """What was overheard of a robot, if that is recent enough to take it over."""
        known = self.overheard.get(robot)
        return known if known is not None and now - known.at <= RECENT_S else None

    def noticed(self, route: Route, broker: str, key: object, better_by: int, heard_at: float, now: float) -> bool:
        """Another broker heard the frame `key` of a robot that we own: whether to yield.

        It heard it at `heard_at` by our clock, on a link that hears `better_by` tenths better than ours.
        """
        rival = self._rivals.setdefault((route.robot, broker), _Rival())
        if self._heard_here(key, heard_at - SETTLED_S):
            return self._shared(route.robot, rival, better_by, now)
        told, rival.told = rival.told, (key, heard_at)
        if told is not None and told[0] == key and abs(heard_at - told[1]) < NOTICE_EVERY_S / 2:
            return False  # a reminder of what it told us already
        rival.misses += 1
        if rival.asked_at is None:
            rival.asked_at, rival.key, rival.heard_at = now, key, heard_at
        if rival.strange_at is None or (route.heard_at is not None and route.heard_at > rival.strange_at):
            self._alternated(route, broker, rival, now)
        rival.strange_at = now
        return False

    def due(self, find: Callable[[Address], Route | None], now: float) -> Iterator[tuple[Address, str]]:
        """The robots that have moved to another broker, as far as it can be told by now."""
        for (robot, broker), rival in list(self._rivals.items()):
            if rival.asked_at is None or now - rival.asked_at < SETTLED_S:
                continue
            asked_at, rival.asked_at = rival.asked_at, None
            route = find(robot)
            if route is None or self._heard_here(rival.key, rival.heard_at - SETTLED_S):
                continue
            silent_s = inf if route.heard_at is None else now - route.heard_at
            if silent_s < now - asked_at:
                rival.misses = 0
            elif robot in self.conflicts and silent_s < CONFLICT_QUIET_S:
                continue
            elif rival.misses >= MISSES or now - rival.shared_at > SHARED_FOR_S:
                yield robot, broker

    def expire(self, now: float) -> None:
        """Forget what is long past."""
        for key, rival in list(self._rivals.items()):
            strange = rival.strange_at is not None and now - rival.strange_at <= ALTERNATIONS_WITHIN_S
            strange = strange or now - rival.shared_at <= SHARED_FOR_S
            if not strange and rival.better_since is None and rival.asked_at is None:
                del self._rivals[key]
        for robot, known in list(self.overheard.items()):
            if now - known.at > RECENT_S:
                del self.overheard[robot]
        for robot, conflict in list(self.conflicts.items()):
            if now - conflict.last > CONFLICT_KEPT_S:
                del self.conflicts[robot]

    def _note(self, robot: Address, overheard: Overheard) -> None:
        self.overheard.pop(robot, None)
        self.overheard[robot] = overheard  # at the end: the one noted longest ago is forgotten first
        if len(self.overheard) > OVERHEARD_MAX:
            del self.overheard[next(iter(self.overheard))]

    def _shared(self, robot: Address, rival: _Rival, better_by: int, now: float) -> bool:
        """Both of us heard the same frame."""
        rival.asked_at = None
        rival.shared_at, rival.misses = now, 0
        rival.alternations.clear()
        if better_by < BETTER_BY or robot in self.conflicts:
            rival.better_since = None
        elif rival.better_since is None:
            rival.better_since = now
        elif now - rival.better_since >= BETTER_FOR_S:
            rival.better_since = None
            return True
        return False

    def _alternated(self, route: Route, broker: str, rival: _Rival, now: float) -> None:
        """The robot is heard there after it was heard here."""
        robot = route.robot
        rival.alternations.append(now)
        conflict = self.conflicts.get(robot)
        if conflict is not None:
            conflict.brokers.add(broker)
            conflict.last = now
        elif len(rival.alternations) == ALTERNATIONS and now - rival.alternations[0] <= ALTERNATIONS_WITHIN_S:
            self.conflicts[robot] = Conflict(robot, {self._own, broker}, now, now)

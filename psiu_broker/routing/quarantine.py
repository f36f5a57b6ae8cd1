"""Two robots with one name on two links of one broker: the newcomer is held back.

A robot that roams is heard on another link, and the link where it was falls silent. Two robots of one
name are heard by turns: where one was heard after the other, and the first again, and so on, the link
that has the name longer keeps it, and what comes under that name on the other is turned away until
the operator says otherwise. A robot that two radios hear is one robot: each frame that comes by both
takes back one of the turns that were counted.

Pure: told the time.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

from psiu_broker.frame import Address

TURNS: Final = 3
TURNS_WITHIN_S: Final = 60.0
"""So often must a name turn up elsewhere, after it was heard again where it belongs, within so long."""
BOTH_HEARD_S: Final = 1.0
"""How far apart two links may bring one frame of one robot."""
KEPT: Final = 256


@dataclass(slots=True)
class Held:
    """One name that robots on several links have."""

    robot: Address
    keeper: str
    """The link that has the name."""
    links: set[str]
    """Those on which it is held back."""
    since: float
    last: float
    """When a frame was last turned away."""
    frames: int = 0
    """How many were."""


@dataclass(slots=True)
class _Roaming:
    """A robot that was heard on more than one link of late."""

    home: str
    turns: deque[float] = field(default_factory=deque)
    """When it was heard elsewhere, after it had been heard at home."""
    chosen: bool = False
    """The operator says that this is its home."""


class Quarantine:
    """Which names are held back on which links; bounded: what was touched longest ago is forgotten first."""

    def __init__(self, *, capacity: int = KEPT) -> None:
        self.held: dict[Address, Held] = {}
        """By robot; empty unless something is wrong."""
        self._capacity = capacity
        self._roaming: dict[Address, _Roaming] = {}

    def __iter__(self) -> Iterator[Held]:
        return iter(self.held.values())

    def holds(self, robot: Address, link: str) -> bool:
        """Whether what comes under the name `robot` on `link` is turned away."""
        held = self.held.get(robot)
        return held is not None and link in held.links

    def turned_away(self, robot: Address, now: float) -> None:
        """Count a frame that is held back."""
        held = self.held[robot] = self.held.pop(robot)
        held.frames += 1
        held.last = now

    def moved(self, robot: Address, before: str, link: str, now: float) -> str | None:
        """`robot`, which was on the link `before`, is heard on `link`.

        Returns:
            None: it may. Else the link that keeps the name: on the other one it is held back from now on.
        """
        roaming = self._roaming.get(robot)
        if roaming is not None:
            while roaming.turns and now - roaming.turns[0] > TURNS_WITHIN_S:
                roaming.turns.popleft()
        if roaming is None or not (roaming.turns or roaming.chosen):
            roaming = _Roaming(before)
        self._remember(robot, roaming)
        if before != roaming.home:
            return None
        roaming.turns.append(now)
        if len(roaming.turns) < TURNS:
            return None
        del self._roaming[robot]
        self._hold(robot, roaming.home, link, now)
        return roaming.home

    def both_heard(self, robot: Address, apart_s: float) -> None:
        """One frame of `robot` came by two links, `apart_s` apart."""
        roaming = self._roaming.get(robot)
        if roaming is not None and roaming.turns and apart_s <= BOTH_HEARD_S:
            roaming.turns.pop()

    def release(self, robot: Address, link: str) -> bool:
        """The operator says that the robot on `link` may have the name; False if it is not held back there.

        Whoever had it until now is the newcomer then, should both go on talking.
        """
        held = self.held.get(robot)
        if held is None or link not in held.links:
            return False
        held.links.discard(link)
        held.keeper = link
        if not held.links:
            del self.held[robot]
        self._remember(robot, _Roaming(link, chosen=True))
        return True

    def _remember(self, robot: Address, roaming: _Roaming) -> None:
        self._roaming.pop(robot, None)
        self._roaming[robot] = roaming
        if len(self._roaming) > self._capacity:
            del self._roaming[next(iter(self._roaming))]

    def _hold(self, robot: Address, keeper: str, link: str, now: float) -> None:
        held = self.held.get(robot)
        if held is not None:
            held.keeper = keeper
            held.links.add(link)
            return
        if len(self.held) >= self._capacity:
            del self.held[next(iter(self.held))]
        self.held[robot] = Held(robot, keeper, {link}, now, now)

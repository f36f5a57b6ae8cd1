"""One picture of the mesh from what each broker says of the others. Pure."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import combinations
from statistics import fmean

from psiu_broker.messages import Conflict, Mesh, MeshBroker, MeshRobot


@dataclass(frozen=True)
class Broker:
    name: str
    answers: bool
    """False: it is only known from what the others say."""
    mode: str | None
    since: datetime | None
    """When the others first saw it; None where nobody else does."""
    robots: int
    zenoh_id: str


@dataclass(frozen=True)
class Pair:
    """Two brokers of which one at least sees the other."""

    a: str
    b: str
    rtt_ms: float | None
    a_to_b: int
    """Frames."""
    b_to_a: int
    lost: int
    """Frames that one sent and that never came to the other."""
    direct: bool
    only: str | None
    """The one that sees the other without being seen, though both answer."""

    @property
    def how(self) -> str:
        if self.only is not None:
            return f"only {self.only} sees it"
        return "direct" if self.direct else "relayed"


@dataclass(frozen=True)
class Robot:
    """A robot with one owner; it is there twice where the brokers do not agree on the owner."""

    told: MeshRobot
    known_to: tuple[str, ...]
    """The brokers that take this owner for the owner."""
    claimed_by: tuple[str, ...]
    """The brokers that say that it is on a link of theirs."""


@dataclass(frozen=True)
class Split:
    """A broker that some see and others do not."""

    broker: str
    seen_by: tuple[str, ...]
    unseen_by: tuple[str, ...]


@dataclass(frozen=True)
class View:
    brokers: tuple[Broker, ...]
    pairs: tuple[Pair, ...]
    robots: tuple[Robot, ...]
    conflicts: tuple[Conflict, ...]
    splits: tuple[Split, ...]

    @property
    def contested(self) -> frozenset[str]:
        """The names that more than one robot or broker seems to have."""
        return frozenset(conflict.robot for conflict in self.conflicts)

    def robots_of(self, broker: str) -> list[Robot]:
        return [robot for robot in self.robots if robot.told.owner == broker]


def composed(answers: Sequence[Mesh]) -> View:
    """The view of all from the view of each; everything in the order of names."""
    by_name = {each.broker: each for each in sorted(answers, key=lambda each: each.broker)}
    seen = {name: {other.name: other for other in mesh.brokers} for name, mesh in by_name.items()}
    robots = _robots(by_name)
    others = (other for mesh in seen.values() for other in mesh)
    names = sorted({*by_name, *others, *(robot.told.owner for robot in robots)})
    splits = []
    for name in names:
        askers = [asker for asker in by_name if asker != name]
        seen_by = tuple(asker for asker in askers if name in seen[asker])
        if 0 < len(seen_by) < len(askers):
            splits.append(Split(name, seen_by, tuple(asker for asker in askers if asker not in seen_by)))
    return View(
        brokers=tuple(_broker(name, by_name.get(name), seen.values(), robots) for name in names),
        pairs=tuple(
            _pair(a, b, seen.get(a, {}).get(b), seen.get(b, {}).get(a), both=a in by_name and b in by_name)
            for a, b in combinations(names, 2)
            if b in seen.get(a, {}) or a in seen.get(b, {})
        ),
        robots=robots,
        conflicts=_conflicts(by_name.values()),
        splits=tuple(splits),
    )


def _broker(name: str, own: Mesh | None, seen: Iterable[dict[str, MeshBroker]], robots: Sequence[Robot]) -> Broker:
    told = [others[name] for others in seen if name in others]
    return Broker(
        name,
        own is not None,
        own.mode if own is not None else None,
        min((each.since for each in told), default=None),
        sum(robot.told.owner == name for robot in robots),
        own.zenoh_id if own is not None else next((each.zenoh_id for each in told), ""),
    )


def _pair(a: str, b: str, by_a: MeshBroker | None, by_b: MeshBroker | None, *, both: bool) -> Pair:
    """What `a` says of `b`, and `b` of `a`."""
    told = [each for each in (by_a, by_b) if each is not None]
    rtts = [each.rtt_ms for each in told if each.rtt_ms is not None]
    return Pair(
        a,
        b,
        fmean(rtts) if rtts else None,
        by_a.frames_out if by_a is not None else told[0].frames_in,
        by_b.frames_out if by_b is not None else told[0].frames_in,
        sum(each.lost for each in told),
        any(each.linked for each in told),
        (a if by_a is not None else b) if both and len(told) == 1 else None,
    )


def _robots(by_name: dict[str, Mesh]) -> tuple[Robot, ...]:
    """Each robot as its owner tells it, or else as who heard of it last."""
    told: dict[tuple[str, str], dict[str, MeshRobot]] = {}
    claimed_by: dict[str, set[str]] = {}
    for name, mesh in by_name.items():
        owned: dict[str, MeshRobot] = {}
        for claim in sorted(mesh.robots, key=lambda each: (each.term, each.owner)):
            owned[claim.robot] = claim  # the highest of several is the owner's
            claimed_by.setdefault(claim.robot, set()).add(claim.owner)
        for robot in owned.values():
            told.setdefault((robot.robot, robot.owner), {})[name] = robot
    return tuple(
        Robot(
            by.get(owner) or max(by.values(), key=lambda each: each.term), tuple(by), tuple(sorted(claimed_by[robot]))
        )
        for (robot, owner), by in sorted(told.items())
    )


def _conflicts(answers: Iterable[Mesh]) -> tuple[Conflict, ...]:
    """Each contested name once, since it was first noticed."""
    found: dict[str, Conflict] = {}
    for conflict in sorted((each for mesh in answers for each in mesh.conflicts), key=lambda each: each.since):
        first = found.setdefault(conflict.robot, conflict)
        brokers = sorted({*first.brokers, *conflict.brokers})
        found[conflict.robot] = first.model_copy(update={"brokers": brokers})
    return tuple(found[robot] for robot in sorted(found))

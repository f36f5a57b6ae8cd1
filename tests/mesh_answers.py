"""What brokers answer of the mesh, for tests of what is shown of it."""

from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from typing import Any

from psiu_broker.messages import Conflict, Mesh, MeshBroker, MeshRobot

NOW = datetime(2026, 11, 22, 4, 0, tzinfo=UTC)


def broker(name: str, **more: Any) -> MeshBroker:
    """`name` as another one sees it."""
    return MeshBroker.model_validate(
        {"name": name, "zenoh_id": f"id-{name}", "since": NOW, "rtt_ms": 0.5, "linked": True} | more
    )


def robot(name: str, owner: str, **more: Any) -> MeshRobot:
    return MeshRobot.model_validate(
        {
            "robot": name,
            "protocol": "psiu-ascii",
            "owner": owner,
            "link": "radio",
            "quality": 0.9,
            "age_s": 3,
            "term": 1,
        }
        | more
    )


def conflict(name: str, *brokers: str, later_s: float = 0) -> Conflict:
    since = NOW + timedelta(seconds=later_s)
    return Conflict(robot=name, brokers=list(brokers), since=since, detail="by turns; rename one of them")


def mesh(name: str, *others: MeshBroker, robots: Iterable[MeshRobot] = (), conflicts: Iterable[Conflict] = ()) -> Mesh:
    """The answer of `name`."""
    return Mesh(
        broker=name,
        mode="peer",
        zenoh_id=f"id-{name}",
        brokers=list(others),
        robots=list(robots),
        conflicts=list(conflicts),
    )


def full(*names: str, robots: Iterable[MeshRobot] = (), conflicts: Iterable[Conflict] = ()) -> list[Mesh]:
    """The answers where everyone sees everyone and every robot."""
    robots, conflicts = list(robots), list(conflicts)
    return [
        mesh(name, *(broker(other) for other in names if other != name), robots=robots, conflicts=conflicts)
        for name in names
    ]

"""A broker that has nothing to tell to those who query it."""

from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any, Final

from psiu_broker.bus.queries import Source
from psiu_broker.frame import Address
from psiu_broker.messages import (
    Account,
    Card,
    Conflict,
    Health,
    Ledger,
    Link,
    Mesh,
    RobotAccount,
    Route,
    Status,
    Trunk,
    Why,
)

NOW: Final = datetime(2026, 11, 22, tzinfo=UTC)


class Quiet(Source):
    """It has no links and no robots, and no frame has arrived."""

    def status(self) -> Status:
        return Status(
            broker="base",
            version="0",
            started=NOW,
            uptime_s=1,
            links_open=0,
            links=0,
            robots=0,
            zenoh_id="a",
            listen=[],
        )

    def links(self) -> Sequence[Link]:
        return []

    def trunks(self) -> Sequence[Trunk]:
        return []

    def routes(self) -> Sequence[Route]:
        return []

    def ledger(self) -> Ledger:
        return Ledger(accounts=[], total=Account(link="", arrived=0, delivered=0, answered=0), balances=True)

    def robot_accounts(self) -> Sequence[RobotAccount]:
        return []

    def health(self) -> Health:
        return Health(healthy=True, checks={})

    def mesh_seen(self) -> Mesh:
        return Mesh(broker="base", mode="peer", zenoh_id="b")

    def conflicts(self) -> Sequence[Conflict]:
        return []

    def release(self, robot: Address, link: str) -> bool:
        return False

    def config(self) -> Mapping[str, Any]:
        return {"broker": {"name": "base"}}

    def why(self, a: Address, b: Address) -> Why:
        return Why(a=str(a), b=str(b), delivered=False, verdict="no_route", steps=[])

    def robots(self) -> Iterable[Address]:
        return []

    def card(self, robot: Address) -> Card | None:
        return None

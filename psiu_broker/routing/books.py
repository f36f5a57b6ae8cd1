"""The books of each robot: what became of the frames that name it as their sender.

Nothing here is touched for a frame from a known robot that is delivered at once. The frames that a robot's
route counts as they come are read there, and what is delivered is what is left: so the sum over all robots,
compared with the books of the links, which count every frame, shows whether one is missing.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import Final, NamedTuple

from psiu_broker.frame import Address
from psiu_broker.routing.table import Route
from psiu_broker.routing.verdicts import ANSWERED, Verdict

ROBOTS_KEPT: Final = 1024
"""Of those without a route; of the ones beyond only the sum is kept."""


class _Account:
    """What was counted under some addresses, which are one robot's."""

    __slots__ = ("addresses", "arrived", "fates")

    def __init__(self) -> None:
        self.addresses: set[Address] = set()
        self.arrived = 0
        """Without those that live routes have counted."""
        self.fates: dict[Verdict, int] = {}
        """Of what was not delivered."""

    def absorb(self, other: "_Account") -> None:
        self.addresses |= other.addresses
        self.arrived += other.arrived
        for verdict, count in other.fates.items():
            self.settled(verdict, count)

    def settled(self, verdict: Verdict, count: int = 1) -> None:
        self.fates[verdict] = self.fates.get(verdict, 0) + count


class Told(NamedTuple):
    """The books of one robot at one moment; arrived = delivered + answered + dropped + waiting."""

    robot: Address | None
    """None: nobody in particular, or robots that are kept no more."""
    link: str | None
    """Where it is; None where nobody knows."""
    arrived: int
    answered: int
    dropped: Mapping[Verdict, int]
    waiting: int

    @property
    def delivered(self) -> int:
        return self.arrived - self.answered - sum(self.dropped.values()) - self.waiting


class Books:
    """The accounts of all robots with a route, and of the latest `capacity` others.

    Args:
        routes: the routes of now, by address.
    """

    def __init__(self, routes: Mapping[Address, Route], *, capacity: int = ROBOTS_KEPT) -> None:
        self.waiting: Callable[[], Mapping[Address, int]] = dict
        """How many frames of each sender wait: these are given up by no robot's account before they are settled."""
        self._routes = routes
        self._capacity = capacity
        self._accounts: dict[Address, _Account] = {}
        """Under all their addresses, the ones used last at the end."""
        self._sweep_at = capacity
        self._others = _Account()

    def arrived(self, source: Address) -> None:
        """A frame arrived that no route counts."""
        self._of(source).arrived += 1
        self._accounts[source] = self._accounts.pop(source)

    def settled(self, source: Address, verdict: Verdict) -> None:
        """A frame that arrived was not delivered."""
        self._of(source).settled(verdict)

    def nameless(self, verdict: Verdict) -> None:
        """Something arrived that names nobody, and was dropped."""
        self._others.arrived += 1
        self._others.settled(verdict)

    def departed(self, route: Route) -> None:
        """A route is no more, and what it counted is kept here."""
        self._join(route.addresses).arrived += route.counted

    def told(self) -> Iterator[Told]:
        """Every robot's books, and last of all those of nobody in particular."""
        waiting = dict(self.waiting())
        counted: dict[int, int] = {}
        where: dict[int, Route] = {}
        routes = {id(route): route for route in self._routes.values()}.values()
        for route in routes:  # before anything is counted: two accounts may turn out to be one
            self._join(route.addresses)
        for route in routes:
            account = self._join(route.addresses)
            counted[id(account)] = counted.get(id(account), 0) + route.counted
            where.setdefault(id(account), route)
        for account in {id(account): account for account in self._accounts.values()}.values():
            waits = sum(waiting.pop(address, 0) for address in account.addresses)
            here = where.get(id(account))
            robot = min(account.addresses) if here is None else here.robot
            link = None if here is None else here.way.link
            yield _told(robot, link, account, counted.get(id(account), 0), waits)
        yield _told(None, None, self._others, 0, sum(waiting.values()))

    def _of(self, source: Address) -> _Account:
        route = self._routes.get(source)
        return self._join((source,) if route is None else route.addresses)

    def _join(self, addresses: tuple[Address, ...]) -> _Account:
        """The one account of all these addresses, from now on if not before."""
        accounts = self._accounts
        found = {id(account): account for address in addresses if (account := accounts.get(address))}
        if not found and len(accounts) >= self._sweep_at:
            self._sweep()
        first, *rest = found.values() or (_Account(),)
        for other in rest:
            first.absorb(other)
        if rest or not first.addresses.issuperset(addresses):
            first.addresses.update(addresses)
            for address in first.addresses:
                accounts[address] = first
        return first

    def _sweep(self) -> None:
        """Keep half as many robots without a route as there may be: the ones that were counted last."""
        waiting = self.waiting()
        unique = {id(account): account for account in reversed(self._accounts.values())}
        spare = [
            account
            for account in unique.values()
            if not any(address in self._routes or waiting.get(address) for address in account.addresses)
        ]
        for account in spare[self._capacity // 2 :]:
            for address in account.addresses:
                del self._accounts[address]
            account.addresses.clear()
            self._others.absorb(account)
        self._sweep_at = max(self._capacity, len(self._accounts) + self._capacity // 2)


def _told(robot: Address | None, link: str | None, account: _Account, counted: int, waiting: int) -> Told:
    dropped: dict[Verdict, int] = {verdict: count for verdict, count in account.fates.items() if verdict != ANSWERED}
    answered = account.fates.get(ANSWERED, 0)
    return Told(robot, link, account.arrived + counted, answered, dropped, waiting)

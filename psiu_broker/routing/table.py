"""Who was heard where, and when."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

from psiu_broker.frame import MESH, Address, Way


class Binding(NamedTuple):
    """A robot of the configuration: its name, its number if it has one, and the way to it."""

    name: Address
    number: Address | None
    way: Way
    protocol: str

    @property
    def addresses(self) -> tuple[Address, ...]:
        return (self.name,) if self.number is None else (self.name, self.number)


class Route:
    """The way to one robot. Mutable: the router touches it for each frame that the robot sends."""

    __slots__ = (
        "addresses",
        "decision",
        "first_heard",
        "frames",
        "heard_at",
        "home",
        "learned",
        "pinned",
        "protocol",
        "way",
    )

    def __init__(self, addresses: tuple[Address, ...], way: Way, protocol: str, *, pinned: bool) -> None:
        self.addresses = addresses
        self.way = way
        self.home = way
        """Where the configuration says the robot is; its peer there may be learned."""
        self.protocol = protocol
        self.pinned = pinned
        """True for a route of the configuration: it neither ages nor moves to another link of this broker."""
        self.decision: Any = None
        """What the router answers for a frame in the robot's own protocol, while its link is up."""
        self.first_heard: float | None = None
        self.heard_at: float | None = None
        self.frames = 0
        self.learned = 0
        """How many of `frames` taught something new: these are not `counted`."""

    @property
    def counted(self) -> int:
        """The frames that came by the known way, which only this route counts."""
        return self.frames - self.learned

    @property
    def robot(self) -> Address:
        return self.addresses[0]

    def may_be_on(self, way: Way) -> bool:
        """Whether the configuration lets the robot be heard on `way`."""
        home = self.home
        return not self.pinned or way == home or (home.peer is None and way.link == home.link)


class Departed(NamedTuple):
    """Where a robot was last heard, once its route was withdrawn."""

    link: str
    at: float


class Table:
    """Routes by address, bounded; a robot with a name and a number has one route under both."""

    def __init__(
        self,
        bindings: tuple[Binding, ...] = (),
        withdrawn: Callable[[Route], None] = lambda _: None,
        *,
        capacity: int = 4096,
    ) -> None:
        """`withdrawn` is told of each route that is no more."""
        self.routes: dict[Address, Route] = {}
        self._withdrawn = withdrawn
        self._capacity = capacity
        self._departed: dict[Address, Departed] = {}
        for binding in bindings:
            self._enter(Route(binding.addresses, binding.way, binding.protocol, pinned=True))

    def __iter__(self) -> Iterator[Route]:
        """Each route once."""
        return (route for address, route in self.routes.items() if route.addresses[0] == address)

    def learn(self, address: Address, way: Way, protocol: str, now: float) -> Route | None:
        """Note that `address` was heard on `way`; None when its route is pinned elsewhere.

        The newest checked frame wins: a robot that moved is followed. A robot of the configuration
        keeps its link and, where the configuration names one, its peer. When the table is full, the
        robot that has been known for longest gives way; if it is there, its next frame brings it back.
        """
        route = self.routes.get(address)
        if route is None:
            self._make_room(now)
            route = Route((address,), way, protocol, pinned=False)
            self._enter(route)
            self._departed.pop(address, None)
        elif not route.may_be_on(way):
            return None
        route.way = way
        route.protocol = protocol
        route.heard_at = now
        route.frames += 1
        route.learned += 1
        if route.first_heard is None:
            route.first_heard = now
        return route

    def place(
        self, addresses: tuple[Address, ...], way: Way, protocol: str, now: float, *, heard: bool = True
    ) -> Route | None:
        """Note where another broker says that a robot is.

        A robot of the configuration follows only if it was `heard` there. None where it does not, and for a bare
        number that is known to be a robot with a name.
        """
        robot = addresses[0]
        route = self.routes.get(robot)
        if route is not None and (route.robot != robot or (route.pinned and not heard)):
            return None
        free = (robot, *(number for number in addresses[1:] if self._may_join(number, robot)))
        if route is None or (not route.pinned and route.addresses != free):
            self._withdraw(list({id(old): old for each in free if (old := self.routes.get(each))}.values()), now)
            self._make_room(now)
            route = Route(free, way, protocol, pinned=False)
            self._enter(route)
        route.way = way
        route.protocol = protocol
        route.heard_at = None
        for address in route.addresses:
            self._departed.pop(address, None)
        return route

    def withdraw(self, route: Route, now: float) -> None:
        """Give up a route; that of a robot of the configuration leads back to where it says."""
        self._forget([route], now)

    def forget_link(self, link: str, now: float) -> None:
        """Withdraw what was learned on `link`; pinned routes stay, to say that their link is down."""
        self._forget([route for route in self if route.way.link == link], now)

    def forget_way(self, way: Way, now: float) -> None:
        """Withdraw what was learned by `way`."""
        self._forget([route for route in self if route.way == way], now)

    def age(self, limit_s: Mapping[str, float], now: float) -> None:
        """Withdraw the learned routes not heard for their link's `limit_s`."""
        self._withdraw(
            [
                route
                for route in self
                if not route.pinned and route.heard_at is not None and now - route.heard_at > limit_s[route.way.link]
            ],
            now,
        )

    def departed(self, address: Address) -> Departed | None:
        return self._departed.get(address)

    def _may_join(self, number: Address, robot: Address) -> bool:
        """Whether `number` is free for the robot: nobody's, its own, or that of a robot not known by name before."""
        route = self.routes.get(number)
        return route is None or route.robot == robot or (route.robot == number and not route.pinned)

    def _make_room(self, now: float) -> None:
        if len(self.routes) >= self._capacity:
            free = [route for route in self.routes.values() if not route.pinned]
            self._withdraw([next((route for route in free if route.way.link == MESH), free[0])], now)

    def _enter(self, route: Route) -> None:
        for address in route.addresses:
            self.routes[address] = route

    def _forget(self, routes: list[Route], now: float) -> None:
        for route in routes:
            if route.pinned:
                if route.way.link != route.home.link:
                    route.heard_at = None
                route.way = route.home
        self._withdraw([route for route in routes if not route.pinned], now)

    def _withdraw(self, routes: list[Route], now: float) -> None:
        for route in routes:
            for address in route.addresses:
                del self.routes[address]
                self._departed.pop(address, None)
                self._departed[address] = Departed(route.way.link, now)
            self._withdrawn(route)
        while len(self._departed) > self._capacity:
            del self._departed[next(iter(self._departed))]

"""Where a frame goes.

`Router.route` is asked once for each frame that arrived. In order: a double is dropped; the source
is learned; then the destination decides. A known robot has its decision ready on its route, so the
usual frame costs three look-ups, however many robots there are; every other case is `decide`,
which changes nothing and which `why` asks too.
"""

from collections.abc import Callable, Collection, Hashable
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

from psiu_broker.frame import EVERYONE, NOBODY, Address, Frame, Way
from psiu_broker.routing.duplicates import Duplicates
from psiu_broker.routing.table import Binding, Route, Table
from psiu_broker.routing.verdicts import DUPLICATE, LINK_DOWN, NO_ROUTE, REFUSED, SAME_WAY, Verdict

SELF: Final = Way("@self")
"""The way of frames that the broker itself sends or answers."""

Action = Literal["forward", "flood", "answer", "ask", "translate", "drop"]


@dataclass(frozen=True, slots=True)
class Decision:
    """What to do with a frame.

    forward: to `hops`. flood: to `hops`, and the broker answers too. answer: it is for the broker.
    ask: unknown robot; hold the frame and ask for it on `hops`. translate: the robot speaks another
    protocol; the broker asks it in the sender's stead. drop: for the reason `verdict`.
    """

    action: Action
    hops: tuple[Way, ...] = ()
    verdict: Verdict | None = None


DOUBLE: Final = Decision("drop", verdict=DUPLICATE)
IMPOSSIBLE_SOURCE: Final = Decision("drop", verdict=REFUSED)
_ANSWER: Final = Decision("answer")


class Port(NamedTuple):
    """What the router knows of a link that is up."""

    link: str
    protocol: str
    ways: Callable[[], Collection[Way]]
    """Every far end of the link, now."""
    wildcard: bool = True
    """Whether questions to everyone go out on it."""


class Router:
    """Decides for each frame. Pure: told the time (seconds, any steady clock), does no I/O.

    Args:
        own: the addresses of the broker itself, with the protocol of each.
        bindings: the robots of the configuration.
        identity: a frame's bytes in one form for all links, so that a double is known by them.
        heard: called when a robot is heard for the first time or from a new way.
        withdrawn: called when the route to a robot is given up.
    """

    def __init__(
        self,
        own: dict[Address, str],
        bindings: tuple[Binding, ...],
        identity: Callable[[Frame], Hashable],
        heard: Callable[[Route], None] = lambda _: None,
        withdrawn: Callable[[Route], None] = lambda _: None,
        duplicates: Duplicates | None = None,
    ) -> None:
        self.table = Table(bindings, withdrawn)
        self._routes = self.table.routes
        for address, protocol in own.items():
            route = Route((address,), SELF, protocol, pinned=True)
            route.decision = _ANSWER
            self._routes[address] = route
        self._ports: dict[str, Port] = {}
        self._identity = identity
        self._heard = heard
        self._is_double = (duplicates or Duplicates()).is_double

    def route(self, frame: Frame, arrived: Way, now: float) -> Decision:
        """Decide for a frame that arrived, and learn from it."""
        if self._is_double(self._identity(frame), arrived, now):
            return DOUBLE
        source = self._routes.get(frame.source)
        if source is not None and source.way is arrived:
            source.heard_at = now
            source.frames += 1
        elif not self._learn(frame, source, arrived, now):
            return IMPOSSIBLE_SOURCE
        target = self._routes.get(frame.destination)
        if target is not None and target.protocol == frame.protocol and target.way != arrived:
            ready: Decision | None = target.decision
            if ready is not None:
                return ready
        return self.decide(frame.destination, frame.protocol, arrived)

    def decide(self, destination: Address, protocol: str, arrived: Way) -> Decision:
        """What `route` decides for a frame of `protocol` from `arrived`, doubles aside. Changes nothing."""
        if destination == EVERYONE:
            return Decision("flood", self._everyone(protocol, arrived))
        target = self._routes.get(destination)
        if target is None:
            # Only names can be asked for; a PSIU HEXA number is found by its own first packet.
            hops = () if destination.is_numbered else self._everyone(protocol, arrived)
            return Decision("ask", hops) if hops else Decision("drop", verdict=NO_ROUTE)
        if target.way == SELF:
            return _ANSWER if arrived != SELF else Decision("drop", verdict=SAME_WAY)
        if target.way.link not in self._ports:
            return Decision("drop", verdict=LINK_DOWN)
        if target.protocol != protocol:
            translatable = (protocol, target.protocol) == ("psiu-ascii", "psiu-hexa")
            return Decision("translate") if translatable else Decision("drop", verdict=REFUSED)
        hops = tuple(way for way in self._ways_to(target) if way != arrived)
        if hops:
            return Decision("forward", hops)
        return Decision("drop", verdict=SAME_WAY if target.way.link == arrived.link else LINK_DOWN)

    def link_up(self, port: Port) -> None:
        self._ports[port.link] = port
        for route in self.table:
            if route.way.link == port.link:
                self._refresh(route)

    def link_down(self, link: str, now: float) -> None:
        """Withdraw what was learned on `link`."""
        self._ports.pop(link, None)
        for route in self.table:
            if route.way.link == link:
                route.decision = None
        self.table.forget_link(link, now)

    def peer_lost(self, way: Way, now: float) -> None:
        """Withdraw the routes over a far end that is gone."""
        self.table.forget_way(way, now)
        for route in self.table:
            if route.way.link == way.link:
                self._refresh(route)

    def find(self, address: Address) -> Route | None:
        return self._routes.get(address)

    def robots(self) -> list[Route]:
        """Every robot that is known, the broker itself left out."""
        return [route for route in self.table if route.way != SELF]

    def _learn(self, frame: Frame, source: Route | None, arrived: Way, now: float) -> bool:
        """Take note of the sender; False if it cannot be who it says."""
        if arrived == SELF or frame.source == NOBODY:
            return True
        if frame.source == EVERYONE or (source is not None and source.way == SELF):
            return False
        news = source is None or source.way != arrived or source.heard_at is None
        route = self.table.learn(frame.source, arrived, frame.protocol, now)
        if route is not None:
            self._refresh(route)
            if news:
                self._heard(route)
        return True

    def _refresh(self, route: Route) -> None:
        """Have the decision ready for the frames to come, if the way is one that needs no thought."""
        port = self._ports.get(route.way.link)
        known = port is not None and route.way in port.ways()
        route.decision = Decision("forward", (route.way,)) if known else None

    def _ways_to(self, target: Route) -> Collection[Way]:
        """The robot's own way, if it is there; every way of its link while nobody knows which is the robot's."""
        ways = self._ports[target.way.link].ways()
        return ways if target.way.peer is None else tuple(way for way in ways if way == target.way)

    def _everyone(self, protocol: str, arrived: Way) -> tuple[Way, ...]:
        return tuple(
            way
            for port in self._ports.values()
            if port.protocol == protocol and port.wildcard
            for way in port.ways()
            if way != arrived
        )

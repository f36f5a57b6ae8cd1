"""Where a frame goes.

`Router.route` is asked once for each frame that arrived. In order: a source that cannot be there and a
command that the policy denies are dropped, and so is a double; the source is learned; then the
destination decides. A known robot has its decision ready on its route, so the
usual frame costs three look-ups, however many robots there are; every other case is `decide`,
which changes nothing and which `why` asks too. What waited for an unknown robot is judged once more
when that is heard, by `reconsider`.
"""

from collections.abc import Callable, Collection, Hashable, Mapping
from dataclasses import dataclass, field
from typing import Final, Literal, NamedTuple

from psiu_broker.frame import EVERYONE, MESH, NOBODY, Address, Frame, Way
from psiu_broker.routing.books import Books
from psiu_broker.routing.duplicates import Duplicates
from psiu_broker.routing.guard import Guard
from psiu_broker.routing.outbox import STOP_LANE, lane
from psiu_broker.routing.ownership import Ownership
from psiu_broker.routing.policy import Policy, Rule
from psiu_broker.routing.quarantine import Quarantine
from psiu_broker.routing.table import Binding, Route, Table
from psiu_broker.routing.verdicts import (
    DENIED,
    DUPLICATE,
    LINK_DOWN,
    NO_ROUTE,
    QUARANTINED,
    REFUSED,
    SAME_WAY,
    SPOOFED,
    STORM,
    TOO_MANY_NAMES,
    Verdict,
)

SELF: Final = Way("@self")
"""The way of frames that the broker itself sends or answers."""

Action = Literal["forward", "flood", "answer", "ask", "translate", "drop"]


@dataclass(frozen=True, slots=True)
class Decision:
    """What to do with a frame.

    forward: to `hops`. flood: to `hops`, and the broker answers too. answer: it is for the broker.
    ask: unknown robot; hold the frame and ask for it on `hops`. translate: the robot speaks another
    protocol; the broker asks it in the sender's stead, or tells the sender that it cannot, for the
    reason `verdict`. drop: for the reason `verdict`.
    """

    action: Action
    hops: tuple[Way, ...] = ()
    verdict: Verdict | None = None
    void: bool = False
    """The frame is as if it had not been heard: nobody is told what it says."""
    only: Way | None = field(init=False, repr=False, compare=False)
    """The hop of a forward that has just one, as nearly every frame's has."""

    def __post_init__(self) -> None:
        single = self.action == "forward" and len(self.hops) == 1
        object.__setattr__(self, "only", self.hops[0] if single else None)


DOUBLE: Final = Decision("drop", verdict=DUPLICATE, void=True)
_TURNED_AWAY: Final[Mapping[Verdict, Decision]] = {
    verdict: Decision("drop", verdict=verdict, void=True)
    for verdict in (REFUSED, DENIED, SPOOFED, TOO_MANY_NAMES, QUARANTINED, STORM)
}
_ANSWER: Final = Decision("answer")


ANY: Final = ""
"""The protocol of a port that carries every one."""


class Port(NamedTuple):
    """What the router knows of a link that is up."""

    link: str
    protocol: str
    ways: Callable[[], Collection[Way]]
    """Every far end of the link, now."""
    wildcard: bool = True
    """Whether questions to everyone go out on it."""
    domain: str | None = None
    """Whose PSIU HEXA numbers can be asked for on it; None: nobody's."""
    new_names_per_minute: int | None = None
    """How many robots may be heard there for the first time; None: as many as there are."""


class Router:
    """Decides for each frame. Pure: told the time (seconds, any steady clock), does no I/O.

    Args:
        own: the addresses of the broker itself, with the protocol of each.
        bindings: the robots of the configuration.
        identity: a frame's bytes in one form for all links, so that a double is known by them.
        heard: called when a robot is heard for the first time or from a new way.
        withdrawn: called when the route to a robot is given up.
        ownership: who owns the robots that other brokers hear too; None where there are no others.
        plays: the links on which programs are told that the broker is some robot, whatever that speaks.
    """

    def __init__(
        self,
        own: dict[Address, str],
        bindings: tuple[Binding, ...],
        identity: Callable[[Frame], Hashable],
        heard: Callable[[Route], None] = lambda _: None,
        withdrawn: Callable[[Route], None] = lambda _: None,
        duplicates: Duplicates | None = None,
        ownership: Ownership | None = None,
        plays: Collection[str] = (),
    ) -> None:
        self.table = Table(bindings, self._gone)
        self._routes = self.table.routes
        self.books = Books(self._routes)
        for address, protocol in own.items():
            route = Route((address,), SELF, protocol, pinned=True)
            route.decision = _ANSWER
            self._routes[address] = route
        self.guard = Guard()
        self.quarantine = Quarantine()
        self.policy: Policy | None = None
        self.ports: dict[str, Port] = {}
        """The links that are up, and `MESH`."""
        self._ownership = ownership
        self._plays = frozenset(plays)
        self._identity = identity
        self._heard = heard
        self._withdrawn = withdrawn
        self._duplicates = duplicates or Duplicates()

    def obey(self, policy: Policy) -> None:
        """From now on `policy` says who may command whom.

        What the broker sends itself, and what programs want of the robot that they are played, is judged elsewhere:
        where it is a call.
        """
        policy.addresses_of = self._addresses_of
        self.policy = None if policy.idle else policy

    def route(self, frame: Frame, arrived: Way, now: float) -> Decision:
        """Decide for a frame that arrived, and learn from it."""
        routes = self._routes
        source = routes.get(frame.source)
        there = source if source is not None and source.way is arrived else None
        if there is None:
            # Before its double is looked for: what is turned away must not stand in the way of what it imitates.
            if self._is_spoofed(source, arrived):
                return self._turn_away_unless_double(frame, SPOOFED, arrived, now)
            if self.quarantine.held and self._is_held_back(frame, source, arrived, now):
                return self._turn_away_unless_double(frame, QUARANTINED, arrived, now)
        policy = self.policy
        if policy is not None and arrived is not SELF:
            rule = policy.denial(frame, arrived)
            if rule is not None and not self._is_played(frame, arrived):
                self.books.arrived(frame.source)
                return self._turn_away(frame, DENIED, arrived, now, rule)
        if self._duplicates.is_double(self._identity(frame), arrived, now, frame.subject):
            self.books.arrived(frame.source)
            return self._note_double(frame, arrived, now)
        if there is not None:
            there.heard_at = now
            there.frames += 1
        else:
            self.books.arrived(frame.source)
            wrong = self._learn(frame, source, arrived, now)
            if wrong is not None:
                return self._turn_away_noted(frame, wrong, arrived, now)
        target = routes.get(frame.destination)
        if target is not None and target.protocol == frame.protocol and target.way != arrived:
            ready: Decision | None = target.decision
            if ready is not None:
                return ready
        elif target is None and self._is_storm(frame, arrived, now):
            return self._turn_away_noted(frame, STORM, arrived, now)
        return self._decide_noted(frame, arrived)

    def sent(self, frame: Frame, now: float) -> None:
        """A frame of our own leaves without being routed: what comes round of it is a double."""
        self.books.arrived(frame.source)
        self._duplicates.is_double(self._identity(frame), SELF, now, frame.subject)

    def reconsider(self, frame: Frame, arrived: Way, now: float) -> Decision:
        """Decide anew for a frame that was let in and has waited: by now it may be known whose its addresses are."""
        if self.quarantine.held and self._is_held_back(frame, self._routes.get(frame.source), arrived, now):
            return self._turn_away(frame, QUARANTINED, arrived, now)
        rule = None if self.policy is None or arrived is SELF else self.policy.denial(frame, arrived)
        if rule is not None and not self._is_played(frame, arrived):
            return self._turn_away(frame, DENIED, arrived, now, rule)
        return self.decide(frame.destination, frame.protocol, arrived)

    def decide(self, destination: Address, protocol: str, arrived: Way) -> Decision:
        """What `route` decides for a frame of `protocol` from `arrived`, doubles aside. Changes nothing."""
        if destination == EVERYONE:
            return Decision("flood", self._everyone(protocol, arrived))
        target = self._routes.get(destination)
        if target is None:
            hops = self.elsewhere(destination, protocol, arrived)
            return Decision("ask", hops) if hops else Decision("drop", verdict=NO_ROUTE)
        if target.way == SELF:
            return _ANSWER if arrived != SELF else Decision("drop", verdict=SAME_WAY)
        translatable = self._is_translatable(protocol, target, arrived)
        if target.way.link not in self.ports:
            return Decision("translate" if translatable else "drop", verdict=LINK_DOWN)
        if target.way.link == MESH and not translatable:
            return self._decide_by_mesh(target, arrived)
        if target.protocol != protocol:
            return Decision("translate") if translatable else Decision("drop", verdict=REFUSED)
        hops = tuple(way for way in self._ways_to(target) if way != arrived)
        if hops:
            return Decision("forward", hops)
        return Decision("drop", verdict=SAME_WAY if target.way.link == arrived.link else LINK_DOWN)

    def elsewhere(self, robot: Address, protocol: str, arrived: Way) -> tuple[Way, ...]:
        """Where else than by the way that leads to it a robot may be asked for; nowhere, where its place is fixed."""
        route = self._routes.get(robot)
        if route is not None and (route.pinned or route.way != arrived):
            return ()
        return self._everyone(protocol, arrived, robot.domain if robot.is_numbered else None)

    def link_up(self, port: Port) -> None:
        self.ports[port.link] = port
        if port.new_names_per_minute is not None:
            self.guard.limit(port.link, port.new_names_per_minute)
        for route in self.table:
            if route.way.link == port.link:
                self._refresh(route)

    def link_down(self, link: str, now: float) -> None:
        """Withdraw what was learned on `link`, and let another take its place at once."""
        self.ports.pop(link, None)
        for route in self.table:
            if route.way.link == link:
                route.decision = None
        self.table.forget_link(link, now)
        self._duplicates.forget(link, now)

    def peer_lost(self, way: Way, now: float) -> None:
        """Withdraw the routes over a far end that is gone."""
        self.table.forget_way(way, now)
        for route in self.table:
            if route.way.link == way.link or (route.pinned and route.way.link in self.ports):
                self._refresh(route)

    def find(self, address: Address) -> Route | None:
        return self._routes.get(address)

    def robots(self) -> list[Route]:
        """Every robot on a link of this broker."""
        return [route for route in self.table if route.way.link not in (SELF.link, MESH)]

    def is_here(self, robot: Address) -> bool:
        """Whether the robot is on a link of ours."""
        route = self._routes.get(robot)
        return route is not None and route.way.link not in (SELF.link, MESH)

    def is_elsewhere(self, robot: Address) -> bool:
        """Whether another broker has the robot."""
        route = self._routes.get(robot)
        return route is not None and route.way.link == MESH

    def announced(
        self, addresses: tuple[Address, ...], way: Way, protocol: str, now: float, *, heard: bool = True
    ) -> None:
        """Another broker, which `way` leads to, has the robot.

        What the configuration says of it here goes before, unless the robot was `heard` there.
        """
        before = self._routes.get(addresses[0])
        way_before = None if before is None else before.way
        if way_before == SELF:
            return
        route = self.table.place(addresses, way, protocol, now, heard=heard)
        if route is not None:
            self._refresh(route)
            if route is not before and self.policy is not None:
                self.policy.forget()
            if route is not before or way_before != way:
                self._heard(route)

    def unannounced(self, robot: Address, now: float) -> None:
        """No other broker has the robot any more."""
        route = self._routes.get(robot)
        if route is not None and route.way.link == MESH and route.robot == robot:
            self.table.withdraw(route, now)
            if route.pinned:
                self._refresh(route)
                self._heard(route)

    def take(self, robot: Address, way: Way, protocol: str, heard_at: float) -> bool:
        """The robot, of which another broker was the owner, is on a link of ours, where it was overheard.

        False if it cannot be there any more.
        """
        route = self.table.learn(robot, way, protocol, heard_at) if way.link in self.ports else None
        if route is None:
            return False
        self._refresh(route)
        self._heard(route)
        return True

    def _gone(self, route: Route) -> None:
        if len(route.addresses) > 1 and self.policy is not None:
            self.policy.forget()
        self.books.departed(route)
        self._withdrawn(route)

    def _addresses_of(self, address: Address) -> tuple[Address, ...]:
        route = self._routes.get(address)
        return (address,) if route is None else route.addresses

    def _is_spoofed(self, source: Route | None, arrived: Way) -> bool:
        """Whether `source`, by the configuration, is elsewhere; what robots another broker hears, that broker knows."""
        if source is None or arrived is SELF:
            return False
        return source.way is SELF or (arrived.link != MESH and not source.may_be_on(arrived))

    def _is_held_back(self, frame: Frame, source: Route | None, arrived: Way, now: float) -> bool:
        """Whether `frame` comes in the name of a robot on another link; a stop passes, whoever says it."""
        robot = frame.source if source is None else source.robot
        if lane(frame) == STOP_LANE or not self.quarantine.holds(robot, arrived.link):
            return False
        self.quarantine.turned_away(robot, now)
        return True

    def _turn_away_unless_double(self, frame: Frame, verdict: Verdict, arrived: Way, now: float) -> Decision:
        self.books.arrived(frame.source)
        if self._duplicates.knows(self._identity(frame), arrived, now, frame.subject):
            return DOUBLE  # overheard, or come round
        return self._turn_away(frame, verdict, arrived, now)

    # What went nowhere must not make a double of what comes next with its bytes. Of what robots say to each other on
    # one radio that is left as it is, or another radio's copy would move the robot twice; a stop harms nobody twice.

    def _turn_away_noted(self, frame: Frame, verdict: Verdict, arrived: Way, now: float) -> Decision:
        self._duplicates.withdraw(self._identity(frame))
        return self._turn_away(frame, verdict, arrived, now)

    def _decide_noted(self, frame: Frame, arrived: Way) -> Decision:
        decision = self.decide(frame.destination, frame.protocol, arrived)
        if decision.action == "drop" and lane(frame) == STOP_LANE:
            self._duplicates.withdraw(self._identity(frame))
        return decision

    def _turn_away(
        self, frame: Frame, verdict: Verdict, arrived: Way, now: float, rule: Rule | None = None
    ) -> Decision:
        self.guard.refused(frame, verdict, arrived, now, rule)
        return _TURNED_AWAY[verdict]

    def _is_played(self, frame: Frame, arrived: Way) -> bool:
        """Whether a program says to a robot that it is played what becomes a call, and is judged then."""
        target = self._routes.get(frame.destination) if arrived.link in self._plays else None
        return target is not None and target.protocol != frame.protocol

    def _is_storm(self, frame: Frame, arrived: Way, now: float) -> bool:
        """Whether `frame` is one too many to everyone; of stops only one that comes close behind its equal is."""
        if frame.destination != EVERYONE or arrived is SELF or arrived.link == MESH:
            return False
        if lane(frame) == STOP_LANE:
            return not self.guard.may_stop_everyone(frame.payload, arrived, now)
        return not self.guard.may_tell_everyone(arrived.link, now)

    def _learn(self, frame: Frame, source: Route | None, arrived: Way, now: float) -> Verdict | None:
        """Take note of the sender; the verdict if it cannot be who it says, or is one too many.

        The stop of one that is turned away passes, and teaches nothing.
        """
        if arrived == SELF or frame.source == NOBODY:
            return None
        if frame.source == EVERYONE:
            return REFUSED
        if arrived.link == MESH:
            return None  # other brokers announce their robots; what these say teaches nothing
        if source is not None and source.way.link == MESH and not self._takes(source, frame, arrived, now):
            return None
        if self.quarantine.holds(frame.source if source is None else source.robot, arrived.link):
            return None  # a stop, which teaches nothing
        wrong: Verdict | None = None
        if source is None:
            if not self._may_come(frame.source, arrived, now):
                wrong = TOO_MANY_NAMES
        elif self._is_newcomer(source, arrived, now):
            wrong = QUARANTINED
        if wrong is not None:
            return None if lane(frame) == STOP_LANE else wrong
        news = source is None or source.way != arrived or source.heard_at is None
        route = self.table.learn(frame.source, arrived, frame.protocol, now)
        if route is not None:
            self._refresh(route)
            if news:
                self._heard(route)
        return None

    def _is_newcomer(self, source: Route, arrived: Way, now: float) -> bool:
        """Whether who speaks on `arrived` has but the name of a robot that is on another link of ours."""
        before = source.way.link
        if before in (arrived.link, MESH) or source.pinned:
            return False
        return self.quarantine.moved(source.robot, before, arrived.link, now) is not None

    def _may_come(self, robot: Address, arrived: Way, now: float) -> bool:
        """Whether `robot` may be known from now on; one that was there before its link went down is no news."""
        departed = self.table.departed(robot)
        return (departed is not None and departed.link == arrived.link) or self.guard.may_name(arrived.link, now)

    def _takes(self, source: Route, frame: Frame, arrived: Way, now: float) -> bool:
        """Whether a robot of another broker, heard here, is ours from now on."""
        ownership = self._ownership
        return source.may_be_on(arrived) and (ownership is None or ownership.takes(source, frame, arrived, now))

    def _note_double(self, frame: Frame, arrived: Way, now: float) -> Decision:
        """A double goes nowhere, and yet its robot was heard on the link that brought it."""
        source = self._routes.get(frame.source)
        if source is not None and arrived.link not in (MESH, SELF.link):
            if source.way == arrived:
                source.heard_at = now
            elif source.way.link == MESH and self._ownership is not None and source.may_be_on(arrived):
                self._ownership.overhear(source, frame, arrived, now)
            elif source.way.link != arrived.link and source.heard_at is not None:
                self.quarantine.both_heard(source.robot, now - source.heard_at)
        return DOUBLE

    def _is_translatable(self, protocol: str, target: Route, arrived: Way) -> bool:
        """Whether the broker asks `target` in the sender's stead: its protocol is another one, and words tell which.

        A robot of another broker is asked there; only a program that it is played to has nobody there.
        """
        if arrived.link in self._plays:
            return target.protocol != protocol
        return protocol == "psiu-ascii" and target.protocol != protocol and target.way.link != MESH

    def _decide_by_mesh(self, target: Route, arrived: Way) -> Decision:
        """For a robot of another broker: to that broker, never from one to the next."""
        if arrived.link == MESH:
            return Decision("drop", verdict=SAME_WAY)
        if self._ownership is not None and self._ownership.heard_on(target.robot) == arrived.link:
            return Decision("drop", verdict=SAME_WAY)  # it is on this very radio, and has heard the frame
        port = self.ports.get(MESH)
        if port is None or target.way not in port.ways():
            return Decision("drop", verdict=LINK_DOWN)
        return Decision("forward", (target.way,))

    def _refresh(self, route: Route) -> None:
        """Have the decision ready for the frames to come, if the way is one that needs no thought."""
        port = self.ports.get(route.way.link)
        known = port is not None and route.way.link != MESH and route.way in port.ways()
        route.decision = Decision("forward", (route.way,)) if known else None

    def _ways_to(self, target: Route) -> Collection[Way]:
        """The robot's own way, if it is there; every way of its link while nobody knows which is the robot's."""
        ways = self.ports[target.way.link].ways()
        return ways if target.way.peer is None else tuple(way for way in ways if way == target.way)

    def _everyone(self, protocol: str, arrived: Way, domain: str | None = None) -> tuple[Way, ...]:
        return tuple(
            way
            for port in self.ports.values()
            if port.protocol in (protocol, ANY) and port.wildcard and not port.link == MESH == arrived.link
            if port.domain == domain
            for way in port.ways()
            if way != arrived
        )

"""Which robots are ours to claim, and what the routes to those of other brokers follow from."""

import logging
from collections.abc import Callable, Hashable
from typing import Final

from psiu_broker.frame import MESH, Address
from psiu_broker.mesh.bus import MeshBus, NoBus
from psiu_broker.mesh.neighbour import Neighbours
from psiu_broker.routing.claims import Claim, age_of
from psiu_broker.routing.ownership import Ownership
from psiu_broker.routing.router import Router
from psiu_broker.routing.table import Route

log = logging.getLogger(__name__)

GIVEN_S: Final = 1.0
"""How long a robot that we gave up may be without an owner before we look for it again."""
ORPHANED_S: Final = 1.0
"""How long a robot whose broker is gone may be without an owner before its card is deleted."""


class Robots:
    """Keeps the router, our claims and what others claim in line with each other; `Ownership` decides.

    Args:
        own: this broker's name.
        quality: of a link, in tenths of what is heard that check out.
        orphaned: called with a robot whose broker is gone, that nobody else has, and of which it is ours to say so.
    """

    def __init__(
        self,
        own: str,
        router: Router,
        ownership: Ownership,
        neighbours: Neighbours,
        quality: Callable[[str], int],
        orphaned: Callable[[Address], None],
    ) -> None:
        self.claims = ownership.claims
        self._own = own
        self._router = router
        self._ownership = ownership
        self._neighbours = neighbours
        self._quality = quality
        self._orphaned = orphaned
        self._bus: MeshBus = NoBus()
        self._attached = False
        self._given: dict[Address, float] = {}
        self._orphans: dict[Address, tuple[str, float]] = {}
        """Robots that nobody owns any more: who did last, and until when."""

    def attach(self, bus: MeshBus) -> None:
        """Our robots are claimed on `bus`, at the latest when `set_right` is called."""
        self._bus = bus
        self._attached = True

    def detach(self) -> None:
        """The bus is gone; the other brokers follow, and then `clear`."""
        self._bus = NoBus()
        self._attached = False

    def clear(self) -> None:
        """Nobody is left who knows of our claims, or to whom to say that a robot is gone."""
        for robot in self.claims.of(self._own):
            self.claims.remove(self._own, robot)
        self._orphans.clear()

    # Of our links.

    def heard(self, route: Route, now: float) -> None:
        """A robot was heard on one of our links, for the first time or after it moved there."""
        if route.way.link != MESH and self._attached:
            self._given.pop(route.robot, None)
            self._announce(route, now, news=True)

    def gone(self, route: Route) -> None:
        """The route to a robot was withdrawn."""
        claim = self.claims.find(self._own, route.robot)
        if claim is not None:
            self._unclaim(claim)

    # Of other brokers.

    def broker_came(self, name: str, now: float) -> None:
        """No robot has its name from now on."""
        self._settle(Address.named(name), now)

    def broker_gone(self, name: str, now: float) -> None:
        for robot in self.claims.remove_broker(name):
            self._orphans[robot] = name, now
            self._settle(robot, now)

    def claimed(self, broker: str, claim: Claim, now: float) -> None:
        if self.claims.set(broker, claim):
            self._settle(claim.robot, now)

    def follow(self, broker: str, robot: Address, claim: Claim | None, now: float) -> None:
        """Bring what the broker claims of `robot` in line with `claim`, the newest that it has declared."""
        if claim is None:
            self.claims.remove(broker, robot)
            self._orphans[robot] = broker, now
        else:
            self.claims.set(broker, claim)
        self._settle(robot, now)

    def noticed(self, robot: Address, broker: str, key: Hashable, quality: int, heard_at: float, now: float) -> None:
        """The broker heard the frame `key` of a robot that may be ours, at `heard_at`, on a link of that quality."""
        route = self._router.find(robot)
        if route is not None and self.claims.find(self._own, route.robot) is not None:
            better_by = quality - self._quality(route.way.link)
            if self._ownership.noticed(route, broker, key, better_by, heard_at, now):
                self._give(route, broker, now)

    # Now and then.

    def tick(self, now: float) -> None:
        """Give and take what has moved or was left."""
        for robot, broker in list(self._ownership.due(self._router.find, now)):
            route = self._router.find(robot)
            if route is not None and self.claims.find(self._own, robot) is not None:
                self._give(route, broker, now)
        if not all(neighbour.alive(now) for neighbour in self._neighbours):
            for robot in self._ownership.abandoned(now):
                self._take(robot, now)

    def set_right(self, now: float) -> None:
        """Whatever a lost message left wrong."""
        self._ownership.expire(now)
        for robot, since in list(self._given.items()):
            if now - since > GIVEN_S:
                del self._given[robot]
                self._settle(robot, now)
        owners = {robot: broker for broker, claim in self.claims if (robot := claim.robot) not in self._given}
        owners |= {Address.named(neighbour.name): neighbour.name for neighbour in self._neighbours}
        for robot, owner in owners.items():
            found = self._router.find(robot)
            if owner != self._own and (found is None or found.way.peer != owner or found.way.link != MESH):
                self._settle(robot, now)
        for route in list(self._router.table):
            if route.way.link == MESH:
                if route.robot not in owners and route.robot not in self._given:
                    self._settle(route.robot, now)
            elif route.way.link in self._router.ports:
                self._announce(route, now)
        for robot, claim in self.claims.of(self._own).items():
            found = self._router.find(robot)
            if found is None or found.way.link == MESH:
                self._unclaim(claim)
        self._tell_orphans(now)

    # Inside.

    def _settle(self, robot: Address, now: float) -> None:
        """Bring the route to `robot` in line with who claims it."""
        namesake = self._neighbours.find(str(robot))
        if namesake is not None:  # a robot cannot be a broker
            self._router.announced((robot,), namesake.way, "psiu-ascii", now)
            return
        held = self.claims.owner(robot)
        if held is None:
            if not self._take(robot, now) and robot not in self._given:
                self._router.unannounced(robot, now)
            return
        owner, claim = held
        if owner == self._own:
            return
        self._given.pop(robot, None)
        self._orphans.pop(robot, None)
        mine = self.claims.find(self._own, robot)
        if mine is not None:
            self._unclaim(mine)
        self._ownership.forget(robot)
        neighbour = self._neighbours.find(owner)
        if neighbour is not None:
            heard = claim.age_s is not None
            self._router.announced(claim.addresses, neighbour.way, claim.protocol, now, heard=heard)

    def _take(self, robot: Address, now: float) -> bool:
        """Take a robot that we overheard of late."""
        known = self._ownership.recent(robot, now)
        self._ownership.overheard.pop(robot, None)
        return known is not None and self._router.take(robot, known.way, known.protocol, known.at)

    def _give(self, route: Route, broker: str, now: float) -> None:
        """Give up a robot that moved to another broker, which takes it when it sees that."""
        robot = route.robot
        mine = self.claims.find(self._own, robot)
        neighbour = self._neighbours.find(broker)
        if mine is None or neighbour is None:
            return
        log.info("mesh: %s goes to %s", robot, broker)
        self._unclaim(mine)
        self._ownership.remember(route)
        self._given[robot] = now
        self._router.announced(route.addresses, neighbour.way, route.protocol, now)

    def _announce(self, route: Route, now: float, *, news: bool = False) -> None:
        """Claim a robot of one of our links, or renew the claim where it has changed."""
        robot = route.robot
        mine = self.claims.find(self._own, robot)
        held = self.claims.owner(robot)
        if not self._attached or robot in self._given:
            return
        taken = held is not None and held[0] != self._own
        if taken and not news:
            return
        heard = route.heard_at is not None
        term = mine.term if mine is not None and (mine.term > 0 or not heard) else 0
        if heard and (term == 0 or taken):
            term = self.claims.next_term(robot)
        quality = self._quality(route.way.link)
        if mine is not None and abs(quality - mine.quality) < 2:
            quality = mine.quality
        number = next((each for each in route.addresses[1:] if each.is_numbered), None)
        age_s = age_of(route.heard_at, now)
        claim = Claim(robot, number, route.protocol, route.way.link, term, quality, age_s)
        if claim == mine:
            return
        self.claims.set(self._own, claim)
        self._bus.claim(claim)
        if mine is not None:
            self._bus.withdraw(mine)

    def _unclaim(self, claim: Claim) -> None:
        self.claims.remove(self._own, claim.robot)
        self._bus.withdraw(claim)

    def _tell_orphans(self, now: float) -> None:
        """One of the brokers that are left says that a robot is gone with its broker."""
        for robot, (owner, since) in list(self._orphans.items()):
            if now - since > ORPHANED_S:
                del self._orphans[robot]
                first = all(self._own < neighbour.name for neighbour in self._neighbours)
                gone = self._neighbours.find(owner) is None
                if first and gone and self.claims.owner(robot) is None and self._router.find(robot) is None:
                    self._orphaned(robot)

"""The broker: puts the parts together, starts them, watches them, and stops them.

What is wired to what:

    Link, Mesh   -- a frame -->                          Exchange
    Exchange     -- where to? -->                        Router       -- whose robot is it? -->  Ownership
    Exchange     -- for us, or in another protocol -->   Resident
    Exchange     -- what robots say -->                  Bus.publisher
    Router       -- a robot came, or went -->            Broker       -->  codecs' directories, Mesh, Resident, cards
    Ownership    -- heard a robot of another broker -->  Broker       -->  Mesh
    Bus          -- a call -->                           Broker       -->  Resident
    Bus          -- a trace -->                          Broker       -->  Tracing  -->  Resident, or Bus.traces
    Bus          -- a question -->                       Broker       -->  Report
"""

import asyncio
import logging
import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from psiu_broker import __version__
from psiu_broker.bus.bus import Bus
from psiu_broker.codecs.directories import Directories
from psiu_broker.codecs.identity import identity
from psiu_broker.codecs.paced import PacedCodec
from psiu_broker.codecs.psiu_hexa import PsiuHexa
from psiu_broker.config import Configuration, LinkConfiguration
from psiu_broker.config.policies import policy_of
from psiu_broker.config.shown import shown
from psiu_broker.config.who import bindings, ends, own_addresses, rests_of
from psiu_broker.errors import BusError, CallError
from psiu_broker.exchange import Exchange, NoBus
from psiu_broker.frame import MESH, Address, Frame, Way
from psiu_broker.hold_off import LastAlive
from psiu_broker.link import Link
from psiu_broker.mesh.mesh import MAX_AGE_S, Mesh
from psiu_broker.mesh.neighbour import Neighbours
from psiu_broker.mesh.probe import Probed
from psiu_broker.mesh.quality import Qualities
from psiu_broker.messages import (
    Answer,
    CallRequest,
    Card,
    Conflict,
    Health,
    Ledger,
    RobotAccount,
    Route,
    Status,
    Trace,
    Why,
)
from psiu_broker.messages import Link as LinkMessage
from psiu_broker.messages import Mesh as MeshMessage
from psiu_broker.messages import Trunk as TrunkMessage
from psiu_broker.paced_link import PacedLink
from psiu_broker.profiles import Description
from psiu_broker.protocols import CODECS
from psiu_broker.pulse import Pulse
from psiu_broker.report import Report
from psiu_broker.resident import DISCOVER, Resident
from psiu_broker.routing import table
from psiu_broker.routing.duplicates import Duplicates
from psiu_broker.routing.outbox import is_stop
from psiu_broker.routing.ownership import Ownership
from psiu_broker.routing.router import SELF, Router
from psiu_broker.routing.verdicts import Verdict
from psiu_broker.tracing import Tracing
from psiu_broker.trunk import Trunks

log = logging.getLogger(__name__)

TICK_S: Final = 0.1
"""How often what is too late is dropped and cards that changed are put."""
SETTLING_S: Final = 0.3
LOOK_AROUND_S: Final = 2.0
ALIVE_EVERY_S: Final = 0.25
DOUBLES_MARGIN_S: Final = 2.0
"""A frame may wait its age limit in an outbox, and this long elsewhere, before its double is no longer known."""
DRAIN_S: Final = 1.0
"""How long a stopping broker lets its outboxes empty."""
REOPEN_S: Final = 2.0
ROUND_TRIP_S: Final = 2.0


class Broker:
    """One broker. `start`, then `stop`; what programs ask of it in between comes by the bus."""

    def __init__(self, configuration: Configuration) -> None:
        self.configuration = configuration
        self.started = time.time()
        name = configuration.broker.name
        self._directories = Directories()
        options = [link.options for link in configuration.links.values()]
        duplicates = Duplicates(
            max((each.max_age_s for each in options), default=0.0) + DOUBLES_MARGIN_S,
            question_s=max((each.question_max_age_s for each in options), default=0.0) + DOUBLES_MARGIN_S,
        )
        neighbours = Neighbours()
        self._ownership = Ownership(name, neighbours.alive, duplicates.heard_here, self._heard_of_another)
        router = Router(
            own_addresses(configuration),
            bindings(configuration),
            identity,
            self._robot_heard,
            self._robot_gone,
            duplicates,
            self._ownership,
            [link.name for link in configuration.links.values() if link.options.plays is not None],
        )
        self.exchange = Exchange(Address.named(name), router)
        router.obey(policy_of(configuration, lambda way: self.exchange.links[way.link].is_named(way.peer)))
        self._qualities = Qualities()
        self.mesh = Mesh(name, self, router, self._ownership, neighbours, self._qualities.of, identity)
        self.exchange.join(self.mesh, MAX_AGE_S)
        self.resident = self.exchange.resident = Resident(configuration, self.exchange)
        self.resident.settling(lambda: SETTLING_S if neighbours.ways else 0.0)
        self.programs = self.resident.failsafe
        self.tracing = Tracing(name, self.exchange, self.resident.call, self._broker_of)
        self._trunks = Trunks(name, configuration.trunks.values())
        self.report = Report(name, self.exchange, self.resident.commands, self._trunks)
        for link in configuration.links.values():
            self.exchange.add(self._link(link))
        self._directories.add((Address.named(name),))
        for route in router.robots():
            self._directories.add(route.addresses)
        self._last_alive = LastAlive(name) if configuration.mesh.mode == "router" else None
        self._changed: dict[Address, table.Route] = {}
        self._seen: dict[str, float] = {}
        self._conflicts: set[tuple[str, ...]] = set()
        self._pulse = Pulse(time.monotonic())
        self._bus: Bus | None = None
        self._bus_lost = asyncio.Event()
        self._tasks: list[asyncio.Task[None]] = []
        self._link_tasks: list[asyncio.Task[None]] = []

    async def start(self) -> None:
        """Open the bus and begin to open the links; returns when the core runs, whatever the links do.

        Raises:
            BusError: the bus cannot open: an endpoint in `zenoh.listen` is taken or not ours.
        """
        try:
            if self._last_alive is not None:
                rest_s = await self._last_alive.hold_off()
                if rest_s:
                    log.info("waited %.1f s: routers forget a broker that was there a moment ago", rest_s)
            await self._open_bus()
        except BaseException:
            self._trunks.close()
            raise
        self._pulse = Pulse(time.monotonic())
        create = asyncio.get_running_loop().create_task
        self._tasks = [
            create(self._tick(), name="tick"),
            create(self._look_around(), name="look around"),
            create(self._keep_bus(), name="bus"),
        ]
        if self._last_alive is not None:
            self._tasks.append(create(self._note_life(self._last_alive), name="last alive"))
        kept = (*self.exchange.links.values(), *self._trunks)
        self._link_tasks = [create(each.run(), name=f"{each.kind} {each.name}") for each in kept]

    async def stop(self) -> None:
        """Refuse new calls, stop robots that are to be, let what waits go out, close the links, then the bus."""
        # At once: programs that do not read their replies must not hold up what stops robots.
        for trouble in await asyncio.gather(self._retire_bus(), self.resident.close(), return_exceptions=True):
            if isinstance(trouble, Exception):
                log.error("stopping all the same", exc_info=trouble)
        try:
            async with asyncio.timeout(DRAIN_S):
                await asyncio.gather(*(link.drained() for link in self.exchange.links.values()))
        except TimeoutError:
            log.warning("stopping with frames still waiting; they are dropped")
        for task in (*self._link_tasks, *self._tasks):
            task.cancel()
        await asyncio.gather(*self._link_tasks, *self._tasks, return_exceptions=True)
        if self._bus is not None:
            self.exchange.bus = NoBus()
            self._bus.publisher.withdraw_cards()
            await self._bus.session.close()
        self._trunks.close()

    async def healthy(self) -> bool:
        """Whether everything makes progress: the loop's ticks, every link's life, and the bus, asked through Zenoh."""
        return (await self._health()).healthy

    # bus.Served

    def status(self) -> Status:
        links = self.exchange.links.values()
        bus = self._bus
        return Status(
            broker=self.configuration.broker.name,
            version=__version__,
            started=self.report.moment(time.monotonic() - (time.time() - self.started)),
            uptime_s=round(time.time() - self.started, 3),
            links_open=sum(link.state == "open" for link in links),
            links=len(links),
            robots=len(self.exchange.router.robots()),
            zenoh_id=bus.session.zenoh_id if bus else "",
            listen=list(self.configuration.zenoh.listen),
            published=bus.publisher.puts if bus else 0,
            unpublished=bus.publisher.failures if bus else 0,
            tasks=len(asyncio.all_tasks()),
            refused_puts=bus.calls.refused_puts if bus else 0,
        )

    def links(self) -> Sequence[LinkMessage]:
        return self.report.links()

    def trunks(self) -> Sequence[TrunkMessage]:
        return self.report.trunks()

    def routes(self) -> Sequence[Route]:
        return self.report.routes()

    def ledger(self) -> Ledger:
        return self.report.ledger()

    def robot_accounts(self) -> Sequence[RobotAccount]:
        return self.report.robot_accounts()

    def health(self) -> Health:
        checks = self._checks()
        return Health(healthy=all(checks.values()), checks=checks)

    def config(self) -> Mapping[str, Any]:
        return shown(self.configuration)

    def mesh_seen(self) -> MeshMessage:
        mode, bus = self.configuration.mesh.mode, self._bus
        if bus is None:
            return self.report.mesh(self.mesh, mode)
        return self.report.mesh(self.mesh, mode, bus.session.zenoh_id, bus.mesh.linked, bus.mesh.unreadable)

    def conflicts(self) -> Sequence[Conflict]:
        return self.report.conflicts(self.mesh)

    def why(self, a: Address, b: Address) -> Why:
        return self.report.why(a, b)

    def release(self, robot: Address, link: str) -> bool:
        """Hold the robot on that link back no longer; False if it is not."""
        route = self.exchange.router.find(robot)
        return self.exchange.router.quarantine.release(robot if route is None else route.robot, link)

    def robots(self) -> Iterable[Address]:
        return [route.robot for route in self.exchange.router.robots()]

    def card(self, robot: Address) -> Card | None:
        route = self.exchange.router.find(robot)
        return None if route is None or route.way.link in (SELF.link, MESH) else self.report.card(route)

    def cards(self) -> Mapping[Address, Card]:
        return self.report.cards()

    def describe(self, frame: Frame) -> Description:
        return self.resident.describe(frame)

    async def call(self, robot: Address, command: str, request: CallRequest) -> Answer | None:
        """None: another broker has the robot, and answers."""
        if self._is_elsewhere(robot):
            return None
        self._refuse_what_is_stale(command)
        try:
            answer = await self.resident.call(robot, command, request)
        except CallError as error:
            if error.code == "unknown_robot" and self._is_elsewhere(robot):
                return None
            raise
        self._note(self.exchange.router.robots() if command == DISCOVER else ())
        return answer

    async def send(self, robot: Address, command: str, request: CallRequest) -> None:
        if not self._is_elsewhere(robot):
            self._refuse_what_is_stale(command)
            await self.resident.tell(robot, command, request)

    async def trace(self, a: Address, b: Address) -> Trace | None:
        """None: `a` is not here."""
        if self._bus is None or self.exchange.router.find(a) is None or self._is_elsewhere(a):
            return None
        return await self.tracing.trace(a, b, self._bus.traces.probe)

    async def probed(self, robot: Address) -> Probed:
        return await self.tracing.probed(robot)

    def _refuse_what_is_stale(self, command: str) -> None:
        """Raise CallError for what came while the broker stood still: nobody knows how long it waited."""
        if self._pulse.stale(time.monotonic()) and not is_stop(command):
            raise CallError("expired", "the broker stood still for a while; nothing was sent")

    def _is_elsewhere(self, robot: Address) -> bool:
        """Whether another broker has the robot, and its calls."""
        route = self.exchange.router.find(robot)
        if route is None or route.way == SELF:
            return False
        return route.way.link == MESH or self._ownership.owner(route.robot) not in (
            None,
            self.configuration.broker.name,
        )

    def _broker_of(self, zenoh_id: str) -> str:
        """The broker with that Zenoh id; the id where there is none."""
        known = (each.name for each in self.mesh.neighbours if each.zenoh_id.lstrip("0") == zenoh_id)
        return next(known, zenoh_id)

    # mesh.Hub

    def relayed(self, frame: Frame, way: Way, now: float, age_s: float) -> Verdict | None:
        return self.exchange.relayed(frame, way, now, age_s)

    def relay_dropped(self, verdict: Verdict) -> None:
        self.exchange.relay_dropped(verdict)

    def neighbour_came(self, name: str) -> None:
        """Those who listen there may have been told that our robots are gone."""
        if self._bus is not None:
            self._bus.publisher.forget_cards()
        self._note(self.exchange.router.robots())

    def orphaned(self, robot: Address) -> None:
        if self._bus is not None:
            self._bus.publisher.delete_card(robot)

    # Inside: robots come and go.

    def _note(self, routes: Iterable[table.Route]) -> None:
        """Their cards may have changed."""
        self._changed.update({route.robot: route for route in routes})

    def _robot_heard(self, route: table.Route) -> None:
        self._directories.add(route.addresses)
        if route.way.link != MESH:
            self._changed[route.robot] = route
            self.mesh.robot_heard(route, time.monotonic())
        else:
            self._changed.pop(route.robot, None)
            if self._bus is not None:
                self._bus.publisher.forget_card(route.robot)
        self.resident.robot_heard(route)
        for address in route.addresses:
            self.exchange.release(address, time.monotonic())

    def _robot_gone(self, route: table.Route) -> None:
        self._changed.pop(route.robot, None)
        self.mesh.robot_gone(route)
        self.resident.robot_gone(route)
        self._directories.remove(route.addresses)
        if self._bus is not None:
            self._bus.publisher.withdraw_card(route.robot)

    def _heard_of_another(self, owner: str, frame: Frame, way: Way) -> None:
        self.mesh.notify(owner, frame, way, time.monotonic())

    # Inside: putting together.

    def _link(self, configuration: LinkConfiguration) -> Link:
        options = configuration.codec
        domain = options.domain if isinstance(options, PsiuHexa.Options) else ""
        codec = CODECS[configuration.protocol]
        directory = self._directories.of(domain)
        there = ends(self.configuration, configuration)
        if issubclass(codec, PacedCodec):
            rests = rests_of(self.configuration, configuration)
            return PacedLink(configuration, lambda: codec(options, directory), self.exchange, rests=rests, ends=there)
        return Link(
            configuration,
            lambda: codec(options, directory, datagrams=configuration.adapter.datagrams),
            self.exchange,
            unaddressed=isinstance(options, PsiuHexa.Options) and options.topology != "ad-hoc",
            ends=there,
        )

    # Inside: the bus, opened and kept open.

    async def _retire_bus(self) -> None:
        for task in self._tasks:
            if task.get_name() == "bus":
                # Else it might open another session meanwhile, of which nobody takes leave.
                task.cancel()
                await asyncio.gather(task, return_exceptions=True)
        if self._bus is not None:
            await self._bus.retire()

    async def _open_bus(self) -> None:
        self._bus = await Bus.open(self.configuration, self, self._bus_lost.set, *self._trunks.meet())
        self.exchange.bus = self._bus.publisher
        self._note(self.exchange.router.robots())

    async def _keep_bus(self) -> None:
        """Open another session when Zenoh lost the one we had."""
        while True:
            await self._bus_lost.wait()
            self.exchange.bus = NoBus()
            self.programs.programs_unsure()  # nobody would tell of those that go until the bus is back
            lost, self._bus = self._bus, None
            try:
                if lost is not None:
                    await lost.close()
                self._bus_lost.clear()
                await self._open_bus()
            except Exception as error:  # whatever it is, the bus must come back
                trouble = error if isinstance(error, BusError) else repr(error)
                log.warning("the bus cannot be opened again: %s; trying on", trouble)
                self._bus_lost.set()
                await asyncio.sleep(REOPEN_S)

    # Inside: what goes on by the clock.

    async def _tick(self) -> None:
        while True:
            try:
                self._look_after(time.monotonic())
            except Exception:  # whatever is wrong with one robot's card must not stop the clock of all
                log.exception("a tick failed")
            await asyncio.sleep(TICK_S)

    async def _look_around(self) -> None:
        """See whom Zenoh has a link to."""
        while True:
            if self._bus is not None:
                await self._bus.mesh.look()
            await asyncio.sleep(LOOK_AROUND_S)

    async def _note_life(self, alive: LastAlive) -> None:
        while True:
            alive.note()
            await asyncio.sleep(ALIVE_EVERY_S)

    def _look_after(self, now: float) -> None:
        """Drop what is too late, and put the cards that changed."""
        stood_still_s = self._pulse.beat(now)
        if stood_still_s:
            log.warning("stood still for %.1f s; calls that came meanwhile are refused", stood_still_s)
        self.exchange.expire(now)
        self.resident.failsafe.tick(now)
        for link in self.exchange.links.values():
            self._qualities.count(link.name, link.frames_in, link.malformed)
            if self._seen.get(link.name) != link.since:
                self._seen[link.name] = link.since
                self._note(route for route in self.exchange.router.robots() if route.way.link == link.name)
        self.mesh.tick(now)
        self._alarm()
        if self._bus is not None:
            for robot in tuple(self._changed):
                route = self._changed.pop(robot)  # first: one that cannot be told must not be in the way of the others
                self._bus.publisher.publish_card(route.robot, self.report.card(route))

    def _alarm(self) -> None:
        """Say aloud, once, which names are not one robot's."""
        conflicts = self.conflicts()
        now = {(each.robot, *each.brokers, *each.held_back): each for each in conflicts}
        if now.keys() == self._conflicts:
            return
        for key in now.keys() - self._conflicts:
            log.warning("more than one is called %s: %s", now[key].robot, now[key].detail)
        for name, *_ in self._conflicts - now.keys():
            log.info("%s: what was said of its name is no longer so", name)
        self._conflicts = set(now)
        if self._bus is not None:
            self._bus.publisher.publish_conflicts(conflicts)

    def _checks(self) -> dict[str, bool]:
        links = {task.get_name(): not task.done() for task in self._link_tasks}
        return {
            "loop": self._pulse.since_s(time.monotonic()) < 10 * TICK_S + ROUND_TRIP_S,
            "bus": self._bus is not None and not self._bus.session.is_lost,
            "ledger": self.report.ledger().balances,
            **links,
        }

    async def _health(self) -> Health:
        checks = self._checks()
        try:
            checks["zenoh round trip"] = (
                self._bus is not None and await self._bus.round_trip.measure(ROUND_TRIP_S) < ROUND_TRIP_S
            )
        except BusError as error:
            log.warning("health: %s", error)
            checks["zenoh round trip"] = False
        if not all(checks.values()):
            log.error("not healthy: %s", ", ".join(name for name, good in checks.items() if not good))
        return Health(healthy=all(checks.values()), checks=checks)

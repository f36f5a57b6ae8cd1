"""A mesh of brokers in one process: the real routing and mesh code, a network of lists, and time told by the test.

Tokens behave as Zenoh's do: they come in their order, they go at once with a session that was killed, and after
`LEASE_S` where the way to it is cut; whoever comes (back) into sight is told what stands and what went meanwhile.
"""

import heapq
import random
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from itertools import combinations, count
from typing import Final, NamedTuple

from balanced import assert_balanced
from memory_adapter import MemoryAdapter, MemoryTransport, codec_of, configuration

from psiu_broker.codecs import psiu_ascii
from psiu_broker.codecs.identity import identity
from psiu_broker.exchange import Exchange
from psiu_broker.frame import MESH, Address, Frame, Malformed, Way
from psiu_broker.link import Link
from psiu_broker.mesh.beat import Beat, Notice
from psiu_broker.mesh.mesh import MAX_AGE_S, Mesh
from psiu_broker.mesh.neighbour import Neighbours
from psiu_broker.messages import RawFrame
from psiu_broker.routing.claims import Claim
from psiu_broker.routing.duplicates import Duplicates
from psiu_broker.routing.ownership import Ownership
from psiu_broker.routing.router import Router
from psiu_broker.routing.table import Binding, Route
from psiu_broker.routing.verdicts import REFUSED, Verdict

TICK_S: Final = 0.1
LEASE_S: Final = 2.0
RECONNECT_S: Final = 0.1
RADIO, WIFI = "radio", "wifi"

ENCODE: Final = codec_of(configuration()).encode


def wire(source: str, destination: str, *words: str) -> bytes:
    return ENCODE(psiu_ascii.message(Address.named(source), Address.named(destination), *words))


class Token(NamedTuple):
    """What one session has declared; `claim` is None for the broker's own presence."""

    broker: str
    epoch: int
    zenoh_id: str
    edition: int
    claim: Claim | None


class Session:
    """Implements `mesh.MeshBus` for one life of one broker."""

    linked = ()
    refuses = False
    """It takes no frame."""

    def __init__(self, simulation: "Simulation", name: str, serial: int) -> None:
        self.zenoh_id = f"{name}-{serial}"
        self.tokens: dict[Claim | None, Token] = {}
        self._simulation = simulation
        self._name = name
        self._epoch = 0
        self._edition = 0

    def put_frame(self, to: str, lane: int, data: bytes) -> bool:
        if self.refuses:
            return False
        self._simulation.frames.append((self._name, to, lane, data))
        self._simulation.taken[self._name, self._epoch] += 1
        self._simulation.put_frame(self._name, to, lane, data)
        return True

    def put_beat(self, beat: Beat) -> None:
        self._simulation.beat = beat
        for to in self._simulation.others(self._name):
            self._simulation.send(
                "beat", self._name, to, lambda it: it.dispatch(lambda: it.mesh.beat_came(beat, it.now))
            )

    def put_notice(self, to: str, notice: Notice) -> None:
        self._simulation.send(
            "notice", self._name, to, lambda it: it.dispatch(lambda: it.mesh.notice_came(notice, it.now))
        )

    def announce(self, epoch: int) -> None:
        self._epoch = epoch
        self._declare(None)

    def claim(self, claim: Claim) -> None:
        if claim not in self.tokens:
            self._declare(claim)

    def withdraw(self, claim: Claim) -> None:
        token = self.tokens.pop(claim, None)
        if token is not None:
            self._simulation.tell_all("untoken", token)

    def declare_anew(self) -> None:
        self._edition += 1
        old, self.tokens = self.tokens, {}
        for claim in old:
            self._declare(claim)
        for token in old.values():
            self._simulation.tell_all("untoken", token)

    def hang_up(self, zenoh_id: str | None) -> None:
        """New connections bring all declarations with them."""
        self.declare_anew()

    def _declare(self, claim: Claim | None) -> None:
        token = self.tokens[claim] = Token(self._name, self._epoch, self.zenoh_id, self._edition, claim)
        self._simulation.tell_all("token", token)


class Antenna(MemoryTransport):
    """The far end of a link: what was written to it, and when."""

    def __init__(self, station: "Station") -> None:
        super().__init__()
        self._station = station
        self.times: list[float] = []

    def write(self, data: bytes, peer: object) -> bool:
        self.times.append(self._station.simulation.now)
        return super().write(data, peer)


class Alarm:
    """A timer on the clock of the simulation."""

    def __init__(self, call: Callable[[], None]) -> None:
        self._call = call
        self._cancelled = False

    def cancel(self) -> None:
        self._cancelled = True

    def ring(self) -> None:
        if not self._cancelled:
            self._call()


class Station:
    """One life of a broker: its exchange and mesh, and links whose far ends are lists. Is its own bus and resident."""

    listened = True
    raw_listened = False

    def __init__(
        self,
        simulation: "Simulation",
        name: str,
        bindings: tuple[Binding, ...],
        links: Sequence[str],
        clock_s: float,
        options: Mapping[str, object],
    ) -> None:
        self.simulation = simulation
        self.name = name
        self.alive = True
        self.stopped = False
        self.waiting: list[Callable[[], None]] = []
        """What comes while it is stopped."""
        self.published: list[Frame] = []
        self.answered: list[Frame] = []
        self.orphans: list[Address] = []
        self.quality: dict[str, int] = {}
        self.seen: set[Token] = set()
        """The tokens of others, as the network has told of them."""
        self._clock_s = clock_s
        duplicates = Duplicates(4.0)
        self.neighbours = Neighbours()
        self.ownership = Ownership(name, self.neighbours.alive, duplicates.heard_here, self._overheard)
        own = Address.named(name)
        self.router = Router(
            {own: "psiu-ascii"}, bindings, identity, self._heard, self._gone, duplicates, self.ownership
        )
        self.exchange = Exchange(own, self.router)
        self.exchange.bus = self
        self.exchange.resident = self
        self.mesh = Mesh(
            name, self, self.router, self.ownership, self.neighbours, lambda link: self.quality.get(link, 10), identity
        )
        self.exchange.join(self.mesh, MAX_AGE_S)
        self.antennas: dict[str, Antenna] = {}
        for link in links:
            made = configuration(link, adapter=MemoryAdapter(), **{"route_age_s": 300.0, **options})
            self.exchange.add(
                Link(
                    made, lambda made=made: codec_of(made), self.exchange, clock=lambda: self.now, call_at=self.call_at
                )  # type: ignore[misc]
            )
            self.plug(link)

    @property
    def now(self) -> float:
        return self.simulation.now + self._clock_s

    def call_at(self, when: float, call: Callable[[], None]) -> "Alarm":
        alarm = Alarm(call)
        self.simulation.after(when - self.now, lambda: self.dispatch(alarm.ring))
        return alarm

    def plug(self, link: str) -> None:
        self.antennas[link] = Antenna(self)
        self.exchange.links[link].connected(self.antennas[link])

    def unplug(self, link: str) -> None:
        self.exchange.links[link]._down("unplugged")

    def owner(self, robot: str) -> str | None:
        return self.ownership.owner(Address.named(robot))

    def route(self, robot: str) -> Route | None:
        return self.router.find(Address.named(robot))

    def tick(self) -> None:
        self.exchange.expire(self.now)
        self.mesh.tick(self.now)

    def told(self, kind: str, token: Token) -> None:
        """The network tells of a token, once each way; the broker hears of it when it is not stopped."""
        if (token in self.seen) is (kind == "token"):
            return
        name, epoch, zenoh_id, edition, claim = token
        mesh = self.mesh
        if kind == "token":
            self.seen.add(token)
            if claim is None:
                self.dispatch(lambda: mesh.broker_came(name, epoch, zenoh_id, str(edition), self.now))
            else:
                self.dispatch(lambda: mesh.claimed(name, epoch, claim, self.now))
        else:
            self.seen.remove(token)
            if claim is None:
                self.dispatch(lambda: mesh.broker_went(name, epoch, str(edition), self.now))
            else:
                self.dispatch(lambda: mesh.unclaimed(name, epoch, claim, self.now))

    def dispatch(self, event: Callable[[], None]) -> None:
        """Have it happen, once the broker is not stopped."""
        if self.stopped:
            self.waiting.append(event)
        else:
            event()

    # The router's and the ownership's ears, as in Broker.

    def _heard(self, route: Route) -> None:
        if route.way.link != MESH:
            self.mesh.robot_heard(route, self.now)
        for address in route.addresses:
            self.exchange.release(address, self.now)

    def _gone(self, route: Route) -> None:
        self.mesh.robot_gone(route)

    def _overheard(self, owner: str, frame: Frame, way: Way) -> None:
        self.mesh.notify(owner, frame, way, self.now)

    # mesh.Hub

    def relayed(self, frame: Frame, way: Way, now: float, age_s: float) -> object:
        return self.exchange.relayed(frame, way, now, age_s)

    def relay_dropped(self, verdict: Verdict) -> None:
        self.exchange.relay_dropped(verdict)

    def neighbour_came(self, name: str) -> None: ...

    def orphaned(self, robot: Address) -> None:
        self.orphans.append(robot)

    # exchange.Bus

    def publish(self, frame: Frame, way: Way, received: float) -> None:
        if str(frame.source) != self.name:
            self.published.append(frame)

    def tapped(self, link: str) -> bool:
        return False

    def publish_raw(self, raw: RawFrame) -> None: ...

    # exchange.Resident

    def answer(self, frame: Frame, way: Way, now: float) -> None:
        self.answered.append(frame)

    def translate(self, frame: Frame, way: Way, now: float) -> Verdict:
        return REFUSED

    def malformed(self, malformed: Malformed, way: Way, now: float) -> None: ...
    def asked_names(self, ways: Iterable[Way], now: float) -> None: ...
    def delivered(self, frame: Frame, now: float) -> None: ...
    def undelivered(self, frame: Frame, verdict: Verdict) -> None: ...
    def link_opened(self, link: Link, now: float) -> None: ...
    def link_closed(self, link: Link, now: float) -> None: ...
    def peer_came(self, way: Way, now: float) -> None: ...
    def peer_lost(self, way: Way, now: float) -> None: ...


class Simulation:
    """Brokers, all of which reach each other until the test cuts something.

    `loses` may be set: called with the kind of a message ("frame", "beat", "notice", "token",
    "untoken"), who sends it and to whom; True loses it.
    """

    def __init__(
        self,
        names: Iterable[str],
        *,
        seed: int = 0,
        delay_s: float = 0.005,
        bindings: dict[str, tuple[Binding, ...]] | None = None,
        links: Sequence[str] = (RADIO, WIFI),
        clocks_apart: bool = True,
        options: Mapping[str, object] | None = None,
    ) -> None:
        """`options` are those of every link, where they are not the usual ones."""
        self.now = 1000.0
        self.loses: Callable[[str, str, str], bool] = lambda *_: False
        self.delay_of: dict[str, float] = {}
        """By kind of message, where it is not `delay_s`."""
        self.sent: Counter[str] = Counter()
        """Messages by their kind, once for each broker that they go to."""
        self.lost: Counter[str] = Counter()
        """Those of them that never came."""
        self.beat: Beat | None = None
        """The last one."""
        self.frames: deque[tuple[str, str, int, bytes]] = deque(maxlen=32)
        """The last ones: from whom, to whom, their lane and their envelope."""
        self.taken: Counter[tuple[str, int]] = Counter()
        """Frames that the bus took, by broker and its life."""
        self.stations: dict[str, Station] = {}
        self.former: list[Station] = []
        self.bindings = bindings or {}
        self._delay_s = delay_s
        self._links = links
        self._random = random.Random(seed)
        self._clocks_apart = clocks_apart
        self._options = options or {}
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._order = count()
        self._sessions: dict[str, Session] = {}
        self._cut: set[frozenset[str]] = set()
        self._latest: dict[tuple[str, str, str], float] = {}
        self._serial = count(1)
        for name in names:
            self.start(name)

    # What happens to brokers and the network.

    def start(self, name: str) -> Station:
        clock_s = self._random.uniform(-500, 5000) if self._clocks_apart else 0.0
        station = self.stations[name] = Station(
            self, name, self.bindings.get(name, ()), self._links, clock_s, self._options
        )
        session = self._sessions[name] = Session(self, name, next(self._serial))
        station.mesh.attach(session, station.now)
        for other in self.others(name):
            self._reconcile_later(name, other, self._delay_s)
        self._tick_later(station, self._random.uniform(0, TICK_S))
        return station

    def kill(self, name: str) -> None:
        """SIGKILL: the others are told at once, where they are not cut off."""
        station = self.stations.pop(name)
        station.alive = False
        self.former.append(station)
        session = self._sessions.pop(name)
        for token in session.tokens.values():
            self.tell_all("untoken", token, surely=True)

    def leave(self, name: str) -> None:
        """A broker stops as it should."""
        self.stations[name].mesh.detach(self.stations[name].now)
        self.kill(name)

    def reopen(self, name: str) -> None:
        """The session of a broker is lost, and another is opened."""
        station = self.stations[name]
        station.mesh.detach(station.now)
        for token in self._sessions[name].tokens.values():
            self.tell_all("untoken", token, surely=True)
        station.seen.clear()
        session = self._sessions[name] = Session(self, name, next(self._serial))
        station.mesh.attach(session, station.now)
        for other in self.others(name):
            self._reconcile_later(name, other, self._delay_s)

    def stop(self, name: str) -> None:
        """SIGSTOP."""
        self.stations[name].stopped = True

    def resume(self, name: str) -> None:
        station = self.stations[name]
        station.stopped = False
        backlog, station.waiting = station.waiting, []
        for event in backlog:
            event()

    def cut(self, *pairs: tuple[str, str]) -> None:
        """Nothing passes between each of these pairs any more, and nobody is told."""
        for pair in pairs:
            key = frozenset(pair)
            if key not in self._cut:
                self._cut.add(key)
                self.after(LEASE_S, lambda key=key: self._expire_lease(key))  # type: ignore[misc]

    def partition(self, *groups: Collection[str]) -> None:
        """Only those in one group reach each other."""
        for one, other in combinations(groups, 2):
            self.cut(*((a, b) for a in one for b in other))

    def heal(self) -> None:
        for pair in list(self._cut):
            self._cut.remove(pair)
            a, b = pair
            self._reconcile_later(a, b, RECONNECT_S)

    def says(self, robot: str, at: Iterable[str], to: str, *words: str, link: str = RADIO) -> bytes:
        """`robot` puts a frame on the radio of the brokers `at`; its bytes."""
        data = wire(robot, to, *words)
        for name in at:
            if name in self.stations:
                station = self.stations[name]
                station.dispatch(lambda station=station: station.exchange.links[link].received(data, None))  # type: ignore[misc]
        return data

    def talks(self, robot: str, at: Iterable[str], seconds: float, every_s: float = 0.2, to: str = "PC") -> list[bytes]:
        """`robot` says something new now and then, and time passes."""
        at = tuple(at)
        said = []
        until = self.now + seconds
        while self.now < until - 1e-9:
            said.append(self.says(robot, at, to, "estou", str(next(self._serial))))
            self.run(min(every_s, until - self.now))
        return said

    # Time.

    def after(self, seconds: float, event: Callable[[], None]) -> None:
        heapq.heappush(self._events, (self.now + seconds, next(self._order), event))

    def run(self, seconds: float) -> None:
        until = self.now + seconds
        events = self._events
        while events and events[0][0] <= until:
            self.now, _, event = heapq.heappop(events)
            event()
        self.now = until

    def run_until(self, true: Callable[[], bool], within_s: float) -> float:
        """How long it took until `true`, looked at every 10 ms."""
        began = self.now
        while not true():
            assert self.now - began < within_s, f"not within {within_s} s"
            self.run(0.01)
        return self.now - began

    # What holds of the whole.

    def owners(self, robot: str) -> dict[str, str | None]:
        """Who owns `robot`, as each broker knows it."""
        return {name: station.owner(robot) for name, station in self.stations.items()}

    def owner(self, robot: str) -> str | None:
        """The owner on whom all brokers agree, with their routes; None if they do not."""
        owners = set(self.owners(robot).values())
        return next(iter(owners)) if len(owners) == 1 and not self.disagreements([robot]) else None

    def disagreements(self, robots: Iterable[str], among: Iterable[str] | None = None) -> list[str]:
        """What is wrong with who owns what, and with the routes that follow from it."""
        wrong = []
        stations = [self.stations[name] for name in (among if among is not None else self.stations)]
        for robot in robots:
            owners = {station.name: station.owner(robot) for station in stations}
            if len(set(owners.values())) != 1:
                wrong.append(f"{robot}: {owners}")
                continue
            [owner] = set(owners.values())
            for station in stations:
                route = station.route(robot)
                if owner is None:
                    if route is not None and not route.pinned:
                        wrong.append(f"{robot}: {station.name} has a way {route.way}, and nobody owns it")
                elif route is None:
                    wrong.append(f"{robot}: {station.name} has no way to {owner}")
                elif station.name == owner:
                    if route.way.link == MESH:
                        wrong.append(f"{robot}: {owner} owns it and sends it to {route.way.peer}")
                elif route.way != Way(MESH, owner) and not route.pinned:
                    wrong.append(f"{robot}: {station.name} sends to {route.way}, not {owner}")
        return wrong

    def balances(self) -> None:
        """Every frame is accounted for, in the books of each broker and between each two of them."""
        for station in (*self.stations.values(), *self.former):
            assert_balanced(station.exchange)
        for one in self.stations.values():
            for other in one.neighbours:
                there = self.stations[other.name].neighbours.find(one.name)
                assert there is not None
                for lane, number in other.sent.items():
                    series = there.received.get(lane)
                    arrived, lost = (0, 0) if series is None else (series.received, series.lost)
                    unseen = number - arrived - lost
                    assert unseen >= 0, (one.name, other.name, lane)
                    assert not unseen or self.loses or self.former, (one.name, other.name, lane)

    def published(self, data: bytes) -> int:
        """How many brokers published the frame, counted as often as each did."""
        return sum(frame.wire == data for it in (*self.stations.values(), *self.former) for frame in it.published)

    def transmitted(self, data: bytes, link: str = RADIO) -> int:
        """How often any broker put these bytes on `link`."""
        return sum(it.antennas[link].wires.count(data) for it in (*self.stations.values(), *self.former))

    @property
    def declared_anew(self) -> int:
        return sum(station.mesh.declared_anew for station in self.stations.values())

    # The network.

    def others(self, name: str) -> list[str]:
        return [other for other in self.stations if other != name]

    def reach(self, a: str, b: str) -> bool:
        return frozenset((a, b)) not in self._cut

    def put_frame(self, sender: str, to: str, lane: int, data: bytes) -> None:
        """Whoever may say that it is `sender`."""
        self.send("frame", sender, to, lambda it: it.dispatch(lambda: it.mesh.frame_came(sender, lane, data, it.now)))

    def session(self, name: str) -> Session:
        return self._sessions[name]

    def send(self, kind: str, sender: str, to: str, deliver: Callable[[Station], None]) -> None:
        """In its order among its kind, unless it is lost."""
        self.sent[kind] += 1
        if to not in self.stations or self.loses(kind, sender, to):
            self.lost[kind] += 1
            return
        self._send(kind, sender, to, deliver)

    def _send(self, kind: str, sender: str, to: str, deliver: Callable[[Station], None]) -> None:
        delay_s = self.delay_of.get(kind, self._delay_s) * self._random.uniform(0.5, 1.5)
        stream = "token" if kind == "untoken" else kind
        at = max(self.now + delay_s, self._latest.get((stream, sender, to), 0.0))
        self._latest[stream, sender, to] = at
        station = self.stations[to]

        def arrive() -> None:
            if self.reach(sender, to) and self.stations.get(to) is station:
                deliver(station)
            else:
                self.lost[kind] += 1

        self.after(at - self.now, arrive)

    def tell_all(self, kind: str, token: Token, *, surely: bool = False) -> None:
        for other in self.others(token.broker):
            if surely:
                if self.reach(token.broker, other):
                    self._send(kind, token.broker, other, lambda it: it.told(kind, token))
                else:  # noticed when the lease of the way to it ends
                    self.after(LEASE_S, lambda other=other: self._reconcile(other, token.broker))  # type: ignore[misc]
            else:
                self.send(kind, token.broker, other, lambda it: it.told(kind, token))

    def _tick_later(self, station: Station, seconds: float) -> None:
        def tick() -> None:
            if station.alive:
                if not station.stopped:
                    station.tick()
                self._tick_later(station, TICK_S)

        self.after(seconds, tick)

    def _reconcile_later(self, a: str, b: str, seconds: float) -> None:
        def reconcile() -> None:
            self._reconcile(a, b)
            self._reconcile(b, a)

        self.after(seconds, reconcile)

    def _expire_lease(self, pair: frozenset[str]) -> None:
        if pair in self._cut:
            a, b = pair
            self._reconcile(a, b)
            self._reconcile(b, a)

    def _reconcile(self, observer: str, owner: str) -> None:
        """Have `observer` told what stands of `owner`, which may be out of reach or gone."""
        if observer not in self.stations:
            return
        station = self.stations[observer]
        session = self._sessions.get(owner)
        stands = set(session.tokens.values()) if session is not None and self.reach(observer, owner) else set()
        seen = {token for token in station.seen if token.broker == owner}
        for token in sorted(stands - seen, key=_presence_first):
            if not self.loses("token", owner, observer):
                station.told("token", token)
        for token in sorted(seen - stands, key=_presence_first):
            station.told("untoken", token)


def _presence_first(token: Token) -> tuple[bool, str]:
    return token.claim is not None, repr(token.claim)

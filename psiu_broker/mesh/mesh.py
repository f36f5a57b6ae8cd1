"""The other brokers as one more way for frames: who is there, who owns which robot, and frames to and from them.

A frame goes to the broker that owns its robot, and there to a link; never from broker to broker
again, because Zenoh itself relays between brokers. What is known comes from announcements
(`Claims`); the tick sets right whatever was missed, so a lost message costs time and nothing else.
"""

import logging
import random
import secrets
from collections.abc import Callable, Collection, Hashable, Iterator
from math import inf
from typing import Final, Literal, Protocol

from psiu_broker.errors import EncodeError
from psiu_broker.frame import MESH, Address, Frame, Way
from psiu_broker.mesh.beat import Beat, Notice, digest
from psiu_broker.mesh.envelope import Envelope, pack, unpack
from psiu_broker.mesh.neighbour import BEAT_S, NEWCOMER_S, SILENT_S, Neighbour, Neighbours, Remedy
from psiu_broker.routing.claims import Claim, age_of
from psiu_broker.routing.outbox import Fate, lane
from psiu_broker.routing.ownership import Ownership
from psiu_broker.routing.router import Router
from psiu_broker.routing.table import Route
from psiu_broker.routing.verdicts import DELIVERED, DUPLICATE, LINK_DOWN, MALFORMED, REFUSED, Verdict

log = logging.getLogger(__name__)

MAX_AGE_S: Final = 2.0
"""A frame that waited longer before it could be handed to another broker is not."""
GIVEN_S: Final = 1.0
"""How long a robot that we gave up may be without an owner before we look for it again."""
ORPHANED_S: Final = 1.0
"""How long a robot whose broker is gone may be without an owner before its card is deleted."""
ANEW_EVERY_S: Final = 1.5
ASKED_S: Final = 2 * ANEW_EVERY_S
"""How long a broker that is asked to declare anew may take until that is seen."""
SILENT: Final = "announced and silent"
CUT_ALL_MAX: Final = 2
HANG_UP_EVERY_S: Final = 8.0
"""Ending every link is for what nothing else mends."""
ASLEEP_S: Final = 1.0
"""A pause between our own beats that is no mere load: then it is we who were not there."""
FULL_EVERY: Final = 2
"""Every so many beats one says what was heard from everybody; the others are short."""
DIFFERS_S: Final = 1.0
NAMESAKE_S: Final = 3.0
"""A broker of our name that is announced for longer than this is no former life of ours."""
BROKERS_MAX: Final = 1024
NAMESAKES_MAX: Final = 64
EDITIONS_MAX: Final = 16
CLAIMS_MAX: Final = 4096
"""Of one broker."""
STRANGERS_MAX: Final = 256
FORMER_MAX: Final = 1024


class Tokens:
    """The claims that one life of a broker has declared now: some twice for a moment, while all is declared anew."""

    __slots__ = ("_claims", "_digest", "_round", "asked_at", "renewed")

    def __init__(self) -> None:
        self._claims: dict[Address, list[tuple[int, Claim]]] = {}
        """With the round of asking in which they were declared, the oldest first."""
        self._digest: str | None = None
        self._round = 0
        self.asked_at = -inf
        self.renewed = False
        """Since the last `ask`, the broker has declared itself anew, and so all its claims."""

    def __iter__(self) -> Iterator[Claim]:
        """The newest claim of each robot."""
        return (held[-1][1] for held in self._claims.values())

    @property
    def digest(self) -> str:
        if self._digest is None:
            self._digest = digest({claim for held in self._claims.values() for _, claim in held})
        return self._digest

    def add(self, claim: Claim) -> None:
        self._digest = None
        if claim.robot in self._claims or len(self._claims) < CLAIMS_MAX:
            held = self._claims.setdefault(claim.robot, [])
            if len(held) < EDITIONS_MAX:
                held.append((self._round, claim))

    def remove(self, claim: Claim) -> Claim | None:
        """The claim that the broker still has for the robot."""
        self._digest = None
        held = self._claims.get(claim.robot, [])
        declared = next((each for each in held if each[1] == claim), None)
        if declared is not None:
            held.remove(declared)
        if not held:
            self._claims.pop(claim.robot, None)
            return None
        return held[-1][1]

    def ask(self, now: float) -> None:
        """The broker is asked to declare anew what it has."""
        self.asked_at = now
        self._round += 1
        self.renewed = False

    def sweep(self) -> list[Address]:
        """Forget what was not declared anew since we asked; of which robots."""
        self._digest = None
        self.renewed = False
        self.asked_at = -inf
        changed = []
        for robot, held in list(self._claims.items()):
            kept = [each for each in held if each[0] == self._round]
            if kept != held:
                changed.append(robot)
                self._claims[robot] = kept
                if not kept:
                    del self._claims[robot]
        return changed

    def find(self, robot: Address) -> Claim | None:
        held = self._claims.get(robot)
        return held[-1][1] if held else None


class MeshBus(Protocol):
    """What the mesh needs of the bus. None of these waits or raises."""

    zenoh_id: str
    linked: Collection[str]
    """The Zenoh ids of those to whom a link of ours leads."""

    def put_frame(self, to: str, lane: int, data: bytes) -> None: ...
    def put_beat(self, beat: Beat) -> None: ...
    def put_notice(self, to: str, notice: Notice) -> None: ...
    def announce(self, epoch: int) -> None:
        """Say that we are there, in this life; before the first `claim`."""

    def claim(self, claim: Claim) -> None: ...
    def withdraw(self, claim: Claim) -> None: ...
    def declare_anew(self) -> None:
        """Declare everything once more, for brokers that have lost sight of it."""

    def hang_up(self, zenoh_id: str | None) -> None:
        """End the links to a broker, or to all, so that they begin anew."""


Trouble = Literal["silent", "deaf", "unclear"]


class _Life:
    """One life of a broker, as it is announced."""

    __slots__ = ("editions", "zenoh_id")

    def __init__(self, zenoh_id: str) -> None:
        self.zenoh_id = zenoh_id
        self.editions: set[str] = set()
        """Its announcements: two for a moment while it declares everything anew."""


class _Namesake:
    """Another broker with our name."""

    def __init__(self, since: float) -> None:
        self.since = since
        self.editions: set[str] = set()


class _Stranger:
    """A broker that is heard and not announced."""

    def __init__(self, name: str, zenoh_id: str, now: float) -> None:
        self.name = name
        self.zenoh_id = zenoh_id
        self.since = self.heard_at = now
        self.remedy = Remedy()


class _NoBus:
    """In the bus's place while there is none."""

    zenoh_id = ""
    linked: Collection[str] = ()

    def put_frame(self, to: str, lane: int, data: bytes) -> None: ...
    def put_beat(self, beat: Beat) -> None: ...
    def put_notice(self, to: str, notice: Notice) -> None: ...
    def announce(self, epoch: int) -> None: ...
    def claim(self, claim: Claim) -> None: ...
    def withdraw(self, claim: Claim) -> None: ...
    def declare_anew(self) -> None: ...
    def hang_up(self, zenoh_id: str | None) -> None: ...


class Hub(Protocol):
    """The broker's side of the mesh."""

    def relayed(self, frame: Frame, way: Way, now: float, age_s: float) -> object:
        """A frame came from another broker; `age_s` is how long ago its robot sent it, as far as is known."""

    def relay_dropped(self, verdict: Verdict) -> None:
        """Something came from another broker that is no frame for us."""

    def neighbour_came(self, name: str) -> None: ...

    def orphaned(self, robot: Address) -> None:
        """The robot's broker is gone, nobody else has it, and it is ours to say so."""


class Mesh:
    """Stands among the links as `MESH`: its far ends are the other brokers, by name.

    Args:
        own: this broker's name.
        quality: of a link, in tenths of what is heard that check out.
        identity: as the router's.
    """

    def __init__(
        self,
        own: str,
        hub: Hub,
        router: Router,
        ownership: Ownership,
        neighbours: Neighbours,
        quality: Callable[[str], int],
        identity: Callable[[Frame], Hashable],
    ) -> None:
        self.own = own
        self.ownership = ownership
        self.claims = ownership.claims
        self.neighbours = neighbours
        self.epoch = 0
        self.declared_anew = 0
        self.namesakes: dict[int, _Namesake] = {}
        """Other brokers with our name, by their epochs."""
        self._hub = hub
        self._router = router
        self._quality = quality
        self._identity = identity
        self._bus: MeshBus = _NoBus()
        self._attached = False
        self._announced: dict[str, dict[int, _Life]] = {}
        """Each broker's lives that are announced: one, and for a while what Zenoh still keeps of a former one."""
        self._former: dict[tuple[str, int], Neighbour] = {}
        """Brokers that went, by name and life: if they were only out of sight, the series go on."""
        self._tokens: dict[tuple[str, int], Tokens] = {}
        """By broker and life, also of those that are not announced (yet, or any more)."""
        self._given: dict[Address, float] = {}
        self._orphans: dict[Address, tuple[str, float]] = {}
        """Robots that nobody owns any more: who did last, and until when."""
        self._strangers: dict[str, _Stranger] = {}
        self._beats = 0
        self._beat_soon = False
        self._beaten = -inf
        self._awake_since = -inf
        self._hung_up_at = -inf
        self._anew_at = -inf
        self._anew_wanted: str | None = None
        """Why everything should be declared anew."""

    # The bus comes and goes.

    def attach(self, bus: MeshBus, now: float, epoch: int | None = None) -> None:
        """A session is open: begin a new life on it, with an epoch that should be greater than any before it."""
        self._bus = bus
        self._attached = True
        self.epoch = secrets.randbits(62) if epoch is None else epoch
        self._anew_wanted = None
        self._anew_at = now
        bus.announce(self.epoch)
        self.tick(now)

    def detach(self, now: float) -> None:
        """The session is gone, and with it everybody."""
        self._bus = _NoBus()
        self._attached = False
        for neighbour in list(self.neighbours):
            self._lose(neighbour, now)
        for robot in self.claims.of(self.own):
            self.claims.remove(self.own, robot)
        self._former.clear()
        self._announced.clear()
        self._tokens.clear()
        self._orphans.clear()
        self.namesakes.clear()

    # As a link.

    def ways(self) -> tuple[Way, ...]:
        return self.neighbours.ways

    def offer(
        self, frame: Frame, peer: object, arrived: Way, now: float, patience_s: float = inf, fate: Fate | None = None
    ) -> Verdict | None:
        """Hand `frame` to the broker `peer`; like `Link.offer`, but nothing ever waits."""
        neighbour = self.neighbours.find(str(peer))
        if neighbour is None:
            return LINK_DOWN
        waited_s = 0.0 if patience_s == inf else MAX_AGE_S - patience_s
        urgency = lane(frame)
        try:
            data = self._packed(frame, neighbour, neighbour.sent.get(urgency, 0) + 1, now, waited_s)
        except EncodeError as error:
            log.debug("to broker %s: %s", neighbour.name, error)
            return REFUSED
        neighbour.number(urgency)
        self._bus.put_frame(neighbour.name, urgency, data)
        return DELIVERED

    # What the bus brings.

    def broker_came(self, name: str, epoch: int, zenoh_id: str, edition: str, now: float) -> None:
        """A broker is announced; `edition` tells its announcements apart where there is more than one."""
        if name == self.own:
            if epoch != self.epoch and (epoch in self.namesakes or len(self.namesakes) < NAMESAKES_MAX):
                self.namesakes.setdefault(epoch, _Namesake(now)).editions.add(edition)
            return
        if name not in self._announced and len(self._announced) >= BROKERS_MAX:
            return
        life = self._announced.setdefault(name, {}).setdefault(epoch, _Life(zenoh_id))
        if len(life.editions) < EDITIONS_MAX:
            life.editions.add(edition)
        known = self.neighbours.find(name)
        if known is None:
            self._begin(name, epoch, now)
        elif known.epoch == epoch:
            self._tokens_of(name, epoch).renewed = True
        elif epoch > known.epoch and not known.alive(now):
            self._lose(known, now)
            self._begin(name, epoch, now)

    def _begin(self, name: str, epoch: int, now: float) -> None:
        """A broker is there, in the life that is announced as `epoch`."""
        neighbour = self._former.pop((name, epoch), None)
        if neighbour is None:
            neighbour = Neighbour(name, epoch, self._announced[name][epoch].zenoh_id, now)
        else:
            neighbour.returned(now)
        self.neighbours.add(neighbour)
        self._settle(Address.named(name), now)
        for claim in self._tokens_of(name, epoch):
            if self.claims.set(name, claim):
                self._settle(claim.robot, now)
        self._hub.neighbour_came(name)
        self._beat_soon = True
        log.info("mesh: broker %s is there", name)

    def broker_went(self, name: str, epoch: int, edition: str, now: float) -> None:
        """An announcement is no more; with its last one the broker is gone."""
        if name == self.own and epoch in self.namesakes:
            self.namesakes[epoch].editions.discard(edition)
            if not self.namesakes[epoch].editions:
                del self.namesakes[epoch]
        lives = self._announced.get(name, {})
        life = lives.get(epoch)
        if life is None:
            return
        life.editions.discard(edition)
        if life.editions:
            return
        del lives[epoch]
        neighbour = self.neighbours.find(name)
        if neighbour is not None and neighbour.epoch == epoch:
            self._lose(neighbour, now)
            if lives:
                self._begin(name, max(lives), now)
        if not lives:
            del self._announced[name]

    def _lose(self, neighbour: Neighbour, now: float) -> None:
        name = neighbour.name
        self.neighbours.remove(name)
        self._former[name, neighbour.epoch] = neighbour
        if len(self._former) > FORMER_MAX:
            del self._former[next(iter(self._former))]
        for robot in self.claims.remove_broker(name):
            self._orphans[robot] = name, now
            self._settle(robot, now)
        self._router.peer_lost(neighbour.way, now)
        log.info("mesh: broker %s is gone", name)

    def claimed(self, broker: str, epoch: int, claim: Claim, now: float) -> None:
        if broker == self.own:
            return
        self._tokens_of(broker, epoch).add(claim)
        if self._lives(broker, epoch) and self.claims.set(broker, claim):
            self._settle(claim.robot, now)

    def unclaimed(self, broker: str, epoch: int, claim: Claim, now: float) -> None:
        if broker == self.own:
            return
        tokens = self._tokens_of(broker, epoch)
        tokens.remove(claim)
        if self._lives(broker, epoch):
            self._follow(broker, tokens, claim.robot, now)

    def frame_came(self, sender: str, urgency: int, data: bytes, now: float) -> None:
        envelope = unpack(data)
        neighbour = self.neighbours.find(sender)
        if envelope is None:
            self._hub.relay_dropped(MALFORMED)
        elif neighbour is None or (envelope.epoch, envelope.to_epoch) != (neighbour.epoch, self.epoch):
            self._hub.relay_dropped(REFUSED)
        elif not neighbour.take(urgency, envelope.sequence):
            self._hub.relay_dropped(DUPLICATE)
        else:
            age_s = envelope.age_ms / 1000 + neighbour.late_s(envelope.sent_us, now)
            self._hub.relayed(envelope.frame, neighbour.way, now, age_s)

    def beat_came(self, beat: Beat, now: float) -> None:
        if beat.broker == self.own:
            return
        neighbour = self.neighbours.find(beat.broker)
        if neighbour is None or neighbour.epoch != beat.epoch:
            if beat.epoch not in self._announced.get(beat.broker, {}):
                self._stranger(beat, now)
                return
            if neighbour is not None:  # the announcement of a former life is still there
                self._lose(neighbour, now)
            self._begin(beat.broker, beat.epoch, now)
            neighbour = self.neighbours.find(beat.broker)
        if neighbour is None:
            return
        self._strangers.pop(beat.broker, None)
        if self.own in beat.unseen:
            self._declare_anew(now, f"{beat.broker} does not see all of it")
        neighbour.beat(beat, self.own, self.epoch, now)
        if beat.claims == self._tokens_of(beat.broker, beat.epoch).digest:
            neighbour.differs_since = None
        elif neighbour.differs_since is None:
            neighbour.differs_since = now

    def notice_came(self, notice: Notice, now: float) -> None:
        if notice.frame is None:
            self._declare_anew(now, f"{notice.broker} does not see all of it")
            return
        try:
            envelope = unpack(bytes.fromhex(notice.frame))
        except ValueError:
            envelope = None
        neighbour = self.neighbours.find(notice.broker)
        if envelope is None or neighbour is None:
            return
        if (envelope.epoch, envelope.to_epoch) != (neighbour.epoch, self.epoch):
            return  # of a former life
        route = self._router.find(envelope.frame.source)
        if route is None or self.claims.find(self.own, route.robot) is None:
            return
        better_by = notice.quality - self._quality(route.way.link)
        heard_at = now - neighbour.late_s(envelope.sent_us, now) - (neighbour.round_trip_s or 0.0) / 2
        key = self._identity(envelope.frame)
        if self.ownership.noticed(route, notice.broker, key, better_by, heard_at, now):
            self._give(route, notice.broker, now)

    # What the broker tells us.

    def robot_heard(self, route: Route, now: float) -> None:
        """A robot was heard on one of our links, for the first time or after it moved there."""
        if route.way.link != MESH and self._attached:
            self._given.pop(route.robot, None)
            self._announce(route, now, news=True)

    def robot_gone(self, route: Route) -> None:
        """The route to a robot was withdrawn."""
        claim = self.claims.find(self.own, route.robot)
        if claim is not None:
            self._unclaim(claim)

    def notify(self, owner: str, frame: Frame, arrived: Way, now: float) -> None:
        """Tell the owner of a robot that we heard this frame of it at `now`."""
        neighbour = self.neighbours.find(owner)
        if neighbour is not None:
            try:
                data = self._packed(frame, neighbour, 0, now, 0.0)
            except EncodeError:
                return
            notice = Notice(broker=self.own, quality=self._quality(arrived.link), frame=data.hex())
            self._bus.put_notice(owner, notice)

    def tick(self, now: float) -> None:
        """To be called some ten times a second."""
        if not self._attached:
            return
        for robot, broker in list(self.ownership.due(self._router.find, now)):
            route = self._router.find(robot)
            if route is not None and self.claims.find(self.own, robot) is not None:
                self._give(route, broker, now)
        if not all(neighbour.alive(now) for neighbour in self.neighbours):
            for robot in self.ownership.abandoned(now):
                self._take(robot, now)
        if self._beat_soon or now - self._beaten >= BEAT_S:
            self._beat_soon = False
            if now - self._beaten > ASLEEP_S:
                self._awake_since = now
            self._beaten = now
            self._beat(now)
            for owner, frame, way, heard_at in list(self.ownership.reminders(now)):
                self.notify(owner, frame, way, heard_at)
            self._set_right(now)
            self._guard(now)
            self._declare_what_is_wanted(now)

    def conflicts(self, now: float) -> Iterator[tuple[str, set[str], float, str]]:
        """Names that more than one robot or broker has: the name, at which brokers, since when, and what it means."""
        for conflict in self.ownership.conflicts.values():
            detail = "robots of this name talk at each of these brokers by turns; rename one of them"
            yield str(conflict.robot), conflict.brokers, conflict.since, detail
        for namesake in self.namesakes.values():
            if now - namesake.since > NAMESAKE_S:
                yield (
                    self.own,
                    {self.own},
                    namesake.since,
                    "another broker has this name too; rename one of them in [broker]",
                )

    # Inside.

    def _packed(self, frame: Frame, neighbour: Neighbour, number: int, now: float, waited_s: float) -> bytes:
        age_ms = int(max(waited_s, 0.0) * 1000)
        return pack(Envelope(self.epoch, neighbour.epoch, number, int(now * 1e6), age_ms, frame))

    def _beat(self, now: float) -> None:
        self._beats += 1
        beat = Beat(
            broker=self.own,
            epoch=self.epoch,
            zenoh_id=self._bus.zenoh_id,
            sent_us=int(now * 1e6),
            claims=digest(self.claims.of(self.own).values()),
            unseen=self._unseen(now),
        )
        if self._beats % FULL_EVERY == 0:
            heard = {each.name: echo for each in self.neighbours if (echo := each.echo(now)) is not None}
            sent = {each.name: (each.epoch, each.sent) for each in self.neighbours if each.sent}
            beat = beat.model_copy(update={"heard": heard, "sent": sent})
        self._bus.put_beat(beat)

    def _unseen(self, now: float) -> list[str]:
        """The brokers that are heard and not announced, or announced otherwise than they say."""
        strangers = [each.name for each in self._strangers.values() if now - each.since > NEWCOMER_S]
        return strangers + [each.name for each in self.neighbours if self._trouble(each, now) == "unclear"]

    def _settle(self, robot: Address, now: float) -> None:
        """Bring the route to `robot` in line with who claims it."""
        namesake = self.neighbours.find(str(robot))
        if namesake is not None:  # a robot cannot be a broker
            self._router.announced((robot,), namesake.way, "psiu-ascii", now)
            return
        held = self.claims.owner(robot)
        if held is None:
            if not self._take(robot, now) and robot not in self._given:
                self._router.unannounced(robot, now)
            return
        owner, claim = held
        if owner == self.own:
            return
        self._given.pop(robot, None)
        self._orphans.pop(robot, None)
        mine = self.claims.find(self.own, robot)
        if mine is not None:
            self._unclaim(mine)
        self.ownership.forget(robot)
        neighbour = self.neighbours.find(owner)
        if neighbour is not None:
            heard = claim.age_s is not None
            self._router.announced(claim.addresses, neighbour.way, claim.protocol, now, heard=heard)

    def _take(self, robot: Address, now: float) -> bool:
        """Take a robot that we overheard of late."""
        known = self.ownership.recent(robot, now)
        self.ownership.overheard.pop(robot, None)
        return known is not None and self._router.take(robot, known.way, known.protocol, known.at)

    def _follow(self, broker: str, tokens: Tokens, robot: Address, now: float) -> None:
        """Bring what the broker claims of `robot` in line with its tokens."""
        claim = tokens.find(robot)
        if claim is None:
            self.claims.remove(broker, robot)
            self._orphans[robot] = broker, now
        else:
            self.claims.set(broker, claim)
        self._settle(robot, now)

    def _lives(self, broker: str, epoch: int) -> bool:
        neighbour = self.neighbours.find(broker)
        return neighbour is not None and neighbour.epoch == epoch

    def _tokens_of(self, broker: str, epoch: int) -> Tokens:
        tokens = self._tokens.get((broker, epoch))
        if tokens is None:
            if len(self._tokens) >= FORMER_MAX:
                gone = (each for each in self._tokens if not self._lives(*each))
                self._tokens.pop(next(gone, (broker, epoch)), None)
            tokens = self._tokens[broker, epoch] = Tokens()
        return tokens

    def _give(self, route: Route, broker: str, now: float) -> None:
        """Give up a robot that moved to another broker, which takes it when it sees that."""
        robot = route.robot
        mine = self.claims.find(self.own, robot)
        neighbour = self.neighbours.find(broker)
        if mine is None or neighbour is None:
            return
        log.info("mesh: %s goes to %s", robot, broker)
        self._unclaim(mine)
        self.ownership.remember(route)
        self._given[robot] = now
        self._router.announced(route.addresses, neighbour.way, route.protocol, now)

    def _announce(self, route: Route, now: float, *, news: bool = False) -> None:
        """Claim a robot of one of our links, or renew the claim where it has changed."""
        robot = route.robot
        mine = self.claims.find(self.own, robot)
        held = self.claims.owner(robot)
        if not self._attached or robot in self._given:
            return
        taken = held is not None and held[0] != self.own
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
        self.claims.set(self.own, claim)
        self._bus.claim(claim)
        if mine is not None:
            self._bus.withdraw(mine)

    def _unclaim(self, claim: Claim) -> None:
        self.claims.remove(self.own, claim.robot)
        self._bus.withdraw(claim)

    def _set_right(self, now: float) -> None:
        """Whatever a lost message left wrong."""
        self.ownership.expire(now)
        for robot, since in list(self._given.items()):
            if now - since > GIVEN_S:
                del self._given[robot]
                self._settle(robot, now)
        owners = {robot: broker for broker, claim in self.claims if (robot := claim.robot) not in self._given}
        owners |= {Address.named(neighbour.name): neighbour.name for neighbour in self.neighbours}
        for robot, owner in owners.items():
            found = self._router.find(robot)
            if owner != self.own and (found is None or found.way.peer != owner or found.way.link != MESH):
                self._settle(robot, now)
        for route in list(self._router.table):
            if route.way.link == MESH:
                if route.robot not in owners and route.robot not in self._given:
                    self._settle(route.robot, now)
            elif route.way.link in self._router.ports:
                self._announce(route, now)
        for robot, claim in self.claims.of(self.own).items():
            found = self._router.find(robot)
            if found is None or found.way.link == MESH:
                self._unclaim(claim)
        self._tell_orphans(now)

    def _tell_orphans(self, now: float) -> None:
        """One of the brokers that are left says that a robot is gone with its broker."""
        for robot, (owner, since) in list(self._orphans.items()):
            if now - since > ORPHANED_S:
                del self._orphans[robot]
                first = all(self.own < neighbour.name for neighbour in self.neighbours)
                gone = self.neighbours.find(owner) is None
                if first and gone and self.claims.owner(robot) is None and self._router.find(robot) is None:
                    self._hub.orphaned(robot)

    def _guard(self, now: float) -> None:
        """Notice who has lost sight of us, or we of them: Zenoh does, and does not always mend it."""
        for neighbour in self.neighbours:
            trouble = self._trouble(neighbour, now)
            if trouble is None:
                neighbour.remedy.over()
            elif neighbour.remedy.is_due(now):
                self._remedy(neighbour.name, neighbour.zenoh_id, neighbour.remedy, f"announced and {trouble}", now)
                if trouble == "unclear":
                    self._differs(neighbour, now)
        for stranger in list(self._strangers.values()):
            if now - stranger.heard_at > SILENT_S:
                del self._strangers[stranger.name]
            elif now - stranger.since > NEWCOMER_S and stranger.remedy.is_due(now):
                self._ask_anew(stranger.name)
                self._remedy(stranger.name, stranger.zenoh_id, stranger.remedy, "heard and not announced", now)

    def _trouble(self, neighbour: Neighbour, now: float) -> Trouble | None:
        patience_s = SILENT_S if neighbour.beat_at is not None else NEWCOMER_S
        if now - max(neighbour.last_sign(), self._awake_since) > patience_s:
            return "silent"
        if neighbour.deaf_since is not None and now - neighbour.deaf_since > NEWCOMER_S:
            return "deaf"
        if neighbour.differs_since is not None and now - neighbour.differs_since > DIFFERS_S:
            return "unclear"
        return None

    def _remedy(self, name: str, zenoh_id: str, remedy: Remedy, trouble: str, now: float) -> None:
        """Do more each time against the same trouble with a broker: declare anew, then connect anew.

        In steps, because each remedy is itself a trouble for others for a moment; the last one, which
        ends every link, is for a broker that is announced and silent, and for twice at most.
        """
        if remedy.steps <= 2:
            self._declare_anew(now, f"{name} is {trouble}")
        elif zenoh_id in self._bus.linked:
            log.warning("mesh: connecting anew: %s is %s", name, trouble)
            self._bus.hang_up(zenoh_id)
        elif (
            trouble == SILENT
            and remedy.cut_all < CUT_ALL_MAX
            and now - self._hung_up_at >= HANG_UP_EVERY_S * random.uniform(1, 2)  # noqa: S311 - spreads, no secret
        ):
            remedy.cut_all += 1
            self._hung_up_at = now
            log.warning("mesh: connecting anew with everybody: %s is %s", name, trouble)
            self._bus.hang_up(None)

    def _differs(self, neighbour: Neighbour, now: float) -> None:
        """We have missed a token of a broker, or that one was withdrawn."""
        tokens = self._tokens_of(neighbour.name, neighbour.epoch)
        if tokens.renewed and tokens.asked_at > -inf:
            for robot in tokens.sweep():
                self._follow(neighbour.name, tokens, robot, now)
        elif now - tokens.asked_at > ASKED_S:
            tokens.ask(now)
            self._ask_anew(neighbour.name)

    def _stranger(self, beat: Beat, now: float) -> None:
        """A beat of a broker that is not announced to us."""
        stranger = self._strangers.get(beat.broker)
        if stranger is None and len(self._strangers) < STRANGERS_MAX:
            stranger = self._strangers[beat.broker] = _Stranger(beat.broker, beat.zenoh_id, now)
        if stranger is not None:
            stranger.heard_at = now

    def _ask_anew(self, name: str) -> None:
        log.info("mesh: asking %s to declare anew what it has", name)
        self._bus.put_notice(name, Notice(broker=self.own))

    def _declare_anew(self, now: float, why: str) -> None:
        """Declare everything anew, now or as soon as it was not just done."""
        self._anew_wanted = why
        self._declare_what_is_wanted(now)

    def _declare_what_is_wanted(self, now: float) -> None:
        why = self._anew_wanted
        if why is not None and now - self._anew_at >= ANEW_EVERY_S:
            self._anew_wanted = None
            self._anew_at = now
            self.declared_anew += 1
            log.warning("mesh: declaring everything anew: %s", why)
            self._bus.declare_anew()

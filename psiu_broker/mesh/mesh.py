"""The other brokers as one more way for frames: who is there, who owns which robot, and frames to and from them.

A frame goes to the broker that owns its robot, and there to a link; never from broker to broker
again, because Zenoh itself relays between brokers. What is known comes from announcements
(`Claims`); the tick sets right whatever was missed, so a lost message costs time and nothing else.
"""

import logging
import secrets
from collections.abc import Callable, Hashable, Iterator
from math import inf
from typing import Final, Protocol

from psiu_broker.errors import EncodeError
from psiu_broker.frame import Address, Frame, Way
from psiu_broker.mesh.beat import Beat, Notice, digest
from psiu_broker.mesh.bus import MeshBus, NoBus
from psiu_broker.mesh.envelope import Envelope, pack, unpack
from psiu_broker.mesh.lives import Lives, Namesakes
from psiu_broker.mesh.neighbour import BEAT_S, Neighbour, Neighbours
from psiu_broker.mesh.remedies import ANEW_EVERY_S, Remedies
from psiu_broker.mesh.robots import Robots
from psiu_broker.mesh.tokens import AllTokens
from psiu_broker.routing.claims import Claim
from psiu_broker.routing.outbox import Fate, lane
from psiu_broker.routing.ownership import Ownership
from psiu_broker.routing.router import Router
from psiu_broker.routing.table import Route
from psiu_broker.routing.verdicts import DELIVERED, DUPLICATE, LINK_DOWN, MALFORMED, REFUSED, Verdict

log = logging.getLogger(__name__)

MAX_AGE_S: Final = 2.0
"""A frame that waited longer before it could be handed to another broker is not."""
ASKED_S: Final = 2 * ANEW_EVERY_S
"""How long a broker that is asked to declare anew may take until that is seen."""
ASLEEP_S: Final = 1.0
"""A pause between our own beats that is no mere load: then it is we who were not there."""
FULL_EVERY: Final = 2
"""Every so many beats one says what was heard from everybody; the others are short."""
FORMER_MAX: Final = 1024


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
        self._hub = hub
        self._router = router
        self._quality = quality
        self._identity = identity
        self._bus: MeshBus = NoBus()
        self._attached = False
        self._robots = Robots(own, router, ownership, neighbours, quality, hub.orphaned)
        self._remedies = Remedies(own, neighbours, self._unclear)
        self._lives = Lives()
        self._namesakes = Namesakes()
        self._tokens = AllTokens(self._lives_now)
        self._former: dict[tuple[str, int], Neighbour] = {}
        """Brokers that went, by name and life: if they were only out of sight, the series go on."""
        self._beats = 0
        self._beat_soon = False
        self._beaten = -inf

    @property
    def declared_anew(self) -> int:
        """How often everything was declared once more, because somebody had lost sight of it."""
        return self._remedies.declared_anew

    # The bus comes and goes.

    def attach(self, bus: MeshBus, now: float, epoch: int | None = None) -> None:
        """A session is open: begin a new life on it, with an epoch that should be greater than any before it."""
        self._bus = bus
        self._attached = True
        self.epoch = secrets.randbits(62) if epoch is None else epoch
        self._remedies.attach(bus, now)
        self._robots.attach(bus)
        bus.announce(self.epoch)
        self.tick(now)

    def detach(self, now: float) -> None:
        """The session is gone, and with it everybody."""
        self._bus = NoBus()
        self._attached = False
        self._remedies.detach()
        self._robots.detach()
        for neighbour in list(self.neighbours):
            self._lose(neighbour, now)
        self._robots.clear()
        self._former.clear()
        self._lives.clear()
        self._tokens.clear()
        self._namesakes.clear()

    # As a link.

    def ways(self) -> tuple[Way, ...]:
        return self.neighbours.ways

    def offer(
        self, frame: Frame, peer: object, arrived: Way, now: float, patience_s: float = inf, fate: Fate | None = None
    ) -> Verdict | None:
        """Hand `frame` to the broker `peer`; like `Link.offer`, but nothing ever waits.

        The other broker is told an age, not a patience: one that leaves no more than `patience_s` of `MAX_AGE_S`.
        """
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
        if not self._bus.put_frame(neighbour.name, urgency, data):
            return LINK_DOWN
        neighbour.number(urgency)
        return DELIVERED

    # What the bus brings.

    def broker_came(self, name: str, epoch: int, zenoh_id: str, edition: str, now: float) -> None:
        """A broker is announced; `edition` tells its announcements apart where there is more than one."""
        if name == self.own:
            if epoch != self.epoch:
                self._namesakes.came(epoch, edition, now)
            return
        if not self._lives.came(name, epoch, zenoh_id, edition):
            return
        known = self.neighbours.find(name)
        if known is None:
            self._begin(name, epoch, now)
        elif known.epoch == epoch:
            self._tokens.of(name, epoch).renewed = True
        elif epoch > known.epoch and not known.alive(now):
            self._lose(known, now)
            self._begin(name, epoch, now)

    def _begin(self, name: str, epoch: int, now: float) -> None:
        """A broker is there, in the life that is announced as `epoch`."""
        neighbour = self._former.pop((name, epoch), None)
        if neighbour is None:
            neighbour = Neighbour(name, epoch, self._lives.zenoh_id(name, epoch), now)
        else:
            neighbour.returned(now)
        self.neighbours.add(neighbour)
        self._robots.broker_came(name, now)
        for claim in self._tokens.of(name, epoch):
            self._robots.claimed(name, claim, now)
        self._hub.neighbour_came(name)
        self._beat_soon = True
        log.info("mesh: broker %s is there", name)

    def broker_went(self, name: str, epoch: int, edition: str, now: float) -> None:
        """An announcement is no more; with its last one the broker is gone."""
        if name == self.own:
            self._namesakes.went(epoch, edition)
            return
        if not self._lives.went(name, epoch, edition):
            return
        neighbour = self.neighbours.find(name)
        if neighbour is not None and neighbour.epoch == epoch:
            self._lose(neighbour, now)
            latest = self._lives.latest(name)
            if latest is not None:
                self._begin(name, latest, now)

    def _lose(self, neighbour: Neighbour, now: float) -> None:
        name = neighbour.name
        self.neighbours.remove(name)
        self._former[name, neighbour.epoch] = neighbour
        if len(self._former) > FORMER_MAX:
            del self._former[next(iter(self._former))]
        self._robots.broker_gone(name, now)
        self._router.peer_lost(neighbour.way, now)
        log.info("mesh: broker %s is gone", name)

    def claimed(self, broker: str, epoch: int, claim: Claim, now: float) -> None:
        if broker == self.own:
            return
        self._tokens.of(broker, epoch).add(claim)
        if self._lives_now(broker, epoch):
            self._robots.claimed(broker, claim, now)

    def unclaimed(self, broker: str, epoch: int, claim: Claim, now: float) -> None:
        if broker == self.own:
            return
        tokens = self._tokens.of(broker, epoch)
        tokens.remove(claim)
        if self._lives_now(broker, epoch):
            self._robots.follow(broker, claim.robot, tokens.find(claim.robot), now)

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
            if not self._lives.has(beat.broker, beat.epoch):
                self._remedies.stranger(beat, now)
                return
            if neighbour is not None:  # the announcement of a former life is still there
                self._lose(neighbour, now)
            self._begin(beat.broker, beat.epoch, now)
            neighbour = self.neighbours.find(beat.broker)
        if neighbour is None:
            return
        self._remedies.known(beat.broker)
        if self.own in beat.unseen:
            self._remedies.declare_anew(now, f"{beat.broker} does not see all of it")
        neighbour.beat(beat, self.own, self.epoch, now)
        if beat.claims == self._tokens.of(beat.broker, beat.epoch).digest:
            neighbour.differs_since = None
        elif neighbour.differs_since is None:
            neighbour.differs_since = now

    def notice_came(self, notice: Notice, now: float) -> None:
        if notice.frame is None:
            self._remedies.declare_anew(now, f"{notice.broker} does not see all of it")
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
        heard_at = now - neighbour.late_s(envelope.sent_us, now) - (neighbour.round_trip_s or 0.0) / 2
        frame = envelope.frame
        self._robots.noticed(frame.source, notice.broker, self._identity(frame), notice.quality, heard_at, now)

    # What the broker tells us.

    def robot_heard(self, route: Route, now: float) -> None:
        """A robot was heard on one of our links, for the first time or after it moved there."""
        self._robots.heard(route, now)

    def robot_gone(self, route: Route) -> None:
        """The route to a robot was withdrawn."""
        self._robots.gone(route)

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
        self._robots.tick(now)
        if self._beat_soon or now - self._beaten >= BEAT_S:
            self._beat_soon = False
            if now - self._beaten > ASLEEP_S:
                self._remedies.woke(now)
            self._beaten = now
            self._beat(now)
            for owner, frame, way, heard_at in list(self.ownership.reminders(now)):
                self.notify(owner, frame, way, heard_at)
            self._robots.set_right(now)
            self._remedies.tick(now)

    def conflicts(self, now: float) -> Iterator[tuple[str, set[str], float, str]]:
        """Names that more than one robot or broker has: the name, at which brokers, since when, and what it means."""
        for conflict in self.ownership.conflicts.values():
            detail = "robots of this name talk at each of these brokers by turns; rename one of them"
            yield str(conflict.robot), conflict.brokers, conflict.since, detail
        for since in self._namesakes.since(now):
            yield self.own, {self.own}, since, "another broker has this name too; rename one of them in [broker]"

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
            unseen=self._remedies.unseen(now),
        )
        if self._beats % FULL_EVERY == 0:
            heard = {each.name: echo for each in self.neighbours if (echo := each.echo(now)) is not None}
            sent = {each.name: (each.epoch, each.sent) for each in self.neighbours if each.sent}
            beat = beat.model_copy(update={"heard": heard, "sent": sent})
        self._bus.put_beat(beat)

    def _unclear(self, neighbour: Neighbour, now: float) -> None:
        """We have missed a token of a broker, or that one was withdrawn."""
        name = neighbour.name
        tokens = self._tokens.of(name, neighbour.epoch)
        if tokens.renewed and tokens.asked_at > -inf:
            for robot in tokens.sweep():
                self._robots.follow(name, robot, tokens.find(robot), now)
        elif now - tokens.asked_at > ASKED_S:
            tokens.ask(now)
            self._remedies.ask_anew(name)

    def _lives_now(self, broker: str, epoch: int) -> bool:
        neighbour = self.neighbours.find(broker)
        return neighbour is not None and neighbour.epoch == epoch

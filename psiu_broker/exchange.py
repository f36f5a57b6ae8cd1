"""The one meeting point: every frame that arrives on any link passes here and has its fate written down."""

import logging
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Set
from contextlib import suppress
from datetime import UTC, datetime
from math import inf
from typing import Final, Literal, Protocol, cast

from psiu_broker.adapter import Peer
from psiu_broker.codecs import psiu_ascii, psiu_hexa
from psiu_broker.codecs.psiu_hexa import PsiuHexa
from psiu_broker.errors import EncodeError
from psiu_broker.frame import EVERYONE, MESH, Address, Frame, Malformed, Way, peer_text
from psiu_broker.link import Link
from psiu_broker.messages import RawFrame
from psiu_broker.profiles.rarely import Rarely
from psiu_broker.routing.allowance import Allowance
from psiu_broker.routing.holding import Holding
from psiu_broker.routing.outbox import STOP_LANE, Fate, is_question, lane
from psiu_broker.routing.router import ANY, SELF, Decision, Port, Router
from psiu_broker.routing.verdicts import (
    ANSWERED,
    DELIVERED,
    EXPIRED,
    MALFORMED,
    NO_ROUTE,
    REFUSED,
    SAME_WAY,
    UNREACHED,
    Account,
    Verdict,
)

SEARCHES_AT_ONCE: Final = 3
SEARCH_EVERY_S: Final = 10.0
"""In the long run, for one robot that others search: on slow links a search would else come round to us for ever."""

BITS_A_BYTE: Final = 10

log = logging.getLogger(__name__)

_SEARCHES: Final = frozenset({"qualseunome", "ping"})


class Bus(Protocol):
    """What the exchange needs of the bus. `listened` and `raw_listened` are read for each frame."""

    listened: bool
    """Somebody listens to decoded frames."""
    raw_listened: bool
    """Somebody listens to the raw frames of some link."""

    def publish(self, frame: Frame, way: Way, received: float) -> None: ...
    def tapped(self, link: str) -> bool: ...
    def publish_raw(self, raw: RawFrame) -> None: ...


class NoBus:
    """In the bus's place while there is none: nobody listens."""

    listened = raw_listened = False

    def publish(self, frame: Frame, way: Way, received: float) -> None: ...
    def tapped(self, link: str) -> bool:
        return False

    def publish_raw(self, raw: RawFrame) -> None: ...


class Resident(Protocol):
    """The robot that the broker itself is, and its voice for robots that speak another protocol."""

    def answer(self, frame: Frame, way: Way, now: float) -> None:
        """A frame for the broker, or for everyone."""

    def translate(self, frame: Frame, way: Way, now: float) -> Verdict:
        """A frame for a robot of another protocol: ask it in the sender's stead."""

    def malformed(self, malformed: Malformed, way: Way, now: float) -> None:
        """Bytes that were no frame: perhaps a robot's complaint, perhaps one to make ourselves."""

    def asked_names(self, ways: Iterable[Way], now: float) -> None:
        """The broker has just asked who is there: the next qualseunome or ping from each robot is its answer."""

    def delivered(self, frame: Frame, now: float) -> None:
        """A frame of the broker's own has left, at once or after it waited; told for each copy."""

    def undelivered(self, frame: Frame, verdict: Verdict) -> None:
        """A frame of the broker's own that waited was dropped."""

    def unreachable(self, frame: Frame, way: Way, now: float) -> None:
        """A frame that came by `way`, where senders are to be told, did not reach its robot."""

    def link_opened(self, link: Link, now: float) -> None: ...

    def link_closed(self, link: Link, now: float) -> None: ...

    def peer_came(self, way: Way, now: float) -> None: ...

    def peer_lost(self, way: Way, now: float) -> None: ...


class Outlet(Protocol):
    """Where a frame can leave: a link, or the mesh."""

    def offer(
        self, frame: Frame, peer: Peer, arrived: Way, now: float, patience_s: float = inf, fate: Fate | None = None
    ) -> Verdict | None:
        """As `Link.offer`."""

    def ways(self) -> tuple[Way, ...]: ...


class Exchange:
    """Moves frames between links and other brokers; implements `link.Hub`.

    For each link, for the broker's own frames under `SELF`, and in `Router.books` for each robot, at every moment:
    arrived = settled (delivered, answered, dropped) + waiting.
    """

    def __init__(
        self,
        own_name: Address,
        router: Router,
        holding: Holding | None = None,
        wall_clock: Callable[[], float] = time.time,
    ) -> None:
        self.bus: Bus = NoBus()
        self.links: dict[str, Link] = {}
        self._outlets: dict[str, Outlet] = {}
        """The links, and the mesh."""
        self.accounts: dict[str, Account] = {SELF.link: Account()}
        self.allowances: dict[str, Allowance] = {}
        """For what the broker asks on each link without having been told to."""
        self.router = router
        router.books.waiting = lambda: Counter(frame.source for frame, _ in self._waiting())
        self.holding = holding or Holding()
        self.alone: Set[Address] = frozenset()
        """Robots that must hear nothing now but the broker's own calls, and what stops everyone."""
        self._searches = Rarely()
        self._mistakes = 0
        self.resident: Resident
        self._ports: dict[str, Port] = {}
        self._route_age_s: dict[str, float] = {}
        self._max_age_s: dict[str, tuple[float, float]] = {}
        """Of what moves robots, and of questions."""
        self._proxied: set[str] = set()
        """The links whose senders are told of it in the robot's stead."""
        self._own_name = own_name
        self._wall_clock = wall_clock

    def add(self, link: Link) -> None:
        """Take in a link; its books start now."""
        self.links[link.name] = self._outlets[link.name] = link
        self.accounts[link.name] = Account()
        self.allowances[link.name] = Allowance(link.adapter.bits_per_second)
        options = link.configuration.options
        if options.proxy_errors:
            self._proxied.add(link.name)
        self._ports[link.name] = Port(
            link.name,
            link.configuration.protocol,
            link.ways,
            options.wildcard,
            _domain(link.configuration.codec),
            options.new_names_per_minute,
        )
        self._route_age_s[link.name] = options.route_age_s
        self._max_age_s[link.name] = options.max_age_s, options.question_max_age_s

    def join(self, mesh: Outlet, max_age_s: float) -> None:
        """Take in the other brokers, as far ends of the link `MESH`."""
        self._outlets[MESH] = mesh
        self.accounts[MESH] = Account()
        self._route_age_s[MESH] = inf
        self._max_age_s[MESH] = max_age_s, max_age_s
        self.router.link_up(Port(MESH, ANY, mesh.ways))

    def heard(self, frame: Frame, way: Way, now: float, patience_s: float = inf) -> Verdict | None:
        """A frame from a robot (or, by the way SELF, from the broker): decide, move, count, tell the bus.

        Returns its verdict; None while it waits, for at most `patience_s`.
        """
        account = self.accounts[way.link]
        account.arrived += 1
        bus = self.bus
        decision = self.router.route(frame, way, now)
        only = decision.only
        if only is not None and not (self.alone and frame.destination in self.alone and way is not SELF):
            verdict = self._outlets[only.link].offer(frame, only.peer, way, now, patience_s)
            if bus.listened:
                self._publish(frame, decision.hops, way)
        else:
            # Before it is carried out: listeners hear a question before our answer to it.
            if bus.listened and not decision.void:
                self._publish(frame, decision.hops, way)
            verdict = self._carry_out(decision, frame, way, now, patience_s)
        if verdict is not None:
            account.fates[verdict] += 1
            if verdict is not DELIVERED:
                self.router.books.settled(frame.source, verdict)
            if bus.raw_listened:
                self._tap("in", way, verdict, frame)
            if self._proxied and verdict in UNREACHED and way.link in self._proxied:
                self.resident.unreachable(frame, way, now)
        return verdict

    def relayed(self, frame: Frame, way: Way, now: float, age_s: float) -> Verdict | None:
        """A frame came from another broker `age_s` after its robot sent it.

        It is told to the bus there, unless its robot is ours: then the other broker was the quicker one to hear it.
        """
        account = self.accounts[MESH]
        account.arrived += 1
        decision = self.router.route(frame, way, now)
        if self.bus.listened and not decision.void and self.router.is_here(frame.source):
            self._publish(frame, decision.hops, way)
        patience_s = self._longest_wait_s(frame, decision.hops) - age_s
        verdict: Verdict | None
        if patience_s <= 0:
            verdict = EXPIRED
        elif decision.action == "ask":
            verdict = self._ask(frame, decision.hops, way, now, age_s)
        else:
            verdict = self._carry_out(decision, frame, way, now, patience_s)
        if verdict is not None:
            self._settle(account, frame, verdict)
            if self.bus.raw_listened:
                self._tap("in", way, verdict, frame)
        return verdict

    def relay_dropped(self, verdict: Verdict) -> None:
        """Something came from another broker that is no frame for us."""
        account = self.accounts[MESH]
        account.arrived += 1
        account.fates[verdict] += 1
        self.router.books.nameless(verdict)

    def malformed(self, malformed: Malformed, way: Way, now: float) -> None:
        account = self.accounts[way.link]
        account.arrived += 1
        account.fates[MALFORMED] += 1
        self.router.books.nameless(MALFORMED)
        if self.bus.raw_listened:
            self._tap("in", way, MALFORMED, malformed)
        self.resident.malformed(malformed, way, now)

    def send(self, frame: Frame, now: float, patience_s: float = inf) -> Verdict | None:
        """Send a frame of the broker's own; its verdict, or None while it waits, for at most `patience_s`.

        When it leaves is told to `Resident.delivered`; that it waited and is dropped to `Resident.undelivered`.
        """
        verdict = self.heard(frame, SELF, now, patience_s)
        if verdict is DELIVERED:
            self.resident.delivered(frame, now)
        return verdict

    def send_by(self, frame: Frame, way: Way, now: float) -> Verdict | None:
        """As `send`, but by `way`, wherever its destination is known to be."""
        account = self.accounts[SELF.link]
        account.arrived += 1
        self.router.sent(frame, now)
        if self.bus.listened:
            self._publish(frame, (way,), SELF)
        verdict = self._spread(frame, (way,), SELF, now)
        if verdict is not None:
            self._settle(account, frame, verdict)
        return verdict

    def ask_names(self, link: Link, now: float, *, told: bool = False) -> None:
        """Ask everyone on one link who they are; unless we were told to, only where our allowance has room."""
        self._ask_on(EVERYONE, link.ways(), now, told=told)

    def ask_for(self, robot: Address, now: float) -> bool:
        """Ask for a robot on every link where it may hear its name or number; False if there is none."""
        protocol = psiu_hexa.PROTOCOL if robot.is_numbered else psiu_ascii.PROTOCOL
        # Other brokers announce theirs.
        hops = [hop for hop in self.router.decide(robot, protocol, SELF).hops if hop.link != MESH]
        self._ask_on(robot, hops, now)
        return bool(hops)

    def may_ask(self, robot: Address, link: str, now: float, times: int = 1) -> bool:
        """Whether our allowance has room for asking `robot` on `link` without being told; if so, it is charged."""
        return self._may_say(self._question(robot, link), link, now, times)

    def settled(self, fate: Fate, verdict: Verdict, now: float) -> None:
        if verdict is DELIVERED and fate.arrived is SELF:
            self.resident.delivered(fate.frame, now)
        final = fate.settle(verdict)
        if final is not None:
            self._settle(self.accounts[fate.arrived.link], fate.frame, final)
            if self.bus.raw_listened:
                self._tap("in", fate.arrived, final, fate.frame)
            if final is not DELIVERED and fate.arrived is SELF:
                self.resident.undelivered(fate.frame, final)
            elif final in UNREACHED and fate.arrived.link in self._proxied:
                self.resident.unreachable(fate.frame, fate.arrived, now)

    def sent(self, frame: Frame, wire: bytes, way: Way) -> None:
        self._tap("out", way, DELIVERED, frame._replace(wire=wire))

    def opened(self, link: Link, now: float) -> None:
        self.router.link_up(self._ports[link.name])
        self.resident.link_opened(link, now)

    def closed(self, link: Link, now: float) -> None:
        self.router.link_down(link.name, now)
        self.resident.link_closed(link, now)

    def peer_came(self, way: Way, now: float) -> None:
        self.resident.peer_came(way, now)

    def peer_lost(self, way: Way, now: float) -> None:
        self.router.peer_lost(way, now)
        self.resident.peer_lost(way, now)

    def release(self, robot: Address, now: float) -> None:
        """`robot` has been heard: move the frames that waited for it."""
        for held in self.holding.release(robot):
            decision = self.router.reconsider(held.frame, held.arrived, now)
            patience_s = self._longest_wait_s(held.frame, decision.hops) - (now - held.since)
            verdict: Verdict | None
            if decision.action == "ask":
                verdict = NO_ROUTE
            elif patience_s <= 0:
                verdict = EXPIRED
            else:
                verdict = self._carry_out(decision, held.frame, held.arrived, now, patience_s)
            if verdict is not None:
                self.settled(Fate(held.frame, held.arrived), verdict, now)

    def expire(self, now: float) -> None:
        """Drop what has waited too long, here and in the outboxes, and the routes that grew too old."""
        for held in self.holding.expire(now):
            decision = self.router.decide(held.frame.destination, held.frame.protocol, held.arrived)
            self.settled(Fate(held.frame, held.arrived), decision.verdict or NO_ROUTE, now)
        for link in self.links.values():
            link.expire(now)
        self.router.table.age(self._route_age_s, now)

    def waiting(self) -> dict[str, int]:
        """How many of the frames that arrived on each link wait now, in an outbox or for a route."""
        counts = dict.fromkeys(self.accounts, 0)
        for _, arrived in self._waiting():
            counts[arrived.link] += 1
        return counts

    def _waiting(self) -> Iterator[tuple[Frame, Way]]:
        fates = {id(parcel.fate): parcel.fate for link in self.links.values() for parcel in link.outbox}
        for fate in fates.values():
            yield fate.frame, fate.arrived
        for held in self.holding:
            yield held.frame, held.arrived

    def _settle(self, account: Account, frame: Frame, verdict: Verdict) -> None:
        account.fates[verdict] += 1
        if verdict is not DELIVERED:
            self.router.books.settled(frame.source, verdict)

    def _tap(self, direction: Literal["in", "out"], way: Way, verdict: Verdict, what: Frame | Malformed) -> None:
        if not self.bus.tapped(way.link):
            return
        frame = what if isinstance(what, Frame) else None
        self.bus.publish_raw(
            RawFrame(
                direction=direction,
                broker=str(self._own_name),
                link=way.link,
                peer=peer_text(way.peer),
                source=str(frame.source) if frame else None,
                destination=str(frame.destination) if frame else None,
                subject=frame.subject if frame else None,
                verdict=verdict,
                detail=(frame.remark if frame else cast(Malformed, what).reason) or None,
                received=datetime.fromtimestamp(self._wall_clock(), UTC),
                wire=what.wire.hex(),
            )
        )

    def _carry_out(self, decision: Decision, frame: Frame, way: Way, now: float, patience_s: float) -> Verdict | None:
        match decision.action:
            case "forward" if way is not SELF and frame.destination in self.alone:
                return REFUSED
            case "forward":
                return self._spread(frame, decision.hops, way, now, patience_s)
            case "flood":
                return self._flood(frame, decision.hops, way, now, patience_s)
            case "answer":
                return self._answer(frame, way, now)
            case "translate":
                return self._translate(frame, way, now)
            case "ask":
                return self._ask(frame, decision.hops, way, now)
            case "drop":
                if decision.verdict is SAME_WAY and frame.subject in _SEARCHES:
                    return self._look_elsewhere(frame, way, now)
                return decision.verdict

    def _longest_wait_s(self, frame: Frame, hops: tuple[Way, ...]) -> float:
        """How old `frame` may be when it leaves by any of `hops`."""
        question = is_question(frame.subject)
        return min((self._max_age_s[hop.link][question] for hop in hops), default=inf)

    def _flood(self, frame: Frame, hops: tuple[Way, ...], way: Way, now: float, patience_s: float) -> Verdict | None:
        answered: Verdict = NO_ROUTE if way is SELF else self._answer(frame, way, now)
        if not hops:
            return answered
        if self.alone and way is not SELF and lane(frame) != STOP_LANE:
            hops = self._past_alone(hops, way)
        return self._spread(frame, hops, way, now, patience_s) if hops else REFUSED

    def _past_alone(self, hops: tuple[Way, ...], arrived: Way) -> tuple[Way, ...]:
        """Those of `hops` by which what `arrived` for everyone comes to no robot that is to be left `alone`."""
        routes = (self.router.find(robot) for robot in self.alone)
        shut = {route.way for route in routes if route is not None and route.way.link != MESH}
        # Who is at no far end that such frames go to may be reached by any of its link, as in a group.
        whole = {way.link for way in shut if way not in hops and way != arrived}
        return tuple(hop for hop in hops if hop not in shut and hop.link not in whole)

    # What a robot says must not break the link that brought it, nor the books, by a mistake in how it is understood.

    def _answer(self, frame: Frame, way: Way, now: float) -> Verdict:
        try:
            self.resident.answer(frame, way, now)
        except Exception:
            self._note_mistake(frame, way)
            return REFUSED
        return ANSWERED

    def _translate(self, frame: Frame, way: Way, now: float) -> Verdict:
        try:
            return self.resident.translate(frame, way, now)
        except Exception:
            self._note_mistake(frame, way)
            return REFUSED

    def _note_mistake(self, frame: Frame, way: Way) -> None:
        self._mistakes += 1
        if self._mistakes & (self._mistakes - 1) == 0:  # the 1st, 2nd, 4th, 8th, …: a flood of them is one story
            log.exception("%s from %s was not dealt with: %d mistakes so far", frame.subject, way, self._mistakes)

    def _spread(
        self, frame: Frame, hops: tuple[Way, ...], way: Way, now: float, patience_s: float = inf
    ) -> Verdict | None:
        """Send copies several ways; the verdict of the whole, None while a copy waits."""
        fate = Fate(frame, way, len(hops))
        final: Verdict | None = None
        for hop in hops:
            verdict = self._outlets[hop.link].offer(frame, hop.peer, way, now, patience_s, fate)
            if verdict is DELIVERED and way is SELF:  # while other copies may wait
                self.resident.delivered(frame, now)
            if verdict is not None:
                final = fate.settle(verdict)
        return final

    def _publish(self, frame: Frame, hops: tuple[Way, ...], way: Way) -> None:
        """Tell the bus of `frame`; of our own with the bytes that its first hop carries.

        What the robot of another broker says is told there.
        """
        if self.router.is_elsewhere(frame.source):
            return
        link = next((self.links[hop.link] for hop in hops if hop.link != MESH), None)
        if not frame.wire and link is not None:
            with suppress(EncodeError):
                frame = frame._replace(wire=link.codec.encode(frame))
        self.bus.publish(frame, way, self._wall_clock())

    def _ask(self, frame: Frame, hops: tuple[Way, ...], way: Way, now: float, age_s: float = 0.0) -> Verdict | None:
        """Hold a frame, which is `age_s` old, for an unknown robot, and ask for the robot."""
        robot = frame.destination
        if way is SELF or not self.holding.add(frame, way, now - age_s):
            return NO_ROUTE
        if self.holding.is_due(robot, now) and self._may_search(frame, now):
            self.holding.asked(robot, now)
            self._ask_on(robot, hops, now)
        return None

    def _look_elsewhere(self, frame: Frame, way: Way, now: float) -> Verdict | None:
        """A robot is searched for by the very way that leads to it: perhaps by a broker there that lost it."""
        hops = self.router.elsewhere(frame.destination, frame.protocol, way)
        return self._ask(frame, hops, way, now) if hops else SAME_WAY

    def _may_search(self, frame: Frame, now: float) -> bool:
        """Whether `frame` may have us ask for its destination; it may be another broker's search for the same."""
        return frame.subject not in _SEARCHES or self._searches.may(
            frame.destination, now, SEARCH_EVERY_S, SEARCHES_AT_ONCE
        )

    def _ask_on(self, robot: Address, hops: Iterable[Way], now: float, *, told: bool = False) -> None:
        questions: dict[Frame, list[Way]] = {}
        for hop in hops:
            frame = self._question(robot, hop.link)
            if told or self._may_say(frame, hop.link, now):
                questions.setdefault(frame, []).append(hop)
        account = self.accounts[SELF.link]
        for frame, asked in questions.items():
            self.resident.asked_names(asked, now)
            self.router.sent(frame, now)
            account.arrived += 1
            if self.bus.listened:
                self._publish(frame, tuple(asked), SELF)
            verdict = self._spread(frame, tuple(asked), SELF, now)
            if verdict is not None:
                self._settle(account, frame, verdict)

    def _question(self, robot: Address, link: str) -> Frame:
        """What makes `robot` speak: a name is asked for, a number is pinged, which moves nobody."""
        if robot.is_numbered:
            codec = cast(PsiuHexa.Options, self.links[link].configuration.codec)
            return psiu_hexa.packet(Address.numbered(codec.local, codec.domain), robot, b"")
        return psiu_ascii.message(self._own_name, robot, "qualseunome")

    def _may_say(self, frame: Frame, link: str, now: float, times: int = 1) -> bool:
        allowance = self.allowances.get(link)
        if allowance is None:  # the mesh
            return True
        try:
            size = len(self.links[link].codec.encode(frame))
        except EncodeError:
            size = 0
        return allowance.may(times * size * BITS_A_BYTE, now)


def _domain(codec: object) -> str | None:
    """Whose numbers a packet of a link can carry to a robot that is not known yet."""
    if isinstance(codec, PsiuHexa.Options) and codec.topology != "point-to-point":
        return codec.domain
    return None

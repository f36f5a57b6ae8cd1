"""What the broker says of itself, as messages: cards, links, routes, the ledger, and why."""

import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from shlex import quote
from typing import Final, Literal

from psiu_broker.exchange import Exchange
from psiu_broker.frame import EVERYONE, MESH, Address, Way, peer_text
from psiu_broker.link import Link
from psiu_broker.mesh.mesh import Mesh
from psiu_broker.messages import (
    Account,
    Card,
    Command,
    Conflict,
    Ledger,
    MeshBroker,
    MeshRobot,
    RobotAccount,
    Route,
    Why,
)
from psiu_broker.messages import Link as LinkMessage
from psiu_broker.messages import Mesh as MeshMessage
from psiu_broker.messages import Trunk as TrunkMessage
from psiu_broker.routing import table, verdicts
from psiu_broker.routing.books import Told
from psiu_broker.routing.claims import BEST
from psiu_broker.routing.guard import Refusal
from psiu_broker.routing.policy import Rule
from psiu_broker.routing.quarantine import Held
from psiu_broker.routing.router import SELF, Decision
from psiu_broker.trunk import Trunk


class Report:
    """Reads the exchange, changes nothing; `commands` tells what the robot of a route can do."""

    def __init__(
        self,
        broker: str,
        exchange: Exchange,
        commands: Callable[[table.Route], Sequence[Command]],
        trunks: Iterable[Trunk] = (),
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._broker = broker
        self._exchange = exchange
        self._router = exchange.router
        self._commands = commands
        self._trunks = trunks
        self._clock = clock

    def moment(self, at: float) -> datetime:
        """The wall clock's reading when the steady clock read `at`."""
        return datetime.fromtimestamp(time.time() - (self._clock() - at), UTC)

    def card(self, route: table.Route) -> Card:
        link = self._exchange.links[route.way.link]
        return Card(
            robot=str(route.robot),
            address=next((str(address) for address in route.addresses if address.is_numbered), None),
            protocol=route.protocol,
            broker=self._broker,
            link=link.name,
            peer=peer_text(route.way.peer),
            link_state=link.state,
            first_heard=None if route.first_heard is None else self.moment(route.first_heard),
            last_heard=None if route.heard_at is None else self.moment(route.heard_at),
            commands=list(self._commands(route)),
            frames_heard=route.frames,
        )

    def cards(self) -> Mapping[Address, Card]:
        return {route.robot: self.card(route) for route in self._router.robots()}

    def links(self) -> list[LinkMessage]:
        robots = self._router.robots()
        return [self._link(link, robots) for link in self._exchange.links.values()]

    def _link(self, link: Link, robots: Sequence[table.Route]) -> LinkMessage:
        p50, p99 = (
            None if ms is None else round(ms, 3) for ms in link.outbox.delays.ms(link.frames_out) or (None, None)
        )
        return LinkMessage(
            name=link.name,
            adapter=link.configuration.adapter_name,
            protocol=link.codec.protocol,
            state=link.state,
            reason=link.reason,
            since=self.moment(link.since),
            peers=[str(peer_text(way.peer)) for way in link.ways() if way.peer is not None],
            robots=sum(route.way.link == link.name for route in robots),
            frames_in=link.frames_in,
            frames_out=link.frames_out,
            malformed=link.malformed,
            queued=link.outbox.size,
            delay_p50_ms=p50,
            delay_p99_ms=p99,
            reopened=max(link.opened - 1, 0),
            unasked=self._exchange.allowances[link.name].refused,
            last_heard=None if link.last_heard is None else self.moment(link.last_heard),
            details=dict(link.details()),
        )

    def trunks(self) -> list[TrunkMessage]:
        return [
            TrunkMessage(
                name=trunk.name,
                adapter=trunk.configuration.adapter_name,
                state=trunk.state,
                reason=trunk.reason,
                since=self.moment(trunk.since),
                far=" ".join(trunk.far) or None,
                bytes_in=trunk.bytes_in,
                bytes_out=trunk.bytes_out,
                overruns=trunk.overruns,
            )
            for trunk in self._trunks
        ]

    def mesh(
        self,
        mesh: Mesh,
        mode: Literal["peer", "router"],
        zenoh_id: str = "",
        linked: Collection[str] = (),
        unreadable: int = 0,
    ) -> MeshMessage:
        """The other brokers as `mesh` knows them; `linked` are the Zenoh ids that a link of ours leads to."""
        now = self._clock()
        robots = [
            MeshRobot(
                robot=str(claim.robot),
                address=None if claim.number is None else str(claim.number),
                protocol=claim.protocol,
                owner=owner,
                link=claim.link,
                quality=claim.quality / BEST,
                age_s=claim.age_s,
                term=claim.term,
            )
            for owner, claim in mesh.claims
        ]
        owned = Counter(robot.owner for robot in robots)
        brokers = [
            MeshBroker(
                name=each.name,
                zenoh_id=each.zenoh_id,
                since=self.moment(each.since),
                rtt_ms=None if each.round_trip_s is None else round(each.round_trip_s * 1000, 3),
                silent_s=None if each.beat_at is None else round(now - each.beat_at, 3),
                frames_in=each.frames_in,
                frames_out=each.frames_out,
                lost=each.lost,
                robots=owned[each.name],
                linked=each.zenoh_id in linked,
            )
            for each in mesh.neighbours
        ]
        return MeshMessage(
            broker=self._broker,
            mode=mode,
            zenoh_id=zenoh_id,
            brokers=sorted(brokers, key=lambda broker: broker.name),
            robots=sorted(robots, key=lambda robot: robot.robot),
            conflicts=self._mesh_conflicts(mesh, now),
            redeclared=mesh.declared_anew,
            unreadable=unreadable,
        )

    def conflicts(self, mesh: Mesh) -> list[Conflict]:
        """Every name that is not one robot's, by name: on the links of this broker, and among brokers."""
        here = [self._held(each) for each in self._router.quarantine]
        return sorted(here + self._mesh_conflicts(mesh, self._clock()), key=lambda each: each.robot)

    def _held(self, held: Held) -> Conflict:
        links = ", ".join(sorted(held.links))
        return Conflict(
            robot=str(held.robot),
            brokers=[self._broker],
            since=self.moment(held.since),
            detail=f"{held.keeper} has the name, {links} is held back: rename that one, or let it in: "
            f"psiu conflicts --release {quote(str(held.robot))} {sorted(held.links)[0]}",
            link=held.keeper,
            held_back=sorted(held.links),
            frames=held.frames,
            last=self.moment(held.last),
        )

    def _mesh_conflicts(self, mesh: Mesh, now: float) -> list[Conflict]:
        return [self._conflict(*each) for each in mesh.conflicts(now)]

    def _conflict(self, name: str, brokers: Iterable[str], since: float, detail: str) -> Conflict:
        return Conflict(robot=name, brokers=sorted(brokers), since=self.moment(since), detail=detail)

    def routes(self) -> list[Route]:
        now = self._clock()
        return [self._route(route, now) for route in self._router.table if route.way != SELF]

    def _route(self, route: table.Route, now: float) -> Route:
        age_s = None if route.heard_at is None else now - route.heard_at
        if route.way.link == MESH:
            return Route(robot=str(route.robot), link=MESH, peer=peer_text(route.way.peer), origin="mesh")
        limit_s = self._exchange.links[route.way.link].configuration.options.route_age_s
        return Route(
            robot=str(route.robot),
            link=route.way.link,
            peer=peer_text(route.way.peer),
            origin="static" if route.pinned else "learned",
            age_s=None if age_s is None else round(age_s, 3),
            expires_in_s=None if route.pinned or age_s is None else round(limit_s - age_s, 3),
        )

    def ledger(self) -> Ledger:
        waiting = self._exchange.waiting()
        accounts = [_account(name, account, waiting[name]) for name, account in self._exchange.accounts.items()]
        whole = verdicts.Account(sum(account.arrived for account in accounts))
        for account in self._exchange.accounts.values():
            for verdict, count in account.fates.items():
                whole.fates[verdict] += count
        total = _account("total", whole, sum(waiting.values()))
        balances = all(map(_balances, accounts)) and _agree(total, list(self._router.books.told()))
        return Ledger(accounts=accounts, total=total, balances=balances)

    def robot_accounts(self) -> list[RobotAccount]:
        return [
            RobotAccount(
                robot=None if told.robot is None else str(told.robot),
                link=told.link,
                arrived=told.arrived,
                delivered=told.delivered,
                answered=told.answered,
                dropped={str(verdict): count for verdict, count in told.dropped.items()},
                waiting=told.waiting,
            )
            for told in self._router.books.told()
        ]

    def why(self, source: Address, destination: Address) -> Why:
        """What would become of a frame from `source` to `destination` now, step by step; nothing is sent."""
        origin = self._router.find(source)
        steps = [self._where(source, origin)]
        last = self._router.guard.last_refusal(source)
        arrived = origin.way if origin is not None else SELF if last is None else last.way
        target = self._router.find(destination)
        protocol = origin.protocol if origin is not None else target.protocol if target is not None else "psiu-ascii"
        decision = self._router.decide(destination, protocol, arrived)
        if destination != EVERYONE:
            steps.append(self._where(destination, target))
        steps.append(self._outcome(decision, destination, protocol, target))
        verdict = decision.verdict or _ENDS[decision.action]
        denied = self._policed(source, destination, arrived, steps) if decision.verdict is None else None
        if denied is not None:
            decision, verdict = Decision("drop", verdict=verdicts.DENIED), verdicts.DENIED
        if last is not None:
            steps.append(self._turned_away(source, origin, last))
        ways = decision.hops
        if not ways and target is not None and decision.action in ("translate", "drop"):
            ways = (target.way,)
        brokers = {str(way.peer) for way in ways if way.link == MESH} if decision.action in _MOVES else set()
        links = {way.link for way in ways if way.link in self._exchange.links}
        link = self._exchange.links[links.pop()] if len(links) == 1 else None
        heard_at = None if target is None else target.heard_at
        return Why(
            a=str(source),
            b=str(destination),
            delivered=verdict in verdicts.KEPT,
            verdict=verdict,
            steps=steps,
            broker=self._broker,
            entry=None if origin is None else origin.way.link,
            via=None if not brokers else brokers.pop() if len(brokers) == 1 else "*",
            link=None if link is None else link.name,
            age_s=None if heard_at is None else round(self._clock() - heard_at, 3),
            filter=self._filter(decision, protocol, arrived, target, link) if denied is None else str(denied),
            cost_ms=None if link is None or decision.verdict is not None else _cost_ms(link),
        )

    def _policed(self, source: Address, destination: Address, arrived: Way, steps: list[str]) -> Rule | None:
        """What denies commands from one to the other, whatever they are; `steps` tells of it, and of single ones."""
        policy = self._router.policy
        if policy is None:
            return None
        some, rest = policy.about(source, destination, arrived)
        steps += [f"some commands: {rule}" for rule in some]
        if rest is not None:
            steps.append(f"{'other ' if some else ''}commands are denied, not answers and questions: {rest}")
        return rest

    def _turned_away(self, source: Address, origin: table.Route | None, last: Refusal) -> str:
        """The last frame in the name of `source` that was not listened to."""
        ago_s = self._clock() - last.at
        match last.verdict:
            case "spoofed" if origin is not None and origin.way == SELF:
                reason = f"{source} is this broker itself"
            case "spoofed" if origin is not None:
                reason = f"the configuration puts {source} on {origin.home}"
            case "denied":
                reason = str(last.rule)
            case "refused":
                reason = f"nobody is called {source}"
            case _:
                reason = _REASONS.get(last.verdict, verdicts.MEANINGS[last.verdict])
        what = f"{last.subject or 'a frame'} for {last.destination} from {last.way}"
        count = f"{last.count} frames of {source}, the last" if last.count > 1 else f"a frame of {source}"
        return f"turned away: {count} {ago_s:.1f} s ago, {what} ({last.verdict}): {reason}"

    def _where(self, address: Address, route: table.Route | None) -> str:
        now = self._clock()
        if route is None:
            departed = self._router.table.departed(address)
            if departed is None:
                return f"{address} has not been heard on any link"
            place = "with another broker" if departed.link == MESH else f"on {departed.link}"
            return f"{address} was {place} until {now - departed.at:.1f} s ago; its route was withdrawn"
        if route.way == SELF:
            return f"{address} is this broker"
        if route.way.link == MESH:
            broker = peer_text(route.way.peer)
            return f"{address} is a broker" if broker == str(address) else f"{address} is with broker {broker}"
        link = self._exchange.links[route.way.link]
        state = "open" if link.state == "open" else f"{link.state} ({link.reason})"
        heard = "not heard yet" if route.heard_at is None else f"last heard {now - route.heard_at:.1f} s ago"
        kind = "by the configuration" if route.pinned else "learned"
        return f"{address} is on {route.way} ({kind}, {heard}); link {link.name} is {state}"

    def _outcome(self, decision: Decision, destination: Address, protocol: str, target: table.Route | None) -> str:
        match decision.action:
            case "forward" | "flood" if decision.hops:
                return f"sent to {', '.join(map(str, decision.hops))}"
            case "answer" | "flood":
                return "the broker answers it"
            case "translate" if decision.verdict is None:
                return f"{destination} speaks {target and target.protocol}: the broker asks it and answers in its name"
            case "ask":
                asked = ", ".join(map(str, decision.hops))
                return (
                    f"held for a moment while {destination} is asked for on {asked}; dropped (no_route) if it is silent"
                )
            case _:
                return f"dropped ({decision.verdict}): {_REASONS.get(str(decision.verdict), '')}"

    def _filter(
        self, decision: Decision, protocol: str, arrived: Way, target: table.Route | None, link: Link | None
    ) -> str | None:
        """What did or could stop a frame, or keeps it from some links."""
        match decision.action:
            case "drop" | "translate" if decision.verdict is not None:
                return self._stopped(decision, protocol, arrived, target, link)
            case "flood" | "ask":
                kept = [
                    each.name
                    for each in self._exchange.links.values()
                    if each.codec.protocol == protocol and not each.configuration.options.wildcard
                ]
                return f"wildcard = false: not on {', '.join(kept)}" if kept else None
            case "translate":
                return f"translation: what {target and target.protocol} cannot say is answered with falha"
            case "forward" if link is not None:
                limit_s = link.configuration.options.max_age_s
                return f"max_age_s = {limit_s:g}: dropped if it has to wait longer for {link.name}"
            case _:
                return None

    def _stopped(
        self, decision: Decision, protocol: str, arrived: Way, target: table.Route | None, link: Link | None
    ) -> str:
        match decision.verdict:
            case "same_way" if target is not None and target.way == SELF:
                return "a broker sends itself nothing"
            case "same_way" if arrived.link == MESH:
                return "split horizon: what comes from a broker is not handed to a broker"
            case "same_way" if target is not None and target.way.link == MESH:
                return f"split horizon: {target.robot} is on {arrived} too, and has heard it there"
            case "same_way":
                return f"split horizon: what comes on {arrived} does not leave on it"
            case "refused" if target is not None:
                return f"no translation from {protocol} to {target.protocol}"
            case "link_down" if link is not None:
                return f"{link.name} is {link.state}"
            case _:
                return str(_REASONS.get(str(decision.verdict), decision.verdict))


_ENDS: Final[Mapping[str, verdicts.Verdict]] = {
    "forward": verdicts.DELIVERED,
    "flood": verdicts.DELIVERED,
    "answer": verdicts.ANSWERED,
    "translate": verdicts.ANSWERED,
    "ask": verdicts.NO_ROUTE,
}
"""How a frame ends, as far as can be told beforehand."""

_MOVES: Final = frozenset({"forward", "flood", "translate"})
"""The actions that hand a frame, or its meaning, on."""

_BITS_A_BYTE: Final = 10
_USUAL_BYTES: Final[Mapping[str, int]] = {"psiu-ascii": 40, "psiu-hexa": 6}
"""How long a frame is for which the cost is told: ``base 040 parafrente sucesso MNERIM 03012``."""

_REASONS = {
    "no_route": "nobody knows it, and there is no open link to ask on",
    "same_way": "both are on one line, where it was heard already",
    "link_down": "its link is down",
    "refused": "it speaks another protocol, and there is no translation",
    "too_many_names": "more new names than new_names_per_minute came on that link",
    "quarantined": "a robot on another link has that name: psiu conflicts",
    "storm": "too many frames to everyone came from that link",
}


def _cost_ms(link: Link) -> float:
    """How long a frame offered now would take until its last bit is on the wire, the frame under way left out."""
    waiting = sum(len(parcel.wire) for parcel in link.outbox) + _USUAL_BYTES.get(link.codec.protocol, 0)
    bits_per_second = link.adapter.bits_per_second
    return 0.0 if bits_per_second is None else round(waiting * _BITS_A_BYTE * 1000 / bits_per_second, 3)


def _account(name: str, account: verdicts.Account, waiting: int) -> Account:
    dropped: dict[str, int] = {str(verdict): count for verdict, count in account.dropped().items() if count}
    return Account(
        link=name,
        arrived=account.arrived,
        delivered=account.fates[verdicts.DELIVERED],
        answered=account.fates[verdicts.ANSWERED],
        dropped=dropped,
        waiting=waiting,
    )


def _agree(total: Account, robots: Sequence[Told]) -> bool:
    """Whether the robots' books, which are kept apart from the links', add up to `total`."""
    dropped: Counter[str] = Counter()
    for robot in robots:
        dropped.update({str(verdict): count for verdict, count in robot.dropped.items()})
    sums = [sum(getattr(each, what) for each in robots) for what in ("arrived", "delivered", "answered", "waiting")]
    return (
        sums == [total.arrived, total.delivered, total.answered, total.waiting]
        and dropped == total.dropped
        and all(robot.delivered >= 0 for robot in robots)
    )


def _balances(account: Account) -> bool:
    return account.arrived == account.delivered + account.answered + sum(account.dropped.values()) + account.waiting

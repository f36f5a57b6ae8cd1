"""What the broker says of itself, as messages: cards, links, routes, the ledger, and why."""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Final

from psiu_broker.exchange import Exchange
from psiu_broker.frame import EVERYONE, Address, peer_text
from psiu_broker.link import Link
from psiu_broker.messages import Account, Card, Command, Ledger, Route, Why
from psiu_broker.messages import Link as LinkMessage
from psiu_broker.messages import Trunk as TrunkMessage
from psiu_broker.routing import table, verdicts
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
            reopened=max(link.opened - 1, 0),
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

    def routes(self) -> list[Route]:
        now = self._clock()
        return [self._route(route, now) for route in self._router.robots()]

    def _route(self, route: table.Route, now: float) -> Route:
        age_s = None if route.heard_at is None else now - route.heard_at
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
        return Ledger(accounts=accounts, total=total, balances=all(map(_balances, accounts)))

    def why(self, source: Address, destination: Address) -> Why:
        """What would become of a frame from `source` to `destination` now, step by step; nothing is sent."""
        origin = self._router.find(source)
        steps = [self._where(source, origin)]
        arrived = SELF if origin is None else origin.way
        target = self._router.find(destination)
        protocol = origin.protocol if origin is not None else target.protocol if target is not None else "psiu-ascii"
        decision = self._router.decide(destination, protocol, arrived)
        if destination != EVERYONE:
            steps.append(self._where(destination, target))
        steps.append(self._outcome(decision, destination, protocol, target))
        verdict = decision.verdict or _ENDS[decision.action]
        delivered = verdict in verdicts.KEPT
        return Why(a=str(source), b=str(destination), delivered=delivered, verdict=verdict, steps=steps)

    def _where(self, address: Address, route: table.Route | None) -> str:
        now = self._clock()
        if route is None:
            departed = self._router.table.departed(address)
            if departed is None:
                return f"{address} has not been heard on any link"
            return f"{address} was on {departed.link} until {now - departed.at:.1f} s ago; its route was withdrawn"
        if route.way == SELF:
            return f"{address} is this broker"
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
            case "translate":
                return f"{destination} speaks {target and target.protocol}: the broker asks it and answers in its name"
            case "ask":
                asked = ", ".join(map(str, decision.hops))
                return (
                    f"held for a moment while {destination} is asked for on {asked}; dropped (no_route) if it is silent"
                )
            case _:
                return f"dropped ({decision.verdict}): {_REASONS.get(str(decision.verdict), '')}"


_ENDS: Final[Mapping[str, verdicts.Verdict]] = {
    "forward": verdicts.DELIVERED,
    "flood": verdicts.DELIVERED,
    "answer": verdicts.ANSWERED,
    "translate": verdicts.ANSWERED,
    "ask": verdicts.NO_ROUTE,
}
"""How a frame ends, as far as can be told beforehand."""

_REASONS = {
    "no_route": "nobody knows it, and there is no open link to ask on",
    "same_way": "both are on one line, where it was heard already",
    "link_down": "its link is down",
    "refused": "it speaks another protocol, and there is no translation",
}


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


def _balances(account: Account) -> bool:
    return account.arrived == account.delivered + account.answered + sum(account.dropped.values()) + account.waiting

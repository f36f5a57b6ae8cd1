"""What programs may ask the broker itself: its status and tables, and the robots' cards."""

import logging
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final, Protocol

import zenoh

from psiu_broker.bus.keys import Keys, robot, text
from psiu_broker.bus.replies import Replies, Values
from psiu_broker.bus.session import JSON, Session, json_of
from psiu_broker.errors import CallError
from psiu_broker.frame import Address
from psiu_broker.messages import Card, Conflict, Health, Ledger, Link, Mesh, RobotAccount, Route, Status, Trunk, Why

logger = logging.getLogger(__name__)

AT_ONCE_MAX: Final = 64
"""Queries being answered; one more is refused as busy."""

RING: Final = 1024

TURN_MAX: Final = 1
"""Queries that one turn of the loop handles: a table of all robots is work."""


class Source(Protocol):
    """The broker as its queries see it; each method returns at once with values that change no more."""

    def status(self) -> Status: ...
    def links(self) -> Sequence[Link]: ...
    def trunks(self) -> Sequence[Trunk]: ...
    def routes(self) -> Sequence[Route]: ...
    def ledger(self) -> Ledger: ...
    def robot_accounts(self) -> Sequence[RobotAccount]: ...
    def health(self) -> Health: ...
    def mesh_seen(self) -> Mesh: ...
    def conflicts(self) -> Sequence[Conflict]: ...
    def config(self) -> Mapping[str, Any]: ...
    def why(self, a: Address, b: Address) -> Why: ...
    def release(self, robot: Address, link: str) -> bool: ...
    def robots(self) -> Iterable[Address]: ...
    def card(self, robot: Address) -> Card | None: ...


class Queries:
    """Answers ``psiu/@broker/{broker}/…`` and ``psiu/{robot}``; lists are JSON arrays.

    A query with wildcards gets every answer that it covers, each on its own key, except
    ``why/{a}/{b}``, which must name two robots, and ``release/{robot}/{link}``, after which the
    robot on that link is no longer held back: its answer is what conflicts are left.
    """

    def __init__(self, session: Session, keys: Keys, broker: str, source: Source) -> None:
        self._session = session
        self._replies = Replies(session, "bus-query")
        self._keys = keys
        self._broker = broker
        self._source = source
        self._room = threading.BoundedSemaphore(AT_ONCE_MAX)
        self._tables: Final[Mapping[str, tuple[zenoh.Encoding, Callable[[], object]]]] = {
            keys.broker(broker, "status"): (json_of("Status"), source.status),
            keys.broker(broker, "links"): (json_of("Link[]"), source.links),
            keys.broker(broker, "trunks"): (json_of("Trunk[]"), source.trunks),
            keys.broker(broker, "routes"): (json_of("Route[]"), source.routes),
            keys.broker(broker, "ledger"): (json_of("Ledger"), source.ledger),
            keys.broker(broker, "ledger-of-robots"): (json_of("RobotAccount[]"), source.robot_accounts),
            keys.broker(broker, "health"): (json_of("Health"), source.health),
            keys.broker(broker, "mesh"): (json_of("Mesh"), source.mesh_seen),
            keys.broker(broker, "conflicts"): (json_of("Conflict[]"), source.conflicts),
            keys.broker(broker, "config"): (JSON, source.config),
        }

    @classmethod
    async def open(cls, session: Session, keys: Keys, broker: str, source: Source) -> "Queries":
        """Answer from now on.

        Raises:
            BusError: the session is closed or lost.
        """
        queries = cls(session, keys, broker, source)
        for key, values in (
            (keys.broker(broker, "**"), queries._broker_values),
            (keys.every_card, queries._card_values),
        ):
            await queries._declare(key, values)
        return queries

    async def _declare(self, key: str, values: Callable[[zenoh.KeyExpr], Values]) -> None:
        await self._session.serve(
            lambda: self._session.zenoh.declare_queryable(key, zenoh.handlers.RingChannel(RING)),
            self._sift,
            lambda query: self._answer(query, values),
            name="bus-queries",
            turn_max=TURN_MAX,
        )

    def _sift(self, query: zenoh.Query) -> zenoh.Query | None:
        if self._room.acquire(blocking=False):
            return query
        self._replies.turn_away(query, CallError("busy", f"{AT_ONCE_MAX} queries are being answered already"))
        return None

    def _answer(self, query: zenoh.Query, values: Callable[[zenoh.KeyExpr], Values]) -> None:
        try:
            reply = self._replies.answer(query, values(query.key_expr))
        except CallError as error:
            reply = self._replies.refuse(query, error)
        except Exception:
            logger.exception("a query of %s failed inside the broker", query.key_expr)
            reply = self._replies.refuse(query, CallError("impossible", "the broker failed; its log says how"))
        reply.add_done_callback(lambda _: self._room.release())

    def _broker_values(self, asked: zenoh.KeyExpr) -> Values:
        values = {key: (encoding, table()) for key, (encoding, table) in self._tables.items() if asked.intersects(key)}
        if values:
            return values
        try:
            _, what = self._keys.read_broker(str(asked))
            if what[:1] == ["trace"] and len(what) == 3:
                return {}  # `Traces` answers
            if what[:1] == ["release"] and len(what) == 3 and "*" not in "".join(what):
                return self._release("/".join(what[1:]), robot(what[1]), text(what[2]))
            pair = [robot(each) for each in what[1:]] if what[:1] == ["why"] and "*" not in "".join(what) else []
        except ValueError as error:
            raise CallError("bad_request", str(error)) from error
        if len(pair) == 2:
            key = "/".join((self._keys.broker(self._broker, "why"), *what[1:]))
            return {key: (json_of("Why"), self._source.why(*pair))}
        raise CallError(
            "bad_request", f"{asked} is none of {', '.join(self._tables)}, why/A/B, trace/A/B and release/A/LINK"
        )

    def _release(self, chunks: str, which: Address, link: str) -> Values:
        if not self._source.release(which, link):
            raise CallError("bad_request", f"no {which} is held back on {link}: psiu conflicts lists who is")
        key = f"{self._keys.broker(self._broker, 'release')}/{chunks}"
        return {key: (json_of("Conflict[]"), self._source.conflicts())}

    def _card_values(self, asked: zenoh.KeyExpr) -> Values:
        key = str(asked)
        if "*" not in key:
            try:
                known = {key: self._keys.read_card(key)}
            except ValueError:  # not a name: nobody has it
                known = {}
        else:
            every = {self._keys.card(robot): robot for robot in self._source.robots()}
            known = {key: robot for key, robot in every.items() if asked.intersects(key)}
        cards = {key: self._source.card(robot) for key, robot in known.items()}
        return {key: (json_of("Card"), card) for key, card in cards.items() if card is not None}

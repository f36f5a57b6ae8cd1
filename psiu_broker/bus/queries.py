"""What programs may ask the broker itself: its status and tables, and the robots' cards."""

import asyncio
import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Protocol

import zenoh
from pydantic_core import to_json

from psiu_broker.bus.calls import refuse
from psiu_broker.bus.keys import Keys, robot
from psiu_broker.bus.session import JSON, Session, json_of, plain
from psiu_broker.errors import BusError, CallError
from psiu_broker.frame import Address
from psiu_broker.messages import Card, Health, Ledger, Link, Route, Status, Why

logger = logging.getLogger(__name__)

AT_ONCE_MAX: Final = 64
"""Queries being answered; one more is refused as busy."""

RING: Final = 1024


class Source(Protocol):
    """The broker as its queries see it; each method returns at once with values that change no more."""

    def status(self) -> Status: ...
    def links(self) -> Sequence[Link]: ...
    def routes(self) -> Sequence[Route]: ...
    def ledger(self) -> Ledger: ...
    def health(self) -> Health: ...
    def config(self) -> Mapping[str, Any]: ...
    def why(self, a: Address, b: Address) -> Why: ...
    def cards(self) -> Mapping[Address, Card]: ...


Values = Mapping[str, tuple[zenoh.Encoding, object]]
"""What a query is told, by key: an encoding and a value that `to_json` takes."""


class Queries:
    """Answers ``psiu/@broker/{broker}/…`` and ``psiu/{robot}``; lists are JSON arrays.

    A query with wildcards gets every answer that it covers, each on its own key, except
    ``why/{a}/{b}``, which must name two robots.
    """

    def __init__(self, session: Session, keys: Keys, broker: str, source: Source) -> None:
        self._session = session
        self._keys = keys
        self._broker = broker
        self._source = source
        self._room = threading.BoundedSemaphore(AT_ONCE_MAX)
        self._tables: Final[Mapping[str, tuple[zenoh.Encoding, Callable[[], object]]]] = {
            keys.broker(broker, "status"): (json_of("Status"), source.status),
            keys.broker(broker, "links"): (json_of("Link[]"), source.links),
            keys.broker(broker, "routes"): (json_of("Route[]"), source.routes),
            keys.broker(broker, "ledger"): (json_of("Ledger"), source.ledger),
            keys.broker(broker, "health"): (json_of("Health"), source.health),
            keys.broker(broker, "config"): (JSON, source.config),
        }

    @classmethod
    async def open(cls, session: Session, keys: Keys, broker: str, source: Source) -> "Queries":
        """Answer from now on.

        Raises:
            BusError: the session is closed or lost.
        """
        queries = cls(session, keys, broker, source)
        try:
            for key, values in (
                (keys.broker(broker, "**"), queries._broker_values),
                (keys.every_card, queries._card_values),
            ):
                await queries._declare(key, values)
        except zenoh.ZError as error:
            raise BusError(f"zenoh: {plain(error)}") from error
        return queries

    async def round_trip(self, timeout_s: float) -> float:
        """Ask ourselves for the status through Zenoh and the loop; return the seconds it took.

        Raises:
            BusError: no answer within `timeout_s`.
        """

        def ask() -> float:
            begun = time.monotonic()
            replies = self._session.zenoh.get(
                self._keys.broker(self._broker, "status"),
                timeout=timeout_s,
                allowed_destination=zenoh.Locality.SESSION_LOCAL,
            )
            if not any(reply.ok for reply in replies):
                raise BusError(f"the bus did not answer within {timeout_s} s")
            return time.monotonic() - begun

        try:
            return await asyncio.to_thread(ask)
        except zenoh.ZError as error:
            raise BusError(f"zenoh: {plain(error)}") from error
        except BaseException as error:
            if not self._session.panicked(error):
                raise
            raise BusError(f"zenoh: {plain(error)}") from error

    async def _declare(self, key: str, values: Callable[[zenoh.KeyExpr], Values]) -> None:
        queryable = await asyncio.to_thread(
            self._session.zenoh.declare_queryable, key, zenoh.handlers.RingChannel(RING)
        )
        self._session.declared(queryable)
        self._session.bridge(queryable, self._sift, lambda query: self._answer(query, values), name="bus-queries")

    def _sift(self, query: zenoh.Query) -> zenoh.Query | None:
        if self._room.acquire(blocking=False):
            return query
        refuse(query, CallError("busy", f"{AT_ONCE_MAX} queries are being answered already"))
        return None

    def _answer(self, query: zenoh.Query, values: Callable[[zenoh.KeyExpr], Values]) -> None:
        try:
            reply = self._session.off_loop(_reply, query, values(query.key_expr))
        except CallError as error:
            reply = self._session.off_loop(refuse, query, error)
        except Exception:
            logger.exception("a query of %s failed inside the broker", query.key_expr)
            failed = CallError("impossible", "the broker failed; its log says how")
            reply = self._session.off_loop(refuse, query, failed)
        reply.add_done_callback(self._ended)

    def _ended(self, reply: "asyncio.Future[None]") -> None:
        self._room.release()
        error = None if reply.cancelled() else reply.exception()
        if error is not None and not self._session.panicked(error):
            logger.error("a query could not be answered", exc_info=error)

    def _broker_values(self, asked: zenoh.KeyExpr) -> Values:
        values = {key: (encoding, table()) for key, (encoding, table) in self._tables.items() if asked.intersects(key)}
        if values:
            return values
        try:
            _, what = self._keys.read_broker(str(asked))
            pair = [robot(each) for each in what[1:]] if what[:1] == ["why"] and "*" not in "".join(what) else []
        except ValueError as error:
            raise CallError("bad_request", str(error)) from error
        if len(pair) == 2:
            key = "/".join((self._keys.broker(self._broker, "why"), *what[1:]))
            return {key: (json_of("Why"), self._source.why(*pair))}
        raise CallError("bad_request", f"{asked} is none of {', '.join(self._tables)} and why/A/B")

    def _card_values(self, asked: zenoh.KeyExpr) -> Values:
        cards = {self._keys.card(robot): card for robot, card in self._source.cards().items()}
        return {key: (json_of("Card"), card) for key, card in cards.items() if asked.intersects(key)}


def _reply(query: zenoh.Query, values: Values) -> None:
    """Reply with each of `values` on its key; may wait for a slow asker."""
    with query:
        for key, (encoding, value) in values.items():
            try:
                query.reply(key, to_json(value), encoding=encoding)
            except zenoh.ZError as error:
                logger.debug("a reply found no asker: %s", plain(error))
                return

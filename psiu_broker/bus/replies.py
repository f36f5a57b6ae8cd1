"""Ending the queries of other programs in a thread that may wait for an asker: no other thread ever does."""

import asyncio
import logging
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Final

import zenoh
from pydantic_core import to_json

from psiu_broker.bus.session import Session, json_of, plain
from psiu_broker.errors import CallError
from psiu_broker.messages import Refusal

logger = logging.getLogger(__name__)

Values = Mapping[str, tuple[zenoh.Encoding, object]]
"""What a query is told, by key: an encoding and a value that `to_json` takes."""

TURNED_AWAY_MAX: Final = 4096
"""Queries that may wait to hear that there is no room; one more hears nothing."""

SENT_S: Final = 3.0
"""How long a broker that stops waits for programs to read their replies: several may be stuck, one after another."""

_REFUSAL: Final = json_of("Refusal")


class Replies:
    """The replies of one queryable, in a thread of its own: those of another one never wait for them.

    An asker that does not read holds them up for `STUCK_S`, once. More threads would be worse: inside
    Zenoh they wait for one another, each for a `STUCK_S` of its own. No method blocks or raises. A
    future holds nothing; it is done when its query has ended.
    """

    def __init__(self, session: Session, name: str) -> None:
        self._session = session
        self._worker = session.worker(name)
        self._away_room = threading.BoundedSemaphore(TURNED_AWAY_MAX)
        self._pending: set[Future[None]] = set()

    def answer(self, query: zenoh.Query, values: Values) -> "Future[None]":
        """End `query` with each of `values` on its key. On the loop."""
        return self._kept(self._submit(_answer, query, values))

    def refuse(self, query: zenoh.Query, error: CallError) -> "Future[None]":
        """End `query` with an error reply. On the loop."""
        return self._kept(self._submit(_refuse, query, error))

    def turn_away(self, query: zenoh.Query, error: CallError) -> None:
        """Refuse a query that was not let in. In the thread that reads queries."""
        if self._away_room.acquire(blocking=False):
            refused = self._submit(_refuse, query, error)
            refused.add_done_callback(lambda _: self._away_room.release())

    def drop(self, query: zenoh.Query) -> None:
        """End a query without a word: another copy of it is answered. In the thread that reads queries."""
        if self._away_room.acquire(blocking=False):
            dropped = self._submit(_answer, query, {})
            dropped.add_done_callback(lambda _: self._away_room.release())

    async def sent(self) -> None:
        """Wait for what `answer` and `refuse` have on its way out, for at most `SENT_S`."""
        if self._pending:
            await asyncio.wait([asyncio.wrap_future(reply) for reply in tuple(self._pending)], timeout=SENT_S)

    def _kept(self, reply: "Future[None]") -> "Future[None]":
        self._pending.add(reply)
        reply.add_done_callback(self._pending.discard)
        return reply

    def _submit(self, work: Callable[..., None], *arguments: object) -> "Future[None]":
        try:
            return self._worker.submit(self._end, work, *arguments)
        except RuntimeError:  # the session is closed, and the query with it
            ended: Future[None] = Future()
            ended.set_result(None)
            return ended

    def _end(self, work: Callable[..., None], *arguments: object) -> None:
        try:
            work(*arguments)
        except zenoh.ZError as error:
            logger.debug("a reply found no asker: %s", plain(error))
        except BaseException as error:
            if not self._session.panicked(error):
                logger.exception("a query could not be answered")


def _answer(query: zenoh.Query, values: Values) -> None:
    with query:
        for key, (encoding, value) in values.items():
            query.reply(key, to_json(value), encoding=encoding)


def _refuse(query: zenoh.Query, error: CallError) -> None:
    with query:
        query.reply_err(Refusal(error=error.code, message=str(error)).model_dump_json(), encoding=_REFUSAL)

"""Asking ourselves through Zenoh and the loop: what the watchdog looks at. No other program is in the way."""

import time
from typing import Final

import zenoh

from psiu_broker.bus.keys import Keys
from psiu_broker.bus.replies import Replies
from psiu_broker.bus.session import JSON, Session, aside, plain
from psiu_broker.errors import BusError

RING: Final = 4


class RoundTrip:
    """A question that only this session hears, on ``psiu/@alive/{broker}``."""

    def __init__(self, session: Session, key: str) -> None:
        self._session = session
        self._key = key
        self._replies = Replies(session, "bus-alive")

    @classmethod
    async def open(cls, session: Session, keys: Keys, broker: str) -> "RoundTrip":
        """Answer from now on.

        Raises:
            BusError: the session is closed or lost.
        """
        trip = cls(session, keys.alive(broker))

        def declare() -> zenoh.Queryable[zenoh.Handler[zenoh.Query]]:
            ring: zenoh.handlers.RingChannel[zenoh.Query] = zenoh.handlers.RingChannel(RING)
            return session.zenoh.declare_queryable(trip._key, ring, allowed_origin=zenoh.Locality.SESSION_LOCAL)

        await session.serve(declare, lambda query: query, trip._answer, name="bus-alive")
        return trip

    async def measure(self, timeout_s: float) -> float:
        """The seconds that a question took to come back.

        Raises:
            BusError: no answer within `timeout_s`.
        """
        try:
            return await aside(self._ask, timeout_s)
        except zenoh.ZError as error:
            raise BusError(f"zenoh: {plain(error)}") from error
        except BaseException as error:
            if not self._session.panicked(error):
                raise
            raise BusError(f"zenoh: {plain(error)}") from error

    def _ask(self, timeout_s: float) -> float:
        begun = time.monotonic()
        local = zenoh.Locality.SESSION_LOCAL
        replies = self._session.zenoh.get(self._key, timeout=timeout_s, allowed_destination=local)
        if not any(reply.ok for reply in replies):
            raise BusError(f"the bus did not answer within {timeout_s} s")
        return time.monotonic() - begun

    def _answer(self, query: zenoh.Query) -> None:
        self._replies.answer(query, {self._key: (JSON, True)})

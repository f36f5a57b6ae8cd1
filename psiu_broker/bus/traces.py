"""Traces for programs, and the questions that brokers ask one another for them.

psiu/@broker/{broker}/trace/{a}/{b}    get: `Trace`, from the broker that has `a`; the others say nothing
psiu/@mesh/probe/{broker}/{robot}      get, by another broker: `mesh.probe.Probed`
"""

import asyncio
import logging
import threading
from collections.abc import Awaitable, Callable, Sequence
from typing import Any, Final, Literal

import zenoh
from pydantic import BaseModel, ValidationError

from psiu_broker.bus.keys import Keys, chunk, robot, robot_chunk
from psiu_broker.bus.replies import Replies
from psiu_broker.bus.session import Session, aside, json_of, plain
from psiu_broker.bus.work import Work
from psiu_broker.errors import BusError, CallError
from psiu_broker.frame import Address
from psiu_broker.mesh.probe import Probed, Stamp
from psiu_broker.messages import Trace

logger = logging.getLogger(__name__)

AT_ONCE_MAX: Final = 16
"""Traces and probes under way; one more is refused as busy."""
RING: Final = 64

Make = Callable[[Address, Address], Awaitable[Trace | None]]
"""Trace; None where another broker has `a`."""
Look = Callable[[Address], Awaitable[Probed]]

_POINTS: Final[tuple[tuple[Any, Literal["send", "route", "receive"]], ...]] = (
    (zenoh.InterceptionPoint.SEND, "send"),
    (zenoh.InterceptionPoint.ROUTE, "route"),
    (zenoh.InterceptionPoint.RECEIVE, "receive"),
)
"""No mapping: Zenoh's have no hash."""


class Traces:
    """Serves both keys, and asks the second one of other brokers. Each question is a task of its own."""

    def __init__(self, session: Session, keys: Keys, broker: str) -> None:
        self._session = session
        self._keys = keys
        self._broker = broker
        self._probes = f"{keys.prefix}/@mesh/probe"
        self._replies = Replies(session, "bus-trace")
        self._room = threading.BoundedSemaphore(AT_ONCE_MAX)
        self._work = Work(self._replies)

    @classmethod
    async def open(cls, session: Session, keys: Keys, broker: str, make: Make, look: Look) -> "Traces":
        """Answer from now on.

        Raises:
            BusError: the session is closed or lost.
        """
        traces = cls(session, keys, broker)

        async def trace(key: str) -> BaseModel | None:
            a, b = keys.read_broker(key)[1][1:]
            return await make(robot(a), robot(b))

        async def probed(key: str) -> BaseModel | None:
            return await look(robot(key.rpartition("/")[2]))

        every = keys.broker(broker, "trace")
        await traces._serve(f"{every}/*/*", lambda key: every + "/" + "/".join(key.split("/")[-2:]), "Trace", trace)
        await traces._serve(f"{traces._probes}/{chunk(broker)}/*", lambda key: key, "Probed", probed)
        return traces

    async def close(self) -> None:
        """End what is under way; before `Session.close`."""
        await self._work.close()

    async def probe(self, owner: str, which: Address, timeout_s: float) -> tuple[Probed, Sequence[Stamp]]:
        """Have broker `owner` ask its robot, and Zenoh note where question and answer pass.

        Raises:
            BusError: no answer, or none that can be read, within `timeout_s`.
        """
        key = f"{self._probes}/{chunk(owner)}/{robot_chunk(which)}"
        try:
            return await aside(self._ask, key, owner, timeout_s)
        except (zenoh.ZError, ValidationError) as error:
            raise BusError(f"the answer of broker {owner}: {plain(error)}") from error
        except BaseException as error:
            if not self._session.panicked(error):
                raise
            raise BusError(f"zenoh: {plain(error)}") from error

    def _ask(self, key: str, owner: str, timeout_s: float) -> tuple[Probed, Sequence[Stamp]]:
        points = zenoh.TimestampInstrumentationBuilder().set_send(True).set_route(True).set_receive(True).build()
        refused = ""
        for reply in self._session.zenoh.get(key, timeout=timeout_s, timestamp_instrumentation=points):
            if reply.ok is not None:
                return Probed.model_validate_json(reply.ok.payload.to_bytes()), _stamps(reply.ok.timestamp_stack)
            refused = "" if reply.err is None else reply.err.payload.to_string()[:200]
        raise BusError(f"broker {owner} did not answer" + (f": {refused}" if refused else ""))

    async def _serve(
        self, key: str, own: Callable[[str], str], schema: str, work: Callable[[str], Awaitable[BaseModel | None]]
    ) -> None:
        """Answer each query under `key` with what `work` makes of its key, on the key `own` makes of it."""
        ring: Any = zenoh.handlers.RingChannel(RING)
        encoding = json_of(schema)

        async def answer(query: zenoh.Query) -> None:
            asked = str(query.key_expr)
            # A question names its robots; what wildcards cover is asked nothing.
            named = not any("*" in part for part in asked.split("/")[-2:])
            try:
                value = await work(asked) if named and not self._work.closed else None
                reply = self._replies.answer(query, {} if value is None else {own(asked): (encoding, value)})
            except (CallError, ValueError) as error:
                reply = self._replies.refuse(query, CallError("bad_request", str(error)))
            except asyncio.CancelledError:
                reply = self._replies.refuse(query, CallError("shutting_down", "the broker is stopping"))
            except Exception:
                logger.exception("%s failed inside the broker", asked)
                reply = self._replies.refuse(query, CallError("impossible", "the broker failed; its log says how"))
            reply.add_done_callback(lambda _: self._room.release())

        await self._session.serve(
            lambda: self._session.zenoh.declare_queryable(key, ring),
            self._sift,
            lambda query: self._work.begin(answer(query)),
            name="bus-traces",
        )

    def _sift(self, query: zenoh.Query) -> zenoh.Query | None:
        if self._room.acquire(blocking=False):
            return query
        self._replies.turn_away(query, CallError("busy", f"{AT_ONCE_MAX} traces are under way already"))
        return None


def _stamps(stack: Any) -> list[Stamp]:
    """Zenoh's records; none where the session offers none."""
    if stack is None:
        return []
    found = []
    for record in stack.records:
        stamp = record.timestamp()
        # The id's bytes come the other way round.
        zenoh_id = bytes(stamp.get_id())[::-1].hex().lstrip("0")
        point = next(word for each, word in _POINTS if each == record.point)
        found.append(Stamp(zenoh_id, point, stamp.get_time().timestamp() * 1000))
    return found

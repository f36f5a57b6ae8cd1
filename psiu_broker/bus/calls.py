"""Calls from programs to robots: ``psiu/@call/{robot}/{command}``.

A get is a call: it ends with the robot's `Answer` or a `Refusal`, always. A put is a command sent
without waiting for either. Zenoh does not tell how long an asker will wait: the deadline is the
request's `timeout_s`, or the backend's own.
"""

import asyncio
import logging
import math
import threading
from collections.abc import Awaitable, Callable
from concurrent.futures import Future
from typing import Final, NamedTuple

import zenoh
from pydantic import ValidationError

from psiu_broker.bus.keys import Keys
from psiu_broker.bus.once import Once
from psiu_broker.bus.replies import Replies
from psiu_broker.bus.session import Session, json_of
from psiu_broker.bus.work import Work
from psiu_broker.errors import CallError
from psiu_broker.frame import Address
from psiu_broker.messages import Answer, CallRequest
from psiu_broker.routing.outbox import is_stop

logger = logging.getLogger(__name__)

Call = Callable[[Address, str, CallRequest], Awaitable[Answer | None]]
"""Send a command and wait for the robot's answer; None where that is for another broker to do. Raises CallError."""

Send = Callable[[Address, str, CallRequest], Awaitable[None]]
"""Send a command and go on; raises CallError."""

AT_ONCE_MAX: Final = 256
"""Calls under way or waiting their turn, and as many stops besides; one more is refused as busy."""

PAYLOAD_MAX: Final = 65_536
RING: Final = 1024

_ANSWER: Final = json_of("Answer")
_SAME_WORDS: Final = "the same call came a moment ago; routers double calls, so attach an id of your own to repeat one"
_STOPPING: Final = "the broker is stopping; the command may have been carried out"


class _Accepted(NamedTuple):
    key: str
    robot: Address
    command: str
    request: CallRequest
    query: zenoh.Query | None
    room: threading.BoundedSemaphore
    """Where it takes a place until it has ended."""


class Calls:
    """Hands the calls of other programs to the broker and its answers back."""

    def __init__(self, session: Session, keys: Keys, call: Call, send: Send, *, relayed: bool) -> None:
        self.refused_puts = 0
        self._session = session
        self._keys = keys
        self._call = call
        self._send = send
        self._replies = Replies(session, "bus-call")
        self._room = threading.BoundedSemaphore(AT_ONCE_MAX)
        self._stop_room = threading.BoundedSemaphore(AT_ONCE_MAX)
        self._gets = Once(relayed=relayed)
        self._puts = Once(relayed=relayed)
        self._work = Work(self._replies)

    @classmethod
    async def open(cls, session: Session, keys: Keys, call: Call, send: Send, *, relayed: bool = False) -> "Calls":
        """Take calls from now on. `call` serves gets, `send` puts; `relayed` as in `Once`.

        Raises:
            BusError: the session is closed or lost.
        """

        calls = cls(session, keys, call, send, relayed=relayed)
        ring = zenoh.handlers.RingChannel
        await session.serve(
            lambda: session.zenoh.declare_queryable(keys.every_call, ring(RING)),
            calls._sift_query,
            calls._begin,
            name="bus-calls",
        )
        await session.serve(
            lambda: session.zenoh.declare_subscriber(keys.every_call, ring(RING)),
            calls._sift_put,
            calls._begin,
            name="bus-call-puts",
        )
        return calls

    async def close(self) -> None:
        """Answer every call under way, and each that comes later, with ``shutting_down``; before `Session.close`."""
        await self._work.close()

    def _sift_query(self, query: zenoh.Query) -> _Accepted | None:
        """What of `query` the loop must see."""
        key, payload = str(query.key_expr), _bytes(query.payload)
        call_id = _bytes(query.attachment)
        try:
            _refuse_parameters(query.parameters)
            if self._gets.is_double(call_id, key, payload):
                if call_id:
                    self._replies.drop(query)
                    return None
                _refuse_double()
            return self._accepted(key, payload, query)
        except CallError as error:
            self._replies.turn_away(query, error)
            return None

    def _sift_put(self, sample: zenoh.Sample) -> _Accepted | None:
        if sample.kind != zenoh.SampleKind.PUT:
            return None
        key, payload = str(sample.key_expr), _bytes(sample.payload)
        try:
            if self._puts.is_double(_bytes(sample.attachment), key, payload):
                _refuse_double()
            return self._accepted(key, payload, None)
        except CallError as error:
            self._refused_put(str(sample.key_expr), error)
            return None

    def _accepted(self, key: str, payload: bytes, query: zenoh.Query | None) -> _Accepted:
        try:
            robot, command = self._keys.read_call(key)
        except ValueError as error:
            raise CallError("bad_request", str(error)) from error
        request = read_request(payload)
        room = self._stop_room if is_stop(command) else self._room
        if not room.acquire(blocking=False):
            raise CallError("busy", f"{AT_ONCE_MAX} calls are under way already")
        return _Accepted(key, robot, command, request, query, room)

    def _begin(self, accepted: _Accepted) -> None:
        if self._work.closed:  # `close` may have told its tasks to end already; one that never began says nothing
            self._turn_away(accepted)
            return
        self._work.begin(self._serve_put(accepted) if accepted.query is None else self._serve(accepted, accepted.query))

    def _turn_away(self, accepted: _Accepted) -> None:
        stopping = CallError("shutting_down", "the broker is stopping")
        if accepted.query is None:
            self._refused_put(accepted.key, stopping)
            accepted.room.release()
        else:
            self._replies.refuse(accepted.query, stopping).add_done_callback(lambda _: accepted.room.release())

    async def _serve(self, accepted: _Accepted, query: zenoh.Query) -> None:
        reply = await self._outcome(accepted, query)
        reply.add_done_callback(lambda _: accepted.room.release())

    async def _outcome(self, accepted: _Accepted, query: zenoh.Query) -> "Future[None]":
        """The reply to `query`, on its way."""
        if self._work.closed:
            return self._replies.refuse(query, CallError("shutting_down", "the broker is stopping"))
        try:
            answer = await self._call(accepted.robot, accepted.command, accepted.request)
        except CallError as error:
            return self._replies.refuse(query, error)
        except asyncio.CancelledError:
            return self._replies.refuse(query, CallError("shutting_down", _STOPPING))
        except Exception as error:
            logger.exception("a call to %s %s failed inside the broker", accepted.robot, accepted.command)
            failed = CallError("outcome_unknown", f"the broker failed ({type(error).__name__}); its log says how")
            return self._replies.refuse(query, failed)
        return self._replies.answer(query, {} if answer is None else {accepted.key: (_ANSWER, answer)})

    async def _serve_put(self, accepted: _Accepted) -> None:
        try:
            await self._send(accepted.robot, accepted.command, accepted.request)
        except CallError as error:
            self._refused_put(accepted.key, error)
        except Exception:
            logger.exception("a put to %s %s failed inside the broker", accepted.robot, accepted.command)
        finally:
            accepted.room.release()

    def _refused_put(self, key: str, error: CallError) -> None:
        self.refused_puts += 1
        logger.debug("a put to %s was refused: %s", key, error)


def _refuse_double() -> None:
    raise CallError("busy", _SAME_WORDS)


def _bytes(value: zenoh.ZBytes | None) -> bytes:
    return b"" if value is None else value.to_bytes()


def read_request(payload: bytes) -> CallRequest:
    """The request in a payload; none at all means no parameters.

    Raises:
        CallError: bad_request, saying what was expected.
    """
    if len(payload) > PAYLOAD_MAX:
        raise CallError("bad_request", f"a payload of {len(payload)} bytes; {PAYLOAD_MAX} at most")
    if not payload:
        return CallRequest()
    try:
        request = CallRequest.model_validate_json(payload)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False, include_context=False)[0]
        place = ".".join(str(part) for part in first["loc"][:2])
        raise CallError(
            "bad_request", f'expected {{"parameters": [100], "timeout_s": 5}}; {place or "payload"}: {first["msg"]}'
        ) from error
    if any(isinstance(value, float) and not math.isfinite(value) for value in request.parameters):
        raise CallError("bad_request", "parameters: a number must be finite")
    return request


def _refuse_parameters(parameters: zenoh.Parameters) -> None:
    """Raise CallError for ``?100`` behind the key: a command must not go out without what was meant for it."""
    names = (part.partition("=")[0] for part in str(parameters).split(";") if part)
    if any(not name.startswith("_") for name in names):  # those of Zenoh itself begin so
        raise CallError("bad_request", 'parameters go into the payload: {"parameters": [100]}')

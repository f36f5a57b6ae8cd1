"""Calls to robots: one request under way per robot, its tries and its deadline, until an answer or a reason why not.

A call goes through these states, and every wait ends at its deadline:

    turn ──> sent ──reply──────────────> Answer
              │ ├──AGAIN──> settled ──> sent (bounded by `retries`)
              │ ├──BUSY───> AVAIL? every `busy_poll_s` ──FREE──> sent
              │ └──silence> sent again if it is a question, else outcome_unknown
              └──not possible, link down, shutting down: CallError

All methods run on the event loop's thread; times are seconds of the loop's clock.
"""

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Final

from psiu_broker.errors import CallError, EncodeError
from psiu_broker.frame import Address, Frame
from psiu_broker.messages import Answer, Value
from psiu_broker.profiles.profile import Notice, Profile, Reading, Reply, Request

Send = Callable[[Frame, float], CallError | None]
"""Offers a frame to its link, without waiting; the second argument is how long it may wait there, in seconds.

Returns None when the frame is on its way, else why it cannot go.
"""

WAITING_KEPT: Final = 64
"""How many calls may wait for one robot."""
_HEARD_KEPT: Final = 8


@dataclass(slots=True)
class _Lane:
    """The queue in front of one robot."""

    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    users: int = 0


@dataclass(slots=True, eq=False)
class _Call:
    """A call whose turn it is."""

    robot: str
    own: Address
    address: Address
    link: str
    peer: object
    profile: Profile
    request: Request
    build: Callable[[Request], Frame]
    command: str
    begun: float
    deadline: float
    patience_s: float
    retries: int
    busy_poll_s: float
    sent: int = 0
    frame: Frame | None = None
    heard: deque[tuple[Reading | CallError, float]] = field(default_factory=deque)
    woken: asyncio.Event = field(default_factory=asyncio.Event)

    def hear(self, reading: Reading | CallError, now: float) -> None:
        """Keep it for `next`; when a robot talks faster than that, the first words count."""
        if len(self.heard) < _HEARD_KEPT or isinstance(reading, CallError):
            self.heard.append((reading, now))
            self.woken.set()

    async def next(self, until: float) -> tuple[Reading | None, float]:
        """The next thing heard and when, or None at `until`.

        Raises:
            CallError: the call was ended from outside.
        """
        loop = asyncio.get_running_loop()
        if not self.heard and loop.time() < until:
            self.woken.clear()
            try:
                async with asyncio.timeout_at(until):
                    await self.woken.wait()
            except TimeoutError:
                pass
        if not self.heard:
            return None, loop.time()
        reading, at = self.heard.popleft()
        if isinstance(reading, CallError):
            raise reading
        return reading, at


class Conversations:
    """All calls of this broker to robots."""

    def __init__(self, send: Send, *, retries: int = 2, busy_poll_s: float = 0.5, settle_s: float = 0.05) -> None:
        """`settle_s`: how long a robot that did not understand is left alone; all its complaints until then are one."""
        self._send = send
        self._retries = retries
        self._busy_poll_s = busy_poll_s
        self._settle_s = settle_s
        self._lanes: dict[Address, _Lane] = {}
        self._under_way: dict[Address, _Call] = {}
        self._late_pings: dict[Address, float] = {}
        self._closed = False

    async def call(  # noqa: PLR0913 - all by name, and each a different thing
        self,
        *,
        robot: str,
        own: Address,
        address: Address,
        profile: Profile,
        build: Callable[[Request], Frame],
        command: str,
        parameters: Sequence[Value],
        link: str,
        peer: object = None,
        timeout_s: float | None = None,
        retries: int | None = None,
        busy_poll_s: float | None = None,
    ) -> Answer:
        """Tell `robot` (at `address`) a command, as `own`, and return its answer within `timeout_s`.

        Without `timeout_s` the deadline is as long as all tries take. `link` and `peer` are where the
        robot is now, so that `complained` and `link_down` find the call.

        Raises:
            CallError: there is no answer; its code says why.
        """
        begun = asyncio.get_running_loop().time()
        self._refuse_when_closed()
        request = profile.request(command, parameters)
        retries = self._retries if retries is None else retries
        tries = 1 + retries
        if timeout_s is None:
            patience_s, deadline = request.timeout_s, begun + request.timeout_s * tries
        else:
            patience_s = max(request.timeout_s, timeout_s / tries) if request.question else timeout_s
            deadline = begun + timeout_s
        call = _Call(
            robot,
            own,
            address,
            link,
            peer,
            profile,
            request,
            build,
            command,
            begun,
            deadline,
            patience_s,
            retries,
            busy_poll_s or self._busy_poll_s,
        )
        async with self._turn(call):
            reply, at = await self._converse(call)
        elapsed_ms = round((at - begun) * 1000, 3)
        return Answer(status=reply.status, values=list(reply.values), unit=reply.unit, elapsed_ms=elapsed_ms)

    def heard(self, frame: Frame, now: float) -> bool:
        """Take a frame from a robot; True when it was an answer to a call under way."""
        if not self._under_way:
            return False
        call = self._under_way.get(frame.source)
        if call is None or frame.destination != call.own:
            return False
        reading = call.profile.read(call.request, frame)
        if reading is None:
            return False
        call.hear(reading, now)
        return True

    def complained(self, link: str, peer: object = None) -> None:
        """Somebody there said in plain text that it did not understand, without saying who it is or what it was.

        With several calls under way there, only questions are asked again: nothing must move twice.
        """
        calls = [
            call for call in self._under_way.values() if call.link == link and (call.peer is None or call.peer == peer)
        ]
        now = asyncio.get_running_loop().time()
        for call in calls:
            if call.request.question or len(calls) == 1:
                call.hear(Notice.AGAIN, now)

    def undelivered(self, frame: Frame, error: CallError) -> None:
        """A frame that `send` took will not reach its link after all; its call ends with `error`."""
        call = self._under_way.get(frame.destination)
        if call is not None and call.frame == frame:
            call.hear(error, 0.0)

    def link_down(self, link: str, reason: str) -> None:
        """End the calls under way on `link`."""
        since = datetime.now(UTC).strftime("%H:%M:%S UTC")
        for call in self._under_way.values():
            if call.link == link:
                unknown = "" if call.request.question else "; whether it was done is unknown"
                text = f"link {link} is down since {since} ({reason}), before {call.robot} answered{unknown}"
                call.hear(CallError("link_down", text), 0.0)

    def pinging(self, address: Address) -> bool:
        """A ping from `address` is, or may be, the answer to one of ours and so no question (PSIU HEXA row 6)."""
        call = self._under_way.get(address)
        if call is not None and call.request.subject == "ping":
            return True
        until = self._late_pings.get(address)
        return until is not None and asyncio.get_running_loop().time() < until

    def close(self) -> None:
        """End every call with shutting_down, and refuse new ones."""
        self._closed = True
        for call in self._under_way.values():
            call.hear(_shutting_down(), 0.0)

    @asynccontextmanager
    async def _turn(self, call: _Call) -> AsyncIterator[None]:
        """Wait until no other call to this robot is under way; first come, first served."""
        lane = self._lanes.setdefault(call.address, _Lane())
        if lane.users > WAITING_KEPT:
            raise CallError("busy", f"{WAITING_KEPT} calls to {call.robot} wait already")
        lane.users += 1
        try:
            try:
                async with asyncio.timeout_at(call.deadline):
                    await lane.lock.acquire()
            except TimeoutError:
                raise _expired(call) from None
            try:
                self._refuse_when_closed()
                self._under_way[call.address] = call
                yield
            finally:
                self._under_way.pop(call.address, None)
                lane.lock.release()
        finally:
            lane.users -= 1
            if lane.users == 0:
                del self._lanes[call.address]

    async def _converse(self, call: _Call) -> tuple[Reply, float]:
        answered = 0
        try:
            result = await self._ask(call)
            answered = 1
        finally:
            if call.request.subject == "ping":
                self._expect_late_pings(call, call.sent - answered)
        return result

    async def _ask(self, call: _Call) -> tuple[Reply, float]:
        loop = asyncio.get_running_loop()
        tries = 0
        while True:
            until = min(loop.time() + call.patience_s, call.deadline)
            self._offer(call, call.request, until)
            call.sent += 1
            tries += 1
            reading, at = await self._after_sending(call, until)
            if reading is Notice.FREE:
                tries -= 1
            elif isinstance(reading, Reply):
                return reading, at
            elif reading is Notice.IMPOSSIBLE:
                raise CallError("impossible", f"{call.robot} says that {call.command} is impossible")
            elif reading is None and not call.request.question:
                raise _outcome_unknown(call, loop.time())
            elif tries > call.retries or loop.time() >= call.deadline:
                raise _no_answer(call, tries, understood=reading is None)

    async def _after_sending(self, call: _Call, until: float) -> tuple[Reading | None, float]:
        """What came of one try: a reply, None for silence, AGAIN once the robot is quiet, FREE after it was busy."""
        reading, at = await self._next_but(call, until, Notice.FREE)
        if reading is Notice.AGAIN:
            settled = min(asyncio.get_running_loop().time() + self._settle_s, call.deadline)
            reading, at = await self._next_but(call, settled, Notice.FREE, Notice.AGAIN)
            reading = reading or Notice.AGAIN
        if reading is Notice.BUSY:
            reading, at = await self._until_free(call)
        return reading, at

    async def _next_but(self, call: _Call, until: float, *ignored: Notice) -> tuple[Reading | None, float]:
        while True:
            reading, at = await call.next(until)
            if reading not in ignored:
                return reading, at

    async def _until_free(self, call: _Call) -> tuple[Reading, float]:
        """FREE, or the reply that came all the same.

        Raises:
            CallError: busy, until the deadline or for lack of a way to ask.
        """
        loop = asyncio.get_running_loop()
        poll = call.profile.poll
        next_poll = loop.time() + call.busy_poll_s
        asked = False
        while poll is not None and loop.time() < call.deadline:
            if loop.time() >= next_poll:
                next_poll = loop.time() + call.busy_poll_s
                self._offer(call, poll, min(next_poll, call.deadline))
                asked = True
            reading, at = await call.next(min(next_poll, call.deadline))
            if isinstance(reading, Reply):
                return reading, at
            if reading is Notice.FREE and asked and loop.time() < call.deadline:
                return reading, at
            if reading is Notice.IMPOSSIBLE and asked:
                break
        raise CallError("busy", f"{call.robot} is busy and did not do {call.command}")

    def _offer(self, call: _Call, request: Request, until: float) -> None:
        """Send one frame of the call.

        Raises:
            CallError: it cannot go.
        """
        try:
            frame = call.build(request)
        except EncodeError as error:
            raise CallError("refused", f"{call.command} cannot be sent to {call.robot}: {error}") from error
        call.frame = frame
        refused = self._send(frame, until - asyncio.get_running_loop().time())
        if refused is not None:
            raise refused

    def _expect_late_pings(self, call: _Call, missing: int) -> None:
        now = asyncio.get_running_loop().time()
        self._late_pings = {address: until for address, until in self._late_pings.items() if until > now}
        if missing > 0:
            self._late_pings[call.address] = now + call.request.timeout_s

    def _refuse_when_closed(self) -> None:
        if self._closed:
            raise _shutting_down()


def _expired(call: _Call) -> CallError:
    waited = f"{call.deadline - call.begun:.3g} s"
    return CallError("expired", f"{call.robot} was at other calls for {waited}; {call.command} was not sent")


def _outcome_unknown(call: _Call, now: float) -> CallError:
    text = f"{call.robot} did not answer {call.command} in {now - call.begun:.3g} s: it may have been done or not"
    return CallError("outcome_unknown", f"{text}, so it was not sent again")


def _no_answer(call: _Call, tries: int, *, understood: bool) -> CallError:
    times = "1 try" if tries == 1 else f"{tries} tries"
    if understood:
        return CallError("no_answer", f"no answer from {call.robot} after {times}")
    return CallError("no_answer", f"{call.robot} did not understand {call.command} after {times}")


def _shutting_down() -> CallError:
    return CallError("shutting_down", "the broker is shutting down")

"""Calls to robots: one request under way per robot, its tries and its deadline, until an answer or a reason why not.

A call goes through these states, and every wait ends at its deadline:

    turn ──> quiet ──> offered ──> sent ──reply──────────────> Answer
                        │           │ ├──AGAIN──> settled ──> offered (bounded by `retries`)
                        │           │ ├──BUSY───> AVAIL? every `busy_poll_s` ──FREE──> offered
                        │           │ └──silence> offered again if it is a question or repeatable, else outcome_unknown
                        │           │ └──or that silence is the answer, where the protocol has no other
                        └───────────┴──dropped, not possible, link down, shutting down: CallError

Offered: it may wait in the outbox of its link, and nothing that is heard can be about it.
Quiet: the robot owes no late reply that could be mistaken for the answer. A stop waits for neither turn nor quiet.
A procedure holds its robot's turn until it is over. It is cut short by a stop, which first waits until it has ended.
All methods run on the event loop's thread; times are seconds of the loop's clock.
"""

import asyncio
from collections.abc import AsyncIterator, Iterable, Iterator, Sequence, Set
from contextlib import asynccontextmanager, contextmanager
from datetime import UTC, datetime
from math import inf
from typing import Final, Protocol

from psiu_broker.conversation.complaints import Complaints, Traffic
from psiu_broker.conversation.late_replies import LateReplies
from psiu_broker.conversation.procedures import Procedures
from psiu_broker.conversation.turns import Turns
from psiu_broker.conversation.under_way import Offer, Robot, UnderWay
from psiu_broker.errors import CallError, EncodeError
from psiu_broker.frame import Address, Frame, peer_text
from psiu_broker.messages import Answer, Value
from psiu_broker.profiles.profile import Notice, Reading, Reply, Request

MENDED_S: Final = 30.0
"""How long a robot that was cut off in a procedure may be at other calls, each of which mends it as well."""


class Links(Protocol):
    """What conversations need of the links. None of these waits."""

    def send(self, frame: Frame, patience_s: float) -> CallError | None:
        """Offer a frame to its link, where it may wait for `patience_s`; None, or why it cannot go.

        When it leaves, at once or later, is told to `Conversations.delivered`; that it is dropped after all to
        `Conversations.undelivered`.
        """

    def expire(self, link: str) -> None:
        """Drop now what has waited on `link` for as long as it may."""

    def traffic(self, link: str) -> Traffic: ...


class Conversations:
    """All calls of this broker to robots."""

    def __init__(self, links: Links, *, retries: int = 2, busy_poll_s: float = 0.5, settle_s: float = 0.05) -> None:
        """`settle_s`: how long a robot that did not understand is left alone; all its complaints until then are one."""
        self._links = links
        self._retries = retries
        self._busy_poll_s = busy_poll_s
        self._settle_s = settle_s
        self._turns = Turns()
        self._under_way: dict[Address, list[UnderWay]] = {}
        self._late = LateReplies()
        self._complaints = Complaints()
        self._procedures = Procedures(self)
        self._closed = False

    async def call(
        self,
        robot: Robot,
        command: str,
        parameters: Sequence[Value],
        *,
        timeout_s: float | None = None,
        fresh_s: float = inf,
        retries: int | None = None,
        busy_poll_s: float | None = None,
        repeatable: bool = False,
    ) -> Answer:
        """Tell `robot` a command and return its answer within `timeout_s`.

        Without `timeout_s` the deadline is as long as all tries take. A command that has not left within
        `fresh_s` is not sent; one that is to be fresh and waits for its turn gives way to a newer one like it.
        A procedure is not begun where it could not be ended in time. What is `repeatable` is sent again on
        silence, as a question is.

        Raises:
            CallError: there is no answer; its code says why.
        """
        request = robot.profile.request(command, parameters)
        retries = self._retries if retries is None else retries
        tries = 1 + retries
        takes_s = 0.0 if request.procedure is None else request.procedure.takes_s
        if timeout_s is None:
            timeout_s, patience_s = takes_s + request.timeout_s * tries, request.timeout_s
        else:
            patience_s = max(request.timeout_s, timeout_s / tries) if request.question or repeatable else timeout_s
        if request.procedure is not None and takes_s > timeout_s:
            raise CallError("refused", f"{command} takes {takes_s:.1f} s, more than the {timeout_s:.3g} s it was given")
        call = _under_way(robot, command, request, timeout_s, fresh_s)
        call.leave_by -= takes_s
        call.patience_s, call.retries, call.busy_poll_s = patience_s, retries, busy_poll_s or self._busy_poll_s
        call.repeatable = repeatable
        return await self._answer(call, replaceable=fresh_s < inf and not request.question)

    async def stop(
        self, robot: Robot, command: str, parameters: Sequence[Value], *, timeout_s: float, retries: int
    ) -> Answer:
        """As `call`, of what stops `robot`, whatever its word is: before anything else, again on silence, and also
        once calls are closed.

        Raises:
            CallError: there is no answer; its code says why.
        """
        request = robot.profile.request(command, parameters)
        call = _under_way(robot, command, request, timeout_s, timeout_s)
        call.patience_s, call.retries, call.busy_poll_s = timeout_s / (1 + retries), retries, self._busy_poll_s
        call.repeatable = call.urgent = True
        return await self._answer(call, replaceable=False)

    async def _answer(self, call: UnderWay, *, replaceable: bool) -> Answer:
        request = call.request
        async with self._turn(call, replaceable=replaceable):
            await self._quiet(call)
            if request.procedure is not None:
                reply, at = await self._procedures.perform(call, request.procedure)
            else:
                reply, at = await self._ask(call)
        elapsed_ms = round((at - call.begun) * 1000, 3)
        return Answer(
            status=reply.status,
            values=list(reply.values),
            unit=reply.unit,
            remark=reply.remark,
            elapsed_ms=elapsed_ms,
        )

    async def tell(self, robot: Robot, command: str, parameters: Sequence[Value], *, fresh_s: float) -> None:
        """Send a command and go on: what the robot answers is nobody's.

        It waits for its turn behind calls, so that its answer cannot end one of them, but for no answer: a stream
        of set-points flows as fast as its link, and it is the next call that waits until the robot has answered
        them. While a call holds the stream up, the newest of each command is kept, for at most `fresh_s`.

        Raises:
            CallError: it was not sent; its code says why.
        """
        request = robot.profile.request(command, parameters)
        if request.procedure is not None:
            raise CallError("bad_request", f"{command} is many messages: call it, and wait for the answer")
        call = _under_way(robot, command, request, fresh_s, fresh_s)
        async with self._turn(call, replaceable=True):
            self.offer(call, request, call.leave_by)

    @property
    def alone(self) -> Set[Address]:
        """The robots that must hear nothing from anybody else now; this set changes.

        Where one's link has just opened, it is in the middle of a procedure that was cut short: `mend` it first of all.
        """
        return self._procedures.alone

    async def mend(self, robot: Robot) -> None:
        """Bring a robot out of the procedure that was cut short, if one was; the next call to it would, too.

        Raises:
            CallError: it had no turn.
        """
        now = asyncio.get_running_loop().time()
        async with self._turns.turn(robot.address, name=robot.name, command="mend", until=now + MENDED_S):
            await self._procedures.mend(robot)

    def heard(self, frame: Frame, now: float) -> bool:
        """Take a frame from a robot; True when it was an answer, to a call under way or an earlier request."""
        if not self._under_way and not self._late:
            return False
        calls = self._under_way.get(frame.source, ())
        about = _about(calls, frame)
        # An earlier stop that was put may owe this very answer, or be lost; who waits is told that the robot stops.
        stops = about is not None and about[0].is_stop and not about[0].has_reply
        if not stops and self._late.take(frame, now):
            for call in calls:
                call.woken.set()
            return True
        if about is None:
            return False
        call, reading = about
        call.answer(reading, now)
        if call.sending is not None:
            self._complaints.settle(call.sending, self._links.traffic(call.robot.link), replies=1)
        return True

    def delivered(self, frame: Frame, now: float) -> None:
        """A frame that `Links.send` took has left: what is heard from now on can be the answer to it."""
        self._late.delivered(frame, now)
        for call in self._under_way.get(frame.destination, ()):
            call.woken.set()
            call.delivered(frame, now)

    def complained(self, link: str, peer: object = None) -> None:
        """Somebody there said in plain text that it did not understand, without saying who it is or what it was.

        Questions and stops are sent again; anything else only where it can be about no other frame.
        """
        now = asyncio.get_running_loop().time()
        traffic = self._links.traffic(link)
        for call in [call for calls in self._under_way.values() for call in calls]:
            robot = call.robot
            if not call.sent or call.waiting or robot.link != link or (robot.peer is not None and robot.peer != peer):
                continue
            if call.sending is not None and self._complaints.blame(call.sending, traffic, now):
                call.answer(Notice.AGAIN, now)
                self._complaints.settle(call.sending, traffic)
            elif call.may_repeat or call.is_stop:
                call.hear(Notice.AGAIN, now)

    def undelivered(self, frame: Frame, error: CallError) -> None:
        """A frame that `Links.send` took will not reach its link after all; its call ends with `error`."""
        self._late.undelivered(frame)
        for call in self._under_way.get(frame.destination, ()):
            call.woken.set()
            offer = call.taken(frame)
            if offer is not None and offer.needed:
                call.hear(error, 0.0)

    def link_down(self, link: str, reason: str, peer: object = None) -> None:
        """End the calls under way on `link`, or those to `peer` there."""
        since = datetime.now(UTC).strftime("%H:%M:%S UTC")
        down = f"link {link}" if peer is None else f"link {link} to {peer_text(peer)}"
        for call in [call for calls in self._under_way.values() for call in calls]:
            if call.robot.link == link and (peer is None or call.robot.peer == peer):
                unknown = call.sent and not call.request.question
                doubt = "; whether it was done is unknown" if unknown else ""
                text = f"{down} is down since {since} ({reason}), before {call.robot.name} answered{doubt}"
                call.hear(CallError("link_down", text), 0.0)

    def pinging(self, address: Address) -> bool:
        """A ping from `address` is, or may be, the answer to one of ours and so no question (PSIU HEXA row 6)."""
        return any(call.sent and call.request.subject == "ping" for call in self._under_way.get(address, ()))

    def close(self) -> None:
        """End every call with shutting_down, and refuse new ones, unless they are urgent."""
        self._closed = True
        for calls in self._under_way.values():
            for call in calls:
                if not call.urgent:
                    call.hear(_shutting_down(), 0.0)

    @asynccontextmanager
    async def _turn(self, call: UnderWay, *, replaceable: bool) -> AsyncIterator[None]:
        """Wait until no other call to this robot is under way, or, for a stop, until no procedure is."""
        self._refuse_when_closed(call)
        robot, loop = call.robot, asyncio.get_running_loop()
        came = loop.time()
        if call.is_stop or call.is_ending:
            await self._procedures.interrupt(robot.address, call.command, call.leave_by)
        if call.is_stop:
            await self._procedures.mend(robot)
            self._refuse_when_closed(call)
            call.put_off(loop.time() - came)  # what had to be ended first must not make a stop too late
            self._overtake(call)
            with self.hearing(call):
                yield
            return
        async with self._turns.turn(
            robot.address,
            name=robot.name,
            command=call.command,
            until=call.leave_by,
            replaceable=replaceable,
            alone=call.request.procedure is not None,
            motion=call.is_motion,
        ):
            await self._procedures.mend(robot)
            self._refuse_when_closed(call)
            with self.hearing(call):
                yield

    def _overtake(self, stop: UnderWay) -> None:
        """What came before `stop` and would move the robot after it is not sent, or not again."""
        self._turns.overtake(stop.robot.address)
        for call in self._under_way.get(stop.robot.address, ()):
            if call.is_motion:
                call.overtaken = True
                if not call.sent and not call.waiting:
                    call.hear(_overtaken(call), 0.0)

    @contextmanager
    def hearing(self, call: UnderWay) -> Iterator[None]:
        """Have the call hear its robot; the replies that are missing when it ends are owed."""
        address = call.robot.address
        self._under_way.setdefault(address, []).append(call)
        try:
            yield
        finally:
            self._under_way[address].remove(call)
            if not self._under_way[address]:
                del self._under_way[address]
            now, profile, request = asyncio.get_running_loop().time(), call.robot.profile, call.request
            alone = request.procedure is not None  # it has waited until the robot has said all
            if call.frame is not None and not alone:
                missing = call.sent - call.answered
                self._late.expect(call.frame, profile, request, missing, now, call.sent_at + request.timeout_s)
            for offer in call.waiting if not alone else ():
                self._late.expect_waiting(offer.frame, profile, request, now, offer.until)

    async def _quiet(self, call: UnderWay) -> None:
        """Wait until the robot owes nothing that could be mistaken for the answer, unless it is a stop."""
        robot, loop = call.robot, asyncio.get_running_loop()
        while not call.is_stop:
            until = self._late.owed_until(robot.address, robot.profile, call.request, loop.time())
            if until is None:
                return
            if loop.time() >= call.leave_by:
                text = f"{robot.name} still owes an answer to an earlier command; {call.command} was not sent"
                raise CallError("expired", text)
            await call.rest(min(until, call.leave_by))
            if call.heard:  # nothing is sent yet: it can only be the end of the call
                await call.next(0.0)

    async def _ask(self, call: UnderWay) -> tuple[Reply, float]:
        loop = asyncio.get_running_loop()
        tries = 0
        while True:
            if call.overtaken:
                raise _overtaken(call)
            until = min(loop.time() + call.patience_s, call.deadline)
            asked_again = call.sent and call.request.question
            self.offer(call, call.request, until if asked_again else min(until, call.leave_by))
            tries += 1
            reading, at = await self._after_sending(call, until)
            if reading is Notice.FREE:
                tries -= 1
            elif isinstance(reading, Reply):
                return reading, at
            elif reading is Notice.IMPOSSIBLE:
                raise CallError("impossible", f"{call.robot.name} says that {call.command} is impossible")
            elif reading is None and call.request.silence is not None and call.sent:
                return call.request.silence, loop.time()
            elif reading is None and not (call.may_repeat and tries <= call.retries and loop.time() < call.again_by):
                if call.request.question:
                    raise _no_answer(call, tries, understood=True)
                raise _outcome_unknown(call, tries)
            elif tries > call.retries or loop.time() >= call.deadline:
                raise _no_answer(call, tries, understood=False)

    async def _after_sending(self, call: UnderWay, until: float) -> tuple[Reading | None, float]:
        """What came of one try: a reply, None for silence, AGAIN once the robot is quiet, FREE after it was busy.

        The frame may leave up to `until`; the robot has as long as it may take from then on.
        """
        await self.left(call, until)
        if call.request.silence is not None:
            until = min(call.sent_at + call.request.timeout_s, call.deadline)
        else:
            until = min(max(call.sent_at + call.patience_s, until), call.deadline)
        reading, at = await self._next_but(call, until, Notice.FREE)
        if reading is Notice.AGAIN:
            settled = min(asyncio.get_running_loop().time() + self._settle_s, call.deadline)
            reading, at = await self._next_but(call, settled, Notice.FREE, Notice.AGAIN)
            reading = reading or Notice.AGAIN
        if reading is Notice.BUSY:
            reading, at = await self._until_free(call)
        return reading, at

    async def left(self, call: UnderWay, until: float) -> None:
        """Wait until nothing of the call waits in an outbox any more, or something is heard, at most until `until`."""
        loop = asyncio.get_running_loop()
        while call.waiting and not call.heard and loop.time() < until:
            await call.rest(until)
        if call.waiting and not call.heard:
            self._links.expire(call.robot.link)

    async def _next_but(self, call: UnderWay, until: float, *ignored: Notice) -> tuple[Reading | None, float]:
        while True:
            reading, at = await call.next(until)
            if reading not in ignored:
                return reading, at

    async def _until_free(self, call: UnderWay) -> tuple[Reading, float]:
        """FREE, or the reply that came all the same.

        Raises:
            CallError: busy, until the deadline or for lack of a way to ask.
        """
        loop = asyncio.get_running_loop()
        poll = call.robot.profile.poll
        next_poll = loop.time() + call.busy_poll_s
        sent = call.sent
        while poll is not None and loop.time() < call.deadline:
            if loop.time() >= next_poll:
                next_poll = loop.time() + call.busy_poll_s
                self.offer(call, poll, min(next_poll, call.deadline))
            reading, at = await call.next(min(next_poll, call.deadline))
            if isinstance(reading, Reply):
                return reading, at
            asked = call.sent > sent
            if reading is Notice.FREE and asked and loop.time() < call.deadline:
                return reading, at
            if reading is Notice.IMPOSSIBLE and asked:
                break
        raise CallError("busy", f"{call.robot.name} is busy and did not do {call.command}")

    def offer(self, call: UnderWay, request: Request, until: float, *, needed: bool | None = None) -> None:
        """Send one frame of the call, which may leave up to `until`. If it is `needed`, the call ends if it is dropped.

        Raises:
            CallError: it cannot go.
        """
        robot, now = call.robot, asyncio.get_running_loop().time()
        if now >= until:
            raise CallError("expired", f"it was too late for {call.command}; it was not sent to {robot.name}")
        try:
            frame = robot.build(request)
        except EncodeError as error:
            raise CallError("refused", f"{call.command} cannot be sent to {robot.name}: {error}") from error
        before = self._links.traffic(robot.link)
        call.sending = None
        call.waiting.append(Offer(frame, until, needed=request is call.request if needed is None else needed))
        refused = self._links.send(frame, until - now)
        if refused is not None:
            call.taken(frame)
            raise refused
        if not call.waiting:
            call.sending = self._complaints.sending(robot.link, before, self._links.traffic(robot.link))

    def _refuse_when_closed(self, call: UnderWay) -> None:
        if self._closed and not call.urgent:
            raise _shutting_down()


def _about(calls: Iterable[UnderWay], frame: Frame) -> tuple[UnderWay, Reading] | None:
    """The call that `frame` is about, rather one that has no reply yet, and what it says."""
    about: tuple[UnderWay, Reading] | None = None
    for call in calls:
        if not call.sent or frame.destination != call.robot.own:
            continue
        reading = call.robot.profile.read(call.request, frame)
        if reading is not None and (about is None or about[0].has_reply):
            about = call, reading
    return about


def _under_way(robot: Robot, command: str, request: Request, timeout_s: float, fresh_s: float) -> UnderWay:
    begun = asyncio.get_running_loop().time()
    leave_by = begun + min(timeout_s, fresh_s)
    return UnderWay(robot, command, request, begun, begun + timeout_s, leave_by)


def _overtaken(call: UnderWay) -> CallError:
    again = " again" if call.sent else ""
    return CallError("expired", f"a stop came for {call.robot.name}; {call.command} was not sent{again}")


def _outcome_unknown(call: UnderWay, tries: int) -> CallError:
    waited_s = asyncio.get_running_loop().time() - call.begun
    text = f"{call.robot.name} did not answer {call.command} in {waited_s:.3g} s: it may have been done or not"
    again = f"; it was sent {tries} times" if tries > 1 else "" if call.may_repeat else ", so it was not sent again"
    return CallError("outcome_unknown", text + again)


def _no_answer(call: UnderWay, tries: int, *, understood: bool) -> CallError:
    times = "1 try" if tries == 1 else f"{tries} tries"
    if understood:
        return CallError("no_answer", f"no answer from {call.robot.name} after {times}")
    return CallError("no_answer", f"{call.robot.name} did not understand {call.command} after {times}")


def _shutting_down() -> CallError:
    return CallError("shutting_down", "the broker is shutting down")

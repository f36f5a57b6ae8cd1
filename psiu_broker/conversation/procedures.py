"""Procedures: a robot that is to hear one thing after another and nothing else, and that no trouble leaves in between.

However one is cut short (the robot objects, its link goes down, a stop comes, the call is cancelled), its ending is
sent: at once, or where the link is down before anything else that is sent to the robot later.
"""

import asyncio
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field
from typing import Final, Protocol

from psiu_broker.conversation.under_way import Robot, UnderWay
from psiu_broker.errors import CallError
from psiu_broker.frame import Address
from psiu_broker.profiles.profile import Procedure, Reading, Reply, Request, Step

ENDING_TRIES: Final = 2
ENDING_S: Final = 0.3
"""How long a robot may take to say all that it says of an ending; none of it may be taken for a later call's answer."""
ENDING_PATIENCE_S: Final = 2.0
"""How long an ending may wait in the outbox of its link."""
CUT_KEPT: Final = 256
"""Robots remembered as cut; of more than these the first are forgotten."""


class Calls(Protocol):
    """What procedures need of the conversations."""

    def offer(self, call: UnderWay, request: Request, until: float, *, needed: bool) -> None:
        """Send one frame of `call`; raises CallError."""

    async def left(self, call: UnderWay, until: float) -> None:
        """Wait until nothing of `call` waits in an outbox, or something is heard, at most until `until`."""

    def hearing(self, call: UnderWay) -> AbstractContextManager[None]:
        """Have `call` hear its robot."""


@dataclass(slots=True)
class _Running:
    call: UnderWay
    over: asyncio.Event = field(default_factory=asyncio.Event)
    ends: bool = False


class Procedures:
    """The procedures under way, one at most for each robot, and those that were cut."""

    def __init__(self, calls: Calls) -> None:
        self._calls = calls
        self.alone: Final[set[Address]] = set()
        """The robots that are at a procedure, or await the ending of one that was cut."""
        self._running: dict[Address, _Running] = {}
        self._cut: dict[Address, Request] = {}

    async def interrupt(self, robot: Address, command: str, until: float) -> None:
        """For the sake of `command`, end what `robot` is at and wait until it is out of it, at most until `until`."""
        running = self._running.get(robot)
        if running is None:
            return
        if not running.ends:
            running.call.hear(CallError("expired", f"{command} came meanwhile"), 0.0)
        with suppress(TimeoutError):
            async with asyncio.timeout_at(until):
                await running.over.wait()

    async def perform(self, call: UnderWay, procedure: Procedure) -> tuple[Reply, float]:
        """Carry out `procedure`, whose turn it is; the robot's answer and when it came.

        Raises:
            CallError: why there is none, and in what state the robot is.
        """
        running = self._begin(call)
        try:
            if not procedure.steps:
                return await self._end_only(running, procedure)
            return await self._perform(running, procedure)
        finally:
            self._over(running)

    async def mend(self, robot: Robot) -> None:
        """Send `robot`, whose turn it is, the ending of the procedure that was cut, if one was; never raises CallError.

        It is forgotten once that has left, whatever the robot says.
        """
        request = self._cut.get(robot.address)
        if request is None or request.procedure is None or robot.address in self._running:
            return
        now = _now()
        running = self._begin(UnderWay(robot, request.subject, request, now, now, now))
        try:
            with self._calls.hearing(running.call):
                await self._end(running, request.procedure)
        finally:
            self._over(running)

    def _begin(self, call: UnderWay) -> _Running:
        running = self._running[call.robot.address] = _Running(call)
        self.alone.add(call.robot.address)
        return running

    def _over(self, running: _Running) -> None:
        address = running.call.robot.address
        del self._running[address]
        if address not in self._cut:
            self.alone.discard(address)
        running.over.set()

    async def _perform(self, running: _Running, procedure: Procedure) -> tuple[Reply, float]:
        call = running.call
        step, reading, at = procedure.steps[0], None, 0.0
        try:
            for step in procedure.steps:
                reading, at = await self._take(call, step)
                if reading is not None:
                    break
            if isinstance(reading, Reply) and reading.status != "falha" and step is procedure.steps[-1]:
                return reading, at
        except CallError as error:
            if not call.sent and not call.waiting:
                raise
            state = await self._state(running, procedure)
            raise CallError(error.code, f"{step.name}: {error}; {state}") from None
        except BaseException:  # cancelled: there is no time to wait for what the robot says
            if call.sent or call.waiting:
                self._offer_ending(call, procedure)
            raise
        if reading is None and call.request.silence is not None:
            return call.request.silence, at
        state = await self._state(running, procedure)
        if reading is None:
            waited = f"{step.pause_s:.3g} s"
            text = f"{call.robot.name} did not say within {waited} that {call.command} is done; {state}"
            raise CallError("outcome_unknown", text)
        return _objection(step, reading, state), at

    async def _take(self, call: UnderWay, step: Step) -> tuple[Reading | None, float]:
        """Send `step` and return what the robot says of it, or None; raises CallError."""
        sent = call.sent
        if _now() >= call.deadline:
            raise CallError("expired", "its time is over")
        until = min(_now() + call.request.timeout_s, call.deadline)
        self._calls.offer(call, _request(call, step), until, needed=True)
        await self._calls.left(call, until)
        begun = call.sent_at if call.sent > sent else _now()
        return await call.next(begun + step.pause_s)

    async def _end_only(self, running: _Running, procedure: Procedure) -> tuple[Reply, float]:
        call = running.call
        if await self._end(running, procedure):
            return Reply("sucesso", remark=procedure.ended), _now()
        raise CallError("outcome_unknown", f"{call.robot.name} did not answer {call.command}: it may be out of reach")

    async def _state(self, running: _Running, procedure: Procedure) -> str:
        """End it, and in what state the robot is then, for a person."""
        robot = running.call.robot
        if await self._end(running, procedure):
            return procedure.ended
        if robot.address in self._cut:
            return f"{robot.name} will be told to end it when its link is open again"
        return f"{robot.name} was told to end it and did not answer"

    async def _end(self, running: _Running, procedure: Procedure) -> bool:
        """Whether the robot says that it is out of `procedure`, wherever it was."""
        call = running.call
        running.ends = True
        call.heard.clear()
        for _ in range(ENDING_TRIES):
            if not self._offer_ending(call, procedure):
                return False
            try:
                await self._calls.left(call, _now() + ENDING_PATIENCE_S)
                self._note_left(call)
                answered = await self._says_something(call)
            except CallError:  # it was dropped, the link went down, or the broker is stopping
                return False
            if answered:
                return True
        return False

    async def _says_something(self, call: UnderWay) -> bool:
        """Whether anything is heard until the robot has said it all; raises CallError."""
        until = _now() + ENDING_S
        answered = False
        while (reading := (await call.next(until))[0]) is not None:
            answered = answered or isinstance(reading, Reply)
        return answered

    def _offer_ending(self, call: UnderWay, procedure: Procedure) -> bool:
        """Whether the ending could be sent; else it is remembered, as it is until it has left."""
        address = call.robot.address
        self._cut[address] = call.request
        if len(self._cut) > CUT_KEPT:
            oldest = next(iter(self._cut))
            del self._cut[oldest]
            self.alone.discard(oldest)
        try:
            for step in procedure.ending:
                self._calls.offer(call, _request(call, step), _now() + ENDING_PATIENCE_S, needed=True)
        except CallError:
            return False
        self._note_left(call)
        return True

    def _note_left(self, call: UnderWay) -> None:
        """Nothing is to be remembered once the whole ending has left; what is dropped, `call` hears of."""
        if not call.waiting and not call.heard:
            self._cut.pop(call.robot.address, None)


def _now() -> float:
    return asyncio.get_running_loop().time()


def _request(call: UnderWay, step: Step) -> Request:
    return Request(step.subject, step.payload, False, call.request.timeout_s)


def _objection(step: Step, reading: Reading, state: str) -> Reply:
    """The robot's answer where it ended the procedure itself at `step`: what it said, and the place."""
    said = reading if isinstance(reading, Reply) else Reply("falha", remark=reading.value)
    remark = said.remark if said.status == "falha" and said.remark else "the robot ended it before its time"
    return Reply("falha", (*said.values, step.place), remark=f"{step.name}: {remark}; {state}")

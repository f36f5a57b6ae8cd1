"""Programs that find a robot on a link and command it in a protocol that is not the robot's own.

The link says which robot (``plays = "MNERIM"``). Each program, one far end of the link, has a persona of its own,
which answers at once what it can; what the robot is to do becomes a call to it, one after another.
"""

import asyncio
import logging
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import Final, Protocol

from psiu_broker.config import Configuration
from psiu_broker.config.who import Ends, ends
from psiu_broker.errors import CallError
from psiu_broker.exchange import Exchange
from psiu_broker.frame import Address, Frame, Way
from psiu_broker.link import Link
from psiu_broker.messages import Answer, CallRequest
from psiu_broker.profiles.persona import Call, Persona, Say
from psiu_broker.profiles.profile import Description
from psiu_broker.protocols import PROTOCOLS
from psiu_broker.routing.outbox import is_stop
from psiu_broker.routing.verdicts import ANSWERED, QUEUE_FULL, Verdict

CALLS_KEPT: Final = 16
"""How many calls of one program may wait for those before them."""

log = logging.getLogger(__name__)


class Robots(Protocol):
    """What programs are offered of robots."""

    async def call(self, robot: Address, command: str, request: CallRequest) -> Answer:
        """As `Calling.call`."""

    async def tell(self, robot: Address, command: str, request: CallRequest) -> None:
        """As `Calling.tell`."""


class Playing:
    """Every program that commands a robot so; all methods run on the event loop's thread."""

    def __init__(
        self,
        configuration: Configuration,
        exchange: Exchange,
        robots: Robots,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._exchange = exchange
        self._robots = robots
        self._clock = clock
        self._played: Mapping[str, Ends] = {
            name: ends(configuration, link) for name, link in configuration.links.items() if link.options.plays
        }
        self._programs: dict[Way, _Program] = {}

    def link_opened(self, link: Link, now: float) -> None:
        """Where a link has one far end, the program is there now."""
        if link.name in self._played and not link.adapter.datagrams:
            for way in link.ways():
                self._program(way, now)

    def heard(self, frame: Frame, way: Way, now: float) -> Verdict | None:
        """Do what a program wants of the robot that it was told it finds; None where `way` is that of no program."""
        program = self._program(way, now)
        if program is None:
            return None
        return ANSWERED if program.do(program.persona.heard(frame, now), now) else QUEUE_FULL

    def told(self, frame: Frame, description: Description, now: float) -> None:
        """A robot said something to nobody in particular: programs that it is played to hear of it."""
        for program in [each for each in self._programs.values() if each.robot == frame.source]:
            program.do(program.persona.told(description, now), now)

    def link_closed(self, link: str) -> None:
        self._forget([way for way in self._programs if way.link == link])

    def peer_lost(self, way: Way) -> None:
        self._forget([each for each in self._programs if each == way])

    async def close(self) -> None:
        """Forget every program, and wait until nothing is done for it any more."""
        tasks = [program.task for program in self._programs.values() if program.task is not None]
        self._forget(list(self._programs))
        await asyncio.gather(*tasks, return_exceptions=True)

    def _program(self, way: Way, now: float) -> "_Program | None":
        program = self._programs.get(way)
        if program is not None:
            return program
        played = self._played.get(way.link)
        if played is None:
            return None
        configuration = self._exchange.links[way.link].configuration
        persona = PROTOCOLS[configuration.protocol].persona
        if persona is None:
            return None
        options = configuration.map or persona.Options()
        program = self._programs[way] = _Program(
            persona(str(played.own), configuration.codec, options),
            played.own,
            played.far(way.peer),
            configuration.protocol,
            lambda frame: self._exchange.send_by(frame, way, self._clock()),
            self._robots,
            self._clock,
        )
        program.do(program.persona.opened(now), now)
        return program

    def _forget(self, ways: Iterable[Way]) -> None:
        for way in ways:
            self._programs.pop(way).end()


class _Program:
    """One program, what it is played, and what it waits for."""

    def __init__(
        self,
        persona: Persona,
        robot: Address,
        address: Address,
        protocol: str,
        send: Callable[[Frame], object],
        robots: Robots,
        clock: Callable[[], float],
    ) -> None:
        self.persona = persona
        self.robot = robot
        self.task: asyncio.Task[None] | None = None
        self._address = address
        self._protocol = protocol
        self._send = send
        self._robots = robots
        self._clock = clock
        self._waiting: deque[Call] = deque()
        self._newest: dict[str, Call] = {}
        self._stops: set[asyncio.Task[None]] = set()
        self._timer: asyncio.TimerHandle | None = None
        self._ended = False

    def do(self, actions: Iterable[Say | Call], now: float) -> bool:
        """Say what is to be said, begin what is to be done; False if something was refused for want of room."""
        done = True
        for action in actions:
            if isinstance(action, Say):
                self._send(Frame(self.robot, self._address, action.subject, action.payload, self._protocol))
            else:
                done = self._take(action, now) and done
        self._set_timer(now)
        return done

    def end(self) -> None:
        """The program is gone: nothing more is begun for it."""
        self._ended = True
        self._waiting.clear()
        self._newest.clear()
        if self._timer is not None:
            self._timer.cancel()
        if self.task is not None:
            self.task.cancel()

    def _take(self, call: Call, now: float) -> bool:
        if self._ended:
            return False
        if is_stop(call.command):
            # What waits is older than the stop, and would undo it.
            self._waiting.clear()
            self._newest.clear()
            self._start_stop(call)
            return True
        if call.newest:
            self._newest[call.command] = call
        elif len(self._waiting) < CALLS_KEPT:
            self._waiting.append(call)
        else:
            self.do(self.persona.answered(call, None, "busy: too much waits already", now), now)
            return False
        if self.task is None:
            self.task = asyncio.get_running_loop().create_task(self._work())
        return True

    def _start_stop(self, call: Call) -> None:
        task = asyncio.get_running_loop().create_task(self._carry_out(call))
        self._stops.add(task)
        task.add_done_callback(self._stops.discard)

    async def _work(self) -> None:
        try:
            while self._waiting or self._newest:
                newest = next(iter(self._newest), None)
                await self._carry_out(self._waiting.popleft() if newest is None else self._newest.pop(newest))
        finally:
            self.task = None

    async def _carry_out(self, call: Call) -> None:
        answer, error = None, ""
        try:
            request = CallRequest(parameters=list(call.parameters))
            if call.newest:
                await self._robots.tell(self.robot, call.command, request)
            else:
                answer = await self._robots.call(self.robot, call.command, request)
        except (CallError, ValueError) as failure:
            error = str(failure)
            log.debug("%s told %s %s: %s", self._address, self.robot, call.command, error)
        now = self._clock()
        if not self._ended and (error or not call.newest):
            self.do(self.persona.answered(call, answer, error, now), now)

    def _set_timer(self, now: float) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        until = self.persona.waits_until()
        if until is not None and not self._ended:
            self._timer = asyncio.get_running_loop().call_later(max(0.0, until - now), self._due)

    def _due(self) -> None:
        self._timer = None
        now = self._clock()
        self.do(self.persona.due(now), now)

"""Programs that find a robot on a link and command it in a protocol that is not the robot's own.

The link says which robot (``plays = "MNERIM"``). Each program, one far end of the link, has a persona of its own,
which answers at once what it can; what the robot is to do becomes a call to it, one after another.
"""

import asyncio
import logging
import time
from collections import deque
from collections.abc import Callable, Coroutine, Iterable, Mapping, Sequence
from typing import Any, Final, NamedTuple, Protocol, TypeVar

from psiu_broker.calling import Caller
from psiu_broker.config import Configuration
from psiu_broker.config.who import Ends, ends
from psiu_broker.errors import CallError
from psiu_broker.exchange import Exchange
from psiu_broker.failsafe import ON_LINK, Failsafe
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
STOPS_KEPT: Final = 8
"""How many stops of one program may wait for their answers; of any more the answers are not waited for."""
SHORTEST_S: Final = 0.001
"""A persona that wants its turn at once, and always again, takes no more of the loop's time than this leaves it."""
STOPPED: Final = "a stop came meanwhile"

log = logging.getLogger(__name__)
T = TypeVar("T")


class Robots(Protocol):
    """What programs are offered of robots."""

    async def call(
        self, robot: Address, command: str, request: CallRequest, asked_at: float | None, by: Caller
    ) -> Answer:
        """As `Calling.call`."""

    async def tell(
        self, robot: Address, command: str, request: CallRequest, asked_at: float | None, by: Caller
    ) -> None:
        """As `Calling.tell`."""


class Playing:
    """Every program that commands a robot so; all methods run on the event loop's thread."""

    def __init__(
        self,
        configuration: Configuration,
        exchange: Exchange,
        robots: Robots,
        failsafe: Failsafe,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._exchange = exchange
        self._robots = robots
        self._failsafe = failsafe
        self._clock = clock
        self._played: Mapping[str, Ends] = {
            name: ends(configuration, link) for name, link in configuration.links.items() if link.options.plays
        }
        self._programs: dict[Way, Program] = {}
        self._closed = False

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
        return ANSWERED if program.hear(frame, now) else QUEUE_FULL

    def told(self, robot: Address, describe: Callable[[], Description], now: float) -> None:
        """A robot said something to nobody in particular: programs that it is played to hear of it."""
        if not self._programs:
            return
        programs = [each for each in self._programs.values() if each.robot == robot]
        if programs:
            description = describe()
            for program in programs:
                program.tell(description, now)

    def link_closed(self, link: str) -> None:
        self._forget([way for way in self._programs if way.link == link])

    def peer_came(self, way: Way, now: float) -> None:
        """A program has come, before it says anything."""
        self._program(way, now)

    def peer_lost(self, way: Way) -> None:
        self._forget([each for each in self._programs if each == way])

    async def close(self) -> None:
        """Forget every program, and wait until nothing is done for it any more."""
        self._closed = True
        tasks = [task for program in self._programs.values() for task in program.tasks]
        self._forget(list(self._programs))
        await asyncio.gather(*tasks, return_exceptions=True)

    def _program(self, way: Way, now: float) -> "Program | None":
        program = self._programs.get(way)
        if program is not None:
            return program
        played = self._played.get(way.link)
        if played is None or self._closed:
            return None
        configuration = self._exchange.links[way.link].configuration
        persona = PROTOCOLS[configuration.protocol].persona
        if persona is None:
            return None
        options = configuration.map or persona.Options()
        program = self._programs[way] = Program(
            persona(str(played.own), configuration.codec, options),
            played.own,
            played.far(way.peer),
            configuration.protocol,
            way,
            lambda frame: self._exchange.send_by(frame, way, self._clock()),
            self._robots,
            self._clock,
        )
        self._failsafe.program_came(_id(way))
        program.open(now)
        return program

    def _forget(self, ways: Iterable[Way]) -> None:
        for way in ways:
            self._programs.pop(way).end()
            if not self._closed:
                self._failsafe.program_gone(_id(way))


def _id(way: Way) -> str:
    return f"{ON_LINK}{way}"


class _Asked(NamedTuple):
    """A call, and when the program asked for it."""

    call: Call
    at: float


class Program:
    """One program, what it is played, and what it waits for. A mistake of its persona is its own trouble."""

    def __init__(
        self,
        persona: Persona,
        robot: Address,
        address: Address,
        protocol: str,
        way: Way,
        send: Callable[[Frame], object],
        robots: Robots,
        clock: Callable[[], float],
    ) -> None:
        self.robot = robot
        self.tasks: set[asyncio.Task[None]] = set()
        """All that goes on for it."""
        self._persona = persona
        self._address = address
        self._protocol = protocol
        self._caller = Caller(address, way)
        self._id = _id(way)
        self._send = send
        self._robots = robots
        self._clock = clock
        self._waiting: deque[_Asked] = deque()
        self._newest: dict[str, _Asked] = {}
        self._under_way: _Asked | None = None
        self._worker: asyncio.Task[None] | None = None
        self._stops: set[asyncio.Task[None]] = set()
        self._timer: asyncio.TimerHandle | None = None
        self._mistakes = 0
        self._ended = False

    def open(self, now: float) -> None:
        """The program has come."""
        self._do(lambda: self._persona.opened(now), now)

    def hear(self, frame: Frame, now: float) -> bool:
        """Do what the program wants; False if something of it was not to be had, for want of room."""
        return self._do(lambda: self._persona.heard(frame, now), now)

    def tell(self, description: Description, now: float) -> None:
        """The robot said something to nobody in particular."""
        self._do(lambda: self._persona.told(description, now), now)

    def end(self) -> None:
        """The program is gone: nothing more is begun for it, and only its stops are seen through."""
        self._ended = True
        self._waiting.clear()
        self._newest.clear()
        if self._timer is not None:
            self._timer.cancel()
        if self._worker is not None:
            self._worker.cancel()

    def _do(self, ask: Callable[[], Iterable[Say | Call]], now: float) -> bool:
        """Say what is to be said, begin what is to be done; False if something was refused for want of room."""
        actions = self._try(lambda: tuple(ask()))
        if actions is None:
            return False
        done = True
        for action in actions:
            if isinstance(action, Say):
                self._send(Frame(self.robot, self._address, action.subject, action.payload, self._protocol))
            else:
                done = self._take(_Asked(action, now)) and done
        # Only now: what a stop swept away, the persona was told of meanwhile.
        self._set_timer(self._try(self._persona.waits_until), now)
        return done

    def _try(self, ask: Callable[[], T]) -> T | None:
        """What the persona tells; None if it made a mistake."""
        try:
            return ask()
        except Exception:
            self._mistakes += 1
            if self._mistakes & (self._mistakes - 1) == 0:  # the 1st, 2nd, 4th, 8th, …
                log.exception("what is played to %s as %s made a mistake", self._address, self.robot)
            return None

    def _take(self, asked: _Asked) -> bool:
        call = asked.call
        if self._ended:
            return False
        if is_stop(call.command):
            self._sweep(asked.at)
            self._start_stop(asked)
            return True
        if call.newest:
            # What moves it forwards and backwards may be one letter of the program, of which the newest value counts.
            self._newest[call.command if call.asked is None else call.asked.subject] = asked
        elif len(self._waiting) < CALLS_KEPT:
            self._waiting.append(asked)
        else:
            self._answer(call, None, "busy: too much waits already", asked.at)
            return False
        if self._worker is None:
            self._worker = self._start(self._work())
        return True

    def _sweep(self, now: float) -> None:
        """Give up all that is older than a stop, and would undo it."""
        swept = [*([self._under_way] if self._under_way else []), *self._newest.values(), *self._waiting]
        self._waiting.clear()
        self._newest.clear()
        if self._worker is not None:
            self._worker.cancel()
        self._worker = self._under_way = None
        for asked in swept:
            self._answer(asked.call, None, STOPPED, now)

    def _start_stop(self, asked: _Asked) -> None:
        if len(self._stops) >= 2 * STOPS_KEPT:
            return  # Those whose answers are not waited for have not left yet: they stop it as well.
        task = self._start(self._carry_out(asked, waits=len(self._stops) < STOPS_KEPT))
        self._stops.add(task)
        task.add_done_callback(self._stops.discard)

    def _start(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = asyncio.get_running_loop().create_task(work)
        self.tasks.add(task)
        task.add_done_callback(self.tasks.discard)
        return task

    async def _work(self) -> None:
        worker = asyncio.current_task()
        try:
            while self._waiting or self._newest:
                newest = next(iter(self._newest), None)
                asked = self._under_way = self._waiting.popleft() if newest is None else self._newest.pop(newest)
                await self._carry_out(asked, waits=not asked.call.newest)
        finally:
            if self._worker is worker:
                self._worker = self._under_way = None

    async def _carry_out(self, asked: _Asked, *, waits: bool) -> None:
        call, answer, error = asked.call, None, ""
        try:
            request = CallRequest(parameters=list(call.parameters)).model_copy(update={"program": self._id})
            if waits:
                answer = await self._robots.call(self.robot, call.command, request, asked.at, self._caller)
            else:
                await self._robots.tell(self.robot, call.command, request, asked.at, self._caller)
        except (CallError, ValueError, OverflowError) as failure:
            error = str(failure)
            log.debug("%s told %s %s: %s", self._address, self.robot, call.command, error)
        if error or answer is not None:
            self._answer(call, answer, error, self._clock())

    def _answer(self, call: Call, answer: Answer | None, error: str, now: float) -> None:
        """Tell of the outcome of a call; nothing is said of a set-point that a stop took the place of."""
        if self._ended:
            return

        def say() -> Sequence[Say]:
            said = self._persona.answered(call, answer, error, now)
            return () if call.newest and error == STOPPED else said

        self._do(say, now)

    def _set_timer(self, until: float | None, now: float) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if until is not None and not self._ended:
            self._timer = asyncio.get_running_loop().call_later(max(SHORTEST_S, until - now), self._due)

    def _due(self) -> None:
        self._timer = None
        now = self._clock()
        self._do(lambda: self._persona.due(now), now)

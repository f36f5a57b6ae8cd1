"""Robots that somebody moved, and what stops them when nobody is left who could: ``[robots.NAME.failsafe]``.

A program is known by the id that its calls carry, and is there for as long as its token on the bus is, whichever
broker it is connected to; the broker that sends to the robot watches. Whoever commands a robot by a frame of its own is
no program: only a silent link and the end of the broker concern it, and a program that moved the robot before is missed
as if nobody had since.
"""

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from math import inf
from typing import Final

from psiu_broker.config import Configuration
from psiu_broker.config.tables import FailsafeConfiguration
from psiu_broker.errors import CallError
from psiu_broker.frame import EVERYONE, Address, Frame
from psiu_broker.profiles.profile import Profile, Request
from psiu_broker.routing.outbox import STOP_LANE, lane

AWAITED_S: Final = 1.0
"""How long a program may take to show the token that its calls promise, or, after a trouble of the bus, again."""
AGAIN_S: Final = 1.0
"""How long after a stop that did not leave it is tried again."""
LAST_S: Final = 1.5
"""How long a stopping broker lets robots answer their stops."""
ON_LINK: Final = "@"
"""How the ids of programs begin that come by a link and have no token; no program on the bus is called so."""
PROGRAMS_KEPT: Final = 16_384
OFFERED_KEPT: Final = 256

log = logging.getLogger(__name__)

Stop = Callable[[Address, FailsafeConfiguration, float], Awaitable[object]]
"""Tell a robot, before anything else, what stops it, and wait for its answer for so long; raises CallError."""


@dataclass(slots=True, eq=False)
class Ward:
    """One robot that is watched over."""

    robot: Address
    link: str
    options: FailsafeConfiguration
    moved_at: float = -inf
    """When it was moved last; -inf: it has been stopped since, or nobody moved it."""
    program: str | None = None
    """Who of those who would be missed moved it last; None: nobody."""
    due: str = ""
    """Why it is to be stopped; empty: it is not."""
    failed: bool = False
    """A stop that is due did not leave."""
    not_before: float = -inf
    stopping: asyncio.Task[None] | None = None
    """The try that is under way, until the stop leaves."""
    asked_of: tuple[str, bytes] = ("", b"")
    """Subject and payload of what stops it."""

    @property
    def moves(self) -> bool:
        return self.moved_at > -inf


class Failsafe:
    """Implements `link.Watch` for the links of the robots it watches. All methods run on the event loop's thread."""

    def __init__(
        self,
        configuration: Configuration,
        stop: Stop,
        profile: Callable[[Address], Profile | None],
        heard_at: Callable[[Address], float | None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`profile` is what a robot understands, `heard_at` when it was heard last, by `clock`."""
        self._stop = stop
        self._profile = profile
        self._heard_at = heard_at
        self._clock = clock
        self._wards: dict[Address, Ward] = {}
        self._all: list[Ward] = []
        for robot in configuration.robots.values():
            if robot.failsafe is not None:
                ward = Ward(Address.named(robot.name), robot.link, robot.failsafe)
                self._all.append(ward)
                self._wards[ward.robot] = ward
                if robot.address is not None:
                    self._wards[robot.address] = ward
        self.links: Final = frozenset(ward.link for ward in self._all)
        self.last: Final = frozenset(each for each, ward in self._wards.items() if "broker_stop" in ward.options.on)
        """Those that are to hear nothing after the stop of a broker that stops."""
        self._open: set[str] = set()
        self._tries: set[asyncio.Task[None]] = set()
        self._closed = False
        self._present: set[str] = set()
        self._awaited: dict[str, float] = {}
        self._gone: dict[str, str] = {}
        """Programs that are there no more, and how they went."""
        self._offered: dict[int, tuple[Frame, Request, str | None]] = {}

    def ward(self, robot: Address) -> Ward | None:
        """The robot, if it is watched over."""
        return self._wards.get(robot)

    # What is sent to robots.

    def offered(self, ward: Ward, frame: Frame, request: Request, program: str | None) -> None:
        """`frame` is to be sent for `request`, at the wish of `program`.

        Raises:
            CallError: that program is gone, and nobody could stop what it begins.
        """
        if program is not None and self._gone.get(program) == _VANISHED and "program_gone" in ward.options.on:
            raise CallError("expired", f"the program that asked for it is gone; nothing was sent to {ward.robot}")
        self._offered[id(frame)] = frame, request, program
        while len(self._offered) > OFFERED_KEPT:
            del self._offered[next(iter(self._offered))]

    def stops(self, frame: Frame) -> bool:
        """Whether `frame` is what stops its robot, though its word may be that of any command."""
        ward = self._wards.get(frame.destination)
        return ward is not None and self._is_stop(ward, frame, self._offered.get(id(frame), (frame, frame))[1])

    def left(self, link: str, frame: Frame, now: float) -> None:
        """`frame` has left on a link."""
        _, request, program = self._offered.pop(id(frame), (frame, None, None))
        for ward in self._told(link, frame.destination):
            if self._is_stop(ward, frame, request or frame):
                if frame.destination == EVERYONE:
                    continue  # robots take no heed of it
                if ward.due:
                    log.info("%s has been told to stop", ward.robot)
                _let_go(ward)
            elif not request.question if request is not None else self._moves(ward, frame):
                self._note(ward, program, now)

    # Who is there.

    def program_came(self, program: str) -> None:
        """Its token is there."""
        self._awaited.pop(program, None)
        self._gone.pop(program, None)
        if len(self._present) < PROGRAMS_KEPT:
            self._present.add(program)

    def program_done(self, program: str) -> None:
        """It goes in good order: what it moved may go on."""
        self._leave(program, _DONE)
        for ward in self._all:
            if ward.program == program:
                ward.program = None

    def program_gone(self, program: str) -> None:
        """Its token is there no more."""
        if self._gone.get(program) == _DONE:
            return
        self._leave(program, _VANISHED)
        for ward in self._all:
            if ward.program == program and ward.moves:
                self._set_due(ward, "program_gone", "the program that moved it is gone")

    def programs_unsure(self) -> None:
        """The bus may not have told of some that went: each has to show its token again."""
        until = self._clock() + AWAITED_S
        self._awaited.update({program: until for program in self._present if not program.startswith(ON_LINK)})

    def link_opened(self, link: str) -> None:
        self._open.add(link)
        for ward in self._all:
            if ward.link == link and ward.due:
                ward.not_before = -inf
                self._begin(ward)

    def link_closed(self, link: str) -> None:
        self._open.discard(link)
        for ward in self._all:
            if ward.link == link and ward.moves:
                self._set_due(ward, "link_silent", "its link went down")

    def tick(self, now: float) -> None:
        """Look who is missed, and what is due; to be called often."""
        for program in [each for each, until in self._awaited.items() if until <= now]:
            self.program_gone(program)
        for ward in self._all:
            if not ward.moves:
                continue
            heard_at = self._heard_at(ward.robot)
            since = ward.moved_at if heard_at is None else max(ward.moved_at, heard_at)
            if now - since >= ward.options.silent_s:
                self._set_due(ward, "link_silent", f"nothing came from it for {ward.options.silent_s:g} s")
            if ward.due and now >= ward.not_before:
                self._begin(ward)

    async def close(self) -> None:
        """The broker stops, and nothing else is sent any more: stop what moves, try once more what did not leave,
        whyever it was due, and return when that has ended."""
        for ward in self._all:
            if ward.moves:
                self._set_due(ward, "broker_stop", "the broker stops")
            if ward.due:
                self._begin(ward)
        under_way = [(ward, ward.stopping) for ward in self._all if ward.stopping is not None]
        with suppress(TimeoutError):
            async with asyncio.timeout(LAST_S):
                await asyncio.gather(*(self._try_once_more(ward, task) for ward, task in under_way))
                if self._tries:
                    await asyncio.wait(self._tries)
        self._closed = True
        for task in self._tries:
            task.cancel()
        await asyncio.gather(*self._tries, return_exceptions=True)
        for ward in self._all:
            if ward.due:
                log.warning("%s may go on: the broker ends before it could be told to stop", ward.robot)

    # Inside.

    def _told(self, link: str, destination: Address) -> Iterable[Ward]:
        if destination == EVERYONE:
            return [ward for ward in self._all if ward.link == link]
        ward = self._wards.get(destination)
        return () if ward is None else (ward,)

    def _is_stop(self, ward: Ward, frame: Frame, asked: Request | Frame) -> bool:
        return lane(frame) == STOP_LANE or (asked.subject, asked.payload) == self._asked_of(ward)

    def _asked_of(self, ward: Ward) -> tuple[str, bytes]:
        profile = self._profile(ward.robot)
        if not ward.asked_of[0] and profile is not None:
            with suppress(CallError):  # by what a robot says of itself it may not know the command
                request = profile.request(ward.options.command, ward.options.parameters)
                ward.asked_of = request.subject, request.payload
        return ward.asked_of

    def _moves(self, ward: Ward, frame: Frame) -> bool:
        profile = self._profile(ward.robot)
        return profile is not None and profile.moves(frame)

    def _note(self, ward: Ward, program: str | None, now: float) -> None:
        """It has been moved, by `program`, or by somebody who would not be missed and takes nothing over."""
        ward.moved_at = now
        gone = None if program is None else self._gone.get(program)
        if program is None or gone == _DONE:
            return
        ward.program = program
        if gone == _VANISHED:
            self._set_due(ward, "program_gone", "the program that moved it is gone")
            return
        if ward.due:
            log.info("%s need not be stopped any more: another program moves it", ward.robot)
            ward.due = ""
        if program not in self._present:
            self._awaited.setdefault(program, now + AWAITED_S)

    def _leave(self, program: str, how: str) -> None:
        self._present.discard(program)
        self._awaited.pop(program, None)
        self._gone[program] = how
        while len(self._gone) > PROGRAMS_KEPT:
            del self._gone[next(iter(self._gone))]

    def _set_due(self, ward: Ward, loss: str, why: str) -> None:
        if loss in ward.options.on and not (ward.due or self._closed):
            ward.due, ward.failed, ward.not_before = why, False, -inf
            later = "" if ward.link in self._open else f", once link {ward.link} is open"
            log.warning("%s is told to stop%s: %s", ward.robot, later, why)
            self._begin(ward)

    def _begin(self, ward: Ward) -> None:
        if ward.stopping is None and ward.link in self._open and not self._closed:
            ward.not_before = self._clock() + AGAIN_S
            task = ward.stopping = asyncio.get_running_loop().create_task(self._carry_out(ward))
            self._tries.add(task)
            task.add_done_callback(self._tries.discard)

    async def _carry_out(self, ward: Ward) -> None:
        """Have the robot stopped; if that does not leave, or its link may have lost it, it stays due."""
        try:
            await self._stop(ward.robot, ward.options, LAST_S)
        except CallError as error:
            if ward.stopping is not asyncio.current_task():  # it has left
                log.warning("%s was told to stop, and may go on: %s", ward.robot, error)
                if error.code == "link_down" and not ward.moves:  # which may have lost it
                    ward.moved_at, ward.due, ward.failed = self._clock(), str(error), False
                    self._begin(ward)
            elif error.code == "unknown_robot":  # it is another broker's
                log.warning("%s is not told to stop: %s", ward.robot, error)
                _let_go(ward)
            elif not ward.failed:
                ward.failed = True
                log.warning("%s could not be told to stop yet: %s", ward.robot, error)
        finally:
            if ward.stopping is asyncio.current_task():
                ward.stopping = None

    async def _try_once_more(self, ward: Ward, under_way: asyncio.Task[None]) -> None:
        await asyncio.wait([under_way])
        if ward.due:
            self._begin(ward)
        if ward.stopping is not None:
            await asyncio.wait([ward.stopping])


def _let_go(ward: Ward) -> None:
    """It stands, or is somebody else's to watch."""
    ward.moved_at, ward.program, ward.due, ward.stopping = -inf, None, "", None


_DONE: Final = "done"
_VANISHED: Final = "vanished"

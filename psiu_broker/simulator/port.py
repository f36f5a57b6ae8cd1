"""What every simulated connection shares: robots behind a faulty line, and waiting until something is so."""

import asyncio
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from itertools import groupby
from types import TracebackType
from typing import Any, ClassVar, Literal, Self

from psiu_broker.simulator.faults import Faults, Line
from psiu_broker.simulator.robot import Robot

Observer = Callable[[Literal["in", "out"], bytes], None]
"""Told of all bytes as the robots get them (``in``) and as they leave on the line (``out``)."""

Condition = Callable[[], bool]


class Port(ABC):
    """One or more `robots` on one line; several hear each other as well as what comes from outside.

    A subclass opens something in `_attach`, hands what it reads to `_deliver`, and writes in `_put`.
    """

    datagrams: ClassVar[bool] = False

    def __init__(self, *robots: Robot, faults: Faults | None = None, observer: Observer | None = None) -> None:
        if not robots:
            raise ValueError("a port needs at least one robot")
        self.robots = robots
        self.robot = robots[0]
        self.plugged = False
        self._plugs = 0
        self._faults = faults or Faults()
        self._observer = observer
        self._loop: asyncio.AbstractEventLoop
        self._inward: Line
        self._outward: dict[Robot, Line] = {}
        self._in_flight: dict[Line, deque[tuple[Any, ...]]] = {}
        self._timers: set[asyncio.TimerHandle] = set()
        self._checks: set[Callable[[], None]] = set()

    @abstractmethod
    def _attach(self) -> None:
        """Open the connection.

        Raises:
            OSError: it cannot be opened.
        """

    @abstractmethod
    def _detach(self) -> None:
        """Close the connection at once."""

    @abstractmethod
    def _put(self, data: bytes, peer: object) -> None:
        """Write `data` for `peer` (None: whoever there is); what does not fit is lost, as on a real line."""

    async def open(self) -> None:
        """Begin: the line's clock, telemetry, and the connection itself.

        Raises:
            OSError: the connection cannot be opened.
        """
        self._loop = asyncio.get_running_loop()
        now = self._loop.time()
        self._inward = self._faults.line("in", now)
        self._outward = {robot: self._faults.line(f"out/{robot.name}", now) for robot in self.robots}
        self._in_flight = {line: deque() for line in (self._inward, *self._outward.values())}
        self.plug()
        for robot in self.robots:
            if robot.telemetry_s is not None:
                self._at(now + robot.telemetry_s, self._tell, robot, now + robot.telemetry_s)

    async def close(self) -> None:
        """End everything; harmless twice."""
        self.unplug()
        for timer in self._timers:
            timer.cancel()
        self._timers.clear()

    async def __aenter__(self) -> Self:
        await self.open()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    def plug(self) -> None:
        """Connect (again); harmless when connected.

        Raises:
            OSError: the connection cannot be opened.
        """
        if not self.plugged:
            self._attach()
            self.plugged = True
            self._plugs += 1
            self._changed()

    def unplug(self) -> None:
        """Pull the cable: what is on the way is lost, the robots go on and nobody hears them."""
        if self.plugged:
            self.plugged = False
            self._detach()
            for robot in self.robots:
                robot.boundary()
            self._changed()

    def send(self, data: bytes, robot: Robot | None = None) -> None:
        """Let `robot` (default: the first) send `data` of its own accord."""
        self._speak(robot or self.robot, data, None, self._loop.time())

    async def until(self, condition: Condition, timeout_s: float = 5.0) -> None:
        """Return once `condition()` is true; it is asked again whenever something happens on this port.

        Raises:
            TimeoutError: it was not true within `timeout_s`.
        """
        await _until((self,), condition, timeout_s)

    def _deliver(self, data: bytes, peer: object) -> None:
        """Bytes that came from outside."""
        self._carry(self._inward, data, self._arrived, peer)

    def _arrived(self, data: bytes, peer: object) -> None:
        if self.plugged:
            if self._observer:
                self._observer("in", data)
            self._hear(data, peer, None)

    def _hear(self, data: bytes, peer: object, speaker: Robot | None) -> None:
        now = self._loop.time()
        for robot in self.robots:
            if robot is speaker:
                continue
            if self.datagrams:
                robot.boundary()
            # Answers due together share a timer: timers of one moment have no order among themselves.
            for delay_s, replies in groupby(robot.receive(data, now), key=lambda reply: reply[0]):
                self._later(delay_s, self._say, robot, [reply for _, reply in replies], peer, now + delay_s)
        self._changed()

    def _say(self, robot: Robot, replies: Sequence[bytes], peer: object, when: float) -> None:
        for reply in replies:
            self._speak(robot, reply, peer, when)

    def _speak(self, robot: Robot, data: bytes, peer: object, when: float) -> None:
        robot.advance(max(when, self._loop.time()))
        self._carry(self._outward[robot], data, self._leave, peer)
        if len(self.robots) > 1:
            self._hear(data, peer, robot)
        self._changed()

    def _leave(self, data: bytes, peer: object) -> None:
        if self.plugged:
            if self._observer:
                self._observer("out", data)
            self._put(data, peer)

    def _tell(self, robot: Robot, when: float) -> None:
        robot.advance(max(when, self._loop.time()))
        self._speak(robot, robot.telemetry(), None, when)
        if robot.telemetry_s is not None:
            self._at(when + robot.telemetry_s, self._tell, robot, when + robot.telemetry_s)

    def _carry(self, line: Line, data: bytes, arrive: Callable[[bytes, object], None], peer: object) -> None:
        now = self._loop.time()
        waiting = self._in_flight[line]
        for delay_s, piece in line.carry(data, now):
            if delay_s <= 0 and not waiting:
                arrive(piece, peer)
            else:
                # One queue a line: timers of one moment would let pieces overtake each other.
                waiting.append((self._plugs, arrive, piece, peer))
                self._at(now + delay_s, self._next_arrives, waiting)

    def _next_arrives(self, waiting: deque[tuple[Any, ...]]) -> None:
        plugs, arrive, piece, peer = waiting.popleft()
        if plugs == self._plugs:
            arrive(piece, peer)

    def _later(self, delay_s: float, callback: Callable[..., None], *arguments: object) -> None:
        if delay_s <= 0:
            callback(*arguments)
        else:
            self._at(self._loop.time() + delay_s, callback, *arguments)

    def _at(self, when: float, callback: Callable[..., None], *arguments: object) -> None:
        def due() -> None:
            self._timers.discard(timer)
            callback(*arguments)

        timer = self._loop.call_at(when, due)
        self._timers.add(timer)

    def _changed(self) -> None:
        for check in tuple(self._checks):
            check()


class Simulation:
    """Several ports opened and closed together."""

    def __init__(self, *ports: Port) -> None:
        self.ports = ports

    async def __aenter__(self) -> Self:
        try:
            for port in self.ports:
                await port.open()
        except BaseException:
            await self._close()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._close()

    async def _close(self) -> None:
        for port in reversed(self.ports):
            await port.close()

    async def until(self, condition: Condition, timeout_s: float = 5.0) -> None:
        """Return once `condition()` is true; it is asked again whenever something happens on any port.

        Raises:
            TimeoutError: it was not true within `timeout_s`.
        """
        await _until(self.ports, condition, timeout_s)


async def _until(ports: Sequence[Port], condition: Condition, timeout_s: float) -> None:
    met: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    def check() -> None:
        if met.done():
            return
        try:
            if condition():
                met.set_result(None)
        except Exception as error:
            # The asker's mistake, not the robot's: it belongs to the asker.
            met.set_exception(error)

    for port in ports:
        port._checks.add(check)
    try:
        check()
        async with asyncio.timeout(timeout_s):
            await met
    finally:
        for port in ports:
            port._checks.discard(check)

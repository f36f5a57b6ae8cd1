"""What goes on around the broker: robots that talk, a program that calls, and trouble on the lines."""

import asyncio
import contextlib
import random
import threading
from collections import Counter
from itertools import chain
from typing import Final

from psiu_broker.bus.client import Client
from psiu_broker.errors import CallError, PsiuError
from psiu_broker.messages import CallRequest
from psiu_broker.simulator import Port, PtyPort
from tests.soak.lab import Lab

HELLO_EVERY_S: Final = 0.5
ORDER_EVERY_S: Final = 0.05
ORDERS_EACH: Final = 3
LOST_ROBOT: Final = 0.02
"""How often somebody is told something who is not there."""
TROUBLE_EVERY_S: Final = 2.0
GONE_S: Final = (0.02, 0.3, 2.5)
FLAPS: Final = 10
FLAP_S: Final = 0.05
NOISE_BYTES: Final = 200
CALL_S: Final = 1.0
CALL_EVERY_S: Final = 0.02


class Caller(threading.Thread):
    """A program that calls one robot after the other; `outcomes` counts how that ended."""

    def __init__(self, endpoint: str, lab: Lab, seed: int) -> None:
        super().__init__(name="caller", daemon=True)
        self.outcomes: Counter[str] = Counter()
        self.ending = threading.Event()
        self._endpoint = endpoint
        luck = random.Random(seed)
        self._next = chain(lab.calls, iter(lambda: luck.choice(lab.calls), None))

    def run(self) -> None:
        while not self.ending.is_set():
            with contextlib.suppress(PsiuError), Client([self._endpoint]) as client:
                self._call(client)

    def _call(self, client: Client) -> None:
        """Until the session is lost, as happens where a machine has too much to do."""
        while not self.ending.wait(CALL_EVERY_S):
            call = next(self._next)
            request = CallRequest(parameters=list(call.parameters), timeout_s=CALL_S)
            try:
                client.call(call.robot, call.command, request)
            except CallError as error:
                self.outcomes[error.code] += 1
                if error.code == "no_answer" and not client.brokers():
                    return
            else:
                self.outcomes["answered"] += 1

    def end(self) -> None:
        self.ending.set()
        self.join()


class Trouble:
    """Robots that order others about, cables that are pulled, and noise; runs on the robots' loop."""

    def __init__(self, lab: Lab, seed: int) -> None:
        self.done: Counter[str] = Counter()
        self._lab = lab
        self._random = random.Random(seed)
        self._orders = {
            robot.name: self._random.sample([call for call in lab.calls if call.robot != robot.name], ORDERS_EACH)
            for _, robot in lab.speakers
        }
        self._tasks: list[asyncio.Task[None]] = []

    def begin(self) -> None:
        self._tasks = [asyncio.create_task(self._order()), asyncio.create_task(self._break())]

    async def end(self) -> None:
        """Nobody is told anything more, and every cable is in its place."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for port in self._lab.ports:
            _plug(port)

    async def _order(self) -> None:
        """Everybody asks who is there, and every pair talks once, so that the broker is warm soon; then at random."""
        for port, robot in self._lab.speakers:
            port.send(robot.hello(), robot)
            await asyncio.sleep(HELLO_EVERY_S)
        pairs = [(port, robot, call) for port, robot in self._lab.speakers for call in self._orders[robot.name]]
        for port, robot, call in chain(pairs, iter(lambda: self._random.choice(pairs), None)):
            if self._random.random() < LOST_ROBOT:
                speaker, stray = self._lab.speakers[0]
                speaker.send(stray.command("NOBODY", "parafrente", 1), stray)
            port.send(robot.command(call.robot, call.command, *call.parameters), robot)
            self.done["orders"] += 1
            await asyncio.sleep(ORDER_EVERY_S)

    async def _break(self) -> None:
        while True:
            await asyncio.sleep(TROUBLE_EVERY_S * self._random.uniform(0.5, 1.5))
            port = self._random.choice(self._lab.ports)
            what = self._random.choice(("pulled", "flapping", "noise"))
            self.done[what] += 1
            if what == "noise":
                port.send(self._random.randbytes(NOISE_BYTES))
            elif what == "pulled":
                await self._pull(port, self._random.choice(GONE_S))
            else:
                for _ in range(FLAPS):
                    await self._pull(port, FLAP_S)
                    await asyncio.sleep(FLAP_S)

    async def _pull(self, port: Port, seconds: float) -> None:
        port.unplug()
        try:
            await asyncio.sleep(seconds)
        finally:
            _plug(port)


def _plug(port: Port) -> None:
    # The port of a UDP robot may have been taken meanwhile; a pseudo-terminal is always there.
    with contextlib.suppress(() if isinstance(port, PtyPort) else OSError):
        port.plug()

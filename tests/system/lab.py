"""Brokers as processes in namespaces, each with a robot beside it and a program that calls through it."""

import asyncio
import itertools
import json
import os
import signal
import socket
import sys
from collections.abc import Sequence
from contextlib import AsyncExitStack, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, Literal

from system.network import Network
from system.robot import ORDER, CountingRobot

Mode = Literal["router", "peer"]

ROOT: Final = Path(__file__).parents[2]
BIN: Final = Path(sys.executable).parent
BUS: Final = 7447
LINK: Final = 9000
ROBOT: Final = 9001
END_S: Final = 6.0
CALL_S: Final = 0.5
"""A caller gives up a call after this and the client's margin."""

CONFIGURATION: Final = """
[broker]
name = "{broker}"
[zenoh]
listen = ["tcp/0.0.0.0:7447"]
unprotected = true
[mesh]
mode = "{mode}"
connect = {connect}
[links.wifi]
adapter = "udp"
listen = "127.0.0.1:9000"
peers = ["127.0.0.1:9001"]
protocol = "psiu-ascii"
timeout_s = {timeout_s}
"""


class BrokerProcess:
    """`psiu-broker run` in a namespace; its log is kept."""

    def __init__(self, name: str, command: Sequence[str], folder: Path) -> None:
        self.name = name
        self._log = folder / f"{name}.log"
        self._command = command
        self._folder = folder / name
        self._folder.mkdir()
        self._process: asyncio.subprocess.Process | None = None

    async def spawn(self) -> None:
        own = str(self._folder)
        environment = {**os.environ, "NO_COLOR": "1", "RUNTIME_DIRECTORY": own, "XDG_RUNTIME_DIR": own}
        with self._log.open("ab") as log:
            self._process = await asyncio.create_subprocess_exec(
                *self._command, stdin=asyncio.subprocess.DEVNULL, stdout=log, stderr=log, env=environment
            )

    def signal(self, number: signal.Signals) -> None:
        assert self._process is not None
        self._process.send_signal(number)

    async def ended(self) -> int:
        """The exit code. Raises TimeoutError after `END_S`."""
        assert self._process is not None
        async with asyncio.timeout(END_S):
            return await self._process.wait()

    async def kill(self) -> None:
        """End it at once; harmless where it has ended."""
        with suppress(ProcessLookupError):
            self.signal(signal.SIGKILL)
        await self.ended()

    def note(self, text: str) -> None:
        """Write a line of our own into its log."""
        with self._log.open("a") as log:
            log.write(f"{datetime.now(UTC):%F %T.%f} ---- {text}\n")


class CallerProcess:
    """`tests.system.caller` in a namespace."""

    def __init__(self) -> None:
        self._numbers = itertools.count()
        self._waiting: dict[int, asyncio.Future[dict[str, Any]]] = {}
        self._process: asyncio.subprocess.Process
        self._reading: asyncio.Task[None]

    async def open(self, command: Sequence[str]) -> None:
        pipe = asyncio.subprocess.PIPE
        self._process = await asyncio.create_subprocess_exec(*command, stdin=pipe, stdout=pipe, cwd=ROOT)
        self._reading = asyncio.create_task(self._read())

    async def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            async with asyncio.timeout(END_S):
                await self._process.wait()
        except TimeoutError:
            self._process.kill()
            await self._process.wait()
        await self._reading

    async def call(self, robot: str, word: str) -> str | None:
        """Order `robot` to do `word`; None, or why there is no answer."""
        answer = await self._request(call=[robot, ORDER, word], timeout_s=CALL_S)
        if answer.get("answer") == [word]:
            return None
        return str(answer.get("error", answer))

    async def ask(self, broker: str, what: str) -> dict[str, Any] | None:
        """What a broker answers to ``psiu/@broker/{broker}/{what}``, if it does."""
        answer: dict[str, Any] | None = (await self._request(ask=[broker, what])).get("answer")
        return answer

    async def _request(self, **what: object) -> dict[str, Any]:
        number = next(self._numbers)
        future: asyncio.Future[dict[str, Any]] = asyncio.get_running_loop().create_future()
        self._waiting[number] = future
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"id": number, **what}).encode() + b"\n")
        return await future

    async def _read(self) -> None:
        assert self._process.stdout is not None
        async for line in self._process.stdout:
            answer = json.loads(line)
            self._waiting.pop(answer["id"]).set_result(answer)
        for future in self._waiting.values():
            future.set_result({"error": "the caller ended"})
        self._waiting.clear()


class Lab:
    """One broker for each namespace of `network`; an async context manager."""

    def __init__(self, network: Network, mode: Mode, folder: Path) -> None:
        self.network = network
        self.mode = mode
        self.nodes: Final = range(len(network.namespaces))
        self.news = asyncio.Event()
        """Set whenever a robot has heard something."""
        self.robots: Final = [
            CountingRobot(f"BETA{node + 1}", ("127.0.0.1", LINK), self.news.set) for node in self.nodes
        ]
        self.brokers: Final[list[BrokerProcess]] = []
        self.callers: Final = [CallerProcess() for _ in self.nodes]
        for node in self.nodes:
            name = f"base{node + 1}"
            file = folder / f"{name}.toml"
            file.write_text(self._configuration(node, name))
            command = network.command(node, BIN / "psiu-broker", "run", "--config", file)
            self.brokers.append(BrokerProcess(name, command, folder))
        self._folder = folder
        self._stack = AsyncExitStack()

    async def __aenter__(self) -> "Lab":
        async with AsyncExitStack() as stack:
            for node, robot in enumerate(self.robots):
                await robot.open(self.network.inside(node, _robot_socket))
                stack.callback(robot.close)
            for broker in self.brokers:
                await broker.spawn()
                stack.push_async_callback(broker.kill)
            for node, caller in enumerate(self.callers):
                module = (sys.executable, "-m", "tests.system.caller", f"tcp/127.0.0.1:{BUS}")
                await caller.open(self.network.command(node, *module))
                stack.push_async_callback(caller.close)
            self._stack = stack.pop_all()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._stack.aclose()

    async def ask(self, node: int, what: str) -> dict[str, Any] | None:
        """What the broker of `node` answers to a program beside it, if it does."""
        return await self.callers[node].ask(self.brokers[node].name, what)

    def note(self, text: str) -> None:
        """Write a line into the log of every broker."""
        for broker in self.brokers:
            broker.note(text)

    def _configuration(self, node: int, name: str) -> str:
        neighbours = [
            f"tcp/{cable.address(other)}:{BUS}"
            for cable in self.network.cables_of(node)
            for other in (cable.a, cable.b)
            if other < node  # each link has one side that connects
        ]
        return CONFIGURATION.format(broker=name, mode=self.mode, connect=json.dumps(neighbours), timeout_s=CALL_S)


def _robot_socket() -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.setblocking(False)
    made.bind(("127.0.0.1", ROBOT))
    return made

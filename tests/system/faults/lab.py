"""A broker in a process of its own between MNERIM, whose link is in trouble, and two robots that talk all the while."""

import asyncio
import contextlib
import os
import re
import signal
import socket
import struct
import subprocess
import sys
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any, Final, Literal

import psutil
from ports import free_port
from system.faults.ends import QUESTION, SPEAKS_EVERY_S, End, robot

from psiu_broker.bus.client import Client
from psiu_broker.errors import BusError, CallError
from psiu_broker.messages import CallRequest
from psiu_broker.simulator import PtyPort, UdpPort

BIN: Final = Path(sys.executable).parent
STEPPED: Final = Path(__file__).with_name("stepped_clock.py")
EVERY_S: Final = 0.1
PATIENCE_S: Final = 90.0
"""On a machine that does much else; what is measured is printed, not judged."""
GROWN_BYTES: Final = 8 * 2**20
"""By so much may memory differ: what is freed is not always given back at once."""

CONFIGURATION: Final = """
[broker]
name = "{name}"
[zenoh]
listen = ["tcp/127.0.0.1:{bus}"]
[mesh]
{mesh}
"""
LINKS: Final = """
[links.trouble]
{trouble}
protocol = "psiu-ascii"
timeout_s = 0.5
retries = 0
[links.left]
adapter = "serial"
device = "{left}"
protocol = "psiu-ascii"
[links.right]
adapter = "udp"
listen = "127.0.0.1:{right}"
protocol = "psiu-ascii"
"""


class Base:
    """A broker as a process, and a program on its bus."""

    def __init__(self, folder: Path, name: str, links: str, mesh: str = "") -> None:
        self.port = free_port()
        self.file = folder / f"{name}.toml"
        self.file.write_text(CONFIGURATION.format(name=name, bus=self.port, mesh=mesh) + links)
        self.log = folder / f"{name}.log"
        self.environment: dict[str, str] = {}
        self.program = [str(BIN / "psiu-broker")]
        self.process: subprocess.Popen[bytes]
        self.client: Client

    async def start(self) -> None:
        with self.log.open("ab") as log:
            self.process = await asyncio.to_thread(
                subprocess.Popen,
                [*self.program, "run", "--config", str(self.file)],
                env={**os.environ, **self.environment},
                stderr=log,
            )
        try:
            self.client = await self.met()
        except BaseException:
            self.process.kill()
            self.process.wait()
            raise

    async def met(self) -> Client:
        """A program on its bus, as soon as there is one."""
        async with asyncio.timeout(PATIENCE_S):
            while True:
                assert self.process.poll() is None, self.log.read_text()
                with contextlib.suppress(BusError):
                    return await asyncio.to_thread(Client, [f"tcp/127.0.0.1:{self.port}"])

    async def stop(self, how: signal.Signals = signal.SIGTERM) -> int:
        await asyncio.to_thread(self.client.close)
        self.process.send_signal(how)
        return await asyncio.to_thread(self.process.wait, PATIENCE_S)

    async def ask(self, what: str) -> Any:
        """What the broker itself says."""
        name = self.file.stem
        answers = await asyncio.to_thread(self.client.ask, what, broker=name, timeout_s=10.0)
        return answers[name]

    async def answered(self, name: str = "MNERIM") -> None:
        """`name` answers a call; as many are made as it takes."""
        request = CallRequest(timeout_s=0.5)
        async with asyncio.timeout(PATIENCE_S):
            while True:
                with contextlib.suppress(CallError):
                    await asyncio.to_thread(self.client.call, name, QUESTION, request)
                    return
                await asyncio.sleep(0.02)

    def files(self) -> int:
        return psutil.Process(self.process.pid).num_fds()

    def memory(self) -> int:
        return int(psutil.Process(self.process.pid).memory_info().rss)


class Lab:
    """`end` is MNERIM's; ALFA on a serial port tells BRAVO on UDP a number, again and again."""

    def __init__(self, folder: Path, end: End) -> None:
        self.folder = folder
        self.end = end
        right = free_port(socket.SOCK_DGRAM)
        self._alfa = robot("ALFA")
        self._left = PtyPort(self._alfa, link=folder / "alfa")
        self._right = UdpPort(robot("BRAVO", SPEAKS_EVERY_S), peer=f"127.0.0.1:{right}", observer=self._overheard)
        links = LINKS.format(trouble=end.options, left=self._left.path, right=right)
        self.base = Base(folder, "base", links)
        self.recovered_s: float | None = None
        """Where a fault is judged by something else than MNERIM's next answer."""
        self.told = 0
        self.heard: list[int] = []

    @contextlib.asynccontextmanager
    async def running(self, *, absent: bool = False) -> AsyncIterator[None]:
        """With MNERIM there, unless it is `absent`. In the end everything must be as it was."""
        async with self._left:
            if not absent:
                await self.end.open()
            try:
                await self.base.start()
                try:
                    async with self._right:
                        await self.base.answered("BRAVO")
                        await self.base.answered("ALFA")
                        if not absent:
                            await self.base.answered()
                        talking = asyncio.create_task(self._talk())
                        try:
                            files, memory = self.base.files(), self.base.memory()
                            yield
                        finally:
                            talking.cancel()
                            await asyncio.wait({talking})
                        await self._is_as_before(files + absent * FILES_OF_A_LINK, memory)
                finally:
                    code = await self.base.stop()
                assert code == 0, self.base.log.read_text()
            finally:
                await self.end.close()

    async def until(self, true: Callable[[], Awaitable[object]]) -> None:
        async with asyncio.timeout(PATIENCE_S):
            while not await true():  # noqa: ASYNC110 - what another process is like is no event
                await asyncio.sleep(0.05)

    async def link(self) -> Any:
        """What the broker tells of the link that is in trouble."""
        return next(link for link in await self.base.ask("links") if link["name"] == "trouble")

    async def _talk(self) -> None:
        while True:
            self.told += 1
            self._left.send(self._alfa.say("BRAVO", "marca", self.told))
            await asyncio.sleep(EVERY_S)

    def _overheard(self, direction: Literal["in", "out"], data: bytes) -> None:
        if direction == "in":
            self.heard += [int(number) for number in re.findall(rb"BRAVO \d+ marca (\d+) ALFA", data)]

    async def _is_as_before(self, files: int, memory: int) -> None:
        async def all_heard() -> bool:
            return len(self.heard) >= self.told

        await self.until(all_heard)
        assert self.heard == list(range(1, self.told + 1)), "another link lost something, or got it twice"
        ledger = await self.base.ask("ledger")
        assert ledger["balances"], ledger
        (left,) = (account for account in ledger["accounts"] if account["link"] == "left")
        assert (left["delivered"] >= self.told, left["dropped"]) == (True, {}), left
        health = await self.base.ask("health")
        assert health["healthy"], health

        async def closed() -> bool:
            return self.base.files() <= files

        try:
            await self.until(closed)
        except TimeoutError:
            raise AssertionError(f"{self.base.files()} descriptors, {files} before") from None
        assert self.base.memory() - memory < GROWN_BYTES, f"memory grew by {self.base.memory() - memory} bytes"


FILES_OF_A_LINK: Final = 4
"""At most, of any kind of link, with what it watches."""


class SteppedClock:
    """The wall clock of `base`, which starts with it."""

    def __init__(self, base: Base, file: Path) -> None:
        self._file = file
        self.step(0.0)
        base.program = [sys.executable, str(STEPPED), str(file)]

    def step(self, to_s: float) -> None:
        """Be `to_s` ahead of the true time."""
        with self._file.open("r+b" if self._file.exists() else "wb") as file:
            file.write(struct.pack("d", to_s))


@contextlib.contextmanager
def small_disk(folder: Path) -> Iterator[None]:
    """A file system of 64 kB on `folder`."""
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "none", str(folder)], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def fill(file: Path) -> None:
    """Write until nothing fits."""
    with contextlib.suppress(OSError), file.open("wb", buffering=0) as rest:
        while True:
            rest.write(bytes(512))

"""The processes that are measured, each on a core of its own where there is another for the load."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Self

from tests.bench.ends import LEFT, RIGHT, Ends, PtyEnds, UdpEnds

HERE = Path(__file__).parent
CORES = sorted(os.sched_getaffinity(0))
ROUTER_CORE, LOAD_CORE = (CORES[0], CORES[1]) if len(CORES) > 1 else (CORES[0], CORES[0])
BROKER_COMMAND = Path(sys.executable).with_name("psiu-broker")

CPU_CLOCK = 2
"""CPUCLOCK_SCHED of the kernel's clock ids: nanoseconds of a process with all its threads."""

CONFIGURATION = """
[broker]
name = "base"
[zenoh]
listen = ["{bus}"]
"""
UDP_LINK = """
[links.{name}]
adapter = "udp"
listen = "127.0.0.1:{port}"
protocol = "psiu-ascii"
new_names_per_minute = 100000
"""
PTY_LINK = """
[links.{name}]
adapter = "serial"
device = "{device}"
baudrate = 4000000
pace = false
protocol = "psiu-ascii"
new_names_per_minute = 100000
"""


@contextmanager
def on_core(core: int) -> Iterator[None]:
    """What is started meanwhile runs on `core`, with all its threads."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {core})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


class Router:
    """A running router; its log goes to `log`."""

    def __init__(self, command: Sequence[str | Path], log: Path) -> None:
        self._log = log
        with on_core(ROUTER_CORE), log.open("wb") as output:
            self.started = time.perf_counter()
            self._process = subprocess.Popen(
                [str(word) for word in command], stdout=output, stderr=output, stdin=subprocess.DEVNULL
            )
        self._clock = (~self._process.pid << 3) | CPU_CLOCK

    def cpu_s(self) -> float:
        """CPU time used so far by all threads.

        Raises:
            RuntimeError: it has ended.
        """
        if self._process.poll() is not None:
            raise RuntimeError(f"a router ended by itself:\n{self._log.read_text()}")
        return time.clock_gettime(self._clock)

    def rss_mib(self) -> float:
        pages = Path(f"/proc/{self._process.pid}/statm").read_text().split()[1]
        return int(pages) * os.sysconf("SC_PAGE_SIZE") / 2**20

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._process.send_signal(signal.SIGTERM)
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if error is not None:
            print(self._log.read_text(), file=sys.stderr)


def broker(ends: Ends, folder: Path, bus: str) -> Router:
    """`psiu-broker run` with a link to each of `ends`."""
    text = CONFIGURATION.format(bus=bus)
    for side, name in ((LEFT, "left"), (RIGHT, "right")):
        if isinstance(ends, UdpEnds):
            text += UDP_LINK.format(name=name, port=ends.router_ports[side])
        elif isinstance(ends, PtyEnds):
            text += PTY_LINK.format(name=name, device=ends.devices[side])
    name = bus.rpartition(":")[2]
    configuration = folder / f"{name}.toml"
    configuration.write_text(text)
    return Router([BROKER_COMMAND, "run", "--config", configuration], folder / f"{name}.log")


def forwarder(ends: Ends, robots: tuple[Sequence[bytes], Sequence[bytes]], folder: Path) -> Router:
    """The bare forwarder between `ends`; `robots` are those on each side."""
    arguments = ["pty" if isinstance(ends, PtyEnds) else "udp"]
    for side in (LEFT, RIGHT):
        if isinstance(ends, UdpEnds):
            arguments.append(str(ends.router_ports[side]))
            arguments += [f"{robot.decode()}={ends.ports[side]}" for robot in robots[side]]
        elif isinstance(ends, PtyEnds):
            arguments.append(ends.devices[side])
            arguments += [robot.decode() for robot in robots[side]]
    return Router([sys.executable, HERE / "forwarder.py", *arguments], folder / "forwarder.log")


class Listener:
    """A Zenoh client in its own process, on the load's core, that counts what comes on psiu/**."""

    def __init__(self, bus: str) -> None:
        with on_core(LOAD_CORE):
            self._process = subprocess.Popen(
                [sys.executable, HERE / "listener.py", bus], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            )
        self.told()

    def told(self) -> int:
        """How many messages came until now."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        return int(self._process.stdout.readline())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with self._process as ending:
            assert ending.stdin is not None
            ending.stdin.close()


def free_bus() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"

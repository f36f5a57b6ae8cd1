"""A broker, a program that moves MNERIM, each in a process of its own, and MNERIM on a UDP socket here.

There may be another broker, `hill`, which has no robot: programs then connect to that one.
"""

import contextlib
import select
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from psiu_broker.bus.client import Client
from tests.ports import free_port

PATIENCE_S = 20.0
ROOT = Path(__file__).parents[2]

CONFIGURATION = """
[broker]
name = "base"
[zenoh]
listen = ["tcp/127.0.0.1:{bus}"]
[links.wifi]
adapter = "udp"
listen = "127.0.0.1:{wifi}"
peers = ["127.0.0.1:{robot}"]
protocol = "psiu-ascii"
[robots.MNERIM]
link = "wifi"
{more}
"""


HILL = """
[broker]
name = "hill"
[zenoh]
listen = ["tcp/127.0.0.1:{bus}"]
[mesh]
connect = ["tcp/127.0.0.1:{base}"]
"""


class Lab:
    """MNERIM, and what it has heard: each message, and when by the monotonic clock."""

    def __init__(self, folder: Path, more: str, *, hill: bool = False) -> None:
        self.heard: list[tuple[float, str]] = []
        self.answers = True
        self.spoke_at = 0.0
        """When it answered last."""
        self.robot = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.robot.bind(("127.0.0.1", 0))
        self._brokers: list[subprocess.Popen[str]] = []
        self._others: list[subprocess.Popen[str]] = []
        try:
            self._open(folder, more, hill=hill)
        except BaseException:
            self.close()
            raise

    def program(self, *how: str, wire: int = 0) -> subprocess.Popen[str]:
        """A program that has moved MNERIM, connected by `wire` where there is one."""
        endpoint = f"tcp/127.0.0.1:{wire or self.bus}"
        program = self._started(self._others, sys.executable, "-m", "tests.system.mover", endpoint, *how)
        self.until("parafrente")
        self._await(program, program.stdout, "moved")
        return program

    def wire(self) -> tuple[int, subprocess.Popen[str]]:
        """A wire to the broker of programs: the port at their end, and the process that is the wire."""
        port = free_port()
        wire = self._started(self._others, sys.executable, "-m", "tests.system.wire", str(port), str(self.bus))
        self._await(wire, wire.stdout, "laid")
        return port, wire

    def until(self, word: str, timeout_s: float = PATIENCE_S) -> float:
        """Be MNERIM until it is told `word`; when that was."""
        end = time.monotonic() + timeout_s
        while time.monotonic() < end:
            if self._hear(end - time.monotonic()) == word:
                return self.heard[-1][0]
        raise AssertionError(f"MNERIM was not told {word}, but {self.words}")

    def listen(self, seconds: float) -> list[str]:
        """Be MNERIM for so long; what it is told meanwhile."""
        before, end = len(self.heard), time.monotonic() + seconds
        while (rest_s := end - time.monotonic()) > 0:
            self._hear(rest_s)
        return self.words[before:]

    @property
    def words(self) -> list[str]:
        """All that it was told, but for questions."""
        return [word for _, word in self.heard if word != "qualseunome"]

    def leave(self) -> None:
        """End programs and wires; the brokers stay."""
        self._end(self._others)

    def close(self) -> None:
        self._end(self._others)
        self._end(self._brokers)
        self.robot.close()

    @staticmethod
    def _end(processes: "list[subprocess.Popen[str]]") -> None:
        for process in processes:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            process.communicate()
        processes.clear()

    def _hear(self, timeout_s: float) -> str:
        if not select.select([self.robot], [], [], max(0.0, timeout_s))[0]:
            return ""
        data, sender = self.robot.recvfrom(1000)
        at = time.monotonic()
        _, _, word, *_ = data.decode().split()
        self.heard.append((at, word))
        if self.answers:
            text = "base 000 qualseunome MNERIM " if word == "qualseunome" else f"base 000 {word} sucesso MNERIM "
            text = text.replace("000", f"{len(text) + 5:03d}")
            self.robot.sendto(f"{text}{sum(text.encode()) % 65536:05d}".encode(), sender)
            self.spoke_at = time.monotonic()
        return word

    def _open(self, folder: Path, more: str, *, hill: bool) -> None:
        self.bus = free_port()
        wifi = free_port(socket.SOCK_DGRAM)
        robot = self.robot.getsockname()[1]
        base = CONFIGURATION.format(bus=self.bus, wifi=wifi, robot=robot, more=more)
        self.broker = self._broker(folder / "base.toml", base)
        if hill:
            self.bus, port = free_port(), self.bus
            self.hill = self._broker(folder / "hill.toml", HILL.format(bus=self.bus, base=port))
            self._meet()

    def _meet(self) -> None:
        """Be MNERIM until `hill` knows whose it is."""
        end = time.monotonic() + PATIENCE_S
        with Client([f"tcp/127.0.0.1:{self.bus}"]) as client:
            while time.monotonic() < end:
                self.listen(0.05)
                seen = client.ask("mesh", broker="hill").get("hill", {"robots": []})
                if any((each["robot"], each["owner"]) == ("MNERIM", "base") for each in seen["robots"]):
                    return
        raise AssertionError("hill does not know that MNERIM is with base")

    def _broker(self, file: Path, text: str) -> "subprocess.Popen[str]":
        file.write_text(text)
        command = Path(sys.executable).parent / "psiu-broker"
        broker = self._started(self._brokers, command, "run", "--config", file)
        self._await(broker, broker.stderr, "is ready")
        return broker

    @staticmethod
    def _started(kept: "list[subprocess.Popen[str]]", *command: str | Path) -> "subprocess.Popen[str]":
        pipe = subprocess.PIPE
        started = subprocess.Popen(
            [str(each) for each in command], stdin=pipe, stdout=pipe, stderr=pipe, text=True, cwd=ROOT
        )
        kept.append(started)
        return started

    @staticmethod
    def _await(process: "subprocess.Popen[str]", stream: object, text: str) -> None:
        for line in stream:  # type: ignore[attr-defined]
            if text in line:
                return
        raise AssertionError(f"{process.args} ended without {text!r}: {process.communicate()}")


@contextlib.contextmanager
def lab(more: str, *, hill: bool = False) -> Iterator[Lab]:
    with tempfile.TemporaryDirectory(prefix="psiu-failsafe-") as folder:
        made = Lab(Path(folder), more, hill=hill)
        try:
            yield made
        finally:
            made.close()

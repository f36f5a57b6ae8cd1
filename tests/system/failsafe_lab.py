"""A broker, a program that moves MNERIM, each in a process of its own, and MNERIM on a UDP socket here."""

import contextlib
import select
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

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


class Lab:
    """MNERIM, and what it has heard: each message, and when by the monotonic clock."""

    def __init__(self, folder: Path, more: str) -> None:
        self.heard: list[tuple[float, str]] = []
        self.answers = True
        self.robot = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.robot.bind(("127.0.0.1", 0))
        self.bus = free_port()
        self.file = folder / "base.toml"
        wifi = free_port(socket.SOCK_DGRAM)
        robot = self.robot.getsockname()[1]
        self.file.write_text(CONFIGURATION.format(bus=self.bus, wifi=wifi, robot=robot, more=more))
        self.broker = self._started(Path(sys.executable).parent / "psiu-broker", "run", "--config", self.file)
        self._await(self.broker, self.broker.stderr, "is ready")
        self._programs: list[subprocess.Popen[str]] = []

    def program(self, *how: str) -> subprocess.Popen[str]:
        """A program that has moved MNERIM."""
        endpoint = f"tcp/127.0.0.1:{self.bus}"
        program = self._started(sys.executable, "-m", "tests.system.mover", endpoint, *how)
        self._programs.append(program)
        self.until("parafrente")
        self._await(program, program.stdout, "moved")
        return program

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

    def close(self) -> None:
        for process in (*self._programs, self.broker):
            with contextlib.suppress(ProcessLookupError):
                process.send_signal(signal.SIGCONT)
                process.kill()
            process.communicate()
        self.robot.close()

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
        return word

    @staticmethod
    def _started(*command: str | Path) -> "subprocess.Popen[str]":
        pipe = subprocess.PIPE
        return subprocess.Popen(
            [str(each) for each in command], stdin=pipe, stdout=pipe, stderr=pipe, text=True, cwd=ROOT
        )

    @staticmethod
    def _await(process: "subprocess.Popen[str]", stream: object, text: str) -> None:
        for line in stream:  # type: ignore[attr-defined]
            if text in line:
                return
        raise AssertionError(f"{process.args} ended without {text!r}: {process.communicate()}")


@contextlib.contextmanager
def lab(more: str) -> Iterator[Lab]:
    with tempfile.TemporaryDirectory(prefix="psiu-failsafe-") as folder:
        made = Lab(Path(folder), more)
        try:
            yield made
        finally:
            made.close()

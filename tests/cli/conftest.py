"""Real processes: the console scripts as a user starts them, and a broker with three simulated robots."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

import pytest
from click.testing import CliRunner, Result
from lab_file import lab_text
from ports import free_port

from psiu_broker.cli.daemon import psiu_broker
from psiu_broker.cli.tool import psiu

BIN = Path(sys.executable).parent
PATIENCE_S = 20.0

MORE = """
[links.lost]
adapter = "serial"
device = "/dev/serial/by-id/none"
protocol = "psiu-ascii"
[trunks.hill]
adapter = "serial"
device = "socket://127.0.0.1:1"
"""


class Process:
    """A console script under test, and its lines as they come."""

    def __init__(self, *words: str | Path, **more: Any) -> None:
        name, *arguments = map(str, words)
        environment = {**os.environ, "PYTHONUNBUFFERED": "", "NO_COLOR": "1", **more.pop("env", {})}
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **more}
        self.popen = subprocess.Popen([BIN / name, *arguments], env=environment, text=True, **pipes)
        self.out: list[str] = []
        self.err: list[str] = []
        self._news = threading.Condition()
        self._threads = [
            threading.Thread(target=self._read, args=(stream, lines), daemon=True)
            for stream, lines in ((self.popen.stdout, self.out), (self.popen.stderr, self.err))
            if stream is not None
        ]
        for thread in self._threads:
            thread.start()

    def until(self, pattern: str) -> str:
        """The first line, of either stream, that `pattern` is found in."""
        end = time.monotonic() + PATIENCE_S
        with self._news:
            while True:
                for line in (*self.out, *self.err):
                    if re.search(pattern, line):
                        return line
                ended = not any(thread.is_alive() for thread in self._threads)
                assert not ended and time.monotonic() < end, f"no {pattern!r} in {self.out} {self.err}"
                self._news.wait(0.1)

    def signal(self, number: signal.Signals) -> None:
        self.popen.send_signal(number)

    def ended(self) -> int:
        """The exit code, once all is read."""
        code = self.popen.wait(PATIENCE_S)
        for thread in self._threads:
            thread.join(PATIENCE_S)
        return code

    def close(self) -> None:
        if self.popen.poll() is None:
            self.popen.terminate()
            try:
                self.popen.wait(5)
            except subprocess.TimeoutExpired:
                self.popen.kill()
        self.ended()
        for stream in (self.popen.stdin, self.popen.stdout, self.popen.stderr):
            if stream is not None:
                stream.close()

    def _read(self, stream: IO[str], lines: list[str]) -> None:
        for line in stream:
            with self._news:
                lines.append(line.rstrip("\n"))
                self._news.notify_all()


class Lab:
    """A broker between MNERIM on a pty, BETA on UDP and BRACO on a second pty: five processes with the test's own."""

    def __init__(self, folder: Path) -> None:
        wifi, beta = (free_port(socket.SOCK_DGRAM) for _ in range(2))
        bus = free_port()
        radio, arm = folder / "radio", folder / "arm"
        self.endpoint = f"tcp/127.0.0.1:{bus}"
        self.env = {"PSIU_CONNECT": self.endpoint}
        self.file = folder / "lab.toml"
        self.file.write_text(lab_text(bus=bus, radio=radio, wifi=wifi, beta=beta, arm=arm) + MORE)
        extras = ("--command", "distancia:0=42", "--command", "trava:0=falha", "--command", "muda:0=", "--command")
        self.mnerim = Process("psiu", "sim", "--json", "--name", "MNERIM", "--pty", radio, *extras, "liga:1,0,1")
        self.beta = Process("psiu", "sim", "--json", "--name", "BETA", "--udp", f"127.0.0.1:{beta}")
        words = ("--protocol", "psiu-hexa", "--address", "0x12", "--topology", "point-to-point", "--pty", arm)
        nodes = ("--node", "garra=4:servo", "--node", "sonar=7:distance=99")
        self.braco = Process("psiu", "sim", "--json", *words, *nodes)
        self.robots = (self.mnerim, self.beta, self.braco)
        for robot in self.robots:
            robot.until('"ready"')
        self.broker = Process("psiu-broker", "run", "--config", self.file)
        self.broker.until("is ready")

    def run(self, *words: str) -> Result:
        """`psiu` with these words, in this process; stdout is no terminal."""
        return CliRunner().invoke(psiu, words, env=self.env, prog_name="psiu")

    def script(self, name: str) -> list[str]:
        return [str(BIN / name)]

    def json(self, *words: str) -> Any:
        result = self.run(*words, "--json")
        assert result.exit_code == 0, result.output
        return json.loads(result.stdout)

    def close(self) -> None:
        for process in (self.broker, *self.robots):
            process.close()


@pytest.fixture(scope="session")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    lab = Lab(tmp_path_factory.mktemp("lab"))
    try:
        end = time.monotonic() + PATIENCE_S
        while len([card for card in lab.json("robots") if card["last_heard"]]) < 3:
            assert time.monotonic() < end, lab.json("robots")
            time.sleep(0.05)
        yield lab
    finally:
        lab.close()


@pytest.fixture(scope="session")
def process() -> type[Process]:
    """For those that end their processes themselves."""
    return Process


@pytest.fixture(scope="session")
def port() -> Callable[[socket.SocketKind], int]:
    """A free port of a kind."""
    return free_port


@pytest.fixture
def start() -> Iterator[Callable[..., Process]]:
    """Start console scripts that end with the test."""
    started: list[Process] = []

    def begin(*words: str | Path, **more: Any) -> Process:
        started.append(Process(*words, **more))
        return started[-1]

    yield begin
    for process in started:
        process.close()


@pytest.fixture
def tool() -> Callable[..., Result]:
    """`psiu` in this process, where it needs no broker."""
    return lambda *words, **more: CliRunner().invoke(psiu, words, prog_name="psiu", **more)


@pytest.fixture
def daemon() -> Callable[..., Result]:
    """`psiu-broker` in this process."""
    return lambda *words, **more: CliRunner().invoke(psiu_broker, words, prog_name="psiu-broker", **more)


@pytest.fixture
def nowhere() -> str:
    """An endpoint where nobody listens."""
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture
def bus_port() -> int:
    return free_port()

"""The brokers of deploy/examples/mesh as a new user runs them: a robot at each, one broker killed and back."""

import json
import re
import signal
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from psiu_broker.cli.tool import psiu

EXAMPLE = Path(__file__).parents[2] / "deploy/examples/mesh"
ROBOTS = ("MNERIM", "BETA", "GAMA")
PATIENCE_S = 15.0


class Three:
    """The example with ports that are free here, and a robot at each broker."""

    def __init__(self, folder: Path, process: Any, port: Callable[[socket.SocketKind], int]) -> None:
        self._process = process
        self.bus = [port(socket.SOCK_STREAM) for _ in ROBOTS]
        ports = {f"745{at + 1}": str(bus) for at, bus in enumerate(self.bus)}
        for at in (1, 2, 3):
            ports |= {f"900{at}": str(port(socket.SOCK_DGRAM)), f"901{at}": str(port(socket.SOCK_DGRAM))}
        self.files = []
        for at in (1, 2, 3):
            text = (EXAMPLE / f"base{at}.toml").read_text()
            self.files.append(folder / f"base{at}.toml")
            self.files[-1].write_text(re.sub(r"\b(745|90[01])\d\b", lambda found: ports[found[0]], text))
        self.robots = [
            process("psiu", "sim", "--name", name, "--udp", f"127.0.0.1:{ports[f'901{at + 1}']}")
            for at, name in enumerate(ROBOTS)
        ]
        self.brokers = [self.run(at) for at in range(3)]

    def run(self, at: int) -> Any:
        broker = self._process("psiu-broker", "run", "--config", self.files[at])
        broker.until("is ready")
        return broker

    def psiu(self, at: int, *words: str) -> Any:
        """What the tool prints at a broker, or None where it fails."""
        environment = {"PSIU_CONNECT": f"tcp/127.0.0.1:{self.bus[at]}"}
        done = CliRunner().invoke(psiu, [*words, "--json"], env=environment, prog_name="psiu")
        return json.loads(done.stdout) if done.exit_code == 0 else None

    def until(self, true: Callable[[], bool]) -> None:
        end = time.monotonic() + PATIENCE_S
        while not true():
            assert time.monotonic() < end

    def all_called(self, callers: tuple[int, ...] = (0, 1, 2), robots: tuple[str, ...] = ROBOTS) -> bool:
        return all((self.psiu(at, "call", robot, "parafrente", "1") or {}).get("status") == "sucesso"
                   for at in callers for robot in robots)  # fmt: skip

    def close(self) -> None:
        for process in (*self.brokers, *self.robots):
            process.close()


@pytest.fixture
def three(tmp_path: Path, process: Any, port: Callable[[socket.SocketKind], int]) -> Iterator[Three]:
    three = Three(tmp_path, process, port)
    yield three
    three.close()


def test_every_robot_is_called_at_every_broker_also_after_one_was_killed_and_came_back(three: Three) -> None:
    three.until(three.all_called)
    seen = three.psiu(0, "mesh")
    assert seen is not None
    three.brokers[2].signal(signal.SIGKILL)
    three.brokers[2].close()
    three.until(lambda: three.psiu(0, "call", "GAMA", "parafrente", "1") is None)
    assert three.all_called((0, 1), ("MNERIM", "BETA"))
    three.brokers[2] = three.run(2)
    three.until(three.all_called)

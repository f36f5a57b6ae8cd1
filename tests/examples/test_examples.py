"""The two programs of the README: another program on the bus, and an adapter of somebody else's."""

import asyncio
import json
import os
import signal
import socket
import sys
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import ClassVar

import pytest
from adapter_contract import AdapterContract, FarEnd
from examples.unix_adapter import Unix
from ports import free_port

from psiu_broker.broker import Broker
from psiu_broker.config import load
from psiu_broker.simulator import AsciiRobot, PtyPort

HERE = Path(__file__).parent
PLAIN_ZENOH = HERE / "plain_zenoh.py"
UNIX_ADAPTER = HERE / "unix_adapter.py"
README_ENDPOINT = "tcp/127.0.0.1:7447"


class _Simulator(FarEnd):
    """What listens on the socket; it accepts one caller after another."""

    def __init__(self, path: Path) -> None:
        self.adapter = Unix(path=str(path))
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(path))
        self._listener.listen()
        self._listener.setblocking(False)
        self._line: socket.socket | None = None

    @property
    def line(self) -> socket.socket:
        if self._line is None:
            self._line, _ = self._listener.accept()
            self._line.setblocking(False)
        return self._line

    async def say(self, data: bytes) -> None:
        await asyncio.get_running_loop().sock_sendall(self.line, data)

    async def heard(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            data += await asyncio.get_running_loop().sock_recv(self.line, size - len(data))
        return data

    async def vanish(self) -> None:
        self.line.close()

    def close(self) -> None:
        self._listener.close()
        if self._line is not None:
            self._line.close()


class TestAnAdapterOfSomebodyElses(AdapterContract):
    @pytest.fixture
    def far(self, tmp_path: Path) -> Iterator[_Simulator]:
        simulator = _Simulator(tmp_path / "arena.sock")
        yield simulator
        simulator.close()

    @pytest.fixture
    def absent(self, tmp_path: Path) -> object:
        return Unix(path=str(tmp_path / "nobody.sock"))


async def test_an_installed_adapter_is_found_by_its_entry_point(tmp_path: Path) -> None:
    (tmp_path / "arena.py").write_text(UNIX_ADAPTER.read_text())
    installed = tmp_path / "arena-1.dist-info"
    installed.mkdir()
    (installed / "METADATA").write_text("Metadata-Version: 2.1\nName: arena\nVersion: 1\n")
    (installed / "entry_points.txt").write_text("[psiu_broker.adapters]\nunix = arena:Unix\n")
    file = tmp_path / "arena.toml"
    file.write_text(
        '[broker]\nname = "base"\n[links.arena]\nadapter = "unix"\npath = "/run/arena.sock"\nprotocol = "psiu-ascii"\n'
    )
    program = "import sys, pathlib, psiu_broker.config as c; print(c.load(pathlib.Path(sys.argv[1])).links['arena'])"
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-c", program, str(file), env={**os.environ, "PYTHONPATH": str(tmp_path)}, stdout=-1, stderr=-2
    )
    output, _ = await process.communicate()
    assert process.returncode == 0, output.decode()
    assert "path='/run/arena.sock'" in output.decode()


class _Listener:
    """The plain program, started against our broker, and its lines."""

    options: ClassVar[dict[str, int]] = {"stdout": asyncio.subprocess.PIPE, "stderr": asyncio.subprocess.STDOUT}

    def __init__(self, folder: Path, endpoint: str) -> None:
        text = PLAIN_ZENOH.read_text()
        assert text.count(README_ENDPOINT) == 1
        self._file = folder / "plain_zenoh.py"
        self._file.write_text(text.replace(README_ENDPOINT, endpoint))

    async def run(self, *arguments: str, until: str) -> list[str]:
        """Its lines up to the first that begins with `until`, then Ctrl-C."""
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-u",
            str(self._file),
            *arguments,
            **self.options,  # type: ignore[arg-type]
        )
        assert process.stdout is not None
        lines: list[str] = []
        try:
            async with asyncio.timeout(20):
                async for line in process.stdout:
                    lines.append(line.decode().rstrip("\n"))
                    if lines[-1].startswith(until):
                        break
                else:
                    pytest.fail("\n".join(lines))
            process.send_signal(signal.SIGINT)
            async with asyncio.timeout(20):
                await process.wait()
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()
        return lines


@pytest.fixture
async def program(tmp_path: Path) -> AsyncIterator[_Listener]:
    """The example beside a broker with MNERIM on a pty."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    file = tmp_path / "lab.toml"
    async with PtyPort(AsciiRobot("MNERIM", answer_s=0.1), link=tmp_path / "radio") as radio:
        file.write_text(
            f'[broker]\nname = "base"\n[zenoh]\nlisten = ["{endpoint}"]\n'
            f'[links.radio]\nadapter = "serial"\ndevice = "{radio.path}"\nprotocol = "psiu-ascii"\nbaudrate = 115200\n'
        )
        broker = Broker(load(file))
        await broker.start()
        try:
            yield _Listener(tmp_path, endpoint)
        finally:
            await broker.stop()


async def test_plain_zenoh_calls_a_robot_and_hears_what_it_says(program: _Listener) -> None:
    lines = await program.run("MNERIM", "parafrente", "7", until="psiu/MNERIM/base/parafrente ")
    answer = json.loads(next(line for line in lines if line.startswith("answer: ")).removeprefix("answer: "))
    assert answer["status"] == "sucesso"
    message = json.loads(lines[-1].partition(" ")[2])
    assert (message["source"], message["destination"], message["command"]) == ("MNERIM", "base", "parafrente")
    assert message["status"] == "sucesso"


async def test_plain_zenoh_is_told_why_there_is_no_answer(program: _Listener) -> None:
    lines = await program.run("MNERIM", "parafrente", "1200", until="no answer: ")
    assert json.loads(lines[-1].removeprefix("no answer: "))["error"] == "refused"

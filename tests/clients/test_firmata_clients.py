"""Libraries for Firmata that nobody here wrote open a port of the broker and drive a robot of another protocol."""

import asyncio
import json
import shutil
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path

import pyfirmata2  # type: ignore[import-untyped]
import pytest
from ports import free_port
from pyfirmata2 import pyfirmata2 as library

from psiu_broker.broker import Broker
from psiu_broker.config import load
from psiu_broker.simulator import HexaRobot, PtyPort

HERE = Path(__file__).parent
PATIENCE_S = 20.0


class Lab:
    """An arm that speaks PSIU HEXA, and the board that it is played as."""

    def __init__(self, folder: Path) -> None:
        self.arm = HexaRobot(0x12, topology="point-to-point", actuators=(4, 5, 6, 9), sensors={7: 50, 8: 0})
        self.line = PtyPort(self.arm, link=folder / "arm")
        self.board = folder / "board"
        file = folder / "lab.toml"
        file.write_text(f"""
[broker]
name = "base"
[zenoh]
listen = ["tcp/127.0.0.1:{free_port()}"]
[links.arm]
adapter = "serial"
device = "{self.line.path}"
pace = false
protocol = "psiu-hexa"
topology = "point-to-point"
[robots.BRACO]
address = 0x12
link = "arm"
nodes.garra = {{ node = 4, type = "servo" }}
nodes.farol = {{ node = 5, type = "on-off" }}
nodes.roda = {{ node = 6, type = "linear" }}
nodes.sonar = {{ node = 7, type = "distance", unit = "cm" }}
nodes.pulso = {{ node = 9, type = "servo" }}
nodes.toque = {{ node = 8, type = "switch" }}
[links.board]
adapter = "pty"
path = "{self.board}"
protocol = "firmata"
role = "board"
plays = "BRACO"
map.2 = {{ reading = "toque", poll_s = 0.05 }}
map.3 = {{ command = "roda", mode = "pwm" }}
map.9 = {{ command = "garra", mode = "servo", offset = -90 }}
map.10 = {{ command = "pulso", mode = "servo", offset = -90, minimum = -45, maximum = -10 }}
map.13 = {{ command = "farol" }}
map.A0 = {{ reading = "sonar", poll_s = 0.05, scale = 4 }}
""")
        self.broker = Broker(load(file))

    async def until(self, true: Callable[[], object]) -> None:
        async with asyncio.timeout(PATIENCE_S):
            while not true():  # noqa: ASYNC110 - the broker's state is values, not events
                await asyncio.sleep(0.005)


@pytest.fixture
async def lab(tmp_path: Path) -> AsyncIterator[Lab]:
    lab = Lab(tmp_path)
    async with lab.line:
        await lab.broker.start()
        try:
            await lab.until(lambda: all(link.state == "open" for link in lab.broker.links()))
            yield lab
            assert lab.broker.ledger().balances
        finally:
            await lab.broker.stop()


class TestPyFirmata2:
    @pytest.mark.parametrize("made", [pyfirmata2.Board, pyfirmata2.Arduino], ids=["asks", "knows its layout"])
    async def test_it_drives_the_robot(self, lab: Lab, made: type[pyfirmata2.Board]) -> None:
        await asyncio.to_thread(self.drive, lab, made)

    async def test_programs_may_follow_one_another(self, lab: Lab) -> None:
        for _ in range(3):
            await asyncio.to_thread(self.drive, lab, pyfirmata2.Board)

    def drive(self, lab: Lab, made: type[pyfirmata2.Board]) -> None:
        lab.arm.signals.update({7: 50, 8: 0})
        with self.opened(lab.board, made) as board:
            board.samplingOn(20)
            board.send_sysex(0x79, [])
            board.sp.write(b"\xf9")
            assert self.eventually(lambda: (board.firmware, board.firmata_version) == ("BRACO", (2, 5)))

            arm = board.get_pin("d:9:s")
            for angle_deg, signal in ((120, 42), (0, 0x80), (180, 0x7F)):
                arm.write(angle_deg)
                self.becomes(lab, 4, signal)
            lamp = board.get_pin("d:13:o")
            for on in (1, 0, 1):
                lamp.write(on)
                self.becomes(lab, 5, 255 * on)
            board.get_pin("d:3:p").write(0.5)
            self.becomes(lab, 6, 128)

            touched: list[bool] = []
            button = board.get_pin("d:2:i")
            button.register_callback(touched.append)
            lab.arm.signals[8] = 1
            assert self.eventually(lambda: touched[-1:] == [True])
            lab.arm.signals[8] = 0
            assert self.eventually(lambda: touched[-1:] == [False])

            distances: list[float] = []
            sonar = board.get_pin("a:0")
            sonar.register_callback(distances.append)
            for centimetres in (50, 120):
                lab.arm.signals[7] = centimetres
                shown = [round(4 * centimetres / 1023, 4)]
                assert self.eventually(lambda shown=shown: distances[-1:] == shown)  # type: ignore[misc]

    def becomes(self, lab: Lab, node: int, signal: int) -> None:
        assert self.eventually(lambda: lab.arm.signals[node] == signal), lab.arm.signals

    @staticmethod
    @contextmanager
    def opened(path: Path, made: type[pyfirmata2.Board]) -> Iterator[pyfirmata2.Board]:
        # A real board wants five seconds to boot.
        wait, library.BOARD_SETUP_WAIT_TIME = library.BOARD_SETUP_WAIT_TIME, 0.05
        try:
            board = made(str(path))
        finally:
            library.BOARD_SETUP_WAIT_TIME = wait
        try:
            yield board
        finally:
            board.exit()

    @staticmethod
    def eventually(true: Callable[[], object]) -> bool:
        until = time.monotonic() + PATIENCE_S
        while not true():
            if time.monotonic() > until:
                return False
            time.sleep(0.005)
        return True


class Node:
    """Our program for firmata-io, and what it has told so far."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self.process = process
        self.said: list[dict[str, object]] = []

    async def follow(self) -> None:
        assert self.process.stdout is not None
        async for line in self.process.stdout:
            self.said.append(json.loads(line))


@asynccontextmanager
async def running(path: Path) -> AsyncIterator[Node]:
    node = shutil.which("node")
    if node is None or not (HERE / "node_modules").is_dir():
        pytest.skip("needs node and, once: npm ci --ignore-scripts --prefix tests/clients")
    process = await asyncio.create_subprocess_exec(
        node, str(HERE / "firmata_io.js"), str(path), stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE
    )
    program = Node(process)
    following = asyncio.create_task(program.follow())
    try:
        yield program
        assert process.stdin is not None
        process.stdin.close()
        async with asyncio.timeout(PATIENCE_S):
            assert await process.wait() == 0
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
        await following


class TestFirmataIo:
    async def test_it_drives_the_robot(self, lab: Lab) -> None:
        async with running(lab.board) as program:
            await lab.until(lambda: program.said)
            assert program.said[0] == {
                "ready": "BRACO",
                "version": {"major": 2, "minor": 5},
                "pins": {
                    "2": [0, 1, 11], "3": [0, 1, 3], "9": [0, 1, 4], "10": [0, 1, 4], "13": [0, 1], "14": [2],
                },
                "analog": [14],
            }  # fmt: skip
            await lab.until(lambda: lab.arm.signals[4] == 42)
            await lab.until(lambda: lab.arm.signals[5] == 255)
            await lab.until(lambda: lab.arm.signals[6] == 200)
            await lab.until(lambda: {"mode": 4, "state": 120} in program.said)
            await lab.until(lambda: {"text": "pulso takes -45 to -10, got 0"} in program.said)

            await lab.until(lambda: {"distance": 200} in program.said)
            lab.arm.signals[7] = 120
            await lab.until(lambda: {"distance": 480} in program.said)
            await lab.until(lambda: {"touch": 0} in program.said)
            lab.arm.signals[8] = 1
            await lab.until(lambda: {"touch": 1} in program.said)
        assert lab.arm.signals[4] == 42

    async def test_it_is_greeted_as_by_a_board_that_was_reset(self, lab: Lab) -> None:
        async with running(lab.board) as program:
            await lab.until(lambda: any(link.details.get("program") == "here" for link in lab.broker.links()))
            begun = time.monotonic()
            await lab.until(lambda: program.said)
            # Without a greeting it would ask of its own accord, five seconds later.
            assert time.monotonic() - begun < 4.5

    async def test_programs_may_follow_one_another_and_a_lock_is_gone_with_who_had_it(self, lab: Lab) -> None:
        for angle in (1, 2):
            lab.arm.signals[4] = angle
            async with running(lab.board) as program:
                await lab.until(lambda: lab.arm.signals[4] == 42)
                assert program.said[0]["ready"] == "BRACO"

"""deploy/examples/protocols/translations.toml does what it says, with simulated robots and bytes of its programs."""

import asyncio
import os
import socket
import tty
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import pytest
from ports import free_port
from test_protocols import Lab, lab, message, until

from psiu_broker.simulator import AsciiRobot, Extra, HexaRobot, PtyPort
from psiu_broker.simulator.mitya import MityaBody

FILE = Path(__file__).parents[2] / "deploy/examples/protocols/translations.toml"
BY_ID = "/dev/serial/by-id/usb-FTDI_FT232R"


class Stage(NamedTuple):
    made: Lab
    mnerim: AsciiRobot
    mitya: MityaBody
    arm: HexaRobot
    radio: PtyPort
    panel: int
    """The port of the Mitya program's link."""
    folder: Path


@pytest.fixture
async def stage(tmp_path: Path) -> AsyncIterator[Stage]:
    """Everything of the file, on pseudo-terminals and a free port."""
    mnerim = AsciiRobot("MNERIM", per_unit_s=0.0, extras=[Extra("pare")])
    mitya = MityaBody("MITYA", version="2012")
    arm = HexaRobot(0x12, topology="point-to-point", actuators=(4, 5), sensors={7: 50, 8: 0})
    radio, corpo, line = (
        PtyPort(robot, link=tmp_path / name) for robot, name in ((mnerim, "radio"), (mitya, "corpo"), (arm, "arm"))
    )
    panel = free_port(socket.SOCK_DGRAM)
    text = FILE.read_text()
    for written, meant in (
        ('[broker]\nname = "base"\n', ""),
        (f"{BY_ID}_RADIO-if00-port0", str(radio.path)),
        (f"{BY_ID}_MITYA-if00-port0", str(corpo.path)),
        ("open_delay_s = 2 ", "open_delay_s = 0 "),
        ("0.0.0.0:51974", f"127.0.0.1:{panel}"),
        ('adapter = "rfcomm"\naddress = "98:D3:31:00:00:01"', f'adapter = "serial"\ndevice = "{line.path}"'),
        (
            "/run/psiu-broker/placa",
            f"{tmp_path}/placa",
        ),
        ('adapter = "rfcomm"\naccept = true', f'adapter = "pty"\npath = "{tmp_path}/celular"'),
    ):
        assert written in text
        text = text.replace(written, meant)
    async with lab(tmp_path, text, radio, corpo, line) as made:
        yield Stage(made, mnerim, mitya, arm, radio, panel, tmp_path)


@contextmanager
def opened(port: Path) -> Iterator[int]:
    """A serial port, as a program opens it."""
    line = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        tty.setraw(line)
        yield line
    finally:
        os.close(line)


async def heard(line: int, wanted: bytes) -> None:
    """Read from `line` until `wanted` has come."""
    said = bytearray()

    def come() -> bool:
        with suppress(BlockingIOError):
            said.extend(os.read(line, 1000))
        return wanted in said

    await until(come)


async def test_a_program_of_words_moves_the_mitya(stage: Stage) -> None:
    stage.radio.send(message("MITYA", "drive 100", "PC"))
    await until(lambda: stage.mitya.body.left == 100)


async def test_a_program_for_the_mitya_drives_the_robot_of_words(stage: Stage) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as program:
        program.connect(("127.0.0.1", stage.panel))
        for sent, x in ((b"D0064", 50), (b"DFFCE\r\n", 25)):
            program.send(sent)
            await until(lambda x=x: stage.mnerim.position.x == x)  # type: ignore[misc]
        program.send(b"L00FF")
        await until(lambda: stage.mnerim.heard[-1].parameters == ("89",))
        assert stage.mnerim.heard[-1].subject == "giradireita"
        program.send(b"D0000")
        await until(lambda: stage.mnerim.heard[-1].subject == "pare")
        program.setblocking(False)
        program.send(b"Q0001")
        assert await asyncio.wait_for(asyncio.get_running_loop().sock_recv(program, 100), 5.0) == b"E0102"


async def test_a_firmata_program_drives_the_nodes_of_the_arm(stage: Stage) -> None:
    with opened(stage.folder / "placa") as line:
        os.write(line, b"\xf4\x09\x04\xe9\x78\x00")  # pin 9 is a servo, and goes to 120 degrees
        await until(lambda: stage.arm.signals[4] == 42)
        os.write(line, b"\xf5\x0d\x01")
        await until(lambda: stage.arm.signals[5] == 255)
        os.write(line, b"\xc0\x01")
        await heard(line, b"\xe0\x48\x01")  # 4 × 50 cm


async def test_a_phone_with_amarino_drives_the_robot_of_words(stage: Stage) -> None:
    with opened(stage.folder / "celular") as line:
        os.write(line, b"A1.50\x13")
        await until(lambda: stage.mnerim.position.x == 150)
        await heard(line, b"\x12sucesso\x13")
        os.write(line, b"A4.00\x13")
        await heard(line, b"400 is above 300")

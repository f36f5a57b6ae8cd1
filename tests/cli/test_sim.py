"""Simulated robots that a user starts beside their own program."""

import json
import os
import select
import signal
import socket
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result

from psiu_broker.simulator import QUIRKS

Run = Callable[..., Result]
Start = Callable[..., Any]

FORWARD = b"MNERIM 034 parafrente 100 PC 02123"
DONE = b"PC 038 parafrente sucesso MNERIM 02755"
WHO = b"?? 027 qualseunome PC 01753"


def talk(port: Path, data: bytes, size: int) -> bytes:
    """Write to a serial port and read `size` bytes of what comes back, or what comes soon."""
    descriptor = os.open(port, os.O_RDWR | os.O_NOCTTY)
    try:
        os.write(descriptor, data)
        answer = b""
        while len(answer) < (size or 1) and select.select([descriptor], [], [], 5 if size else 0.3)[0]:
            piece = os.read(descriptor, 4096)
            if not piece:
                break
            answer += piece
        return answer
    finally:
        os.close(descriptor)


def test_a_robot_on_a_pty_answers_tells_what_it_does_and_takes_its_name_away(start: Start, tmp_path: Path) -> None:
    port = tmp_path / "radio"
    robot = start("psiu", "sim", "--name", "MNERIM", "--pty", port)
    robot.until(f"MNERIM \\(psiu-ascii\\) is at {port}; Ctrl-C ends")
    assert talk(port, FORWARD, len(DONE)) == DONE
    robot.until(r"^\d\d:\d\d:\d\d\.\d\d\d  <- MNERIM 034 parafrente 100 PC 02123$")
    robot.until(r"   PC: parafrente 100$")
    robot.until(r"-> PC 038 parafrente sucesso MNERIM 02755$")
    robot.until(r"   is at x 100 cm, y 0 cm, heading 0 deg$")
    robot.signal(signal.SIGINT)
    assert robot.ended() == 0
    assert robot.err == []
    assert not port.is_symlink()


def test_a_robot_on_udp_greets_its_peer_and_answers_programs_in_json(start: Start) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as program:
        program.bind(("127.0.0.1", 0))
        program.settimeout(10)
        home = f"127.0.0.1:{program.getsockname()[1]}"
        robot = start("psiu", "sim", "--name", "BETA", "--udp", "127.0.0.1:0", "--peer", home, "--json")
        greeting, where = program.recvfrom(1024)
        assert greeting == b"?? 029 qualseunome BETA 01892"
        program.sendto(WHO, where)
        assert program.recv(1024).startswith(b"PC 029 qualseunome BETA ")
    robot.until('"heard"')
    robot.signal(signal.SIGTERM)
    assert robot.ended() == 0
    events = [json.loads(line) for line in robot.out]
    assert [each["event"] for each in events] == ["ready", "out", "in", "heard", "out"]
    assert events[0]["where"] == f"127.0.0.1:{where[1]}"
    assert bytes.fromhex(events[2]["wire"]) == WHO
    assert (events[3]["source"], events[3]["subject"], events[3]["parameters"]) == ("PC", "qualseunome", [])


def test_a_robot_of_bytes_names_its_nodes_in_their_units(start: Start, tmp_path: Path) -> None:
    port = tmp_path / "arm"
    words = ("--protocol", "psiu-hexa", "--address", "0x12", "--node", "garra=4:servo", "--node", "sonar=7:distance=99")
    robot = start("psiu", "sim", *words, "--topology", "point-to-point", "--crc", "sum", "--pty", port)
    robot.until("0x12 .psiu-hexa. is at")
    assert talk(port, bytes((6, 4, 0xC0, 0xCA)), 3) == bytes((5, 65, 70))
    assert talk(port, bytes((6, 7, 0, 13)), 4) == bytes((6, 0, 99, 105))
    robot.until(r"<- 06 04 c0 ca$")
    robot.until(r"garra is at -45 deg \(signal 192\)$")


def test_quirks_and_faults_are_seen_on_the_wire(start: Start, tmp_path: Path) -> None:
    quirky, lossy = tmp_path / "quirky", tmp_path / "lossy"
    robots = [
        start("psiu", "sim", "--name", "MNERIM", "--pty", quirky, "--quirk", "crlf", "--quirk", "unpadded"),
        start("psiu", "sim", "--name", "MNERIM", "--pty", lossy, "--loss", "1"),
    ]
    for robot in robots:
        robot.until("is at")
    assert talk(quirky, FORWARD, len(DONE) + 1) == b"PC 038 parafrente sucesso MNERIM 2755\r\n"
    assert talk(lossy, FORWARD, 0) == b""


def test_every_quirk_is_explained(tool: Run) -> None:
    listed = tool("sim", "--list-quirks")
    assert listed.exit_code == 0
    for name, text in QUIRKS.items():
        assert name in listed.output
        assert text in listed.output


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--name", "A"), "where is the robot?"),
        (("--name", "A", "--pty", "x", "--udp", "127.0.0.1:1"), "where is the robot?"),
        (("--pty", "x"), "--name is missing"),
        (("--protocol", "psiu-hexa", "--pty", "x"), "--address is missing"),
        (("--name", "A", "--pty", "x", "--address", "1"), "--address is an option of psiu-hexa"),
        (("--protocol", "psiu-hexa", "--address", "1", "--quirk", "crlf", "--pty", "x"), "--quirk is an option of"),
        (("--protocol", "psiu-hexa", "--address", "256", "--pty", "x"), "an address is 0–255, not 256"),
        (("--protocol", "psiu-hexa", "--address", "1", "--node", "garra", "--pty", "x"), "such as garra=4:servo"),
        (("--protocol", "psiu-hexa", "--address", "1", "--node", "a=4:leg", "--pty", "x"), "type: Input should be"),
        (("--name", "A", "--udp", "nowhere"), "HOST:PORT"),
        (("--name", "A", "--pty", "x", "--peer", "127.0.0.1:1"), "--peer is for --udp"),
        (("--name", "A", "--pty", "x", "--silence", "5:1"), "negative"),
        (("--name", "A", "--pty", "x", "--silence", "soon"), "FROM:UNTIL in seconds"),
        (("--name", "A", "--pty", "x", "--command", ":"), "such as distancia:0=42"),
        (("--name", "A", "--pty", "x", "--loss", "2"), "--loss"),
        (("--name", "A", "--udp", "127.0.0.1:0", "--byte-by-byte"), "a datagram arrives whole"),
    ],
)
def test_what_cannot_be_meant_is_refused_with_what_was_expected(tool: Run, words: tuple[str, ...], said: str) -> None:
    refused = tool("sim", *words)
    assert refused.exit_code == 2
    assert said in " ".join(refused.output.split())


def test_a_name_that_is_taken_is_one_line(tool: Run, tmp_path: Path) -> None:
    (tmp_path / "radio").write_text("mine")
    refused = tool("sim", "--name", "A", "--pty", str(tmp_path / "radio"))
    assert refused.exit_code == 1
    assert "exists and is not a link to a pseudo-terminal" in refused.stderr
    assert (tmp_path / "radio").read_text() == "mine"


def test_without_the_extra_a_bluetooth_robot_says_what_to_install(tool: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "bumble.core", None)
    monkeypatch.delitem(sys.modules, "psiu_broker.simulator.rfcomm", raising=False)
    refused = tool("sim", "--protocol", "psiu-hexa", "--address", "0x12", "--rfcomm", "usb:0")
    assert refused.exit_code == 1
    assert "pip install 'psiu-broker[bluetooth-simulator]'" in refused.stderr


def test_a_bluetooth_controller_that_is_not_there_is_one_line(start: Start) -> None:
    pytest.importorskip("bumble")
    robot = start("psiu", "sim", "--name", "A", "--rfcomm", "tcp-client:127.0.0.1:1")
    assert robot.ended() == 1
    assert [line.partition(":")[0] for line in robot.err] == ["psiu"]
    assert "Bluetooth controller tcp-client:127.0.0.1:1" in robot.err[0]


def test_a_robot_that_nobody_reads_any_more_ends(start: Start, tmp_path: Path) -> None:
    port = tmp_path / "radio"
    reading, writing = os.pipe()
    robot = start("psiu", "sim", "--name", "MNERIM", "--pty", port, stdout=writing)
    os.close(writing)
    assert b"is at" in os.read(reading, 4096)
    os.close(reading)
    with suppress(OSError):  # the cable is pulled
        talk(port, FORWARD, len(DONE))
    assert (robot.ended(), robot.err) == (0, [])

"""A simulated robot of each protocol, as a user sees it: what it hears, says and does, quirks included."""

import json
import os
import select
import signal
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result

from psiu_broker.cli.simulated import OFFERS, SIMULATED, cast
from psiu_broker.protocols import PROTOCOLS

Run = Callable[..., Result]
Start = Callable[..., Any]

MIROSOT = bytes.fromhex("aa 3e3e fc7e 0303 55")


@contextmanager
def opened(port: Path) -> Iterator[Callable[..., bytes]]:
    """A serial port: write, and read what comes until it is `size` bytes, or for a while."""
    descriptor = os.open(port, os.O_RDWR | os.O_NOCTTY)

    def say(data: bytes, size: int = 0) -> bytes:
        os.write(descriptor, data)
        answer = b""
        while len(answer) < (size or 1) and select.select([descriptor], [], [], 5 if size else 0.3)[0]:
            answer += os.read(descriptor, 4096)
        return answer

    try:
        yield say
    finally:
        os.close(descriptor)


def events(robot: Any, kind: str) -> list[dict[str, Any]]:
    return [event for line in robot.out if (event := json.loads(line))["event"] == kind]


def test_only_what_the_broker_speaks_is_simulated() -> None:
    assert set(SIMULATED) <= set(PROTOCOLS)


@pytest.mark.parametrize(
    ("words", "question", "answer"),
    [
        (("--protocol", "firmata", "--firmware", "A"), b"\xf9", bytes.fromhex("f90205f07902054100f7")),
        (("--protocol", "amarino"), b"B7\x13", b"\x127\x13"),
        (("--protocol", "mitya", "--version", "2014"), b"G00xx", b"#0001"),
        (
            ("--version", "0.5", "--name", "MNERIM"),
            b"MNERIM031parafrente 100 PC02024",
            b"PC035parafrente sucesso MNERIM02656",
        ),
    ],
)
def test_robots_answer_at_a_udp_port(start: Start, words: tuple[str, ...], question: bytes, answer: bytes) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as program:
        program.bind(("127.0.0.1", 0))
        program.settimeout(10)
        robot = start("psiu", "sim", *words, "--udp", "127.0.0.1:0", "--json")
        host, port = json.loads(robot.until('"ready"'))["where"].split(":")
        program.sendto(question, (host, int(port)))
        assert program.recv(1000) == answer


@pytest.mark.parametrize("protocol", SIMULATED)
def test_the_help_tells_the_options_of_each_protocol_by_themselves(tool: Run, protocol: str) -> None:
    _, found, told = tool("sim", "--help").output.partition(f"\nOptions of {protocol}:\n")
    assert found
    own = told.partition("\n\n")[0]
    for offer in OFFERS[protocol]:
        assert offer.spelled in own


def test_a_mitya_of_2012_moves_silently_and_never_gets_back_into_step(start: Start, tmp_path: Path) -> None:
    port = tmp_path / "corpo"
    robot = start("psiu", "sim", "--protocol", "mitya", "--pty", port)
    robot.until(rf"MITYA .mitya. is at {port}")
    with opened(port) as say:
        assert say(b"D0064H005A") == b""
        assert say(b"x" + b"D0000", 5) == b"E0002"
        assert say(b"D0000", 5) == b"E0002"
    robot.until(r"<- D0064H005A$")
    robot.until(r"   drive 100$")
    robot.until(r"   motors at 100 left, 100 right$")
    assert not any("motors at 0 left" in line for line in robot.out)


def test_a_mitya_that_records_is_silent_and_plays_its_script_later(start: Start, tmp_path: Path) -> None:
    port = tmp_path / "corpo"
    robot = start("psiu", "sim", "--protocol", "mitya", "--version", "2013", "--pty", port)
    robot.until("is at")
    with opened(port) as say:
        assert say(b"G0010", 5) == b"#0000"
        assert say(b"r0103", 5) == b"#0000"
        robot.until("records script 3, and is silent meanwhile")
        assert say(b"Z0002G0064W0064G0000W0000") == b""
        assert say(b"Z0000", 5) == b"r0200"
        robot.until("records no more")
        robot.until("script 3 has 2 actions")
        say(b"r0003", 5)
        robot.until("motors at 100 left, 100 right")
        robot.until("motors at 0 left, 0 right")


def test_a_mitya_at_udp_is_the_phone_with_its_body(start: Start) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as program:
        program.bind(("127.0.0.1", 0))
        program.settimeout(10)
        words = ("--udp", "127.0.0.1:0", "--volts", "7.5", "--version", "2013", "--json")
        robot = start("psiu", "sim", "--protocol", "mitya", *words)
        where = json.loads(robot.until('"ready"'))["where"].split(":")
        home = (where[0], int(where[1]))
        program.sendto(b"G0064\r\n", home)
        program.sendto(b"=0000", home)
        assert program.recv(100) == b"~02EE"
    robot.signal(signal.SIGINT)
    assert robot.ended() == 0
    motors = events(robot, "motors")
    assert [(each["left"], each["right"]) for each in motors] == [(100, 100)]


def test_all_robots_of_a_team_are_there_and_what_is_the_same_is_told_once(start: Start, tmp_path: Path) -> None:
    port = tmp_path / "campo"
    robot = start("psiu", "sim", "--protocol", "soccer", "--pty", port)
    robot.until(r"0x01, 0x02, 0x03 .soccer. are at")
    with opened(port) as say:
        for _ in range(5):
            say(MIROSOT)
        assert say(MIROSOT[:3] + bytes(2) + MIROSOT[5:]) == b""
    robot.until(r"   robot 1: 15 15$")
    robot.until(r"   robot 2: -31 31$")
    robot.until(r"   \.\.\. and 4 times more$")
    robot.until(r"   robot 2 dropped 1$")
    assert sum("<- aa 3e 3e fc 7e 03 03 55" in line for line in robot.out) == 1


def test_one_robot_of_a_team_in_json_tells_every_packet(start: Start, tmp_path: Path) -> None:
    port = tmp_path / "campo"
    words = ("--protocol", "soccer", "--address", "2", "--stop-after", "0.2", "--json")
    robot = start("psiu", "sim", *words, "--pty", port)
    robot.until("ready")
    with opened(port) as say:
        say(MIROSOT)
        say(MIROSOT)
    robot.until('"wheels":.-31,31.')
    robot.until('"wheels":.0,0.')
    robot.signal(signal.SIGINT)
    assert robot.ended() == 0
    assert {each["robot"] for each in events(robot, "wheels")} == {2}
    assert "".join(each["wire"] for each in events(robot, "in")) == (MIROSOT * 2).hex()


def test_own_packets_are_read_as_the_options_say(start: Start, tmp_path: Path) -> None:
    port = tmp_path / "campo"
    words = ("--preset", "guarana", "--robots", "2", "--start", "0x10", "--byte-codec", "int8", "--trailer", "none")
    robot = start("psiu", "sim", "--protocol", "soccer", *words, "--pty", port)
    robot.until("are at")
    with opened(port) as say:
        say(bytes((0x10, 0xFF, 0x05)))
    robot.until("robot 1: -1$")
    robot.until("robot 2: 5$")


def test_a_board_with_firmata_boots_tells_who_it_is_and_shows_its_pins(start: Start, tmp_path: Path) -> None:
    port = tmp_path / "uno"
    words = ("--firmware", "AB", "--boot", "0.5", "--pin", "A0=513", "--pin", "7=1")
    robot = start("psiu", "sim", "--protocol", "firmata", *words, "--pty", port)
    robot.until("uno .firmata. is at")
    boot = bytes.fromhex("f90205 f079020541004200f7")
    with opened(port) as say:
        assert say(bytes.fromhex("f40d01"), len(boot)) == boot  # it was deaf
        say(bytes.fromhex("f40901 f40903 e97f01"))
        assert say(bytes.fromhex("f40700 d001"), 3) == bytes.fromhex("900001")
        assert say(bytes.fromhex("c001"), 3) == bytes.fromhex("e00104")
        time.sleep(0.2)
        say(bytes.fromhex("c000 ff"))
    robot.until(r"-> f9 02 05 f0 79 02 05 41 00 42 00 f7$")
    robot.until(r"   pin-mode 9 3$")
    robot.until(r"   D9 is pwm, at 255$")
    robot.until("forgets everything and begins anew")
    assert not any("D13 is output" in line for line in robot.out)
    reported = [line for line in robot.out if "-> e0 01 04" in line]
    assert 1 <= len(reported) <= 2  # in a message of its own, then with all that is reported


def test_an_input_that_drifts_is_never_long_the_same(start: Start, tmp_path: Path) -> None:
    port = tmp_path / "uno"
    robot = start("psiu", "sim", "--protocol", "firmata", "--pin", "A1=100:900", "--pty", port, "--json")
    robot.until("ready")
    with opened(port) as say:
        say(bytes.fromhex("c101"), 90)  # its boot message among them
    robot.signal(signal.SIGINT)
    assert robot.ended() == 0
    assert len({each["wire"] for each in events(robot, "out") if each["wire"].startswith("e1")}) > 3


def test_a_board_with_amarino_answers_as_it_was_made_and_crashes_without_a_flag(start: Start, tmp_path: Path) -> None:
    port = tmp_path / "lampada"
    words = ("--function", "b=", "--function", "c=on", "--function", "d", "--reading", "3.25", "--telemetry", "0.2")
    robot = start("psiu", "sim", "--protocol", "amarino", *words, "--pty", port)
    robot.until("board .amarino. is at")
    with opened(port) as say:
        robot.until(r"-> .x123.25.x13$")
        assert b"\x12200\x13" in say(b"b200\x13", 5) + say(b"", 5)
        say(b"d1;2\x13")
        say(b"\x13")
    robot.until(r"   flag/b 200$")
    robot.until(r"   flag/d 1 2$")
    robot.until(r"   crashes: it is dead until Ctrl-C$")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--protocol", "mitya", "--version", "1"), "--version of mitya is 2012 or 2013 or 2014, not 1"),
        (("--name", "A", "--version", "2012"), "--version of psiu-ascii is 1 or 0.5 or 0, not 2012"),
        (("--protocol", "mitya", "--volts", "50"), "a voltage is 0 to 40.95 V, not 50"),
        (("--protocol", "mitya", "--preset", "f180"), "--preset is an option of soccer; add --protocol soccer"),
        (("--protocol", "soccer", "--name", "A"), "--name is an option of psiu-ascii or mitya or firmata or amarino"),
        (("--protocol", "soccer", "--address", "4"), "an address is 1–3, one of the robots of the team, not 4"),
        (("--protocol", "soccer", "--robots", "0"), "at least"),
        (("--protocol", "soccer", "--telemetry", "1"), "--telemetry is an option of"),
        (("--protocol", "firmata", "--pin", "x=1"), "such as A0=100:900"),
        (("--protocol", "firmata", "--pin", "7=1:2"), "such as A0=100:900"),
        (("--protocol", "firmata", "--pin", "0=1"), "an Uno has pins 2–13 and A0–A5"),
        (("--protocol", "firmata", "--pin", "A9=1:2"), "an Uno has pins 2–13 and A0–A5"),
        (("--protocol", "amarino", "--function", "ab"), "such as A=42"),
        (("--protocol", "amarino", "--function", "!=1"), "'!' is no flag"),
    ],
)
def test_what_cannot_be_meant_is_refused_with_what_was_expected(tool: Run, words: tuple[str, ...], said: str) -> None:
    refused = tool("sim", *words, "--pty", "x")
    assert refused.exit_code == 2, refused.output
    assert said in " ".join(refused.output.split())


@pytest.mark.parametrize("protocol", SIMULATED)
def test_what_is_seen_of_a_robot_is_always_as_much(protocol: str) -> None:
    given = {"psiu-ascii": {"name": "A"}, "psiu-hexa": {"address": 1}}.get(protocol, {})
    played = cast(protocol, given, seed=0, datagrams=False)
    for robot in played.robots:
        before = list(played.view(robot))
        robot.receive(bytes(range(256)) + b"D0064" + MIROSOT, 1.0)
        assert [each.event for each in played.view(robot)] == [each.event for each in before]

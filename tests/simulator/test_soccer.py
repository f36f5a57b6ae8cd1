"""The paper's robots: which bytes of a packet they take for theirs, and what they do."""

import asyncio
import json
import os
import socket
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.simulator.faults import Faults
from psiu_broker.simulator.soccer import TEAMS, SoccerRobot
from psiu_broker.simulator.transports import PtyPort, UdpPort

VECTORS: dict[str, Any] = json.loads((Path(__file__).parents[1] / "vectors" / "soccer.json").read_text())
MIROSOT = bytes.fromhex("aa3e3efc7e030355")


def told(robot: SoccerRobot, *pieces: bytes, now: float = 0.0) -> SoccerRobot:
    for piece in pieces:
        assert robot.receive(piece, now) == [], "it never answers"
    return robot


@pytest.mark.parametrize("vector", VECTORS["packets"], ids=lambda v: f"{v['preset']}-{v['hex'][:8]}")
def test_each_robot_takes_its_own_share_of_a_golden_packet(vector: dict[str, Any]) -> None:
    wire = bytes.fromhex(vector["hex"])
    team = SoccerRobot.team(vector["preset"])
    assert len(team) == len(vector["robots"])
    for robot, expected in zip(team, vector["robots"], strict=True):
        told(robot, *(bytes((byte,)) for byte in wire))
        if expected is None:
            assert (robot.packets, robot.dropped, set(robot.wheels)) == (0, 1, {0})
        else:
            assert (robot.packets, robot.dropped, list(robot.wheels)) == (1, 0, expected)
            assert [heard.parameters for heard in robot.heard] == [tuple(map(str, expected))]


@pytest.mark.parametrize("vector", VECTORS["wheel_bytes"], ids=lambda v: v["byte"])
def test_each_wheel_byte_moves_a_wheel(vector: dict[str, Any]) -> None:
    byte = bytes.fromhex(vector["byte"])
    robot = told(SoccerRobot(1, robots=1, bytes_per_robot=1), b"\xaa" + byte + b"\x55")
    assert robot.wheels == (-vector["speed"] if vector["reverse"] else vector["speed"],)


def test_exactly_a_quarter_of_all_bytes_is_obeyed() -> None:
    obeyed = [
        byte
        for byte in range(256)
        if told(SoccerRobot(1, robots=1, bytes_per_robot=1), bytes((0xAA, byte, 0x55))).packets
    ]
    assert obeyed == sorted(int(vector["byte"], 16) for vector in VECTORS["wheel_bytes"])


@pytest.mark.parametrize("vector", VECTORS["index"])
def test_the_index_is_that_of_the_paper(vector: dict[str, Any]) -> None:
    count, address, first = vector["num_bytes"], vector["address"], vector["first_byte"]
    robot = SoccerRobot(address, robots=8, bytes_per_robot=count, byte_codec="raw")
    data = bytes(range(1, 8 * count + 1))
    assert told(robot, b"\xaa" + data + b"\x55").wheels == tuple(range(first, first + count))


def test_bytes_before_the_start_byte_are_ignored() -> None:
    assert told(SoccerRobot(1), b"\x00\x55\x3e" + MIROSOT).wheels == (15, 15)


def test_a_packet_without_its_end_byte_is_ignored_whole() -> None:
    robot = told(SoccerRobot(1), MIROSOT[:-1] + b"\x54")
    assert (robot.wheels, robot.dropped) == ((0, 0), 1)
    assert told(robot, MIROSOT).wheels == (15, 15)


def test_a_packet_cut_short_by_a_silence_is_ignored() -> None:
    robot = told(SoccerRobot(1), MIROSOT[:4])
    told(robot, MIROSOT, now=1.0)
    assert (robot.packets, robot.dropped, robot.wheels) == (1, 1, (15, 15))


def test_a_datagram_is_a_whole_packet_or_none() -> None:
    robot = told(SoccerRobot(1), MIROSOT[:4])
    robot.boundary()
    robot.boundary()
    assert (told(robot, MIROSOT).packets, robot.dropped) == (1, 1)


def test_a_fill_byte_may_be_anything_and_none_is_not_waited_for() -> None:
    robot = SoccerRobot(2, robots=2, bytes_per_robot=1, byte_codec="int8", trailer="fill")
    assert told(robot, b"\xaa\x01\xff\x77").wheels == (-1,)
    robot = SoccerRobot(2, robots=2, bytes_per_robot=1, byte_codec="int8", trailer="none")
    assert told(robot, b"\xaa\x01\xff").wheels == (-1,)


def test_wheels_turn_until_told_otherwise() -> None:
    robot = told(SoccerRobot(2), MIROSOT, now=10.0)
    robot.advance(12.0)
    assert (robot.wheels, robot.travelled) == ((-31, 31), (-62.0, 62.0))
    told(robot, b"\xaa\x03\x03\x03\x03\x03\x03\x55", now=13.0)
    robot.advance(99.0)
    assert (robot.wheels, robot.travelled) == ((0, 0), (-93.0, 93.0))


def test_a_robot_that_stops_in_a_silence_does() -> None:
    robot = told(SoccerRobot(1, stop_after_s=0.5), MIROSOT, now=10.0)
    robot.advance(10.4)
    assert robot.wheels == (15, 15)
    robot.advance(20.0)
    assert robot.wheels == (0, 0)
    assert robot.travelled == pytest.approx((7.5, 7.5))


def test_a_bad_share_does_not_keep_a_robot_moving() -> None:
    robot = told(SoccerRobot(1, stop_after_s=0.5), MIROSOT, now=10.0)
    told(robot, bytes.fromhex("aa363efc7e030355"), now=10.4)
    robot.advance(10.6)
    assert (robot.wheels, robot.dropped) == ((0, 0), 1)


@pytest.mark.parametrize(
    "options",
    [
        {"address": 0}, {"address": 4}, {"address": 1, "bytes_per_robot": 0}, {"address": 1, "start": 256},
        {"address": 1, "byte_codec": "x"}, {"address": 1, "trailer": "x"},
    ],
)  # fmt: skip
def test_a_robot_that_cannot_be_is_refused(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"is 1–3|at least one byte|there is no"):
        SoccerRobot(**options)


def test_there_is_a_team_for_each_preset_and_options_go_before_its_own() -> None:
    assert set(TEAMS) == set(VECTORS["presets"])
    assert [robot.name for robot in SoccerRobot.team("mirosot", robots=2)] == ["0x01", "0x02"]
    with pytest.raises(ValueError, match="there is no team"):
        SoccerRobot.team("brasil")


def test_a_robot_says_nothing_of_its_own_accord() -> None:
    robot = SoccerRobot(1)
    assert (robot.hello(), robot.telemetry(), robot.telemetry_s) == (b"", b"", None)


@given(data=st.binary(max_size=200), cuts=st.lists(st.integers(0, 200), max_size=6), preset=st.sampled_from([*TEAMS]))
def test_nothing_is_raised_and_any_cut_is_alike(data: bytes, cuts: list[int], preset: str) -> None:
    data = MIROSOT[:3] + data + MIROSOT
    places = [0, *sorted(cut for cut in cuts if cut < len(data)), len(data)]
    for whole, cut in zip(SoccerRobot.team(preset), SoccerRobot.team(preset), strict=True):
        told(whole, data)
        told(cut, *(data[start:end] for start, end in pairwise(places)))
        assert (whole.wheels, whole.packets, whole.dropped) == (cut.wheels, cut.packets, cut.dropped)


async def test_a_whole_team_listens_on_one_pty(tmp_path: Path) -> None:
    team = SoccerRobot.team("mirosot")
    async with PtyPort(*team, link=tmp_path / "radio", faults=Faults(one_byte_at_a_time=True)) as port:
        descriptor = os.open(port.path, os.O_RDWR | os.O_NOCTTY)
        try:
            os.write(descriptor, MIROSOT)
            await port.until(lambda: all(robot.packets for robot in team))
        finally:
            os.close(descriptor)
    assert [robot.wheels for robot in team] == [(15, 15), (-31, 31), (0, 0)]


async def test_a_whole_team_listens_on_one_udp_port_and_is_silent() -> None:
    team = SoccerRobot.team("mirosot")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as caller:
        caller.setblocking(False)
        caller.bind(("127.0.0.1", 0))
        async with UdpPort(*team, peer=f"127.0.0.1:{caller.getsockname()[1]}") as port:
            host, _, number = port.address.rpartition(":")
            caller.sendto(MIROSOT[:5], (host, int(number)))
            caller.sendto(MIROSOT, (host, int(number)))
            await port.until(lambda: all(robot.packets for robot in team))
            assert {robot.dropped for robot in team} == {1}
            await asyncio.sleep(0)
            with pytest.raises(BlockingIOError):
                caller.recv(100)

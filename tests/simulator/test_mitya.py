"""The simulated Robot Mitya: what its firmware does to each message, in each version, on a line and behind a phone."""

import json
import os
import socket
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.simulator.mitya import CLOCK_MS, MEMORY, Action, MityaBody, MityaVersion
from psiu_broker.simulator.transports import PtyPort, UdpPort

VECTORS = json.loads((Path(__file__).parents[1] / "vectors" / "mitya.json").read_text())


def says(robot: MityaBody, *texts: str, now: float = 0.0) -> list[str]:
    return [reply.decode() for text in texts for _, reply in robot.receive(text.encode("latin-1"), now)]


def old() -> MityaBody:
    return MityaBody("MITYA")


def new(**options: Any) -> MityaBody:
    return MityaBody("MITYA", version="2013", **options)


def record(robot: MityaBody, slot: int, *actions: str, room: int | None = None) -> list[str]:
    count = len(actions) // 2 if room is None else room
    return says(robot, f"r01{slot:02X}", f"Z{count:04X}", *actions, "Z0000")


class TestA2012Body:
    @pytest.mark.parametrize("text", ["L00FF", "RFF81", "LFF9C", "H005A", "V003C", "F0102", "I0001", "T0010", "t0002"])
    def test_obeys_in_silence(self, text: str) -> None:
        assert says(old(), text) == []

    @pytest.mark.parametrize(
        ("text", "answer"),
        [
            ("E0001", "E0002"), ("h0001", "E0002"), ("F0001", "E0002"), ("Q0001", "E0002"), ("00000", "E0002"),
            ("G0064", "E0002"), ("W03E8", "E0007"), ("Z000A", "E0007"), ("Z0000", "E0007"), ("L-064", "E0001"),
            ("L00G0", "E0001"), ("hello", "E0001"),
        ],
    )  # fmt: skip
    def test_says_what_it_cannot_do(self, text: str, answer: str) -> None:
        assert says(old(), text) == [answer]

    def test_is_seen_to_move(self) -> None:
        robot = old()
        says(robot, "D0064", "RFF9C", "H00B4", "V003C", "T0064", "I0001", "F0103", "y0001", "y0000", "t0002")
        body = robot.body
        assert (body.left, body.right) == (100, -100)
        assert (body.head_horizontal, body.head_vertical, body.tail) == (180, 60, 100)
        assert (body.headlights, body.mood, body.gestures) == (True, 0x103, ["nod", "wag"])

    def test_goes_no_faster_and_turns_no_further_than_it_can(self) -> None:
        robot = old()
        says(robot, "D8000", "H7FFF", "VFFFF", "T0000")
        body = robot.body
        assert (body.left, body.right) == (-255, -255)
        assert (body.head_horizontal, body.head_vertical, body.tail) == (180, 0, 10)

    def test_fires_whatever_the_value(self) -> None:
        robot = old()
        says(robot, *VECTORS["datagrams"]["fire_2012"])
        assert robot.body.shots == 6

    def test_never_finds_its_step_again(self) -> None:
        robot = old()
        assert says(robot, "x" + "L0001" * 40) == ["E0001"] * 40
        assert robot.body.left == 0
        assert says(robot, "0000", "L0001") == ["E0002"]  # 10000
        assert robot.body.left == 1

    def test_keeps_what_it_has_begun_whatever_happens_to_the_line(self) -> None:
        robot = old()
        says(robot, "L00")
        robot.boundary()
        says(robot, "07", now=1000.0)
        assert robot.body.left == 7

    def test_a_line_end_makes_it_lose_step(self) -> None:
        assert says(old(), "L0001\r\n", "L0002\r\n") == ["E0001"]

    def test_reads_either_case(self) -> None:
        robot = old()
        says(robot, "L00ff")
        assert robot.body.left == 255

    def test_notes_what_it_took_for_a_message(self) -> None:
        robot = old()
        says(robot, "D0064", "RFF81")
        assert [(heard.subject, heard.parameters) for heard in robot.heard] == [
            ("drive", ("100",)),
            ("right", ("-127",)),
        ]


class TestLaterBodies:
    @pytest.mark.parametrize("version", ["2013", "2014"])
    @pytest.mark.parametrize("text", ["G0064", "L00FF", "H005A", "M0101", "I0001", "s0001", "y0001", "h0064", "v0064"])
    def test_answer_each_command(self, version: MityaVersion, text: str) -> None:
        assert says(MityaBody("MITYA", version=version), text) == ["#0000"]

    @pytest.mark.parametrize(
        ("text", "answers"),
        [
            ("M0001", ["M0001", "#0000"]),
            ("=0000", ["~01F6", "#0000"]),
            ("Q0001", ["#0002"]),
            ("*0001", ["#0002"]),
            ("W0000", ["#0007"]),
            ("Gxxxx", ["#0001"]),
            ("D0064G0064", ["#0008"] * 5 + ["#0000"]),
            ("0G0064", ["#0008", "#0000"]),
            ("00000", ["#0008"]),  # the other four wait for a fifth
        ],
    )
    def test_say_what_else_there_is_to_say(self, text: str, answers: list[str]) -> None:
        assert says(new(), text) == answers

    def test_find_their_step_again(self) -> None:
        robot = new()
        assert says(robot, "00FF", "G0064") == ["#0008"] * 4 + ["#0000"]
        assert robot.body.left == 100

    def test_2014_has_no_scripts(self) -> None:
        assert says(MityaBody("MITYA", version="2014"), "r0100", "Z0002") == ["#0002", "#0007"]

    def test_tell_their_battery(self) -> None:
        robot = new(volts=4.2, telemetry_s=1.0)
        assert robot.telemetry() == b"~01A4"
        assert says(robot, "=1000") == ["~11A4", "#0000"]


class TestScripts:
    def test_a_body_is_silent_while_it_records_and_then_says_that_it_ended(self) -> None:
        robot = old()
        assert says(robot, "r0103") == []
        assert robot.recording == 3
        assert says(robot, "Z0002", "D0064", "W03E8", "D0000", "W0000") == []
        assert robot.body.left == 0
        assert says(robot, "Z0000") == ["r0200"]
        assert robot.recording is None
        assert robot.scripts[3] == [Action("D", 100, 1000), Action("D", 0, 0)]

    def test_it_is_played_in_its_time(self) -> None:
        robot = old()
        record(robot, 0, "D0064", "W03E8", "H0000", "W01F4", "D0000", "W0000")
        assert says(robot, "r0000", now=10.0) == []
        robot.advance(10.0)
        assert (robot.body.left, robot.body.head_horizontal) == (100, 90)
        robot.advance(11.0)
        assert (robot.body.left, robot.body.head_horizontal) == (100, 0)
        robot.advance(11.5)
        assert robot.body.left == 0
        assert not robot.playing

    def test_what_is_for_the_phone_is_sent_to_it_in_its_time(self) -> None:
        robot = old()
        record(robot, 0, "F0002", "W03E8", "F0001", "W0000")
        assert robot.receive(b"r0000", 0.0) == [(0.0, b"F0002"), (1.0, b"F0001")]

    def test_later_bodies_answer_the_beginning_and_each_action(self) -> None:
        robot = new()
        assert says(robot, "r0100") == ["#0000"]
        assert says(robot, "Z0001", "G0064", "W0064", "Z0000") == ["r0200"]
        assert says(robot, "r0000") == ["#0000", "#0000"]

    @pytest.mark.parametrize(
        ("messages", "error"),
        [
            (["Z0002", "D0064", "D0064"], "E0004"),
            (["Z0002", "W0064"], "E0004"),
            (["Z0002", "D0064", "Z0000"], "E0004"),
            (["Z0002", "r0000"], "E0003"),
            (["Z0001", "D0064", "W0001", "D0000", "W0001"], "E0006"),
            (["D0064", "W0001"], "E0006"),
            (["Z0083"], "E0005"),
            (["Z0002", "DDDDx"], "E0001"),
        ],
    )
    def test_an_error_ends_the_recording_and_frees_the_slot(self, messages: list[str], error: str) -> None:
        robot = old()
        assert says(robot, "r0102", *messages) == [error, "r0200"]
        assert robot.recording is None
        assert robot.scripts == {}
        says(robot, "L0007")
        assert robot.body.left == 7

    def test_the_memory_is_shared_by_all_slots(self) -> None:
        robot = old()
        assert record(robot, 0, room=MEMORY - 10) == ["r0200"]
        assert record(robot, 1, room=11) == ["E0005", "r0200", "E0007"]
        assert record(robot, 1, room=10) == ["r0200"]
        assert record(robot, 0, room=MEMORY - 10) == ["r0200"]  # what was there is freed first

    @pytest.mark.parametrize("slot", [0x0A, 0xFF])
    def test_there_are_ten_slots(self, slot: int) -> None:
        robot = old()
        assert says(robot, f"r01{slot:02X}") == []
        assert robot.recording is None
        assert says(robot, "r0109") == []
        assert robot.recording == 9

    def test_what_it_says_at_the_end_of_a_recording_begins_one(self) -> None:
        robot = old()
        says(robot, "r0200")
        assert robot.recording == 0

    def test_an_action_beyond_the_clock_never_comes(self) -> None:
        robot = old()
        record(robot, 0, "L0001", "WFFFF", "L0002", "W0001", "L0003", "W0000")
        says(robot, "r0000")
        robot.advance(CLOCK_MS)
        assert robot.body.left == 2

    def test_a_script_goes_on_only_while_its_slot_is_the_one_that_was_named_last(self) -> None:
        robot = old()
        record(robot, 0, "D0064", "W03E8", "D0032", "W03E8", "D0000", "W0000")
        says(robot, "r0000")
        says(robot, "r0109", "Z0000", "D0000")
        robot.advance(1.5)
        assert robot.body.left == 0
        says(robot, "r0100", "Z0000", now=1.5)
        robot.advance(1.6)
        assert robot.body.left == 50, "it goes on where it was left, without being played anew"

    def test_an_empty_slot_plays_nothing(self) -> None:
        robot = old()
        assert says(robot, "r0005") == []
        assert not robot.playing


class TestThePhone:
    def phone(self, version: MityaVersion = "2012") -> MityaBody:
        return MityaBody("MITYA", version=version, phone=True)

    def test_takes_five_bytes_of_a_datagram(self) -> None:
        robot = self.phone()
        says(robot, bytes.fromhex(VECTORS["datagrams"]["with_crlf"]).decode(), "L0007\r\n")
        assert (robot.body.shots, robot.body.left) == (1, 7)

    def test_ignores_set_points_that_repeat(self) -> None:
        robot = self.phone()
        says(robot, "L0007", "L0007", "L0008", "L0007")
        assert [heard.parameters for heard in robot.heard] == [("7",), ("8",), ("7",)]

    def test_shows_moods_itself_and_tells_them(self) -> None:
        robot = self.phone()
        assert says(robot, "F0003") == ["F0003"]
        assert robot.body.mood == 3
        assert says(robot, "F0102") == []
        assert robot.body.mood == 0x102

    def test_passes_on_errors_but_no_success(self) -> None:
        assert says(self.phone(), "Q0001") == ["E0002"]
        robot = self.phone("2013")
        assert says(robot, "G0064", "Q0001", "M0003") == ["#0002", "M0003"]

    def test_while_a_script_is_recorded_nothing_is_a_repeat_or_a_mood(self) -> None:
        robot = self.phone()
        says(robot, "r0100", "Z0003", "L0007", "W0001", "L0007", "W0001", "F0001", "W0001", "Z0000")
        assert [action.letter for action in robot.scripts[0]] == ["L", "L", "F"]
        assert robot.body.mood == 1
        assert says(robot, "F0003") == ["F0003"]

    def test_a_short_datagram_does_not_bring_the_body_out_of_step(self) -> None:
        robot = self.phone()
        assert says(robot, "L0") == ["E0001"]
        says(robot, "L0007")
        assert robot.body.left == 7


@pytest.mark.parametrize("options", [{"version": "2011"}, {"volts": 41}, {"volts": -1}])
def test_what_cannot_be_is_refused(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"there is no version|a voltage is"):
        MityaBody("MITYA", **options)


def test_a_2012_body_tells_of_hits_and_says_hello_with_its_mood() -> None:
    robot = MityaBody("MITYA", telemetry_s=1.0)
    assert robot.telemetry() == b"h0001h0000"
    assert robot.hello() == b"F0001"
    assert new().hello() == b"M0001"


@given(st.lists(st.binary(max_size=12) | st.from_regex(r"\A[A-Za-z=~*#][0-9A-F]{4}\Z").map(str.encode), max_size=20))
def test_no_bytes_are_too_odd(pieces: list[bytes]) -> None:
    for version in ("2012", "2013", "2014"):
        for phone in (False, True):
            robot = MityaBody("MITYA", version=version, phone=phone)
            for now, piece in enumerate(pieces):
                for delay_s, said in robot.receive(piece, float(now)):
                    assert delay_s >= 0
                    assert len(said) == 5
            assert sum(map(len, robot.scripts.values())) <= MEMORY


async def test_it_can_be_a_serial_port(tmp_path: Path) -> None:
    async with PtyPort(new(), link=tmp_path / "corpo") as port:
        device = os.open(port.path, os.O_RDWR | os.O_NOCTTY)
        try:
            os.write(device, b"G0064")
            robot = port.robot
            assert isinstance(robot, MityaBody)
            await port.until(lambda: robot.body.left == 100)
            assert os.read(device, 5) == b"#0000"
        finally:
            os.close(device)


async def test_it_can_be_a_phone_at_a_udp_port() -> None:
    robot = MityaBody("MITYA", phone=True)
    async with UdpPort(robot) as port:
        host, _, number = port.address.rpartition(":")
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as program:
            program.settimeout(5)
            for text in ("D0064\r\n", "Q0001"):
                program.sendto(text.encode(), (host, int(number)))
            await port.until(lambda: len(robot.heard) == 2)
            assert program.recv(100) == b"E0002"
    assert robot.body.left == 100

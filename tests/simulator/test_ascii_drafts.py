import json
from pathlib import Path
from typing import Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.codecs.codec import Directory
from psiu_broker.codecs.psiu_ascii import PsiuAscii, message
from psiu_broker.frame import Address, Frame
from psiu_broker.simulator import AsciiRobot

VECTORS = json.loads((Path(__file__).parents[1] / "vectors" / "psiu-ascii.json").read_text())["frames"]
WIRES = {vector["wire"].encode() for vector in VECTORS}
HALF = b"MNERIM031parafrente 100 PC02024"
NONE = b"MNERIM029parafrente 100 01884"


def answers(robot: AsciiRobot, data: bytes) -> list[bytes]:
    return [reply for _, reply in robot.receive(data, 0.0)]


def summed(text: bytes) -> bytes:
    return text + b"%05d" % (sum(text) & 0xFFFF)


def test_a_robot_of_draft_0_5_answers_as_its_firmware_does() -> None:
    robot = AsciiRobot("MNERIM", version="0.5", quirks={"wrong_size"})
    assert {HALF, *answers(robot, HALF)} <= WIRES
    robot.advance(1.0)
    assert robot.position.x == 100
    assert answers(robot, b"??024qualseunome PC01654") == [summed(b"PC026qualseunome MNERIM")]


def test_a_robot_of_draft_0_answers_whoever_it_was_told_of() -> None:
    robot = AsciiRobot("MNERIM", version="0", telemetry_to="BASE")
    assert answers(robot, NONE) == [summed(b"BASE031parafrente sucesso ")]
    assert robot.heard[0].source == "BASE"


@pytest.mark.parametrize(("version", "good"), [("0.5", HALF), ("0", NONE)])
def test_it_finds_its_frames_however_they_come(version: Literal["0.5", "0"], good: bytes) -> None:
    robot = AsciiRobot("MNERIM", version=version)
    wrong_size = summed(good[:-5].replace(b"MNERIM0", b"MNERIM1"))
    for data in (b"7 " + good, b"\r\n" + good, b"xyz" + good, b"12345" + good, wrong_size):
        assert len([reply for byte in data for reply in answers(robot, bytes([byte]))]) == 1


@pytest.mark.parametrize(("version", "good"), [("0.5", HALF), ("0", NONE)])
def test_it_obeys_no_other_frame_and_complains_if_it_is_of_that_kind(version: Literal["0.5", "0"], good: bytes) -> None:
    robot = AsciiRobot("MNERIM", version=version, quirks={"complains", "ruined_by_crlf"})
    assert answers(robot, summed(good[:-5].replace(b"MNERIM", b"OUTROS"))) == []
    assert answers(robot, good[:-1] + b"0") == [b"CHECKSUM NAO BATEU!\r\n"]
    assert answers(robot, b"\n" + good) == [b"CHECKSUM NAO BATEU!\r\n"]
    assert len(answers(robot, good)) == 1


@given(amount=st.integers(0, 999), version=st.sampled_from(["0.5", "0"]))
def test_the_broker_and_the_robot_understand_each_other(amount: int, version: Literal["0.5", "0"]) -> None:
    codec = PsiuAscii(PsiuAscii.Options(version=version), Directory(all_names={"PC", "MNERIM"}))
    order = message(Address.named("PC"), Address.named("MNERIM"), "parafrente", str(amount))
    (reply,) = answers(AsciiRobot("MNERIM", version=version), codec.encode(order))
    (frame,) = codec.decode(reply, 0.0)
    assert isinstance(frame, Frame)
    assert (frame.destination.name, frame.payload, frame.remark) == ("PC", b"parafrente sucesso", "")

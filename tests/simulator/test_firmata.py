"""The simulated Arduino, as the firmware's source has it and as pyFirmata2, which nobody here wrote, sees it."""

import asyncio
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pyfirmata2
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyfirmata2 import pyfirmata2 as library

from psiu_broker.simulator import Faults, PtyPort
from psiu_broker.simulator.firmata import Drift, FirmataBoard, modes_of

BOOT = bytes.fromhex("f90205 f07902055300740061006e006400610072006400460069007200") + bytes.fromhex(
    "6d006100740061002e0069006e006f00f7"
)


def board(**options: object) -> FirmataBoard:
    made = FirmataBoard(**options)  # type: ignore[arg-type]
    made.advance(0.0)
    made.telemetry()
    return made


def said(robot: FirmataBoard, data: str, now: float = 0.0) -> list[str]:
    return [reply.hex() for _, reply in robot.receive(bytes.fromhex(data), now)]


def reported(robot: FirmataBoard, now: float) -> str:
    robot.advance(now)
    return robot.telemetry().hex()


def test_its_first_words_are_its_version_and_its_firmware_once() -> None:
    robot = FirmataBoard()
    assert reported(robot, 0.0) == BOOT.hex()
    assert reported(robot, 0.1) == ""
    assert BOOT[:5] == bytes.fromhex("f90205f079")


def test_it_tells_them_before_it_answers_the_first_question() -> None:
    assert said(FirmataBoard(), "f9") == [BOOT.hex(), "f90205"]


def test_while_it_boots_it_is_deaf() -> None:
    robot = FirmataBoard(boot_s=1.5)
    assert said(robot, "f9", 0.0) == []
    assert reported(robot, 1.4) == ""
    assert reported(robot, 1.5) == BOOT.hex()
    assert said(robot, "f9", 1.6) == ["f90205"]


def test_the_button_resets_it_and_it_speaks_again() -> None:
    robot = board()
    said(robot, "f40901 f50901")
    assert (robot.modes[9], robot.states[9]) == (1, 1)
    robot.press_reset()
    assert (robot.modes[9], robot.states[9], robot.resets) == (1, 0, 1)
    assert reported(robot, 1.0) == BOOT.hex()


@pytest.mark.parametrize(("resets", "boot"), [(True, BOOT.hex()), (False, "")])
def test_losing_its_line_resets_it_only_where_that_is_wired(resets: bool, boot: str) -> None:
    robot = board(resets_on_reopen=resets)
    robot.boundary()
    assert reported(robot, 1.0) == boot


def test_a_reset_over_the_line_is_silent() -> None:
    robot = board()
    assert said(robot, "f40904 e95a00 ff") == []
    assert (robot.modes[9], robot.states[9], robot.resets) == (1, 0, 1)


def test_it_answers_the_questions_of_a_host() -> None:
    robot = board(instance=3)
    assert said(robot, "f079f7") == [BOOT[3:].hex()]
    assert said(robot, "f051f7") == ["f05203f7"]
    assert said(board(), "f051f7") == []
    assert said(robot, "f069f7") == ["f06a" + "7f" * 14 + "000102030405f7"]
    (capabilities,) = said(robot, "f06bf7")
    pins = bytes.fromhex(capabilities)[2:-1].hex()
    assert pins.startswith("7f7f" + "00010b010101040e7f" + "00010b0101010308040e7f")
    assert pins.endswith("00010b010101020a7f" * 4 + "00010b010101020a06017f" * 2)
    assert bytes.fromhex(pins).count(0x7F) == 20


def test_a_pin_s_state_is_what_was_written_to_it() -> None:
    robot = board()
    assert said(robot, "f06d0df7 f50d01 f06d0df7") == ["f06e0d0100f7", "f06e0d0101f7"]
    assert said(robot, "f40904 e95a00 f06d09f7") == ["f06e09045af7"]
    assert said(robot, "f40904 e93401 f06d09f7") == ["f06e09043401f7"]
    assert said(robot, "f06f09000001f7 f06d09f7") == ["f06e09040000" + "01f7"]
    assert said(robot, "f4020b f06d02f7") == ["f06e020b01f7"]
    assert said(robot, "f06d63f7") == ["f06e63f7"]


def test_a_pin_takes_only_what_its_mode_takes() -> None:
    robot = board()
    said(robot, "f40d03 e34001 f40303 f50301 937f01 f40200 f50201")
    assert robot.modes[13] == 1
    assert (robot.modes[3], robot.states[3]) == (3, 0)
    assert robot.states[2] == 0
    said(robot, "907c01")
    assert robot.states[:8] == [0, 0, 1, 0, 1, 1, 1, 1]
    assert said(robot, "f4020e") == [said_text("Unknown pin mode")]
    assert said(robot, "f47f01 ef7f7f df01 9f0101 cf01") == []


def said_text(text: str) -> str:
    return "f071" + "".join(f"{ord(letter):02x}00" for letter in text) + "f7"


def test_a_servo_is_given_its_pulses() -> None:
    robot = board()
    said(robot, "f07009200460" + "12f7")
    assert (robot.modes[9], robot.pulses[9]) == (4, (0x20 | 4 << 7, 0x60 | 0x12 << 7))


def test_strings_are_kept_and_never_more_than_ten() -> None:
    robot = board()
    said(robot, said_text("oi") * 12)
    assert robot.texts == ["oi"] * 10


def test_a_digital_port_is_told_at_once_when_asked_and_then_on_each_change() -> None:
    robot = board()
    robot.set_pin(2, 1)
    assert said(robot, "f40200 d001") == ["900400"]
    assert reported(robot, 0.02) == ""
    robot.set_pin(2, 0)
    assert reported(robot, 0.04) == "900000"
    robot.set_pin(7, 1)
    assert reported(robot, 0.06) == ""
    assert said(robot, "f4070b") == []
    assert reported(robot, 0.08) == "900001"
    robot.set_pin(7, None)
    assert reported(robot, 0.1) == ""
    said(robot, "d000")
    robot.set_pin(2, 1)
    assert reported(robot, 0.12) == ""


def test_an_analog_channel_is_told_at_once_and_then_at_the_sampling_interval() -> None:
    robot = board()
    robot.set_pin("A0", 1023)
    assert said(robot, "c001") == ["e07f07"]
    assert reported(robot, 0.019) == "e07f07"
    assert reported(robot, 0.02) == ""
    assert said(robot, "f07a6400f7") == []
    assert reported(robot, 0.1) == ""
    assert reported(robot, 0.12) == "e07f07"
    said(robot, "f40e01")
    assert reported(robot, 1.0) == ""
    assert said(robot, "f40e02") == ["e07f07"]


def test_an_analog_input_may_drift_until_it_is_set() -> None:
    robot = board(drifts={1: Drift(100, 200, period_s=2.0)})
    assert said(robot, "c101", 0.0) == ["e16400"]
    assert said(robot, "c101", 1.0) == ["e14801"]
    robot.set_pin("A1", 5)
    assert said(robot, "c101", 1.5) == ["e10500"]


@pytest.mark.parametrize("pin", [0, 1, 20, -1, "A6"])
def test_only_pins_of_an_uno_can_be_set(pin: int | str) -> None:
    with pytest.raises(ValueError, match="an Uno has pins 2–13 and A0–A5"):
        board().set_pin(pin, 1)


@given(data=st.lists(st.binary(max_size=30), max_size=10))
def test_nothing_that_it_hears_breaks_it(data: list[bytes]) -> None:
    whole, cut = board(), board()
    told = b"".join(reply for _, reply in whole.receive(b"".join(data), 0.0))
    assert b"".join(reply for each in data for _, reply in cut.receive(each, 0.0)) == told
    assert reported(whole, 1.0) == reported(cut, 1.0)
    assert all(mode in modes_of(pin) for pin, mode in enumerate(whole.modes) if pin >= 2)
    assert len(whole._data) <= 64


def eventually(condition: Callable[[], bool]) -> bool:
    deadline = time.monotonic() + 5
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.005)
    return True


@contextmanager
def host(path: str) -> Iterator[pyfirmata2.Board]:
    wait, library.BOARD_SETUP_WAIT_TIME = library.BOARD_SETUP_WAIT_TIME, 0.05
    try:
        # The layout by name: asked for it, a board lists modes in an order that the library does not expect.
        made = pyfirmata2.Arduino(path)
    finally:
        library.BOARD_SETUP_WAIT_TIME = wait
    try:
        yield made
    finally:
        made.exit()


def drive(path: str, robot: FirmataBoard) -> None:
    """What a person's program does with pyFirmata2: outputs, a servo, a button and a light sensor."""
    with host(path) as uno:
        uno.send_sysex(0x79, [])
        uno.sp.write(b"\xf9")
        uno.samplingOn(20)
        assert eventually(lambda: (uno.firmware, uno.firmata_version) == ("StandardFirmata.ino", (2, 5)))

        uno.get_pin("d:13:o").write(1)
        assert eventually(lambda: robot.states[13] == 1)
        uno.get_pin("d:5:p").write(0.5)
        assert eventually(lambda: (robot.modes[5], robot.states[5]) == (3, 128))
        arm = uno.get_pin("d:9:s")
        arm.write(120)
        assert eventually(lambda: (robot.modes[9], robot.states[9]) == (4, 120))
        assert robot.pulses[9] == (544, 2400)

        pressed: list[bool] = []
        button = uno.get_pin("d:2:u")
        button.register_callback(pressed.append)
        assert eventually(lambda: robot.modes[2] == 11)
        robot.set_pin(2, 0)
        assert eventually(lambda: pressed[-1:] == [False])
        robot.set_pin(2, 1)
        assert eventually(lambda: pressed[-1:] == [True])

        light: list[float] = []
        sensor = uno.get_pin("a:0:i")
        sensor.register_callback(light.append)
        robot.set_pin("A0", 512)
        assert eventually(lambda: light[-1:] == [round(512 / 1023, 4)])


@pytest.mark.parametrize("faults", [Faults(), Faults(one_byte_at_a_time=True)], ids=["whole", "byte by byte"])
async def test_pyfirmata2_drives_it_over_a_serial_line(faults: Faults) -> None:
    robot = FirmataBoard()
    async with PtyPort(robot, faults=faults) as port:
        await asyncio.to_thread(drive, port.path, robot)

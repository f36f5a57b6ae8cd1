import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.codecs.amarino import Amarino
from psiu_broker.frame import Frame
from psiu_broker.simulator.amarino import AmarinoBoard


def answers(board: AmarinoBoard, data: bytes) -> list[bytes]:
    return [reply for _, reply in board.receive(data, 0.0)]


def test_a_function_is_told_its_values_and_answers_with_a_text() -> None:
    board = AmarinoBoard(functions={"A": None, "t": "21.50", "e": ""})
    assert answers(board, b"A180;45\x13t\x13e1;2\x13") == [b"\x1221.50\x13", b"\x121;2\x13"]
    assert [(heard.subject, heard.parameters) for heard in board.heard] == [
        ("flag/A", ("180", "45")), ("flag/t", ()), ("flag/e", ("1", "2")),
    ]  # fmt: skip


@pytest.mark.parametrize("message", [b"\x13", b"/1\x13", b" \x13", b"\x11\x13", b"-5\x13", b"A\x1b\x13"])
def test_a_message_without_a_flag_or_with_one_below_0_crashes_it_until_it_is_unplugged(message: bytes) -> None:
    board = AmarinoBoard()
    assert answers(board, b"C\x13" + message + b"C\x13") == []
    assert board.crashed
    board.boundary()
    assert answers(board, b"C\x13") == []
    assert board.hello() == board.telemetry() == b""
    board.unplug()
    assert answers(board, b"C\x13") == [b"\x1242\x13"]


def test_it_says_that_a_flag_has_no_function() -> None:
    board = AmarinoBoard(functions={})
    assert answers(board, b"A1\x13") == [b"\x12Flag not registered: \x13", b"\x1265\x13"]
    assert answers(board, b"~\x13") == [b"\x12Flag out of bounds: \x13", b"\x12126\x13"]


def test_it_keeps_64_bytes_and_forgets_what_was_aborted() -> None:
    board = AmarinoBoard(functions={"e": ""})
    assert answers(board, b"e" + b"x" * 99 + b"\x13") == [b"\x12" + b"x" * 63 + b"\x13"]
    assert answers(board, b"eold\x1bene") == []
    assert answers(board, b"w\x13") == [b"\x12new\x13"]


def test_it_tells_its_readings_with_two_decimals() -> None:
    assert AmarinoBoard(readings=[21.5, -3]).telemetry() == b"\x1221.50;-3.00\x13"
    assert AmarinoBoard("vela").hello() == b"\x12vela\x13"


@pytest.mark.parametrize("flag", ["", "/", "{", "AB"])
def test_a_function_needs_a_flag_from_0_to_z(flag: str) -> None:
    with pytest.raises(ValueError, match="no flag"):
        AmarinoBoard(functions={flag: None})


@given(data=st.binary(max_size=200))
def test_whatever_is_forwarded_from_a_phone_no_board_crashes(data: bytes) -> None:
    phone, board = Amarino(Amarino.Options(role="board")), AmarinoBoard()
    for event in phone.decode(data + b"\x13", 0.0):
        if isinstance(event, Frame) and event.dialect == Amarino(Amarino.Options(role="phone")).dialect:
            board.receive(event.wire, 0.0)
    assert not board.crashed


@given(pieces=st.lists(st.binary(max_size=90), max_size=5))
def test_it_never_raises(pieces: list[bytes]) -> None:
    board = AmarinoBoard()
    for piece in pieces:
        board.receive(piece, 0.0)

import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.codecs.fragments import (
    LONGEST_MESSAGE,
    LONGEST_PAYLOAD,
    MOST_MESSAGES,
    REASSEMBLY_S,
    Piece,
    Reassembly,
    fields,
    join_fields,
    split,
)
from psiu_broker.errors import EncodeError
from psiu_broker.frame import Address

A, B, C = (Address.numbered(number) for number in (1, 2, 3))
some_fields = st.lists(st.binary(max_size=255), min_size=1, max_size=12).filter(
    lambda parts: len(parts) + len(parts[0]) > 1
)


def long_message(size: int) -> bytes:
    """A complex payload of `size` bytes, more than one packet holds."""
    parts = [bytes(255)] * ((size - 1) // 256)
    rest = size - 1 - 256 * len(parts)
    payload = join_fields([*parts, b"\x07" * (rest - 1)] if rest else parts)
    assert len(payload) == size
    return payload


def feed(reassembly: Reassembly, pieces: list[bytes], now: float = 0.0) -> tuple[list[Piece], list[Piece]]:
    whole, lost = [], []
    for piece in pieces:
        done, given_up = reassembly.take(A, B, Piece(piece, b"<" + piece + b">"), now)
        lost += given_up
        if done is not None:
            whole.append(done)
    return whole, lost


@given(parts=some_fields)
def test_fields_that_were_joined_come_apart_again(parts: list[bytes]) -> None:
    assert fields(join_fields(parts)) == parts


@given(payload=st.binary(max_size=300))
def test_fields_are_either_consistent_or_none(payload: bytes) -> None:
    parts = fields(payload)
    if parts is not None:
        assert payload == bytes((len(parts), *map(len, parts))) + b"".join(parts)


@pytest.mark.parametrize(
    ("payload", "expected"),
    [
        (b"\x01\x01\x55", [b"\x55"]),
        (b"\x02\x01\x02\xaa\xbb\xcc", [b"\xaa", b"\xbb\xcc"]),
        (b"\x02\x00\x00", [b"", b""]),
        (b"\x02\x00\x01\x55", [b"", b"\x55"]),
        (b"", None),
        (b"\x00", None),
        (b"\x00\x00\x00", None),
        (b"\x01\x02\x55", None),
        (b"\x01\x01\x55\x55", None),
        (b"\x05\x01\x01", None),
    ],
)
def test_a_count_of_at_least_one_and_sizes_that_add_up_make_fields(
    payload: bytes, expected: list[bytes] | None
) -> None:
    assert fields(payload) == expected


@pytest.mark.parametrize("parts", [[], [b"x"] * 256, [bytes(256)], [b""]])
def test_fields_that_no_packet_can_carry_are_refused(parts: list[bytes]) -> None:
    with pytest.raises(EncodeError):
        join_fields(parts)


@pytest.mark.parametrize("size", [252, 300, 501, 502, 503, 753, 4000])
def test_a_long_message_travels_in_full_pieces_and_a_shorter_last_one(size: int) -> None:
    payload = long_message(size)
    pieces = split(payload)
    assert b"".join(pieces) == payload
    assert {len(piece) for piece in pieces[:-1]} == {LONGEST_PAYLOAD}
    assert len(pieces[-1]) < LONGEST_PAYLOAD


@pytest.mark.parametrize("size", [252, 300, 501, 502, 503, 753, 4000])
def test_a_long_message_is_whole_again_with_its_last_piece(size: int) -> None:
    payload = long_message(size)
    pieces = split(payload)
    reassembly = Reassembly()
    assert feed(reassembly, pieces[:-1]) == ([], [])
    assert reassembly
    whole, lost = feed(reassembly, pieces[-1:])
    assert (whole, lost) == ([Piece(payload, b"".join(b"<" + piece + b">" for piece in pieces))], [])
    assert not reassembly


def test_the_longest_message_of_all_is_whole_again() -> None:
    payload = join_fields([bytes(255)] * 255)
    assert len(payload) == LONGEST_MESSAGE
    whole, lost = feed(Reassembly(), split(payload))
    assert ([piece.payload for piece in whole], lost) == ([payload], [])


def test_one_packet_or_less_is_not_broken() -> None:
    full = join_fields([bytes(249)])
    assert split(full) == [full]
    assert split(b"") == [b""]
    assert split(b"\x41") == [b"\x41"]


def test_a_full_packet_that_is_complete_by_itself_waits_for_nothing() -> None:
    full = join_fields([bytes(249)])
    reassembly = Reassembly()
    assert feed(reassembly, [full]) == ([Piece(full, b"<" + full + b">")], [])
    assert not reassembly


def test_a_full_packet_without_a_single_field_waits_for_nothing() -> None:
    assert len(feed(Reassembly(), [bytes(LONGEST_PAYLOAD)])[0]) == 1


@pytest.mark.parametrize("payload", [b"\x07" * 252, b"\x01" * LONGEST_PAYLOAD])
def test_bytes_that_are_no_fields_cannot_be_broken(payload: bytes) -> None:
    with pytest.raises(EncodeError):
        split(payload)


def test_short_packets_of_others_pass_between_the_pieces() -> None:
    payload = long_message(300)
    first, last = split(payload)
    reassembly = Reassembly()
    assert reassembly.take(A, B, Piece(first, b""), 0.0) == (None, [])
    assert reassembly.take(B, A, Piece(b"\x41", b""), 0.0) == (Piece(b"\x41", b""), [])
    assert reassembly.take(C, B, Piece(b"", b""), 0.0) == (Piece(b"", b""), [])
    assert reassembly.take(A, B, Piece(last, b""), 0.0) == (Piece(payload, b""), [])


def test_a_message_whose_next_piece_stays_away_is_given_up_at_its_deadline() -> None:
    first, second, last = split(long_message(600))
    reassembly = Reassembly()
    feed(reassembly, [first], now=10.0)
    feed(reassembly, [second], now=10.9)
    assert reassembly.expire(10.9 + REASSEMBLY_S - 0.001) == []
    assert reassembly.expire(10.9 + REASSEMBLY_S) == [Piece(first + second, b"<" + first + b"><" + second + b">")]
    assert not reassembly
    assert feed(reassembly, [last], now=12.0) == ([Piece(last, b"<" + last + b">")], [])


def test_a_message_with_a_lost_piece_is_given_up_and_not_delivered() -> None:
    first, _, last = split(long_message(600))
    whole, lost = feed(Reassembly(), [first, last])
    assert (whole, [piece.payload for piece in lost]) == ([], [first + last])


def test_a_message_that_outgrows_its_promise_is_given_up_at_once() -> None:
    first = split(long_message(300))[0]
    reassembly = Reassembly()
    whole, lost = feed(reassembly, [first, first])
    assert (whole, len(lost)) == ([], 1)
    assert not reassembly


def test_more_messages_at_once_than_allowed_push_out_the_oldest() -> None:
    first = split(long_message(300))[0]
    reassembly = Reassembly()
    for number in range(MOST_MESSAGES):
        assert reassembly.take(Address.numbered(number), B, Piece(first, bytes((number,))), number / 100) == (None, [])
    _, given_up = reassembly.take(Address.numbered(99), B, Piece(first, b""), 0.5)
    assert given_up == [Piece(first, b"\x00")]


@given(
    pieces=st.lists(st.tuples(st.integers(0, 40), st.sampled_from([0, 1, 250, 251]), st.integers(0, 255)), max_size=60)
)
def test_no_pieces_whatever_are_held_beyond_the_bounds(pieces: list[tuple[int, int, int]]) -> None:
    reassembly = Reassembly()
    held = 0
    for number, size, byte in pieces:
        piece = Piece(bytes((byte,)) * size, b"")
        whole, given_up = reassembly.take(Address.numbered(number), B, piece, 0.0)
        held += size - (len(whole.payload) if whole else 0) - sum(len(lost.payload) for lost in given_up)
        assert 0 <= held <= MOST_MESSAGES * (LONGEST_MESSAGE + LONGEST_PAYLOAD)
    assert sum(len(lost.payload) for lost in reassembly.expire(REASSEMBLY_S)) == held

"""The carga of complex packets: its fields, and messages too long for one packet (PSIU HEXA 1.3).

A complex carga says how many fields it has, how long each is, then the fields. More than 251
bytes travel as full packets and a shorter last one; an empty one follows where the last piece
would be full. The head of the first piece tells the whole length, so a full packet that is
complete by itself is never taken for the first piece of something longer.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Final, NamedTuple

from psiu_broker.errors import EncodeError
from psiu_broker.frame import Address

LONGEST_PAYLOAD: Final = 251
"""Bytes of carga that one packet can carry."""

LONGEST_MESSAGE: Final = 1 + 255 + 255 * 255
"""Bytes of the longest complex carga: 255 fields of 255 bytes."""

REASSEMBLY_S: Final = 1.0
"""A message whose next piece stays away so long is given up."""

MOST_MESSAGES: Final = 16
"""How many messages may be under way at once; one more pushes out the oldest."""


def fields(payload: bytes) -> list[bytes] | None:
    """The fields of a complex carga; None if count and sizes do not add up to its length."""
    if not payload or not payload[0] or _length(payload) != len(payload):
        return None
    count = payload[0]
    ends = [1 + count]
    for size in payload[1 : 1 + count]:
        ends.append(ends[-1] + size)
    return [payload[start:end] for start, end in pairwise(ends)]


def join_fields(parts: Sequence[bytes]) -> bytes:
    """The complex carga of 1–255 fields of 0–255 bytes each, the inverse of `fields`.

    Raises:
        EncodeError: too many, none, too long, or so short together that the packet would read as a node's.
    """
    if not 1 <= len(parts) <= 255:
        raise EncodeError(f"a complex packet has 1–255 fields, not {len(parts)}")
    for part in parts:
        if len(part) > 255:
            raise EncodeError(f"a field has at most 255 bytes, not {len(part)}")
    payload = bytes((len(parts), *map(len, parts))) + b"".join(parts)
    if len(payload) < 3:
        raise EncodeError("one empty field makes a packet of two bytes, which would be read as a node's")
    return payload


def _length(payload: bytes | bytearray) -> int | None:
    """How long the complex carga that begins with `payload` claims to be; None while its head is not all there."""
    head = 1 + payload[0]
    return head + sum(payload[1:head]) if len(payload) >= head else None


def _begins(payload: bytes) -> bool:
    """Whether a full packet is only the first piece of what its head promises."""
    return len(payload) == LONGEST_PAYLOAD and ((length := _length(payload)) is None or length > LONGEST_PAYLOAD)


def split(payload: bytes) -> list[bytes]:
    """`payload` in the pieces in which it travels: full ones, and always a shorter one last.

    Raises:
        EncodeError: it is longer than one packet and no complex carga, or too long for that.
    """
    if len(payload) < LONGEST_PAYLOAD:
        return [payload]
    if fields(payload) is None:
        raise EncodeError(f"{len(payload)} bytes that are no fields cannot be broken into packets")
    if len(payload) == LONGEST_PAYLOAD:
        return [payload]
    return [payload[at : at + LONGEST_PAYLOAD] for at in range(0, len(payload) + 1, LONGEST_PAYLOAD)]


class Piece(NamedTuple):
    """A message, whole or so far: its carga and the bytes on the wire."""

    payload: bytes
    wire: bytes


class _Message:
    __slots__ = ("payload", "touched", "wire")

    def __init__(self, now: float) -> None:
        self.payload = bytearray()
        self.wire = bytearray()
        self.touched = now


class Reassembly:
    """Messages under way, each between one source and one destination; holds at most `MOST_MESSAGES`."""

    def __init__(self) -> None:
        self._messages: dict[tuple[Address, Address], _Message] = {}

    def __bool__(self) -> bool:
        return bool(self._messages)

    def take(self, source: Address, destination: Address, piece: Piece, now: float) -> tuple[Piece | None, list[Piece]]:
        """What `piece` completes (itself, if it is whole; None if more must come), and what had to be given up."""
        given_up = self.expire(now)
        pair = (source, destination)
        message = self._messages.get(pair)
        if message is None:
            if not _begins(piece.payload):
                return piece, given_up
            if len(self._messages) >= MOST_MESSAGES:
                oldest = min(self._messages, key=lambda pair: self._messages[pair].touched)
                given_up.append(self._give_up(oldest))
            message = self._messages[pair] = _Message(now)
        message.payload += piece.payload
        message.wire += piece.wire
        message.touched = now
        claimed = _length(message.payload)
        last = len(piece.payload) < LONGEST_PAYLOAD
        if last and claimed == len(message.payload):
            del self._messages[pair]
            return Piece(bytes(message.payload), bytes(message.wire)), given_up
        if last or (claimed is not None and claimed < len(message.payload)):
            given_up.append(self._give_up(pair))
        return None, given_up

    def expire(self, now: float) -> list[Piece]:
        """Give up every message whose next piece has stayed away for `REASSEMBLY_S`."""
        if not self._messages:
            return []
        late = [pair for pair, message in self._messages.items() if now - message.touched >= REASSEMBLY_S]
        return [self._give_up(pair) for pair in late]

    def _give_up(self, pair: tuple[Address, Address]) -> Piece:
        message = self._messages.pop(pair)
        return Piece(bytes(message.payload), bytes(message.wire))

"""One frame on its way from broker to broker, as bytes.

What the robot said travels, not its wire: the codec of the last link writes the frame anew, so
that no broker can put bytes on another's radio that are no frame.
"""

import struct
from collections.abc import Callable, Mapping
from typing import Final, NamedTuple

from psiu_broker.codecs import psiu_ascii, psiu_hexa
from psiu_broker.errors import EncodeError
from psiu_broker.frame import Address, Frame
from psiu_broker.protocols import PROTOCOLS

VERSION: Final = 2
LONGEST: Final = 65_535

_HEADER: Final = struct.Struct(">BQQQQIhhH")
_MARK: Final = "\0"


class Envelope(NamedTuple):
    """A frame, and what the receiving broker must know of its way."""

    epoch: int
    """Which life of the sending broker this is: a random 64-bit number."""
    to_epoch: int
    """For which life of the receiving broker it is meant."""
    sequence: int
    """The place in the series from the one to the other, of one lane, in these lives; counts from 1."""
    sent_us: int
    """What the sender's steady clock read, in microseconds."""
    age_ms: int
    """How long the frame had waited at the sender."""
    frame: Frame


def pack(envelope: Envelope) -> bytes:
    """The bytes of `envelope`.

    Raises:
        EncodeError: a name that cannot be carried, or too much of it all.
    """
    frame = envelope.frame
    source, destination = frame.source, frame.destination
    texts = (frame.protocol, source.name, source.domain, destination.name, destination.domain, frame.subject)
    if any(_MARK in text for text in texts):
        raise EncodeError("a name with a NUL in it cannot be sent to another broker")
    words = _MARK.join(texts).encode("utf-8", "surrogatepass")
    if len(words) + len(frame.payload) > LONGEST:
        raise EncodeError(f"a frame of {len(frame.payload)} bytes is too long for another broker")
    try:
        header = _HEADER.pack(
            VERSION,
            envelope.epoch,
            envelope.to_epoch,
            envelope.sequence,
            envelope.sent_us,
            min(max(envelope.age_ms, 0), 0xFFFFFFFF),
            source.number,
            destination.number,
            len(words),
        )
    except struct.error as error:
        raise EncodeError(f"an envelope cannot say this: {error}") from error
    return header + words + frame.payload


def unpack(data: bytes) -> Envelope | None:
    """What `pack` made; None for anything else. Never raises."""
    if len(data) < _HEADER.size or data[0] != VERSION:
        return None
    _, epoch, to_epoch, sequence, sent_us, age_ms, source, destination, length = _HEADER.unpack_from(data)
    start = _HEADER.size + length
    try:
        texts = data[_HEADER.size : start].decode("utf-8").split(_MARK)
        protocol, source_name, source_domain, name, domain, subject = texts
    except ValueError:
        return None
    sender, receiver = Address(source_name, source, source_domain), Address(name, destination, domain)
    if len(data) < start or not (_can_be(sender) and _can_be(receiver)) or protocol not in PROTOCOLS:
        return None
    make = _MAKERS.get(protocol)
    frame = Frame(sender, receiver, subject, data[start:], protocol) if make is None else None
    if make is not None:
        frame = make(sender, receiver, data[start:])
    return None if frame is None else Envelope(epoch, to_epoch, sequence, sent_us, age_ms, frame)


def _can_be(address: Address) -> bool:
    """A name, or a number within a domain; neither is the source of a protocol that names none."""
    if address.name or address.number == -1:
        return address.number == -1 and not address.domain
    return 0 <= address.number <= 255


def _ascii(source: Address, destination: Address, payload: bytes) -> Frame | None:
    try:
        return psiu_ascii.message(source, destination, *payload.decode("ascii").split(" "))
    except UnicodeDecodeError:
        return None


_MAKERS: Final[Mapping[str, Callable[[Address, Address, bytes], Frame | None]]] = {
    "psiu-ascii": _ascii,
    "psiu-hexa": psiu_hexa.packet,
}

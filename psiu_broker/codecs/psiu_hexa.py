"""PSIU HEXA: packets of bytes for small processors, ended by one check byte.

    [source][destination][size][payload…][check]    ad-hoc
    [slave][size][payload…][check]                  master-slave (the slave, both ways)
    [size][payload…][check]                         point-to-point

How it is read. No byte says "here a packet begins": what does is the end of the one before, or a
silence. While that holds (*in step*), the size tells how many bytes belong to the packet, and the
check byte settles it. When a size is impossible, a check fails or a silence comes too early, the
step is lost: one byte is dropped and each following place is tried as a beginning. Such a
*find* is not trusted like a packet in step, because eight bits of check pass one wrong packet in
256; it must also be for a robot that is known, have a possible size and, if complex, fields that
add up. A point-to-point packet names nobody, so there only a silence restores the step.

A decision needs nothing but the bytes up to it, so however the stream is cut, the packets are the
same. What waits is at most one packet. However many finds cover a byte, it is looked at once for
all their CRCs (`crc_parts`); sums are so cheap that each is made anew.
"""

from collections.abc import Sequence
from functools import cache
from typing import ClassVar, Final, Literal

from pydantic import BaseModel, ConfigDict, Field

from psiu_broker.codecs.checksums import CHECKS, CRCS, CheckName
from psiu_broker.codecs.codec import Codec, Directory, Event
from psiu_broker.codecs.crc_parts import CrcParts
from psiu_broker.codecs.fragments import LONGEST_PAYLOAD, Piece, Reassembly, fields, join_fields, split
from psiu_broker.codecs.noise import Noise
from psiu_broker.errors import EncodeError
from psiu_broker.frame import MALFORMED_KEPT, NOBODY, Address, Frame, Malformed

__all__ = ["PsiuHexa", "fields", "join_fields", "packet"]

PROTOCOL: Final = "psiu-hexa"

_NAMED: Final = {65: "ack", 78: "nak", 66: "busy", 63: "available", 70: "free", 87: "wtf"}
_COMMANDS: Final = tuple(_NAMED.get(byte, f"command/{byte}") for byte in range(256))
_NODES: Final = tuple(f"node/{node}" for node in range(256))
_CARRIED: Final = {"ad-hoc": 2, "master-slave": 1, "point-to-point": 0}

BAD_CHECK: Final = "crc"
"""The reason of a `Malformed` whose check byte was wrong: what a NAK is for."""

_BAD_SIZE: Final = "size"
_UNFINISHED: Final = "unfinished"
_BAD_FRAGMENTS: Final = "fragments"

# Frame(...) goes through a Python function; this is the same without it, on the path that every packet takes.
_make = tuple.__new__


@cache
def _addresses(domain: str) -> tuple[Address, ...]:
    return tuple(Address.numbered(number, domain) for number in range(256))


def _subject(payload: bytes) -> str:
    if len(payload) == 2:
        return _NODES[payload[0]]
    if len(payload) == 1:
        return _COMMANDS[payload[0]]
    return "complex" if payload else "ping"


def packet(source: Address, destination: Address, payload: bytes) -> Frame:
    """A packet of our own, to be encoded: 0 bytes a ping, 1 a command, 2 node and signal, more a complex one."""
    return Frame(source, destination, _subject(payload), payload, PROTOCOL)


class PsiuHexa(Codec):
    """One stream of PSIU HEXA packets."""

    protocol: ClassVar[str] = PROTOCOL

    class Options(BaseModel):
        """What the user may write for a PSIU HEXA link."""

        model_config = ConfigDict(extra="forbid", frozen=True)

        topology: Literal["ad-hoc", "master-slave", "point-to-point"] = Field(
            "ad-hoc", description="which addresses a packet carries: source and destination, the slave's, or none"
        )
        size: Literal["nominal", "real"] = Field(
            "nominal", description="what the size byte counts: payload + 4 always, or the bytes on the wire"
        )
        crc: CheckName = Field("smbus", description="how the check byte is made; none: packets have no check byte")
        resync: bool = Field(True, description="after a bad packet search for the next; false: wait for a silence")
        fragment: bool = Field(False, description="break and rejoin complex messages of more than 251 bytes")
        silence_ms: int = Field(20, ge=20, description="a silence this long ends a packet; at least 3.5 characters")
        domain: str = Field("", pattern=r"^[A-Za-z0-9_-]*$", description="whose addresses these are, such as a team")
        local: int = Field(0, ge=0, le=255, description="our own address, also where packets carry none")
        remote: int | None = Field(None, ge=0, le=255, description="the robot at the far end of a point-to-point link")

    def __init__(self, options: Options, directory: Directory, *, datagrams: bool = False) -> None:
        self.options = options
        self.silence_s = options.silence_ms / 1000
        self.dialect = "/".join(filter(None, (PROTOCOL, options.topology, options.size, options.crc, options.domain)))
        self._heard_dialect = self.dialect if options.topology == "ad-hoc" else f"{self.dialect}/heard"
        self._check = CHECKS[options.crc]
        self._parts = CrcParts(CRCS[options.crc]) if options.crc in CRCS else None
        """What is begun, while finds are looked for in it."""
        self._carried = _CARRIED[options.topology]
        self._end = None if self._check is None else -1
        """Where in a packet the payload ends."""
        around = self._carried + (1 if self._check is None else 2)
        """Bytes of a packet besides its payload."""
        self._least = 4 if options.size == "nominal" else around
        self._most = self._least + LONGEST_PAYLOAD
        self._beyond = around - self._least
        """What the size byte lacks to the bytes on the wire; negative where it counts absent addresses."""
        self._addresses = _addresses(options.domain)
        self._local = self._addresses[options.local]
        self._remote = NOBODY if options.remote is None else self._addresses[options.remote]
        self._directory = directory
        self._reassembly = Reassembly() if options.fragment else None
        self._begun = b""
        self._reason = ""
        """Why the step was lost; empty while in step."""
        self._noise = Noise()

    def decode(self, data: bytes, now: float) -> Sequence[Event]:
        """The packets that `data` completes, and in one `Malformed` each run of bytes between them (PSIU HEXA 1)."""
        if not self.pending:
            # One whole packet and nothing else: what nearly every datagram and most reads are.
            carried = self._carried
            length = len(data)
            if (
                length > carried
                and data[carried] + self._beyond == length
                and self._least <= data[carried] <= self._most
                and ((check := self._check) is None or check(data[:-1]) == data[-1])
            ):
                frame = self._frame(bytes(data))
                return [frame] if self._reassembly is None else self._joined(self._reassembly, frame, now)
        events: list[Event] = []
        self._search(data, events, now, closed=False)
        return events

    def flush(self, now: float) -> Sequence[Event]:
        """Give up what was begun, after a search for packets inside it; whatever follows is in step."""
        events: list[Event] = []
        if self.pending:
            self._search(b"", events, now, closed=True)
        if self._reassembly:
            events += self._given_up(self._reassembly.expire(now))
        return events

    def encode(self, frame: Frame) -> bytes:
        """The packet of `frame`; all its packets, one behind the other, if it must be broken.

        Raises:
            EncodeError: it is of another protocol, too long, or an address has no place in this topology and domain.
        """
        if frame.dialect == self.dialect and frame.wire:
            return frame.wire
        if frame.protocol != PROTOCOL:
            raise EncodeError(f"a frame of {frame.protocol or 'no protocol'} cannot be sent as {PROTOCOL}")
        head = self._head(frame)
        if self._reassembly is not None:
            return b"".join(self._packet(head, piece) for piece in split(frame.payload))
        if len(frame.payload) > LONGEST_PAYLOAD:
            raise EncodeError(f"{len(frame.payload)} bytes are more than a packet holds (251); set fragment = true")
        return self._packet(head, frame.payload)

    def _packet(self, head: bytes, payload: bytes) -> bytes:
        body = b"%b%c%b" % (head, len(payload) + self._least, payload)
        return body if self._check is None else b"%b%c" % (body, self._check(body))

    def _head(self, frame: Frame) -> bytes:
        if self._carried == 0:
            if self._remote is not NOBODY and frame.destination != self._remote:
                raise EncodeError(f"only {self._remote} is at the end of this link, not {frame.destination}")
            return b""
        destination = self._number(frame.destination)
        if self._carried == 1:
            return bytes((destination,))
        return bytes((self._number(frame.source), destination))

    def _number(self, address: Address) -> int:
        if not 0 <= address.number <= 255:
            raise EncodeError(f"{str(address) or 'nobody'} has no PSIU HEXA address")
        if address.domain != self.options.domain:
            raise EncodeError(
                f"{address} is not in the domain {self.options.domain or '(the default one)'} of this link"
            )
        return address.number

    def _frame(self, wire: bytes) -> Frame:
        carried = self._carried
        payload = wire[carried + 1 : self._end]
        if carried == 2:
            source = self._addresses[wire[0]]
            destination = self._addresses[wire[1]]
        else:
            source = self._addresses[wire[0]] if carried else self._remote
            destination = self._local
        return _make(Frame, (source, destination, _subject(payload), payload, PROTOCOL, wire, self._heard_dialect, ""))

    def _search(self, data: bytes, events: list[Event], now: float, *, closed: bool) -> None:
        """Read on from where the last call stopped; if `closed`, to the end, and be in step afterwards."""
        buffer = self._begun + data
        carried, beyond, check = self._carried, self._beyond, self._check
        at = dropped = 0
        end = len(buffer)
        while at < end:
            lost = bool(self._reason)
            if lost:
                at = self._next_find(buffer, at, closed=closed)
                if at == end:
                    break
            reason = _UNFINISHED
            if end - at > carried:
                size = buffer[at + carried]
                length = size + beyond
                if not self._least <= size <= self._most:
                    reason = _BAD_SIZE
                elif end - at >= length:
                    wire = buffer[at : at + length]
                    if self._is_find(buffer, at, wire) if lost else check is None or check(wire[:-1]) == wire[-1]:
                        self._noise.add(buffer[dropped:at], events)
                        self._noise.end(self._reason, events)
                        self._reason = ""
                        frame = self._frame(wire)
                        events += (frame,) if self._reassembly is None else self._joined(self._reassembly, frame, now)
                        at = dropped = at + length
                        continue
                    reason = BAD_CHECK
                elif not closed:
                    break
            elif not closed:
                break
            self._reason = self._reason or reason
            at += 1
        self._noise.add(buffer[dropped:at], events)
        self._begun = buffer[at:]
        if self._parts is not None:
            self._parts.forget(at)
        if closed:
            self._noise.end(self._reason, events)
            self._reason = ""
        self.pending = bool(self._begun or self._reason)

    def _next_find(self, buffer: bytes, at: int, *, closed: bool) -> int:
        """Where, from `at` on, a packet of a possible size for (or from) a known robot begins, or may yet."""
        carried, least, most = self._carried, self._least, self._most
        if not carried or not self.options.resync:
            return len(buffer)
        addressed = carried - 1
        numbers = self._directory.numbers
        # In master-slave the address is the slave's, so ours says nothing.
        local = self.options.local if addressed else -1
        for place in range(at, len(buffer) - carried):
            if least <= buffer[place + carried] <= most:
                number = buffer[place + addressed]
                if number in numbers or number == local:
                    return place
        return len(buffer) if closed else max(at, len(buffer) - carried)

    def _is_find(self, buffer: bytes, at: int, wire: bytes) -> bool:
        """Whether what may be the packet `wire`, which begins at `at`, is one although the step is lost."""
        if self._parts is not None:
            right = self._parts.of(buffer, at, at + len(wire) - 1) == wire[-1]
        else:
            right = self._check is None or self._check(wire[:-1]) == wire[-1]
        return right and not self._is_odd(wire)

    def _is_odd(self, wire: bytes) -> bool:
        """Whether a find is a complex packet whose fields do not add up; pieces of a longer message never do."""
        payload = wire[self._carried + 1 : self._end]
        return len(payload) > 2 and self._reassembly is None and fields(payload) is None

    def _joined(self, reassembly: Reassembly, frame: Frame, now: float) -> list[Event]:
        piece = Piece(frame.payload, frame.wire)
        whole, given_up = reassembly.take(frame.source, frame.destination, piece, now)
        events = self._given_up(given_up)
        if whole is piece:
            events.append(frame)
        elif whole is not None:
            # Not our own dialect: a link that breaks messages differently, or not at all, must encode it anew.
            dialect = f"{self._heard_dialect}/pieces"
            joined = frame._replace(subject="complex", payload=whole.payload, wire=whole.wire, dialect=dialect)
            events.append(joined)
        return events

    @staticmethod
    def _given_up(pieces: list[Piece]) -> list[Event]:
        return [Malformed(_BAD_FRAGMENTS, wire[:MALFORMED_KEPT], len(wire)) for _, wire in pieces]

"""Packets of robot soccer teams: a start byte, the same number of bytes for each robot, and a trailer.

    AA   3E 3E   FC 7E   03 03   55
    start  1       2       3     end

RoboFEI's protocol, and those that its authors compare with it, differ only in what `Soccer.Options`
declares; presets name the teams. Nobody is addressed: the share of robot a begins at byte
n·a − (n − 1) of the data, which are counted from 1 as robots are. Nobody answers.

How it is read. What comes before a start byte is ignored, then bytes are counted; where the end
byte should be, another one means that step was lost, and the search goes on from the next start
byte behind the failed one. A fill byte may have any value. Where bytes carry check bits, a share
with a wrong one is dropped and the others count: each robot reads its own. A silence of five
characters drops what was begun.

Every frame of a packet has the whole packet as its `wire`. If not one share is right the packet is
one `Malformed`. At most one packet is held, and each byte is looked at once.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Final, Literal, NamedTuple, Self, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator, model_validator

from psiu_broker.codecs.codec import Directory, Event
from psiu_broker.codecs.noise import NOISE, Noise
from psiu_broker.codecs.paced import PacedCodec, Rest, Share
from psiu_broker.errors import EncodeError
from psiu_broker.frame import MALFORMED_KEPT, NOBODY, Address, Frame, Malformed

__all__ = ["LIMITS", "PRESETS", "Soccer", "byte_of", "first_byte", "hold_trouble", "rate_trouble", "value_of"]

PROTOCOL: Final = "soccer"

WHEELS: Final = "rodas"
"""The subject of a share that is the speeds of the left and the right wheel."""
BYTES: Final = "bytes"
"""The subject of any other share."""
STOP: Final = "pare"
"""The subject of a set-point of ours that stops a robot; it is heard as what its bytes say."""

BITS_A_BYTE: Final = 10
SILENCE_CHARACTERS: Final = 5

_BAD_CHECK: Final = "check"
_BAD_END: Final = "end"
_UNFINISHED: Final = "unfinished"

ByteCodec = Literal["raw", "int8", "mirosot"]
Preset = Literal["mirosot", "f180", "guarana", "cendori", "plymouth"]


class Limits(NamedTuple):
    """The values that one byte can say."""

    low: int
    high: int

    def __str__(self) -> str:
        return f"{self.low} to {self.high}" if self.low < 0 else f"{self.low}–{self.high}"


LIMITS: Final[Mapping[ByteCodec, Limits]] = {
    "raw": Limits(0, 255),
    "int8": Limits(-128, 127),
    "mirosot": Limits(-31, 31),
}

PRESETS: Final[Mapping[Preset, Mapping[str, Any]]] = {
    "mirosot": {"robots": 3, "bytes_per_robot": 2, "byte_codec": "mirosot", "baud": 19200, "rate_hz": 30},
    "f180": {"robots": 5, "bytes_per_robot": 4, "byte_codec": "raw", "baud": 19200, "rate_hz": 30},
    "guarana": {
        "robots": 3, "bytes_per_robot": 1, "byte_codec": "raw", "trailer": "fill", "baud": 1200, "rate_hz": 24,
    },
    "cendori": {
        "robots": 5, "bytes_per_robot": 3, "byte_codec": "raw", "trailer": "fill", "baud": 2000, "rate_hz": 11,
    },
    "plymouth": {"robots": 1, "bytes_per_robot": 3, "byte_codec": "raw", "baud": 38400, "rate_hz": 30},
}  # fmt: skip
"""What the teams of RoboFEI's paper declare. The rate is 30 Hz, a packet for each picture of the camera, or what the
line carries."""


def _wheel_byte(speed: int) -> int:
    """Bit 7 the direction, bits 6–2 the speed, bit 1 the inverse of bit 7, bit 0 that of bit 3 (RoboFEI 3.2.1)."""
    reverse = speed < 0
    data = reverse << 7 | abs(speed) << 2
    return data | (not reverse) << 1 | (not data >> 3 & 1)


_WHEEL_BYTES: Final = tuple(map(_wheel_byte, range(-31, 32)))
_BACKWARDS_AT_0: Final = 0x81
_SPEEDS: Final = {_BACKWARDS_AT_0: 0} | {byte: speed for speed, byte in enumerate(_WHEEL_BYTES, -31)}


def byte_of(value: int, byte_codec: ByteCodec) -> int:
    """The byte that says `value`, which lies within `LIMITS`."""
    return _WHEEL_BYTES[value + 31] if byte_codec == "mirosot" else value & 0xFF


def value_of(byte: int, byte_codec: ByteCodec) -> int | None:
    """What `byte` says; None where its check bits are wrong."""
    if byte_codec == "mirosot":
        return _SPEEDS.get(byte)
    return byte - 256 if byte_codec == "int8" and byte > 127 else byte


def first_byte(robot: int, bytes_per_robot: int) -> int:
    """Which byte of the data, counted from 1, is the first of `robot`, counted from 1 (RoboFEI 3.2, INDICE)."""
    return bytes_per_robot * robot - (bytes_per_robot - 1)


class Soccer(PacedCodec):
    """One stream of one team's packets."""

    protocol: ClassVar[str] = PROTOCOL
    addressed = False

    class Options(BaseModel):
        """What the user may write for a link to a soccer team; what is left out is the preset's."""

        model_config = ConfigDict(extra="forbid", frozen=True)

        preset: Preset = Field("mirosot", description="whose packets they are; every option below may differ from it")
        robots: int = Field(3, ge=1, le=255, description="how many robots a packet has a share for, numbered from 1")
        bytes_per_robot: int = Field(2, ge=1, le=64, description="bytes of each robot's share")
        byte_codec: ByteCodec = Field(
            "mirosot", description="what a byte says: 0–255, -128 to 127, or a wheel's speed -31 to 31 with check bits"
        )
        start: int = Field(0xAA, ge=0, le=255, description="the byte that begins a packet")
        trailer: Literal["end", "fill", "none"] = Field(
            "end", description="what follows the shares: the end byte, a byte without a meaning, or nothing"
        )
        end: int = Field(0x55, ge=0, le=255, description='the byte that ends a packet, with trailer = "end"')
        fill: int = Field(0x00, ge=0, le=255, description='the last byte of a packet, with trailer = "fill"')
        baud: int = Field(19200, ge=1, description="bits a second that the robots listen at")
        rate_hz: float = Field(
            30.0, gt=0, le=1000, allow_inf_nan=False, description="packets a second; guarana 24, cendori 11"
        )
        hold_s: float = Field(
            0.5, gt=0, le=3600, allow_inf_nan=False,
            description="how long a robot goes on with what it was told last; then it is told to stop",
        )  # fmt: skip
        steady: bool = Field(
            True, description="send from the moment the link opens; false: from the first command to any robot on"
        )
        silence_ms: int = Field(
            5, ge=5, description="a silence this long, and of five characters, ends a packet that is heard"
        )

        @model_validator(mode="before")
        @classmethod
        def _as_preset(cls, data: Any) -> Any:
            if not isinstance(data, dict):
                return data
            preset = data.get("preset", "mirosot")
            return {**PRESETS[preset], **data} if preset in get_args(Preset) else data

        @field_validator("start", "end")
        @classmethod
        def _is_no_data(cls, byte: int, info: ValidationInfo) -> int:
            if info.data.get("byte_codec") != "mirosot":
                return byte
            if info.field_name == "end" and info.data.get("trailer") != "end":
                return byte
            speed = value_of(byte, "mirosot")
            if speed is not None:
                usual = "0xAA" if info.field_name == "start" else "0x55"
                raise ValueError(
                    f"0x{byte:02X} is also the mirosot byte of a wheel at speed {speed}, so that robots could not tell"
                    f" them apart; choose a byte that is none, {usual} is usual"
                )
            return byte

        @model_validator(mode="after")
        def _holds_long_enough(self) -> Self:
            trouble = hold_trouble(self.hold_s, self.rate_hz)
            if trouble is not None:
                raise ValueError(f"{trouble}; raise one of them")
            return self

        @property
        def packet_bytes(self) -> int:
            """The length of a packet."""
            return 1 + self.robots * self.bytes_per_robot + (self.trailer != "none")

        @property
        def stop(self) -> bytes:
            """The share of a robot that stands still, unless told otherwise: every value 0."""
            return bytes((byte_of(0, self.byte_codec),)) * self.bytes_per_robot

        @property
        def subject(self) -> str:
            """What the frames are called that are heard."""
            return WHEELS if self.byte_codec == "mirosot" and self.bytes_per_robot == 2 else BYTES

    def __init__(
        self, options: Options | None = None, directory: Directory | None = None, *, datagrams: bool = False
    ) -> None:
        options = options or Soccer.Options()
        self.options = options
        self.robots = options.robots
        self.rate_hz = options.rate_hz
        self.steady = options.steady
        self.rest = Rest(options.stop, options.hold_s)
        self.silence_s = max(options.silence_ms / 1000, SILENCE_CHARACTERS * BITS_A_BYTE / options.baud)
        trailer = {"end": bytes((options.end,)), "fill": bytes((options.fill,)), "none": b""}[options.trailer]
        shape = f"{options.start:02x}-{options.robots}x{options.bytes_per_robot}-{options.trailer}{trailer.hex()}"
        self.dialect = f"{PROTOCOL}/{shape}/{options.byte_codec}"
        self._head = bytes((options.start,))
        self._trailer = trailer
        self._checked_end = options.end if options.trailer == "end" else None
        self._length = options.packet_bytes
        self._subject = options.subject
        self._addresses = tuple(map(Address.numbered, range(1, options.robots + 1)))
        self._buffer = bytearray()
        self._noise = Noise()
        self._reason = ""
        """Why the step was lost; empty while in step."""

    def decode(self, data: bytes, now: float) -> Sequence[Event]:
        """A frame for each robot of the packets that `data` completes, and what was between them."""
        events: list[Event] = []
        buffer, start, length = self._buffer, self.options.start, self._length
        buffer += data
        at, end = 0, len(buffer)
        while True:
            found = buffer.find(start, at)
            if found < 0:
                found = end
            if found > at:
                self._waste(buffer[at:found], NOISE, events)
                at = found
            if end - at < length:
                break
            if self._checked_end is not None and buffer[at + length - 1] != self._checked_end:
                self._waste(buffer[at : at + 1], _BAD_END, events)
                at += 1
                continue
            self._end_noise(events)
            self._take(bytes(buffer[at : at + length]), events)
            at += length
        del buffer[:at]
        self.pending = bool(buffer or self._noise.size)
        return events

    def flush(self, now: float) -> Sequence[Event]:
        """Give up what was begun."""
        events: list[Event] = []
        if self.pending:
            if self._buffer:
                self._waste(self._buffer, _UNFINISHED, events)
                self._buffer.clear()
            self._end_noise(events)
            self.pending = False
        return events

    def encode(self, frame: Frame) -> bytes:
        """The packet that tells one robot what `frame` says, and every other one to stop.

        Raises:
            EncodeError: it is no set-point of a robot of this team.
        """
        if frame.dialect == self.dialect and frame.wire:
            return frame.wire
        mine = self.share(frame)
        return self.packet([mine.payload if robot == mine.robot else self.rest.stop for robot in self._numbers])

    def share(self, frame: Frame) -> Share:
        if frame.protocol != PROTOCOL:
            raise EncodeError(f"a frame of {frame.protocol or 'no protocol'} cannot be sent as {PROTOCOL}")
        robot = frame.destination.number
        if robot not in self._numbers:
            name = str(frame.destination) or "nobody"
            raise EncodeError(f"{name} is not in this team, whose robots are 1–{self.robots}")
        if frame.dialect and frame.dialect.rpartition("/")[2] != self.options.byte_codec:
            raise EncodeError(f"bytes of {frame.dialect} do not mean the same as {self.options.byte_codec} ones")
        self._check(frame.payload)
        return Share(robot, frame.payload)

    def packet(self, shares: Sequence[bytes]) -> bytes:
        if len(shares) != self.robots:
            raise EncodeError(f"a packet has shares for {self.robots} robots, not {len(shares)}")
        for share in shares:
            self._check(share)
        return b"".join((self._head, *shares, self._trailer))

    @property
    def _numbers(self) -> range:
        return range(1, self.robots + 1)

    def _check(self, share: bytes) -> None:
        if len(share) != self.options.bytes_per_robot:
            raise EncodeError(f"a robot's share has {self.options.bytes_per_robot} bytes, not {len(share)}")
        if not self._is_right(share):
            raise EncodeError(f"0x{share.hex()}: its check bits are wrong, and robots would drop it")

    def _is_right(self, share: bytes) -> bool:
        return self.options.byte_codec != "mirosot" or all(byte in _SPEEDS for byte in share)

    def _take(self, wire: bytes, events: list[Event]) -> None:
        size = self.options.bytes_per_robot
        found: list[Event] = []
        right = False
        for address in self._addresses:
            first = first_byte(address.number, size)
            share = wire[first : first + size]
            if self._is_right(share):
                right = True
                found.append(Frame(NOBODY, address, self._subject, share, PROTOCOL, wire, self.dialect))
            else:
                found.append(Malformed(_BAD_CHECK, share, size))
        events += found if right else [Malformed(_BAD_CHECK, wire[:MALFORMED_KEPT], len(wire))]

    def _waste(self, data: bytearray, reason: str, events: list[Event]) -> None:
        self._reason = self._reason or reason
        self._noise.add(data, events)

    def _end_noise(self, events: list[Event]) -> None:
        self._noise.end(self._reason, events)
        self._reason = ""


def hold_trouble(hold_s: float, rate_hz: float) -> str | None:
    """Why set-points that hold for `hold_s` may be too old before they leave; None where all is well."""
    if hold_s * rate_hz >= 2:
        return None
    return f"hold_s = {hold_s:g} is shorter than two packets take at rate_hz = {rate_hz:g}, {2 / rate_hz:.3g} s"


def rate_trouble(options: Soccer.Options, bits_per_second: int | None) -> str | None:
    """Why a line of `bits_per_second` (None: no limit) cannot carry the packets at their rate; None if it can."""
    bits = options.packet_bytes * BITS_A_BYTE
    needed = options.rate_hz * bits
    if bits_per_second is None or needed <= bits_per_second:
        return None
    highest = bits_per_second / bits
    # Rounded down, or the advice would be refused in its turn.
    advice = int(highest) or int(highest * 1000) / 1000
    lower = f"lower rate_hz to {advice:g} or " if advice else ""
    return (
        f"{options.rate_hz:g} packets/s × {options.packet_bytes} bytes × {BITS_A_BYTE} bits = {needed:.10g} bit/s,"
        f" the line carries {bits_per_second}; {lower}use a line of at least {-int(-needed // 1)} bit/s"
    )

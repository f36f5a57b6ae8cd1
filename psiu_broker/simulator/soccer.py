"""Simulated robots of a soccer team, which read packets as the paper's robots do and never say a word."""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final, Literal, Self, get_args

from psiu_broker.simulator.robot import Heard, Reply, Robot

ByteCodec = Literal["raw", "int8", "mirosot"]
Trailer = Literal["end", "fill", "none"]

PATIENCE_S: Final = 0.05
"""A packet that stops this long in the middle is forgotten."""

TEAMS: Final[Mapping[str, Mapping[str, Any]]] = MappingProxyType(
    {
        "mirosot": {"robots": 3, "bytes_per_robot": 2, "byte_codec": "mirosot", "trailer": "end"},
        "f180": {"robots": 5, "bytes_per_robot": 4, "byte_codec": "raw", "trailer": "end"},
        "guarana": {"robots": 3, "bytes_per_robot": 1, "byte_codec": "raw", "trailer": "fill"},
        "cendori": {"robots": 5, "bytes_per_robot": 3, "byte_codec": "raw", "trailer": "fill"},
        "plymouth": {"robots": 1, "bytes_per_robot": 3, "byte_codec": "raw", "trailer": "end"},
    }
)
"""The robots of the teams that the paper names."""


class SoccerRobot(Robot):
    """Robot `address`, counted from 1, of a team whose packets have that many `robots`.

    `wheels` is what it does now: a value for each of its bytes. `travelled` is the sum of that over
    time, wheel by wheel. It goes on until it is told otherwise, or, with `stop_after_s`, until
    nothing that it understands has come for so long. `packets` counts what it understood; `dropped`
    packets without their end byte or cut short by a silence, and shares of its own whose check bits are wrong.
    """

    protocol = "soccer"

    def __init__(  # noqa: PLR0913
        self,
        address: int,
        *,
        robots: int = 3,
        bytes_per_robot: int = 2,
        byte_codec: ByteCodec = "mirosot",
        start: int = 0xAA,
        trailer: Trailer = "end",
        end: int = 0x55,
        patience_s: float = PATIENCE_S,
        stop_after_s: float | None = None,
    ) -> None:
        """Make the robot.

        Raises:
            ValueError: a number is out of range, or an option has no such value.
        """
        super().__init__()
        if not 1 <= address <= robots <= 255:
            raise ValueError(f"an address is 1–{robots}, one of the robots of the team, not {address}")
        if bytes_per_robot < 1 or not 0 <= start <= 255 or not 0 <= end <= 255:
            raise ValueError("a robot has at least one byte, and the bytes of a packet are 0–255")
        for what, value, known in (("byte codec", byte_codec, ByteCodec), ("trailer", trailer, Trailer)):
            if value not in get_args(known):
                raise ValueError(f"there is no {what} {value!r} (known: {', '.join(get_args(known))})")
        self.name = f"0x{address:02x}"
        self.address = address
        self.wheels: tuple[int, ...] = (0,) * bytes_per_robot
        self.travelled: tuple[float, ...] = (0.0,) * bytes_per_robot
        self.packets = 0
        self.dropped = 0
        self.last_packet = -math.inf
        """When it last understood one."""
        self._index = bytes_per_robot * address - (bytes_per_robot - 1)
        self._bytes = bytes_per_robot
        self._total = robots * bytes_per_robot
        self._byte_codec = byte_codec
        self._start = start
        self._trailer = trailer
        self._end = end
        self._patience_s = patience_s
        self._stop_after_s = stop_after_s
        self._received: bytearray | None = None
        """The data of the packet so far; None while waiting for a start byte."""
        self._last_byte = -math.inf
        self._moved_at: float | None = None

    @classmethod
    def team(cls, preset: str, **options: Any) -> list[Self]:
        """All the robots of one of `TEAMS`; `options` are those of each, and go before its own.

        Raises:
            ValueError: there is no such team, or an option is wrong.
        """
        if preset not in TEAMS:
            raise ValueError(f"there is no team {preset!r} (known: {', '.join(TEAMS)})")
        shape = {**TEAMS[preset], **options}
        return [cls(address, **shape) for address in range(1, shape["robots"] + 1)]

    def receive(self, data: bytes, now: float) -> list[Reply]:
        if self._received is not None and now - self._last_byte > self._patience_s:
            self._drop()
        self._last_byte = now
        for byte in data:
            self._take(byte, now)
        return []

    def boundary(self) -> None:
        if self._received is not None:
            self._drop()

    def hello(self) -> bytes:
        """Nothing: it only listens."""
        return b""

    def telemetry(self) -> bytes:
        """Nothing."""
        return b""

    def advance(self, now: float) -> None:
        """Let the wheels have turned until `now`."""
        began = now if self._moved_at is None else self._moved_at
        stops = now if self._stop_after_s is None else min(now, self.last_packet + self._stop_after_s)
        moved_s = max(0.0, stops - began)
        self.travelled = tuple(
            so_far + wheel * moved_s for so_far, wheel in zip(self.travelled, self.wheels, strict=True)
        )
        if stops < now:
            self.wheels = (0,) * self._bytes
        self._moved_at = now

    def _take(self, byte: int, now: float) -> None:
        if self._received is None:
            if byte == self._start:
                self._received = bytearray()
            return
        if len(self._received) < self._total:
            self._received.append(byte)
            if self._trailer != "none" or len(self._received) < self._total:
                return
        elif self._trailer == "end" and byte != self._end:
            self._drop()
            return
        received, self._received = self._received, None
        self._obey(received, now)

    def _obey(self, received: bytearray, now: float) -> None:
        mine = received[self._index - 1 : self._index - 1 + self._bytes]
        if self._byte_codec == "mirosot" and any(byte & 3 != _check_bits(byte) for byte in mine):
            self.dropped += 1
            return
        self.advance(now)
        self.wheels = tuple(self._value(byte) for byte in mine)
        self.packets += 1
        self.last_packet = now
        self.note(Heard(now, "", "rodas", tuple(map(str, self.wheels))))

    def _value(self, byte: int) -> int:
        if self._byte_codec == "mirosot":
            speed = byte >> 2 & 31
            return -speed if byte & 0x80 else speed
        return byte - 256 if self._byte_codec == "int8" and byte > 127 else byte

    def _drop(self) -> None:
        self._received = None
        self.dropped += 1


def _check_bits(byte: int) -> int:
    """Bit 1 is the inverse of bit 7, bit 0 that of bit 3."""
    return (~byte >> 7 & 1) << 1 | (~byte >> 3 & 1)

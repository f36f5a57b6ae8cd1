"""The check values of the protocols: the byte sum of PSIU ASCII and the eight-bit checks of PSIU HEXA."""

import functools
import operator
from collections.abc import Callable, Mapping
from typing import Final, Literal, NamedTuple
from zlib import adler32

Check = Callable[[bytes], int]
"""What makes one byte, 0–255, of any bytes before it."""

CheckName = Literal["smbus", "maxim-dow", "dvb-s2", "nrsc-5", "xor", "sum", "negsum", "none"]

_ADLER_EXACT: Final = 256


class Crc(NamedTuple):
    """An eight-bit CRC: what each byte makes of its state, and the first state."""

    table: tuple[int, ...]
    start: int = 0


def byte_sum(data: bytes) -> int:
    """The sum of all bytes, modulo 65536 (PSIU ASCII, CheckSum)."""
    if len(data) <= _ADLER_EXACT:
        # The low half of Adler-32 is 1 + the sum modulo 65521, which so few bytes cannot reach; half the time of sum().
        return (adler32(data) & 0xFFFF) - 1
    return sum(data) & 0xFFFF


def crc8_table(polynomial: int, *, reflected: bool = False) -> tuple[int, ...]:
    """The 256 remainders of one byte; a tuple, because indexing one is faster than indexing bytes.

    `polynomial` has its highest power first even where bits are taken lowest first (`reflected`).
    """
    if reflected:
        polynomial = int(f"{polynomial:08b}"[::-1], 2)
    return tuple(_remainder(byte, polynomial, reflected=reflected) for byte in range(256))


def _remainder(byte: int, polynomial: int, *, reflected: bool) -> int:
    for _ in range(8):
        if reflected:
            byte = (byte >> 1) ^ (polynomial if byte & 1 else 0)
        else:
            byte = ((byte << 1) & 0xFF) ^ (polynomial if byte & 0x80 else 0)
    return byte


def _crc8(crc: Crc) -> Check:
    table, start = crc

    def crc8(data: bytes) -> int:
        value = start
        for byte in data:
            value = table[value ^ byte]
        return value

    return crc8


def _xor(data: bytes) -> int:
    return functools.reduce(operator.xor, data, 0)


def _sum(data: bytes) -> int:
    return sum(data) & 0xFF


def _negsum(data: bytes) -> int:
    return -sum(data) & 0xFF


CRCS: Final[Mapping[CheckName, Crc]] = {
    "smbus": Crc(crc8_table(0x07)),
    "maxim-dow": Crc(crc8_table(0x31, reflected=True)),
    "dvb-s2": Crc(crc8_table(0xD5)),
    "nrsc-5": Crc(crc8_table(0x31), start=0xFF),
    "xor": Crc(tuple(range(256))),
}
"""Those of the checks that are CRCs, of which the exclusive or is the simplest."""

CHECKS: Final[Mapping[CheckName, Check | None]] = {
    **{name: _crc8(crc) for name, crc in CRCS.items()},
    "xor": _xor,
    "sum": _sum,
    "negsum": _negsum,
    "none": None,
}
"""What a PSIU HEXA packet may end in; None: in nothing, the packet has no check byte."""

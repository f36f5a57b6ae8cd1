"""The eight-bit CRCs of many parts of one text, in a time that does not depend on how long or how many they are.

A CRC is linear: what stands before a part changes the state behind it as it would were the part all zeros. So the
states behind each byte of the text tell the CRC of any part of it.
"""

from collections.abc import Sequence
from functools import cache
from typing import Final

from psiu_broker.codecs.checksums import Crc

LONGEST_PART: Final = 256


class CrcParts:
    """The CRCs of parts of a text that grows at its end and is forgotten at its beginning."""

    def __init__(self, crc: Crc) -> None:
        self._table, self._start = crc
        self._skips = _skips(crc.table)
        self._begin = 0
        """Where the last part began."""
        self._states = bytearray(1)
        """Before the byte there and behind it and each of the next; only how they differ counts."""

    def of(self, text: bytes, begin: int, end: int) -> int:
        """The CRC of ``text[begin:end]``, at most `LONGEST_PART` bytes; `begin` is never less than it last was."""
        states = self._states
        del states[: begin - self._begin]
        self._begin = begin
        if not states:
            states.append(0)
        known = begin + len(states) - 1
        if known < end:
            table = self._table
            state = states[-1]
            for byte in text[known:end]:
                state = table[state ^ byte]
                states.append(state)
        return states[end - begin] ^ self._skips[end - begin][states[0] ^ self._start]

    def forget(self, size: int) -> None:
        """The text loses its first `size` bytes, in which the last part began or which were before the next."""
        self._begin -= size


@cache
def _skips(table: tuple[int, ...]) -> Sequence[bytes]:
    """For each number of zeros the states behind them, by the state before them."""
    skips = [bytes(range(256))]
    for _ in range(LONGEST_PART):
        skips.append(skips[-1].translate(bytes(table)))
    return skips

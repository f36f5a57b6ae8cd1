"""How a small robot reads PSIU ASCII: word by word as the bytes come, judged by the sum alone.

It shares nothing with the broker's codec on purpose: a robot that had the broker's mistakes would
prove nothing about the broker.
"""

from collections.abc import Mapping
from typing import Final, NamedTuple

LONGEST_FRAME: Final = 999
CHECKSUM_DIGITS: Final = 5
_SPACE: Final = 0x20
_LINE_ENDS: Final = b"\r\n"


class Sentence(NamedTuple):
    """One frame in words; not `intact`: its checksum is wrong, and any word of it may be."""

    destination: str
    source: str
    command: str
    parameters: tuple[str, ...]
    intact: bool


class Ear:
    """Reads one line byte by byte.

    `parameter_counts` (of the robot's own commands) says where a checksum is due; in a frame of
    another command the first word of five digits counts as one. A word over `word_bytes` spoils
    the frame without a trace.
    """

    def __init__(
        self, parameter_counts: Mapping[str, int], *, ruined_by_crlf: bool, word_bytes: int, greatest_sum: int
    ) -> None:
        self._counts = parameter_counts
        self._ruined_by_crlf = ruined_by_crlf
        self._word_bytes = word_bytes
        self._greatest_sum = greatest_sum
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self._words: list[str] = []
        self._word = bytearray()
        self._sum = 0
        self._size = 0
        self._overflow = False

    def take(self, byte: int) -> Sentence | None:
        """The frame that `byte` completes, if it completes one."""
        if not self._size and (byte == _SPACE or byte in _LINE_ENDS):
            if self._ruined_by_crlf and byte != _SPACE:
                self._sum += byte
            return None
        self._size += 1
        if self._size > LONGEST_FRAME:
            self.forget()
            return None
        if byte == _SPACE:
            self._sum += sum(self._word) + _SPACE
            self._words.append(self._word.decode("latin-1"))
            self._word.clear()
            return None
        self._word.append(byte)
        self._overflow |= len(self._word) > self._word_bytes
        return self._judge() if len(self._word) == CHECKSUM_DIGITS and len(self._words) > 3 else None

    def _judge(self) -> Sentence | None:
        """Decide whether the five bytes of the last word are the checksum that ends a frame."""
        words = self._words
        place = next((i for i, word in enumerate(words) if i and len(word) == 3 and word.isdigit()), 1)
        if len(words) < place + 3:
            return None
        command = words[place + 1]
        digits = self._word.isdigit()
        intact = digits and int(self._word) == self._sum % 65536 and self._sum <= self._greatest_sum
        due = digits and len(words) >= place + 3 + self._counts.get(command, 0)
        ends_here = words[place] == f"{self._size:03d}"
        if not (intact or due or ends_here):
            return None
        overflow = self._overflow
        self.forget()
        if overflow:
            return None
        return Sentence(" ".join(words[:place]), words[-1], command, tuple(words[place + 2 : -1]), intact)

"""How a small robot reads PSIU ASCII: word by word as the bytes come, judged by the sum alone.

It shares nothing with the broker's codec on purpose: a robot that had the broker's mistakes would
prove nothing about the broker.
"""

import re
from abc import ABC, abstractmethod
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


class Ear(ABC):
    """Reads one line byte by byte."""

    @abstractmethod
    def forget(self) -> None:
        """Begin anew."""

    @abstractmethod
    def take(self, byte: int) -> Sentence | None:
        """The frame that `byte` completes, if it completes one."""


class WordEar(Ear):
    """Reads the document's form, whose parts have spaces between them.

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
        self._words: list[str] = []
        self._word = bytearray()
        self._sum = 0
        self._size = 0
        self._overflow = False

    def take(self, byte: int) -> Sentence | None:
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


class DraftEar(Ear):
    """Reads a draft: the name of the robot (or whoever a frame is for) and the size without a space between them.

    With a `sender`, the frames name none (draft 0) and are taken to come from that one.
    """

    def __init__(self, name: str, *, sender: str | None, ruined_by_crlf: bool, greatest_sum: int) -> None:
        self._own = (name, "??")
        self._head = re.compile(rf"({re.escape(name)}|\?\?|[^\d ]+)(\d{{3}})")
        self._sender = sender
        self._ruined_by_crlf = ruined_by_crlf
        self._greatest_sum = greatest_sum
        self.forget()

    def forget(self) -> None:
        self._text = ""
        self._ruin = 0

    def take(self, byte: int) -> Sentence | None:
        if byte in _LINE_ENDS:
            self.forget()
            self._ruin = byte if self._ruined_by_crlf else 0
            return None
        self._text = (self._text + chr(byte))[-LONGEST_FRAME:]
        digits = self._text[-CHECKSUM_DIGITS:]
        if len(digits) < CHECKSUM_DIGITS or not digits.isdigit():
            return None
        return self._judge(int(digits))

    def _judge(self, checksum: int) -> Sentence | None:
        """The first frame that ends here."""
        text = self._text
        for start in range(len(text) - CHECKSUM_DIGITS):
            head = self._head.match(text, start)
            if head is None:
                continue
            total = sum(text[start:-CHECKSUM_DIGITS].encode("latin-1")) + self._ruin
            intact = total % 65536 == checksum and total <= self._greatest_sum
            ends_here = head[1] in self._own and int(head[2]) == len(text) - start
            *words, sender = text[head.end() : -CHECKSUM_DIGITS].split(" ")
            if words and (intact or ends_here) and bool(sender) == (self._sender is None):
                self.forget()
                return Sentence(head[1], self._sender or sender, words[0], tuple(words[1:]), intact)
        return None

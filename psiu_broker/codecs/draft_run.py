"""Where the frames of the drafts of PSIU ASCII are in a run of printable bytes: those of 0.5 and, with no sender, of 0.

    MNERIM031parafrente 100 PC02024     0.5
    MNERIM029parafrente 100 01884       0

No space is around the size and, in 0.5, none before the checksum. So the size is where three
digits follow a known name; behind a name that nobody knows, where three digits tell the true
length. Only a known name's size claims the bytes behind it.
"""

import re
from collections.abc import Collection
from typing import Final

from psiu_broker.codecs.ascii_run import COMPLAINT_TEXT, Fit, Run
from psiu_broker.codecs.codec import Directory
from psiu_broker.frame import EVERYONE

LONGEST_NAME: Final = 64
"""Bytes of the longest destination in a frame of the drafts, so that a size is soon told from other digits."""

_SIZE: Final = re.compile(rb"(?=(\d{3}))\d")
_SPACE: Final = 0x20


class DraftRun(Run):
    """A run of frames of draft 0.5."""

    ENDING = re.compile(rb"(?=(\d{5}))\d|" + re.escape(COMPLAINT_TEXT))
    UNPADDED = re.compile(rb"(\d{4})\Z")

    def __init__(self, directory: Directory, *, strict: bool) -> None:
        super().__init__(strict=strict)
        self._directory = directory

    def name_end(self, text: bytes | bytearray, start: int, end: int) -> int | None:
        """Where in the frame from `start` to `end` the destination ends and the size begins."""
        known = unknown = None
        lengths = self._name_lengths()
        for size in _SIZE.finditer(text, start + 1, min(end, start + LONGEST_NAME + 3)):
            place = size.start()
            if text[place - 1] == _SPACE:
                continue
            is_known = place - start in lengths and self._is_known(text[start:place].decode("ascii", "replace"))
            if int(size[1]) == end - start:
                if is_known:
                    return place
                unknown = unknown or place
            elif is_known:
                known = known or place
        return known or unknown

    def size_field(self, text: bytes | bytearray, edge: int = 0, begin: int = 1) -> re.Match[bytes] | None:
        """The first three digits, from `begin` on, behind a known name that begins at `edge` or later."""
        names = self._directory.all_names
        lengths: Collection[int] = ()
        for size in _SIZE.finditer(text, begin):
            lengths = lengths or self._name_lengths()
            end = size.start()
            before = text[max(edge, end - LONGEST_NAME) : end].decode("ascii", "replace")
            if before.endswith(EVERYONE.name) or any(
                before[-length:] in names for length in lengths if length <= len(before)
            ):
                return size
        return None

    def _name_lengths(self) -> Collection[int]:
        """The lengths that known names have, or may have where there are so many names that all are worth a try."""
        names = self._directory.all_names
        if len(names) >= LONGEST_NAME:
            return range(1, LONGEST_NAME + 1)
        return {len(EVERYONE.name), *map(len, names)} - {0}

    def _is_known(self, name: str) -> bool:
        return name in self._directory.all_names or name == EVERYONE.name

    def _find_field(self) -> None:
        size = self.size_field(self.text, max(0, self._edge), max(0, self._fields_from))
        if size is None:
            self._fields_from = max(self._fields_from, len(self.text) - 2)
        else:
            self._field = size.start()
            self._claimed = self._field - 1 + int(size[1])

    def _fit(self, start: int, digits: int, end: int) -> Fit | None:
        text = self.text
        field = self.name_end(text, start, end)
        if field is None or text[field + 3] == _SPACE:
            return None
        tail = self._tail(field + 3, digits)
        exact = end - digits == 5 and int(text[field : field + 3]) == end - start
        if tail is None or not (exact or self._is_known(text[start:field].decode())):
            return None
        return Fit(start, field, tail, end, exact)

    def _tail(self, message: int, digits: int) -> int | None:
        """Where the sender ends, if there is one behind a message, which begins at `message`."""
        return digits if message < self.text.rfind(b" ", 0, digits) < digits - 1 else None


class SenderlessRun(DraftRun):
    """A run of frames of draft 0."""

    ENDING = Run.ENDING
    UNPADDED = Run.UNPADDED

    def _tail(self, message: int, digits: int) -> int | None:
        return digits - 1 if message < digits - 1 else None

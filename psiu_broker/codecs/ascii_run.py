"""Where the frames are in a run of printable bytes; the theory is told in `psiu_ascii`."""

import re
from bisect import bisect_left
from itertools import accumulate
from typing import ClassVar, Final, NamedTuple

LONGEST: Final = 999
"""Bytes of the longest frame: what three digits can say."""

COMPLAINT_TEXT: Final = b"CHECKSUM NAO BATEU!"

SIZE_FIELD: Final = re.compile(rb" (\d{3}) ")
CHECKSUM_FIELD: Final = re.compile(rb" (\d{5})")

_SPACE: Final = 0x20
_HELD: Final = 4096
_REACH: Final = 3 * LONGEST
"""A frame of 999 bytes, held back by a claim of 999, after noise of 999 that is still to be told apart."""


class Fit(NamedTuple):
    """A frame that may be, by its places in the text, or a complaint, whose `field` is -1."""

    start: int
    field: int
    """Where the name before the size ends."""
    tail: int
    """Where all that the checksum is set behind ends."""
    end: int
    exact: bool

    def moved(self, by: int) -> "Fit":
        return Fit(self.start + by, self.field + by, self.tail + by, self.end + by, self.exact)


class Run:
    """A run of printable bytes as far as it is not settled; holds at most 4096 bytes and what one `read` adds."""

    ENDING: ClassVar[re.Pattern[bytes]] = re.compile(CHECKSUM_FIELD.pattern + b"|" + re.escape(COMPLAINT_TEXT))
    """What a frame ends in, its digits a group, or a complaint."""
    UNPADDED: ClassVar[re.Pattern[bytes]] = re.compile(rb" (\d{4})\Z")

    def __init__(self, *, strict: bool) -> None:
        self._strict = strict
        self.text = bytearray()
        self.clear()

    def clear(self) -> None:
        """The next byte begins a new run."""
        self.text.clear()
        self._sums = [0]
        """The sum of the text before each place."""
        self.settled = 0
        """All before this place was frames, or was given out as noise."""
        self._edge = 0
        """Where the run began or the last frame ended; negative once that is forgotten."""
        self.fits: list[Fit] = []
        """Later ones end later."""
        self._endings_from = 0
        self._field: int | None = None
        """The first size field after the last frame; negative once it is forgotten."""
        self._fields_from = 1
        self._claimed = 0
        """Where at the latest a frame with that size field ends."""

    def read(self, text: bytes) -> None:
        """Lengthen the run."""
        self._sums += accumulate(text, initial=self._sums.pop())
        self.text += text
        for ending in self.ENDING.finditer(self.text, self._endings_from):
            self._endings_from = ending.end()
            if ending[1] is not None:
                self._add_fits(ending)
            else:
                self.fits.append(Fit(ending.start(), -1, -1, ending.end(), exact=False))
        # One byte less than a complaint may still become one.
        self._endings_from = max(self._endings_from, len(self.text) + 1 - len(COMPLAINT_TEXT))

    def read_unpadded(self) -> None:
        """The run ends at a boundary: what it ends in may be a checksum that lacks its zero."""
        ending = self.UNPADDED.search(self.text, max(0, len(self.text) - 5))
        if ending is not None and not self._strict:
            self._add_fits(ending)

    def next(self, *, ended: bool) -> Fit | None:
        """The first fit that nothing before it can still overrule; `ended`: nothing more comes."""
        if self._field is None:
            self._find_field()
        if not self.fits:
            return None
        first_field = len(self.text) if self._field is None else self._field
        for fit in self.fits:
            if fit.end <= first_field or (fit.exact and fit.field <= first_field):
                return fit
        return self.fits[0] if ended or self._claimed <= len(self.text) else None

    def accept(self, fit: Fit) -> None:
        """`fit` is settled, and with it everything before its end."""
        self.settled = self._edge = fit.end
        self.fits = [later for later in self.fits if later.start >= fit.end]
        if self._field is not None and self._field <= fit.end:
            self._field = None
            self._fields_from = fit.end + 1

    def settle(self, end: int) -> bytes:
        """The text before `end` that no frame holds, now settled."""
        text = bytes(self.text[self.settled : end])
        self.settled = end
        return text

    def forget(self) -> bytes:
        """Hold no more than a frame can still need; what had to be settled for that."""
        if self.settled == len(self.text):
            self.clear()
            return b""
        if len(self.text) <= _HELD:
            return b""
        noise = self.settle(max(self.settled, len(self.text) - _REACH))
        gone = self.settled
        del self.text[:gone], self._sums[:gone]
        self.settled = 0
        self.fits = [fit.moved(-gone) for fit in self.fits]
        self._edge -= gone
        self._endings_from -= gone
        self._fields_from -= gone
        self._claimed -= gone
        if self._field is not None:
            self._field -= gone
        return noise

    def _add_fits(self, ending: re.Match[bytes]) -> None:
        """Note the frames with this ending: at most two, since 999 printable bytes wrap the sum at most once."""
        sums = self._sums
        digits, end = ending.span(1)
        checksum = int(ending[1])
        if checksum > 0xFFFF:
            return
        first = max(self.settled, end - LONGEST)
        for before in (sums[digits] - checksum - 0x10000, sums[digits] - checksum):
            start = bisect_left(sums, before, first, digits - 1)
            if sums[start] == before and self.text[start] != _SPACE:
                fit = self._fit(start, digits, end)
                if fit is not None and (fit.exact or not self._strict):
                    self.fits.append(fit)

    def _find_field(self) -> None:
        """Set `_field` and what it claims, or note how far there is none."""
        field = SIZE_FIELD.search(self.text, self._fields_from)
        if field is None:
            self._fields_from = max(self._fields_from, len(self.text) - 4)
        else:
            self._field = field.start()
            self._claimed = self._field - 1 + int(field[1])

    def _fit(self, start: int, digits: int, end: int) -> Fit | None:
        """The frame from `start` whose checksum is the text from `digits` to `end`, if that has all its parts."""
        text = self.text
        tail = digits - 1
        field = SIZE_FIELD.search(text, start + 1, tail)
        if field is None or text[field.start() - 1] == _SPACE or text[field.end()] == _SPACE:
            return None
        if not field.end() < text.rfind(b" ", 0, tail) < tail - 1:
            return None
        exact = end - digits == 5 and int(field[1]) == end - start
        return Fit(start, field.start(), tail, end, exact) if exact or self._may_begin(start) else None

    def _may_begin(self, start: int) -> bool:
        """Whether a word begins at `start`: behind a space, a frame or a complaint, or with the run."""
        text = self.text
        return start == self._edge or (
            start > 0
            and (
                text[start - 1] == _SPACE
                or CHECKSUM_FIELD.fullmatch(text, max(0, start - 6), start) is not None
                or text.endswith(COMPLAINT_TEXT, 0, start)
            )
        )

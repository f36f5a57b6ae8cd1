"""PSIU ASCII: frames of printable words, ended by the sum of their bytes.

    MNERIM 034 parafrente 100 PC 02123
    dest.  size  message      src checksum

How it is read. A frame lies within a *run* of printable bytes; anything else ends the run, and
the end of a line, of a datagram or a silence is a *boundary* besides. Nothing marks the
beginning of a frame, but every *ending*, a space and five digits, names the sum of what stands
before it, and sums only grow: two bisections in the running sums find each place where a frame
with that ending can begin. From there the first `` ddd `` is its size field. If it tells the true
length the fit is *exact*, otherwise *loose*: accepted where a word begins, and remarked upon,
unless `strict`.

Which fit counts. The first size field since the last frame has the first word: while the length
that it claims can still come, only its own exact frame is taken, so that a message may quote
other frames. Once its claim has failed, or the run has ended, endings are taken in their order;
hence a size corrupted to 999 only delays the good frames behind it, by its claim or a short
silence (`RIPE_S`), and never swallows them. At a boundary the checksum may lack its zero.

All of this depends on the bytes alone, so however the stream is cut, the frames are the same. A
few thousand bytes are held at most, and an ending is looked into once. `ascii_run.Run` finds the
fits (`draft_run` those of the drafts before the document, which leave out spaces and the sender);
the codec makes frames of them.
"""

import re
from collections.abc import Sequence
from typing import ClassVar, Final, Literal

from pydantic import BaseModel, ConfigDict, Field

from psiu_broker.codecs.ascii_run import COMPLAINT_TEXT, LONGEST, SIZE_FIELD, Fit, Run
from psiu_broker.codecs.checksums import byte_sum
from psiu_broker.codecs.codec import Codec, Directory, Event
from psiu_broker.codecs.draft_run import LONGEST_NAME, DraftRun, SenderlessRun
from psiu_broker.codecs.noise import NOISE, Noise
from psiu_broker.errors import EncodeError
from psiu_broker.frame import COMPLAINT, NOBODY, Address, Frame, Malformed

__all__ = ["PsiuAscii", "message"]

PROTOCOL: Final = "psiu-ascii"

RIPE_S: Final = 0.02
"""The silence that decides for a whole frame held back by the claim of an earlier size field."""

_CANONICAL: Final = "psiu-ascii/1"
_SIZE_BYTES: Final = len(b" ddd ")
_DRAFT_SIZE_BYTES: Final = len(b"ddd")

_BAD_CHECKSUM: Final = "checksum"
_BAD_SIZE: Final = "size"
_UNFINISHED: Final = "unfinished"

_PIECE: Final = re.compile(rb"([ -~]+)|([\r\n]+)|[^ -~\r\n]+")
_PRINTABLE: Final = re.compile(rb"[!-~][ -~]*")
_DIGITS: Final = b"0123456789"
_MISREAD: Final = re.compile(rb" \d{3}( |\Z)")

_SIZES: Final = tuple(b"%03d" % size for size in range(LONGEST + 1))


class _Checksums(dict[int, bytes]):
    """Sums as text, each written when it first occurs: writing one takes ten times as long as looking it up."""

    def __missing__(self, total: int) -> bytes:
        text = self[total] = b"%05d" % total
        return text


_CHECKSUMS: Final = _Checksums()
_PRINTABLE_BYTES: Final = bytes(range(0x20, 0x7F))

_SHORTEST: Final = 9
"""No frame of any version has fewer bytes: a name, the digits of the size, and those of the checksum."""
_ENDED: Final = re.compile(rb"[^ -~\r\n]")
"""What ends a run, and no line."""

_STEP: Final = 1024
_MOST_WORDS: Final = 1024
"""Names, and command words, that are remembered as text."""

# Frame(...) goes through a Python function; this is the same without it, on the path that nearly every frame takes.
_make = tuple.__new__


def message(source: Address, destination: Address, *words: str) -> Frame:
    """A frame of our own, to be encoded: a command or answer and its parameters (PSIU ASCII, Campos do pacote)."""
    # A lone surrogate stays a byte that `encode` refuses, rather than an exception here or a word that was never said.
    payload = " ".join(words).encode("utf-8", "surrogatepass")
    return Frame(source, destination, words[0] if words else "", payload, PROTOCOL)


class PsiuAscii(Codec):
    """One stream of PSIU ASCII frames."""

    protocol: ClassVar[str] = PROTOCOL

    class Options(BaseModel):
        """What the user may write for a PSIU ASCII link."""

        model_config = ConfigDict(extra="forbid", frozen=True)

        version: Literal["1", "0.5", "0"] = Field(
            "1", description="1 is the document; 0.5 and 0 are its drafts, and frames of 0 name no sender"
        )
        strict: bool = Field(False, description="refuse frames with a wrong size or a checksum without its zero")
        line_end: Literal["none", "crlf"] = Field(
            "none", description="what follows a frame that is sent; robots want none"
        )
        silence_ms: int = Field(200, ge=20, description="half a frame is given up after such a silence")

    def __init__(self, options: Options, directory: Directory, *, datagrams: bool = False) -> None:
        self.options = options
        self._canonical = f"{PROTOCOL}/{options.version}"
        self.dialect = self._canonical if options.line_end == "none" else f"{self._canonical}/crlf"
        self.addressed = options.version != "0"
        self.silence_s = self._silence_s = options.silence_ms / 1000
        self._directory = directory
        self._names: dict[bytes, Address] = {}
        self._subjects: dict[bytes, str] = {}
        self._draft: DraftRun | None = None
        if options.version != "1":
            reader = DraftRun if self.addressed else SenderlessRun
            self._draft = reader(directory, strict=options.strict)
        self._run = self._draft or Run(strict=options.strict)
        self._noise = Noise()

    def whole(self, data: bytes) -> Frame | None:
        """The frame, if `data` is one whole canonical frame of names and a command heard before: the common case.

        None in the drafts, since they remember no command.
        """
        try:
            destination, size, rest = data.split(b" ", 2)
            if size != _SIZES[len(data)]:
                is_line = data.endswith(b"\r\n") and size == _SIZES[len(data) - 2]
                return self.whole(data[:-2]) if is_line else None
            payload, source, checksum = rest.rsplit(b" ", 2)
            if checksum != _CHECKSUMS[byte_sum(data[:-5])]:
                return None
            command, _, parameters = payload.partition(b" ")
            subject = self._subjects[command]
            to = self._names[destination]
            sender = self._names[source]
        except (ValueError, LookupError):  # a part is missing, too long, or a word not heard before
            return None
        # Only the parameters were not looked at before; and a known name with spaces may begin with one of them.
        if not parameters.isalnum() and parameters.translate(None, _PRINTABLE_BYTES):
            return None
        if self._directory.names and self._may_begin_a_name(payload + b" " + source):
            return None
        return _make(Frame, (sender, to, subject, payload, PROTOCOL, data, _CANONICAL, ""))

    def decode(self, data: bytes, now: float) -> Sequence[Event]:
        """The frames that `data` completes, and in one `Malformed` each run of bytes between them."""
        events: list[Event] = []
        rest = 0 if self.pending else self._take_whole(data, events)
        for piece in _PIECE.finditer(data, rest):
            if piece[1] is not None:
                if piece.end() - piece.start() < _SHORTEST and not self._run.text and _ENDED.match(data, piece.end()):
                    self._waste(piece[1], events)
                    continue
                for at in range(piece.start(), piece.end(), _STEP):
                    self._read(data[at : min(at + _STEP, piece.end())], events)
            elif piece[2] is not None:
                self._end_line(events)
            else:
                self._end_run(events, boundary=False)
                self._noise.add(piece[0], events)
        self.pending = len(self._run.text) > 0 or self._noise.size > 0
        self.silence_s = RIPE_S if self._run.fits else self._silence_s
        return events

    def flush(self, now: float) -> Sequence[Event]:
        """Settle or give up what was begun."""
        if not self.pending:
            return ()
        events: list[Event] = []
        self._end_line(events)
        self.pending = False
        self.silence_s = self._silence_s
        return events

    def encode(self, frame: Frame) -> bytes:
        """The frame with its true size and padded checksum, and the line end if one is configured.

        Raises:
            EncodeError: a name or word cannot be said in printable ASCII, would be read as another, or all is too long.
        """
        wire = frame.wire if frame.wire and frame.dialect == self._canonical else self._encoded(frame)
        return wire if self.dialect == self._canonical else wire + b"\r\n"

    def _encoded(self, frame: Frame) -> bytes:
        if frame.protocol != PROTOCOL:
            raise EncodeError(f"a frame of {frame.protocol or 'no protocol'} cannot be sent as {PROTOCOL}")
        destination = _name(frame.destination)
        if self._draft is not None:
            return self._encoded_draft(frame, destination, self._draft)
        if _MISREAD.search(destination, 1):
            raise EncodeError(f"{frame.destination}: three digits alone in a name would be read as the size")
        return _ended(destination, b" %b ", b"%b %b " % (_words(frame.payload, "a message"), _name(frame.source)))

    def _encoded_draft(self, frame: Frame, destination: bytes, draft: DraftRun) -> bytes:
        if len(destination) > LONGEST_NAME:
            raise EncodeError(f"{frame.destination}: the drafts have room for {LONGEST_NAME} bytes of a name")
        message = b"%b " % _words(frame.payload, "a message")
        wire = _ended(destination, b"%b", message + _name(frame.source) if self.addressed else message)
        read = draft.name_end(wire, 0, len(wire))
        if read != len(destination):
            raise EncodeError(
                f"{frame.destination}: with the size behind it, it would be read as {wire[:read].decode()}"
            )
        return wire

    def _take_whole(self, data: bytes, events: list[Event]) -> int:
        """Take the `whole` frames that `data` begins with; where the rest begins.

        However the stream is cut, the frames are the same: it is cut here where each says that it ends.
        """
        start = 0
        while True:
            field = data.find(b" ", start) + 1
            size = data[field : field + 3]
            end = start + int(size) if field and size.isdigit() else len(data) + 1
            frame = self.whole(data[start:end]) if end <= len(data) else None
            if frame is None:
                return start
            events.append(frame)
            start = end

    def _may_begin_a_name(self, message: bytes) -> bool:
        """Whether a known name with spaces is at the end of `message`, behind its command word."""
        words = message.decode().split(" ")
        return any(" ".join(words[at:]) in self._directory.names for at in range(1, len(words) - 1))

    def _sender(self, text: str, start: int, space: int, end: int) -> int:
        """The space before the sender's name, which ends at `end`: the longest known one, else the word after `space`.

        `start` is the second byte of the message, of which the name leaves at least one.
        """
        names = self._directory.names
        longest = space
        while names and (space := text.rfind(" ", start, space)) > 0:
            if text[space + 1 : end] in names:
                longest = space
        return longest

    def _read(self, text: bytes, events: list[Event]) -> None:
        self._run.read(text)
        self._settle(events, ended=False)
        self._waste(self._run.forget(), events)

    def _end_line(self, events: list[Event]) -> None:
        self._end_run(events, boundary=True)
        self._end_noise(events)

    def _end_run(self, events: list[Event], *, boundary: bool) -> None:
        """Settle the run, since no frame goes beyond it; what is left is noise."""
        run = self._run
        if run.text:
            self._settle(events, ended=True)
            if boundary:
                run.read_unpadded()
                self._settle(events, ended=True)
            self._waste(run.settle(len(run.text)), events)
            run.clear()

    def _settle(self, events: list[Event], *, ended: bool) -> None:
        run = self._run
        while (fit := run.next(ended=ended)) is not None:
            self._waste(run.settle(fit.start), events)
            self._end_noise(events)
            is_complaint = fit.field < 0
            events.append(
                Malformed(COMPLAINT, COMPLAINT_TEXT, len(COMPLAINT_TEXT)) if is_complaint else self._frame(fit)
            )
            run.accept(fit)

    def _frame(self, fit: Fit) -> Frame:
        wire = bytes(self._run.text[fit.start : fit.end])
        text = wire.decode("ascii")
        field = fit.field - fit.start
        end = fit.tail - fit.start
        message = field + (_SIZE_BYTES if self._draft is None else _DRAFT_SIZE_BYTES)
        source = NOBODY
        payload = wire[message:end]
        if self.addressed:
            sender = self._sender(text, message + 1, text.rindex(" ", 0, end), end)
            source = self._address(wire[sender + 1 : end])
            payload = wire[message:sender]
        dialect, remark = self._canonical, ""
        if not fit.exact:
            dialect = f"{self._canonical}/loose"
            unpadded = len(wire[end:].lstrip()) < 5
            remark = "checksum not padded" if unpadded else f"size {text[field:message].strip()}, not {len(wire):03}"
        destination = self._address(wire[:field])
        return Frame(source, destination, self._subject(payload), payload, PROTOCOL, wire, dialect, remark)

    def _address(self, name: bytes) -> Address:
        address = self._names.get(name)
        if address is None:
            if len(self._names) >= _MOST_WORDS:
                self._names.clear()
            address = self._names[name] = Address.named(name.decode("ascii"))
        return address

    def _subject(self, payload: bytes) -> str:
        word = payload.split(b" ", 1)[0]
        if self._draft is not None:
            return word.decode("ascii")
        subject = self._subjects.get(word)
        if subject is None:
            if len(self._subjects) >= _MOST_WORDS:
                self._subjects.clear()
            subject = self._subjects[word] = word.decode("ascii")
        return subject

    def _waste(self, text: bytes, events: list[Event]) -> None:
        """`text` was no frame: it is noise, and the spaces that noise begins with are nothing at all."""
        self._noise.add(text if self._noise.size else text.lstrip(b" "), events)

    def _end_noise(self, events: list[Event]) -> None:
        if self._noise.size:
            self._noise.end(self._reason(), events)

    def _reason(self) -> str:
        """Why the noise was no frame, as far as it looks like one."""
        kept = bytes(self._noise.kept)
        field = SIZE_FIELD.search(kept, 1) if self._draft is None else self._draft.size_field(kept)
        if self._noise.size > LONGEST or not field:
            return NOISE
        summed = kept.rfind(b" ") + 1 if self._draft is None else max(len(kept.rstrip(_DIGITS)), len(kept) - 5)
        ending = kept[summed:]
        if len(ending) == 5 and ending.isdigit() and byte_sum(kept[:summed]) == int(ending):
            return _BAD_SIZE
        looks_whole = len(ending) == 4 and ending.isdigit()
        return _BAD_CHECKSUM if looks_whole or self._run.ENDING.search(kept, field.end(1)) else _UNFINISHED


def _ended(destination: bytes, size: bytes, rest: bytes) -> bytes:
    """A whole frame: its length written as `size` says, and `rest` with its checksum behind it."""
    length = len(destination) + len(size % b"ddd") + len(rest) + 5
    if length > LONGEST:
        raise EncodeError(f"the frame would have {length} bytes, of which three digits can only say {LONGEST}")
    summed = destination + size % _SIZES[length] + rest
    return b"%b%05d" % (summed, byte_sum(summed))


def _name(address: Address) -> bytes:
    if address.is_numbered:
        raise EncodeError(f"{address} is a number; PSIU ASCII knows robots by name")
    name = _words(address.name.encode("utf-8", "surrogatepass"), "a name")
    if name.endswith(b" "):
        raise EncodeError(f"{address.name!r}: a name cannot end in a space")
    return name


def _words(words: bytes, what: str) -> bytes:
    if not _PRINTABLE.fullmatch(words):
        raise EncodeError(f"{words.decode('utf-8', 'replace')!r}: {what} is printable ASCII, not empty, no space first")
    return words

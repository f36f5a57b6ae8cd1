"""Amarino: texts between a phone and a board, each ended by 0x13. No addresses, no checksum, no escaping.

    A180;45 <13>        phone to board: a flag, which says what function is meant, and a text
    <12> 21.50 <13>     board to phone: a text

Several values are joined by ``;``, and numbers with a point have two decimals (`values_text`, `values`).

Boards trust what they hear. A message with no flag, or with one below ``0``, makes them jump to where no function
is; they keep 64 bytes of a message; 0x1B makes them forget what they heard of it. So none that they would not live
through is sent, and such a message of a phone is none.

How it is read. From a board, what is not between 0x12 and 0x13 is noise. From a phone, everything up to 0x13 is one
message; a 0x1B alone and what says only that the phone is alive (0x11 0x13, the subject ``alive``) are harmless.
"""

import re
from collections.abc import Sequence
from typing import ClassVar, Final, Literal

from pydantic import BaseModel, ConfigDict, Field

from psiu_broker.codecs.codec import Codec, Directory, Event
from psiu_broker.codecs.noise import NOISE, Noise
from psiu_broker.errors import EncodeError
from psiu_broker.frame import NOBODY, Frame

PROTOCOL: Final = "amarino"

Role = Literal["phone", "board"]

LONGEST_MESSAGE: Final = 64
"""Bytes of a flag and its text that a board keeps."""
LONGEST_TEXT: Final = 1024
"""Bytes of the longest text that we take from a board, or say as one."""

FIRST_FLAG: Final = ord("0")
LAST_FLAG: Final = ord("z")
"""A board has functions for these and those between; to a higher flag it answers that it is out of bounds."""

TEXT: Final = "text"
"""The subject of what a board says."""
ALIVE: Final = "alive"
ABORT: Final = "abort"
"""The subject of a frame of ours, without a payload, that makes a board forget what it heard of a message."""
FLAG: Final = "flag/"
"""Before the flag in the subject of what a phone says: ``flag/A``."""

START: Final = b"\x12"
END: Final = b"\x13"
_ABORT: Final = b"\x1b"
_ALIVE: Final = b"\x11"
_CONTROLS: Final = re.compile(rb"[\x11-\x13\x1b]")
_PIECE: Final = re.compile(rb"[^\x11-\x13\x1b]+|[\x11-\x13\x1b]")

_WHOLE: Final = re.compile(r"[+-]?[0-9]{1,18}")
_POINTED: Final = re.compile(r"[+-]?[0-9]{1,38}\.[0-9]{1,18}(?:E-?[0-9]{1,2})?")

_SAID_BY: Final = {"phone": f"{PROTOCOL}/phone", "board": f"{PROTOCOL}/board"}

_UNFINISHED: Final = "unfinished"
_CONTROL: Final = "control"
_TOO_LONG: Final = "too long"
_BAD_FLAG: Final = "flag"
_ABORTED: Final = "aborted"


def flag_subject(flag: int) -> str:
    """``flag/A``."""
    return FLAG + chr(flag)


def values_text(values: Sequence[float | str]) -> str:
    """`values` as one text: joined by ``;``, those with a point with two decimals.

    Raises:
        ValueError: a text among them that would be read as several or end the message, or no finite number.
    """
    return ";".join(map(_value_text, values))


def values(text: bytes) -> tuple[int | float | str, ...]:
    """The values that `text` joins, as the numbers that they spell; none in an empty text. Never raises."""
    return tuple(map(_value, text.decode("utf-8", "replace").strip().split(";"))) if text.strip() else ()


def text_trouble(text: bytes) -> str | None:
    """Why `text` cannot be in a message; None where it can."""
    control = _CONTROLS.search(text)
    return None if control is None else f"byte 0x{control[0].hex()} would be read as a mark between messages"


def flag_trouble(message: bytes) -> str | None:
    """Why a board would not live through a message of a phone; None where it would."""
    if not message:
        return "a message without a flag crashes the board"
    if message[0] < FIRST_FLAG:
        return f"the flag 0x{message[0]:02x} crashes the board: flags begin at 0 (0x30)"
    if len(message) > LONGEST_MESSAGE:
        return f"{len(message)} bytes are more than the {LONGEST_MESSAGE} that a board keeps of a flag and its text"
    return None


class Amarino(Codec):
    """One stream of Amarino's messages."""

    protocol: ClassVar[str] = PROTOCOL
    addressed: bool = False

    class Options(BaseModel):
        """What the user may write for an Amarino link."""

        model_config = ConfigDict(extra="forbid", frozen=True)

        role: Role = Field("phone", description="what the broker is on this link: the phone of a board, or the board")
        silence_ms: int = Field(500, ge=20, description="half a message is given up after such a silence")

    def __init__(
        self, options: Options | None = None, directory: Directory | None = None, *, datagrams: bool = False
    ) -> None:
        self.options = options or self.Options()
        self.silence_s = self.options.silence_ms / 1000
        self._is_phone = self.options.role == "phone"
        self.dialect = _SAID_BY[self.options.role]
        self._heard_dialect = _SAID_BY["board" if self._is_phone else "phone"]
        self._message: bytearray | None = None
        """What came of a message; None before one begins."""
        self._reason = NOISE
        """Why what comes now is none."""
        self._noise = Noise()

    def decode(self, data: bytes, now: float) -> Sequence[Event]:
        """The messages that `data` completes, and in one `Malformed` each run of bytes between them.

        A lone 0x1B of a phone is nothing.
        """
        events: list[Event] = []
        hear = self._hear_board if self._is_phone else self._hear_phone
        for piece in _PIECE.finditer(data):
            hear(piece[0], events)
        self._set_pending()
        return events

    def flush(self, now: float) -> Sequence[Event]:
        """Give up what was begun."""
        events: list[Event] = []
        self._spoil(_UNFINISHED, b"", events)
        self._end_noise(events)
        self._set_pending()
        return events

    def encode(self, frame: Frame) -> bytes:
        """The bytes of a message.

        Raises:
            EncodeError: a board would not live through it, it would be read as another, or the other side says such.
        """
        if frame.wire and frame.dialect == self.dialect:
            return frame.wire
        if frame.protocol != PROTOCOL:
            raise EncodeError(f"a frame of {frame.protocol or 'no protocol'} cannot be sent as {PROTOCOL}")
        if frame.subject == ABORT and self._is_phone and not frame.payload:
            return _ABORT
        trouble = self._trouble(frame)
        if trouble is not None:
            raise EncodeError(trouble)
        return frame.payload + END if self._is_phone else START + frame.payload + END

    def _trouble(self, frame: Frame) -> str | None:
        if (frame.subject == TEXT) == self._is_phone:
            return "a text without a flag is what a board says" if self._is_phone else "a board says no flags"
        if self._is_phone:
            return flag_trouble(frame.payload) or text_trouble(frame.payload)
        if len(frame.payload) > LONGEST_TEXT:
            return f"{len(frame.payload)} bytes are more than the {LONGEST_TEXT} of the longest text"
        return text_trouble(frame.payload)

    def _hear_board(self, piece: bytes, events: list[Event]) -> None:
        if piece == START:
            self._spoil(_UNFINISHED, b"", events)
            self._end_noise(events)
            self._message = bytearray()
        elif self._message is None:
            self._noise.add(piece, events)
            if piece == END:
                self._end_noise(events)
        elif piece == END:
            text = bytes(self._message)
            self._message = None
            events.append(self._frame(TEXT, text, START + text + END))
        elif _CONTROLS.match(piece):
            self._spoil(_CONTROL, piece, events)
        elif len(self._message) + len(piece) > LONGEST_TEXT:
            self._spoil(_TOO_LONG, piece, events)
        else:
            self._message += piece

    def _hear_phone(self, piece: bytes, events: list[Event]) -> None:
        if piece == _ABORT:
            if self._message is not None or self._noise.size:
                self._spoil(_ABORTED, piece, events)
                self._end_noise(events)
        elif piece == END:
            self._end_message(bytes(self._message or b""), events)
        elif self._noise.size:
            self._noise.add(piece, events)
        elif len(self._message or b"") + len(piece) > LONGEST_MESSAGE:
            self._spoil(_TOO_LONG, piece, events)
        else:
            self._message = (self._message or bytearray()) + piece

    def _end_message(self, message: bytes, events: list[Event]) -> None:
        if self._noise.size:
            self._spoil(self._reason, END, events)
        elif message == _ALIVE:
            self._message = None
            # Not the dialect of what may be sent on as it came: today's boards take it for a flag.
            frame = self._frame(ALIVE, message, message + END)
            events.append(frame._replace(dialect=f"{self._heard_dialect}/alive"))
        elif flag_trouble(message) is not None:
            self._spoil(_BAD_FLAG, END, events)
        elif _CONTROLS.search(message):
            self._spoil(_CONTROL, END, events)
        else:
            self._message = None
            events.append(self._frame(flag_subject(message[0]), message, message + END))
        self._end_noise(events)

    def _frame(self, subject: str, payload: bytes, wire: bytes) -> Frame:
        return Frame(NOBODY, NOBODY, subject, payload, PROTOCOL, wire, self._heard_dialect)

    def _spoil(self, reason: str, piece: bytes, events: list[Event]) -> None:
        """What was begun, and `piece` behind it, is no message."""
        if self._message is not None:
            begun = (START if self._is_phone else b"") + bytes(self._message)
            self._noise.add(begun, events)
            self._message = None
            self._reason = reason
        elif not self._noise.size:
            self._reason = reason
        self._noise.add(piece, events)

    def _end_noise(self, events: list[Event]) -> None:
        self._noise.end(self._reason, events)
        self._reason = NOISE

    def _set_pending(self) -> None:
        self.pending = self._message is not None or self._noise.size > 0


def _value_text(value: float | str) -> str:
    if isinstance(value, float):
        if value - value != 0:
            raise ValueError(f"{value} is not a number that a board can read")
        return f"{value:.2f}"
    text = str(value)
    trouble = text_trouble(text.encode("utf-8", "surrogatepass"))
    if trouble is None and ";" in text:
        trouble = "; stands between values, and a board would read two"
    if trouble is not None:
        raise ValueError(f"{text!r}: {trouble}")
    return text


def _value(text: str) -> int | float | str:
    if _WHOLE.fullmatch(text):
        return int(text)
    return float(text) if _POINTED.fullmatch(text) else text

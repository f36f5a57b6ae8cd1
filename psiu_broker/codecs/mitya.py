"""Robot Mitya: messages of one letter and four hexadecimal digits, such as D0064; nothing between them, no checksum.

Versions. 2012 is the document; the firmware of 2013 renamed letters so that none is a hexadecimal digit, and answers
``#0000``; that of 2014 has no RoboScript. A message is known by its *word* (`LETTERS`): D of 2012 and G of 2013 are
both ``drive``, so that a frame of one version goes to a robot of another under the letter that this one knows.

How it is read. Messages follow each other without a mark. While the reader is *in step*, each begins where the last
one ended. Anything else there loses the step, and what restores it is a known letter that is no digit with four
digits behind it, the end of a line, of a datagram, or a silence; before these, messages are counted off backwards,
since D, E, F and f of 2012 look like digits.

Line ends are nothing. One-shots (t y n f h) come as bursts: their value, perhaps thrice, then 0000, perhaps thrice.
The first message of a burst is the frame; the others are nothing. While a script is recorded everything is a frame,
with ``script/`` before its word.
"""

import re
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import ClassVar, Final, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field

from psiu_broker.codecs.codec import Codec, Directory, Event
from psiu_broker.codecs.noise import NOISE, Noise
from psiu_broker.errors import EncodeError
from psiu_broker.frame import NOBODY, Frame

PROTOCOL: Final = "mitya"

Version = Literal["2012", "2013", "2014"]
VERSIONS: Final[tuple[Version, ...]] = get_args(Version)

_DOCUMENT: Final = {
    "L": "left", "R": "right", "D": "drive", "H": "head-horizontal", "V": "head-vertical",
    "E": "error", "F": "mood", "I": "headlights", "T": "tail",
    "t": "wag", "y": "nod", "n": "shake", "f": "fire", "h": "hit",
    "r": "script", "Z": "room", "W": "wait",
}  # fmt: skip
_RENAMED: Final = {"D": "G", "E": "#", "F": "M", "f": "s", "h": "*"}
_ADDED: Final = {"=": "battery", "~": "telemetry", "h": "turn-horizontal", "v": "turn-vertical"}
_2013: Final = {_RENAMED.get(letter, letter): word for letter, word in _DOCUMENT.items()} | _ADDED
_2014: Final = {letter: word for letter, word in _2013.items() if word not in ("script", "room", "wait")}

LETTERS: Final[Mapping[Version, Mapping[str, str]]] = MappingProxyType(
    {"2012": MappingProxyType(_DOCUMENT), "2013": MappingProxyType(_2013), "2014": MappingProxyType(_2014)}
)
"""What each letter of a version means: ``LETTERS["2013"]["G"] == "drive"``."""

BY_WORD: Final[Mapping[Version, Mapping[str, str]]] = MappingProxyType(
    {version: MappingProxyType({word: letter for letter, word in LETTERS[version].items()}) for version in VERSIONS}
)
"""The letter of each word in a version: ``BY_WORD["2013"]["drive"] == "G"``."""

DONE: Final = "done"
"""The word of ``#0000``, by which 2013 and 2014 say that a command was carried out; any other ``#`` is an error."""
ONE_SHOTS: Final = frozenset({"wag", "nod", "shake", "fire", "hit"})
"""Words that are an event and no set-point: sent with their value, then with 0."""
SCRIPT: Final = "script/"
"""Before the word of a message that is recorded, not done: ``script/nod``. Such messages are sent exactly once."""
LETTER: Final = "letter/"
"""Before a letter that the version has no word for: ``letter/Q``."""
STOP: Final = "stop"
"""The subject of a frame of ours that stops both motors: a ``drive`` of 0 that overtakes what waits.

It may have more messages around the ``drive``: those that end a script which is being played (`profiles.roboscript`).
"""
REALIGN: Final = "realign"
"""The subject of a frame of ours whose payload is sent as it is, to find the step of a 2012 body."""

MESSAGE_BYTES: Final = 5
BURST_S: Final = 1.0
"""The messages of one burst of a one-shot follow each other at least this soon."""

_MESSAGE: Final = re.compile(rb"[A-Za-z#*~=][0-9A-Fa-f]{4}")
_DIGITS: Final = frozenset(b"0123456789ABCDEFabcdef")
_STOPPING: Final = re.compile(rb"((?:[DG]0001)?([DG])0000)r010[0-9](?:Z0001)?Z0000Z0000\1")
_REALIGNING: Final = re.compile(rb"0?W0000")
"""The question of a realignment, and the filler that may go before it."""
_LINE_END: Final = frozenset(b"\r\n")
_LATIN: Final = frozenset(b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz")
_HELD: Final = 4 * MESSAGE_BYTES
"""Digits that may turn out to be messages once it is known where they end; more are noise."""

_UNFINISHED: Final = "unfinished"


def message(letter: str, value: int) -> bytes:
    """The five bytes of a message; `value` is -32768…65535.

    Raises:
        ValueError: `value` is no number of 16 bits.
    """
    if not -0x8000 <= value <= 0xFFFF:
        raise ValueError(f"{value} is not -32768 to 65535")
    return b"%b%04X" % (letter.encode("ascii"), value & 0xFFFF)


def is_message(payload: bytes) -> bool:
    """Whether `payload` is a letter and four hexadecimal digits."""
    return _MESSAGE.fullmatch(payload) is not None


def number(payload: bytes) -> int:
    """The value 0…65535 of a message."""
    return int(payload[1:MESSAGE_BYTES], 16)


def signed(payload: bytes) -> int:
    """The value of a message as a signed number, -32768…32767."""
    value = number(payload)
    return value - 0x10000 if value > 0x7FFF else value


def word_of(version: Version, payload: bytes) -> str:
    """The word of a message, without ``script/``; never raises."""
    letter = payload[:1].decode("ascii", "replace")
    word = LETTERS[version].get(letter, LETTER + letter)
    return DONE if letter == "#" and word == "error" and payload[1:] == b"0000" else word


class Mitya(Codec):
    """One stream of Robot Mitya's messages, or the datagrams of one far end."""

    protocol: ClassVar[str] = PROTOCOL
    addressed: bool = False
    remembers: ClassVar[bool] = True

    class Options(BaseModel):
        """What the user may write for a Robot Mitya link."""

        model_config = ConfigDict(extra="forbid", frozen=True)

        version: Version = Field("2012", description="whose letters; 2012 is the document, 2013 and 2014 the firmware")
        repeat: int | None = Field(
            None, ge=1, le=10, description="how often each value of a one-shot is sent; usual: 3 over UDP, else 1"
        )
        realign: bool = Field(True, description="bring a 2012 body that lost step back into it; serial links only")
        silence_ms: int = Field(100, ge=20, description="half a message is given up after such a silence")

    def __init__(
        self, options: Options | None = None, directory: Directory | None = None, *, datagrams: bool = False
    ) -> None:
        self.options = options or self.Options()
        self.version: Version = self.options.version
        self.dialect = f"{PROTOCOL}/{self.version}"
        self.silence_s = self.options.silence_ms / 1000
        self._heard_dialect = f"{self.dialect}/heard"
        self._repeat = self.options.repeat or (3 if datagrams else 1)
        self._known = frozenset(ord(letter) for letter in LETTERS[self.version])
        self._letters = self._known | (_LATIN if self.version == "2012" else _LATIN - _DIGITS)
        self._sure = self._known - _DIGITS
        self._begun = b""
        self._lost = False
        self._noise = Noise()
        self._recording = False
        self._wants_wait = False
        self._shots: dict[str, tuple[int, float]] = {}

    def decode(self, data: bytes, now: float) -> Sequence[Event]:
        """The messages that `data` completes, and in one `Malformed` each run of bytes between them."""
        events: list[Event] = []
        self._read(self._begun + data, events, now)
        self.pending = bool(self._begun or self._noise.size)
        return events

    def flush(self, now: float) -> Sequence[Event]:
        """Give up what was begun; whatever follows is in step."""
        events: list[Event] = []
        if self._begun:
            rest = self._counted_off(self._begun, events, now) if self._lost else self._begun
            self._noise.add(rest, events)
        self._noise.end(NOISE if self._lost else _UNFINISHED, events)
        self._begun = b""
        self._lost = self.pending = False
        return events

    def encode(self, frame: Frame) -> bytes:
        """The message of `frame` under the letter of this version; for a one-shot the whole burst.

        Raises:
            EncodeError: it is of another protocol, is no message, has no letter in this version, or is an r02xx of our
                own, by which a body would begin to record.
        """
        if frame.protocol != PROTOCOL:
            raise EncodeError(f"a frame of {frame.protocol or 'no protocol'} cannot be sent as {PROTOCOL}")
        if frame.subject == REALIGN and _REALIGNING.fullmatch(frame.payload):
            return frame.payload
        stopping = _STOPPING.fullmatch(frame.payload) if frame.subject == STOP else None
        if stopping is not None and stopping[2].decode("ascii") == BY_WORD[self.version]["drive"]:
            return frame.payload
        if not is_message(frame.payload):
            raise EncodeError(f"{frame.payload!r} is not a letter and four hexadecimal digits")
        word = frame.subject.removeprefix(SCRIPT)
        letter = self._letter(word, frame.payload)
        value = number(frame.payload)
        if word == "script" and value >= 0x0200 and not frame.wire:
            raise EncodeError("r02xx is for a body to say: one that hears it begins to record")
        wire = message(letter, value)
        if word not in ONE_SHOTS or frame.subject.startswith(SCRIPT):
            return wire
        return (wire * self._repeat if value else b"") + message(letter, 0) * self._repeat

    def pieces(self, wire: bytes) -> Sequence[bytes]:
        """One message a datagram."""
        return [wire[at : at + MESSAGE_BYTES] for at in range(0, len(wire), MESSAGE_BYTES)]

    def _letter(self, word: str, payload: bytes) -> str:
        if word == DONE and self.version != "2012":
            return "#"
        if word == STOP:
            return BY_WORD[self.version]["drive"]
        if word.startswith(LETTER):
            if payload[0] in self._letters and chr(payload[0]) not in LETTERS[self.version]:
                return chr(payload[0])
        elif (letter := BY_WORD[self.version].get(word)) is not None:
            return letter
        raise EncodeError(f"{word} has no letter in the Robot Mitya of {self.version}")

    def _read(self, buffer: bytes, events: list[Event], now: float) -> None:
        """Read to the end of `buffer`, or to where a message may have begun."""
        at = start = 0
        # Between `start` and `at` are digits that, while lost, may be messages counted off from where they end.
        while at < len(buffer):
            byte = buffer[at]
            if byte in _LINE_END:
                self._noise.add(self._counted_off(buffer[start:at], events, now), events)
                self._noise.end(NOISE, events)
                self._lost = False
                at = start = at + 1
                continue
            if byte in (self._sure if self._lost else self._letters):
                candidate = buffer[at : at + MESSAGE_BYTES]
                if all(digit in _DIGITS for digit in candidate[1:]):
                    if len(candidate) < MESSAGE_BYTES:
                        break
                    self._noise.add(self._counted_off(buffer[start:at], events, now), events)
                    self._take(candidate, events, now)
                    at = start = at + MESSAGE_BYTES
                    continue
            self._lost = True
            at += 1
            if byte not in _DIGITS:
                self._noise.add(buffer[start:at], events)
                start = at
            elif at - start > _HELD:
                self._noise.add(buffer[start : at - _HELD], events)
                start = at - _HELD
        self._begun = buffer[start:]

    def _counted_off(self, digits: bytes, events: list[Event], now: float) -> bytes:
        """Take the messages that end where `digits` end; what is before them."""
        start = len(digits)
        if not _DIGITS.issuperset(digits):  # a letter whose message was cut off
            return digits
        while start >= MESSAGE_BYTES and digits[start - MESSAGE_BYTES] in self._known:
            start -= MESSAGE_BYTES
        if start < len(digits):
            self._noise.add(digits[:start], events)
        for at in range(start, len(digits), MESSAGE_BYTES):
            self._take(digits[at : at + MESSAGE_BYTES], events, now)
        return b"" if start < len(digits) else digits

    def _take(self, wire: bytes, events: list[Event], now: float) -> None:
        self._noise.end(NOISE, events)
        self._lost = False
        payload = wire[:1] + wire[1:].upper()
        word = word_of(self.version, payload)
        value = number(payload)
        if self._recording:
            word = SCRIPT + word
            self._record(word, value)
        elif word == "script" and value >> 8 == 1:
            self._recording, self._wants_wait = True, False
            self._shots.clear()
        elif word in ONE_SHOTS and self._goes_on(word, value, now):
            return
        dialect = self.dialect if wire == payload and word not in ONE_SHOTS else self._heard_dialect
        events.append(Frame(NOBODY, NOBODY, word, payload, PROTOCOL, wire, dialect))

    def _record(self, word: str, value: int) -> None:
        """Follow a recording as a body does, which ends it with Z0000 or at anything out of its order."""
        if word == "script/room":
            self._recording = value != 0
        elif word == "script/wait":
            self._recording, self._wants_wait = self._wants_wait, False
        elif word == "script/script":
            self._recording = False
        else:
            self._recording, self._wants_wait = not self._wants_wait, True

    def _goes_on(self, word: str, value: int, now: float) -> bool:
        """Whether a one-shot belongs to the burst that it began with before."""
        last, when = self._shots.get(word, (0, now - 2 * BURST_S))
        self._shots[word] = (value, now)
        return now - when <= BURST_S and value in (0, last)

"""Firmata 2.x: messages as in MIDI, each begun by a byte from 0x80 on and carried by bytes below it.

    E0 7F 07        analog channel 0 reads 1023
    F0 79 … F7      a system-exclusive message: anything longer

How it is read. A message is whole with its last data byte, a system-exclusive one with F7; there is no
checksum. Any other byte from 0x80 on breaks off what was begun and begins anew, so that one lost byte costs
one message. What was broken off, data bytes that belong to nothing and bytes that begin nothing are noise, in one
piece between two messages.

Which messages there are depends on who speaks. `role` is what the broker is on this link: ``host`` hears a
board, ``board`` hears a program. Only a program sends C0–DF, F4, F5 and FF, and its F9 has no data.

The payload of a frame is the whole message; one to be sent may be several messages, one behind the other.
`firmata_messages` makes and reads them. Subjects:

    from a board                               from a program
    analog/CHANNEL, digital/PORT               write-analog/PIN, write-digital/PORT
    version, firmware, capabilities, mapping   ask/version, ask/firmware, ask/capabilities, ask/mapping
    pin-state/PIN                              ask/pin-state
    id                                         ask/id
                                               pin-mode/PIN, write-pin/PIN, servo/PIN, sampling, reset
                                               report-analog/CHANNEL, report-digital/PORT
    string, sysex/76 (the command in hexadecimal): either way
"""

import re
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Final, Literal

from pydantic import BaseModel, ConfigDict, Field

from psiu_broker.codecs.codec import Codec, Directory, Event
from psiu_broker.codecs.firmata_messages import END, SYSEX
from psiu_broker.codecs.noise import NOISE, Noise
from psiu_broker.errors import EncodeError
from psiu_broker.frame import MALFORMED_KEPT, NOBODY, Frame, Malformed

__all__ = ["PROTOCOL", "Firmata", "Role", "message", "messages", "subject"]

PROTOCOL: Final = "firmata"
DIALECT: Final = "firmata/2"

Role = Literal["host", "board"]
"""Who one is: a host (a program) or a board."""

LONGEST: Final = 4096
"""Bytes of the longest message that is heard: room for the capabilities of the largest board many times over."""

_UNFINISHED: Final = "unfinished"
_TOO_LONG: Final = "too long"
_EMPTY: Final = "empty"

_SAID_BY_BOARD: Final[Mapping[int, int]] = {
    **{0x90 | low: 2 for low in range(16)},
    **{0xE0 | low: 2 for low in range(16)},
    0xF9: 2,
}
_SAID_BY_HOST: Final[Mapping[int, int]] = {
    **{0x90 | low: 2 for low in range(16)},
    **{0xE0 | low: 2 for low in range(16)},
    **{0xC0 | low: 1 for low in range(16)},
    **{0xD0 | low: 1 for low in range(16)},
    0xF4: 2,
    0xF5: 2,
    0xF9: 0,
    0xFF: 0,
}
_SAID: Final[Mapping[Role, Mapping[int, int]]] = {"board": _SAID_BY_BOARD, "host": _SAID_BY_HOST}
"""The data bytes of each message that is not system-exclusive, by who says it."""

_WORDS: Final[Mapping[Role, Mapping[int, str]]] = {
    "board": {0xE0: "analog", 0x90: "digital", 0xF9: "version"},
    "host": {
        0xE0: "write-analog", 0x90: "write-digital", 0xC0: "report-analog", 0xD0: "report-digital",
        0xF4: "pin-mode", 0xF5: "write-pin", 0xF9: "ask/version", 0xFF: "reset",
    },
}  # fmt: skip
_SYSEX_WORDS: Final = {
    0x51: "ask/id", 0x52: "id", 0x69: "ask/mapping", 0x6A: "mapping", 0x6B: "ask/capabilities", 0x6C: "capabilities",
    0x6D: "ask/pin-state", 0x71: "string", 0x7A: "sampling",
}  # fmt: skip
_SYSEX_PIN_WORDS: Final = {0x6E: "pin-state", 0x6F: "write-analog", 0x70: "servo"}

_TOKEN: Final = re.compile(rb"[\x00-\x7f]+|[\x80-\xff]")

# Frame(...) goes through a Python function; this is the same without it.
_make = tuple.__new__


def subject(wire: bytes, speaker: Role) -> str:
    """The word, of the table above, for the whole message `wire` of `speaker`."""
    status = wire[0]
    if status == SYSEX:
        return _sysex_subject(wire[1], wire[2:-1])
    word = _WORDS[speaker][status & 0xF0 if status < SYSEX else status]
    if status < SYSEX:
        return f"{word}/{status & 0x0F}"
    return f"{word}/{wire[1]}" if status in (0xF4, 0xF5) else word


def _sysex_subject(command: int, data: bytes) -> str:
    if command == 0x79:
        return "firmware" if data else "ask/firmware"
    word = _SYSEX_PIN_WORDS.get(command)
    if word is not None:
        return f"{word}/{data[0]}" if data else word
    return _SYSEX_WORDS.get(command) or f"sysex/{command:02x}"


def message(payload: bytes, speaker: Role = "host") -> Frame:
    """A frame of our own, to be encoded: one or more whole messages; its subject is that of the first.

    Raises:
        EncodeError: `payload` is not whole messages that `speaker` can say.
    """
    first, *_ = messages(payload, speaker)
    return Frame(NOBODY, NOBODY, subject(first, speaker), payload, PROTOCOL)


def messages(payload: bytes, speaker: Role) -> Sequence[bytes]:
    """The messages that `payload` is, at least one.

    Raises:
        EncodeError: it is not whole messages that `speaker` can say.
    """
    found: list[bytes] = []
    at = 0
    while at < len(payload):
        status = payload[at]
        size = _SAID[speaker].get(status)
        end = payload.find(END, at) + 1 if status == SYSEX else at + 1 + size if size is not None else 0
        wire = payload[at:end]
        if end > len(payload) or len(wire) < (3 if status == SYSEX else 1) or _broken(wire):
            raise EncodeError(f"{payload[at : at + 16].hex(' ')} is no message that a Firmata {speaker} sends")
        found.append(wire)
        at = end
    if not found:
        raise EncodeError("a Firmata message has at least one byte")
    return found


def _broken(wire: bytes) -> bool:
    """Whether a byte that begins a message is inside `wire`."""
    return not (wire[1:-1] if wire[0] == SYSEX else wire[1:]).isascii()


class Firmata(Codec):
    """One stream of Firmata messages. Nothing of it is skipped: each byte is in a frame or a `Malformed`."""

    protocol: ClassVar[str] = PROTOCOL
    addressed = False

    class Options(BaseModel):
        """What the user may write for a Firmata link."""

        model_config = ConfigDict(extra="forbid", frozen=True)

        role: Role = Field("host", description="what the broker is here: host to a board, or board to a program")
        buffer: int = Field(
            64, ge=8, le=LONGEST, description="bytes between F0 and F7 that the board has room for; StandardFirmata: 64"
        )
        silence_ms: int = Field(500, ge=20, description="half a message is given up after such a silence")

    def __init__(self, options: Any = None, directory: Directory | None = None, *, datagrams: bool = False) -> None:
        self.options: Firmata.Options = self.Options() if options is None else options
        self.dialect = DIALECT
        self.silence_s = self.options.silence_ms / 1000
        self._speaker: Role = "board" if self.options.role == "host" else "host"
        self._said = _SAID[self._speaker]
        self._begun = bytearray()
        """A message without its end."""
        self._missing = 0
        """The data bytes that it lacks; negative in a system-exclusive one."""
        self._noise = Noise()
        """What the last whole message was followed by, besides `_begun`."""
        self._reason = NOISE

    def whole(self, data: bytes) -> Frame | None:
        """The frame, if `data` is one analog or digital message: nearly all that boards say."""
        if len(data) == 3 and data[0] & 0x80 and self._said.get(data[0]) == 2 and data[1] < 0x80 and data[2] < 0x80:
            return self._frame(bytes(data))
        return None

    def decode(self, data: bytes, now: float) -> Sequence[Event]:
        """The messages that `data` completes, and in one `Malformed` each run of bytes between them."""
        events: list[Event] = []
        for token in _TOKEN.finditer(data):
            text = token[0]
            if text[0] < 0x80:
                self._take(text, events)
            else:
                self._take_status(text[0], events)
        self.pending = bool(self._begun or self._noise.size)
        return events

    def flush(self, now: float) -> Sequence[Event]:
        """Give up what was begun."""
        events: list[Event] = []
        self._give_up(_UNFINISHED, events)
        self._noise.end(self._reason, events)
        self.pending = False
        return events

    def encode(self, frame: Frame) -> bytes:
        """The message or messages of `frame`.

        Raises:
            EncodeError: it is of another protocol, is no whole message, or is more than the board has room for.
        """
        if frame.protocol != PROTOCOL:
            raise EncodeError(f"a frame of {frame.protocol or 'no protocol'} cannot be sent as {PROTOCOL}")
        room = self.options.buffer if self.options.role == "host" else LONGEST
        for wire in messages(frame.payload, self.options.role):
            if len(wire) - 2 > room:
                raise EncodeError(f"{len(wire) - 2} bytes are more than the board has room for ({room})")
        return frame.payload

    def _take(self, data: bytes, events: list[Event]) -> None:
        """Data bytes: for the message that is begun, else for none."""
        begun = self._begun
        if not begun:
            self._waste(data, NOISE, events)
        elif self._missing < 0:
            room = LONGEST - len(begun)
            begun += data[:room]
            if len(data) >= room:
                self._noise.end(self._reason, events)
                events.append(Malformed(_TOO_LONG, bytes(begun[:MALFORMED_KEPT]), len(begun)))
                begun.clear()
                self._waste(data[room:], NOISE, events)
        else:
            taken = data[: self._missing]
            begun += taken
            self._missing -= len(taken)
            if self._missing == 0:
                self._finish(events)
                self._waste(data[len(taken) :], NOISE, events)

    def _take_status(self, status: int, events: list[Event]) -> None:
        """A byte that begins or ends a message, or ought to."""
        if status == END and self._begun and self._missing < 0:
            self._begun.append(status)
            if len(self._begun) > 2:
                self._finish(events)
            else:
                self._give_up(_EMPTY, events)
            return
        self._give_up(_UNFINISHED, events)
        missing = -1 if status == SYSEX else self._said.get(status)
        if missing is None:
            self._waste(bytes((status,)), NOISE, events)
            return
        self._begun.append(status)
        self._missing = missing
        if missing == 0:
            self._finish(events)

    def _finish(self, events: list[Event]) -> None:
        self._noise.end(self._reason, events)
        events.append(self._frame(bytes(self._begun)))
        self._begun.clear()

    def _frame(self, wire: bytes) -> Frame:
        return _make(Frame, (NOBODY, NOBODY, subject(wire, self._speaker), wire, PROTOCOL, wire, DIALECT, ""))

    def _give_up(self, reason: str, events: list[Event]) -> None:
        if self._begun:
            self._waste(self._begun, reason, events)
            self._begun.clear()

    def _waste(self, data: bytes | bytearray, reason: str, events: list[Event]) -> None:
        """Lengthen the noise, which is for `reason` where it is nothing else."""
        self._reason = NOISE if self._noise.size else reason
        self._noise.add(data, events)

"""The messages of Firmata 2.x by name, made and read (firmata/protocol, protocol.md 2.5.1).

    match read(frame.payload):
        case AnalogMessage(channel, value): ...

`read` and `AnalogMessage(…).wire` are each other's inverse. An AnalogMessage from a board is numbered by
channel (A0 is 0), one to a board by pin; `DigitalMessage` is for the eight pins of a port, both ways.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

ANALOG: Final = 0xE0
DIGITAL: Final = 0x90
REPORT_ANALOG: Final = 0xC0
REPORT_DIGITAL: Final = 0xD0
SYSEX: Final = 0xF0
PIN_MODE: Final = 0xF4
PIN_VALUE: Final = 0xF5
END: Final = 0xF7
VERSION: Final = 0xF9
RESET: Final = 0xFF

ASK_ID: Final = 0x51
ID: Final = 0x52
ASK_MAPPING: Final = 0x69
MAPPING: Final = 0x6A
ASK_CAPABILITIES: Final = 0x6B
CAPABILITIES: Final = 0x6C
ASK_PIN_STATE: Final = 0x6D
PIN_STATE: Final = 0x6E
EXTENDED_ANALOG: Final = 0x6F
SERVO: Final = 0x70
STRING: Final = 0x71
FIRMWARE: Final = 0x79
SAMPLING: Final = 0x7A

MODES: Final[Mapping[str, int]] = {
    "input": 0, "output": 1, "analog": 2, "pwm": 3, "servo": 4, "shift": 5, "i2c": 6, "onewire": 7,
    "stepper": 8, "encoder": 9, "serial": 10, "pullup": 11,
}  # fmt: skip
_MODE_NAMES: Final = {number: name for name, number in MODES.items()}
_NO_CHANNEL: Final = 0x7F
_PIN_ENDS: Final = 0x7F
_SHORT: Final = 1 << 14


def mode_name(mode: int) -> str:
    """``pwm`` for 3; ``mode 14`` for one that the protocol does not name."""
    return _MODE_NAMES.get(mode, f"mode {mode}")


def seven_bit(value: int, least: int = 2) -> bytes:
    """`value` in bytes of seven bits, lowest first, at least `least` of them."""
    out = bytearray()
    while value or len(out) < least:
        out.append(value & 0x7F)
        value >>= 7
    return bytes(out)


def from_seven_bit(data: bytes) -> int:
    """The number that `seven_bit` wrote."""
    value = 0
    for byte in reversed(data):
        value = value << 7 | byte
    return value


def text_bytes(text: str) -> bytes:
    """`text` as Firmata carries it: each byte of its UTF-8 as two of seven bits."""
    return b"".join(bytes((byte & 0x7F, byte >> 7)) for byte in text.encode("utf-8", "replace"))


def from_text_bytes(data: bytes) -> str:
    """The text in pairs of seven-bit bytes, as UTF-8 where it is; a last byte without its pair counts as one.

    Never raises. A character over 255, which a board may send as one pair, stands for itself.
    """
    codes = [from_seven_bit(data[at : at + 2]) for at in range(0, len(data), 2)]
    if all(code < 256 for code in codes):
        try:
            return bytes(codes).decode("utf-8")
        except UnicodeDecodeError:
            pass
    return "".join(map(chr, codes))


def sysex(command: int, data: bytes = b"") -> bytes:
    """One system-exclusive message; `data` is of seven bits."""
    return b"%c%c%b%c" % (SYSEX, command, data, END)


@dataclass(frozen=True, slots=True)
class AnalogMessage:
    """From a board: what channel `number` reads. To a board: what pin `number` is to do (PWM, servo)."""

    number: int
    value: int

    @property
    def wire(self) -> bytes:
        if self.number > 15 or self.value >= _SHORT:
            return sysex(EXTENDED_ANALOG, bytes((self.number,)) + seven_bit(self.value))
        return bytes((ANALOG | self.number, self.value & 0x7F, self.value >> 7))


@dataclass(frozen=True, slots=True)
class DigitalMessage:
    """The pins ``8 * port`` to ``8 * port + 7``, the lowest in bit 0 of `mask`."""

    port: int
    mask: int

    @property
    def wire(self) -> bytes:
        return bytes((DIGITAL | self.port, self.mask & 0x7F, self.mask >> 7))


@dataclass(frozen=True, slots=True)
class ReportAnalog:
    """Whether the board is to report a channel; with `on` it also reports it at once (2.4)."""

    channel: int
    on: bool

    @property
    def wire(self) -> bytes:
        return bytes((REPORT_ANALOG | self.channel, self.on))


@dataclass(frozen=True, slots=True)
class ReportDigital:
    """Whether the board is to report the changes of a port; with `on` it also reports it at once (2.4)."""

    port: int
    on: bool

    @property
    def wire(self) -> bytes:
        return bytes((REPORT_DIGITAL | self.port, self.on))


@dataclass(frozen=True, slots=True)
class PinMode:
    """What a pin is to be: one of `MODES`."""

    pin: int
    mode: int

    @property
    def wire(self) -> bytes:
        return bytes((PIN_MODE, self.pin, self.mode))


@dataclass(frozen=True, slots=True)
class PinValue:
    """One digital output alone (2.5)."""

    pin: int
    on: bool

    @property
    def wire(self) -> bytes:
        return bytes((PIN_VALUE, self.pin, self.on))


@dataclass(frozen=True, slots=True)
class Version:
    """The board's protocol version; its first words after a reset."""

    major: int
    minor: int

    @property
    def wire(self) -> bytes:
        return bytes((VERSION, self.major, self.minor))


@dataclass(frozen=True, slots=True)
class Firmware:
    """The sketch's own name and version."""

    major: int
    minor: int
    name: str

    @property
    def wire(self) -> bytes:
        return sysex(FIRMWARE, bytes((self.major, self.minor)) + text_bytes(self.name))


@dataclass(frozen=True, slots=True)
class Capabilities:
    """Each pin's modes with their resolution in bits; a pin without any is not for use."""

    pins: Sequence[Mapping[int, int]]

    @property
    def wire(self) -> bytes:
        told = (bytes(byte for pair in pin.items() for byte in pair) + bytes((_PIN_ENDS,)) for pin in self.pins)
        return sysex(CAPABILITIES, b"".join(told))


@dataclass(frozen=True, slots=True)
class AnalogMapping:
    """Each pin's analog channel, None where it has none."""

    channels: Sequence[int | None]

    @property
    def wire(self) -> bytes:
        return sysex(MAPPING, bytes(_NO_CHANNEL if channel is None else channel for channel in self.channels))


@dataclass(frozen=True, slots=True)
class PinState:
    """What was last written to a pin (not what it reads); `mode` None: the board has no such pin."""

    pin: int
    mode: int | None
    state: int = 0

    @property
    def wire(self) -> bytes:
        told = b"" if self.mode is None else bytes((self.mode,)) + seven_bit(self.state, 1)
        return sysex(PIN_STATE, bytes((self.pin,)) + told)


@dataclass(frozen=True, slots=True)
class AskPinState:
    """The question that `PinState` answers."""

    pin: int

    @property
    def wire(self) -> bytes:
        return sysex(ASK_PIN_STATE, bytes((self.pin,)))


@dataclass(frozen=True, slots=True)
class ServoConfig:
    """The shortest and longest pulse of a servo, in microseconds; it also makes the pin a servo."""

    pin: int
    shortest: int
    longest: int

    @property
    def wire(self) -> bytes:
        return sysex(SERVO, bytes((self.pin,)) + seven_bit(self.shortest) + seven_bit(self.longest))


@dataclass(frozen=True, slots=True)
class Text:
    """A string for a person or a sketch, either way."""

    text: str

    @property
    def wire(self) -> bytes:
        return sysex(STRING, text_bytes(self.text))


@dataclass(frozen=True, slots=True)
class Sampling:
    """How often analog channels are reported, in milliseconds; 19 unless told."""

    interval_ms: int

    @property
    def wire(self) -> bytes:
        return sysex(SAMPLING, seven_bit(self.interval_ms))


@dataclass(frozen=True, slots=True)
class Identity:
    """The number of a FirmataExpress board."""

    number: int

    @property
    def wire(self) -> bytes:
        return sysex(ID, bytes((self.number,)))


@dataclass(frozen=True, slots=True)
class Sysex:
    """Anything else: I2C, steppers, the scheduler, a sketch's own."""

    command: int
    data: bytes = b""

    @property
    def wire(self) -> bytes:
        return sysex(self.command, self.data)


@dataclass(frozen=True, slots=True)
class Simple:
    """A message without contents, of which there is one each."""

    wire: bytes


ASK_VERSION_MESSAGE: Final = Simple(bytes((VERSION,)))
RESET_MESSAGE: Final = Simple(bytes((RESET,)))
ASK_FIRMWARE_MESSAGE: Final = Simple(sysex(FIRMWARE))
ASK_CAPABILITIES_MESSAGE: Final = Simple(sysex(ASK_CAPABILITIES))
ASK_MAPPING_MESSAGE: Final = Simple(sysex(ASK_MAPPING))
ASK_ID_MESSAGE: Final = Simple(sysex(ASK_ID))
_SIMPLE: Final = {
    message.wire: message
    for message in (
        ASK_VERSION_MESSAGE, RESET_MESSAGE, ASK_FIRMWARE_MESSAGE,
        ASK_CAPABILITIES_MESSAGE, ASK_MAPPING_MESSAGE, ASK_ID_MESSAGE,
    )
}  # fmt: skip

Message = (
    AnalogMessage | DigitalMessage | ReportAnalog | ReportDigital | PinMode | PinValue | Version | Firmware
    | Capabilities | AnalogMapping | PinState | AskPinState | ServoConfig | Text | Sampling | Identity | Sysex | Simple
)  # fmt: skip


def read(wire: bytes) -> Message | None:
    """The message that `wire` is; None where it is none, or its contents make no sense. Never raises."""
    simple = _SIMPLE.get(wire)
    if simple is not None:
        return simple
    if len(wire) < 2 or any(byte & 0x80 for byte in wire[1 : -1 if wire[0] == SYSEX else None]):
        return None
    if wire[0] == SYSEX:
        return _read_sysex(wire[1], wire[2:-1]) if len(wire) > 2 and wire[-1] == END else None
    return _read_short(wire)


def _read_short(wire: bytes) -> Message | None:
    low = wire[0] & 0x0F
    match wire[0] & 0xF0, *wire[1:]:
        case (0xE0, first, second):
            return AnalogMessage(low, first | second << 7)
        case (0x90, first, second):
            return DigitalMessage(low, first | second << 7)
        case (0xC0, first):
            return ReportAnalog(low, first != 0)
        case (0xD0, first):
            return ReportDigital(low, first != 0)
    match tuple(wire):
        case (0xF4, pin, mode):
            return PinMode(pin, mode)
        case (0xF5, pin, value):
            return PinValue(pin, value != 0)
        case (0xF9, major, minor):
            return Version(major, minor)
    return None


_LONGEST_VALUE: Final = 5
"""Seven-bit bytes of a value; no pin has more than 32 bits."""


def _read_sysex(command: int, data: bytes) -> Message | None:  # noqa: PLR0911 - one for each message
    match command, *data:
        case (0x6F | 0x6E, *_) if len(data) > _LONGEST_VALUE + 2:
            return None
        case (0x6F, pin, _, *_):
            return AnalogMessage(pin, from_seven_bit(data[1:]))
        case (0x79, major, minor, *_):
            return Firmware(major, minor, from_text_bytes(data[2:]))
        case (0x6C, *_):
            return _read_capabilities(data)
        case (0x6A, *_):
            return AnalogMapping(tuple(None if byte == _NO_CHANNEL else byte for byte in data))
        case (0x6E, pin):
            return PinState(pin, None)
        case (0x6E, pin, mode, *_):
            return PinState(pin, mode, from_seven_bit(data[2:]))
        case (0x6D, pin):
            return AskPinState(pin)
        case (0x70, pin, _, _, _, _):
            return ServoConfig(pin, from_seven_bit(data[1:3]), from_seven_bit(data[3:5]))
        case (0x71, *_):
            return Text(from_text_bytes(data))
        case (0x7A, _, _):
            return Sampling(from_seven_bit(data))
        case (0x52, number):
            return Identity(number)
    return None if command in _KNOWN else Sysex(command, data)


_KNOWN: Final = frozenset({
    ASK_ID, ID, ASK_MAPPING, MAPPING, ASK_CAPABILITIES, CAPABILITIES, ASK_PIN_STATE, PIN_STATE,
    EXTENDED_ANALOG, SERVO, STRING, FIRMWARE, SAMPLING,
})  # fmt: skip


def _read_capabilities(data: bytes) -> Capabilities | None:
    pins: list[Mapping[int, int]] = []
    pin: dict[int, int] = {}
    at = 0
    while at < len(data):
        if data[at] == _PIN_ENDS:
            pins.append(pin)
            pin = {}
            at += 1
        elif at + 1 < len(data):
            pin[data[at]] = data[at + 1]
            at += 2
        else:
            return None
    return None if pin else Capabilities(tuple(pins))

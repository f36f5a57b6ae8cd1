"""A simulated Arduino Uno with StandardFirmata 2.5.

It shares nothing with the broker's codec on purpose, and reads as the firmware does: byte by byte, with room for 64
data bytes, and taking every byte before F7 for data of a system-exclusive message.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from psiu_broker.simulator.robot import Heard, Reply, Robot

INPUT: Final = 0
OUTPUT: Final = 1
ANALOG: Final = 2
PWM: Final = 3
SERVO: Final = 4
I2C: Final = 6
PULLUP: Final = 11

PINS: Final = 20
FIRST_ANALOG: Final = 14
CHANNELS: Final = PINS - FIRST_ANALOG
PWM_PINS: Final = frozenset({3, 5, 6, 9, 10, 11})
PORTS: Final = 3
GREATEST_READING: Final = 1023

SAMPLING_S: Final = 0.019
LEAST_SAMPLING_S: Final = 0.001
ROOM: Final = 64
"""The data bytes of one message that it keeps."""

_DATA_BYTES: Final = {0xE0: 2, 0x90: 2, 0xC0: 1, 0xD0: 1, 0xF4: 2, 0xF5: 2}
_NONE: Final = 0x7F


@dataclass(frozen=True)
class Drift:
    """An analog input that goes up and down between two readings, once in `period_s`."""

    low: int = 0
    high: int = GREATEST_READING
    period_s: float = 10.0

    def at(self, now: float) -> int:
        share = (1 - math.cos(2 * math.pi * now / self.period_s)) / 2
        return round(self.low + (self.high - self.low) * share)


def modes_of(pin: int) -> Mapping[int, int]:
    """What a pin of the Uno can be, with the resolution in bits, in the order of the firmware; 0 and 1 are the line."""
    modes: dict[int, int] = {}
    if 2 <= pin < PINS:
        modes |= {INPUT: 1, PULLUP: 1, OUTPUT: 1}
    if FIRST_ANALOG <= pin < PINS:
        modes[ANALOG] = 10
    if pin in PWM_PINS:
        modes[PWM] = 8
    if 2 <= pin < FIRST_ANALOG:
        modes[SERVO] = 14
    if pin in (18, 19):
        modes[I2C] = 1
    return modes


class FirmataBoard(Robot):
    """A board of 20 pins, A0–A5 being 14–19. What it does with its outputs is in `modes` and `states`.

    After its boot (`boot_s`, during which it is deaf) it tells its version and `firmware` unasked. Digital inputs are
    looked at every 19 ms, or as often as the sampling interval where that is shorter. With `instance` it is a
    FirmataExpress board of that number. `resets_on_reopen`: losing the serial line resets it, as DTR does on an Uno.
    """

    protocol = "firmata"

    def __init__(
        self,
        name: str = "uno",
        *,
        firmware: str = "StandardFirmata.ino",
        instance: int | None = None,
        drifts: Mapping[int, Drift] | None = None,
        boot_s: float = 0.0,
        resets_on_reopen: bool = False,
    ) -> None:
        super().__init__()
        self.name = name
        self.firmware = firmware
        self.modes: list[int] = []
        self.states: list[int] = []
        self.pulses: dict[int, tuple[int, int]] = {}
        """The shortest and longest pulse of servos that were given them, in microseconds."""
        self.texts: list[str] = []
        """What it was told in strings, the newest ten."""
        self.resets = -1
        self._instance = instance
        self._drifts = dict(drifts or {})
        self._boot_s = boot_s
        self._resets_on_reopen = resets_on_reopen
        self._levels: dict[int, int] = {}
        self._now = 0.0
        self._boots_at: float | None = None
        self._greeted = False
        self._sampled = -math.inf
        self._sampling_s = SAMPLING_S
        self._reset()

    def set_pin(self, pin: int | str, level: float | None) -> None:
        """Apply a level to an input: 0 or 1, 0–1023 where it is analog; None: nothing is connected.

        Raises:
            ValueError: there is no such pin.
        """
        number = FIRST_ANALOG + int(pin[1:]) if isinstance(pin, str) and pin[:1] == "A" else int(pin)
        if not 2 <= number < PINS:
            raise ValueError(f"an Uno has pins 2–13 and A0–A5 (14–19), not {pin}")
        self._drifts.pop(number - FIRST_ANALOG, None)
        if level is None:
            self._levels.pop(number, None)
        else:
            self._levels[number] = int(level)

    def press_reset(self) -> None:
        """Press the button: everything is forgotten, and the boot message comes again."""
        self._boots_at = None
        self._greeted = False
        self._reset()

    def receive(self, data: bytes, now: float) -> list[Reply]:
        self.advance(now)
        if not self._greeted and not self._awake():
            return []
        told = self._boot()
        for byte in data:
            told += self._hear(byte)
        return [(0.0, each) for each in told]

    def boundary(self) -> None:
        self._command = 0
        self._wanted = 0
        self._in_sysex = False
        if self._resets_on_reopen:
            self.press_reset()

    def hello(self) -> bytes:
        self._greeted = True
        return bytes((0xF9, 2, 5)) + self._told_firmware()

    def advance(self, now: float) -> None:
        self._now = now
        if self._boots_at is None:
            self._boots_at = now + self._boot_s

    def telemetry(self) -> bytes:
        """Whatever is to be reported now; often nothing."""
        if not self._awake():
            return b""
        told = self._boot()
        for port in range(PORTS):
            if self._reported_ports[port]:
                told += self._port(port, force=False)
        if self._now - self._sampled >= self._sampling_s - 1e-6:
            self._sampled = self._now
            for channel in range(CHANNELS):
                if self._reported_channels[channel] and self.modes[FIRST_ANALOG + channel] == ANALOG:
                    told.append(self._channel(channel))
        return b"".join(told)

    def _awake(self) -> bool:
        return self._boots_at is not None and self._now >= self._boots_at

    def _boot(self) -> list[bytes]:
        return [] if self._greeted else [self.hello()]

    def _reset(self) -> None:
        self.resets += 1
        self._command = 0
        self._channel_number = 0
        self._wanted = 0
        self._in_sysex = False
        self._data = bytearray()
        self.modes = [ANALOG if pin >= FIRST_ANALOG else OUTPUT for pin in range(PINS)]
        self.states = [0] * PINS
        self.pulses = {}
        self._inputs = [0] * PORTS
        self._reported_ports = [False] * PORTS
        self._reported_channels = [False] * CHANNELS
        self._last_masks = [0] * PORTS
        self._sampled = -math.inf
        self._sampling_s = self.telemetry_s = SAMPLING_S

    def _hear(self, byte: int) -> list[bytes]:
        if self._in_sysex:
            if byte == 0xF7:
                self._in_sysex = False
                return self._sysex(bytes(self._data)) if self._data else []
            if len(self._data) < ROOM:
                self._data.append(byte)
            return []
        if self._wanted and byte < 0x80:
            self._data.append(byte)
            self._wanted -= 1
            return [] if self._wanted else self._obey(self._command, self._channel_number, self._data)
        if byte < 0x80:
            return []
        self._command = byte if byte >= 0xF0 else byte & 0xF0
        self._channel_number = byte & 0x0F
        self._data = bytearray()
        self._wanted = _DATA_BYTES.get(self._command, 0)
        self._in_sysex = byte == 0xF0
        if byte == 0xFF:
            self._note("reset")
            self._reset()
        elif byte == 0xF9:
            self._note("version")
            return [bytes((0xF9, 2, 5))]
        return []

    def _obey(self, command: int, number: int, data: Sequence[int]) -> list[bytes]:
        value = data[0] | data[1] << 7 if len(data) > 1 else data[0]
        match command:
            case 0xE0:
                self._note("analog", number, value)
                self._write_analog(number, value)
            case 0x90:
                self._note("digital", number, value)
                self._write_port(number, value)
            case 0xC0:
                self._note("report-analog", number, value)
                return self._report_channel(number, value != 0)
            case 0xD0:
                self._note("report-digital", number, value)
                if number < PORTS:
                    self._reported_ports[number] = value != 0
                    return self._port(number, force=True) if value else []
            case 0xF4:
                self._note("pin-mode", data[0], data[1])
                return self._set_mode(data[0], data[1])
            case 0xF5:
                self._note("pin-value", data[0], data[1])
                if 2 <= data[0] < PINS and self.modes[data[0]] == OUTPUT:
                    self.states[data[0]] = data[1]
        return []

    def _sysex(self, message: bytes) -> list[bytes]:
        command, data = message[0], message[1:]
        self._note(f"sysex/{command:02x}", *data)
        if command == 0x79:
            return [self._told_firmware()]
        if command == 0x6B:
            pins = (bytes(each for pair in modes_of(pin).items() for each in pair) for pin in range(PINS))
            return [b"\xf0\x6c" + b"".join(pin + bytes((_NONE,)) for pin in pins) + b"\xf7"]
        if command == 0x69:
            channels = (pin - FIRST_ANALOG if pin >= FIRST_ANALOG else _NONE for pin in range(PINS))
            return [b"\xf0\x6a" + bytes(channels) + b"\xf7"]
        if command == 0x6D and data:
            return [self._told_state(data[0])]
        if command == 0x51 and self._instance is not None:
            return [bytes((0xF0, 0x52, self._instance, 0xF7))]
        return self._set_up(command, data)

    def _set_up(self, command: int, data: bytes) -> list[bytes]:
        if command == 0x6F and len(data) > 1:
            self._write_analog(data[0], sum(byte << 7 * place for place, byte in enumerate(data[1:4])))
        elif command == 0x70 and len(data) > 4 and SERVO in modes_of(data[0]):
            self.pulses[data[0]] = (data[1] | data[2] << 7, data[3] | data[4] << 7)
            return self._set_mode(data[0], SERVO)
        elif command == 0x71:
            codes = (low | high << 7 for low, high in zip(data[::2], data[1::2], strict=False))
            self.texts = [*self.texts[-9:], "".join(map(chr, codes))]
        elif command == 0x7A and len(data) > 1:
            self._sampling_s = max(LEAST_SAMPLING_S, (data[0] | data[1] << 7) / 1000)
            self.telemetry_s = min(SAMPLING_S, self._sampling_s)
        return []

    def _set_mode(self, pin: int, mode: int) -> list[bytes]:
        if pin >= PINS:
            return []
        told: list[bytes] = []
        if pin >= FIRST_ANALOG:
            told += self._report_channel(pin - FIRST_ANALOG, mode == ANALOG)
        if pin >= 2:
            bit = 1 << pin % 8
            takes = mode in (INPUT, PULLUP)
            self._inputs[pin // 8] = self._inputs[pin // 8] | bit if takes else self._inputs[pin // 8] & ~bit
        self.states[pin] = 0
        if mode in modes_of(pin):
            self.modes[pin] = mode
            self.states[pin] = int(mode == PULLUP)
        elif mode not in (INPUT, OUTPUT, ANALOG, PWM, SERVO, I2C, PULLUP):
            told.append(self._string("Unknown pin mode"))
        return told

    def _write_analog(self, pin: int, value: int) -> None:
        if pin < PINS and self.modes[pin] in (PWM, SERVO):
            self.states[pin] = value

    def _write_port(self, port: int, mask: int) -> None:
        for pin in range(max(2, 8 * port), min(PINS, 8 * port + 8)):
            if self.modes[pin] in (OUTPUT, INPUT):
                self.states[pin] = mask >> pin % 8 & 1

    def _report_channel(self, channel: int, on: bool) -> list[bytes]:
        if channel >= CHANNELS:
            return []
        self._reported_channels[channel] = on
        return [self._channel(channel)] if on else []

    def _channel(self, channel: int) -> bytes:
        drift = self._drifts.get(channel)
        value = self._levels.get(FIRST_ANALOG + channel, 0) if drift is None else drift.at(self._now)
        value = max(0, min(GREATEST_READING, value))
        return bytes((0xE0 | channel, value & 0x7F, value >> 7))

    def _port(self, port: int, *, force: bool) -> list[bytes]:
        mask = 0
        for pin in range(8 * port, min(PINS, 8 * port + 8)):
            if self._inputs[port] >> pin % 8 & 1 and self._levels.get(pin, self.states[pin]):
                mask |= 1 << pin % 8
        if mask == self._last_masks[port] and not force:
            return []
        self._last_masks[port] = mask
        return [bytes((0x90 | port, mask & 0x7F, mask >> 7))]

    def _told_firmware(self) -> bytes:
        name = b"".join(bytes((byte & 0x7F, byte >> 7)) for byte in self.firmware.encode())
        return b"\xf0\x79\x02\x05" + name + b"\xf7"

    def _told_state(self, pin: int) -> bytes:
        if pin >= PINS:
            return bytes((0xF0, 0x6E, pin, 0xF7))
        state = self.states[pin]
        more = bytes((state >> 7 & 0x7F,)) if state > 0x7F else b""
        more += bytes((state >> 14 & 0x7F,)) if state >= 1 << 14 else b""
        return bytes((0xF0, 0x6E, pin, self.modes[pin], state & 0x7F)) + more + b"\xf7"

    @staticmethod
    def _string(text: str) -> bytes:
        return b"\xf0\x71" + b"".join(bytes((byte & 0x7F, byte >> 7)) for byte in text.encode()) + b"\xf7"

    def _note(self, subject: str, *parameters: int) -> None:
        self.note(Heard(self._now, "", subject, tuple(map(str, parameters))))

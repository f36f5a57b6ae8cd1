"""A robot played as a Firmata board: programs write and read its pins, and mean the robot.

The board answers at once for itself: its name is the robot's, its pins are those of the map. What a program writes to
a pin becomes a call, of which only the newest counts; what the robot tells, or answers when it is asked, is what the
pin reads. Nothing is reported of which the robot has said nothing, and nothing more often than it says it.
"""

from collections import Counter, defaultdict
from collections.abc import Hashable, Iterator, Sequence
from math import inf
from typing import Any, ClassVar, Final

from psiu_broker.codecs import firmata
from psiu_broker.codecs.firmata_messages import (
    ASK_CAPABILITIES_MESSAGE,
    ASK_FIRMWARE_MESSAGE,
    ASK_ID_MESSAGE,
    ASK_MAPPING_MESSAGE,
    ASK_VERSION_MESSAGE,
    MODES,
    RESET_MESSAGE,
    AnalogMapping,
    AnalogMessage,
    AskPinState,
    Capabilities,
    DigitalMessage,
    Firmware,
    Identity,
    Message,
    PinMode,
    PinState,
    PinValue,
    ReportAnalog,
    ReportDigital,
    Sampling,
    ServoConfig,
    Simple,
    Text,
    Version,
    mode_name,
    read,
)
from psiu_broker.frame import Frame
from psiu_broker.messages import Answer, Value
from psiu_broker.profiles.firmata_map import (
    PWM_GREATEST,
    SERVO_GREATEST_DEG,
    SHORTEST_PULSE_US,
    FirmataMap,
    Layout,
    PlayedPin,
)
from psiu_broker.profiles.persona import Call, Persona, Say
from psiu_broker.profiles.profile import Description
from psiu_broker.profiles.rarely import Rarely

VERSION: Final = (2, 5)
SAMPLING_S: Final = 0.019
BOOT_S: Final = 0.25
"""After opening a port libraries set it up and throw away what has come; real boards take longer to boot."""
COMPLAINTS_AT_ONCE: Final = 3
COMPLAIN_EVERY_S: Final = 1.0
"""In the long run, about one pin: a program may write it a hundred times a second."""
LONGEST_TEXT: Final = 120
_LONGEST_PULSE_US: Final = 2400
_INPUTS: Final = frozenset({MODES["input"], MODES["pullup"]})

Actions = list[Say | Call]


class _State:
    """What a pin is at the moment."""

    __slots__ = ("chosen", "mode", "pending", "pulses", "reported_at", "reporting", "unsure", "value", "written")

    def __init__(self, mode: int) -> None:
        self.mode = mode
        self.chosen = False
        """Whether the program chose the mode; a pin that it never spoke of is not touched with the rest of its port."""
        self.written: int | None = None
        self.unsure = False
        """What was written last did not reach the robot."""
        self.value: int | None = None
        """What it reads; None: the robot has not said."""
        self.reporting = False
        self.pending = False
        self.reported_at = -inf
        self.pulses = (SHORTEST_PULSE_US, _LONGEST_PULSE_US)


class _Poll:
    """One question that is asked again and again for some pins."""

    __slots__ = ("at", "every_s", "numbers", "under_way")

    def __init__(self) -> None:
        self.numbers: list[int] = []
        self.every_s = inf
        self.at = -inf
        self.under_way = False


class FirmataPersona(Persona):
    """One program's board."""

    Options: ClassVar[type[FirmataMap]] = FirmataMap

    def __init__(self, name: str, codec: Any, options: FirmataMap) -> None:
        self._name = name
        self._id = options.id
        self._layout = Layout(options)
        self._rarely = Rarely()
        self._boots_at: float | None = None
        self._shared = Counter(pin.command for pin in self._layout.pins.values())
        self._numbers_of: dict[str, list[int]] = defaultdict(list)
        self._polls: dict[tuple[str, tuple[Value, ...]], _Poll] = {}
        for number, pin in self._layout.pins.items():
            if pin.reading is not None:
                self._numbers_of[pin.reading].append(number)
            if pin.question is not None and pin.poll_s is not None:
                poll = self._polls.setdefault(pin.question, _Poll())
                poll.numbers.append(number)
                poll.every_s = min(poll.every_s, pin.poll_s)
        self._begin()

    def _begin(self) -> None:
        """All pins as after a reset."""
        self._states = {number: _State(self._layout.first_mode(number)) for number in self._layout.names}
        self._sampling_s = SAMPLING_S
        self._ports: dict[int, int] = {}
        """The mask last reported of each port that is reported; -1: none yet."""

    def opened(self, now: float) -> Sequence[Say | Call]:
        """Opening its port resets a board, which then tells its versions by itself."""
        self._begin()
        self._boots_at = now + BOOT_S
        return []

    def heard(self, frame: Frame, now: float) -> Sequence[Say | Call]:
        match read(frame.payload):
            case Simple() as simple:
                return self._asked(simple)
            case AskPinState(number):
                return [self._pin_state(number)]
            case PinMode(number, mode):
                return self._set_mode(number, mode, now)
            case ServoConfig(number, shortest, longest):
                actions = self._set_mode(number, MODES["servo"], now)
                state = self._states.get(number)
                if state is not None and state.mode == MODES["servo"] and shortest < longest:
                    state.pulses = (shortest, longest)
                return actions
            case AnalogMessage(number, value):
                return self._write(number, value, now)
            case DigitalMessage(port, mask):
                return self._write_port(port, mask, now)
            case PinValue(number, on):
                return self._switch(number, on, now)
            case message:
                return self._report(message, now)

    def answered(self, call: Call, answer: Answer | None, error: str, now: float) -> Sequence[Say]:
        failed = error or (_trouble(call, answer) if answer is not None else "")
        poll = self._polls.get((call.command, call.parameters))
        if poll is not None and poll.under_way:
            poll.under_way = False
            if not failed and answer is not None and answer.values:
                return self._read(poll.numbers, answer.values[0], now)
        if not failed:
            return []
        for number, pin in self._layout.pins.items():
            if pin.command == call.command:
                # It is not as it was written, so that writing the same again is worth a call.
                self._states[number].unsure = True
        return self._complain(call.command, failed, now)

    def told(self, description: Description, now: float) -> Sequence[Say]:
        said: list[Say] = []
        for name, value in _readings(description):
            said += self._read(self._numbers_of.get(name, ()), value, now)
        return said

    def waits_until(self) -> float | None:
        times = [poll.at for poll in self._polls.values() if self._is_wanted(poll)]
        times += [state.reported_at + self._sampling_s for state in self._states.values() if state.pending]
        if self._boots_at is not None:
            times.append(self._boots_at)
        return min(times, default=None)

    def due(self, now: float) -> Sequence[Say | Call]:
        actions: Actions = []
        if self._boots_at is not None and self._boots_at <= now:
            self._boots_at = None
            actions += [_say(Version(*VERSION)), self._firmware()]
        for (command, parameters), poll in self._polls.items():
            if self._is_wanted(poll) and poll.at <= now:
                poll.under_way = True
                poll.at = now + poll.every_s
                actions.append(Call(command, parameters))
        for number, state in self._states.items():
            if state.pending:
                actions += self._report_analog(number, now)
        return actions

    # What the board answers for itself.

    def _asked(self, question: Simple) -> Actions:
        numbers = self._layout.names
        if question == ASK_VERSION_MESSAGE:
            return [_say(Version(*VERSION))]
        if question == ASK_FIRMWARE_MESSAGE:
            return [self._firmware()]
        if question == ASK_CAPABILITIES_MESSAGE:
            return [_say(Capabilities([self._layout.modes(number) for number in numbers]))]
        if question == ASK_MAPPING_MESSAGE:
            return [_say(AnalogMapping([self._layout.channel(number) for number in numbers]))]
        if question == ASK_ID_MESSAGE:
            return [_say(Identity(self._id))]
        return self._reset() if question == RESET_MESSAGE else []

    def _firmware(self) -> Say:
        return _say(Firmware(*VERSION, self._name))

    def _pin_state(self, number: int) -> Say:
        state = self._states.get(number)
        if state is None:
            return _say(PinState(number, None))
        return _say(PinState(number, state.mode, int(state.mode == MODES["pullup"]) or state.written or 0))

    def _reset(self) -> Actions:
        """What was switched on goes off, as all outputs of a board do; a servo stays where it is."""
        actions: Actions = []
        for number, state in self._states.items():
            pin = self._layout.pins.get(number)
            if pin is not None and pin.mode != "servo" and (state.written or state.unsure):
                actions += self._level(pin, number, 0, 0.0)
        self._begin()
        return actions

    # What a program writes.

    def _set_mode(self, number: int, mode: int, now: float) -> Actions:
        state = self._states.get(number)
        if state is None or mode not in self._layout.modes(number):
            return [*self._complain(number, f"{self._pin(number)} cannot be {mode_name(mode)}", now)]
        actions: Actions = []
        if state.mode != mode:
            pin = self._layout.pins.get(number)
            if pin is not None and pin.mode != "servo" and (state.written or state.unsure):
                actions = self._level(pin, number, 0, now)  # as a board does: what was driven goes off
            state.mode = mode
            state.written = None
        state.chosen = True
        return actions

    def _write(self, number: int, value: int, now: float) -> Actions:
        """A level or an angle; it counts whatever mode the program forgot to set."""
        pin = self._layout.pins.get(number)
        if pin is None or pin.command is None or pin.mode == "output":
            return [*self._complain(number, f"{self._pin(number)} takes neither a level nor an angle", now)]
        state = self._states[number]
        if pin.mode == "pwm":
            return self._level(pin, number, min(value, PWM_GREATEST), now)
        if value >= SHORTEST_PULSE_US:
            shortest, longest = state.pulses
            value = round(SERVO_GREATEST_DEG * (min(max(value, shortest), longest) - shortest) / (longest - shortest))
        return self._level(pin, number, min(value, SERVO_GREATEST_DEG), now)

    def _write_port(self, port: int, mask: int, now: float) -> Actions:
        """Eight pins at once: those that change, and those that the program made outputs and writes first."""
        actions: Actions = []
        for bit in range(8):
            number, on = 8 * port + bit, mask >> bit & 1
            state = self._states.get(number)
            if state is None or number not in self._layout.pins or state.mode != MODES["output"]:
                continue
            known = state.written is not None and not state.unsure
            if on != bool(state.written) if known else on or state.chosen or state.unsure:
                actions += self._switch(number, bool(on), now)
        return actions

    def _switch(self, number: int, on: bool, now: float) -> Actions:
        pin = self._layout.pins.get(number)
        if pin is None or pin.command is None or pin.mode == "servo" or self._states[number].mode != MODES["output"]:
            return [*self._complain(number, f"{self._pin(number)} is no output", now)]
        return self._level(pin, number, (1 if pin.mode == "output" else PWM_GREATEST) if on else 0, now)

    def _level(self, pin: PlayedPin, number: int, value: int, now: float) -> Actions:
        if pin.command is None:
            return []
        try:
            parameters = pin.switched(value > 0) if pin.mode == "output" else pin.scaled(value)
        except ValueError as error:
            return [*self._complain(number, str(error), now)]
        self._states[number].written = value
        self._states[number].unsure = False
        # Two pins with one command would else count as set-points of each other.
        return [Call(pin.command, parameters, newest=self._shared[pin.command] == 1)]

    # What a program reads.

    def _report(self, message: Message | None, now: float) -> Actions:
        match message:
            case Sampling(interval_ms):
                self._sampling_s = max(interval_ms, 1) / 1000
            case ReportAnalog(channel, on):
                number = self._layout.digital + channel
                if self._layout.channel(number) is not None:
                    state = self._states[number]
                    state.reporting = on
                    state.pending = False
                    return [*self._report_analog(number, now)] if on else []
            case ReportDigital(port, True):
                self._ports[port] = -1
                return [*self._report_port(port)]
            case ReportDigital(port, False):
                self._ports.pop(port, None)
        return []

    def _read(self, numbers: Sequence[int], reading: Value, now: float) -> list[Say]:
        said: list[Say] = []
        for number in numbers:
            pin, state = self._layout.pins[number], self._states[number]
            is_analog = self._layout.channel(number) is not None
            value = pin.level(reading) if is_analog else pin.high(reading)
            if value is None:
                said += self._complain(
                    number, f"{pin.reading} reads {reading}, which {self._pin(number)} cannot show", now
                )
                continue
            state.value = value
            if not is_analog:
                said += self._report_port(number // 8)
            elif now >= state.reported_at + self._sampling_s:
                said += self._report_analog(number, now)
            else:
                state.pending = state.reporting
        return said

    def _report_analog(self, number: int, now: float) -> list[Say]:
        state, channel = self._states[number], self._layout.channel(number)
        if state.value is None or channel is None or not state.reporting:
            return []
        if state.pending and now < state.reported_at + self._sampling_s:
            return []
        state.pending = False
        state.reported_at = now
        return [_say(AnalogMessage(channel, state.value))]

    def _report_port(self, port: int) -> list[Say]:
        """The port's inputs, if they are reported, have changed, and the robot has told of any."""
        last = self._ports.get(port)
        if last is None:
            return []
        values = {
            bit: state.value
            for bit in range(8)
            if (state := self._states.get(8 * port + bit)) is not None
            and state.mode in _INPUTS
            and state.value is not None
            and self._layout.channel(8 * port + bit) is None
        }
        mask = sum(value << bit for bit, value in values.items())
        if not values or mask == last:
            return []
        self._ports[port] = mask
        return [_say(DigitalMessage(port, mask))]

    def _is_wanted(self, poll: _Poll) -> bool:
        """Whether it is to be asked: nobody else has its answer, and a program waits for what it tells."""
        return not poll.under_way and any(
            self._states[number].reporting or (self._layout.channel(number) is None and number // 8 in self._ports)
            for number in poll.numbers
        )

    def _pin(self, number: int) -> str:
        return f"pin {self._layout.names.get(number, number)}"

    def _complain(self, about: Hashable, text: str, now: float) -> list[Say]:
        """Firmata's way of telling errors: a string for a person."""
        if not self._rarely.may(about, now, COMPLAIN_EVERY_S, COMPLAINTS_AT_ONCE):
            return []
        return [_say(Text(text[:LONGEST_TEXT]))]


def _say(message: Message) -> Say:
    return Say(firmata.subject(message.wire, "board"), message.wire)


def _trouble(call: Call, answer: Answer) -> str:
    if answer.status != "falha":
        return ""
    return answer.remark or " ".join(map(str, (call.command, *call.parameters, "falha", *answer.values)))


def _readings(description: Description) -> Iterator[tuple[str, Value]]:
    """Each value that a frame tells, by name."""
    yield from description.get("readings", {}).items()
    command = description.get("command")
    if command is None:
        return
    value = description.get("value")
    parameters = description.get("parameters") or ()
    if value is not None:
        yield command, value
    elif parameters:
        yield command, parameters[0]

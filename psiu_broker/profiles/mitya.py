"""Robot Mitya as callers see it: each letter under a readable name, its range and unit, and what counts as an answer.

A 2012 body says nothing of a command that it carries out; what it cannot do it says soon. The firmware of 2013 and
2014 answers each message on a serial link, but the phone passes only errors on to its UDP port.
"""

import difflib
import math
from collections import deque
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar, Final, NamedTuple, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from psiu_broker.codecs import mitya
from psiu_broker.codecs.mitya import BY_WORD, DONE, LETTERS, ONE_SHOTS, REALIGN, SCRIPT, STOP, Version
from psiu_broker.errors import CallError
from psiu_broker.frame import Frame
from psiu_broker.messages import Command, Value
from psiu_broker.profiles.profile import SENT, Description, Profile, Reading, Reply, Request, RobotOptions
from psiu_broker.profiles.psiu import COUNT, NAME, SHOW, SHOW_PRINTED, typed
from psiu_broker.routing.outbox import STOP_WORDS, is_stop

__all__ = ["ERRORS", "MOODS", "MityaCommand", "MityaProfile", "Realigner", "meaning"]

ERRORS: Final[Mapping[int, str]] = MappingProxyType(
    {
        0x01: "not a message: a letter and four hexadecimal digits were expected",
        0x02: "unknown command",
        0x03: "a command that a script cannot hold",
        0x04: "the commands of a script are in a wrong order",
        0x05: "no memory for so long a script",
        0x06: "more actions than the script has room for",
        0x07: "a command that only a script can hold",
        0x08: "a digit where a letter was expected",
        0x09: "there is no such voltage divider",
    }
)
"""The meaning of the low byte of an error; the high byte says who met it (`meaning`)."""

MOODS: Final[Mapping[str, int]] = MappingProxyType(
    {
        "normal": 0x0001, "happy": 0x0002, "sad": 0x0003, "angry": 0x0004, "ill": 0x0005,
        "very-happy": 0x0101, "playful": 0x0102, "very-sad": 0x0103, "furious": 0x0104, "musical": 0x0105,
    }
)  # fmt: skip
_SINCE_2013: Final = frozenset({"very-happy", "furious", "musical"})

SLOTS: Final = 10
"""Scripts that a body can hold, 0–9; it takes no notice of 0A, which the document allows."""
FILLERS: Final = 5
"""How often a body may be moved on by one byte; after so many it has been asked at each of the five places."""
PLAY: Final = "play"

_BURSTS_KEPT: Final = 64
_STOPS: Final = ("pare",)
_RESERVED: Final = STOP_WORDS | {NAME, COUNT, SHOW, SHOW_PRINTED}
_SAID_BY_ROBOTS: Final = frozenset({"error", "telemetry", "hit"})
_RECORDED_ONLY: Final = frozenset({"room", "wait"})
_LOW, _HIGH = -0x8000, 0xFFFF
_ASK: Final = b"W0000"
_FILLER: Final = b"0"


def meaning(code: int) -> str:
    """An error in words; never raises."""
    words = ERRORS.get(code & 0xFF, f"error {code & 0xFF}")
    return f"{'the head' if code >> 8 else 'the body'}: {words}"


class MityaCommand(BaseModel):
    """A command of the user's own, or another form for one that is built in.

    ``marcha = {letter = "D", minimum = -100, maximum = 100, unit = "%", scale = 2.55}``: what is sent is the value
    times `scale`, plus `offset`, rounded.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    letter: str = Field(pattern="^[A-Za-z*=]$", description="the letter of its message")
    minimum: float = Field(_LOW, allow_inf_nan=False, description="the least value that a caller may give")
    maximum: float = Field(0x7FFF, allow_inf_nan=False, description="the greatest value that a caller may give")
    unit: str | None = Field(None, description="the unit of these values")
    scale: float = Field(1.0, allow_inf_nan=False, description="what one of this unit is in the message")
    offset: float = Field(0.0, allow_inf_nan=False, description="what 0 of this unit is in the message")
    fixed: int | None = Field(None, ge=_LOW, le=_HIGH, description="the command takes no value and sends this one")
    description: str | None = Field(None, description="what the robot then does, for a person")

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if not self.minimum <= self.maximum:
            raise ValueError(f"minimum {self.minimum:g} is above maximum {self.maximum:g}")
        if self.fixed is None and self.scale == 0:
            raise ValueError("scale 0 sends the same whatever the value; write fixed = ... for that")
        for value in (self.minimum, self.maximum):
            sent = round(value * self.scale + self.offset)
            if self.fixed is None and not _LOW <= sent <= _HIGH:
                raise ValueError(f"{value:g} would be sent as {sent}, which is not {_LOW} to {_HIGH}")
        return self


class _Form(NamedTuple):
    """How a command becomes a message: its word, its letter, and what its value may be."""

    word: str
    letter: str
    minimum: float
    maximum: float
    unit: str | None = None
    scale: float = 1.0
    offset: float = 0.0
    names: Mapping[str, int] = MappingProxyType({})
    """Values by name. With `named_only` there are no others."""
    named_only: bool = False
    default: int | None = None
    """The value that is meant where none is given; None: one must be."""
    fixed: bool = False
    description: str | None = None

    @property
    def takes(self) -> str:
        """What the command takes, for a person."""
        if self.fixed:
            return "no parameters"
        if self.named_only:
            return ", ".join(f"{name} ({value})" for name, value in self.names.items())
        span = f"{self.minimum:g}" if self.minimum == self.maximum else f"{self.minimum:g} to {self.maximum:g}"
        names = f", {' or '.join(self.names)}" if self.names else ""
        none = ", or nothing" if self.default is not None else ""
        return f"{span}{f' {self.unit}' if self.unit else ''}{names}{none}"

    def command(self, name: str, aliases: list[str]) -> Command:
        whole = self.scale == 1 and self.offset == 0
        values = 0 if self.fixed or self.default is not None else 1
        numbered = not self.fixed
        return Command(
            name=name,
            ints=values if whole else 0,
            floats=0 if whole else values,
            minimum=math.ceil(self.minimum) if numbered else None,
            maximum=math.floor(self.maximum) if numbered else None,
            unit=self.unit,
            description=self.description,
            aliases=aliases,
        )

    def value(self, parameters: Sequence[Value]) -> int:
        """The value of the message.

        Raises:
            ValueError: `parameters` are not what the command takes.
        """
        if not parameters and self.default is not None:
            return self.default
        if len(parameters) != 1 or self.fixed:
            raise ValueError(self._refusal(parameters))
        number = _number(parameters[0], self.names)
        if number is None or not self.minimum <= number <= self.maximum:
            raise ValueError(self._refusal(parameters))
        if self.named_only and number not in self.names.values():
            raise ValueError(self._refusal(parameters))
        sent = number * self.scale + self.offset
        if self.scale == 1 and self.offset == 0 and sent != int(sent):
            raise ValueError(self._refusal(parameters))
        return round(sent)

    def shown(self, value: int) -> Value:
        """What a message's value is in the unit of the command."""
        for name, each in self.names.items() if self.named_only else ():
            if each == value:
                return name
        signed = value - 0x10000 if value > 0x7FFF and self.minimum < 0 else value
        if self.scale == 1 and self.offset == 0:
            return signed
        return round((signed - self.offset) / self.scale, 2)

    def _refusal(self, parameters: Sequence[Value]) -> str:
        return f"takes {self.takes}, got {' '.join(map(str, parameters)) or 'nothing'}"


class Realigner:
    """Brings a 2012 body, which cuts what it hears in fives for ever, back into step.

    ``W0000`` is no command outside a script: a body in step objects with E0007, one out of step with E0001, since to
    it W stands for a digit. So it is asked, and after each E0001 asked again behind one more byte, five times at most.
    What makes it begin is any other error: an E0002 may be a command cut at a wrong place, and E0003 to E0006 end a
    recording, which noise may have begun. E0001 ends one too, so that nothing asked after these disturbs one. It needs
    no clock: an answer that does not come is not waited for.

    The first question is put twice: a body that somebody left recording may take one W0000 for a delay of its script,
    but of two in a row one has no command before it, and ends the recording.
    """

    def __init__(self) -> None:
        self.asking = False
        """An answer is awaited."""
        self.in_step: bool | None = None
        """What the last answer told; None: nothing yet."""
        self._fillers = 0
        self._awaited = 0
        self._odd = False
        """It has said of something that it is no command, since the first question."""
        self._out = False
        self._taken: Frame | None = None

    def next(self) -> Sequence[bytes]:
        """What to send now: the next of what `heard` wants, else the first question."""
        if self._out:
            self._out = False
            self._fillers += 1
            self._awaited = 1
            return (_FILLER + _ASK,)
        self.asking, self._fillers, self._awaited, self._odd = True, 0, 2, False
        return (_ASK, _ASK)

    def heard(self, frame: Frame) -> bool:
        """Take note of a frame of the body; True if something is to be sent: call `next`."""
        if frame.subject != "error" or not mitya.is_message(frame.payload):
            return False
        code = mitya.number(frame.payload)
        if not self.asking:
            self._taken = frame if code == 0x07 and self._awaited else None
            self._awaited = 0
            return 0 < code < 0x07
        if code in (0x04, 0x06, 0x07):  # W was read as a letter, by a body that was recording or not
            self.asking, self.in_step, self._out, self._taken = False, True, False, frame
            self._awaited -= 1
        elif code == 0x01:
            self.in_step, self._taken = False, frame
            self._awaited -= 1
            if self._awaited <= 0:
                self.asking = self._out = self._fillers < FILLERS
        elif code == 0x02 and self._odd:  # the answer was lost
            self.asking, self._taken = False, None
            return True
        elif code == 0x02:  # behind fillers five zeros, of which it asked for no more than four
            self._odd, self._taken = True, frame if self._fillers else None
        return self._out

    def forget(self) -> None:
        """Something else is sent now: an answer that has not come yet does not come, or is to that."""
        if self.in_step is not False:
            self.asking = self._out = False
            self._awaited = 0

    def took(self, frame: Frame) -> bool:
        """Whether `frame` was the answer to what was asked here, and so is to no command."""
        return frame is self._taken


class MityaProfile(Profile):
    """One Robot Mitya: a body on a serial link, or a phone with its body at a UDP port (`datagrams`)."""

    protocol: ClassVar[str] = mitya.PROTOCOL

    class Options(RobotOptions):
        """What ``[robots.NAME]`` may hold for a Robot Mitya."""

        error_ms: int = Field(
            300, ge=20, le=60000, description="how long an error may take where success is silent: 2012, or over UDP"
        )
        commands: dict[str, MityaCommand] = Field(
            {}, description='commands of your own, as marcha = {letter = "D", minimum = 0, maximum = 255}'
        )

    def __init__(
        self,
        codec: mitya.Mitya.Options | None = None,
        robot: Options | None = None,
        timeout_s: float = 2.0,
        *,
        datagrams: bool = False,
    ) -> None:
        """Make the robot.

        Raises:
            ValueError: a command of `robot` has a name that is taken, or a letter that the version does not have.
        """
        codec, robot = codec or mitya.Mitya.Options(), robot or self.Options()
        self.version: Version = codec.version
        self._forms = {name: form for name, form in _forms(self.version).items() if form.letter}
        for name, command in robot.commands.items():
            self._forms[name] = _own(name, command, self.version)
        self._by_letter = {form.letter: name for name, form in reversed(self._forms.items()) if name != STOP}
        self._answers = self.version != "2012" and not datagrams
        self._timeout_s = timeout_s if self._answers else robot.error_ms / 1000
        self._burst = 2 * (codec.repeat or 1)
        self._realigner = Realigner() if self.version == "2012" and codec.realign and not datagrams else None
        self._bursts: deque[tuple[Request, list[Frame]]] = deque(maxlen=_BURSTS_KEPT)
        """What was heard so far of requests that are answered more than once."""
        self._volts: tuple[float, ...] = ()

    @classmethod
    def make(cls, codec: Any, robot: Any, timeout_s: float, *, datagrams: bool = False) -> Self:
        return cls(codec, robot, timeout_s, datagrams=datagrams)

    def commands(self) -> Sequence[Command]:
        """The motors, the servos, the gestures, the lights and scripts, then those that the configuration adds."""
        return [
            form.command(name, list(_STOPS) if name == STOP else [form.letter] if named == name else [])
            for name, form in self._forms.items()
            for named in (self._by_letter.get(form.letter),)
        ]

    def request(self, command: str, parameters: Sequence[Value]) -> Request:
        name = STOP if is_stop(command) else command if command in self._forms else self._by_letter.get(command)
        if name is None:
            raise self._unknown(command)
        form = self._forms[name]
        try:
            value = form.value(parameters)
        except ValueError as error:
            raise CallError("refused", f"{command} {error}") from None
        if self._realigner is not None:
            self._realigner.forget()
        question = form.word == "battery"
        payload = mitya.message(form.letter, value)
        return Request(form.word, payload, question, self._timeout_s, None if self._answers else SENT)

    def read(self, request: Request, frame: Frame) -> Reading | None:
        if not mitya.is_message(frame.payload):
            return None
        if self._realigner is not None and self._realigner.took(frame):
            return None
        if frame.subject == "telemetry" and request.subject == "battery":
            divider, volts = _volts(frame.payload)
            if divider != mitya.number(request.payload) >> 12 and self.version == "2014":
                return None
            self._volts = (volts,)
            return None if self._answers else Reply(None, self._volts, "V")
        if frame.subject == "error":
            code = mitya.number(frame.payload)
            if code == 0x07:
                return None  # an answer to W0000, which is no command of ours
            return self._last_of_burst(request, frame)
        if frame.subject == DONE:
            return self._last_of_burst(request, frame)
        return None

    def answers_to(self, request: Request) -> str:
        """All alike: neither an error nor ``#0000`` says of which command it tells."""
        return ""

    def greeting(self) -> Sequence[Request]:
        """The next question by which a 2012 body is realigned; the first one also ends what it may be recording."""
        if self._realigner is None:
            return ()
        return [Request(REALIGN, asked, True, self._timeout_s, SENT) for asked in self._realigner.next()]

    def learn(self, frame: Frame) -> bool:
        """True when the body may be out of step, and the next `greeting` asks on."""
        return self._realigner is not None and self._realigner.heard(frame)

    def describe(self, frame: Frame) -> Description:
        word = frame.subject.removeprefix(SCRIPT)
        if not mitya.is_message(frame.payload):
            return {"kind": "command", "command": frame.subject}
        value = mitya.number(frame.payload)
        if frame.subject == DONE:
            return {"kind": "response", "command": None, "status": "sucesso"}
        if frame.subject == "error":
            return {
                "kind": "error",
                "command": "error",
                "status": "falha",
                "parameters": [frame.payload.decode("ascii", "replace")],
                "remark": meaning(value),
            }
        if frame.subject == "telemetry":
            divider, volts = _volts(frame.payload)
            name = "battery" if divider == 0 else f"divider {divider}"
            return {"kind": "event", "command": word, "value": volts, "unit": "V", "readings": {name: volts}}
        if frame.subject == "hit":
            return {"kind": "event", "command": word, "parameters": [value]}
        if frame.subject == "script":
            return _script(value)
        return self._told(frame, word, value)

    def _told(self, frame: Frame, word: str, value: int) -> Description:
        form = next((each for each in self._forms.values() if each.word == word), None)
        shown: Value = mitya.signed(frame.payload) if form is None else form.shown(value)
        unit = "ms" if word == "wait" else None if form is None else form.unit
        told: Description = {"kind": "command", "command": frame.subject, "parameters": [shown], "unit": unit}
        if not isinstance(shown, str):
            told["value"] = float(shown)
        return told

    def _last_of_burst(self, request: Request, frame: Frame) -> Reply | None:
        """The robot answers each message, those of a burst or a stop too: what all these answers say together."""
        awaited = self._burst if request.subject in ONE_SHOTS else _answered(request.payload)
        if not self._answers or awaited == 1:
            return self._outcome(request, [frame])
        heard = next((heard for asked, heard in self._bursts if asked is request), None)
        if heard is None:
            heard = []
            self._bursts.append((request, heard))
        if not any(frame is each for each in heard):
            heard.append(frame)
        return self._outcome(request, heard) if len(heard) == awaited else None

    def _outcome(self, request: Request, heard: Sequence[Frame]) -> Reply:
        error = next((frame for frame in heard if frame.subject == "error"), None)
        if error is not None:
            text = error.payload.decode("ascii", "replace")
            return Reply("falha", (text,), remark=f"{text}, {meaning(mitya.number(error.payload))}")
        if request.subject != "battery" or not self._volts:
            return Reply("sucesso")
        volts, self._volts = self._volts, ()
        return Reply("sucesso", volts, "V")

    def _unknown(self, command: str) -> CallError:
        word = LETTERS[self.version].get(command, command)
        if word in _RECORDED_ONLY:
            return CallError("refused", f"{command} is part of a script: it is sent only while one is uploaded")
        if word in _SAID_BY_ROBOTS:
            return CallError("refused", f"{command} is for the robot to say")
        for version, letters in LETTERS.items():
            if command in letters and letters[command] in BY_WORD[self.version]:
                meant = BY_WORD[self.version][letters[command]]
                text = f"no command {command}: what {version} calls so is {meant} in {self.version}"
                return CallError("unknown_command", text)
        names = list(self._forms)
        close = difflib.get_close_matches(command, names, 1)
        meant = f"did you mean {close[0]}? " if close else ""
        return CallError("unknown_command", f"no command {command}: {meant}It has {', '.join(names)}")


_BATTERY: Final[Mapping[Version, str]] = {
    "2012": "",
    "2013": "measure the battery now and, unless 0, every so many milliseconds, 1000 at least",
    "2014": "measure the battery now and, unless 0, every so often: 0xNDDD is divider N, every DDD times 10 ms",
}


def _forms(version: Version) -> dict[str, _Form]:
    """The built-in commands; without a letter where the version has none."""
    letters = BY_WORD[version]
    moods = {name: value for name, value in MOODS.items() if version != "2012" or name not in _SINCE_2013}

    def form(word: str, low: float, high: float, unit: str | None, description: str, **more: Any) -> _Form:
        return _Form(word, letters.get(word, ""), low, high, unit, description=description, **more)

    return {
        "drive": form("drive", -255, 255, None, "the speed of both motors; 255 is full, below 0 is backwards"),
        "left": form("left", -255, 255, None, "the speed of the left motor"),
        "right": form("right", -255, 255, None, "the speed of the right motor"),
        STOP: form("drive", 0, 0, None, "stop both motors", fixed=True, default=0)._replace(word=STOP),
        "head-horizontal": form("head-horizontal", 0, 180, "deg", "turn the head; 90 is straight ahead"),
        "head-vertical": form("head-vertical", 0, 90, "deg", "raise or lower the head"),
        "turn-horizontal": form("turn-horizontal", _LOW, 0x7FFF, "cs", "turn the head steadily, so long a turn"),
        "turn-vertical": form("turn-vertical", _LOW, 0x7FFF, "cs", "raise the head steadily, so long a turn"),
        "tail": form("tail", 10, 170, "deg", "turn the tail; 90 is the middle"),
        "mood": form("mood", 1, max(moods.values()), None, "put on a face", names=moods, named_only=True),
        "headlights": form("headlights", 0, 1, None, "switch the headlights", names={"off": 0, "on": 1}),
        "wag": form("wag", 1, 2, None, "wag the tail: 1 evenly, 2 as a wave", default=1),
        "nod": form("nod", 1, 1, None, "nod: yes", default=1),
        "shake": form("shake", 1, 1, None, "shake the head: no", default=1),
        "fire": form("fire", 1, 1, None, "fire the infrared gun", default=1),
        "battery": form("battery", 0, _HIGH, None, _BATTERY[version], default=0),
        PLAY: form("script", 0, SLOTS - 1, None, "play the script of this number"),
    }


def _own(name: str, command: MityaCommand, version: Version) -> _Form:
    if name in _RESERVED or is_stop(name) or not name.isascii() or not name.isprintable() or " " in name or not name:
        taken = ", ".join(sorted(_RESERVED))
        raise ValueError(f"commands.{name}: expected one word, none of {taken}; call it something else")
    word = LETTERS[version].get(command.letter, mitya.LETTER + command.letter)
    if version != "2012" and command.letter in "ABCDEFabcdef":
        raise ValueError(f"commands.{name}: letter {command.letter} is a digit to a robot of {version}")
    if word in _RECORDED_ONLY or word == "script":
        raise ValueError(f"commands.{name}: letter {command.letter} is for scripts, which are uploaded and played")
    if command.fixed is not None:
        fixed = command.fixed
        return _Form(word, command.letter, fixed, fixed, default=fixed, fixed=True, description=command.description)
    return _Form(
        word,
        command.letter,
        command.minimum,
        command.maximum,
        command.unit,
        command.scale,
        command.offset,
        description=command.description,
    )


def _number(value: Value, names: Mapping[str, int]) -> int | float | None:
    if isinstance(value, str):
        if value.lower() in names:
            return names[value.lower()]
        if value[:2].lower() == "0x":
            try:
                return int(value, 16)
            except ValueError:
                return None
        value = typed(value)
    if isinstance(value, int):
        return value  # however great
    return None if isinstance(value, str) or not math.isfinite(value) else value


def _answered(payload: bytes) -> int:
    """How many of the messages are answered with ``#0000`` outside a recording: all but those that end one."""
    return sum(payload[at : at + 1] != b"Z" for at in range(0, len(payload), mitya.MESSAGE_BYTES))


def _volts(payload: bytes) -> tuple[int, float]:
    """The number of the voltage divider, and what it measured."""
    value = mitya.number(payload)
    return value >> 12, (value & 0x0FFF) / 100


def _script(value: int) -> Description:
    slot = value & 0xFF
    match value >> 8:
        case 0:
            return {"kind": "command", "command": PLAY, "parameters": [slot]}
        case 1:
            return {"kind": "command", "command": "record", "parameters": [slot]}
        case _:
            return {"kind": "event", "command": "recorded", "remark": "the recording of a script has ended"}

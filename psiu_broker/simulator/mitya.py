"""A simulated Robot Mitya: the body on a serial line, or the phone with its body at a UDP port."""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal, NamedTuple, get_args

from psiu_broker.simulator.robot import Heard, Reply, Robot

MityaVersion = Literal["2012", "2013", "2014"]

SLOTS: Final = 10
MEMORY: Final = 130
"""Actions that fit into the memory of a body, all its scripts together."""
GESTURES_KEPT: Final = 100
CLOCK_MS: Final = 65536
"""The clock of a script being played wraps: an action that is due later than this never comes."""

_DIGITS: Final = frozenset(b"0123456789ABCDEFabcdef")
_DOCUMENT: Final = {
    "L": "left", "R": "right", "D": "drive", "H": "head-horizontal", "V": "head-vertical", "T": "tail",
    "F": "mood", "I": "headlights", "t": "wag", "y": "nod", "n": "shake", "f": "fire", "h": "hit",
    "r": "script", "Z": "room", "W": "wait", "E": "error",
}  # fmt: skip
_2013: Final = {
    **{letter: word for letter, word in _DOCUMENT.items() if letter not in "DFfhE"},
    "G": "drive", "M": "mood", "s": "fire", "*": "hit", "#": "error",
    "=": "battery", "~": "telemetry", "h": "turn-horizontal", "v": "turn-vertical",
}  # fmt: skip
_2014: Final = {letter: word for letter, word in _2013.items() if word != "script"}
_LETTERS: Final[Mapping[MityaVersion, Mapping[str, str]]] = {"2012": _DOCUMENT, "2013": _2013, "2014": _2014}
_REFLEXES: Final = frozenset({0x0102, 0x0103, 0x0104})
"""Moods that a 2012 body acts out; any other is for the phone to show."""
_SERVOS: Final = {"head-horizontal": (0, 180), "head-vertical": (0, 90), "tail": (10, 170)}
_GESTURES: Final = frozenset({"wag", "nod", "shake", "turn-horizontal", "turn-vertical"})
_STREAMED: Final = frozenset({"left", "right", "drive", "head-horizontal", "head-vertical"})


class Action(NamedTuple):
    """One action of a script: what is done, and how many milliseconds the next one waits."""

    letter: str
    value: int
    delay_ms: int


@dataclass
class Body:
    """What a person sees of the robot: motors -255…255, servos in degrees, the lights, and how often it did what."""

    left: int = 0
    right: int = 0
    head_horizontal: int = 90
    head_vertical: int = 90
    tail: int = 90
    headlights: bool = False
    mood: int = 1
    shots: int = 0
    gestures: list[str] = field(default_factory=list)


class MityaBody(Robot):
    """A Robot Mitya of one `version`.

    A 2012 body cuts what it hears in fives for ever: one byte too many, and it understands nothing until four more
    have come. Those of 2013 and 2014 skip digits (``#0008`` each) and answer every message, ``#0000`` where they
    obeyed. While a script is recorded the body is silent, and ends the recording with ``r0200``.

    As a `phone` it takes one message a datagram, of which it reads five bytes; it ignores repeated set-points, shows
    moods itself, and passes on errors and hits but neither ``#0000`` nor ``r0200``. Telemetry is the battery,
    `volts`; of 2012, a hit.
    """

    protocol = "mitya"

    def __init__(
        self,
        name: str = "MITYA",
        *,
        version: MityaVersion = "2012",
        phone: bool = False,
        volts: float = 5.02,
        memory: int = MEMORY,
        answer_s: float = 0.0,
        telemetry_s: float | None = None,
    ) -> None:
        """Make the robot.

        Raises:
            ValueError: there is no such version, or the voltage cannot be told.
        """
        super().__init__()
        if version not in get_args(MityaVersion):
            raise ValueError(f"there is no version {version!r} (known: {', '.join(get_args(MityaVersion))})")
        if not 0 <= volts <= 40.95:
            raise ValueError(f"a voltage is 0 to 40.95 V, not {volts}")
        self.name = name
        self.version = version
        self.phone = phone
        self.volts = volts
        self.telemetry_s = telemetry_s
        self.body = Body()
        self.scripts: dict[int, list[Action]] = {}
        self.recording: int | None = None
        """The slot that is recorded now."""
        self.playing: deque[tuple[float, Action]] = deque()
        """What the script being played has yet to do, and when."""
        self._slot: int | None = None
        """The slot that was named last, of which the script is played."""
        self._left: dict[int, deque[tuple[float, Action]]] = {}
        """What scripts had yet to do when another slot was named: they go on when theirs is named again."""
        self._memory = memory
        self._answer_s = answer_s
        self._old = version == "2012"
        self._words = _LETTERS[version]
        self._letters = {word: letter for letter, word in self._words.items()}
        self._buffer = bytearray()
        self._room: dict[int, int] = {}
        self._begun: tuple[str, int] | None = None
        self._phone_records = False
        self._last: dict[str, bytes] = {}

    def receive(self, data: bytes, now: float) -> list[Reply]:
        self.advance(now)
        replies = self._as_phone(data[:5].ljust(5, b"\0"), now) if self.phone else self._hear(data, now)
        return [(self._answer_s + delay_s, said) for delay_s, said in replies]

    def boundary(self) -> None:
        """Nothing: a body knows no boundaries, and a phone gets whole datagrams."""

    def hello(self) -> bytes:
        return self._say("mood", self.body.mood)

    def telemetry(self) -> bytes:
        if not self._old:
            return self._say("telemetry", round(self.volts * 100))
        return b"h0001" if self.phone else b"h0001h0000"

    def advance(self, now: float) -> None:
        while self.playing and now >= self.playing[0][0]:
            _, action = self.playing.popleft()
            self._do(self._words.get(action.letter, ""), action.value)

    def _hear(self, data: bytes, now: float) -> list[Reply]:
        """What the body says to bytes from its line."""
        self._buffer += data
        replies: list[Reply] = []
        at = 0
        while len(self._buffer) - at >= 5:
            if not self._old and self._buffer[at] in _DIGITS:
                at += 1
                replies.append((0.0, self._say("error", 8)))
            else:
                replies += self._take(bytes(self._buffer[at : at + 5]), now)
                at += 5
        del self._buffer[:at]
        return replies

    def _take(self, message: bytes, now: float) -> list[Reply]:
        if not all(byte in _DIGITS for byte in message[1:]):
            return _at_once(self._say("error", 1), *self._stop_recording())
        letter, value = chr(message[0]), int(message[1:], 16)
        word = self._words.get(letter, letter)
        if self.recording is not None:
            return _at_once(*self._record(self.recording, letter, value, now))
        self.note(Heard(now, "", word, (str(_signed(value)),)))
        if word in ("wait", "room"):
            return _at_once(self._say("error", 7))
        if word == "script":
            return [*_at_once(*self._ok()), *self._script(value, now)]
        if word == "battery":
            return _at_once(self._say("telemetry", (value & 0xF000) | round(self.volts * 100)), *self._ok())
        if not self._do(word, value):
            return _at_once(self._say("error", 2))
        shown_by_phone = word == "mood" and value < 0x0100
        return _at_once(*([message] if shown_by_phone else []), *self._ok())

    def _ok(self) -> list[bytes]:
        return [] if self._old else [b"#0000"]

    def _do(self, word: str, value: int) -> bool:
        """Do what the body can do by itself; False where it cannot."""
        body = self.body
        if word in ("left", "right", "drive"):
            speed = max(-255, min(255, _signed(value)))
            body.left = body.left if word == "right" else speed
            body.right = body.right if word == "left" else speed
        elif word in _SERVOS:
            low, high = _SERVOS[word]
            setattr(body, word.replace("-", "_"), max(low, min(high, _signed(value))))
        elif word in _GESTURES:
            if value:
                body.gestures.append(word)
                del body.gestures[:-GESTURES_KEPT]
        elif word == "mood" and (not self._old or value in _REFLEXES):
            body.mood = value
        elif word == "headlights":
            body.headlights = bool(value) if value < 2 else body.headlights
        elif word == "fire":
            body.shots += 1  # whatever the value: a body fires at f0000 too
        else:
            return False
        return True

    def _script(self, value: int, now: float) -> list[Reply]:
        """Begin to record or to play; what the body will say while it plays."""
        slot = value & 0xFF
        if slot >= SLOTS:
            return []
        self._name(slot)
        if value >> 8:
            self.recording, self._begun = slot, None
            return []
        self.playing.clear()
        due_ms = 0
        replies: list[Reply] = []
        for action in self.scripts.get(slot, ()):
            if due_ms >= CLOCK_MS:
                break
            self.playing.append((now + due_ms / 1000, action))
            replies += [(due_ms / 1000, said) for said in self._plays(action)]
            due_ms += action.delay_ms
        return replies

    def _plays(self, action: Action) -> list[bytes]:
        """What the body says when it plays `action`: what it cannot do is for the phone."""
        word = self._words.get(action.letter, "")
        known = word in (*_SERVOS, *_GESTURES, "left", "right", "drive", "headlights", "fire")
        reflex = word == "mood" and (action.value in _REFLEXES or not self._old)
        echo = [] if known else [f"{action.letter}{action.value:04X}".encode("latin-1")]
        return echo + (self._ok() if known or reflex else [])

    def _record(self, slot: int, letter: str, value: int, now: float) -> list[bytes]:
        """Take one message of a script; what the body says to it, which is nothing as long as all is well."""
        if letter == "Z" and value:
            self._free(slot)
            if sum(self._room.values()) + value > self._memory:
                return [self._say("error", 5), *self._stop_recording()]
            self._room[slot] = value
            return []
        if letter == "Z" and self._begun is None:
            self.recording = None
            self.note(Heard(now, "", "recorded", (str(slot), str(len(self.scripts.get(slot, ()))))))
            return [b"r0200"]
        if letter == "r":
            return [self._say("error", 3), *self._stop_recording()]
        if (letter == "W") == (self._begun is None) or letter == "Z":
            return [self._say("error", 4), *self._stop_recording()]
        if self._begun is None:
            self._begun = letter, value
            return []
        script = self.scripts.setdefault(slot, [])
        if len(script) >= self._room.get(slot, 0):
            return [self._say("error", 6), *self._stop_recording()]
        script.append(Action(*self._begun, value))
        self._begun = None
        return []

    def _stop_recording(self) -> list[bytes]:
        if self.recording is None:
            return []
        self._free(self.recording)
        self._name(None)
        self.recording = self._begun = None
        return [b"r0200"]

    def _name(self, slot: int | None) -> None:
        if slot != self._slot:
            if self._slot is not None:
                self._left[self._slot] = self.playing
            self.playing = deque() if slot is None else self._left.pop(slot, deque())
            self._slot = slot

    def _free(self, slot: int) -> None:
        self._left.pop(slot, None)
        if slot == self._slot:
            self.playing.clear()
        self.scripts.pop(slot, None)
        self._room.pop(slot, None)

    def _as_phone(self, message: bytes, now: float) -> list[Reply]:
        """What the phone says to a datagram, and what it passes on of what its body says."""
        word = self._words.get(chr(message[0]), "")
        if not self._phone_records and (word in _STREAMED or (word == "mood" and not self._old)):
            if self._last.get(word) == message:
                return []
            self._last[word] = message
        if message.startswith(b"r01"):
            self._phone_records = True
        elif message == b"Z0000":
            self._phone_records = False
        if word == "mood" and message[1:3] == b"00" and not self._phone_records:
            self.body.mood = int(message[3:], 16) if all(byte in _DIGITS for byte in message[3:]) else self.body.mood
            return _at_once(message)
        says = word == "headlights" or (word == "fire" and message[1:] == b"0001")
        replies = _at_once(message) if says and not self._phone_records else []
        for delay_s, said in self._hear(message, now):
            if said.startswith(b"r02"):
                self._phone_records = False
            elif said != b"#0000":
                replies.append((delay_s, said))
        return replies

    def _say(self, word: str, value: int) -> bytes:
        return f"{self._letters[word]}{value:04X}".encode("ascii")


def _at_once(*said: bytes) -> list[Reply]:
    return [(0.0, each) for each in said]


def _signed(value: int) -> int:
    return value - 0x10000 if value > 0x7FFF else value

"""A simulated robot that speaks PSIU ASCII, as the document or its drafts have it or as the authors' firmware does."""

import math
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from random import Random
from types import MappingProxyType
from typing import Final, Literal, NamedTuple, get_args

from psiu_broker.simulator.ear import DraftEar, Ear, Sentence, WordEar
from psiu_broker.simulator.robot import Heard, Reply, Robot

Quirk = Literal[
    "crlf",
    "junk",
    "wrong_size",
    "unpadded",
    "complains",
    "loses_next",
    "silent_errors",
    "ruined_by_crlf",
    "avr",
    "answers_any",
    "odd_index",
]

Version = Literal["1", "0.5", "0"]

QUIRKS: Final[Mapping[Quirk, str]] = MappingProxyType(
    {
        "crlf": "its frames end in CRLF",
        "junk": "after quantoscomandos it sends the number of its commands and a space before every frame",
        "wrong_size": "its frames claim two bytes fewer than they have; their checksums are right",
        "unpadded": "its checksums have no leading zeros",
        "complains": "a wrong checksum makes it send the plain text CHECKSUM NAO BATEU!",
        "loses_next": "after a wrong checksum it also loses the next frame",
        "silent_errors": "it says nothing to a command that it does not understand, and loses the next frame",
        "ruined_by_crlf": "a CR or LF that it receives ruins the next frame",
        "avr": "a word of 20 bytes or a byte sum over 32767 is too much for it",
        "answers_any": "it obeys frames whoever they are for",
        "odd_index": "exibecomando of 0 or of too large an index is answered with garbage",
    }
)
"""The faults of real firmware that a robot can be given, each in words for ``--help``."""

EVERYONE: Final = "??"
COMPLAINT: Final = b"CHECKSUM NAO BATEU!\r\n"
PATIENCE_S: Final = 0.5
"""A frame that stops this long in the middle is forgotten."""

INSTANT_S: Final = 1e-6
"""Sums of times differ by rounding: a motion that ends this soon has ended."""

AVR_WORD_BYTES: Final = 19
AVR_SUM: Final = 32767

_MOVES: Final = {"parafrente": (999, 1), "paratras": (999, -1)}
_TURNS: Final = {"giradireita": (360, -1), "giraesquerda": (360, 1)}
SAME_TALK_S: Final = 0.1
"""Two robots that ask each other's name would answer each other for ever."""

_QUESTIONS: Final = {"quantoscomandos": 0, "exibecomando": 1, "qualseunome": 0}
_GARBAGE: Final = ("\x03\xb2(", "12290", "-1", "0")
_OUTCOMES: Final = {"sucesso", "falha", "ok", "respok", "respfalha"}
_FALHA: Final = ("falha",)


class Position(NamedTuple):
    """Where a robot is: `x` and `y` in cm, `heading` in degrees counterclockwise; 0 looks along x."""

    x: float = 0.0
    y: float = 0.0
    heading: float = 0.0


@dataclass(frozen=True)
class Extra:
    """A command beside those of the document: how many parameters of each type, and the words of its answer."""

    name: str
    ints: int = 0
    floats: int = 0
    chars: int = 0
    answer: str = "sucesso"

    @classmethod
    def parse(cls, text: str) -> "Extra":
        """Read ``distancia:0=42``: ``NAME:INTS[,FLOATS[,CHARS]][=ANSWER]``; without an answer it is sucesso.

        Raises:
            ValueError: `text` is not of this form.
        """
        head, equals, answer = text.partition("=")
        name, _, counts = head.partition(":")
        numbers = counts.split(",") if counts else ["0"]
        words_fit = name.isascii() and name.isprintable() and " " not in name and answer.isascii()
        if not name or not words_fit or len(numbers) > 3 or not all(_is_int(number) for number in numbers):
            raise ValueError(f"{text!r} is not NAME:INTS[,FLOATS[,CHARS]][=ANSWER], such as distancia:0=42")
        ints, floats, chars = (int(number) for number in [*numbers, "0", "0"][:3])
        return cls(name, ints, floats, chars, answer if equals else "sucesso")

    def accepts(self, parameters: Sequence[str]) -> bool:
        """True: `parameters` are as many as declared, ints first, then floats, then chars, and of these types."""
        if len(parameters) != self.ints + self.floats + self.chars:
            return False
        floats = parameters[self.ints : self.ints + self.floats]
        chars = parameters[self.ints + self.floats :]
        ints_fit = all(_is_int(word.removeprefix("-")) for word in parameters[: self.ints])
        return ints_fit and all(map(_is_float, floats)) and all(len(word) == 1 for word in chars)


class _Leg(NamedTuple):
    start: float
    end: float
    origin: Position
    target: Position


class AsciiRobot(Robot):
    """A robot called `name` that drives on a plane and answers as the PSIU document says.

    A motion takes `answer_s` plus `per_unit_s` a centimetre or degree, one after the other; its
    answer follows it. What is asked of everyone (``??``) is answered after a random time up to
    `wildcard_delay_s` (robots on one line must not speak at once). Telemetry is ``posicao x y
    heading`` to `telemetry_to`; in draft 0, whose frames name no sender, so is every answer.
    """

    protocol = "psiu-ascii"

    def __init__(  # noqa: PLR0913
        self,
        name: str,
        *,
        version: Version = "1",
        quirks: Collection[Quirk] = (),
        extras: Sequence[Extra] = (),
        per_unit_s: float = 0.0,
        answer_s: float = 0.005,
        wildcard_delay_s: float = 0.0,
        telemetry_s: float | None = None,
        telemetry_to: str = "PC",
        seed: int = 0,
    ) -> None:
        """Make the robot.

        Raises:
            ValueError: the name cannot be written, or a quirk does not exist.
        """
        super().__init__()
        if not name or not name.isascii() or not name.isprintable() or name != " ".join(name.split()):
            raise ValueError(f"{name!r} cannot be a robot's name: printable ASCII, single spaces inside only")
        unknown = set(quirks) - set(get_args(Quirk))
        if unknown:
            raise ValueError(f"there is no quirk {min(unknown)!r} (known: {', '.join(QUIRKS)})")
        self.name = name
        self.version = version
        self.quirks: frozenset[Quirk] = frozenset(quirks)
        self.position = Position()
        self.telemetry_s = telemetry_s
        self._telemetry_to = telemetry_to
        self._per_unit_s = per_unit_s
        self._answer_s = answer_s
        self._wildcard_delay_s = wildcard_delay_s
        self._random = Random(f"{seed}/{name}")  # noqa: S311 - a simulation that can be repeated
        self._extras = {extra.name: extra for extra in extras}
        motions = [Extra(word, ints=1) for word in (*_MOVES, *_TURNS)]
        questions = [Extra(word, ints=count) for word, count in _QUESTIONS.items()]
        self.commands: tuple[Extra, ...] = (*motions, *questions, *extras)
        self._known = {command.name: command for command in self.commands}
        self._ear = self._new_ear()
        self._last_byte = -math.inf
        self._lose = 0
        self._counted = False
        self._asked: list[tuple[str, str]] = []
        self._met: set[tuple[str, str]] = set()
        self._told_name: dict[str, float] = {}
        self._legs: deque[_Leg] = deque()
        self._goal = self.position
        self._free_at = -math.inf

    def _new_ear(self) -> Ear:
        ruined_by_crlf = "ruined_by_crlf" in self.quirks
        avr = "avr" in self.quirks
        greatest_sum = AVR_SUM if avr else 65535
        if self.version != "1":
            sender = self._telemetry_to if self.version == "0" else None
            return DraftEar(self.name, sender=sender, ruined_by_crlf=ruined_by_crlf, greatest_sum=greatest_sum)
        return WordEar(
            {command.name: command.ints + command.floats + command.chars for command in self.commands},
            ruined_by_crlf=ruined_by_crlf,
            word_bytes=AVR_WORD_BYTES if avr else 999,
            greatest_sum=greatest_sum,
        )

    def receive(self, data: bytes, now: float) -> list[Reply]:
        self.advance(now)
        if now - self._last_byte > PATIENCE_S:
            self._ear.forget()
        self._last_byte = now
        sentences = filter(None, map(self._ear.take, data))
        return [reply for sentence in sentences for reply in self._react(sentence, now)]

    def boundary(self) -> None:
        self._ear.forget()

    def hello(self) -> bytes:
        return self.command(EVERYONE, "qualseunome")

    def telemetry(self) -> bytes:
        x, y, heading = self.position
        return self.say(self._telemetry_to, "posicao", f"{x:.0f}", f"{y:.0f}", f"{heading:.0f}")

    def advance(self, now: float) -> None:
        while self._legs and now >= self._legs[0].end - INSTANT_S:
            self.position = self._legs.popleft().target
        if self._legs and now > self._legs[0].start:
            start, end, origin, target = self._legs[0]
            done = (now - start) / (end - start)
            x, y, heading = (a + (b - a) * done for a, b in zip(origin, target, strict=True))
            self.position = Position(x, y, heading % 360)

    def command(self, destination: str, *words: object) -> bytes:
        """The frame by which this robot orders another: ``command("BETA", "parafrente", 50)``.

        The other's answer is then noted in `heard`, not obeyed.
        """
        asked = (destination, str(words[0]))
        if asked not in self._asked:
            self._asked.append(asked)
        self._met = {met for met in self._met if met[1] != asked[1]}
        return self.say(destination, *words)

    def say(self, destination: str, *words: object) -> bytes:
        """One frame from this robot with `words` as its message, in its own dialect.

        Raises:
            ValueError: it would be longer than the 999 bytes of the format, or is not Latin text.
        """
        around = " " if self.version == "1" else ""
        sender = "" if self.version == "0" else self.name + around
        rest = f"{around}{' '.join(map(str, words))} {sender}"
        size = len(destination) + len(around) + 3 + len(rest) + 5
        if size > 999:
            raise ValueError(f"a frame of {size} bytes: PSIU ASCII has room for 999")
        claimed = size - 2 if "wrong_size" in self.quirks else size
        body = f"{destination}{around}{claimed:03d}{rest}".encode("latin-1")
        checksum = sum(body) % 65536
        frame = body + (b"%d" if "unpadded" in self.quirks else b"%05d") % checksum
        if "junk" in self.quirks and self._counted:
            frame = b"%d %b" % (len(self.commands), frame)
        return frame + b"\r\n" if "crlf" in self.quirks else frame

    def _react(self, sentence: Sentence, now: float) -> list[Reply]:
        destination, source, command, parameters, intact = sentence
        everyone = destination == EVERYONE
        mine = destination == self.name or "answers_any" in self.quirks
        if source == self.name or not (mine or everyone):
            return []
        if self._lose:
            self._lose -= 1
            return []
        if not intact:
            if "loses_next" in self.quirks:
                self._lose = 1
            return [(0.0, COMPLAINT)] if "complains" in self.quirks else []
        if everyone and command != "qualseunome" and not mine:
            return []
        self.note(Heard(now, source, command, parameters))
        if not everyone and self._is_answer(source, command, parameters, now):
            return []
        known = self._known.get(command)
        if known is None or not known.accepts(parameters):
            if "silent_errors" in self.quirks:
                self._lose = 1
                return []
            words: Sequence[str] = _FALHA
            delay_s = 0.0
        else:
            delay_s, words = self._obey(command, parameters, now)
        try:
            reply = self.say(source, command, *words)
        except ValueError:
            return []  # An answer has to repeat the names and the command, and these may fill a frame.
        self._told_name[source] = now if command == "qualseunome" and not everyone else -math.inf
        self._counted |= command == "quantoscomandos"
        if everyone:
            delay_s += self._random.uniform(0.0, self._wildcard_delay_s)
        return [(delay_s, reply)]

    def _is_answer(self, source: str, command: str, parameters: Sequence[str], now: float) -> bool:
        if command == "qualseunome" and now - self._told_name.get(source, -math.inf) < SAME_TALK_S:
            return True
        if (source, command) in self._asked:
            self._asked.remove((source, command))
            return True
        if (EVERYONE, command) in self._asked and (source, command) not in self._met:
            self._met.add((source, command))
            return True
        return bool(parameters) and parameters[-1].lower() in _OUTCOMES

    def _obey(self, command: str, parameters: Sequence[str], now: float) -> tuple[float, Sequence[str]]:
        """What a well-formed command calls for: how long it takes and the words of the answer."""
        if command in self._extras:
            return self._answer_s, self._extras[command].answer.split()
        if command == "qualseunome":
            return 0.0, ()
        if command == "quantoscomandos":
            return 0.0, (str(len(self.commands)),)
        if command == "exibecomando":
            return 0.0, self._shown(int(parameters[0]))
        return self._move(command, int(parameters[0]), now)

    def _shown(self, index: int) -> Sequence[str]:
        if 1 <= index <= len(self.commands):
            shown = self.commands[index - 1]
            return (shown.name, str(shown.ints), str(shown.floats), str(shown.chars))
        return _GARBAGE if "odd_index" in self.quirks else _FALHA

    def _move(self, command: str, amount: int, now: float) -> tuple[float, Sequence[str]]:
        greatest, sign = _MOVES[command] if command in _MOVES else _TURNS[command]
        if not 0 <= amount <= greatest:
            return 0.0, _FALHA
        x, y, heading = self._goal
        if command in _MOVES:
            angle = math.radians(heading)
            step = sign * amount
            target = Position(round(x + step * math.cos(angle), 6), round(y + step * math.sin(angle), 6), heading)
        else:
            target = Position(x, y, heading + sign * amount)
        start = max(now, self._free_at)
        self._free_at = start + self._answer_s + self._per_unit_s * amount
        self._goal = target._replace(heading=target.heading % 360)
        if self._free_at > start:
            # The angle of the leg is not wrapped, so that a turn through 0 is seen to go the short way.
            self._legs.append(_Leg(start, self._free_at, Position(x, y, heading), target))
        self._legs.append(_Leg(self._free_at, self._free_at, target, self._goal))
        return self._free_at - now, ("sucesso",)


def _is_int(word: str) -> bool:
    return word.isascii() and word.isdigit()


def _is_float(word: str) -> bool:
    whole, _, fraction = word.removeprefix("-").partition(".")
    return _is_int(whole + fraction)

"""The broker as a robot: what it answers to frames addressed to itself, and for robots that cannot list commands.

Two brokers, or a broker and a robot that takes any frame for a command, must never keep each other talking: an
answer is never answered, and what may be one that came too late is refused at most once in a while.
"""

from collections.abc import Hashable, Sequence
from typing import Final

from psiu_broker.codecs import psiu_ascii, psiu_hexa
from psiu_broker.frame import EVERYONE, Address, Frame
from psiu_broker.messages import Answer, Command
from psiu_broker.profiles.hexa import AVAILABLE, FREE, WTF
from psiu_broker.profiles.psiu import COUNT, NAME, QUESTIONS, SHOW, Said, canonical, said, text

PING_EVERY_S: Final = 0.1
REFUSE_EVERY_S: Final = 2.0
"""As long as a robot has to answer: its late value must not be met with a falha that it answers in turn."""
_REMEMBERED: Final = 256


class Responder:
    """The broker's own voice under one name; its PSIU HEXA number is the destination of what it hears."""

    def __init__(self, name: str, commands: Sequence[Command] = QUESTIONS) -> None:
        self.name = name
        self._commands = commands
        self._last: dict[Hashable, float] = {}

    def answer(self, frame: Frame, now: float, pinging: bool = False) -> Frame | None:
        """The answer to a frame for the broker (or for everyone), if it deserves one.

        `pinging`: a ping of ours to its sender is under way, so that a ping from there is the answer (rule 6).
        `now` is in seconds on any steady clock.
        """
        if frame.protocol == "psiu-ascii":
            return self._words(frame, now)
        if frame.protocol == "psiu-hexa":
            return self._packet(frame, now, pinging)
        return None

    def _words(self, frame: Frame, now: float) -> Frame | None:
        words = said(frame)
        if not words.command:
            return None
        if canonical(words.command) == NAME:
            # Question and answer look alike, and a robot may take our answer for a question.
            asked = frame.destination == EVERYONE or self._rarely((frame.source, NAME), now)
            return _say(self.name, frame, NAME) if asked else None
        if words.answer:
            return None
        told = _listing(words, frame, self.name, self._commands)
        if told is None and frame.destination != EVERYONE and self._rarely((frame.source, words.command), now):
            told = refusal(frame, self.name)
        return told

    def _packet(self, frame: Frame, now: float, pinging: bool) -> Frame | None:
        payload = frame.payload
        if len(payload) == 0:
            if pinging or not self._rarely(frame.source, now, PING_EVERY_S):
                return None
            return psiu_hexa.packet(frame.destination, frame.source, b"")
        if len(payload) == 1:
            if payload[0] != AVAILABLE:
                return None
            return psiu_hexa.packet(frame.destination, frame.source, bytes((FREE,)))
        return psiu_hexa.packet(frame.destination, frame.source, bytes((WTF,)))

    def _rarely(self, key: Hashable, now: float, every_s: float = REFUSE_EVERY_S) -> bool:
        """True at most once every `every_s` for one key."""
        last = self._last.get(key)
        if last is not None and now - last < every_s:
            return False
        self._last.pop(key, None)
        if len(self._last) >= _REMEMBERED:
            del self._last[next(iter(self._last))]
        self._last[key] = now
        return True


def listing(frame: Frame, name: str, commands: Sequence[Command]) -> Frame | None:
    """The answer of `name` to an ASCII quantoscomandos or exibecomando; None for any other frame."""
    return _listing(said(frame), frame, name, commands)


def outcome(frame: Frame, name: str, answer: Answer) -> Frame:
    """The answer of `name` to the ASCII command `frame`, from what a robot of another protocol answered to the call."""
    status = [] if answer.status is None else [answer.status]
    values = [text(value) for value in answer.values]
    return _say(name, frame, said(frame).command, *status, *values)


def refusal(frame: Frame, name: str) -> Frame:
    """`<command> falha` from `name` to the sender of the ASCII command `frame`."""
    return _say(name, frame, said(frame).command, "falha")


def _listing(words: Said, frame: Frame, name: str, commands: Sequence[Command]) -> Frame | None:
    if words.answer:
        return None
    asked = canonical(words.command)
    if asked == COUNT:
        return _say(name, frame, COUNT, str(len(commands)))
    if asked != SHOW:
        return None
    match words.values:
        case (int(index),) if 1 <= index <= len(commands):
            command = commands[index - 1]
            counts = (str(command.ints), str(command.floats), str(command.chars))
            return _say(name, frame, SHOW, command.name, *counts)
        case _:
            return _say(name, frame, SHOW, "falha")


def _say(name: str, asked: Frame, *words: str) -> Frame:
    return psiu_ascii.message(Address.named(name), asked.source, *words)

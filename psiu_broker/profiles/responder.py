"""The broker as a robot: what it answers to frames addressed to itself, and for robots that cannot list commands.

Two brokers, or a broker and a robot that takes any frame for a command, must never keep each other talking: an
answer is never answered, and what may be one that came too late only a few times, and then once in a while.
"""

import re
from collections.abc import Sequence
from typing import Final

from psiu_broker.codecs import psiu_ascii, psiu_hexa
from psiu_broker.frame import EVERYONE, Address, Frame
from psiu_broker.messages import Answer, Command, Value
from psiu_broker.profiles.hexa import AVAILABLE, FREE, WTF
from psiu_broker.profiles.psiu import COUNT, NAME, QUESTIONS, SHOW, Said, canonical, said, text
from psiu_broker.profiles.rarely import Rarely

PING_EVERY_S: Final = 0.1
"""A ping sooner after our answer to one may be the answer to that (PSIU HEXA row 6)."""
PINGS_AT_ONCE: Final = 10
PINGS_EVERY_S: Final = 1.0
"""In the long run; two brokers far apart would else take each other's answers for pings without end."""
NAMES_AT_ONCE: Final = 4
NAME_EVERY_S: Final = 30.0
"""In the long run, for one who asks us by our name; who asks everyone is always told."""
REFUSE_EVERY_S: Final = 2.0
"""As long as a robot has to answer: its late value must not be met with a falha or WTF that it answers in turn."""


_UNPRINTABLE: Final = re.compile(r"[^!-~]")


class Responder:
    """The broker's own voice under one name; its PSIU HEXA number is the destination of what it hears."""

    def __init__(self, name: str, commands: Sequence[Command] = QUESTIONS) -> None:
        self.name = name
        self._commands = commands
        self._rarely = Rarely()

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

    def listed(self, frame: Frame, name: str, commands: Sequence[Command], now: float) -> Frame | None:
        """`listing` for `name`, a robot that the broker speaks for; its name is told once in a while."""
        if canonical(said(frame).command) == NAME and not self._may_tell(frame, name, now):
            return None
        return listing(frame, name, commands)

    def refused(self, frame: Frame, name: str, now: float) -> Frame | None:
        """`refusal`, but to one sender of one command to `name` only once in a while."""
        key = (frame.source, name, said(frame).command)
        return refusal(frame, name) if self._rarely.may(key, now, REFUSE_EVERY_S) else None

    def _may_tell(self, frame: Frame, name: str, now: float) -> bool:
        return self._rarely.may((frame.source, name), now, NAME_EVERY_S, NAMES_AT_ONCE)

    def _may_ping(self, robot: Address, now: float) -> bool:
        soon = self._rarely.may((robot, "soon"), now, PING_EVERY_S)
        return soon and self._rarely.may(robot, now, PINGS_EVERY_S, PINGS_AT_ONCE)

    def _words(self, frame: Frame, now: float) -> Frame | None:
        words = said(frame)
        if not words.command:
            return None
        if canonical(words.command) == NAME:
            # Question and answer look alike, and a robot may take our answer for a question.
            asked = frame.destination == EVERYONE or self._may_tell(frame, self.name, now)
            return _say(self.name, frame, NAME) if asked else None
        if words.answer:
            return None
        told = _listing(words, frame, self.name, self._commands)
        if told is None and frame.destination != EVERYONE:
            told = self.refused(frame, self.name, now)
        return told

    def _packet(self, frame: Frame, now: float, pinging: bool) -> Frame | None:
        payload = frame.payload
        if len(payload) == 0:
            if pinging or not self._may_ping(frame.source, now):
                return None
            return psiu_hexa.packet(frame.destination, frame.source, b"")
        if len(payload) == 1:
            if payload[0] != AVAILABLE:
                return None
            return psiu_hexa.packet(frame.destination, frame.source, bytes((FREE,)))
        if not self._rarely.may((frame.source, "wtf"), now, REFUSE_EVERY_S):
            return None
        return psiu_hexa.packet(frame.destination, frame.source, bytes((WTF,)))


def listing(frame: Frame, name: str, commands: Sequence[Command]) -> Frame | None:
    """The answer of `name` to an ASCII qualseunome, quantoscomandos or exibecomando; None for any other frame.

    A qualseunome to a name is taken for a question: robots of bytes ask none that this could answer.
    """
    words = said(frame)
    if canonical(words.command) == NAME and words.status is None:
        return _say(name, frame, NAME)
    return _listing(words, frame, name, commands)


def outcome(frame: Frame, name: str, answer: Answer) -> Frame | None:
    """The answer of `name` to the ASCII command `frame`, from what a robot of another protocol answered to the call.

    A field of no bytes is ``0x``; of a text each word is a value, and what is no printable ASCII in it is ``?``. A
    number that has no words is a refusal. None where the robot answers nothing: the command alone would read as one to
    the sender, and what became of it nobody knows.
    """
    if answer.status is None and not answer.values:
        return None
    status = [] if answer.status is None else [answer.status]
    try:
        values = [word for value in answer.values for word in _words(value)]
    except ValueError:
        return refusal(frame, name)
    return _say(name, frame, said(frame).command, *status, *values)


def _words(value: Value) -> Sequence[str]:
    """`value` in words of PSIU ASCII, at least one; raises ValueError."""
    if isinstance(value, str):
        return [_UNPRINTABLE.sub("?", word) for word in value.split()] or ["0x"]
    return [text(value)]


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

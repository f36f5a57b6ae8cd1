"""Reading a script file, and all that may be wrong with it. Pure.

    # an eager robot; a comment begins with # or ;
    drive 100        the name of an action or its letter, and its value
    wait 500         milliseconds until the next action; without it the next one follows at once
    D 0
    mood happy

What stands here is the language.
"""

import re
from collections.abc import Sequence
from difflib import get_close_matches
from typing import Final

from psiu_broker.codecs.mitya import LETTERS, VERSIONS
from psiu_broker.profiles.roboscript.script import (
    ACTIONS_MAX,
    PROBLEMS_SHOWN,
    RECORD,
    ROOM,
    TEXT_MAX,
    TOTAL_MS,
    WAIT,
    Action,
    Problem,
    Script,
    Vocabulary,
)

_DELAY: Final = re.compile(r"[+-]?\d{1,9}", re.ASCII)
_ON_THE_WIRE: Final = re.compile(r"[A-Za-z=*~][0-9A-Fa-f]{4}")
_COMMENT: Final = re.compile(r"(?:^|\s)[#;].*")
_LIKELY: Final = ("100", "90", "1")
_SHOWN: Final = 40


def read(text: str, vocabulary: Vocabulary) -> Script:
    """Read a script file and check it: every problem is told, up to `PROBLEMS_SHOWN`. Never raises."""
    if not vocabulary.forms:
        return Script((), (Problem(0, no_roboscript(vocabulary)),))
    if len(text.encode("utf-8", "replace")) > TEXT_MAX:
        return Script((), (Problem(0, f"it has more than {TEXT_MAX} bytes: shorten its comments"),))
    reader = _Reader(vocabulary)
    # Not splitlines(): an editor does not count a form feed as a line.
    lines = text.removeprefix("\ufeff").replace("\r\n", "\n").replace("\r", "\n").split("\n")
    for line, said in enumerate((_COMMENT.sub("", line).split() for line in lines), 1):
        if said:
            reader.take(line, said)
    return reader.script()


def no_roboscript(vocabulary: Vocabulary) -> str:
    """Why a robot that has no action has none."""
    version = vocabulary.version
    return (
        f"the Robot Mitya of {version} has no RoboScript, those of 2012 and 2013 have: command it by psiu call instead"
    )


class _Reader:
    """Reads line after line."""

    def __init__(self, vocabulary: Vocabulary) -> None:
        self._vocabulary = vocabulary
        self._actions: list[Action] = []
        self._problems: list[Problem] = []
        self._bad_action = False

    def take(self, line: int, said: Sequence[str]) -> None:
        """The words of one line, without its comment."""
        if self._vocabulary.is_wait(said[0]):
            self._wait(line, said[1:])
            return
        self._bad_action = True  # the delay behind a wrong action is not wrong as well
        name = self._vocabulary.name(said[0]) or self._vocabulary.name(said[0].lower())
        if name is None:
            self._say(line, self._unknown(said[0]))
            return
        form = self._vocabulary.forms[name]
        try:
            value = form.value(said[1:])
        except ValueError:
            got = _cut(" ".join(said[1:]))
            wrong = f"{got} is no value of {name}" if got else f"{name} has no value"
            self._say(line, f"{wrong}; it takes {form.takes}: write {self._like(name)}")
            return
        self._bad_action = False
        self._actions.append(Action(form.letter, value & 0xFFFF, 0, line))

    def script(self) -> Script:
        """All of it, checked as a whole."""
        if not self._actions and not self._problems:
            self._say(0, f"it has no action; a script has 1 to {ACTIONS_MAX}: write a line such as drive 100")
        if len(self._actions) > ACTIONS_MAX:
            line = self._actions[ACTIONS_MAX].line
            count = len(self._actions)
            over = count - ACTIONS_MAX
            self._say(line, f"{count} actions; a body has room for about {ACTIONS_MAX}: take out {over} from here on")
        self._check_total()
        problems = sorted(self._problems, key=lambda problem: problem.line)
        if len(problems) > PROBLEMS_SHOWN:
            more = len(problems) - PROBLEMS_SHOWN
            problems[PROBLEMS_SHOWN:] = [
                Problem(problems[PROBLEMS_SHOWN].line, f"here and later, {more} more problems")
            ]
        return Script(tuple(self._actions), tuple(problems))

    def _check_total(self) -> None:
        total = 0
        for action in self._actions:
            total += action.delay_ms
            if total >= TOTAL_MS:
                whole = sum(each.delay_ms for each in self._actions)
                most = f"less than {TOTAL_MS} ms are counted right: shorten them by {whole - TOTAL_MS + 1}"
                self._say(action.wait_line or action.line, f"the delays are {whole} ms together; {most}")
                return

    def _wait(self, line: int, values: Sequence[str]) -> None:
        if len(values) == 2 and values[1].lower() == "ms":
            values = values[:1]
        delay = int(values[0]) if len(values) == 1 and _DELAY.fullmatch(values[0]) else None
        if delay is None:
            got = _cut(" ".join((WAIT, *values)))
            takes = f"wait takes milliseconds, 0 to {TOTAL_MS - 1}: wait 500 is half a second"
            self._say(line, f"{got} is no delay; {takes}")
        elif not 0 <= delay < TOTAL_MS:
            self._say(line, f"{delay} is out of range; wait takes 0 to {TOTAL_MS - 1} ms: choose one of these")
        elif self._bad_action:
            return
        elif not self._actions:
            self._say(
                line, "there is no action before this wait; a script begins with one: write, say, drive 0 above it"
            )
        else:
            last = self._actions[-1]
            self._actions[-1] = last._replace(delay_ms=last.delay_ms + delay, wait_line=line)

    def _unknown(self, said: str) -> str:
        """What is wrong with `said`, which is no action."""
        vocabulary = self._vocabulary
        version, name = vocabulary.version, _cut(said)
        word = LETTERS[version].get(said, said.lower())
        if word in (RECORD, ROOM, "play"):
            return f"{name} cannot be in a script; it is part of uploading or playing one: take it out"
        if word in ("error", "hit", "telemetry"):
            return f"{name} cannot be in a script; only the robot says it: take it out"
        for other in VERSIONS:
            meant = vocabulary.name(LETTERS[other].get(said, ""))
            if meant is not None:
                letter = vocabulary.forms[meant].letter
                return f"{name} is a letter of {other}; in {version} it is {letter}: write {meant}"
        if _ON_THE_WIRE.fullmatch(said):
            like = vocabulary.line(said[0], int(said[1:], 16)) or "drive 100"
            return f"{name} is a message on the wire; an action is a name and a value: write {like}"
        names = (*vocabulary.forms, WAIT)
        near = get_close_matches(said.lower(), names, 1)
        hint = f"did you mean {near[0]}?" if near else "choose one of these"
        return f"there is no action {name}; there are {', '.join(names)}: {hint}"

    def _like(self, name: str) -> str:
        """A line with `name` that is right."""
        form = self._vocabulary.forms[name]
        for value in ("", *_LIKELY, *form.takes.replace(",", "").split()):
            try:
                form.value([value] if value else [])
            except ValueError:
                continue
            return f"{name} {value}".rstrip()
        return name

    def _say(self, line: int, text: str) -> None:
        self._problems.append(Problem(line, text))


def _cut(text: str) -> str:
    """A word of the user's as it can stand in a line of text."""
    shown = text if text.isprintable() else ascii(text)[1:-1]
    return shown if len(shown) <= _SHOWN else f"{shown[:_SHOWN]}…"

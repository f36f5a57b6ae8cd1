"""A Robot Mitya's script: what it is made of, and the messages by which a body records it. Pure.

On the wire it is ``r01xx`` (record slot xx), ``Zxxxx`` (room for so many actions), a command and a ``Wxxxx`` for each
action, and ``Z0000``, to which the body says ``r0200``. All else is silence: the body says nothing while it records.
At an error it says so and ``r0200``, has emptied the slot and does again what it hears.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Final, NamedTuple, Protocol

from psiu_broker.codecs.mitya import BY_WORD, LETTER, LETTERS, STOP, Version, message
from psiu_broker.messages import Value
from psiu_broker.routing.outbox import is_stop

SLOTS: Final = 10
"""Slots 0 to 9. The document says 0A, the firmware has ten."""
ACTIONS_MAX: Final = 130
"""About as many fit into the memory of a body."""
TOTAL_MS: Final = 65_500
"""The delays of a script must be less than this together: a body counts them in 16 bits."""
TEXT_MAX: Final = 30_000
"""Bytes of a script's text, which has to fit into a call; the rest would be comments."""
PROBLEMS_SHOWN: Final = 50
"""Of more than these the rest is counted."""

WAIT: Final = "wait"
ROOM: Final = "room"
RECORD: Final = "script"
_NO_ACTIONS: Final = frozenset({"error", "hit", "telemetry", RECORD, ROOM, WAIT})
"""What a body says, and what makes a script: none of it can be in one."""


class Form(Protocol):
    """How one command becomes a message."""

    @property
    def word(self) -> str: ...
    @property
    def letter(self) -> str: ...
    @property
    def takes(self) -> str:
        """The values that it takes, for a person."""

    @property
    def fixed(self) -> bool:
        """It takes none."""

    def value(self, parameters: Sequence[Value]) -> int:
        """The value of the message; raises ValueError, saying what it takes."""

    def shown(self, value: int) -> Value:
        """The value that a person would write."""


class Vocabulary:
    """What can be an action: in 2014, which has no RoboScript, nothing."""

    def __init__(self, version: Version, forms: Mapping[str, Form]) -> None:
        self.version: Final = version
        has_scripts = RECORD in BY_WORD[version]
        self.forms: Final[Mapping[str, Form]] = {
            name: form for name, form in forms.items() if has_scripts and form.word not in _NO_ACTIONS
        }
        self._by_letter = {form.letter: name for name, form in reversed(self.forms.items()) if not form.fixed}

    def name(self, said: str) -> str | None:
        """The name that `said`, a name, a letter or any word for a stop, stands for; None where it is no action."""
        if said in self.forms:
            return said
        return STOP if is_stop(said) and STOP in self.forms else self._by_letter.get(said)

    def is_wait(self, said: str) -> bool:
        return said.lower() == WAIT or LETTERS[self.version].get(said) == WAIT

    def line(self, letter: str, value: int) -> str | None:
        """The line of a script that stands for this message; None where it is no action."""
        name = self._by_letter.get(letter)
        return None if name is None else f"{name} {self.forms[name].shown(value)}"

    def trouble(self, letter: str, value: int) -> str | None:
        """Why `read` refuses the line of this message, which a body would record; None where it does not."""
        name = self._by_letter.get(letter)
        if name is None:
            return None
        form = self.forms[name]
        shown = form.shown(value)
        try:
            form.value([shown])
        except ValueError:
            return f"{name} {shown} is outside of what it takes, {form.takes}"
        return None


class Action(NamedTuple):
    """One action; `value` is in 16 bits. `line` is where it stands and `wait_line` where its delay does, 0 for none."""

    letter: str
    value: int
    delay_ms: int = 0
    line: int = 0
    wait_line: int = 0


class Problem(NamedTuple):
    """What is wrong on a line: what it is, what was expected, what to do. Line 0 is the whole script."""

    line: int
    text: str


class Script(NamedTuple):
    """What was read; with `problems` it must not be sent."""

    actions: tuple[Action, ...]
    problems: tuple[Problem, ...]

    @property
    def total_ms(self) -> int:
        return sum(action.delay_ms for action in self.actions)


class Message(NamedTuple):
    """One message of an upload: its word, its bytes, and the line that it stands for (0: the whole script)."""

    word: str
    wire: bytes
    line: int


def compiled(actions: Sequence[Action], slot: int, version: Version) -> tuple[Message, ...]:
    """The messages by which a body records `actions` in `slot`, in their order."""
    letters = LETTERS[version]
    return tuple(
        Message(letters.get(letter, LETTER + letter), message(letter, value), line)
        for letter, value, line in _messages(actions, slot, version)
    )


def problem_lines(problems: Sequence[Problem], file: str) -> list[str]:
    """``FILE:LINE: what; expected; what to do`` for each."""
    return [f"{file}:{line}: {text}" if line else f"{file}: {text}" for line, text in problems]


def _messages(actions: Sequence[Action], slot: int, version: Version) -> Iterator[tuple[str, int, int]]:
    """Letter, value and line of each message."""
    record, room, wait = (BY_WORD[version][word] for word in (RECORD, ROOM, WAIT))
    yield record, 0x0100 | slot, 0
    yield room, len(actions), 0
    for action in actions:
        yield action.letter, action.value, action.line
        yield wait, action.delay_ms, action.wait_line or action.line
    yield room, 0, 0

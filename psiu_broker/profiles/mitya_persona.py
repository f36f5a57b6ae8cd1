"""The broker playing a Robot Mitya, phone and body, to a program that sends its messages; another robot does them.

    [links.painel.map]
    D = {command = "parafrente", below_zero = "paratras", scale = 0.4}
    H = {command = "garra", scale = 1, offset = -90}
    y = {command = "acena"}

Each line is a letter of the link's version, or its word, and what the robot is told. The value of the message times
`scale`, plus `offset`, is the parameter; without a `scale` there is none. No scale is taken for granted. Of what the
robot tells unasked, hits and the battery go to the program.
"""

from collections.abc import Sequence
from typing import Any, ClassVar, Final, Self

from pydantic import ConfigDict, Field, model_validator

from psiu_broker.codecs import mitya
from psiu_broker.codecs.mitya import BY_WORD, DONE, LETTERS, ONE_SHOTS, SCRIPT, VERSIONS, Version
from psiu_broker.frame import Frame
from psiu_broker.messages import Answer, Value
from psiu_broker.profiles.persona import Call, Persona, PersonaOptions, Say
from psiu_broker.profiles.profile import Description
from psiu_broker.profiles.rarely import Rarely
from psiu_broker.profiles.scaled_rule import ScaledRule

__all__ = ["MityaPersona", "Rule"]

COMPLAIN_EVERY_S: Final = 5.0
"""A program streams its set-points: it hears of one trouble with one letter only once in a while."""

WRONG: Final = 0x01
UNKNOWN: Final = 0x02
NO_MEMORY: Final = 0x05
_HEAD: Final = 0x0100

_VOLTS_MOST: Final = 40.95

_SET_POINTS: Final = frozenset({"left", "right", "drive", "head-horizontal", "head-vertical"})
_STREAMED: Final = _SET_POINTS | {"tail", "mood", "headlights"}


class Rule(ScaledRule):
    """What the robot is told when the program sends one letter."""

    below_zero: str | None = Field(
        None, min_length=1, description="its command for values below 0, which then lose their sign"
    )
    at_zero: str | None = Field(None, min_length=1, description="its command for 0, without a parameter: a stop")

    def call(self, value: int) -> tuple[str, tuple[Value, ...]]:
        """The robot's command and parameters for a message's `value`.

        Raises:
            ValueError: as `scaled`.
        """
        if value == 0 and self.at_zero is not None:
            return self.at_zero, ()
        if value < 0 and self.below_zero is not None:
            return self.below_zero, self.scaled(-value)
        return self.command, self.scaled(value)


class MityaPersona(Persona):
    """One Robot Mitya played to one program.

    As on the phone, a set-point (L R D H V; since 2013 L R G H V M) whose value is that of the one before is ignored.
    """

    class Options(PersonaOptions):
        """What ``[links.NAME.map]`` may hold: a rule for each letter, or word of a letter, that is to do something."""

        model_config = ConfigDict(extra="allow", frozen=True)
        __pydantic_extra__: dict[str, Rule] = Field(init=False)

        @model_validator(mode="after")
        def _are_letters(self) -> Self:
            for name in self.__pydantic_extra__:
                if not any(name in LETTERS[version] or name in BY_WORD[version] for version in VERSIONS):
                    words = ", ".join(f"{letter} ({word})" for letter, word in LETTERS["2012"].items())
                    raise ValueError(f"{name} is no letter of a Robot Mitya; those of 2012 are {words}")
            return self

    protocol: ClassVar[str] = mitya.PROTOCOL

    def __init__(self, name: str, codec: Any, options: Any) -> None:
        codec = codec or mitya.Mitya.Options()
        self.version: Version = codec.version
        letters = LETTERS[self.version]
        rules: dict[str, Rule] = (options or self.Options()).__pydantic_extra__ or {}
        self._rules = {letters.get(each, each): rule for each, rule in rules.items()}
        self._ignores_repeats = _SET_POINTS if self.version == "2012" else _SET_POINTS | {"mood"}
        self._last: dict[str, int] = {}
        self._rarely = Rarely()

    def heard(self, frame: Frame, now: float) -> Sequence[Say | Call]:
        if not mitya.is_message(frame.payload):
            return ()
        word, value = frame.subject, mitya.signed(frame.payload)
        if self._is_void(word, value):
            return ()
        rule = self._rules.get(word)
        if word == "script" and value >> 8:
            return self._complain(NO_MEMORY, word, now)
        if rule is None:
            return self._complain(UNKNOWN, word, now)
        try:
            command, parameters = rule.call(value)
        except ValueError:
            return self._complain(WRONG, word, now)
        if word in _STREAMED:
            return (Call(command, parameters, newest=True, asked=frame), *self._done())
        return (Call(command, parameters, asked=frame),)

    def answered(self, call: Call, answer: Answer | None, error: str, now: float) -> Sequence[Say]:
        word = "" if call.asked is None else call.asked.subject
        if answer is not None and answer.status != "falha":
            return self._done()
        self._last.pop(word, None)  # it was not done: the same again is no repeat
        return self._complain(WRONG, word, now)

    def told(self, description: Description, now: float) -> Sequence[Say]:
        """A hit is passed on, and since 2013 the volts of what the robot names battery: there are no other letters."""
        if description.get("kind") != "event":
            return ()
        if description.get("command") == "hit":
            return (_say(self.version, "hit", 1),)
        volts = (description.get("readings") or {}).get("battery")
        if self.version == "2012" or description.get("unit") != "V" or isinstance(volts, str | None):
            return ()
        return (_say(self.version, "telemetry", round(volts * 100)),) if 0 <= volts <= _VOLTS_MOST else ()

    def _is_void(self, word: str, value: int) -> bool:
        """Whether a message is nothing to do: a set-point as before, or no command at all."""
        if word in self._ignores_repeats:
            repeated = self._last.get(word) == value
            self._last[word] = value
            return repeated
        # What is recorded, what only a robot says, and the end of a burst whose beginning was lost.
        return word.startswith(SCRIPT) or word in (DONE, "error", "telemetry") or (word in ONE_SHOTS and value == 0)

    def _done(self) -> Sequence[Say]:
        return () if self.version == "2012" else (_say(self.version, DONE, 0),)

    def _complain(self, code: int, word: str, now: float) -> Sequence[Say]:
        if not self._rarely.may((word, code), now, COMPLAIN_EVERY_S):
            return ()
        return (_say(self.version, "error", code | (_HEAD if self.version == "2012" else 0)),)


def _say(version: Version, word: str, value: int) -> Say:
    return Say(word, mitya.message(BY_WORD[version].get(word, "#"), value))

"""The broker playing a board to a phone with Amarino; another robot does what the phone sends.

    [links.celular.map]
    A = {command = "parafrente", scale = 100, maximum = 300}
    d = {command = "garra", scale = 1, offset = -90, stream = true}
    f = {command = "fala", as_it_is = true}
    p = {command = "pare"}

Each line is a flag and what the robot is told. Each number behind the flag times `scale`, plus `offset`, is a
parameter; without a `scale` there is none. No scale is taken for granted. What the robot answers and tells goes back.
"""

import math
import re
from collections.abc import Sequence
from typing import Any, ClassVar, Final, Literal, Self

from pydantic import ConfigDict, Field, model_validator

from psiu_broker.codecs import amarino
from psiu_broker.codecs.amarino import ALIVE, LAST_FLAG, LONGEST_TEXT, TEXT, text_trouble, values, values_text
from psiu_broker.frame import Frame
from psiu_broker.messages import Answer, Value
from psiu_broker.profiles.amarino import FLAG_PATTERN, NOT_REGISTERED, OUT_OF_BOUNDS
from psiu_broker.profiles.persona import Call, Persona, PersonaOptions, Say
from psiu_broker.profiles.profile import Description
from psiu_broker.profiles.rarely import Rarely
from psiu_broker.profiles.scaled_rule import ScaledRule

__all__ = ["AmarinoPersona", "FlagRule"]

COMPLAIN_EVERY_S: Final = 5.0
"""A phone streams its sensors: it hears of one trouble with one flag only once in a while."""

_NUMBERS: Final = re.compile(r"[-+.\d]+")
_UNSAYABLE: Final = re.compile(r"[;\x11-\x13\x1b]")


class FlagRule(ScaledRule):
    """What the robot is told when the phone sends one flag."""

    as_it_is: bool = Field(False, description="instead of a scale: every value, texts too, goes to the robot unchanged")
    stream: bool = Field(False, description="a set-point that comes again and again: only the newest counts")

    @model_validator(mode="after")
    def _is_one_thing(self) -> Self:
        if self.scale is not None and self.as_it_is:
            raise ValueError("as_it_is and scale exclude each other; remove one")
        return self

    def parameters(self, told: Sequence[Value]) -> tuple[Value, ...]:
        """What the robot is told where the phone told `told`.

        Raises:
            ValueError: one is no number, or as `scaled`.
        """
        if self.as_it_is:
            return tuple(told)
        parameters: list[Value] = []
        for value in told if self.scale is not None else ():
            if isinstance(value, str):
                raise ValueError(f"{value} is not a number")  # noqa: TRY004 - refused like any other value
            parameters += self.scaled(value)
        return tuple(parameters)


class AmarinoPersona(Persona):
    """One board played to one phone."""

    class Options(PersonaOptions):
        """What ``[links.NAME.map]`` may hold: a rule for each flag that is to do something."""

        model_config = ConfigDict(extra="allow", frozen=True)
        __pydantic_extra__: dict[str, FlagRule] = Field(init=False)

        tell: Literal["values", "named", "nothing"] = Field(
            "values", description="what goes to the phone of what the robot tells unasked; named: its names too"
        )

        @model_validator(mode="after")
        def _are_flags(self) -> Self:
            for flag in self.__pydantic_extra__:
                if not re.fullmatch(FLAG_PATTERN, flag):
                    raise ValueError(f"{flag!r} is no flag: one character from 0 to z")
            return self

    protocol: ClassVar[str] = amarino.PROTOCOL

    def __init__(self, name: str, codec: Any, options: Any) -> None:
        options = options or self.Options()
        self._rules: dict[str, FlagRule] = options.__pydantic_extra__ or {}
        self._tell: str = options.tell
        self._rarely = Rarely()

    def heard(self, frame: Frame, now: float) -> Sequence[Say | Call]:
        if frame.subject in (ALIVE, TEXT) or not frame.payload:
            return ()
        flag = frame.payload[0]
        rule = self._rules.get(chr(flag))
        if rule is None:
            complaint = NOT_REGISTERED if flag <= LAST_FLAG else OUT_OF_BOUNDS
            return self._complain(frame, (complaint, str(flag)), now)
        try:
            parameters = rule.parameters(values(frame.payload[1:]))
        except (ValueError, OverflowError) as error:
            return self._complain(frame, (_joined(["falha", str(error)]),), now)
        return (Call(rule.command, parameters, newest=rule.stream, asked=frame),)

    def answered(self, call: Call, answer: Answer | None, error: str, now: float) -> Sequence[Say]:
        if answer is not None:
            words = [*([answer.status] if answer.status else []), *answer.values]
            return _say(words) if words else ()
        if call.newest and call.asked is not None:
            return self._complain(call.asked, (_joined(["falha", error]),), now)
        return _say(["falha", error] if error else ["falha"])

    def told(self, description: Description, now: float) -> Sequence[Say]:
        if self._tell == "nothing":
            return ()
        readings = description.get("readings") or {}
        told: list[Value] = list(readings.values() or description.get("parameters") or [])
        value = description.get("value")
        if not told and value is not None:
            told = [value]
        named = self._tell == "named"
        if named and readings:
            told = [part for name, reading in readings.items() for part in (name, reading)]
        command = description.get("command")
        words = [command] if named and command else []
        status, remark = description.get("status"), description.get("remark")
        if status:
            words.append(status)
        elif description.get("kind") == "error":
            words += ["falha", *([remark] if remark else [])]
        return _say([*words, *told]) if words or told else ()

    def _complain(self, frame: Frame, texts: Sequence[str], now: float) -> Sequence[Say]:
        trouble = _NUMBERS.sub("", texts[0])
        if not self._rarely.may((frame.payload[:1], trouble), now, COMPLAIN_EVERY_S):
            return ()
        return [Say(TEXT, text.encode("utf-8", "replace")) for text in texts]


def _say(words: Sequence[Value]) -> Sequence[Say]:
    text = _joined(words).encode("utf-8", "replace")[:LONGEST_TEXT]
    return () if text_trouble(text) else (Say(TEXT, text),)


def _joined(words: Sequence[Value]) -> str:
    """`words` as one text; what a text cannot hold is left out of them."""
    sayable = [_UNSAYABLE.sub(",", word) if isinstance(word, str) else word for word in words]
    return values_text([word if isinstance(word, str) or math.isfinite(word) else "" for word in sayable])

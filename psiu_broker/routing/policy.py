"""Who may command whom.

Rules say it, and the first that matches decides. What no rule matches passes, unless it comes from
beyond this computer by a link that others reach without leave, from a sender that nobody named.
Only commands are judged: answers, questions, what a robot tells unasked, and all that is said to the
broker itself, which moves nobody, pass.

Judging a frame again costs one look-up: what was decided for (source, destination, subject, way) is
kept, in two generations so that forgetting costs nothing, however many names somebody makes up.
"""

import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import translate
from typing import Final

from psiu_broker.frame import EVERYONE, Address, Frame, Way

KEPT: Final = 2048
"""Decisions in a generation."""
LONGEST_KEPT: Final = 64
"""What a longer subject decided is worked out again each time, so that the memory of decisions is small."""
ANY: Final = ("*",)


_Glob = Callable[[str], object] | None


_NUMBER: Final = re.compile(r"((?:.*\.)?0x)([0-9A-Fa-f*?\[\]!-]+)", re.DOTALL)
"""A PSIU HEXA address, or a glob for some."""


def _glob(globs: Sequence[str], *, any_case: bool = False) -> _Glob:
    """What tells whether one of `globs` fits a text, or is it; None where all do."""
    if "*" in globs:
        return None
    # ?? is everyone, and no glob for all names of two letters.
    patterns = [re.escape(each) for each in globs] + [translate(each) for each in globs if each != str(EVERYONE)]
    return re.compile("|".join(f"(?:{each})" for each in patterns), re.IGNORECASE if any_case else 0).fullmatch


def _addresses(globs: Sequence[str]) -> Sequence[str]:
    """`globs`, and how the numbers among them are told: 0x5 as 0x05, 0xA* as 0xa*."""
    numbers = [match for each in globs if (match := _NUMBER.fullmatch(each))]
    lower = [f"{match[1]}{match[2].lower()}" for match in numbers]
    return (*globs, *lower, *(str(Address.parse(each)) for each in lower))


def _any(glob: _Glob, texts: Iterable[str]) -> bool:
    return glob is None or any(glob(text) is not None for text in texts)


@dataclass(frozen=True, slots=True)
class Rule:
    """Whether a command that fits all four is let through; each is a choice of globs, as for file names.

    Names count as they are written, words of commands in any case. A command to everyone reaches whoever a rule
    is for: it is stopped by every denial that fits otherwise, and let through only by what allows ``*`` or ``??``.
    """

    allow: bool
    source: tuple[str, ...] = ANY
    destination: tuple[str, ...] = ANY
    command: tuple[str, ...] = ANY
    link: tuple[str, ...] = ANY
    where: str = ""
    """Where the configuration says so, as ``policy[0]``."""
    text: str = ""
    """The rule in words, where the rest does not tell it."""
    _globs: tuple[_Glob, ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        globs = (
            _glob(_addresses(self.source)),
            _glob(_addresses(self.destination)),
            _glob(self.command, any_case=True),
            _glob(self.link),
        )
        object.__setattr__(self, "_globs", globs)

    def fits(self, source: Iterable[str], destination: Iterable[str], words: Iterable[str] | None, link: str) -> bool:
        """Whether the rule is about such a command; `words` None: about any."""
        from_, to, command, by = self._globs
        return (
            (by is None or by(link) is not None)
            and _any(from_, source)
            and self._reaches(to, destination)
            and (words is None or _any(command, words))
        )

    def __str__(self) -> str:
        if self.text:
            return self.text
        named = {"source": self.source, "destination": self.destination, "command": self.command, "link": self.link}
        told = [f"{name} {' or '.join(globs)}" for name, globs in named.items() if globs != ANY]
        verb = "allows" if self.allow else "denies"
        return f"{self.where} {verb} {', '.join(told) or 'everything'}"

    def _reaches(self, to: _Glob, destination: Iterable[str]) -> bool:
        if to is None:
            return True
        destination = tuple(destination)
        if str(EVERYONE) in destination:
            return not self.allow or str(EVERYONE) in self.destination or "*" in self.destination
        return _any(to, destination)


UNNAMED: Final = Rule(
    False, text="it comes from beyond this computer, and the configuration names neither the sender nor its address"
)
"""What stops a command from a stranger beyond this computer."""

_MISSING: Final = Rule(False, where="not decided yet")


def _nobody(_: Way) -> bool:
    return False


def _itself(address: Address) -> tuple[Address, ...]:
    return (address,)


class Policy:
    """Judges commands. Pure: what it is told is all that it knows.

    Args:
        rules: the first that fits decides.
        own: the broker's own addresses.
        commands: whether a frame that came by a way is a command, which may move its destination.
        words: what rules may call the command of a frame that is one; the same for every frame of one subject and
            destination, unless that subject is empty.
        exposed: the links that others reach from beyond this computer without leave, with the robots that the
            configuration puts there.
        strange: whether who is there, on such a link, is beyond this computer and named by nobody.
    """

    def __init__(
        self,
        rules: Sequence[Rule] = (),
        own: Collection[Address] = (),
        commands: Callable[[Frame, Way], bool] = lambda *_: True,
        words: Callable[[Frame], Collection[str]] = lambda frame: (frame.subject,),
        exposed: Mapping[str, Collection[Address]] | None = None,
        strange: Callable[[Way], bool] = _nobody,
    ) -> None:
        self.rules = tuple(rules)
        self.words = words
        self.addresses_of: Callable[[Address], Iterable[Address]] = _itself
        """Every address of a robot; the router knows."""
        self._own = frozenset(own)
        self._commands = commands
        self._exposed = {link: frozenset(robots) for link, robots in (exposed or {}).items()}
        self._strange = strange
        self._new: dict[tuple[Address, Address, str, Way], Rule | None] = {}
        self._old = self._new

    @property
    def idle(self) -> bool:
        """Whether nothing is ever denied."""
        return not self.rules and not self._exposed

    def denial(self, frame: Frame, arrived: Way) -> Rule | None:
        """What keeps a frame that arrived from its destination; None where nothing does. Never raises."""
        found = self._new.get((frame.source, frame.destination, frame.subject, arrived), _MISSING)
        if found is None:
            return None
        if found is _MISSING:
            found = self._look_up(frame, arrived)
        if found is None or not self._commands(frame, arrived) or (found is UNNAMED and not self._strange(arrived)):
            return None
        return found

    def denial_of(self, source: Address, destination: Address, words: Collection[str], way: Way) -> Rule | None:
        """As `denial`, for a command that is no frame (yet); `words` are its names."""
        found = self._decide(source, destination, words, way.link)
        return None if found is UNNAMED and not self._strange(way) else found

    def about(self, source: Address, destination: Address, arrived: Way) -> tuple[list[Rule], Rule | None]:
        """Rules about some commands from one to the other, in their order, and what denies all others."""
        some: list[Rule] = []
        if destination not in self._own:
            from_, to = self._texts(source), self._texts(destination)
            for rule in self.rules:
                if rule.fits(from_, to, None, arrived.link):
                    if "*" in rule.command:
                        return some, None if rule.allow else rule
                    some.append(rule)
        rest = self._unnamed(source, destination, arrived.link)
        return some, rest if rest is not None and self._strange(arrived) else None

    def forget(self) -> None:
        """Addresses of robots have changed: decide anew."""
        self._new, self._old = {}, {}

    def _look_up(self, frame: Frame, arrived: Way) -> Rule | None:
        key = (frame.source, frame.destination, frame.subject, arrived)
        found = self._old.get(key, _MISSING)
        if found is _MISSING:
            found = self._decide(frame.source, frame.destination, self.words(frame), arrived.link)
        # Without a first word, what a robot makes of the rest may be anything.
        if 0 < len(frame.subject) <= LONGEST_KEPT:
            if len(self._new) >= KEPT:
                self._new, self._old = {}, self._new
            self._new[key] = found
        return found

    def _decide(self, source: Address, destination: Address, words: Collection[str], link: str) -> Rule | None:
        """The rule that denies; `UNNAMED` where it depends on who is there."""
        if destination in self._own:
            return None
        if self.rules:
            from_, to = self._texts(source), self._texts(destination)
            for rule in self.rules:
                if rule.fits(from_, to, words, link):
                    return None if rule.allow else rule
        return self._unnamed(source, destination, link)

    def _unnamed(self, source: Address, destination: Address, link: str) -> Rule | None:
        robots = self._exposed.get(link)
        return None if robots is None or source in robots or destination in self._own else UNNAMED

    def _texts(self, address: Address) -> tuple[str, ...]:
        return tuple(map(str, self.addresses_of(address)))

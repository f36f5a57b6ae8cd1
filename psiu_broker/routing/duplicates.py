"""A short memory of frames, against doubles.

Where two radios hear one robot, or brokers stand in a ring, one frame arrives by several ways.
The first way that brought it leads; the same frame by another way within the window is a double.
By the leading way it is a repeat (a person who presses twice) and passes.

The window must be longer than a frame can take by the slowest way, or it would go round for ever;
questions, which may wait longer than what moves a robot, have a window of their own.
Far ends of one link (UDP peers) are ways too, but quick ones, and a program may well send each of
its commands from a new port: among them the window is `same_link_s`.
"""

from collections.abc import Hashable
from math import inf

from psiu_broker.frame import MESH, Way
from psiu_broker.routing.outbox import is_question


class Duplicates:
    """Remembers each frame for at least its window, in two generations so that forgetting costs nothing."""

    __slots__ = ("_capacity", "_generation_s", "_new", "_old", "_question_s", "_same_link_s", "_until", "_window_s")

    def __init__(
        self,
        window_s: float = 4.0,
        same_link_s: float = 0.25,
        *,
        question_s: float | None = None,
        capacity: int = 16_384,
    ) -> None:
        """`question_s`: the window of questions; default: `window_s`."""
        self._window_s = window_s
        self._question_s = window_s if question_s is None else question_s
        self._generation_s = max(self._window_s, self._question_s)
        self._same_link_s = same_link_s
        self._capacity = capacity
        self._new: dict[Hashable, tuple[Way, float]] = {}
        self._old: dict[Hashable, tuple[Way, float]] = {}
        self._until = -inf
        """When the new generation becomes the old one."""

    def is_double(self, key: Hashable, way: Way, now: float, subject: str = "") -> bool:
        """Note the frame `key` about `subject` heard on `way`; True if it came by another less than the window ago."""
        if now > self._until:
            self._old = self._new
            self._new = {}
            self._until = now + self._generation_s
        new = self._new
        hearing = (way, now)
        seen = new.setdefault(key, hearing)
        if seen is hearing:
            before = self._old.get(key)
            if before is not None and self._is_another(before, way, now, subject):
                if before[0].link == MESH:
                    new[key] = self._leading(before, way)
                else:
                    del new[key]
                return True
            if len(new) >= self._capacity:
                self._until = -inf
        elif seen[0] is not way and self._is_another(seen, way, now, subject):
            new[key] = self._leading(seen, way)
            return True
        else:
            new[key] = hearing
        return False

    def knows(self, key: Hashable, way: Way, now: float, subject: str = "") -> bool:
        """Whether the frame `key` about `subject`, were it heard on `way` now, would be a double; notes nothing."""
        seen = self._new.get(key) or self._old.get(key)
        return seen is not None and self._is_another(seen, way, now, subject)

    def withdraw(self, key: Hashable) -> None:
        """The frame `key`, noted just now, was turned away: what comes next with its bytes is no double of it."""
        self._new.pop(key, None)
        self._old.pop(key, None)

    def heard_here(self, key: Hashable, since: float) -> bool:
        """Whether a link of ours, and not only another broker, brought the frame `key` at `since` or later."""
        seen = self._new.get(key) or self._old.get(key)
        return seen is not None and seen[0].link != MESH and seen[1] >= since

    def _leading(self, seen: tuple[Way, float], way: Way) -> tuple[Way, float]:
        """The way that leads from now on: a link of ours before another broker, however quick that was."""
        return (way, seen[1]) if seen[0].link == MESH else seen

    def forget(self, link: str, now: float) -> None:
        """`link` is gone: what it led may come by another way and be a repeat; only what is very new is a double."""
        for generation in (self._new, self._old):
            led = [key for key, (way, at) in generation.items() if way.link == link and now - at > self._same_link_s]
            for key in led:
                del generation[key]

    def _is_another(self, seen: tuple[Way, float], way: Way, now: float, subject: str) -> bool:
        """Whether what was `seen` came by another way than `way`, and so lately that this is its double."""
        if seen[0] == way:
            return False
        if seen[0].link == way.link:
            window_s = self._same_link_s
        else:
            window_s = self._question_s if is_question(subject) else self._window_s
        return now - seen[1] <= window_s

"""A short memory of frames, against doubles.

Where two radios hear one robot, or brokers stand in a ring, one frame arrives by several ways.
The first way that brought it leads; the same frame by another way within the window is a double.
By the leading way it is a repeat (a person who presses twice) and passes.

The window must be longer than a frame can take by the slowest way, or it would go round for ever.
Far ends of one link (UDP peers) are ways too, but quick ones, and a program may well send each of
its commands from a new port: among them the window is `same_link_s`.
"""

from collections.abc import Hashable

from psiu_broker.frame import Way


class Duplicates:
    """Remembers each frame for at least `window_s`, in two generations so that forgetting costs nothing."""

    __slots__ = ("_capacity", "_new", "_old", "_same_link_s", "_since", "_window_s")

    def __init__(self, window_s: float = 4.0, same_link_s: float = 0.25, *, capacity: int = 16_384) -> None:
        self._window_s = window_s
        self._same_link_s = same_link_s
        self._capacity = capacity
        self._new: dict[Hashable, tuple[Way, float]] = {}
        self._old: dict[Hashable, tuple[Way, float]] = {}
        self._since = float("-inf")

    def is_double(self, key: Hashable, way: Way, now: float) -> bool:
        """Note the frame `key` heard on `way`; True if it came by another way less than the window ago."""
        if now - self._since > self._window_s or len(self._new) >= self._capacity:
            self._old = self._new
            self._new = {}
            self._since = now
        seen = self._new.get(key) or self._old.get(key)
        if seen is not None and seen[0] != way:
            window_s = self._same_link_s if seen[0].link == way.link else self._window_s
            if now - seen[1] <= window_s:
                return True
        self._new[key] = (way, now)
        return False

"""Which brokers are announced, and who else has our name."""

from collections.abc import Iterator
from typing import Final

BROKERS_MAX: Final = 1024
LIVES_MAX: Final = 16
"""Of one broker."""
EDITIONS_MAX: Final = 16
"""Of one life."""
NAMESAKE_S: Final = 3.0
"""A broker of our name that is announced for longer than this is no former life of ours."""
NAMESAKES_MAX: Final = 64


class _Life:
    """One life of a broker, as it is announced."""

    __slots__ = ("editions", "zenoh_id")

    def __init__(self, zenoh_id: str) -> None:
        self.zenoh_id = zenoh_id
        self.editions: set[str] = set()
        """Its announcements: two for a moment while it declares everything anew."""


class Lives:
    """Each broker's lives that are announced: one, and for a while what Zenoh still keeps of a former one."""

    def __init__(self) -> None:
        self._announced: dict[str, dict[int, _Life]] = {}

    def came(self, name: str, epoch: int, zenoh_id: str, edition: str) -> bool:
        """Note an announcement; False where there are too many."""
        if name not in self._announced and len(self._announced) >= BROKERS_MAX:
            return False
        lives = self._announced.setdefault(name, {})
        if epoch not in lives and len(lives) >= LIVES_MAX:
            return False
        life = lives.setdefault(epoch, _Life(zenoh_id))
        if len(life.editions) < EDITIONS_MAX:
            life.editions.add(edition)
        return True

    def went(self, name: str, epoch: int, edition: str) -> bool:
        """An announcement is no more; True where it was the last one of that life."""
        lives = self._announced.get(name, {})
        life = lives.get(epoch)
        if life is None:
            return False
        life.editions.discard(edition)
        if life.editions:
            return False
        del lives[epoch]
        if not lives:
            del self._announced[name]
        return True

    def has(self, name: str, epoch: int) -> bool:
        return epoch in self._announced.get(name, {})

    def latest(self, name: str) -> int | None:
        """The epoch of the broker's last life that is announced."""
        return max(self._announced.get(name, ()), default=None)

    def zenoh_id(self, name: str, epoch: int) -> str:
        return self._announced[name][epoch].zenoh_id

    def clear(self) -> None:
        self._announced.clear()


class _Namesake:
    """Another broker with our name."""

    __slots__ = ("editions", "since")

    def __init__(self, since: float) -> None:
        self.since = since
        self.editions: set[str] = set()


class Namesakes:
    """Other brokers with our name, by their epochs; a former life of ours is one for a moment."""

    def __init__(self) -> None:
        self._known: dict[int, _Namesake] = {}

    def came(self, epoch: int, edition: str, now: float) -> None:
        if epoch in self._known or len(self._known) < NAMESAKES_MAX:
            namesake = self._known.setdefault(epoch, _Namesake(now))
            if len(namesake.editions) < EDITIONS_MAX:
                namesake.editions.add(edition)

    def went(self, epoch: int, edition: str) -> None:
        namesake = self._known.get(epoch)
        if namesake is not None:
            namesake.editions.discard(edition)
            if not namesake.editions:
                del self._known[epoch]

    def since(self, now: float) -> Iterator[float]:
        """Since when each one that stays is there."""
        return (each.since for each in self._known.values() if now - each.since > NAMESAKE_S)

    def clear(self) -> None:
        self._known.clear()

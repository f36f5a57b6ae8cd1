"""What waits for the next packet of a team: of each robot only the newest set-point, but no stop is passed over."""

from collections.abc import Collection

from psiu_broker.routing.outbox import Outbox, Parcel


class SetPoints(Outbox):
    """At most a stop and a set-point for each of `robots`; in their frames, destinations are their numbers.

    A newer set-point takes the place of an older one. It waits behind a stop, or whoever sends set-points
    without pause would undo somebody else's stop before it left.
    """

    __slots__ = ()

    def __init__(self, robots: int) -> None:
        super().__init__(2 * robots)

    def replace(self, parcel: Parcel) -> list[Parcel]:
        """Queue `parcel`; what it took the place of. A stop takes that of everything for its robot."""
        robot = _robot(parcel)
        superseded = self._take_out(lambda older: _robot(older) == robot and older.lane >= parcel.lane)
        self.put(parcel)
        return superseded

    def due(self) -> dict[int, Parcel]:
        """What the next packet carries, by robot; it goes on waiting until `remove`."""
        return {_robot(parcel): parcel for parcel in reversed(tuple(self))}

    def remove(self, parcels: Collection[Parcel]) -> None:
        """Take out what has left."""
        gone = set(map(id, parcels))
        self._take_out(lambda parcel: id(parcel) in gone)


def _robot(parcel: Parcel) -> int:
    return parcel.fate.frame.destination.number

"""All trunks of a broker, and where they meet its Zenoh session."""

import time
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from psiu_broker.config import TrunkConfiguration
from psiu_broker.trunk.folder import Folder
from psiu_broker.trunk.local import Meeting
from psiu_broker.trunk.trunk import Trunk


class Endpoints(NamedTuple):
    """What the session of a broker with trunks listens at and connects to beside its own, as Zenoh writes it."""

    listen: Sequence[str] = ()
    connect: Sequence[str] = ()


class Trunks:
    """Empty where none is configured; then nothing is made of it anywhere."""

    def __init__(self, broker: str, configurations: Collection[TrunkConfiguration]) -> None:
        epoch = f"{time.time_ns():x}"
        self._folder: Folder | None = None
        self._all = [Trunk(each, broker, epoch, Meeting(Path(), Path())) for each in configurations]

    def __iter__(self) -> Iterator[Trunk]:
        return iter(self._all)

    def meet(self) -> Endpoints:
        """Where a session that is about to open meets the trunks; they leave the one that was there before."""
        if not self._all:
            return Endpoints()
        # A new one each time: a session lost to a panic may still be in the old one.
        former, self._folder = self._folder, Folder.make()
        if former is not None:
            former.remove()
        if self._folder is None:
            return Endpoints()
        session = self._folder.path / "session"
        doors = [self._folder.path / str(number) for number in range(len(self._all))]
        for trunk, door in zip(self._all, doors, strict=True):
            trunk.move(Meeting(door, session))
        return Endpoints([_endpoint(session)], [_endpoint(door) for door in doors])

    def close(self) -> None:
        """Leave nothing behind, when the trunks have ended and the session is closed."""
        if self._folder is not None:
            self._folder.remove()
        self._folder = None


def _endpoint(path: Path) -> str:
    return f"unixsock-stream/{path}"

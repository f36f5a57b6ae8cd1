"""What the mesh needs of the bus."""

from collections.abc import Collection
from typing import Protocol

from psiu_broker.mesh.beat import Beat, Notice
from psiu_broker.routing.claims import Claim


class MeshBus(Protocol):
    """What the mesh needs of the bus. None of these waits or raises."""

    zenoh_id: str
    linked: Collection[str]
    """The Zenoh ids of those to whom a link of ours leads."""

    def put_frame(self, to: str, lane: int, data: bytes) -> bool:
        """False: it did not leave."""

    def put_beat(self, beat: Beat) -> None: ...
    def put_notice(self, to: str, notice: Notice) -> None: ...
    def announce(self, epoch: int) -> None:
        """Say that we are there, in this life; before the first `claim`."""

    def claim(self, claim: Claim) -> None: ...
    def withdraw(self, claim: Claim) -> None: ...
    def declare_anew(self) -> None:
        """Declare everything once more, for brokers that have lost sight of it."""

    def hang_up(self, zenoh_id: str | None) -> None:
        """End the links to a broker, or to all, so that they begin anew."""


class NoBus:
    """In the bus's place while there is none."""

    zenoh_id = ""
    linked: Collection[str] = ()

    def put_frame(self, to: str, lane: int, data: bytes) -> bool:
        return False

    def put_beat(self, beat: Beat) -> None: ...
    def put_notice(self, to: str, notice: Notice) -> None: ...
    def announce(self, epoch: int) -> None: ...
    def claim(self, claim: Claim) -> None: ...
    def withdraw(self, claim: Claim) -> None: ...
    def declare_anew(self) -> None: ...
    def hang_up(self, zenoh_id: str | None) -> None: ...

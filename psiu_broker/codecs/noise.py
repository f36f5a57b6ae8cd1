"""Bytes that were no frame, gathered until their run ends: bounded, however long the run is."""

from typing import Final

from psiu_broker.codecs.codec import Event
from psiu_broker.frame import MALFORMED_KEPT, Malformed

NOISE: Final = "noise"

LONGEST_RUN: Final = 4096
"""A longer run is reported in pieces of this size, so that endless noise does not go unseen."""

_KEPT: Final = 1024


class Noise:
    """One run of bytes that were no frame."""

    __slots__ = ("kept", "size")

    def __init__(self) -> None:
        self.kept = bytearray()
        self.size = 0

    def add(self, data: bytes | bytearray, events: list[Event]) -> None:
        """Lengthen the run by `data`; append a `Malformed` to `events` each time it grows too long."""
        at = 0
        while (room := LONGEST_RUN - self.size) < len(data) - at:
            self._keep(data, at, room)
            self.end(NOISE, events)
            at += room
        self._keep(data, at, len(data) - at)

    def end(self, reason: str, events: list[Event]) -> None:
        """The run is over: append it to `events`, if there was one."""
        if self.size:
            events.append(Malformed(reason, bytes(self.kept[:MALFORMED_KEPT]), self.size))
            self.kept.clear()
            self.size = 0

    def _keep(self, data: bytes | bytearray, at: int, size: int) -> None:
        self.kept += data[at : at + min(size, _KEPT - len(self.kept))]
        self.size += size

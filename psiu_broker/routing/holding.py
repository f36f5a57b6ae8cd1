"""Frames for a robot that nobody has heard yet: kept for a moment while it is asked for by name."""

from collections.abc import Iterator
from math import inf
from typing import NamedTuple

from psiu_broker.frame import Address, Frame, Way


class Held(NamedTuple):
    frame: Frame
    arrived: Way
    since: float


class Holding:
    """A small, bounded waiting room, by destination.

    Asking is bounded too, because anybody can send frames to names that nobody has: at most
    `asks` destinations at once, each once every `hold_s`.
    """

    def __init__(self, hold_s: float = 0.5, *, capacity: int = 256, asks: int = 8) -> None:
        self._hold_s = hold_s
        self._capacity = capacity
        self._asks = asks
        self._held: dict[Address, list[Held]] = {}
        self._asked: dict[Address, float] = {}
        """When each destination that is waited for was asked for."""
        self._size = 0

    def __iter__(self) -> Iterator[Held]:
        return (held for frames in self._held.values() for held in frames)

    def is_due(self, destination: Address, now: float) -> bool:
        """Whether to ask for `destination`: not while an answer may be on its way, but again if that stays out."""
        return now - self._asked.get(destination, -inf) >= self._hold_s

    def asked(self, destination: Address, now: float) -> None:
        """`destination`, for which frames wait, is asked for now."""
        self._asked[destination] = now

    def add(self, frame: Frame, arrived: Way, now: float) -> bool:
        """Keep `frame`; False when the room is full or too many others are being asked for."""
        if self._size >= self._capacity or (len(self._held) >= self._asks and frame.destination not in self._held):
            return False
        self._held.setdefault(frame.destination, []).append(Held(frame, arrived, now))
        self._size += 1
        return True

    def release(self, destination: Address) -> list[Held]:
        """Take out the frames for `destination`, oldest first: it has been heard."""
        released = self._held.pop(destination, [])
        self._asked.pop(destination, None)
        self._size -= len(released)
        return released

    def expire(self, now: float) -> list[Held]:
        """Take out the frames whose destination did not answer in time."""
        expired: list[Held] = []
        for destination in list(self._held):
            frames = self._held[destination]
            late = [held for held in frames if held.since + self._hold_s <= now]
            if late:
                expired += late
                # Not just the first: one from another broker is as old as it was when it came.
                frames[:] = [held for held in frames if held.since + self._hold_s > now]
            if not frames:
                del self._held[destination]
                self._asked.pop(destination, None)
        self._size -= len(expired)
        return expired

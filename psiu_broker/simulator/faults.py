"""Faulty lines: what may happen to bytes between a robot and whoever listens, the same again for the same seed."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from random import Random
from typing import Final

BYTE_S: Final = 0.001
"""The time between bytes sent one at a time: a line of about 9600 baud."""


@dataclass(frozen=True)
class Faults:
    """The faults of a line, both ways; the default has none.

    What is handed over at once (a frame, a datagram, what one read gave) is one piece. `loss`,
    `corruption` (one bit is flipped) and `duplicate` are the chances of a piece, 0 to 1. A piece
    arrives after `delay_s` plus a random time up to `jitter_s`, never before an earlier one.
    Nothing passes during `silences`: (from, until) in seconds since the line began.
    """

    loss: float = 0.0
    corruption: float = 0.0
    duplicate: float = 0.0
    delay_s: float = 0.0
    jitter_s: float = 0.0
    silences: Sequence[tuple[float, float]] = ()
    one_byte_at_a_time: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ValueError: a chance outside 0–1, or a negative time.
        """
        for name in ("loss", "corruption", "duplicate"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} is a chance from 0 to 1, not {getattr(self, name)}")
        if self.delay_s < 0 or self.jitter_s < 0 or any(not 0 <= a <= b for a, b in self.silences):
            raise ValueError("a delay, a jitter or a silence cannot be negative")

    def line(self, name: str, now: float) -> "Line":
        """One direction of the line, which begins `now`; each `name` has its own luck."""
        return Line(self, name, now)


class Line:
    """One direction of a faulty line."""

    def __init__(self, faults: Faults, name: str, now: float) -> None:
        self._faults = faults
        self._random = Random(f"{faults.seed}/{name}")  # noqa: S311 - faults that can be repeated
        self._began = now
        self._last = -math.inf

    def carry(self, data: bytes, now: float) -> list[tuple[float, bytes]]:
        """What arrives of the piece `data`, and how many seconds from now."""
        faults, luck = self._faults, self._random
        # The same throws for every piece, so that changing one fault leaves the luck of the others alone.
        lost, damaged, doubled, late = (luck.random() for _ in range(4))
        place = int(luck.random() * 8 * len(data))
        age_s = now - self._began
        if lost < faults.loss or not data or any(a <= age_s < b for a, b in faults.silences):
            return []
        if damaged < faults.corruption:
            changed = bytearray(data)
            changed[place // 8] ^= 1 << place % 8
            data = bytes(changed)
        start = now + faults.delay_s + late * faults.jitter_s
        copies = [data, data] if doubled < faults.duplicate else [data]
        arrivals: list[tuple[float, bytes]] = []
        for copy in copies:
            pieces = [copy[i : i + 1] for i in range(len(copy))] if faults.one_byte_at_a_time else [copy]
            for piece in pieces:
                start = max(start, self._last)
                arrivals.append((start - now, piece))
                self._last = start + BYTE_S if faults.one_byte_at_a_time else start
        return arrivals

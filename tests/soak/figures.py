"""What is looked at while the broker is under load, and whether it is good enough. Pure, but for `look`."""

import os
from collections.abc import Sequence
from itertools import accumulate
from pathlib import Path
from typing import Final, NamedTuple

MIB: Final = 2**20
FLOOR_S: Final = 30.0
"""Memory is compared by the least of so long: what frames that wait take for a while is no leak."""
SHARP_S: Final = 240.0
"""Measured for less than this, the last that fills after the warm-up looks like a leak."""
MORE_AT_REST: Final = 2
"""So many more descriptors, or tasks, than before the load may be in use after it."""


class Usage(NamedTuple):
    """What a process uses at a moment."""

    at_s: float
    rss_mib: float
    in_use_mib: float
    """Without what is free, but not given back to the system."""
    descriptors: int
    threads: int


def look(pid: int, in_use: Path, at_s: float) -> Usage:
    """`in_use` is the file of `watched.py`. Raises OSError if the process has ended."""
    process = Path(f"/proc/{pid}")
    status = dict(line.split(":", 1) for line in (process / "status").read_text().splitlines())
    rss_mib = int(status["VmRSS"].split()[0]) / 1024
    in_use_mib = int(in_use.read_text()) / MIB
    return Usage(at_s, rss_mib, in_use_mib, len(os.listdir(process / "fd")), int(status["Threads"]))  # noqa: PTH208


class Trend(NamedTuple):
    """The line that fits best through the most, so far, of the least of every `FLOOR_S`.

    A session that is lost, as happens where a machine has too much to do, gives back what is taken again later.
    """

    mib_per_h: float
    measured_s: float

    @classmethod
    def of(cls, points: Sequence[tuple[float, float]]) -> "Trend":
        """`points` are seconds and MiB."""
        floors: dict[float, float] = {}
        for at_s, mib in points:
            floor = at_s // FLOOR_S
            floors[floor] = min(mib, floors.get(floor, mib))
        if len(floors) < 2:
            return cls(0.0, 0.0)
        most = list(accumulate(floors.values(), max))
        mean, mean_mib = (sum(values) / len(most) for values in (floors, most))
        spread = sum((floor - mean) ** 2 for floor in floors)
        slope = sum((floor - mean) * (mib - mean_mib) for floor, mib in zip(floors, most, strict=True)) / spread
        return cls(slope / FLOOR_S * 3600, points[-1][0] - points[0][0])


class Bound(NamedTuple):
    """How much memory may grow: by `step_mib`, and for each hour by `mib_per_h` more."""

    step_mib: float
    mib_per_h: float

    def most_mib(self, measured_s: float) -> float:
        return self.step_mib + self.mib_per_h * measured_s / 3600


RSS: Final = Bound(12.0, 4.0)
"""What is freed leaves gaps, now and then of 2 MiB: coarse, beside what is in use."""
IN_USE: Final = Bound(0.3, 0.6)
"""What fills last is 0.22 MiB of it in a run of ten minutes; there a leak of 1 kB/s would be 0.38 MiB more."""
IN_USE_AT_FIRST: Final = Bound(1.0, 0.0)
"""Measured for less than `SHARP_S`."""


class Growth(NamedTuple):
    """How some kind of memory grew after the warm-up."""

    what: str
    trend: Trend
    bound: Bound

    @property
    def grown_mib(self) -> float:
        return self.trend.mib_per_h * self.trend.measured_s / 3600

    @property
    def most_mib(self) -> float:
        return self.bound.most_mib(self.trend.measured_s)

    @property
    def seen_kb_per_s(self) -> float:
        """The least leak that would be too much."""
        return self.most_mib * MIB / 1000 / self.trend.measured_s if self.trend.measured_s else float("inf")


def growths(usages: Sequence[Usage]) -> tuple[Growth, Growth]:
    """Of what is in use, and of the resident memory, from the end of the warm-up on."""
    in_use = Trend.of([(each.at_s, each.in_use_mib) for each in usages])
    rss = Trend.of([(each.at_s, each.rss_mib) for each in usages])
    bound = IN_USE if in_use.measured_s >= SHARP_S else IN_USE_AT_FIRST
    return Growth("in use", in_use, bound), Growth("resident", rss, RSS)


class Rest(NamedTuple):
    """How the broker is while nothing is wrong and little is asked of it."""

    descriptors: int
    threads: int
    tasks: int


def complaints(before: Rest, after: Rest, grown: Sequence[Growth], unbalanced: int, frames: int) -> list[str]:
    """What is not as it should be, in words."""
    found = []
    if unbalanced:
        found.append(f"the ledger did not balance: {unbalanced} times")
    if not frames:
        found.append("no frame arrived")
    found += [
        f"the memory {each.what} grew by {each.grown_mib:.2f} MiB, and {each.most_mib:.2f} MiB is the most"
        for each in grown
        if each.grown_mib > each.most_mib
    ]
    return found + more_at_rest(before, after)


def more_at_rest(before: Rest, after: Rest) -> list[str]:
    """What is in use `after`, and was not `before`, in words."""
    return [
        f"{what} before: {was}, after: {now}"
        for what, was, now in zip(Rest._fields, before, after, strict=True)
        if now > was + MORE_AT_REST
    ]

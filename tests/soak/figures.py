"""What is looked at while the broker is under load, and whether it is good enough. Pure, but for `look`."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

RSS_STEP_MIB: Final = 2.0
RSS_MIB_PER_H: Final = 4.0
"""After the warm-up the memory may have grown by `RSS_STEP_MIB`, and for each hour by this more."""
MORE_AT_REST: Final = 2
"""So many more descriptors, or tasks, than before the load may be in use after it."""


class Usage(NamedTuple):
    """What a process uses at a moment."""

    at_s: float
    rss_mib: float
    descriptors: int
    threads: int


def look(pid: int, at_s: float) -> Usage:
    """Raises OSError if the process has ended."""
    process = Path(f"/proc/{pid}")
    status = dict(line.split(":", 1) for line in (process / "status").read_text().splitlines())
    rss_mib = int(status["VmRSS"].split()[0]) / 1024
    return Usage(at_s, rss_mib, len(os.listdir(process / "fd")), int(status["Threads"]))  # noqa: PTH208


class Trend(NamedTuple):
    """The line through the memory of some moments that fits best."""

    mib_per_h: float
    measured_s: float

    @classmethod
    def of(cls, usages: Sequence[Usage]) -> "Trend":
        if len(usages) < 2:
            return cls(0.0, 0.0)
        mean_s = sum(each.at_s for each in usages) / len(usages)
        mean_mib = sum(each.rss_mib for each in usages) / len(usages)
        spread = sum((each.at_s - mean_s) ** 2 for each in usages)
        slope = sum((each.at_s - mean_s) * (each.rss_mib - mean_mib) for each in usages) / spread
        return cls(slope * 3600, usages[-1].at_s - usages[0].at_s)

    @property
    def grown_mib(self) -> float:
        return self.mib_per_h * self.measured_s / 3600

    @property
    def allowed_mib(self) -> float:
        return RSS_STEP_MIB + RSS_MIB_PER_H * self.measured_s / 3600


class Rest(NamedTuple):
    """How the broker is while nothing is wrong and little is asked of it."""

    descriptors: int
    threads: int
    tasks: int


def complaints(before: Rest, after: Rest, trend: Trend, unbalanced: int, frames: int) -> list[str]:
    """What is not as it should be, in words."""
    found = []
    if unbalanced:
        found.append(f"the ledger did not balance: {unbalanced} times")
    if not frames:
        found.append("no frame arrived")
    if trend.grown_mib > trend.allowed_mib:
        found.append(f"the memory grew by {trend.grown_mib:.1f} MiB, and {trend.allowed_mib:.1f} MiB is the most")
    for what in ("descriptors", "threads", "tasks"):
        was, now = getattr(before, what), getattr(after, what)
        if now > was + MORE_AT_REST:
            found.append(f"{what} before: {was}, after: {now}")
    return found

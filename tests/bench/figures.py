"""What was found: medians, quartiles and percentiles, and the machine they hold for."""

import os
import platform
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

SHARES = (0.5, 0.99, 0.999)


@dataclass(frozen=True)
class Cost:
    """Medians over the rounds; `times` is the CPU cost over the baseline's, round by round, with its quartiles."""

    name: str
    frames_a_second: int
    cpu_us: float
    times: float
    times_quartiles: tuple[float, float]
    sent: int
    lost: int
    doubled: int
    rss_mib: float
    start_ms: float | None = None
    """From exec to the first frame forwarded."""
    told: float | None = None
    """The share of the frames that the Zenoh client was told of."""


@dataclass(frozen=True)
class Latency:
    """p50, p99 and p99.9 in µs; `added` is what is more than without a router."""

    name: str
    percentiles: tuple[float, ...]
    added: tuple[float, ...] | None
    lost: int


@dataclass(frozen=True)
class Figures:
    costs: list[Cost]
    robots: list[Cost]
    latencies: list[Latency]

    @property
    def lost(self) -> int:
        """Frames that did not arrive exactly once."""
        costs = sum(cost.lost + cost.doubled for cost in (*self.costs, *self.robots))
        return costs + sum(latency.lost for latency in self.latencies)


def cost(
    name: str,
    rates: Sequence[float],
    cpu_us: Sequence[float],
    baseline_us: Sequence[float],
    *,
    sent: int,
    lost: int,
    doubled: int,
    rss_mib: float,
    start_ms: float | None,
    told: float | None,
) -> Cost:
    times = sorted(cost / base for cost, base in zip(cpu_us, baseline_us, strict=True))
    quartiles = times[len(times) // 4], times[-1 - len(times) // 4]
    return Cost(
        name,
        round(statistics.median(rates)),
        statistics.median(cpu_us),
        statistics.median(times),
        quartiles,
        sent,
        lost,
        doubled,
        rss_mib,
        start_ms,
        told,
    )


def latency(name: str, took_us: Sequence[float], floor_us: Sequence[float] | None, sent: int) -> Latency:
    percentiles = _percentiles(took_us)
    added = None
    if floor_us is not None:
        added = tuple(routed - direct for routed, direct in zip(percentiles, _percentiles(floor_us), strict=True))
    return Latency(name, percentiles, added, sent - len(took_us))


def machine() -> dict[str, str | int]:
    """What the figures were measured on."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    cpu = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())
    return {
        "cpu": cpu,
        "cores": os.cpu_count() or 0,
        "kernel": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
    }


def _percentiles(values: Sequence[float]) -> tuple[float, ...]:
    ordered = sorted(values) or [0.0]
    return tuple(ordered[min(len(ordered) - 1, int(len(ordered) * share))] for share in SHARES)

"""The figures as tables, coloured on a terminal and plain elsewhere."""

from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.table import Table

from tests.bench.figures import Cost, Figures, Latency, machine
from tests.bench.load import IN_FLIGHT
from tests.bench.measure import Plan

PLAIN_WIDTH = 118


def show(figures: Figures, plan: Plan) -> None:
    console = Console()
    if not console.is_terminal:
        console = Console(width=PLAIN_WIDTH)
    here = machine()
    console.print(
        f"{here['cpu']}, {here['cores']} cores, {here['kernel']}, Python {here['python']}\n"
        f"Two links, robots behind both; 41-byte frames, {IN_FLIGHT} in flight; router and load on a core each.\n"
        f"Medians of {plan.rounds} interleaved rounds of {plan.frames:,} frames. "
        "CPU: all threads of the router over the frames delivered;\n"
        "×: over the first line of the same links, round by round, with quartiles.\n",
        highlight=False,
    )
    console.print(_costs("What a frame costs", "× bare", figures.costs))
    console.print(_costs("What it costs among many robots, UDP → UDP, frames between all of them", "×", figures.robots))
    console.print(_latencies(figures.latencies))


def _costs(title: str, times: str, costs: Sequence[Cost]) -> Table:
    started = any(cost.start_ms is not None for cost in costs)
    table = _table(title, "frames/s", "CPU µs", times, "lost", "RSS MiB", *(["start ms"] if started else []))
    for cost in costs:
        low, high = cost.times_quartiles
        table.add_row(
            cost.name if cost.told is None else f"{cost.name} (told {cost.told:.0%})",
            f"{cost.frames_a_second:,}",
            f"{cost.cpu_us:.1f}",
            f"{cost.times:.2f} ({low:.2f}–{high:.2f})",
            f"{cost.lost}" + (f", {cost.doubled} twice" if cost.doubled else ""),
            f"{cost.rss_mib:.0f}",
            "" if cost.start_ms is None else f"{cost.start_ms:.0f}",
        )
    return table


def _latencies(latencies: Sequence[Latency]) -> Table:
    table = _table("Latency at 1 kHz, µs", "p50", "p99", "p99.9", "added p50", "p99", "p99.9", "lost")
    for latency in latencies:
        added = ["", "", ""] if latency.added is None else [f"{us:.0f}" for us in latency.added]
        table.add_row(latency.name, *(f"{us:.0f}" for us in latency.percentiles), *added, str(latency.lost))
    return table


def _table(title: str, *headings: str) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD)
    table.add_column("", no_wrap=True)
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    return table

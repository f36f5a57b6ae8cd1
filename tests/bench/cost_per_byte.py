"""Print what a byte costs each codec, whatever it hears: python -m tests.bench.cost_per_byte"""

import sys
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

import click
from rich import box
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parents[1]))

from attack.costs import cost_us
from attack.crafted import CRAFTS

from tests.bench.figures import machine
from tests.bench.report import PLAIN_WIDTH

KB, MB = 1_000, 1_000_000
SAMPLE = 16_000
"""Enough to tell the dearest."""
READ = 4096
"""What a link reads at a time."""

Row = tuple[str, float, float, float]


@click.command()
@click.option("--quick", is_flag=True, help="Short streams: whether it works, no figures to quote.")
@click.option("--all", "every", is_flag=True, help="Every crafted stream; else the dearest of each codec.")
def main(quick: bool, every: bool) -> None:
    """Tell codecs streams made to be as dear as can be, 1 kB and 1 MB long; a byte should cost the same in both."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=PLAIN_WIDTH)
    here = machine()
    console.print(f"{here['cpu']}, {here['kernel']}, Python {here['python']}", highlight=False)
    table = Table(
        title="What a byte costs at worst, CPU µs", title_justify="left", title_style="bold", box=box.SIMPLE_HEAD
    )
    table.add_column("", no_wrap=True)
    for heading in ("1 kB", "1 MB", "1 byte at a time", "times, 1 MB over 1 kB"):
        table.add_column(heading, justify="right")
    for name, few, many, single in _rows(quick=quick, every=every):
        table.add_row(name, f"{few:.2f}", f"{many:.2f}", f"{single:.2f}", f"{many / few:.1f}")
    console.print(table)


def _rows(*, quick: bool, every: bool) -> Iterator[Row]:
    many = MB // (100 if quick else 1)
    tries = 1 if quick else 5
    for _, group in groupby(CRAFTS, lambda craft: craft.name.partition(",")[0]):
        crafts = list(group)
        for craft in crafts if every else [max(crafts, key=lambda craft: cost_us(craft, SAMPLE, READ, 1))]:
            yield (
                craft.name,
                cost_us(craft, KB, KB, tries),
                cost_us(craft, many, READ, 1),
                cost_us(craft, KB, 1, tries),
            )


if __name__ == "__main__":
    main()

"""Print the figures of the README: python -m tests.bench"""

import dataclasses
import json
import sys

import click
from rich.console import Console

from tests.bench.figures import machine
from tests.bench.measure import QUICK, Plan, measure
from tests.bench.report import show


@click.command()
@click.option("--quick", is_flag=True, help="A few frames only: whether it works, no figures to quote.")
@click.option("--rounds", type=click.IntRange(1), help="Rounds of the costs, 31 by default.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object.")
def main(quick: bool, rounds: int | None, as_json: bool) -> None:
    """Measure the bare Python forwarder and psiu-broker side by side; 1 if a frame did not arrive exactly once."""
    plan = QUICK if quick else Plan()
    if rounds is not None:
        plan = dataclasses.replace(plan, rounds=rounds)
    with Console(stderr=True).status("") as status:
        figures = measure(plan, status.update)
    if as_json:
        print(json.dumps({"machine": machine(), **dataclasses.asdict(figures)}, indent=1, ensure_ascii=False))
    else:
        show(figures, plan)
    sys.exit(figures.lost > 0)


main()

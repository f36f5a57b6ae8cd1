"""Print how the mesh grows: python -m tests.bench.mesh_scale

Real routing and mesh code over a simulated network (tests/mesh/simulated.py), in one process.
"""

import gc
import platform
import sys
import time
import tracemalloc
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import click
from rich import box
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parents[1]))

from mesh.simulated import RADIO, Simulation, wire

from psiu_broker.mesh.neighbour import BEAT_S

SIZES: Final = (5, 10, 20, 50)
ROBOTS: Final = 20
DELAY_S: Final = 0.005
STEADY_S: Final = 4.0
LATEST_S: Final = 30.0


@dataclass(frozen=True)
class Growth:
    """What was measured with `brokers`, each of which has `robots`; messages as they are received."""

    brokers: int
    robots: int
    start_s: float
    """From the first broker's start until all agree on every robot, and how many messages that took."""
    start_messages: int
    start_cpu_s: float
    changes: dict[str, tuple[float, int]]
    """Until all agree on one robot that appears, roams or vanishes, and the messages that are not beats."""
    steady_messages_s: float
    """Received by one broker in a second in which robots talk and none moves."""
    seldom_tokens_s: float
    """The same, of tokens only, where the robots talk every 7 s."""
    steady_cpu: float
    """Of one processor, for one broker."""
    beat_bytes: int
    memory_kib: float
    """Of one broker."""


def measure(brokers: int, robots: int, steady_s: float) -> Growth:
    """Let `brokers` start with their robots at the same time, and change one robot at a time."""
    names = [f"base{number:02}" for number in range(brokers)]
    everyone = {robot_of(name, number): name for name in names for number in range(robots)}
    began_cpu = time.process_time()
    mesh = started(names, everyone)
    start_s = until(mesh, lambda: not mesh.disagreements(everyone))
    start_cpu_s = time.process_time() - began_cpu
    start_messages = sum(mesh.sent.values())
    first, second = names[0], names[-1]
    changes = {
        "appears": change(mesh, "NOVO", lambda: mesh.says("NOVO", [first], first, "oi"), first),
        "roams": change(mesh, "NOVO", lambda: mesh.says("NOVO", [second], second, "oi"), second),
        "vanishes": change(mesh, "NOVO", lambda: vanish(mesh, "NOVO", second), None),
    }
    talk(mesh, everyone.items(), 2)
    mesh.sent.clear()
    steady_cpu = time.process_time()
    talk(mesh, everyone.items(), steady_s)
    steady_cpu = time.process_time() - steady_cpu
    steady = mesh.sent.copy()
    for _ in range(2):
        mesh.sent.clear()
        talk(mesh, everyone.items(), 7, every_s=7)
    seldom = mesh.sent["token"] + mesh.sent["untoken"]
    return Growth(
        brokers,
        robots,
        start_s,
        start_messages,
        start_cpu_s,
        changes,
        sum(steady.values()) / steady_s / brokers,
        seldom / 7 / brokers,
        steady_cpu / steady_s / brokers,
        len(mesh.beat.model_dump_json()) if mesh.beat is not None else 0,
        memory_kib(names, everyone) / brokers,
    )


def started(names: Iterable[str], everyone: dict[str, str]) -> Simulation:
    """Brokers that have just started, and whose robots have spoken."""
    mesh = Simulation((), delay_s=DELAY_S, links=(RADIO,))
    for name in names:
        mesh.start(name)
    for robot, name in everyone.items():
        mesh.says(robot, [name], name, "oi")
    return mesh


def memory_kib(names: Iterable[str], everyone: dict[str, str]) -> float:
    gc.collect()
    tracemalloc.start()
    mesh = started(names, everyone)
    mesh.run(1)
    gc.collect()
    used = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    return used / 1024


def robot_of(broker: str, number: int) -> str:
    return f"{broker}-ROBO-{number:02}"


def until(mesh: Simulation, true: Callable[[], bool]) -> float:
    began = mesh.now
    while not true():
        if mesh.now - began > LATEST_S:
            raise click.ClickException(f"the brokers do not agree after {LATEST_S:g} s")
        mesh.run(0.01)
    return mesh.now - began


def change(mesh: Simulation, robot: str, happen: Callable[[], object], owner: str | None) -> tuple[float, int]:
    mesh.sent.clear()
    happen()
    took_s = until(mesh, lambda: set(mesh.owners(robot).values()) == {owner} and not mesh.disagreements([robot]))
    mesh.run(1)
    return took_s, sum(count for kind, count in mesh.sent.items() if kind != "beat")


def vanish(mesh: Simulation, robot: str, broker: str) -> None:
    route = mesh.stations[broker].route(robot)
    if route is not None:
        mesh.stations[broker].router.table.withdraw(route, mesh.stations[broker].now)


def talk(mesh: Simulation, robots: Iterable[tuple[str, str]], seconds: float, every_s: float = 1.0) -> None:
    """Every robot tells its broker something now and then."""
    said = [(broker, wire(robot, broker, "estou")) for robot, broker in robots]
    until_s = mesh.now + seconds
    while mesh.now < until_s - 1e-9:
        for broker, data in said:
            mesh.stations[broker].exchange.links[RADIO].received(data, None)
        mesh.run(min(every_s, until_s - mesh.now))


def show(found: list[Growth]) -> None:
    console = Console()
    if not console.is_terminal:
        console = Console(width=118)
    console.print(
        f"Python {platform.python_version()}; {found[0].robots} robots at each broker, {DELAY_S * 1000:g} ms "
        "from broker to broker; real routing and mesh code, simulated network.\n",
        highlight=False,
    )
    table = Table(
        "N",
        "agree s",
        "msgs",
        "CPU s",
        "appears",
        "roams",
        "vanishes",
        "msg/s",
        "tok/s",
        "CPU %",
        "beat B",
        "kB/s",
        "KiB",
        box=box.SIMPLE_HEAD,
        title="How the mesh grows",
        title_justify="left",
        title_style="bold",
    )
    for column in table.columns:
        column.justify = "right"
    for each in found:
        beats_kb_s = (each.brokers - 1) * each.beat_bytes / BEAT_S / 1000
        table.add_row(
            f"{each.brokers}",
            f"{each.start_s:.2f}",
            f"{each.start_messages:,}",
            f"{each.start_cpu_s:.2f}",
            *(f"{took_s:.2f} s {count}" for took_s, count in each.changes.values()),
            f"{each.steady_messages_s:.1f}",
            f"{each.seldom_tokens_s:.1f}",
            f"{100 * each.steady_cpu:.2f}",
            f"{each.beat_bytes:,}",
            f"{beats_kb_s:.1f}",
            f"{each.memory_kib:,.0f}",
        )
    console.print(table)
    console.print(
        "N: brokers; agree: all start at once and all robots speak: until every broker knows each robot's owner, with\n"
        "the messages and the CPU of all of them together\n"
        "appears, roams, vanishes: one robot of one broker, until all agree, and its messages without beats\n"
        "msg/s, CPU %, kB/s (of beats), memory: of one broker while every robot talks once a second\n"
        "tok/s: tokens that one broker receives in a second while every robot talks every 7 s only\n",
        highlight=False,
    )
    console.print("On paper, beside what was measured:", highlight=False)
    for each in found:
        n = each.brokers
        console.print(
            f"  {n:2} brokers: beats (N-1)/{BEAT_S:g} s = {(n - 1) / BEAT_S:.1f} msg/s (measured "
            f"{each.steady_messages_s:.1f}), of all N(N-1)/{BEAT_S:g} s = {n * (n - 1) / BEAT_S:,.0f};"
            f" appears N-1 = {n - 1} ({each.changes['appears'][1]});"
            f" roams 1 notice + 2(N-1) = {2 * n - 1} ({each.changes['roams'][1]});"
            f" vanishes N-1 = {n - 1} ({each.changes['vanishes'][1]});"
            f" claims N·R = {n * each.robots}",
            highlight=False,
            soft_wrap=True,
        )


@click.command()
@click.option("--quick", is_flag=True, help="Three and four brokers with two robots: whether it works.")
def main(quick: bool) -> None:
    """How long until all brokers agree, how many messages that takes, and what it costs: 5 to 50 brokers."""
    if quick:
        found = [measure(size, 2, 1.0) for size in (3, 4)]
    else:
        with Console(stderr=True).status("") as status:
            found = []
            for size in SIZES:
                status.update(f"{size} brokers")
                found.append(measure(size, ROBOTS, STEADY_S))
    show(found)


if __name__ == "__main__":
    main()

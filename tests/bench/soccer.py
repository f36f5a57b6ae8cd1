"""Print how steadily packets leave: python -m tests.bench.soccer

The link of the broker over a real adapter, and simulated robots at the far end, in one process and event loop.
"""

import asyncio
import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, cast

import click
from rich import box
from rich.console import Console
from rich.table import Table

from psiu_adapters.serial import Serial
from psiu_adapters.udp import Udp
from psiu_broker.adapter import Adapter
from psiu_broker.codecs.soccer import Soccer
from psiu_broker.config import LinkConfiguration, LinkOptions
from psiu_broker.frame import NOBODY, Address, Frame, Way
from psiu_broker.link import Hub
from psiu_broker.paced_link import PacedLink
from psiu_broker.simulator.soccer import SoccerRobot
from psiu_broker.simulator.transports import Port, PtyPort, UdpPort
from tests.bench.figures import machine

TEAMS: Final = (("mirosot", 30.0), ("f180", 30.0), ("guarana", 24.0), ("cendori", 11.0), ("plymouth", 30.0))


@dataclass(frozen=True)
class Steadiness:
    """Deviations of a period from the nominal one in ms: as the link measures them and as a robot hears them."""

    name: str
    rate_hz: float
    packets: int
    left: tuple[float, float]
    heard: tuple[float, float, float]
    skipped: int


class Nobody:
    """A hub that forgets."""

    class bus:  # noqa: N801 - a field of a hub
        raw_listened = False

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *_: None


async def measure(preset: str, rate_hz: float, packets: int, *, udp: bool) -> Steadiness:
    """Drive a team until its first robot has heard so many packets, with new set-points for all on the way."""
    options = Soccer.Options(preset=cast(Any, preset), rate_hz=rate_hz)
    team = SoccerRobot.team(preset)
    heard: list[float] = []
    loop = asyncio.get_running_loop()
    with tempfile.TemporaryDirectory(prefix="psiu-bench-") as folder:
        port: Port
        adapter: Adapter

        def observe(direction: str, data: bytes) -> None:
            heard.append(loop.time())

        if udp:
            port = UdpPort(*team, observer=observe)
        else:
            port = PtyPort(*team, link=Path(folder) / "radio", observer=observe)
        async with port:
            if isinstance(port, UdpPort):
                adapter = Udp(listen="127.0.0.1:0", peers=(port.address,), learn=False)
            else:
                adapter = Serial(device=str(Path(folder) / "radio"), baudrate=options.baud)
            made = LinkConfiguration("time", "bench", adapter, "soccer", options, LinkOptions())
            link = PacedLink(made, lambda: Soccer(options), cast(Hub, Nobody()))
            task = asyncio.create_task(link.run())
            while len(heard) < packets:
                before = len(heard)
                for robot in range(1, options.robots + 1):
                    frame = Frame(NOBODY, Address.numbered(robot), options.subject, options.stop, "soccer")
                    link.offer(frame, None, Way("bench"), loop.time())
                await port.until(lambda before=before: len(heard) > before)  # type: ignore[misc]
            details = link.details()
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task
    # The last packet, which stops the robots when the link is closed, is in no slot.
    periods = [abs(later - earlier - 1 / rate_hz) * 1000 for earlier, later in pairwise(heard[:packets])]
    ordered = sorted(periods)
    return Steadiness(
        f"{preset}, {'UDP' if udp else f'serial {options.baud}'}",
        rate_hz,
        packets,
        (float(details["jitter_p50_ms"]), float(details["jitter_p99_ms"])),
        (ordered[len(ordered) // 2], ordered[len(ordered) * 99 // 100], ordered[-1]),
        int(details["no_room"]) + int(details["missed"]),
    )


def show(found: list[Steadiness]) -> None:
    console = Console()
    if not console.is_terminal:
        console = Console(width=118)
    console.print(", ".join(f"{name} {value}" for name, value in machine().items()) + "\n", highlight=False)
    table = Table(
        "team", "Hz", "packets", "left p50", "left p99", "heard p50", "heard p99", "heard max", "skipped",
        box=box.SIMPLE_HEAD, title="How far periods are from the nominal one, ms",
        title_justify="left", title_style="bold",
    )  # fmt: skip
    for column in table.columns[1:]:
        column.justify = "right"
    for each in found:
        numbers = (f"{value:.2f}" for value in (*each.left, *each.heard))
        table.add_row(each.name, f"{each.rate_hz:g}", f"{each.packets}", *numbers, f"{each.skipped}")
    console.print(table)


@click.command()
@click.option("--quick", is_flag=True, help="A few packets only: whether it works, no figures to quote.")
@click.option("--packets", type=click.IntRange(4), default=600, show_default=True, help="Packets of each team.")
def main(quick: bool, packets: int) -> None:
    """Measure every team on a serial line (a pty), and one over UDP, one after the other."""
    if quick:
        packets = 5
    found = [asyncio.run(measure(preset, rate_hz, packets, udp=False)) for preset, rate_hz in TEAMS]
    found.append(asyncio.run(measure("mirosot", 30.0, packets, udp=True)))
    show(found)


if __name__ == "__main__":
    main()

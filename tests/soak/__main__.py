"""A broker in a process of its own under load and faults, for as long as you like: python -m tests.soak --minutes 10"""

import asyncio
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final

import click

from psiu_broker.bus.client import Client
from psiu_broker.errors import PsiuError
from psiu_broker.messages import Ledger, Status
from psiu_broker.simulator import Simulation
from tests.soak import watched
from tests.soak.figures import SHARP_S, Growth, Rest, Usage, complaints, growths, look, more_at_rest
from tests.soak.lab import Lab
from tests.soak.load import Caller, Trouble

SAMPLE_S: Final = 1.0
LINE_S: Final = 10.0
START_S: Final = 60.0
AT_REST_S: Final = 60.0
"""How long the broker has to have every link open again once nothing is wrong any more."""
WARM_UP: Final = 1 / 3
WARM_UP_MAX_S: Final = 300.0


@click.command()
@click.option("--minutes", type=click.FloatRange(0.05), default=2.0, show_default=True, help="How long the load lasts.")
@click.option("--seed", type=int, default=1, show_default=True, help="Of the faults and of who does what.")
@click.option("--keep", type=click.Path(path_type=Path), help="Write the broker's log there.")
def main(minutes: float, seed: int, keep: Path | None) -> None:
    """Print a line every ten seconds, and in the end what the broker used; 1 if that grows, or the ledger is off."""
    with tempfile.TemporaryDirectory(prefix="psiu-soak-") as folder:
        sys.exit(asyncio.run(_Soak(Path(folder), minutes * 60, seed, keep).run()))


class _Soak:
    def __init__(self, folder: Path, load_s: float, seed: int, log: Path | None) -> None:
        bus, *udp = _free_ports()
        self._lab = Lab(folder, bus, iter(udp), seed)
        self._endpoint = f"tcp/127.0.0.1:{bus}"
        self._file = folder / "soak.toml"
        self._file.write_text(self._lab.text)
        self._in_use = folder / "in-use"
        self._log = log or folder / "broker.log"
        self._load_s = load_s
        self._seed = seed
        self._usages: list[Usage] = []
        self._ledger: Ledger
        self._unbalanced = 0
        self._told = 0

    async def run(self) -> int:
        print(f"{self._lab.robots} robots on {self._lab.links} links, {self._load_s / 60:g} min, seed {self._seed}")
        async with Simulation(*self._lab.ports):
            with _broker(self._file, self._in_use, self._log) as self._process:
                await self._look_up()
                with Client([self._endpoint]) as client, client.listening(f"{client.keys.prefix}/**", self._hear):
                    return await self._measure()

    async def _measure(self) -> int:
        before = await self._rest()
        trouble, caller = Trouble(self._lab, self._seed), Caller(self._endpoint, self._lab, self._seed)
        trouble.begin()
        caller.start()
        began = line_at = time.monotonic()
        print(f"{'s':>5} {'frames':>8} {'delivered':>9} {'dropped':>8} {'waiting':>7} {'told':>7} {'calls':>6}"
              f" {'RSS MiB':>8} {'in use':>7} {'fd':>4} {'threads':>7} {'tasks':>5}  ledger")  # fmt: skip
        while (passed_s := time.monotonic() - began) < self._load_s:
            self._usages.append(look(self._process.pid, self._in_use, passed_s))
            if time.monotonic() >= line_at:
                line_at += LINE_S
                await self._line(caller, passed_s)
            await asyncio.sleep(SAMPLE_S)
        await self._line(caller, passed_s)
        await trouble.end()
        await asyncio.to_thread(caller.end)
        after = await self._rest(before)
        await self._look_up()
        warm_up_s = min(self._load_s * WARM_UP, WARM_UP_MAX_S)
        grown = growths([each for each in self._usages if each.at_s >= warm_up_s])
        return self._tell(before, after, grown, trouble, caller)

    def _tell(self, before: Rest, after: Rest, grown: tuple[Growth, Growth], trouble: Trouble, caller: Caller) -> int:
        total = self._ledger.total
        dropped = sum(total.dropped.values())
        print(f"frames       {total.arrived} = {total.delivered} delivered + {total.answered} answered"
              f" + {dropped} dropped + {total.waiting} waiting")  # fmt: skip
        print(f"dropped      {_counts(total.dropped)}")
        print(f"ledger       {'balanced at every look' if not self._unbalanced else f'OFF {self._unbalanced} times'}")
        print(f"calls        {_counts(caller.outcomes)}")
        print(f"faults       {_counts(trouble.done)}, and on every line 2 % lost, 2 % damaged, 1 % doubled")
        for each in grown:
            print(f"{each.what:<12} {each.trend.mib_per_h:+.2f} MiB/h in the last {each.trend.measured_s:.0f} s:"
                  f" {each.grown_mib:+.2f} MiB, {each.most_mib:.2f} MiB is the most")  # fmt: skip
        in_use, _ = grown
        more = "" if in_use.trend.measured_s >= SHARP_S else "; with MINUTES=10 also a smaller one"
        print(f"leaks        one of {in_use.seen_kb_per_s:.1f} kB/s would be seen{more}")
        for what in Rest._fields:
            print(f"{what:<12} {getattr(before, what)} before, {getattr(after, what)} after")
        found = complaints(before, after, grown, self._unbalanced, total.arrived)
        for complaint in found:
            print(f"NOT GOOD: {complaint}")
        if not found:
            print("all good")
        return 1 if found else 0

    async def _line(self, caller: Caller, passed_s: float) -> None:
        status = await self._look_up()
        total, usage = self._ledger.total, self._usages[-1]
        print(f"{passed_s:5.0f} {total.arrived:8} {total.delivered:9} {sum(total.dropped.values()):8}"
              f" {total.waiting:7} {self._told:7} {caller.outcomes.total():6}"
              f" {usage.rss_mib:8.1f} {usage.in_use_mib:7.2f} {usage.descriptors:4} {usage.threads:7} {status.tasks:5}"
              f"  {'balances' if self._ledger.balances else 'OFF'}", flush=True)  # fmt: skip

    async def _look_up(self) -> Status:
        """What the broker says of itself; by a session of its own, because a machine that is busy may end another.

        Raises:
            click.ClickException: it does not answer within `START_S`.
        """
        ledger, status = await asyncio.to_thread(self._ask)
        self._ledger = Ledger.model_validate(ledger)
        self._unbalanced += not self._ledger.balances
        return Status.model_validate(status)

    def _ask(self) -> tuple[object, object]:
        until = time.monotonic() + START_S
        while time.monotonic() < until and self._process.poll() is None:
            with suppress(PsiuError), Client([self._endpoint]) as client:
                ledger, status = client.ask("ledger"), client.ask("status")
                if ledger and status:
                    return ledger["base"], status["base"]
            time.sleep(0.1)
        raise click.ClickException(f"the broker does not answer:\n{self._log.read_text()}")

    async def _rest(self, before: Rest | None = None) -> Rest:
        """What the broker uses once every link is open; waits, so long as that is more than `before`.

        Raises:
            click.ClickException: one does not open within `AT_REST_S`.
        """
        until = time.monotonic() + AT_REST_S
        while (status := await self._look_up()).links_open < status.links:
            if time.monotonic() > until:
                raise click.ClickException(f"{status.links_open} of {status.links} links are open, though all could be")
            await asyncio.sleep(0.2)
        while True:
            await asyncio.sleep(5.0)
            status = await self._look_up()
            usage = look(self._process.pid, self._in_use, 0.0)
            rest = Rest(usage.descriptors, usage.threads, status.tasks)
            if before is None or not more_at_rest(before, rest) or time.monotonic() > until:
                return rest

    def _hear(self, payload: bytes) -> None:
        self._told += 1


@contextmanager
def _broker(file: Path, in_use: Path, log: Path) -> Iterator["subprocess.Popen[bytes]"]:
    command: list[Any] = [sys.executable, watched.__file__, in_use, "run", "--config", file]
    with log.open("wb") as output:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            env={**os.environ, "TMPDIR": str(file.parent), **watched.EXACT},
        )
    try:
        yield process
    finally:
        process.terminate()
        with suppress(subprocess.TimeoutExpired):
            process.wait(10)
        process.kill()
        process.wait()


def _free_ports() -> list[int]:
    """One for Zenoh, and some for UDP."""
    probes = [socket.socket(socket.AF_INET, kind) for kind in (socket.SOCK_STREAM, *[socket.SOCK_DGRAM] * 3)]
    for probe in probes:
        probe.bind(("127.0.0.1", 0))
    ports = [int(probe.getsockname()[1]) for probe in probes]
    for probe in probes:
        probe.close()
    return ports


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{what} {count}" for what, count in sorted(counts.items(), key=lambda item: -item[1])) or "none"


if __name__ == "__main__":
    main()

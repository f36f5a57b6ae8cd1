"""Print how long robots go on after who moved them has ended: python -m tests.bench.failsafe

Brokers and programs are processes of their own; the robot is a UDP socket here. Counted is from the signal, or from the
robot's last word, to the stop frame in the robot's socket.
"""

import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Final, NamedTuple

import click
from rich.console import Console

from psiu_broker.broker import TICK_S
from psiu_broker.bus.session import LEASE_S
from tests.bench.figures import machine
from tests.system.failsafe_lab import Lab, lab

MACHINE_S: Final = 0.25
"""What a busy machine may take beside what has to be waited for."""
SILENT_S: Final = 1.0
STOP: Final = '[robots.MNERIM.failsafe]\ncommand = "pare"\n'
SILENT: Final = f'{STOP}on = ["link_silent"]\nsilent_s = {SILENT_S:g}\n'


def _program_killed(here: Lab) -> float:
    return _after(here, here.program("client"), signal.SIGKILL)


def _program_hangs(here: Lab) -> float:
    return _after(here, here.program("client"), signal.SIGSTOP)


def _program_cut_off(here: Lab) -> float:
    port, wire = here.wire()
    here.program("client", wire=port)
    return _after(here, wire, signal.SIGSTOP)


def _far_broker_killed(here: Lab) -> float:
    here.program("client")
    return _after(here, here.hill, signal.SIGKILL)


def _far_broker_hangs(here: Lab) -> float:
    here.program("client")
    return _after(here, here.hill, signal.SIGSTOP)


def _robot_silent(here: Lab) -> float:
    here.program("put", "nameless")
    here.answers = False
    seconds = here.until("pare") - here.spoke_at
    here.answers = True
    here.until("pare")  # again, since it was silent: now it answers
    return seconds


def _broker_ends(here: Lab) -> float:
    here.program("client")
    return _after(here, here.broker, signal.SIGTERM)


def _after(here: Lab, process: "subprocess.Popen[str]", number: signal.Signals) -> float:
    here.listen(0.2)
    begun = time.monotonic()
    process.send_signal(number)
    return here.until("pare") - begun


class Case(NamedTuple):
    what: str
    measure: Callable[[Lab], float]
    waits_s: float
    """What has to be waited for."""
    more: str = STOP
    hill: bool = False
    again: bool = False
    """The same brokers serve for many rounds."""


CASES: Final = (
    Case("the program is killed", _program_killed, 0.0, again=True),
    Case("the program hangs", _program_hangs, LEASE_S, again=True),
    Case("the program is cut off", _program_cut_off, LEASE_S, again=True),
    Case("the program's broker is killed", _far_broker_killed, 0.0, hill=True),
    Case("the program's broker hangs", _far_broker_hangs, LEASE_S, hill=True),
    Case(f"the robot is silent, silent_s = {SILENT_S:g}", _robot_silent, SILENT_S + TICK_S, SILENT, again=True),
    Case("the broker is ended (SIGTERM)", _broker_ends, 0.0),
)


def _times(case: Case, rounds: int) -> list[float]:
    times: list[float] = []
    with lab(case.more, hill=case.hill) if case.again else nullcontext() as kept:
        for _ in range(rounds):
            one: AbstractContextManager[Lab] = lab(case.more, hill=case.hill) if kept is None else nullcontext(kept)
            with one as here:
                times.append(case.measure(here))
                here.leave()
    return sorted(times)


@click.command()
@click.option("--rounds", type=click.IntRange(1), default=50, help="How often each.  [default: 50]")
def main(rounds: int) -> None:
    """Tell the shortest, median and longest time, in ms, of so many rounds, and how long it may take at most."""
    here = machine()
    print(f"{here['cpu']}, {here['cores']} cores, {here['kernel']}, Python {here['python']}; ms to the stop frame")
    print(f"{'':36}{'rounds':>8}{'min':>8}{'median':>8}{'worst':>8}{'bound':>8}")
    for case in CASES:
        with Console(stderr=True).status(case.what):
            times = _times(case, rounds)
        bound_s = case.waits_s + MACHINE_S
        row = "".join(f"{each * 1000:>8.0f}" for each in (times[0], times[rounds // 2], times[-1], bound_s))
        print(f"{case.what:36}{rounds:>8}{row}{'  OVER' if times[-1] > bound_s else ''}", flush=True)
    print(
        f"bound: the lease of {LEASE_S * 1000:.0f} of whoever hangs, or silent_s and a tick of {TICK_S * 1000:.0f};"
        f" and {MACHINE_S * 1000:.0f} for the machine"
    )
    sys.stdout.flush()


if __name__ == "__main__":
    main()

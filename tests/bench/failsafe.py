"""Print how long robots go on after who moved them has ended: python -m tests.bench.failsafe

A broker and a program are processes of their own; the robot is a UDP socket here. Counted is from the signal to the
stop frame in the robot's socket.
"""

import signal
import sys
import time
from collections.abc import Callable
from typing import Final

import click
from rich.console import Console

from tests.bench.figures import machine
from tests.system.failsafe_lab import Lab, lab

STOP: Final = '[robots.MNERIM.failsafe]\ncommand = "pare"\n'


def _killed(here: Lab) -> float:
    return _after(here, lambda: here.program("call").send_signal, signal.SIGKILL)


def _hangs(here: Lab) -> float:
    return _after(here, lambda: here.program("call").send_signal, signal.SIGSTOP)


def _broker_ends(here: Lab) -> float:
    here.program("call")
    return _after(here, lambda: here.broker.send_signal, signal.SIGTERM)


def _after(here: Lab, ready: Callable[[], Callable[[int], None]], number: signal.Signals) -> float:
    send = ready()
    here.listen(0.2)
    begun = time.monotonic()
    send(number)
    return here.until("pare") - begun


CASES: Final[tuple[tuple[str, Callable[[Lab], float], bool], ...]] = (
    ("the program is killed (SIGKILL)", _killed, True),
    ("the program hangs (SIGSTOP)", _hangs, False),
    ("the broker is ended (SIGTERM)", _broker_ends, False),
)
"""What happens, how it is done, and whether the same broker serves for many rounds."""


@click.command()
@click.option("--rounds", type=click.IntRange(1), default=20, help="How often each.  [default: 20]")
def main(rounds: int) -> None:
    """Tell the median and the longest time, in ms, of so many rounds."""
    here = machine()
    print(f"{here['cpu']}, {here['cores']} cores, {here['kernel']}, Python {here['python']}; ms to the stop frame")
    print(f"{'':34}{'rounds':>8}{'median':>8}{'longest':>9}")
    for name, measure, many in CASES:
        times: list[float] = []
        with Console(stderr=True).status(name):
            if many:
                with lab(STOP) as one:
                    times = [measure(one) for _ in range(rounds)]
            else:
                for _ in range(rounds):
                    with lab(STOP) as each:
                        times.append(measure(each))
        times.sort()
        print(f"{name:34}{rounds:>8}{times[rounds // 2] * 1000:>8.0f}{times[-1] * 1000:>9.0f}")
    sys.stdout.flush()


if __name__ == "__main__":
    main()

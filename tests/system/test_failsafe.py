"""The failsafe, with real processes: what MNERIM is told when those who moved it end, in whatever way."""

import signal
import time

import pytest

from tests.system.failsafe_lab import lab

FAILSAFE = '[robots.MNERIM.failsafe]\ncommand = "pare"\n'
SOON_S = 2.0
"""Far more than it takes; `python -m tests.bench.failsafe` tells how long."""


@pytest.mark.parametrize("how", ["call", "put"])
def test_a_program_that_is_killed_is_missed_at_once(how: str) -> None:
    with lab(FAILSAFE) as here:
        program = here.program(how)
        begun = time.monotonic()
        program.send_signal(signal.SIGKILL)
        assert here.until("pare") - begun < SOON_S
        assert here.listen(1.5) == [], "a stop that was answered is not repeated"


@pytest.mark.parametrize(("how", "within_s"), [("call", 15), ("client", 6)], ids=["Zenoh's own", "our client's"])
def test_a_program_that_hangs_is_missed_within_its_lease(how: str, within_s: float) -> None:
    with lab(FAILSAFE) as here:
        program = here.program(how)
        program.send_signal(signal.SIGSTOP)
        here.until("pare", within_s)


def test_a_robot_that_does_not_answer_its_stop_is_told_only_so_often() -> None:
    with lab(FAILSAFE) as here:
        program = here.program("call")
        here.answers = False
        program.send_signal(signal.SIGKILL)
        here.until("pare")
        again = here.listen(4.0)
        assert set(again) == {"pare"}
        assert len(again) <= 2


def test_a_program_that_goes_in_good_order_leaves_its_robot_moving() -> None:
    with lab(FAILSAFE) as here:
        program = here.program("call", "done")
        program.communicate()
        assert here.listen(1.5) == []


def test_nothing_is_told_where_the_failsafe_is_off() -> None:
    with lab("") as here:
        program = here.program("call")
        program.send_signal(signal.SIGKILL)
        here.broker.send_signal(signal.SIGTERM)
        assert here.listen(1.5) == []


def test_a_broker_that_is_ended_stops_what_moves_first() -> None:
    with lab(FAILSAFE) as here:
        here.program("call")
        begun = time.monotonic()
        here.broker.send_signal(signal.SIGTERM)
        assert here.until("pare") - begun < SOON_S
        assert here.listen(0.5) == []
        assert here.broker.wait(10) == 0


def test_a_broker_that_is_ended_tells_nothing_to_a_robot_that_nobody_moved() -> None:
    with lab(FAILSAFE) as here:
        here.until("qualseunome")
        here.broker.send_signal(signal.SIGTERM)
        assert here.listen(1.0) == []


def test_a_robot_that_falls_silent_is_stopped() -> None:
    with lab(FAILSAFE + 'on = ["link_silent"]\nsilent_s = 0.5\n') as here:
        here.program("put", "nameless")
        here.until("pare")
        assert here.listen(1.5) == []

"""The failsafe, with real processes: what MNERIM is told when those who moved it end, in whatever way."""

import signal
import time

import pytest

from psiu_broker.bus.session import LEASE_S
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


def test_a_program_that_hangs_is_missed_within_its_lease() -> None:
    with lab(FAILSAFE) as here:
        program = here.program("client")
        program.send_signal(signal.SIGSTOP)
        here.until("pare", LEASE_S + SOON_S)


def test_a_program_that_is_cut_off_is_missed_within_its_lease() -> None:
    with lab(FAILSAFE) as here:
        port, wire = here.wire()
        here.program("client", wire=port)
        wire.send_signal(signal.SIGSTOP)
        here.until("pare", LEASE_S + SOON_S)


def test_the_broker_of_the_robot_misses_a_program_of_another_broker() -> None:
    with lab(FAILSAFE, hill=True) as here:
        program = here.program("client")
        begun = time.monotonic()
        program.send_signal(signal.SIGKILL)
        assert here.until("pare") - begun < SOON_S


def test_a_program_whose_broker_is_killed_is_missed_by_the_broker_of_the_robot() -> None:
    with lab(FAILSAFE, hill=True) as here:
        here.program("client")
        begun = time.monotonic()
        here.hill.send_signal(signal.SIGKILL)
        assert here.until("pare") - begun < SOON_S


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

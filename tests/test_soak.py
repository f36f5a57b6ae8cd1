"""`make soak` in little: whether it works, and whether it would see what it looks for."""

import os
import random
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from soak.figures import IN_USE, MIB, RSS, Growth, Rest, Trend, Usage, complaints, growths
from soak.watched import EXACT

ROOT = Path(__file__).parent.parent
REST = Rest(descriptors=161, threads=25, tasks=35)


def used(mib: Callable[[float], float], seconds: int) -> list[Usage]:
    """A look each second, at memory that is `mib` of the time and what frames under way take for a moment."""
    luck = random.Random(1)
    return [
        Usage(at_s, 72.0 + mib(at_s), 88.0 + mib(at_s) + luck.choice((0.0, 0.1, 0.5)), 161, 25)
        for at_s in map(float, range(seconds))
    ]


def grown(mib: float, seconds: float = 3600.0) -> Growth:
    return Growth("in use", Trend(mib * 3600 / seconds, seconds), IN_USE)


@pytest.mark.timeout(240)
def test_fifty_robots_and_their_faults_leave_the_ledger_balanced() -> None:
    command = [sys.executable, "-m", "tests.soak", "--minutes", "0.1"]
    soak = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    said = soak.stdout + soak.stderr
    assert "50 robots on 30 links" in said
    assert "balanced at every look" in said, said
    for what in ("frames", "dropped", "calls", "in use", "resident", "descriptors", "threads", "tasks"):
        assert f"\n{what} " in said, said


@pytest.mark.skipif(sys.platform != "linux", reason="the C library's own figures")
def test_what_is_in_use_is_what_was_taken_and_not_given_back() -> None:
    program = """
import watched
before = watched.in_use()
kept = [bytes(n) for n in range(2000)]
taken = watched.in_use()
kept.clear()
print(taken - before, watched.in_use() - before)
"""
    said = subprocess.check_output(
        [sys.executable, "-c", program], cwd=ROOT / "tests/soak", env={**os.environ, **EXACT}
    )
    taken, left = map(int, said.split())
    assert 2.0e6 < taken < 2.2e6
    assert left < 1e5


def test_a_leak_of_a_kilobyte_a_second_is_seen_within_ten_minutes() -> None:
    in_use, _ = growths(used(lambda at_s: 1000 * at_s / MIB, 400))
    assert in_use.seen_kb_per_s < 1.0
    (complaint,) = complaints(REST, REST, [in_use], 0, 1000)
    assert complaint == "the memory in use grew by 0.38 MiB, and 0.37 MiB is the most"


def test_what_comes_and_goes_is_no_leak() -> None:
    flat = growths(used(lambda at_s: 0.0, 400))
    assert complaints(REST, REST, flat, 0, 1000) == []
    lost = growths(used(lambda at_s: -0.7 * (60 < at_s < 200), 400))
    assert complaints(REST, REST, lost, 0, 1000) == [], "a session that was lost, and came again"
    late = growths(used(lambda at_s: 3.0 * (350 < at_s < 360), 400))
    assert complaints(REST, REST, late, 0, 1000) == []


def test_a_short_run_says_that_it_sees_less() -> None:
    in_use, _ = growths(used(lambda at_s: 1000 * at_s / MIB, 80))
    assert complaints(REST, REST, [in_use], 0, 1000) == []
    assert in_use.seen_kb_per_s > 10.0
    assert growths([])[0].seen_kb_per_s == float("inf")


def test_memory_that_is_free_but_not_given_back_is_bounded_too() -> None:
    resident = Growth("resident", Trend(180.0, 400.0), RSS)
    (complaint,) = complaints(REST, REST, [grown(0.0), resident], 0, 1000)
    assert complaint == "the memory resident grew by 20.00 MiB, and 12.44 MiB is the most"


@pytest.mark.parametrize(
    ("after", "unbalanced", "frames", "said"),
    [
        (REST, 1, 1000, "the ledger did not balance"),
        (REST, 0, 0, "no frame arrived"),
        (REST._replace(descriptors=165), 0, 1000, "descriptors before: 161, after: 165"),
        (REST._replace(threads=30), 0, 1000, "threads before: 25, after: 30"),
        (REST._replace(tasks=40), 0, 1000, "tasks before: 35, after: 40"),
    ],
)
def test_what_is_wrong_is_named(after: Rest, unbalanced: int, frames: int, said: str) -> None:
    (complaint,) = complaints(REST, after, [grown(0.0)], unbalanced, frames)
    assert complaint.startswith(said)

"""`make soak` in little: whether it works, and whether it would see what it looks for."""

import subprocess
import sys
from pathlib import Path

import pytest
from soak.figures import Rest, Trend, Usage, complaints

ROOT = Path(__file__).parent.parent
REST = Rest(descriptors=161, threads=25, tasks=35)
FLAT = Trend(0.0, 600.0)


def used(*mib: float) -> list[Usage]:
    """One look a minute."""
    return [Usage(60.0 * minute, each, 161, 25) for minute, each in enumerate(mib)]


@pytest.mark.timeout(240)
def test_fifty_robots_and_their_faults_leave_the_ledger_balanced() -> None:
    command = [sys.executable, "-m", "tests.soak", "--minutes", "0.1"]
    soak = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    said = soak.stdout + soak.stderr
    assert "50 robots on 30 links" in said
    assert "balanced at every look" in said, said
    for what in ("frames", "dropped", "calls", "memory", "descriptors", "threads", "tasks"):
        assert f"\n{what} " in said, said


def test_the_trend_is_the_line_that_fits_best() -> None:
    trend = Trend.of(used(60.0, 60.1, 60.2, 60.3))
    assert trend.mib_per_h == pytest.approx(6.0)
    assert trend.measured_s == 180.0
    assert Trend.of(used(60.0)) == (0.0, 0.0)


def test_what_is_as_it_was_is_no_complaint() -> None:
    assert complaints(REST, REST, FLAT, 0, 1000) == []
    assert complaints(REST, REST, Trend(3.0, 3600.0), 0, 1000) == []


@pytest.mark.parametrize(
    ("after", "trend", "unbalanced", "frames", "said"),
    [
        (REST, FLAT, 1, 1000, "the ledger did not balance"),
        (REST, FLAT, 0, 0, "no frame arrived"),
        (REST, Trend(30.0, 3600.0), 0, 1000, "the memory grew by 30.0 MiB, and 6.0 MiB is the most"),
        (REST._replace(descriptors=165), FLAT, 0, 1000, "descriptors before: 161, after: 165"),
        (REST._replace(threads=30), FLAT, 0, 1000, "threads before: 25, after: 30"),
        (REST._replace(tasks=40), FLAT, 0, 1000, "tasks before: 35, after: 40"),
    ],
)
def test_what_grows_is_named(after: Rest, trend: Trend, unbalanced: int, frames: int, said: str) -> None:
    (complaint,) = complaints(REST, after, trend, unbalanced, frames)
    assert complaint.startswith(said)

"""`make bench` in little: whether it works, not how fast."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.mark.timeout(180)
def test_the_bench_prints_all_figures_and_nothing_is_lost() -> None:
    command = [sys.executable, "-m", "tests.bench", "--quick"]
    bench = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert bench.returncode == 0, bench.stdout + bench.stderr
    for line in (
        "What a frame costs",
        "UDP → UDP  bare forwarder",
        "UDP → UDP  psiu-broker",
        "pty → pty  psiu-broker",
        "a client (told 100%)",
        "10 robots known",
        "Latency at 1 kHz",
    ):
        assert line in bench.stdout


def test_the_growth_of_the_mesh_is_printed() -> None:
    command = [sys.executable, "-m", "tests.bench.mesh_scale", "--quick"]
    bench = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert bench.returncode == 0, bench.stdout + bench.stderr
    assert "How the mesh grows" in bench.stdout
    assert "4 brokers: beats (N-1)/0.4 s = 7.5 msg/s" in bench.stdout


def test_what_a_byte_costs_each_codec_is_printed() -> None:
    command = [sys.executable, "-m", "tests.bench.cost_per_byte", "--quick"]
    bench = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert bench.returncode == 0, bench.stdout + bench.stderr
    for codec in ("psiu-ascii,", "psiu-ascii 0.5,", "psiu-hexa,", "mitya,", "soccer,", "firmata,", "amarino,"):
        assert codec in bench.stdout

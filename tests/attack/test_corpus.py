"""What `make fuzz` found worth keeping, told again to everything that hears strangers."""

import subprocess
import sys
from pathlib import Path

import pytest
from attack.corpus import kept
from attack.targets import TARGETS
from hypothesis import given, settings
from hypothesis import strategies as st

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("target", TARGETS)
def test_nothing_that_was_kept_does_what_it_must_not(target: str) -> None:
    inputs = kept(target)
    assert inputs, "there is no corpus for it; python -m tests.attack --keep makes one"
    for data in inputs:
        TARGETS[target](data)


@pytest.mark.parametrize("target", TARGETS)
def test_nor_does_what_is_like_it(target: str) -> None:
    inputs = kept(target)

    @given(
        one=st.sampled_from(inputs),
        other=st.sampled_from(inputs),
        cut=st.integers(0, 300),
        spoilt=st.lists(st.tuples(st.integers(0, 300), st.integers(0, 255)), max_size=4),
    )
    @settings(max_examples=30, deadline=None)
    def told(one: bytes, other: bytes, cut: int, spoilt: list[tuple[int, int]]) -> None:
        data = bytearray(one[:cut] + other[cut:])
        for place, byte in spoilt:
            data[place : place + 1] = bytes((byte,))
        TARGETS[target](bytes(data))

    told()


def test_the_fuzzer_attacks_a_target_for_as_long_as_it_is_told() -> None:
    pytest.importorskip("atheris")
    command = [sys.executable, "-m", "tests.attack", "--seconds", "1", "trunk"]
    fuzz = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert fuzz.returncode == 0, fuzz.stdout + fuzz.stderr
    assert "places reached" in fuzz.stdout

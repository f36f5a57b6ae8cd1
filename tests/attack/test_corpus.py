"""What `make fuzz` found worth keeping, told again to everything that hears strangers."""

import shlex
import subprocess
import sys
import time
from pathlib import Path

import pytest
from attack import __main__ as runner
from attack import corpus
from attack.corpus import kept
from attack.targets import TARGETS, tell
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from psiu_broker.codecs.checksums import byte_sum

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


def test_of_many_inputs_the_shortest_are_kept_that_reach_something_new(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(corpus, "FOLDER", tmp_path)

    def tell(data: bytes) -> None:
        for byte in data:
            byte_sum(bytes((byte,)))

    inputs = [b"", b"\1", b"\2", b"\1\1", b"\1\1\1", b"\1\1\1\1", b"\1\1\1\1\1"]
    assert corpus.keep("x", inputs, tell) == 4
    assert kept("x") == [b"\1", b"\1\1", b"\1\1\1", b"\1\1\1\1\1"]


def test_what_broke_a_target_is_printed_whole_with_what_tells_it_again(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    broke = bytes(range(256)) * 8

    def fuzz(name: str, *arguments: Path | str) -> subprocess.CompletedProcess[str]:
        prefix = next(each for each in map(str, arguments) if each.startswith("-artifact_prefix="))
        Path(prefix.partition("=")[2], "crash-0123").write_bytes(broke)
        return subprocess.CompletedProcess([], 77, "", "ValueError: no message\n")

    monkeypatch.setattr(runner, "_fuzz", fuzz)
    assert not runner._attack("trunk", 1, keeping=False)
    printed = capsys.readouterr().out
    assert "ValueError: no message" in printed
    command = next(shlex.split(line) for line in printed.splitlines() if "python -m tests.attack" in line)
    assert bytes.fromhex(command[command.index("--input") + 1]) == broke
    again = subprocess.run([sys.executable, *command[1:]], cwd=ROOT, capture_output=True, text=True, check=False)
    assert again.returncode == 0, again.stdout + again.stderr


def test_a_fuzzer_that_was_ended_is_no_finding_of_an_input_but_a_failure(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ended = subprocess.CompletedProcess([], 72, "", "run interrupted\n")
    monkeypatch.setattr(runner, "_fuzz", lambda *_: ended)
    assert not runner._attack("trunk", 1, keeping=False)
    assert "trunk: no input did it; libFuzzer ended by itself or was ended, with 72" in capsys.readouterr().out


def test_an_input_told_again_fails_as_it_did(monkeypatch: pytest.MonkeyPatch) -> None:
    heard: list[bytes] = []
    monkeypatch.setitem(TARGETS, "trunk", heard.append)
    assert CliRunner().invoke(runner.main, ["--input", "00ff", "trunk"]).exit_code == 0
    assert heard == [b"\x00\xff"]
    monkeypatch.setitem(TARGETS, "trunk", lambda _: 1 / 0)
    assert isinstance(CliRunner().invoke(runner.main, ["--input", "00", "trunk"]).exception, ZeroDivisionError)


def test_an_input_is_too_slow_by_its_own_time_and_not_by_that_of_a_busy_machine(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def endless(_: bytes) -> None:
        while True:
            pass

    monkeypatch.setitem(TARGETS, "trunk", endless)
    with pytest.raises(TimeoutError, match="of CPU time"):
        tell("trunk", b"", 0.05)
    monkeypatch.setitem(TARGETS, "trunk", lambda _: time.sleep(0.2))
    tell("trunk", b"", 0.05)


def test_the_fuzzer_attacks_a_target_for_as_long_as_it_is_told() -> None:
    pytest.importorskip("atheris")
    command = [sys.executable, "-m", "tests.attack", "--seconds", "1", "trunk"]
    fuzz = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert fuzz.returncode == 0, fuzz.stdout + fuzz.stderr
    assert "places reached" in fuzz.stdout

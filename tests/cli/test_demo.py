"""The demo is a test as well: it must end well, and fail aloud where something is not as it should be."""

import logging
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from click.testing import Result

from psiu_broker.cli import demo
from psiu_broker.cli.simulated import SIMULATED
from psiu_broker.simulator import AsciiRobot, HexaRobot, MityaBody

Run = Callable[..., Result]


def test_the_demo_shows_the_main_job_within_its_time_and_ends_well(start: Callable[..., Any]) -> None:
    begun = time.monotonic()
    shown = start("psiu-broker", "demo")
    assert shown.ended() == 0, shown.err
    assert time.monotonic() - begun < 20
    assert shown.err == []
    text = "\n".join(shown.out)
    for each in (
        "base → MNERIM  parafrente 100  @self",
        "MNERIM → base  parafrente sucesso  radio",
        "BETA → MNERIM  giradireita 90  wifi",
        "MNERIM → BETA  giradireita sucesso  radio",
        "BETA → BRACO  garra 45  wifi",
        "BRACO → BETA  garra sucesso  @self",
        "psiu call MITYA D -100          MITYA: sent; this robot does not answer",
        "psiu call GOLEIRO rodas 15 -31  GOLEIRO: sent; this robot does not answer",
        "psiu call UNO led 1             UNO: sucesso",
        "psiu call LAMPADA brilho 200    LAMPADA: 200",
        "The books of base balance",
        "All as it should be",
    ):
        assert each in text
    assert "\x1b" not in text
    assert all(f'protocol = "{protocol}"' in demo.CONFIGURATION for protocol in SIMULATED)


@pytest.fixture
def log() -> Iterator[None]:
    """The log as it was before the demo took it."""
    root = logging.getLogger()
    before, level = root.handlers[:], root.level
    yield
    root.handlers[:] = before
    root.setLevel(level)


class Lame(AsciiRobot):
    """Cannot move."""

    def _move(self, command: str, amount: int, now: float) -> Any:
        return 0.0, ("falha",)


class Broken(MityaBody):
    """Its motors do not run."""

    def _do(self, word: str, value: int) -> bool:
        return word == "drive" or super()._do(word, value)


class Deaf(HexaRobot):
    """Says nothing."""

    def receive(self, data: bytes, now: float) -> Any:
        return []


@pytest.mark.usefixtures("log")
@pytest.mark.parametrize(
    ("name", "robot", "said"),
    [
        ("AsciiRobot", Lame, "MNERIM answered falha"),
        ("HexaRobot", Deaf, "BRACO was not found"),
        ("MityaBody", Broken, "MITYA was told D and did not do it"),
    ],
)
def test_what_does_not_happen_fails_with_one_clear_line(
    daemon: Run, monkeypatch: pytest.MonkeyPatch, name: str, robot: type, said: str
) -> None:
    monkeypatch.setattr(demo, name, robot)
    impatient = demo.CONFIGURATION.replace("topology", "timeout_s = 0.1\ntopology")
    monkeypatch.setattr(demo, "CONFIGURATION", impatient)
    failed = daemon("demo")
    assert failed.exit_code == 1
    assert failed.stderr.startswith(f"psiu-broker: the demo failed: {said}")
    assert len(failed.stderr.splitlines()) == 1
    assert "All as it should be" not in failed.output

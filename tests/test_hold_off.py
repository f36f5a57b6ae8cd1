"""The pause between two lives of a broker whose session is a router."""

import asyncio
import os
from pathlib import Path

import pytest

from psiu_broker import hold_off
from psiu_broker.hold_off import HOLD_OFF_S, LastAlive


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [1000.0]
    monkeypatch.setattr(hold_off.time, "clock_gettime", lambda _: now[0])
    return now


def test_a_broker_that_was_never_there_opens_at_once(tmp_path: Path) -> None:
    assert LastAlive("base", tmp_path).rest_s() == 0


def test_a_broker_that_was_there_a_moment_ago_waits_for_the_rest_of_two_seconds(
    tmp_path: Path, clock: list[float]
) -> None:
    LastAlive("base", tmp_path).note()
    clock[0] += 0.5
    assert LastAlive("base", tmp_path).rest_s() == pytest.approx(HOLD_OFF_S - 0.5)
    clock[0] += 1.5
    assert LastAlive("base", tmp_path).rest_s() == 0


def test_another_broker_on_the_machine_is_another_matter(tmp_path: Path, clock: list[float]) -> None:
    LastAlive("base/1", tmp_path).note()
    assert LastAlive("base", tmp_path).rest_s() == 0


def test_after_the_machine_has_started_anew_nobody_waits(tmp_path: Path, clock: list[float]) -> None:
    LastAlive("base", tmp_path).note()
    clock[0] = 3.0
    assert LastAlive("base", tmp_path).rest_s() == 0


@pytest.mark.parametrize("text", [b"", b"soon", b"\xff\xfe", b"nan"])
def test_a_note_that_cannot_be_read_is_none(tmp_path: Path, clock: list[float], text: bytes) -> None:
    alive = LastAlive("base", tmp_path)
    alive.note()
    [file] = tmp_path.iterdir()
    file.write_bytes(text)
    assert alive.rest_s() == 0


def test_a_note_goes_through_no_link_that_somebody_laid(tmp_path: Path) -> None:
    alive = LastAlive("base", tmp_path)
    alive.note()
    [file] = tmp_path.iterdir()
    file.unlink()
    precious = tmp_path / "precious"
    precious.write_text("mine")
    file.symlink_to(precious)
    alive.note()
    assert precious.read_text() == "mine"


def test_a_place_that_cannot_be_written_is_in_nobodys_way(tmp_path: Path) -> None:
    alive = LastAlive("base", tmp_path / "absent")
    alive.note()
    assert alive.rest_s() == 0


async def test_it_waits_only_if_it_must(tmp_path: Path, clock: list[float], monkeypatch: pytest.MonkeyPatch) -> None:
    waited: list[float] = []

    async def sleep(seconds: float) -> None:
        waited.append(seconds)

    monkeypatch.setattr(asyncio, "sleep", sleep)
    alive = LastAlive("base", tmp_path)
    assert await alive.hold_off() == 0
    alive.note()
    assert await alive.hold_off() == HOLD_OFF_S
    assert waited == [HOLD_OFF_S]


def test_the_file_is_ours_alone(tmp_path: Path) -> None:
    LastAlive("base", tmp_path).note()
    [file] = tmp_path.iterdir()
    assert file.stat().st_mode & 0o777 == 0o600
    assert str(os.getuid()) in file.name


def test_a_pipe_that_somebody_laid_in_its_place_holds_nobody_up(tmp_path: Path) -> None:
    alive = LastAlive("base", tmp_path)
    alive.note()
    [file] = tmp_path.iterdir()
    file.unlink()
    os.mkfifo(file)
    alive.note()
    assert alive.rest_s() == 0

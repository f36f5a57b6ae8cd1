"""`psiu ping` at real processes."""

import json
import re
import signal
from collections.abc import Callable
from typing import Any

import pytest

from psiu_broker.bus.client import Client
from psiu_broker.errors import CallError


def test_each_answer_is_a_line_and_the_end_sums_them_up(lab: Any) -> None:
    asked = lab.run("ping", "MNERIM", "--count", "3", "--every", "0.5")
    assert asked.exit_code == 0, asked.output
    *answers, end = asked.stdout.splitlines()
    assert [re.sub(r"[\d.]+ ms$", "", line) for line in answers] == [f"{number} MNERIM: " for number in (1, 2, 3)]
    assert re.fullmatch(r"MNERIM: 3 of 3 answered, 0% lost; .* ms least, .* ms median, .* ms longest", end)


def test_each_robot_is_asked_what_harms_nothing(lab: Any) -> None:
    for robot in ("BETA", "BRACO", "base", "MNERIM"):
        lines = lab.run("ping", robot, "--count", "1", "--json").stdout.splitlines()
        answer, end = map(json.loads, lines)
        assert answer.keys() == {"n", "elapsed_ms"}, (robot, answer)
        assert end.items() >= {"robot": robot, "sent": 1, "answered": 1, "loss": 0.0}.items()
        assert end["min_ms"] == end["median_ms"] == end["max_ms"] == answer["elapsed_ms"]


def test_silence_is_a_loss_with_its_reason_and_the_exit_code_is_3(lab: Any) -> None:
    asked = lab.run("ping", "NINGUEM", "--count", "2", "--every", "0.01", "--json")
    assert asked.exit_code == 3
    first, second, end = map(json.loads, asked.stdout.splitlines())
    assert (first["error"], second["n"]) == ("unknown_robot", 2)
    assert (end["sent"], end["answered"], end["loss"], end["median_ms"]) == (2, 0, 1.0, None)


def test_it_goes_on_until_ctrl_c_and_then_sums_up(lab: Any, start: Callable[..., Any]) -> None:
    ping = start("psiu", "ping", "MNERIM", "--every", "0.4", "--connect", lab.endpoint)
    ping.until("^3 MNERIM")
    ping.signal(signal.SIGINT)
    assert ping.ended() == 0
    assert re.fullmatch(r"MNERIM: \d+ of \d+ answered, .*", ping.out[-1])


def test_what_is_refused_is_asked_once(lab: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def call(_: Client, robot: str, *__: object) -> None:
        asked.append(robot)
        raise CallError("refused", "broker base lets screen only listen; nothing was sent")

    monkeypatch.setattr(Client, "call", call)
    refused = lab.run("ping", "MNERIM", "--count", "3", "--every", "0.01")
    assert (refused.exit_code, asked) == (3, ["MNERIM"])
    assert refused.stderr == "psiu: broker base lets screen only listen; nothing was sent\n"

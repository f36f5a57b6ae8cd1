"""Robots told what to do, through a broker in another process."""

import json
import re
from typing import Any

import pytest

from psiu_broker.bus.client import Client
from psiu_broker.messages import Answer, CallRequest, Card, Refusal


def test_sucesso_is_told_and_exits_0(lab: Any) -> None:
    called = lab.run("call", "MNERIM", "parafrente", "100")
    assert called.exit_code == 0
    assert re.fullmatch(r"MNERIM: sucesso \(\d+\.\d ms\)\n", called.stdout)


def test_a_value_is_told_with_its_unit_and_exits_0(lab: Any) -> None:
    assert re.fullmatch(r"BRACO: 99 cm \(\d+\.\d ms\)\n", lab.run("call", "BRACO", "sonar").stdout)
    answer = Answer.model_validate(lab.json("call", "MNERIM", "distancia"))
    assert (answer.status, answer.values) == (None, [42])


def test_falha_exits_1(lab: Any) -> None:
    called = lab.run("call", "MNERIM", "trava")
    assert (called.exit_code, called.stdout.partition(" (")[0]) == (1, "MNERIM: falha")
    in_json = lab.run("call", "MNERIM", "trava", "--json")
    assert (in_json.exit_code, json.loads(in_json.stdout)["status"]) == (1, "falha")


@pytest.mark.parametrize(
    ("words", "error", "said"),
    [
        (("MNERIM", "parafrente", "1200"), "refused", "parafrente takes 0–999 cm, got 1200"),
        (("NINGUEM", "parafrente", "1", "--timeout", "0.2"), "unknown_robot", "no robot NINGUEM"),
        (("BRACO", "gara", "1"), "unknown_command", "did you mean garra"),
        (("base", "dance"), "unknown_command", "it understands"),
        (("MNERIM", "x" * 40_000), "bad_request", "longer than"),
        (("MNERIM", "liga", *["1"] * 65), "bad_request", "64 at most"),
    ],
)
def test_no_answer_exits_3_with_the_reason_on_one_line(lab: Any, words: tuple[str, ...], error: str, said: str) -> None:
    called = lab.run("call", *words)
    assert (called.exit_code, called.stdout) == (3, "")
    assert called.stderr.startswith("psiu: ")
    assert said in called.stderr
    assert len(called.stderr.splitlines()) == 1
    in_json = lab.run("call", *words, "--json")
    assert in_json.exit_code == 3
    assert Refusal.model_validate_json(in_json.stdout).error == error


@pytest.mark.parametrize("words", [("garra", "-45"), ("garra", "-45", "--json"), ("--json", "garra", "-45.0")])
def test_negative_numbers_are_arguments(lab: Any, words: tuple[str, ...]) -> None:
    assert lab.run("call", "BRACO", *words).exit_code == 0
    lab.braco.until('"name":"garra","signal":192')


def test_numbers_are_sent_as_numbers_and_the_deadline_with_them(lab: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[CallRequest] = []
    answer = Answer(elapsed_ms=1)
    monkeypatch.setattr(Client, "call", lambda client, robot, command, request: asked.append(request) or answer)
    assert lab.run("call", "MNERIM", "liga", "1", "-2.5", "x1", "--timeout", "3").exit_code == 0
    assert asked == [CallRequest(parameters=[1, -2.5, "x1"], timeout_s=3)]
    assert [type(value) for value in asked[0].parameters] == [int, float, str]


def test_what_is_no_number_stays_text(lab: Any) -> None:
    assert lab.run("call", "MNERIM", "liga", "1", "x").exit_code == 0
    lab.mnerim.until('"subject":"liga","parameters":\\["1","x"\\]')


def test_a_mistyped_option_never_reaches_a_robot(lab: Any) -> None:
    refused = lab.run("call", "MNERIM", "liga", "--tiemout", "3")
    assert refused.exit_code == 2
    assert "--tiemout" in refused.stderr
    negative = lab.run("call", "MNERIM", "distancia", "--timeout", "-1")
    assert (negative.exit_code, "-1.0 is not in the range" in negative.stderr) == (2, True)


def test_an_address_is_called_like_a_name(lab: Any) -> None:
    assert lab.json("call", "0x12", "ping")["status"] == "sucesso"


def test_send_goes_on_and_the_robot_moves(lab: Any) -> None:
    sent = lab.run("send", "MNERIM", "giradireita", "77")
    assert (sent.exit_code, sent.output) == (0, "")
    lab.mnerim.until('"subject":"giradireita","parameters":\\["77"\\]')
    assert lab.json("send", "BRACO", "garra", "-90") == {"sent": True}
    lab.braco.until('"name":"garra","signal":128')


def test_send_without_a_broker_exits_3(lab: Any) -> None:
    assert lab.run("send", "MNERIM", "parafrente", "1", "--prefix", "elsewhere").exit_code == 3


def test_discovery_lists_robots_with_what_they_can_do(lab: Any) -> None:
    cards = {card["robot"]: Card.model_validate(card) for card in lab.json("discover")}
    assert set(cards) == {"MNERIM", "BETA", "BRACO"}
    assert {"distancia", "trava", "liga"} <= {command.name for command in cards["MNERIM"].commands}
    assert lab.run("discover").stdout.startswith("BETA\t")

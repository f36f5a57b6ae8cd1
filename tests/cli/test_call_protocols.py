"""Robots of every protocol told what to do, through a broker in another process."""

import json
import re
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from click.testing import CliRunner, Result
from ports import free_port

from psiu_broker.cli.call import answer_line
from psiu_broker.cli.tables import show_commands, takes
from psiu_broker.cli.tool import psiu
from psiu_broker.messages import Answer, Card, Command

PATIENCE_S = 20.0
SILENT = "sent; this robot does not answer"


def configuration(folder: Path, bus: int) -> str:
    return f"""
[broker]
name = "base"
[zenoh]
listen = ["tcp/127.0.0.1:{bus}"]
[links.corpo]
adapter = "serial"
device = "{folder}/corpo"
baudrate = 9600
protocol = "mitya"
version = "2012"
[robots.MITYA]
link = "corpo"
[links.campo]
adapter = "serial"
device = "{folder}/campo"
baudrate = 19200
protocol = "soccer"
preset = "mirosot"
rate_hz = 30
[robots.GOLEIRO]
link = "campo"
address = 1
[links.placa]
adapter = "serial"
device = "{folder}/placa"
baudrate = 57600
protocol = "firmata"
[robots.UNO]
link = "placa"
pins.led = {{ pin = 13, mode = "output" }}
pins.luz = {{ pin = "A0", mode = "analog" }}
[links.lampada]
adapter = "serial"
device = "{folder}/lampada"
baudrate = 57600
protocol = "amarino"
[robots.LAMPADA]
link = "lampada"
commands.brilho = {{ flag = "b", parameters = ["int"], minimum = 0, maximum = 255, answer = true }}
"""


@pytest.fixture(scope="module")
def zoo(tmp_path_factory: pytest.TempPathFactory, process: Any) -> Iterator[Any]:
    """A broker with a robot of each protocol beside PSIU, each in a process of its own."""
    folder, bus = tmp_path_factory.mktemp("zoo"), free_port()
    (folder / "zoo.toml").write_text(configuration(folder, bus))
    words = {
        "corpo": ("mitya",),
        "campo": ("soccer",),
        "placa": ("firmata", "--pin", "A0=512"),
        "lampada": ("amarino", "--function", "b="),
    }
    robots = {
        link: process("psiu", "sim", "--json", "--pty", folder / link, "--protocol", *more)
        for link, more in words.items()
    }
    started = [*robots.values()]
    try:
        for robot in robots.values():
            robot.until('"ready"')
        started.append(process("psiu-broker", "run", "--config", folder / "zoo.toml"))
        started[-1].until("is ready")

        def run(*words: str) -> Result:
            return CliRunner().invoke(psiu, words, env={"PSIU_CONNECT": f"tcp/127.0.0.1:{bus}"}, prog_name="psiu")

        end = time.monotonic() + PATIENCE_S
        while {line.split("\t")[3] for line in run("links").stdout.splitlines()} != {"open"}:
            assert time.monotonic() < end, run("links").output
            time.sleep(0.05)
        yield SimpleNamespace(run=run, **robots)
    finally:
        for each in reversed(started):
            each.close()


def test_a_robot_that_does_not_answer_is_told_and_that_is_said(zoo: Any) -> None:
    called = zoo.run("call", "MITYA", "D", "100")
    assert called.exit_code == 0, called.output
    assert re.fullmatch(rf"MITYA: {SILENT} \(\d+\.\d ms\)\n", called.stdout)
    zoo.corpo.until('"left":100,"right":100')


def test_backwards_needs_no_other_spelling(zoo: Any) -> None:
    assert zoo.run("call", "MITYA", "D", "-100").exit_code == 0
    zoo.corpo.until('"left":-100,"right":-100')
    assert zoo.run("call", "GOLEIRO", "rodas", "15", "-31").exit_code == 0
    zoo.campo.until('"robot":1,"wheels":.15,-31.')


def test_the_remark_is_in_json(zoo: Any) -> None:
    called = zoo.run("call", "GOLEIRO", "rodas", "-3", "4", "--json")
    assert called.exit_code == 0, called.output
    answer = Answer.model_validate_json(called.stdout)
    assert (answer.status, answer.values, answer.remark) == (None, [], SILENT)


def test_robots_that_answer_are_heard(zoo: Any) -> None:
    assert zoo.run("call", "UNO", "led", "1").stdout.startswith("UNO: sucesso (")
    zoo.placa.until('"pin":13,"name":"D13","mode":"output","state":1')
    assert zoo.run("call", "UNO", "luz").stdout.startswith("UNO: 512 (")
    assert zoo.run("call", "LAMPADA", "brilho", "200").stdout.startswith("LAMPADA: 200 (")
    failed = zoo.run("call", "LAMPADA", "send", "Q", "1")
    assert failed.exit_code == 1
    assert failed.stdout.startswith("LAMPADA: falha: the board has no function for this flag (")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("MITYA", "D", "300"), "D takes -255 to 255, got 300"),
        (("GOLEIRO", "rodas", "-32", "0"), "rodas takes 2 whole numbers, -31 to 31"),
        (("LAMPADA", "brilho", "-1"), "0 to 255"),
    ],
)
def test_what_does_not_fit_is_refused_with_the_range(zoo: Any, words: tuple[str, ...], said: str) -> None:
    refused = zoo.run("call", *words)
    assert refused.exit_code == 3
    assert said in refused.stderr


def test_the_commands_of_one_robot_are_listed_with_all_that_they_take(zoo: Any) -> None:
    rows = {row[0]: row for row in (line.split("\t") for line in zoo.run("robots", "MITYA").stdout.splitlines())}
    assert rows["drive"][1:8] == ["D", "1", "0", "0", "-255", "255", "-"]
    assert rows["head-horizontal"][7] == "deg"
    assert "the speed of both motors" in rows["drive"][8]
    card = Card.model_validate_json(zoo.run("robots", "GOLEIRO", "--json").stdout)
    assert [command.name for command in card.commands] == ["rodas", "bytes", "pare"]
    address = str(card.address)
    assert zoo.run("robots", address).stdout == zoo.run("robots", "GOLEIRO").stdout


def test_the_commands_of_no_robot_are_a_robot_that_is_not_known(zoo: Any) -> None:
    refused = zoo.run("robots", "NINGUEM", "--json")
    assert refused.exit_code == 3
    assert json.loads(refused.stdout)["error"] == "unknown_robot"
    assert "no robot NINGUEM is known" in refused.stderr


@pytest.mark.parametrize(
    ("answer", "line"),
    [
        (Answer(elapsed_ms=1, remark=SILENT), f"X: {SILENT} (1.0 ms)"),
        (Answer(elapsed_ms=1, status="falha", values=["E0002"], remark="E0002, why"), "X: falha: E0002, why (1.0 ms)"),
        (Answer(elapsed_ms=1, status="falha", values=["E0002"]), "X: falha E0002 (1.0 ms)"),
        (Answer(elapsed_ms=1, values=[5.02], unit="V", remark="low"), "X: 5.02 V: low (1.0 ms)"),
        (Answer(elapsed_ms=1), "X: answered (1.0 ms)"),
    ],
)
def test_an_answer_is_one_line(answer: Answer, line: str) -> None:
    assert answer_line("X", answer) == line


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({}, None),
        ({"unit": "cm"}, None),
        ({"ints": 1}, "a number"),
        ({"ints": 1, "minimum": 0, "maximum": 180, "unit": "deg"}, "0 to 180 deg"),
        ({"ints": 2, "minimum": -31, "maximum": 31}, "-31 to 31, twice"),
        ({"floats": 3, "unit": "g"}, "a number g, 3 times"),
        ({"ints": 1, "minimum": 1}, "from 1"),
        ({"ints": 1, "maximum": 9}, "up to 9"),
        ({"minimum": 1, "maximum": 2}, "1 to 2, or nothing"),
        ({"minimum": 1, "maximum": 1}, "1, or nothing"),
        ({"chars": 1}, "text"),
        ({"ints": 1, "chars": 2}, "a number and 2 texts"),
    ],
)
def test_what_a_command_takes_is_told_in_words(fields: dict[str, Any], said: str | None) -> None:
    assert takes(Command(name="x", **fields)) == said


def test_a_terminal_gets_the_commands_as_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    commands = [
        Command(name="drive", ints=1, minimum=-255, maximum=255, aliases=["D"], description="both motors"),
        Command(name="sonar", unit="cm"),
    ]
    card = Card(robot="X", protocol="mitya", broker="base", link="corpo", link_state="open", commands=commands)
    show_commands(card, drawn=True)
    head, titles, drive, sonar = (line.rstrip() for line in capsys.readouterr().out.splitlines())
    assert head == "X  mitya on corpo (open)"
    assert re.split(r"  +", titles) == ["command", "also", "takes", "what it does"]
    assert re.split(r"  +", drive) == ["drive", "D", "-255 to 255", "both motors"]
    assert re.split(r"  +", sonar) == ["sonar", "-", "-", "answers in cm"]
    show_commands(card.model_copy(update={"commands": []}), drawn=True)
    assert "psiu discover" in capsys.readouterr().out

"""`psiu mesh`, from what brokers answer."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self
from xml.etree import ElementTree

import pytest
from click.testing import Result
from mesh_answers import broker, conflict, full, mesh, robot

from psiu_broker.cli import connection
from psiu_broker.cli import mesh as command
from psiu_broker.cli.mesh_view import composed
from psiu_broker.messages import Mesh

Run = Callable[..., Result]


class Bus:
    """In the client's place: brokers that answer what the test says."""

    def __init__(self) -> None:
        self.answers: list[Mesh] = []

    def __call__(self, *_: object) -> Self:
        return self

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None: ...

    def ask(self, *what: str) -> dict[str, Any]:
        assert what == ("mesh",)
        return {each.broker: each.model_dump(mode="json") for each in self.answers}


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bus]:
    bus = Bus()
    monkeypatch.setattr(connection, "Client", bus)
    yield bus


def rows(shown: Result) -> list[list[str]]:
    assert shown.exit_code == 0
    return [line.split("\t") for line in shown.stdout.splitlines()]


def test_a_pipe_gets_lines_that_begin_with_what_they_are(bus: Bus, tool: Run) -> None:
    bus.answers = full("base", "north", robots=[robot("BRACO", "north", address="0x12")])
    bus.answers[0].conflicts.append(conflict("BRACO", "base", "north"))
    told = rows(tool("mesh"))
    since = "2026-11-22T04:00:00.000000Z"
    assert told == [
        ["broker", "base", since, "0", "peer", "yes", "id-base"],
        ["broker", "north", since, "1", "peer", "yes", "id-north"],
        ["link", "base", "north", "0.5", "0", "0", "0", "direct"],
        ["robot", "BRACO", "0x12", "psiu-ascii", "north", "radio", "0.9", "3.0", "base north", "north"],
        ["conflict", "BRACO", "base north", since, "by turns; rename one of them"],
    ]


def test_a_split_is_a_line(bus: Bus, tool: Run) -> None:
    bus.answers = [mesh("a", broker("b"), broker("c")), mesh("b", broker("a")), mesh("c", broker("a"))]
    assert [row for row in rows(tool("mesh")) if row[0] == "split"] == [
        ["split", "b", "a", "c"],
        ["split", "c", "a", "b"],
    ]


def test_json_is_what_each_broker_sees(bus: Bus, tool: Run) -> None:
    bus.answers = full("base", "north")
    told = json.loads(tool("mesh", "--json").stdout)
    assert [Mesh.model_validate(each) for each in told] == bus.answers


def test_a_terminal_gets_tables_and_what_to_do(capsys: pytest.CaptureFixture[str]) -> None:
    told = full(
        "base", "north", robots=[robot("BRACO", "north", address="0x12")], conflicts=[conflict("BETA", "a", "b")]
    )
    told.append(mesh("gate", broker("base")))
    command.show_mesh(composed(told), drawn=True)
    shown = capsys.readouterr().out
    for words in ("round trip", "0.50 ms", "only gate sees it", "BRACO 0x12", "90%", "3 s ago"):
        assert words in shown
    assert "Conflict: BETA at a, b: by turns; rename one of them." in shown
    assert "north is seen by base but not by gate" in shown


def test_a_broker_alone_is_told_so(capsys: pytest.CaptureFixture[str]) -> None:
    command.show_mesh(composed([mesh("base")]), drawn=True)
    assert "base is alone" in capsys.readouterr().out


def test_the_drawing_goes_where_it_is_wanted(bus: Bus, tool: Run, tmp_path: Path) -> None:
    bus.answers = full("base", "north")
    assert tool("mesh", "--graph", tmp_path / "m.svg").output == ""
    assert ElementTree.parse(tmp_path / "m.svg").getroot().tag.endswith("svg")
    tool("mesh", "--graph", tmp_path / "m.dot")
    dot = (tmp_path / "m.dot").read_text()
    assert dot.startswith("graph psiu {")
    assert tool("mesh", "--graph", "-").stdout == dot
    assert tool("mesh", "--graph").stdout == dot


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (("--graph", "mesh.png"), 2, "must end in .dot or .svg"),
        (("--graph", "-", "--json"), 2, "exclude each other"),
        (("--graph", "/nowhere/at/all.svg"), 1, "cannot be written: No such file"),
    ],
)
def test_a_drawing_that_cannot_be_is_said_in_a_line(
    bus: Bus, tool: Run, words: tuple[str, ...], code: int, said: str
) -> None:
    bus.answers = full("base")
    refused = tool("mesh", *words)
    assert (refused.exit_code, refused.stdout) == (code, "")
    assert said in refused.stderr


def test_nobody_there_is_no_broker(bus: Bus, tool: Run) -> None:
    refused = tool("mesh")
    assert (refused.exit_code, refused.stderr) == (3, "psiu: there is no broker at tcp/127.0.0.1:7447\n")

"""What a broker in another process knows, in tables, plain lines and JSON."""

import json
import os
import pty
import re
import subprocess
from collections.abc import Callable
from typing import Any

import pytest
from click.testing import Result

from psiu_broker.bus.client import Client
from psiu_broker.cli.tables import show_links
from psiu_broker.messages import Card, Health, Ledger, Link, Route, Status, Why

Run = Callable[..., Result]


def test_robots_are_a_list_of_cards(lab: Any) -> None:
    cards = {card["robot"]: Card.model_validate(card) for card in lab.json("robots")}
    assert set(cards) == {"MNERIM", "BETA", "BRACO"}
    assert (cards["MNERIM"].link, cards["BRACO"].address) == ("radio", "0x12")


def test_a_pipe_gets_one_line_a_robot_with_tabs_between(lab: Any) -> None:
    rows = [line.split("\t") for line in lab.run("robots").stdout.splitlines()]
    assert [len(row) for row in rows] == [10, 10, 10]
    assert [row[0] for row in rows] == ["BETA", "BRACO", "MNERIM"]
    braco = rows[1]
    assert (braco[1], braco[3], braco[4], braco[5], braco[9]) == ("0x12", "arm", "-", "open", "base")
    assert "garra" in braco[8].split(" ")


def test_links_say_what_they_wait_for(lab: Any) -> None:
    links = {link["name"]: Link.model_validate(link) for link in lab.json("links")}
    assert [links[name].state for name in ("radio", "wifi", "arm")] == ["open"] * 3
    assert links["lost"].state in ("waiting", "opening")
    assert "/dev/serial/by-id/none" in str(links["lost"].reason)
    rows = {line.split("\t")[0]: line.split("\t") for line in lab.run("links").stdout.splitlines()}
    assert {len(row) for row in rows.values()} == {15}
    assert rows["lost"][13:] == ["-", "-"], "nothing was sent"
    assert [float(ms) for ms in rows["radio"][13:]] == [links["radio"].delay_p50_ms, links["radio"].delay_p99_ms]
    assert "/dev/serial/by-id/none" in rows["lost"][4]


def test_routes_tell_how_they_are_known(lab: Any) -> None:
    routes = {route["robot"]: Route.model_validate(route) for route in lab.json("routes")}
    assert (routes["MNERIM"].origin, routes["BRACO"].origin) == ("learned", "static")
    assert lab.json("routes")[0]["broker"] == "base"
    assert {len(line.split("\t")) for line in lab.run("routes").stdout.splitlines()} == {7}


def test_the_ledger_balances_link_by_link(lab: Any) -> None:
    (told,) = lab.json("ledger")
    ledger = Ledger.model_validate(told)
    assert ledger.balances
    for line in lab.run("ledger").stdout.splitlines():
        _, arrived, delivered, answered, dropped, waiting, *_ = line.split("\t")
        assert int(arrived) == int(delivered) + int(answered) + int(dropped) + int(waiting)


def test_books_that_do_not_balance_fail_aloud(lab: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    told = lab.json("ledger")[0] | {"balances": False}
    monkeypatch.setattr(Client, "ask", lambda *_: {"base": told})
    result = lab.run("ledger")
    assert result.exit_code == 1
    assert "the books of base (those of the links and those of the robots do not agree)" in result.stderr


def test_the_status_is_one_object_a_broker_with_its_health(lab: Any) -> None:
    (told,) = lab.json("status")
    assert Status.model_validate(told).broker == "base"
    assert Health.model_validate(told).healthy
    assert (told["links_open"], told["links"], told["robots"]) == (3, 4, 3)
    assert lab.run("status").stdout.split("\t")[6] == "yes"


def test_why_tells_the_decision_and_its_steps(lab: Any) -> None:
    (there,) = [Why.model_validate(each) for each in lab.json("why", "BETA", "MNERIM")]
    assert there.delivered
    nowhere = lab.run("why", "BETA", "0x77")
    assert nowhere.exit_code == 0
    assert nowhere.stdout.startswith("BETA → 0x77 would not arrive: no_route\n  ")


def test_a_terminal_gets_tables_with_heads_and_reasons(lab: Any) -> None:
    screen, terminal = pty.openpty()
    with open(screen, "rb", buffering=0) as shown:  # noqa: PTH123
        # Beside the terminal the test has no end of it open, so that reading ends with the process.
        command = subprocess.Popen(
            [*lab.script("psiu"), "links"], stdout=terminal, env={**os.environ, **lab.env, "COLUMNS": "100"}
        )
        os.close(terminal)
        text = b""
        try:
            while piece := shown.read(4096):
                text += piece
        except OSError:
            pass  # what a pty says at its end
        assert command.wait(10) == 0
    lines = text.decode().splitlines()
    assert "malformed" in lines[0]
    assert "waited" in lines[0]
    assert any(line.startswith("lost is ") and "/dev/serial/by-id/none" in line for line in lines)
    assert any("far end" in line for line in lines)
    assert re.search(r"trunk hill is (waiting|opening): .*connection refused", lines[-1])


@pytest.mark.parametrize("command", ["robots", "links", "routes", "ledger", "status", "discover", "monitor"])
def test_without_a_broker_there_is_one_line_and_exit_code_3(tool: Run, command: str, nowhere: str, monkeypatch) -> None:
    monkeypatch.setattr("psiu_broker.bus.client.OPEN_TIMEOUT_S", 0.3)
    refused = tool(command, "--json", "--connect", nowhere)
    assert refused.exit_code == 3
    assert refused.stderr == f"psiu: no broker answers at {nowhere}; is psiu-broker running?\n"
    assert json.loads(refused.stdout)["error"] == "no_broker"


def test_the_first_of_several_brokers_that_answers_is_asked(lab: Any, tool: Run, nowhere: str) -> None:
    asked = tool("status", "--json", "--connect", f"{nowhere},{lab.endpoint}")
    assert json.loads(asked.stdout)[0]["broker"] == "base"
    asked = tool("status", "--json", "--connect", nowhere, "--connect", lab.endpoint)
    assert json.loads(asked.stdout)[0]["broker"] == "base"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--prefix", "a b"), "prefix"),
        (("--connect", ","), "--connect needs an endpoint"),
        (("--connect", "127.0.0.1:7447"), "127.0.0.1:7447"),
    ],
)
def test_an_impossible_connection_is_told_without_a_traceback(tool: Run, words: tuple[str, str], said: str) -> None:
    refused = tool("robots", *words)
    assert refused.exit_code in (2, 3)
    assert said in refused.stderr
    assert isinstance(refused.exception, SystemExit)


def test_a_prefix_without_brokers_is_no_broker(lab: Any) -> None:
    for command in ("robots", "links", "status", "discover"):
        refused = lab.run(command, "--prefix", "elsewhere")
        assert (refused.exit_code, refused.stderr) == (3, f"psiu: there is no broker at {lab.endpoint}\n")


def test_what_was_lost_before_it_was_a_frame_is_said_in_words(capsys: pytest.CaptureFixture[str]) -> None:
    usual = {"adapter": "udp", "protocol": "psiu-ascii", "state": "open", "since": "2024-01-01T00:00:00Z"}
    lossy = Link(name="wifi", **usual, details={"refused": 3, "lost": 2, "oversized": 0, "listen": "127.0.0.1:9000"})
    whole = Link(name="lab", **usual, details={"refused": 0, "lost": 0, "oversized": 0})
    show_links([("base", lossy), ("base", whole)], drawn=True)
    said = capsys.readouterr().out.splitlines()[3:]
    assert said == ["wifi: 3 datagrams of senders that are not let in, 2 datagrams that the broker came too late for"]

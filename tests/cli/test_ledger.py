"""What became of every frame, in tables, plain lines and JSON, once and as it goes."""

import json
import os
import pty
import signal
import subprocess
from typing import Any, get_args

import pytest

from psiu_broker.bus.client import Client
from psiu_broker.cli.ledger import show_ledger
from psiu_broker.messages import Account, Ledger, RobotAccount
from psiu_broker.routing.verdicts import KEPT, MEANINGS, Verdict


def test_robot_by_robot_the_sums_are_those_of_all_links(lab: Any) -> None:
    lab.run("call", "MNERIM", "parafrente", "1")
    robots = [RobotAccount.model_validate(each) for each in lab.json("ledger", "--robots")]
    assert {"MNERIM", "BETA", "BRACO", "base", None} <= {each.robot for each in robots}
    assert {each.robot: each.link for each in robots}["MNERIM"] == "radio"
    for each in robots:
        assert each.arrived == each.delivered + each.answered + sum(each.dropped.values()) + each.waiting
    total = Ledger.model_validate(lab.json("ledger")[0]).total
    assert sum(each.arrived for each in robots) == total.arrived


def test_one_robots_books_are_found_by_its_name(lab: Any) -> None:
    (line,) = lab.run("ledger", "MNERIM").stdout.splitlines()
    name, link, arrived, delivered, answered, dropped, waiting, _, broker = line.split("\t")
    assert (name, link, broker) == ("MNERIM", "radio", "base")
    assert int(arrived) == int(delivered) + int(answered) + int(dropped) + int(waiting)


def test_of_a_robot_that_never_spoke_there_are_no_books(lab: Any) -> None:
    refused = lab.run("ledger", "GHOST", "--json")
    assert refused.exit_code == 3
    assert json.loads(refused.stdout)["error"] == "unknown_robot"
    assert "psiu ledger --robots" in refused.stderr


def test_watched_it_is_told_again_and_again_until_ctrl_c(lab: Any) -> None:
    watched = subprocess.Popen(
        [*lab.script("psiu"), "ledger", "--watch", "--json"],
        stdout=subprocess.PIPE,
        env={**os.environ, **lab.env, "PYTHONUNBUFFERED": "1"},
    )
    with watched:
        assert watched.stdout is not None
        looks = [Ledger.model_validate(json.loads(watched.stdout.readline())[0]) for _ in range(3)]
        watched.send_signal(signal.SIGINT)
        assert watched.wait(10) == 0
    assert all(look.balances for look in looks)
    assert looks[0].total.arrived <= looks[2].total.arrived


def test_watched_on_a_terminal_it_says_how_many_come_a_second(lab: Any) -> None:
    screen, terminal = pty.openpty()
    with open(screen, "rb", buffering=0) as shown:  # noqa: PTH123
        command = subprocess.Popen(
            [*lab.script("psiu"), "ledger", "--watch"], stdout=terminal, env={**os.environ, **lab.env, "COLUMNS": "120"}
        )
        os.close(terminal)
        text = b""
        while text.count(b"The books of base balance") < 2:
            text += shown.read(4096)
        command.send_signal(signal.SIGINT)
        assert command.wait(10) == 0
    assert b"a second" in text
    assert text.startswith(b"\x1b[H\x1b[J"), "each look in the place of the last"


def test_books_that_do_not_balance_are_shown_while_watching(lab: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    told = lab.json("ledger")[0] | {"balances": False}
    looks = iter(({"base": told}, {"base": told}))

    def ask(*_: object) -> dict[str, Any]:
        try:
            return next(looks)
        except StopIteration:
            raise KeyboardInterrupt from None

    monkeypatch.setattr(Client, "ask", ask)
    monkeypatch.setattr("psiu_broker.cli.ledger.EVERY_S", 0.0)
    result = lab.run("ledger", "--watch", "--json")
    assert result.exit_code == 1
    line = "psiu: the books of base (those of the links and those of the robots do not agree) do not balance: "
    assert result.stderr == f"{line}please report it\n" * 3, "at each look, and at the end"
    assert [json.loads(line)[0]["balances"] for line in result.stdout.splitlines()] == [False, False]


def off_by_one(told: Any, what: str) -> Any:
    account = told["accounts"][0]
    return told | {"accounts": [account | {what: account[what] + 1}, *told["accounts"][1:]]}


@pytest.mark.parametrize("what", ["arrived", "delivered", "answered", "waiting"])
def test_the_sums_are_done_again_whatever_the_broker_says_of_them(
    lab: Any, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    told = lab.json("ledger")[0]
    assert told["balances"]
    monkeypatch.setattr(Client, "ask", lambda *_: {"base": off_by_one(told, what)})
    result = lab.run("ledger")
    assert result.exit_code == 1
    assert f"the books of base ({told['accounts'][0]['link']} " in result.stderr


def test_a_robot_of_whom_more_was_dropped_than_came_fails_aloud(lab: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    account = {"robot": "MNERIM", "arrived": 1, "delivered": -1, "answered": 0, "dropped": {"expired": 2}}
    monkeypatch.setattr(Client, "ask", lambda *_: {"base": [account]})
    result = lab.run("ledger", "MNERIM")
    assert result.exit_code == 1
    assert "MNERIM 1 arrived, -1 delivered" in result.stderr


def test_every_reason_for_a_drop_that_occurs_is_told_in_words(capsys: pytest.CaptureFixture[str]) -> None:
    assert set(MEANINGS) == set(get_args(Verdict))
    dropped = {verdict: 1 for verdict in MEANINGS if verdict not in KEPT}
    count = len(dropped)
    account = Account(link="radio", arrived=count + 1, delivered=1, answered=0, dropped={**dropped, "newer": 0})
    told = Ledger(accounts=[account], total=account.model_copy(update={"link": "total"}), balances=True)
    show_ledger([("base", told)], drawn=True)
    said = capsys.readouterr().out
    assert all(f"\n{verdict}: {MEANINGS[verdict]}\n" in said for verdict in dropped)
    assert "\nThe books of base balance: " in said
    show_ledger([("base", told)], drawn=False)
    assert "balance" not in capsys.readouterr().out


def test_what_does_not_add_up_is_shown_in_the_place_of_the_sum(capsys: pytest.CaptureFixture[str]) -> None:
    account = Account(link="radio", arrived=3, delivered=1, answered=0, dropped={"expired": 1})
    told = Ledger(accounts=[account], total=account, balances=True)
    show_ledger([("base", told)], drawn=True)
    assert "The books of base do NOT balance: radio 3 arrived, 1 delivered, 2 in all" in capsys.readouterr().out

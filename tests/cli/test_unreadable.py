"""A broker of another version than the tool's: what it answers may lack anything, and ends in one line."""

import json
from collections.abc import Callable
from typing import Any

import pytest

from psiu_broker.bus.client import Client

ASKING = [
    ("robots",),
    ("robots", "MNERIM"),
    ("links",),
    ("routes",),
    ("status",),
    ("ledger",),
    ("ledger", "--robots"),
    ("ledger", "MNERIM"),
    ("conflicts",),
    ("mesh",),
    ("mesh", "--graph"),
    ("why", "BETA", "MNERIM"),
    ("trace", "base", "MNERIM"),
    ("call", "MNERIM", "quantoscomandos"),
    ("ping", "MNERIM", "--count", "1"),
    ("monitor", "MNERIM"),
    ("discover",),
]


MANGLED: dict[str, Callable[[Any], Any]] = {
    "without anything in it": lambda value: [{}] if isinstance(value, list) else {},
    "of another shape": lambda value: {"newer": value} if isinstance(value, list) else [value],
    "a number": lambda _: 5,
    "numbers": lambda _: [5],
    "nothing": lambda _: None,
    "no JSON": lambda _: b"\xff{",
}


@pytest.mark.parametrize("answer", MANGLED)
@pytest.mark.parametrize("words", ASKING, ids=" ".join)
def test_an_answer_that_cannot_be_read_is_told_in_one_line(
    lab: Any, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], answer: str
) -> None:
    real = Client._get

    def mangled(client: Client, *arguments: Any) -> list[tuple[str, bytes]]:
        return [(key, written(MANGLED[answer](json.loads(payload)))) for key, payload in real(client, *arguments)]

    monkeypatch.setattr(Client, "_get", mangled)
    result = lab.run(*words)
    assert isinstance(result.exception, SystemExit), result.exception
    assert result.exit_code == 3
    [line] = result.stderr.splitlines()
    assert "cannot be read" in line or "cannot read" in line or (words[0] == "ping" and "did not answer" in line)
    if "--graph" not in words:
        told = json.loads(lab.run(*words, "--json").stdout.splitlines()[0])
        assert told["error"] in ("no_broker", "outcome_unknown")


def written(value: object) -> bytes:
    return value if isinstance(value, bytes) else json.dumps(value).encode()


@pytest.mark.parametrize("words", [("links",), ("ledger",), ("status",), ("robots",), ("routes",)], ids=" ".join)
def test_what_a_newer_broker_says_besides_does_no_harm(
    lab: Any, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    real = Client._get

    def newer(value: Any) -> Any:
        return [newer(each) for each in value] if isinstance(value, list) else value | {"newer": 1}

    def richer(client: Client, *arguments: Any) -> list[tuple[str, bytes]]:
        return [(key, written(newer(json.loads(payload)))) for key, payload in real(client, *arguments)]

    monkeypatch.setattr(Client, "_get", richer)
    assert lab.run(*words).exit_code == 0
    assert lab.run(*words, "--json").exit_code == 0

"""`psiu monitor`: what happens on the bus, as it happens."""

import sys
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Final

import click
from pydantic_core import from_json, to_json

from psiu_broker.bus.client import Client
from psiu_broker.bus.keys import chunk, robot
from psiu_broker.cli.commands import closed_pipe_is_fine, examples
from psiu_broker.cli.connection import Connection, connects
from psiu_broker.cli.lines import Message, card_line, frame_line, gone_line, raw_line
from psiu_broker.cli.output import printable
from psiu_broker.messages import Card

Wanted = Callable[[Message], bool]

_SHOWN: Final = 200


@click.command(
    epilog=examples(
        "psiu monitor",
        "psiu monitor MNERIM",
        "psiu monitor 'psiu/*/*/parafrente'",
        "psiu monitor --json | jq -r .command",
        "psiu monitor --raw radio",
    )
)
@click.argument("key", required=False)
@click.option("--raw", metavar="LINK|all", help="Every frame of a link instead, with its verdict and bytes.")
@connects
def monitor(connection: Connection, key: str | None, raw: str | None) -> None:
    """Print what robots say, until Ctrl-C.

    KEY is a robot's name or address (what it says and what is said to it), or a Zenoh key with wildcards; left out:
    everything. With --json: one object a line with its key, else as psiu schema Decoded, Card or RawFrame says.
    """
    if key is not None and raw is not None:
        raise click.UsageError("give a KEY or --raw, not both")
    with connection.client() as client, suppress(KeyboardInterrupt):
        wanted: Wanted = _anything
        if raw is not None:
            asked = f"{client.keys.prefix}/@raw/*/{'*' if raw == 'all' else chunk(raw)}"
        elif key is not None and ("/" in key or "*" in key):
            asked = key
        else:
            asked = f"{client.keys.prefix}/**"
            wanted = _anything if key is None else _of(key, client.cards())
        if sys.stderr.isatty():
            click.echo(f"Listening to {printable(asked)}; Ctrl-C ends.", err=True)
        try:
            for at, kind, payload in client.monitor(asked):
                message = _gone(client, at) if kind == "delete" else read_message(payload)
                if wanted(message):
                    click.echo(_json(at, message) if connection.as_json else message_line(at, message))
        except BrokenPipeError:
            closed_pipe_is_fine()


def message_line(key: str, message: Message) -> str:
    """A message of the bus for a person, known by its fields; as it came where these are not what they should be."""
    with suppress(TypeError, ValueError, AttributeError, OverflowError, LookupError):
        line = _line(message)
        if line is not None:
            return line
    return printable(f"{key}  {message.get('text') or to_json(message).decode()}")


def _line(message: Message) -> str | None:
    if "verdict" in message and "direction" in message:
        return raw_line(message)
    if "kind" in message and "source" in message:
        return frame_line(message)
    if "link_state" in message:
        return card_line(message)
    if "gone" in message:
        return gone_line(str(message["robot"]))
    return None


def read_message(payload: bytes) -> Message:
    """A payload as an object, whatever it is: anybody may put anything on the bus."""
    with suppress(ValueError):
        message = from_json(payload)
        if isinstance(message, dict):
            return message
    return {"text": payload[:_SHOWN].decode(errors="replace")}


def _gone(client: Client, key: str) -> Message:
    name = key.removeprefix(f"{client.keys.prefix}/")
    with suppress(ValueError):
        name = str(robot(name))
    return {"robot": name, "gone": True}


def _json(key: str, message: Message) -> str:
    return to_json({"key": key, **message}).decode()


def _anything(message: Message) -> bool:
    return True


def _of(name: str, cards: Iterable[Card]) -> Wanted:
    """What is about one robot, under its name or its address."""
    names = {name}
    for card in cards:
        if name in (card.robot, card.address):
            names |= {card.robot, *([card.address] if card.address else [])}
    return lambda message: not names.isdisjoint(message.get(part) for part in ("source", "destination", "robot"))

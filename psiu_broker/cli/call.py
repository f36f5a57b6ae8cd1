"""Telling robots what to do: `psiu call`, `send` and `discover`."""

import sys
from typing import Final

import click

from psiu_broker.cli.commands import WordsCommand, examples
from psiu_broker.cli.connection import Connection, connects
from psiu_broker.cli.output import on_terminal, print_json, print_models, printable, styled
from psiu_broker.cli.tables import show_robots
from psiu_broker.errors import CallError
from psiu_broker.messages import Answer, CallRequest, Value
from psiu_broker.profiles.psiu import typed
from psiu_broker.resident import DISCOVER

FALHA: Final = 1
"""The exit code where the robot did answer: that it could not."""

_timeout = click.option(
    "--timeout",
    "timeout_s",
    metavar="SECONDS",
    type=click.FloatRange(0, 3600, min_open=True),
    help="How long to wait for the answer; left out: as long as the command may take.",
)


@click.command(
    cls=WordsCommand,
    epilog=examples(
        "psiu call MNERIM parafrente 100",
        "psiu call BRACO garra -45 --timeout 5",
        "psiu call MITYA D -100",
        "psiu call GOLEIRO rodas 15 -31",
        "psiu call MNERIM quantoscomandos --json",
        "psiu call 0x12 ping && echo it is there",
    ),
)
@click.argument("robot")
@click.argument("command")
@click.argument("parameters", metavar="[ARG]...", nargs=-1)
@_timeout
@connects
def call(
    connection: Connection, robot: str, command: str, parameters: tuple[str, ...], timeout_s: float | None
) -> None:
    """Tell ROBOT a COMMAND and wait for its answer.

    What reads as a number is sent as one. ROBOT is a name, or a PSIU HEXA address such as 0x12. What it understands is
    listed by psiu robots ROBOT.

    The exit code is 0 for sucesso or a value, 1 for falha, 3 if there was no way to the robot or no answer; then one
    line on stderr says why. It is 0 as well where the robot's protocol has no answers and the command was sent. With
    --json: an answer (psiu schema Answer), or a refusal (psiu schema Refusal) whose error is also no_broker where not
    even a broker answered.
    """
    with connection.client() as client:
        answer = client.call(robot, command, _request(parameters, timeout_s))
    if connection.as_json:
        print_json(answer.model_dump(mode="json"))
    else:
        click.echo(answer_line(robot, answer))
    if answer.status == "falha":
        click.get_current_context().exit(FALHA)


@click.command(cls=WordsCommand, epilog=examples("psiu send MNERIM parafrente 100", "psiu send BRACO garra -45"))
@click.argument("robot")
@click.argument("command")
@click.argument("parameters", metavar="[ARG]...", nargs=-1)
@connects
def send(connection: Connection, robot: str, command: str, parameters: tuple[str, ...]) -> None:
    """Tell ROBOT a COMMAND and go on without its answer.

    The exit code is 0 when a broker has taken the command. Whether the robot could be reached is not told: see
    psiu monitor, or use psiu call.
    """
    with connection.client() as client:
        client.put_call(robot, command, _request(parameters))
        # The question goes the same way as the command: once it is answered, the command has arrived.
        if not client.brokers():
            raise connection.nobody()
    if connection.as_json:
        print_json({"sent": True})
    elif on_terminal():
        click.echo(f"{printable(robot)}: sent")


@click.command(epilog=examples("psiu discover", "psiu discover --json | jq '.[] | {robot, link}'"))
@connects
def discover(connection: Connection) -> None:
    """Ask on every link who is there, and each robot what it can do; then list the robots.

    In a pipe the lines are those of psiu robots; with --json: a list of cards (psiu schema Card).
    """
    with connection.client() as client:
        brokers = client.brokers()
        if not brokers:
            raise connection.nobody()
        if sys.stderr.isatty():
            click.echo("Asking on every link who is there…", err=True)
        for broker in brokers:
            client.call(broker.broker, DISCOVER)
        cards = client.cards()
    if connection.as_json:
        print_models(cards)
    else:
        show_robots(cards, drawn=on_terminal())


def answer_line(robot: str, answer: Answer) -> str:
    """``MNERIM: sucesso (2.1 ms)``, ``BRACO: 42 cm (3.0 ms)``, ``MITYA: sent; this robot does not answer (301 ms)``."""
    values = () if answer.status == "falha" and answer.remark else answer.values  # the remark says them in words
    words = [answer.status, *values, answer.unit if values else None]
    said = " ".join(str(word) for word in words if word is not None)
    if answer.remark:
        said = f"{said}: {answer.remark}" if said else answer.remark
    colour = {"sucesso": "green", "falha": "red"}.get(answer.status or "")
    return f"{printable(robot)}: {styled(said or 'answered', fg=colour, bold=True)} ({answer.elapsed_ms:.1f} ms)"


def _request(parameters: tuple[str, ...], timeout_s: float | None = None) -> CallRequest:
    if len(parameters) > _MOST:
        raise CallError("bad_request", f"{len(parameters)} arguments; a call carries {_MOST} at most")
    values: list[Value] = [typed(word) for word in parameters]
    return CallRequest(parameters=values, timeout_s=timeout_s)


_MOST: Final = 64

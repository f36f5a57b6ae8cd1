"""`psiu ping`: asks a robot something harmless, again and again, and tells how long it took to answer."""

import statistics
import sys
import time
from collections.abc import Sequence
from typing import Any, Final

import click

from psiu_broker.bus.client import Client
from psiu_broker.cli.commands import examples
from psiu_broker.cli.connection import Connection, NoWay, connects
from psiu_broker.cli.output import milliseconds, print_line, printable, styled
from psiu_broker.codecs import psiu_ascii, psiu_hexa
from psiu_broker.errors import CallCode, CallError
from psiu_broker.frame import Address
from psiu_broker.messages import CallRequest, Card
from psiu_broker.protocols import PROTOCOLS

_UNASKED: Final[frozenset[CallCode]] = frozenset({"bad_request", "unknown_command", "refused"})
"""Reasons that will not pass."""


@click.command(epilog=examples("psiu ping MNERIM", "psiu ping 0x12 --count 5 --every 0.2", "psiu ping BETA --json"))
@click.argument("robot")
@click.option("--count", type=click.IntRange(1), help="How often; left out: until Ctrl-C.")
@click.option(
    "--every",
    "every_s",
    metavar="SECONDS",
    type=click.FloatRange(0.01, 3600),
    default=1.0,
    show_default=True,
    help="From one question to the next; one waits for the answer to the one before.",
)
@connects
def ping(connection: Connection, robot: str, count: int | None, every_s: float) -> None:
    """Ask ROBOT something harmless every second, and tell how long each answer took.

    PSIU HEXA robots are pinged, PSIU ASCII robots asked how many commands they have, others what moves nothing.
    Nothing is asked twice: silence counts as a loss. At the end, also after Ctrl-C, come the loss and the least, the
    median and the longest time.

    The exit code is 0 if there was an answer, else 3. With --json: a line a question, {"n", "elapsed_ms"} or {"n",
    "error", "message"}, and at the end {"robot", "sent", "answered", "loss", "min_ms", "median_ms", "max_ms"}.
    """
    times: list[float] = []
    sent = 0
    with connection.client() as client:
        question = _question(connection, client, robot)
        try:
            due = time.monotonic()
            while count is None or sent < count:
                time.sleep(max(0.0, due - time.monotonic()))
                due = max(due + every_s, time.monotonic())
                sent += 1
                _ask(connection, client, robot, question, sent, times)
        except KeyboardInterrupt:
            pass
    _show(connection, robot, sent, times)
    if not times:
        raise NoWay(f"{robot} did not answer")


def _question(connection: Connection, client: Client, robot: str) -> str:
    """What to ask the robot; where nobody knows it, what any of its kind would answer."""
    found = client.get_json(client.keys.card(Address.parse(robot)))
    protocols = [Card.model_validate(card).protocol for card in found.values()]
    protocol = next(iter(protocols), psiu_hexa.PROTOCOL if Address.parse(robot).is_numbered else psiu_ascii.PROTOCOL)
    known = PROTOCOLS.get(protocol)
    if known is None or known.profile.harmless is None:
        raise connection.failure("refused", f"{robot} speaks {protocol}, in which nothing can be asked without harm")
    return known.profile.harmless


def _ask(
    connection: Connection, client: Client, robot: str, question: str, number: int, times: list[float]
) -> None:  # fmt: skip
    try:
        took_ms = client.call(robot, question, CallRequest(retries=0)).elapsed_ms
    except CallError as error:
        if error.code in _UNASKED:
            raise
        if connection.as_json:
            print_line({"n": number, "error": error.code, "message": str(error)})
        else:
            click.echo(f"{number} {styled(str(error), fg='red')}")
    else:
        times.append(took_ms)
        if connection.as_json:
            print_line({"n": number, "elapsed_ms": took_ms})
        else:
            click.echo(f"{number} {printable(robot)}: {milliseconds(took_ms)}")
    sys.stdout.flush()


def _show(connection: Connection, robot: str, sent: int, times: Sequence[float]) -> None:
    loss = (sent - len(times)) / sent if sent else 0.0
    least, median, most = (min(times), statistics.median(times), max(times)) if times else (None, None, None)
    if connection.as_json:
        figures: dict[str, Any] = {"min_ms": least, "median_ms": median, "max_ms": most}
        print_line({"robot": robot, "sent": sent, "answered": len(times), "loss": round(loss, 4), **figures})
        return
    took = ""
    if least is not None and median is not None and most is not None:
        took = f"; {milliseconds(least)} least, {milliseconds(median)} median, {milliseconds(most)} longest"
    click.echo(f"{printable(robot)}: {len(times)} of {sent} answered, {loss:.0%} lost{took}")

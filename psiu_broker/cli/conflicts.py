"""`psiu conflicts`: names that more than one robot, or broker, has, and the operator's word on them."""

from collections.abc import Mapping, Sequence
from typing import Any

import click

from psiu_broker.cli.commands import examples
from psiu_broker.cli.connection import Connection, connects
from psiu_broker.cli.output import on_terminal, print_json, print_rows, print_table
from psiu_broker.cli.tables import with_brokers
from psiu_broker.messages import Conflict


@click.command(
    epilog=examples("psiu conflicts", "psiu conflicts --release MNERIM wifi", "psiu conflicts --json | jq '.[].robot'")
)
@click.option(
    "--release",
    nargs=2,
    type=str,
    metavar="ROBOT LINK",
    help="The ROBOT on LINK may have the name: hold it back no longer.",
)
@connects
def conflicts(connection: Connection, release: tuple[str, str] | None) -> None:
    """List the names that more than one robot has, and where.

    Of robots with one name on two links of a broker the newcomer is held back: it is neither listened to nor
    commanded, but for its stops. Rename it, and with --release let it in. Should both go on talking, the other one is
    the newcomer then.

    In a pipe each line has, between tabs: robot, brokers, the link that has the name, links that are held back, frames
    turned away there, since, detail, broker that says so. With --json: a list (psiu schema Conflict).
    """
    with connection.client() as client:
        told = client.ask("conflicts") if release is None else client.ask("release", *release)
        if not told and not client.brokers():
            raise connection.nobody()
    if connection.as_json:
        print_json([{"broker": broker, **each} for broker in sorted(told) for each in told[broker]])
    else:
        show_conflicts(told, drawn=on_terminal())


def show_conflicts(told: Mapping[str, Sequence[Any]], *, drawn: bool) -> None:
    found = [(broker, Conflict.model_validate(each)) for broker in sorted(told) for each in told[broker]]
    if not drawn:
        print_rows(
            (c.robot, " ".join(c.brokers), c.link, " ".join(c.held_back), c.frames, c.since, c.detail, broker)
            for broker, c in found
        )
        return
    heads = ("name", "where", "held back", "since", "what to do")
    rows = [
        (broker, (c.robot, c.link or ", ".join(c.brokers), _held_back(c), c.since, c.detail)) for broker, c in found
    ]
    print_table(*with_brokers(heads, rows), "Every name is one robot's.")


def _held_back(conflict: Conflict) -> str | None:
    if not conflict.held_back:
        return None
    frames = "1 frame" if conflict.frames == 1 else f"{conflict.frames} frames"
    return f"{', '.join(conflict.held_back)} ({frames} turned away)"

"""`psiu conflicts`: names that more than one robot, or broker, has, and the operator's word on them."""

from collections.abc import Sequence

import click

from psiu_broker.cli.commands import examples
from psiu_broker.cli.connection import Connection, connects
from psiu_broker.cli.output import on_terminal, print_rows, print_table
from psiu_broker.cli.tables import ask_each, print_each, with_brokers
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
    if release is not None:
        with connection.client() as client:
            if not client.ask("release", *release):
                client.refuse_where_denied()
    told = ask_each(connection, Conflict, "conflicts")
    if connection.as_json:
        print_each(told)
    else:
        show_conflicts([(broker, conflict) for broker, conflict, _ in told], drawn=on_terminal())


def show_conflicts(found: Sequence[tuple[str, Conflict]], *, drawn: bool) -> None:
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

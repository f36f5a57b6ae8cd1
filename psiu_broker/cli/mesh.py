"""`psiu mesh`: the brokers, what is between them, and who owns whom."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

import click

from psiu_broker.cli import graph
from psiu_broker.cli.commands import Failure, examples
from psiu_broker.cli.connection import Connection, connects
from psiu_broker.cli.mesh_view import Broker, Pair, Robot, Split, View, composed
from psiu_broker.cli.output import (
    Cell,
    ago,
    milliseconds,
    on_terminal,
    print_models,
    print_rows,
    print_table,
    printable,
    styled,
)
from psiu_broker.messages import Conflict, Mesh

_DRAWN: Final[Mapping[str, Callable[[View], str]]] = {".dot": graph.dot, ".svg": graph.svg}
_STDOUT: Final = "-"


def _drawable(ctx: click.Context, param: click.Parameter, name: str | None) -> str | None:
    if name is not None and name != _STDOUT and Path(name).suffix not in _DRAWN:
        raise click.BadParameter(f"{name} must end in {' or '.join(_DRAWN)}, or be - for DOT on the standard output")
    return name


@click.command(
    epilog=examples(
        "psiu mesh",
        "psiu mesh --graph mesh.svg",
        "psiu mesh --graph | dot -Tpng -o mesh.png",
        "psiu mesh --json | jq '.[].conflicts[]'",
    )
)
@click.option(
    "--graph",
    "file",
    metavar="[FILE]",
    is_flag=False,
    flag_value=_STDOUT,
    callback=_drawable,
    help="Draw it: FILE ends in .svg or .dot; none, or -, is DOT on the standard output.",
)
@connects
def mesh(connection: Connection, file: str | None) -> None:
    """List the brokers that form one network, what is between each two of them, and who owns which robot.

    In a pipe each line has, between tabs, one of:

    \b
    broker    name, since, robots, mode, whether it answers, Zenoh id
    link      broker, broker, round trip in ms, frames there, frames back, lost, how
    robot     robot, address, protocol, owner, link, quality, age in s, known to, claimed by
    conflict  robot, brokers, since, detail
    split     broker, seen by, not seen by

    With --json: a list with what each broker sees (psiu schema Mesh).
    """
    if connection.as_json and file is not None:
        raise click.UsageError("--graph and --json exclude each other")
    with connection.client() as client:
        told = [Mesh.model_validate(each) for _, each in sorted(client.ask("mesh").items())]
    if not told:
        raise connection.nobody()
    if connection.as_json:
        print_models(told)
    elif file is not None:
        _draw(composed(told), file)
    else:
        show_mesh(composed(told), drawn=on_terminal())
        for each in told if on_terminal() else ():
            if each.unreadable:
                said = f"{each.broker}: {each.unreadable} beats, notices or announcements could not be read"
                click.echo(styled(f"{said}: is another broker of another version?", fg="red"))


def show_mesh(view: View, *, drawn: bool) -> None:
    if not drawn:
        print_rows(
            [
                *(("broker", b.name, b.since, b.robots, b.mode, b.answers, b.zenoh_id) for b in view.brokers),
                *(("link", p.a, p.b, _rounded(p.rtt_ms), p.a_to_b, p.b_to_a, p.lost, p.how) for p in view.pairs),
                *(("robot", *_robot_row(r)) for r in view.robots),
                *(("conflict", c.robot, " ".join(c.brokers), c.since, c.detail) for c in view.conflicts),
                *(("split", s.broker, " ".join(s.seen_by), " ".join(s.unseen_by)) for s in view.splits),
            ]
        )
        return
    print_table(("broker", "since", "robots", "mode", "answers"), [_broker(each) for each in view.brokers], "")
    click.echo()
    between = ("between", "and", "round trip", "frames →", "frames ←", "lost", "how")
    alone = f"{view.brokers[0].name} is alone: no other broker is connected to it ([mesh] in its configuration)."
    print_table(between, [_pair(each) for each in view.pairs], printable(alone))
    click.echo()
    answering = tuple(each.name for each in view.brokers if each.answers)
    heads = ("robot", "owner", "link", "quality", "heard", "claimed by", "known to")
    rows = [_robot(each, answering) for each in view.robots]
    print_table(heads, rows, "No robot is announced yet. Ask who is there: psiu discover")
    for conflict in view.conflicts:
        click.echo(styled(_conflict(conflict), fg="red"))
    for split in view.splits:
        click.echo(styled(_split(split), fg="red"))


def _draw(view: View, file: str) -> None:
    if file == _STDOUT:
        click.echo(graph.dot(view), nl=False)
        return
    path = Path(file)
    try:
        path.write_text(_DRAWN[path.suffix](view), encoding="utf-8")
    except OSError as error:
        raise Failure(f"{file} cannot be written: {error.strerror}") from error


def _broker(broker: Broker) -> Sequence[Cell]:
    return broker.name, broker.since, broker.robots, broker.mode, broker.answers


def _pair(pair: Pair) -> Sequence[Cell]:
    rtt = None if pair.rtt_ms is None else milliseconds(pair.rtt_ms)
    return pair.a, pair.b, rtt, pair.a_to_b, pair.b_to_a, pair.lost, pair.how


def _robot(robot: Robot, answering: tuple[str, ...]) -> Sequence[Cell]:
    told = robot.told
    name = told.robot if told.address in (None, told.robot) else f"{told.robot} {told.address}"
    heard = "never" if told.age_s is None else ago(told.age_s)
    known_to = "all" if robot.known_to == answering else ", ".join(robot.known_to)
    return name, told.owner, told.link, f"{told.quality:.0%}", heard, ", ".join(robot.claimed_by), known_to


def _robot_row(robot: Robot) -> Sequence[Cell]:
    told = robot.told
    return (
        told.robot, told.address, told.protocol, told.owner, told.link, told.quality, told.age_s,
        " ".join(robot.known_to), " ".join(robot.claimed_by),
    )  # fmt: skip


def _rounded(ms: float | None) -> float | None:
    return None if ms is None else round(ms, 3)


def _conflict(conflict: Conflict) -> str:
    return f"Conflict: {conflict.robot} at {', '.join(conflict.brokers)}: {conflict.detail}."


def _split(split: Split) -> str:
    return (
        f"{split.broker} is seen by {', '.join(split.seen_by)} but not by {', '.join(split.unseen_by)}: "
        "the network between them is cut, or a firewall is in the way."
    )

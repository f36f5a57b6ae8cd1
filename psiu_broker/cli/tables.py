"""What the brokers know: `psiu robots`, `links`, `routes` and `status`."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final, TypeVar

import click
from pydantic import BaseModel, TypeAdapter

from psiu_broker.cli.commands import examples
from psiu_broker.cli.connection import Connection, connects
from psiu_broker.cli.output import (
    Cell,
    ago,
    on_terminal,
    print_json,
    print_models,
    print_rows,
    print_table,
    printable,
    styled,
)
from psiu_broker.messages import Card, Command, Health, Link, Route, Status, Trunk
from psiu_broker.profiles.psiu import QUESTIONS

M = TypeVar("M", bound=BaseModel)

Links = Sequence[tuple[str, Link]]
Routes = Sequence[tuple[str, Route]]
Rows = Sequence[tuple[str, Sequence[Cell]]]


@click.command(
    epilog=examples("psiu robots", "psiu robots MITYA", "psiu robots --json | jq '.[].robot'", "psiu robots | cut -f1")
)
@click.argument("robot", required=False)
@connects
def robots(connection: Connection, robot: str | None) -> None:
    """List the robots that the broker knows, where they are and what they can do.

    In a pipe each line has, between tabs: robot, address, protocol, link, peer, link state, last heard, frames
    heard, commands, broker. With --json: a list of cards (psiu schema Card).

    With a ROBOT, by name or address: its commands, what they take and what they do. In a pipe each line then has:
    command, other names, ints, floats, chars, minimum, maximum, unit, description. With --json: its card.
    """
    with connection.client() as client:
        cards = client.cards()
        if not cards and not client.brokers():
            raise connection.nobody()
    if robot is not None:
        card = next((card for card in cards if robot in (card.robot, card.address)), None)
        if card is None:
            raise connection.failure("unknown_robot", f"no robot {robot} is known; ask who is there: psiu discover")
        if connection.as_json:
            print_json(card.model_dump(mode="json"))
        else:
            show_commands(card, drawn=on_terminal())
    elif connection.as_json:
        print_models(cards)
    else:
        show_robots(cards, drawn=on_terminal())


@click.command(epilog=examples("psiu links", "psiu links --json | jq '.[] | select(.state != \"open\")'"))
@connects
def links(connection: Connection) -> None:
    """List the links, their state, and what those that are not open wait for.

    In a pipe each line has, between tabs: link, adapter, protocol, state, reason, robots, frames in, frames out,
    malformed, queued, times reopened, peers, broker, and how long the last 1000 frames out had waited to leave, p50 and
    p99 in ms. With --json: a list (psiu schema Link).

    On a terminal the trunks to other brokers follow, where there are any; a program gets them from the key
    psiu/@broker/{broker}/trunks (psiu schema Trunk).
    """
    told = ask_each(connection, Link, "links")
    if connection.as_json:
        print_each(told)
        return
    show_links([(broker, link) for broker, link, _ in told], drawn=on_terminal())
    if on_terminal():
        show_trunks([(broker, trunk) for broker, trunk, _ in ask_each(connection, Trunk, "trunks")])


@click.command(epilog=examples("psiu routes", "psiu routes --json"))
@connects
def routes(connection: Connection) -> None:
    """List where frames for each robot go, how that was learned, and when it will be forgotten.

    In a pipe each line has, between tabs: robot, link, peer, origin, age in s, expires in s, broker.
    With --json: a list (psiu schema Route).
    """
    told = ask_each(connection, Route, "routes")
    if connection.as_json:
        print_each(told)
    else:
        show_routes([(broker, route) for broker, route, _ in told])


@click.command(epilog=examples("psiu status", "psiu status --json | jq '.[].healthy'"))
@connects
def status(connection: Connection) -> None:
    """Show how the broker itself is.

    In a pipe each line has, between tabs: broker, version, seconds up, links open, links, robots, healthy, listening
    endpoints, Zenoh id. With --json: a list (psiu schema Status, and Health in the same object).
    """
    with connection.client() as client:
        statuses = client.brokers()
        healths = client.ask("health")
        found = [(each, Health.model_validate(healths.get(each.broker, _UNKNOWN))) for each in statuses]
    if not found:
        raise connection.nobody()
    if connection.as_json:
        print_json([{**each.model_dump(mode="json"), **health.model_dump(mode="json")} for each, health in found])
    else:
        show_status(found)


def show_robots(cards: Sequence[Card], *, drawn: bool) -> None:
    if drawn:
        heads = ("robot", "protocol", "where", "state", "last heard", "commands")
        rows = [(card.broker, _robot(card)) for card in cards]
        print_table(*with_brokers(heads, rows), "No robot is known yet. Ask who is there: psiu discover")
        return
    print_rows(
        (c.robot, c.address, c.protocol, c.link, c.peer, c.link_state, c.last_heard, c.frames_heard,
         " ".join(command.name for command in c.commands), c.broker)
        for c in cards
    )  # fmt: skip


def show_commands(card: Card, *, drawn: bool) -> None:
    """What one robot can be told."""
    if not drawn:
        print_rows(
            (c.name, " ".join(c.aliases), c.ints, c.floats, c.chars, c.minimum, c.maximum, c.unit, c.description)
            for c in card.commands
        )
        return
    name, protocol, where, state, _, _ = _robot(card)
    click.echo(f"{styled(str(name), bold=True)}  {printable(f'{protocol} on {where} ({state})')}")
    heads = ("command", "also", "takes", "what it does")
    rows = [(c.name, " ".join(c.aliases), takes(c), c.description or _told_in(c)) for c in card.commands]
    print_table(heads, rows, "It has told no commands yet. Ask it what it can do: psiu discover")


def takes(command: Command) -> str | None:
    """The parameters of a command for a person: ``-31 to 31, twice``, ``0 to 180 deg``, ``text``; None for none."""
    count = command.ints + command.floats
    span = _span(command.minimum, command.maximum)
    several = {0: "or nothing", 1: "", 2: "twice"}.get(count, f"{count} times")
    numbers = " ".join(filter(None, (span or ("a number" if count else ""), command.unit if span or count else "")))
    if numbers and several:
        numbers = f"{numbers}, {several}"
    texts = {0: "", 1: "text"}.get(command.chars, f"{command.chars} texts")
    return " and ".join(filter(None, (numbers, texts))) or None


def _told_in(command: Command) -> str | None:
    return f"answers in {command.unit}" if command.unit and takes(command) is None else None


def _span(low: int | None, high: int | None) -> str:
    if low is None or high is None:
        return f"from {low}" if low is not None else f"up to {high}" if high is not None else ""
    return str(low) if low == high else f"{low} to {high}"


def show_links(found: Links, *, drawn: bool) -> None:
    if drawn:
        counted = ("robots", "in", "out", "malformed", "queued", "waited ms", "reopened")
        heads = ("link", "adapter", "protocol", "state", *counted)
        rows = [(broker, _link(link)) for broker, link in found]
        nothing = "The broker has no links: add [links.NAME] to its configuration."
        print_table(*with_brokers(heads, rows), nothing)
        for _, link in found:
            if link.reason:
                click.echo(f"{link.name} is {link.state}: {printable(link.reason)}")
            if link.unasked:
                click.echo(f"{link.name}: {link.unasked} questions of its own left unasked, to spare the line")
            if losses := [f"{count} {words}" for what, words in _LOSSES.items() if (count := link.details.get(what))]:
                click.echo(printable(f"{link.name}: {', '.join(losses)}"))
        return
    print_rows(
        (link.name, link.adapter, link.protocol, link.state, link.reason, link.robots, link.frames_in, link.frames_out,
         link.malformed, link.queued, link.reopened, " ".join(link.peers), broker, link.delay_p50_ms, link.delay_p99_ms)
        for broker, link in found
    )  # fmt: skip


def show_trunks(found: Sequence[tuple[str, Trunk]]) -> None:
    """For a reader; nothing where there are none."""
    if not found:
        return
    click.echo()
    heads = ("trunk", "adapter", "state", "far end", "bytes in", "bytes out")
    rows = [(broker, (t.name, t.adapter, t.state, t.far, t.bytes_in, t.bytes_out)) for broker, t in found]
    print_table(*with_brokers(heads, rows), "")
    for _, trunk in found:
        if trunk.reason:
            click.echo(f"trunk {trunk.name} is {trunk.state}: {printable(trunk.reason)}")
        if trunk.overruns:
            click.echo(f"trunk {trunk.name}: Zenoh did not read in time, {trunk.overruns} connections were given up")


def show_routes(found: Routes) -> None:
    if on_terminal():
        heads = ("robot", "where", "origin", "heard", "forgotten in")
        rows = [(broker, _route(route)) for broker, route in found]
        print_table(*with_brokers(heads, rows), "No robot has been heard yet. Ask who is there: psiu discover")
        return
    print_rows((r.robot, r.link, r.peer, r.origin, r.age_s, r.expires_in_s, broker) for broker, r in found)


def show_status(found: Iterable[tuple[Status, Health]]) -> None:
    if not on_terminal():
        rows = [
            (
                s.broker,
                s.version,
                s.uptime_s,
                s.links_open,
                s.links,
                s.robots,
                h.healthy,
                " ".join(s.listen),
                s.zenoh_id,
            )
            for s, h in found
        ]
        print_rows(rows)
        return
    for each, health in found:
        failed = ", ".join(name for name, good in health.checks.items() if not good)
        click.echo(styled(each.broker, bold=True) + f"  psiu-broker {printable(each.version)}")
        click.echo(f"  started {ago(each.uptime_s)}, {each.started.astimezone():%Y-%m-%d %H:%M:%S}")
        click.echo(f"  {each.links_open} of {each.links} links open, {each.robots} robots known")
        click.echo(f"  programs connect to {printable(' '.join(each.listen))}")
        well = styled("healthy", fg="green") if health.healthy else styled(f"not healthy: {failed}", fg="red")
        click.echo(f"  {well}")


_UNKNOWN: Final[Mapping[str, object]] = {"healthy": False, "checks": {"answers": False}}


def ask_each(connection: Connection, model: type[M], *what: str) -> Sequence[tuple[str, M, Any]]:
    """What each broker lists, item by item: the broker, the item, and its JSON, which may say more."""
    with connection.client() as client:
        told = client.ask(*what)
        items = TypeAdapter(list[model])  # type: ignore[valid-type]
        found = [
            (broker, item, raw)
            for broker, raws in sorted(told.items())
            for item, raw in zip(items.validate_python(raws), raws, strict=True)
        ]
    if not told:
        raise connection.nobody()
    return found


def print_each(told: Sequence[tuple[str, Any, Any]]) -> None:
    print_json([{"broker": broker, **each} for broker, _, each in told])


def with_brokers(columns: Sequence[str], rows: Rows) -> tuple[Sequence[str], Sequence[Sequence[Cell]]]:
    """Say in front of every row whose it is, where there are several brokers."""
    if len({broker for broker, _ in rows}) < 2:
        return columns, [row for _, row in rows]
    return ("broker", *columns), [(broker, *row) for broker, row in rows]


def _robot(card: Card) -> Sequence[Cell]:
    where = _where(card.link, card.peer)
    own = [command.name for command in card.commands if command.name not in _EVERYBODYS]
    heard = card.last_heard or "never"
    name = card.robot if card.address in (None, card.robot) else f"{card.robot} {card.address}"
    return name, card.protocol, where, card.link_state, heard, " ".join(own)


def _link(link: Link) -> Sequence[Cell]:
    waited = None if link.delay_p99_ms is None else f"{link.delay_p50_ms or 0:.3g}–{link.delay_p99_ms:.3g}"
    counts = (link.robots, link.frames_in, link.frames_out, link.malformed, link.queued, waited, link.reopened)
    return link.name, link.adapter, link.protocol, link.state, *counts


def _route(route: Route) -> Sequence[Cell]:
    heard = "never" if route.age_s is None else ago(route.age_s)
    rest = None if route.expires_in_s is None else f"{route.expires_in_s:.0f} s"
    return route.robot, _where(route.link, route.peer), route.origin, heard, rest


def _where(link: str, peer: str | None) -> str:
    return link if peer is None else f"{link}/{peer}"


_LOSSES: Final[Mapping[str, str]] = {
    "refused": "datagrams of senders that are not let in",
    "oversized": "datagrams too long to be whole",
    "lost": "datagrams that the broker came too late for",
    "send_errors": "datagrams that the network refused",
    "overruns": "bytes that the serial port lost",
    "buffer_overruns": "bytes for which its driver had no room",
    "frame_errors": "bytes out of step, as with another baud rate",
    "parity_errors": "bytes with a wrong parity",
    "no_room": "packets for which the line had no room",
}
"""What is gone before it is a frame, or after, and so is in no ledger; by its name in `Link.details`."""

_EVERYBODYS: Final = frozenset(command.name for command in QUESTIONS)

"""`psiu ledger`: what became of every frame, link by link or robot by robot, once or as it goes."""

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any, Final

import click
from pydantic import TypeAdapter

from psiu_broker.bus.client import Client
from psiu_broker.cli.commands import Failure, examples
from psiu_broker.cli.connection import Connection, connects
from psiu_broker.cli.output import Cell, on_terminal, print_json, print_line, print_rows, print_table, styled
from psiu_broker.cli.tables import with_brokers
from psiu_broker.messages import Account, Ledger, RobotAccount
from psiu_broker.routing.verdicts import MEANINGS

Ledgers = Sequence[tuple[str, Ledger]]
"""By broker."""
Robots = Sequence[tuple[str, RobotAccount]]
Rates = Mapping[tuple[str, str | None], float]
"""By broker and link, or robot."""

EVERY_S: Final = 1.0
_SUM: Final = "arrived = delivered + answered + dropped + waiting"
_HEADS: Final = ("arrived", "delivered", "answered", "dropped", "waiting", "why dropped")
_TO_THE_TOP: Final = "\x1b[H\x1b[J"
_ROBOTS: Final = TypeAdapter(list[RobotAccount])


@click.command(
    epilog=examples(
        "psiu ledger",
        "psiu ledger --watch",
        "psiu ledger --robots",
        "psiu ledger MNERIM",
        "psiu ledger --json | jq '.[].balances'",
    )
)
@click.argument("robot", required=False)
@click.option("--robots", is_flag=True, help="Robot by robot: of the frames that name it as their sender.")
@click.option("--watch", is_flag=True, help="Again every second, with how many come, until Ctrl-C.")
@connects
def ledger(connection: Connection, robot: str | None, robots: bool, watch: bool) -> None:
    """Show the fate of every frame: arrived = delivered + answered + dropped + waiting.

    In a pipe each line has, between tabs: link, arrived, delivered, answered, dropped, waiting, reasons of the drops,
    broker. With --json: a list with the ledger of each broker (psiu schema Ledger). The exit code is 1 if the books
    do not balance, which are kept for links and for robots apart and have to agree; then a line on stderr says where.

    With --robots or a ROBOT a line has: robot, link, and the rest as above; - for what names nobody. With --json: a
    list (psiu schema RobotAccount). With --watch and --json: each time on one line.
    """
    by_robot = robots or robot is not None
    wrong: list[str] = []
    with connection.client() as client, suppress(KeyboardInterrupt):
        for told, rates in _looks(client, connection, "ledger-of-robots" if by_robot else "ledger", watch=watch):
            if watch and on_terminal() and not connection.as_json:
                click.echo(_TO_THE_TOP, nl=False)
            if by_robot:
                wrong = _tell_robots(connection, told, robot, rates if watch else None)
            else:
                wrong = _tell_links(connection, told, rates if watch else None)
            if wrong and watch:
                _failure(wrong).show()
    if wrong:
        raise _failure(wrong)


def show_ledger(found: Ledgers, *, drawn: bool, rates: Rates | None = None) -> None:
    accounts = [(broker, account) for broker, each in found for account in (*each.accounts, each.total)]
    _show([(broker, (account.link,), account) for broker, account in accounts], ("link",), rates, drawn=drawn)
    if drawn:
        _explain([account for _, account in accounts])
    for broker, each in found if drawn else ():
        if wrong := unbalanced(each):
            click.echo(styled(f"The books of {broker} do NOT balance: {'; '.join(wrong)}.", fg="red"))
        else:
            click.echo(styled(f"The books of {broker} balance: {_SUM}.", fg="green"))


def unbalanced(ledger: Ledger) -> list[str]:
    """What does not add up in the books of one broker; nothing is taken on trust that the figures show."""
    wrong = [each for account in (*ledger.accounts, ledger.total) for each in _off(account.link, account)]
    for what in ("arrived", "delivered", "answered", "waiting"):
        parts, whole = sum(getattr(each, what) for each in ledger.accounts), getattr(ledger.total, what)
        wrong += [] if parts == whole else [f"{parts} {what} by link, {whole} in total"]
    if not wrong and not ledger.balances:
        wrong.append("those of the links and those of the robots do not agree")
    return wrong


def _off(name: str, account: Account | RobotAccount) -> list[str]:
    found = account.delivered + account.answered + sum(account.dropped.values()) + account.waiting
    right = account.arrived == found and account.delivered >= 0
    return [] if right else [f"{name} {account.arrived} arrived, {account.delivered} delivered, {found} in all"]


def _failure(wrong: Sequence[str]) -> Failure:
    return Failure(f"the books of {'; '.join(wrong)} do not balance: please report it")


def show_robots(found: Robots, *, drawn: bool, rates: Rates | None = None) -> None:
    rows = [(broker, (each.robot, each.link), each) for broker, each in found]
    _show(rows, ("robot", "link"), rates, drawn=drawn)
    if drawn:
        _explain([account for _, account in found])


def _looks(
    client: Client, connection: Connection, what: str, *, watch: bool
) -> Iterator[tuple[Mapping[str, Any], Rates]]:
    """What the brokers say, by their names, and how many frames came a second: once, or for ever."""
    before: dict[tuple[str, str | None], int] = {}
    at = 0.0
    while True:
        told = dict(sorted(client.ask(what).items()))
        if not told:
            raise connection.nobody()
        now = time.monotonic()
        counts = {(broker, name): each for broker, value in told.items() for name, each in _arrived(what, value)}
        yield told, {key: (count - before[key]) / (now - at) for key, count in counts.items() if key in before}
        if not watch:
            return
        before, at = counts, now
        time.sleep(EVERY_S)


def _arrived(what: str, value: Any) -> Iterator[tuple[str | None, int]]:
    """How many frames came, by link or robot."""
    if what == "ledger":
        ledger = Ledger.model_validate(value)
        yield from ((each.link, each.arrived) for each in (*ledger.accounts, ledger.total))
    else:
        yield from ((each.robot, each.arrived) for each in _ROBOTS.validate_python(value))


def _tell_links(connection: Connection, told: Mapping[str, Any], rates: Rates | None) -> list[str]:
    """Returns what does not balance."""
    found = [(broker, Ledger.model_validate(each)) for broker, each in told.items()]
    if connection.as_json:
        (print_json if rates is None else print_line)([{"broker": broker, **each} for broker, each in told.items()])
    else:
        show_ledger(found, drawn=on_terminal(), rates=rates)
    return [f"{broker} ({'; '.join(wrong)})" for broker, each in found if (wrong := unbalanced(each))]


def _tell_robots(
    connection: Connection, told: Mapping[str, Any], robot: str | None, rates: Rates | None
) -> list[str]:  # fmt: skip
    """Returns what does not balance."""
    found = [
        (broker, each)
        for broker, accounts in told.items()
        for each in _ROBOTS.validate_python(accounts)
        if robot is None or each.robot == robot
    ]
    if not found:
        raise connection.failure(
            "unknown_robot", f"no frame of {robot} has arrived; who is known: psiu ledger --robots"
        )
    if connection.as_json:
        rows = [{"broker": broker, **each.model_dump(mode="json")} for broker, each in found]
        (print_json if rates is None else print_line)(rows)
    else:
        show_robots(
            sorted(found, key=lambda item: (item[1].robot is None, item[1].robot)), drawn=on_terminal(), rates=rates
        )
    return [f"{broker} ({wrong})" for broker, each in found for wrong in _off(each.robot or "nobody", each)]


def _show(
    rows: Sequence[tuple[str, Sequence[Cell], Account | RobotAccount]],
    heads: Sequence[str],
    rates: Rates | None,
    *,
    drawn: bool,
) -> None:
    if not drawn:
        print_rows((*names, *_cells(account), broker) for broker, names, account in rows)
        return
    watched = () if rates is None else ("a second",)
    told = [(broker, (*names, *_rate(rates, broker, names), *_cells(account))) for broker, names, account in rows]
    print_table(*with_brokers((*heads, *watched, *_HEADS), told), "No frame has arrived yet.")


def _explain(accounts: Sequence[Account | RobotAccount]) -> None:
    """Say in words why anything was dropped that was."""
    reasons = {reason for account in accounts for reason, count in account.dropped.items() if count}
    for verdict, meaning in MEANINGS.items():
        if verdict in reasons:
            click.echo(f"{verdict}: {meaning}")


def _rate(rates: Rates | None, broker: str, names: Sequence[Cell]) -> Sequence[Cell]:
    if rates is None:
        return ()
    name = names[0]
    return (round(rates.get((broker, None if name is None else str(name)), 0.0)),)


def _cells(account: Account | RobotAccount) -> Sequence[Cell]:
    reasons = " ".join(f"{reason}={count}" for reason, count in account.dropped.items())
    dropped = sum(account.dropped.values())
    return account.arrived, account.delivered, account.answered, dropped, account.waiting, reasons

"""What the commands print: tables on a terminal, one line a row with tabs in a pipe, JSON on request."""

import json
import os
import sys
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from typing import Any, Final

import click
from pydantic import BaseModel
from rich.console import Console
from rich.table import Table
from rich.text import Text

Cell = str | int | float | bool | datetime | None

_PAPER_COLUMNS: Final = 110
_STYLES: Final = {
    "open": "green", "opening": "yellow", "waiting": "yellow", "closed": "red",
    "yes": "green", "no": "red",
    "sucesso": "green", "falha": "red",
}  # fmt: skip


def on_terminal() -> bool:
    return sys.stdout.isatty()


def print_json(value: Any) -> None:
    """One JSON value: indented for a reader at a terminal, else on one line."""
    click.echo(json.dumps(value, ensure_ascii=False, indent=2 if on_terminal() else None))


def print_models(models: Iterable[BaseModel]) -> None:
    """A JSON list, as `print_json`."""
    print_json([model.model_dump(mode="json") for model in models])


def print_line(value: Any) -> None:
    """One JSON value on a line of its own: for what comes one by one."""
    click.echo(json.dumps(value, ensure_ascii=False))


def print_rows(rows: Iterable[Sequence[Cell]]) -> None:
    """Each row on a line, with tabs: for programs."""
    for row in rows:
        click.echo("\t".join(plain(cell) for cell in row))


def print_table(columns: Sequence[str], rows: Sequence[Sequence[Cell]], nothing: str) -> None:
    """`rows` under the heads `columns` for a reader, or `nothing` where there are none. The last column may wrap."""
    if not rows:
        click.echo(nothing)
        return
    table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    for index, column in enumerate(columns):
        numbers = any(type(row[index]) in (int, float) for row in rows)
        last = index == len(columns) - 1
        table.add_column(column, justify="right" if numbers else "left", no_wrap=not last, overflow="fold")
    for row in rows:
        table.add_row(*(_text(cell) for cell in row))
    Console(highlight=False, width=None if on_terminal() else _PAPER_COLUMNS).print(table)


def plain(cell: Cell) -> str:
    """A cell for programs: ``-`` for nothing, times in UTC."""
    if cell is None or cell == "":
        return "-"
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    if isinstance(cell, datetime):
        return cell.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
    return printable(str(cell))


def printable(text: str) -> str:
    """`text` on one line and without what would command a terminal."""
    return "".join(char if char.isprintable() else repr(char)[1:-1] for char in text)


def ago(seconds: float) -> str:
    """How long ago, for a person: ``3 s ago``."""
    for unit, length_s in (("d", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * length_s:
            return f"{seconds / length_s:.0f} {unit} ago"
    return f"{seconds:.0f} s ago" if seconds >= 1 else "now"


def milliseconds(ms: float) -> str:
    """A duration for a person: ``0.42 ms``, ``7.1 ms``, ``120 ms``."""
    return f"{ms:.{2 if ms < 1 else 1 if ms < 100 else 0}f} ms"


def styled(text: str, **style: Any) -> str:
    """`printable` text, in a colour where there is a terminal whose user wants colours."""
    text = printable(text)
    return click.style(text, **style) if on_terminal() and not os.environ.get("NO_COLOR") else text


def _text(cell: Cell) -> Text:
    if isinstance(cell, datetime):
        return Text(ago((datetime.now(UTC) - cell).total_seconds()))
    text = plain(cell)
    return Text(text, style=_STYLES.get(text, ""))

"""What each fault cost, printed as a table once all are over."""

from collections.abc import Callable

import pytest
from system.faults.ends import ENDS
from system.faults.matrix import ROWS

MEASURED: dict[tuple[str, str], float] = {}
WIDTH = 32


@pytest.fixture
def measured() -> Callable[[str, str, float], None]:
    """To be told the row, the link and the seconds."""

    def note(row: str, kind: str, seconds: float) -> None:
        MEASURED[row, kind] = seconds

    return note


def table() -> str:
    lines = [f"{'seconds until it answers again':{WIDTH}}" + "".join(f"{kind:>9}" for kind in ENDS)]
    for row in ROWS:
        cells = [_cell(row.name, kind) if kind in row.kinds else "–" for kind in ENDS]
        why_not = f"  – {row.why_not}" if row.why_not else ""
        lines.append(f"{row.name:{WIDTH}}" + "".join(f"{cell:>9}" for cell in cells) + why_not)
    return "\n".join(lines)


def _cell(row: str, kind: str) -> str:
    seconds = MEASURED.get((row, kind))
    return "?" if seconds is None else f"{seconds:.2f}"


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    if MEASURED and terminalreporter.config.option.capture == "no":
        terminalreporter.write_line("")
        terminalreporter.write_line(table())

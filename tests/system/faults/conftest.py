"""What each fault cost, printed as a table once all are over."""

import os
from collections.abc import Callable

import pytest
from system.faults.ends import ENDS
from system.faults.matrix import ROWS

MEASURED: dict[tuple[str, str], float] = {}
WIDTH = 32
ABOUT = (
    "Each fault ended, and so many seconds later MNERIM, on the link that had it, answered a call again without help.",
    "After each the books balanced, memory and descriptors were back, and robots on two other links had lost nothing.",
    "By RFCOMM, BlueZ was a mock that hands over sockets. On UDP, MNERIM spoke every 0.2 s.",
)


@pytest.fixture
def measured() -> Callable[[str, str, float], None]:
    """To be told the row, the link and the seconds."""

    def note(row: str, kind: str, seconds: float) -> None:
        MEASURED[row, kind] = seconds

    return note


def table() -> str:
    lines = [*ABOUT, f"{os.cpu_count()} processors, load {os.getloadavg()[1]:.0f}.", ""]
    lines += [f"{'seconds until it answers again':{WIDTH}}" + "".join(f"{kind:>9}" for kind in ENDS)]
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

"""After every fault traffic flows again without help, nothing is left over, and other links noticed nothing.

`make faults` has each fault befall each kind of link, and prints how long that took; a usual run has some of them.
"""

import contextlib
import os
import re
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import pytest
from mocked_bluez import MISSING, PAIRED, mocked
from system.faults.conftest import table
from system.faults.ends import ENDS, Kind, at_another_rate
from system.faults.lab import Lab, SteppedClock, small_disk
from system.faults.matrix import ROWS, Row, Trouble, absent_at_start, clock_steps, disk_full

TREE: Final = Path(__file__).parents[3]
ALL: Final = bool(os.environ.get("PSIU_FAULTS"))

pytestmark = [
    pytest.mark.timeout(400),
    pytest.mark.skipif(sys.platform != "linux", reason="ptys, signals and limits as Linux has them"),
]


def cells() -> Iterator[object]:
    for row in ROWS:
        for kind in row.kinds if ALL else row.usual:
            yield pytest.param(row, kind, id=f"{row.name}-{kind}")


@pytest.mark.parametrize(("row", "kind"), list(cells()))
async def test_after_a_fault_all_is_as_before(
    row: Row,
    kind: Kind,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    measured: Callable[[str, str, float], None],
) -> None:
    if kind == "rfcomm" and MISSING:
        pytest.skip(MISSING)
    if row.happens is disk_full and os.geteuid() != 0:
        pytest.skip("only root can mount a small file system of the test's own")
    async with contextlib.AsyncExitStack() as stack:
        bluetooth = None
        if kind == "rfcomm":
            bluetooth = await stack.enter_async_context(mocked(tmp_path, monkeypatch))
            await bluetooth.start(known=PAIRED)
        end = ENDS[kind](tmp_path if bluetooth is None else bluetooth.folder, row.faults)
        lab = Lab(tmp_path, end)
        clock = SteppedClock(lab.base, tmp_path / "clock") if row.happens is clock_steps else None
        if row.happens is disk_full:
            disk = tmp_path / "disk"
            disk.mkdir()
            stack.enter_context(small_disk(disk))
            lab.base.log = disk / "log"
            lab.base.environment["TMPDIR"] = str(disk)
        async with lab.running(absent=row.happens is absent_at_start):
            over = await row.happens(Trouble(lab, bluetooth, clock))
            await lab.base.answered()
            took_s = time.monotonic() - over if lab.recovered_s is None else lab.recovered_s
        measured(row.name, kind, took_s)
        print(f"{row.name}, {kind}: answers again after {took_s:.2f} s")


def test_each_row_says_what_it_cannot_befall() -> None:
    assert all(bool(row.why_not) == (len(row.kinds) < len(ENDS)) for row in ROWS)
    assert all(set(row.usual) <= set(row.kinds) for row in ROWS)


@pytest.mark.parametrize("name", ["README.md", "README.pt-BR.md"])
def test_the_table_of_the_readme_is_the_one_that_is_printed(name: str) -> None:
    told = re.search(r"<!-- faults -->\n\n```text\n(.*?)\n```", (TREE / name).read_text(), re.DOTALL)
    assert told is not None
    assert in_kind(told[1]) == in_kind(table())
    assert "?" not in told[1], "a fault was not measured"


def in_kind(table: str) -> str:
    """A table whatever was measured, and where."""
    return re.sub(r"(?m)^\d+ processors, load \d+", "# processors", re.sub(r" +(?:\d+\.\d\d|\?)(?=\s|$)", " #", table))


def test_a_wrong_rate_leaves_nothing_to_read() -> None:
    assert at_another_rate(b"psiu", 9600, 9600) == b"psiu"
    assert b"psiu" not in at_another_rate(b"psiu psiu psiu")
    assert at_another_rate(b"psiu psiu psiu")

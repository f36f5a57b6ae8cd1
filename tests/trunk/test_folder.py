"""A folder that does not outlive its broker for long, however that ended."""

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from psiu_broker.trunk import folder
from psiu_broker.trunk.folder import PREFIX, Folder

HOLD = """
import tempfile, time
from psiu_broker.trunk.folder import Folder
from psiu_broker.trunk import folder
tempfile.tempdir = {!r}
folder.PARENT_MAX = 1000
folder = Folder.make()
(folder.path / "session").touch()
print(folder.path, flush=True)
time.sleep(60)
"""


@pytest.fixture
def parent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (parent := tmp_path / "t").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(parent))
    monkeypatch.setattr(folder, "PARENT_MAX", 1000)
    return parent


def make() -> Folder:
    made = Folder.make()
    assert made is not None
    return made


def test_what_a_killed_broker_left_is_removed_by_the_next_one_and_not_while_it_lives(parent: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", HOLD.format(str(parent))], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        left = Path(process.stdout.readline().strip())
        make().remove()
        assert (left / "session").exists()
        process.send_signal(signal.SIGKILL)
    assert left.exists()
    make().remove()
    assert not left.exists()


def test_a_folder_in_use_is_left_alone_in_the_same_process_too(parent: Path) -> None:
    first, second = make(), make()
    assert first.path.exists()
    assert first.path != second.path
    first.remove()
    second.remove()


def test_what_only_has_the_name_is_left_alone(parent: Path) -> None:
    (file := parent / f"{PREFIX}file").touch()
    (elsewhere := parent / "elsewhere").mkdir()
    (link := parent / f"{PREFIX}link").symlink_to(elsewhere)
    os.mkfifo(fifo := parent / f"{PREFIX}fifo")
    make().remove()
    assert sorted(parent.iterdir()) == sorted([file, elsewhere, link, fifo])
    for each in (file, link, fifo):
        each.unlink()
    elsewhere.rmdir()

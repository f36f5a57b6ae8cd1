"""The folder in which the trunks of a broker meet its session."""

import stat
import tempfile
from pathlib import Path

import pytest
from memory_adapter import MemoryAdapter

from psiu_broker.config import TrunkConfiguration
from psiu_broker.trunk import Endpoints, Trunks


@pytest.fixture
def trunks() -> Trunks:
    return Trunks("base", [TrunkConfiguration(name, "memory", MemoryAdapter()) for name in ("hill", "x" * 200)])


def path(endpoint: str) -> Path:
    protocol, _, path = endpoint.partition("/")
    assert protocol == "unixsock-stream"
    return Path(path)


def test_each_session_meets_the_trunks_in_a_new_folder_that_others_cannot_enter(trunks: Trunks) -> None:
    folders = []
    for _ in range(2):
        listen, connect = trunks.meet()
        (folder,) = {path(endpoint).parent for endpoint in (*listen, *connect)}
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
        assert (len(listen), len(set(connect))) == (1, 2)
        folders.append(folder)
    assert folders[0] != folders[1]
    assert not folders[0].exists()
    trunks.close()
    assert not folders[1].exists()


def test_a_path_is_never_too_long_for_a_socket(trunks: Trunks, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (long := tmp_path / ("x" * 100)).mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(long))
    listen, connect = trunks.meet()
    assert max(len(str(path(endpoint))) for endpoint in (*listen, *connect)) <= 107
    trunks.close()


def test_without_a_folder_the_broker_goes_on_without_trunks(
    trunks: Trunks, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", "/nowhere")
    assert trunks.meet() == Endpoints()
    assert "the trunks cannot meet Zenoh" in caplog.text
    trunks.close()


def test_without_trunks_there_is_nothing() -> None:
    trunks = Trunks("base", [])
    assert trunks.meet() == Endpoints()
    trunks.close()

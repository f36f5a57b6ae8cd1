"""The daemon as a person and as systemd start and stop it."""

import json
import logging
import os
import re
import signal
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result

from psiu_broker.bus.client import Client
from psiu_broker.cli.logs import JournalFormatter, LineFormatter

Run = Callable[..., Result]
Start = Callable[..., Any]

EXAMPLE = Path(__file__).parents[2] / "deploy/examples/psiu-broker.toml"


@pytest.fixture
def file(tmp_path: Path, bus_port: int) -> Path:
    """A configuration with one link whose device is not there."""
    file = tmp_path / "psiu-broker.toml"
    file.write_text(
        f'[broker]\nname = "base"\n[zenoh]\nlisten = ["tcp/127.0.0.1:{bus_port}"]\n'
        f'[links.radio]\nadapter = "serial"\ndevice = "{tmp_path}/none"\nprotocol = "psiu-ascii"\n'
    )
    return file


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_cleanly(start: Start, file: Path, number: signal.Signals) -> None:
    broker = start("psiu-broker", "run", "--config", file)
    broker.until("base is ready: programs connect to tcp/127.0.0.1:")
    broker.signal(number)
    assert broker.ended() == 0
    assert broker.err[-1].endswith("INFO base has stopped")
    assert broker.out == []


@pytest.mark.parametrize("second", [signal.SIGTERM, signal.SIGINT])
def test_a_second_signal_ends_it_at_once(start: Start, file: Path, second: signal.Signals) -> None:
    broker = start("psiu-broker", "run", "--config", file)
    broker.until("is ready")
    # Stopped meanwhile, so that both are there before it can end by the first.
    broker.signal(signal.SIGSTOP)
    broker.signal(signal.SIGTERM if second is signal.SIGINT else signal.SIGINT)
    broker.signal(second)
    broker.signal(signal.SIGCONT)
    assert broker.ended() == 130
    assert "stopped" not in broker.err[-1]


def test_a_lost_device_does_not_keep_it_from_being_ready(start: Start, file: Path) -> None:
    broker = start("psiu-broker", "run", "--config", file)
    broker.until("is ready")
    broker.until(r"INFO link radio: waiting: .*none")


def test_each_record_is_one_line_with_its_time_and_level(start: Start, file: Path) -> None:
    broker = start("psiu-broker", "run", "--config", file)
    broker.until("is ready")
    broker.signal(signal.SIGTERM)
    broker.ended()
    for line in broker.err:
        assert re.match(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d\.\d{3} (INFO|WARNING) \S", line), line


def test_the_journal_gets_priorities_and_no_times(start: Start, file: Path) -> None:
    reading, writing = os.pipe()
    stream = os.fstat(writing)
    broker = start(
        "psiu-broker", "run", "--config", file,
        env={"JOURNAL_STREAM": f"{stream.st_dev}:{stream.st_ino}"}, stderr=writing,
    )  # fmt: skip
    os.close(writing)
    with open(reading, encoding="utf-8") as journal:  # noqa: PTH123
        assert re.match(r"<6>psiu-broker \S+: base starts", journal.readline())
        while "is ready" not in journal.readline():
            pass
        broker.signal(signal.SIGTERM)
        assert all(re.match(r"<[3-7]>\S", line) for line in journal)


def test_another_stream_than_the_journal_keeps_its_times(start: Start, file: Path) -> None:
    broker = start("psiu-broker", "run", "--config", file, env={"JOURNAL_STREAM": "1:2"})
    assert re.match(r"\d{4}-", broker.until("starts"))


def test_quiet_logs_warnings_only(start: Start, file: Path, tmp_path: Path, bus_port: int) -> None:
    text = file.read_text()
    file.write_text(text.replace(f"{tmp_path}/none", "/dev/ttyUSB77"))
    quiet = start("psiu-broker", "run", "--config", file, "-q")
    assert "WARNING" in quiet.until("may be another device after the next plug-in")
    with Client([f"tcp/127.0.0.1:{bus_port}"]) as client:
        while not client.brokers():  # it gets ready, and says nothing of it
            pass
    quiet.signal(signal.SIGTERM)
    assert quiet.ended() == 0
    assert not any("INFO" in line for line in quiet.err)


def test_quiet_and_verbose_at_once_are_refused(daemon: Run, file: Path) -> None:
    assert daemon("run", "--config", str(file), "-q", "-v").exit_code == 2


def test_a_traceback_stays_on_one_line() -> None:
    try:
        int("two\nlines")
    except ValueError:
        record = logging.LogRecord("x", logging.ERROR, "", 0, "link %s:\nfailed", ("radio",), sys.exc_info())
    for formatter in (LineFormatter(), JournalFormatter()):
        line = formatter.format(record)
        assert "\n" not in line
        assert "link radio: | failed | Traceback" in line
        assert "ValueError: invalid literal" in line
    assert line.startswith("<3>link radio")


def test_the_service_manager_hears_ready_alive_and_stopping(start: Start, file: Path, tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(20)
        environment = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "400000"}
        broker = start("psiu-broker", "run", "--config", file, env=environment)
        assert manager.recv(4096) == b"READY=1\nSTATUS=0 of 1 links open, 0 robots known"
        assert [manager.recv(4096) for _ in range(2)] == [b"WATCHDOG=1"] * 2
        broker.signal(signal.SIGTERM)
        last = b""
        while last != b"STOPPING=1":
            last = manager.recv(4096)
        assert broker.ended() == 0


def test_a_port_in_use_is_one_line_and_exit_code_1(start: Start, lab: Any) -> None:
    second = start("psiu-broker", "run", "--config", lab.file, "-q")
    assert second.ended() == 1
    assert len(second.err) == 1
    assert second.err[0].startswith("psiu-broker: zenoh.listen: tcp/127.0.0.1:")
    assert "in use" in second.err[0]


def test_a_call_under_way_is_told_that_the_broker_stops(start: Start, tmp_path: Path, bus_port: int) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as silent:
        silent.bind(("127.0.0.1", 0))
        silent.settimeout(10)
        peer = f"127.0.0.1:{silent.getsockname()[1]}"
        file = tmp_path / "one.toml"
        file.write_text(
            f'[broker]\nname = "base"\n[zenoh]\nlisten = ["tcp/127.0.0.1:{bus_port}"]\n'
            f'[links.wifi]\nadapter = "udp"\nlisten = "127.0.0.1:0"\npeers = ["{peer}"]\nprotocol = "psiu-ascii"\n'
            f'greet = false\n[robots.MUDO]\nlink = "wifi"\npeer = "{peer}"\n'
        )
        broker = start("psiu-broker", "run", "--config", file)
        broker.until("wifi: open")
        endpoint = f"tcp/127.0.0.1:{bus_port}"
        call = start("psiu", "call", "MUDO", "parafrente", "1", "--json", "--connect", endpoint)
        assert b"parafrente 1" in silent.recv(1024)
        broker.signal(signal.SIGTERM)
        assert call.ended() == 3
        assert json.loads(call.out[0])["error"] == "shutting_down"
        assert broker.ended() == 0


@pytest.mark.parametrize("words", [("run", "--config"), ("check",)])
def test_each_mistake_of_the_configuration_is_a_line_and_the_exit_code_78(
    daemon: Run, tmp_path: Path, words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("psiu_broker.cli.run.log_to_stderr", lambda level: None)
    file = tmp_path / "wrong.toml"
    file.write_text(EXAMPLE.read_text().replace("baudrate", "bauds").replace("psiu-hexa", "psiu-hex"))
    refused = daemon(*words, str(file))
    assert (refused.exit_code, refused.stdout) == (78, "")
    lines = refused.stderr.splitlines()
    assert all(line.startswith(f"{file}: links.") for line in lines)
    assert any("links.radio.bauds" in line and "did you mean baudrate?" in line for line in lines)
    assert any("links.arm.protocol" in line for line in lines)
    missing = daemon(*words, str(tmp_path / "none.toml"))
    assert (missing.exit_code, len(missing.stderr.splitlines())) == (78, 1)


def test_a_good_configuration_is_counted_and_its_warnings_told(daemon: Run, tmp_path: Path) -> None:
    good = daemon("check", str(EXAMPLE))
    assert (good.exit_code, good.stdout, good.stderr) == (0, f"{EXAMPLE}: good: 3 links, 1 robot\n", "")
    file = tmp_path / "open.toml"
    text = EXAMPLE.read_text().replace("127.0.0.1:7447", "0.0.0.0:7447")
    file.write_text(text.replace("[zenoh]", "[zenoh]\nunprotected = true"))
    risky = daemon("check", str(file))
    assert risky.exit_code == 0
    assert risky.stderr.startswith("warning: ")
    assert "zenoh.listen" in risky.stderr

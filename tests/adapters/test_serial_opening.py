"""Serial ports that open, and why others do not."""

import asyncio
import errno
import logging
import os
import re
import sys
import termios
import time
from asyncio.subprocess import PIPE
from pathlib import Path

import pytest
import serial
from adapter_contract import PATIENCE_S, Recorder, held, no_more_than
from pty_robot import Pty
from pydantic import ValidationError

from psiu_adapters.serial import Serial
from psiu_adapters.serial_faults import explain
from psiu_broker.errors import LinkAbsent, LinkBusy, LinkError

LOCK_PORT = """
import serial, sys
port = serial.Serial(sys.argv[1], exclusive=True)
print("held", flush=True)
sys.stdin.read()
port.close()
"""


class TestOpening:
    async def test_a_missing_device_is_waited_for(self, recorder: Recorder) -> None:
        with pytest.raises(LinkAbsent, match=r"^/dev/ttyUSB93: no such device; waiting for it$"):
            await Serial(device="/dev/ttyUSB93").open(recorder)

    async def test_a_by_id_link_that_leads_nowhere_is_waited_for(self, tmp_path: Path, recorder: Recorder) -> None:
        link = tmp_path / "usb-FTDI"
        link.symlink_to("/dev/ttyUSB93")
        with pytest.raises(LinkAbsent, match=r"usb-FTDI: its device is gone; waiting for it$"):
            await Serial(device=str(link)).open(recorder)

    async def test_an_unknown_usb_id_is_waited_for(self, recorder: Recorder) -> None:
        with pytest.raises(LinkAbsent, match=r"^dead:beef:A5XK3RJT: no such USB device; waiting for it$"):
            await Serial(device="dead:beef:A5XK3RJT").open(recorder)

    async def test_another_process_that_holds_the_port_is_named(self, pty: Pty, recorder: Recorder) -> None:
        holder = await asyncio.create_subprocess_exec(
            sys.executable, "-c", LOCK_PORT, str(pty.link), stdin=PIPE, stdout=PIPE
        )
        assert holder.stdin is not None
        assert holder.stdout is not None
        assert await holder.stdout.readline() == b"held\n"
        with pytest.raises(LinkBusy, match=rf"held by another process \(pid {holder.pid}, python"):
            await pty.adapter.open(recorder)
        holder.stdin.close()
        await holder.wait()
        await (await pty.adapter.open(recorder)).close()

    async def test_another_process_that_does_not_lock_is_shown_in_the_status(
        self, pty: Pty, recorder: Recorder
    ) -> None:
        with pty.link.open("rb") as port:
            other = await asyncio.create_subprocess_exec("/bin/cat", stdin=port)
        transport = await pty.adapter.open(recorder)
        assert transport.status()["also_open_in"] == f"pid {other.pid}, cat"
        await transport.close()
        other.kill()
        await other.wait()

    async def test_a_second_link_on_the_same_port_is_refused_and_says_so(self, pty: Pty, recorder: Recorder) -> None:
        transport = await pty.adapter.open(recorder)
        with pytest.raises(LinkBusy, match="another link of this broker"):
            await pty.adapter.open(recorder)
        await transport.close()

    async def test_a_file_that_is_no_serial_port_is_named_so(self, tmp_path: Path, recorder: Recorder) -> None:
        (tmp_path / "file").write_bytes(b"")
        with pytest.raises(LinkError, match=r"file: not a serial port$"):
            await Serial(device=str(tmp_path / "file")).open(recorder)

    @pytest.mark.parametrize("baudrate", [2000, 9600, 57600, 250_000, 4_000_000])
    async def test_odd_baud_rates_open(self, tmp_path: Path, recorder: Recorder, baudrate: int) -> None:
        far = Pty(tmp_path / "odd", baudrate=baudrate)
        await (await far.adapter.open(recorder)).close()
        far.unplug()

    async def test_a_rate_that_the_driver_changes_is_refused_by_name(
        self, pty: Pty, recorder: Recorder, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("psiu_adapters.serial._actual_baudrate", lambda _: 38400)
        before = held()
        with pytest.raises(LinkError, match=r"its driver refuses 9600 baud \(it set 38400\)$"):
            await pty.adapter.open(recorder)
        await no_more_than(before)

    def test_a_rate_that_the_driver_rejects_is_named(self) -> None:
        error = ValueError("Failed to set custom baud rate (2000): [Errno 22] Invalid argument")
        error.__context__ = OSError(errno.EINVAL, "Invalid argument")
        assert str(explain("/dev/ttyS9", "/dev/ttyS9", 2000, error)) == "/dev/ttyS9: its driver refuses 2000 baud"

    def test_a_port_that_is_only_for_a_group_names_the_group(self, tmp_path: Path) -> None:
        device = tmp_path / "ttyUSB0"
        device.touch()
        os.chown(device, 0, 20)
        device.chmod(0o660)
        error = serial.SerialException(errno.EACCES, "Permission denied")
        explained = explain(str(device), str(device), 9600, error)
        assert isinstance(explained, LinkBusy)
        assert "permission denied; only group dialout may open it" in str(explained)
        device.chmod(0o600)
        assert "not opened to its group yet" in str(explain(str(device), str(device), 9600, error))

    async def test_a_bare_number_is_warned_about(
        self, tmp_path: Path, recorder: Recorder, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        far = Pty(tmp_path / "ttyUSB0")
        monkeypatch.setattr("psiu_adapters.serial.BARE_NAME", re.compile(r".*/ttyUSB\d+"))
        with caplog.at_level(logging.WARNING):
            transport = await far.adapter.open(recorder)
        assert "/dev/serial/by-id/" in str(transport.status()["hint"])
        assert [record.levelname for record in caplog.records] == ["WARNING"]
        await transport.close()
        far.unplug()

    async def test_the_status_names_the_device_behind_the_link(self, pty: Pty, recorder: Recorder) -> None:
        transport = await pty.adapter.open(recorder)
        assert transport.status() == {"device": str(pty.link.readlink())}
        await transport.close()

    async def test_nothing_is_received_before_the_board_has_started(self, tmp_path: Path, recorder: Recorder) -> None:
        far = Pty(tmp_path / "board", open_delay_s=0.1)
        began = time.monotonic()
        transport = await far.adapter.open(recorder)
        assert time.monotonic() - began >= 0.1
        await transport.close()
        far.unplug()

    async def test_cancelling_while_the_board_starts_releases_the_port(
        self, tmp_path: Path, recorder: Recorder
    ) -> None:
        far = Pty(tmp_path / "board", open_delay_s=60)
        before = held()
        opening = asyncio.create_task(far.adapter.open(recorder))
        async with asyncio.timeout(PATIENCE_S):
            while held() == before:  # noqa: ASYNC110 — a thread opens it
                await asyncio.sleep(0.01)
        opening.cancel()
        with pytest.raises(asyncio.CancelledError):
            await opening
        await no_more_than(before)
        far.unplug()

    @pytest.mark.parametrize(
        "wrong",
        [{"baudrate": 0}, {"baudrate": "fast"}, {"parity": "N"}, {"stopbits": 3}, {"device": ""}, {"open_delay_s": -1}],
    )
    def test_wrong_options_are_refused(self, wrong: dict[str, object]) -> None:
        with pytest.raises(ValidationError):
            Serial(**{"device": "/dev/null", **wrong})  # type: ignore[arg-type]


class TestSettings:
    async def test_data_bits_parity_and_stop_bits_reach_the_port(self, tmp_path: Path, recorder: Recorder) -> None:
        far = Pty(tmp_path / "odd", parity="odd", stopbits=2, baudrate=19200)
        transport = await far.adapter.open(recorder)
        _, _, flags, _, speed, _, _ = termios.tcgetattr(far.master)
        assert flags & termios.PARODD
        assert flags & termios.CSTOPB
        assert speed == termios.B19200
        await transport.close()
        far.unplug()

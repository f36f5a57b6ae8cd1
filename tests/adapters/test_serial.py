"""The serial adapter on ptys: closing the master looks to the kernel like pulling the plug."""

import asyncio
import errno
import fcntl
import logging
import os
import re
import socket
import sys
import termios
import threading
import time
import tty
from asyncio.subprocess import PIPE
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import serial
from adapter_contract import FRAME, PATIENCE_S, AdapterContract, FarEnd, Recorder, descriptors_become, open_descriptors
from pydantic import ValidationError

from psiu_adapters.serial import Serial
from psiu_adapters.serial_faults import explain
from psiu_broker.adapter import Adapter
from psiu_broker.errors import LinkAbsent, LinkBusy, LinkError

LOCK_PORT = """
import serial, sys
port = serial.Serial(sys.argv[1], exclusive=True)
print("held", flush=True)
sys.stdin.read()
port.close()
"""


class Pty(FarEnd):
    """A robot on a pty, plugged in at `link` as a by-id name is."""

    def __init__(self, link: Path, **options: object) -> None:
        self.link = link
        self.plug_in()
        self.adapter = Serial(device=str(link), **{"pace": False, **options})  # type: ignore[arg-type]

    def plug_in(self) -> None:
        self.master, slave = os.openpty()
        tty.setraw(slave)
        self.link.symlink_to(os.ttyname(slave))
        os.close(slave)
        os.set_blocking(self.master, False)

    def unplug(self) -> None:
        if self.master >= 0:
            os.close(self.master)
            self.master = -1
            self.link.unlink()

    async def say(self, data: bytes) -> None:
        assert os.write(self.master, data) == len(data)

    async def heard(self, size: int) -> bytes:
        loop = asyncio.get_running_loop()
        data = b""
        async with asyncio.timeout(PATIENCE_S):
            while len(data) < size:
                ready = asyncio.Event()
                loop.add_reader(self.master, ready.set)
                try:
                    await ready.wait()
                finally:
                    loop.remove_reader(self.master)
                data += os.read(self.master, size - len(data))
        return data

    async def vanish(self) -> None:
        self.unplug()


class FakeUdev(ModuleType):
    """The part of pyudev that is used, its events told by the test: no udev runs where tests do."""

    def __init__(self) -> None:
        super().__init__("pyudev")
        self.ends: list[socket.socket] = []
        self.Context = object
        self.Monitor = self

    def from_netlink(self, _context: object, *, source: str) -> "FakeMonitor":
        assert source == "udev", "the kernel's events come before udev has set owner and links"
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.ends.append(ours)
        return FakeMonitor(theirs)

    def tell(self, action: str, node: str) -> None:
        for end in self.ends:
            with suppress(BrokenPipeError):
                end.send(f"{action} {node}".encode())

    def close(self) -> None:
        for end in self.ends:
            end.close()


class FakeMonitor:
    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        self.end = end
        self.fileno = end.fileno

    def __del__(self) -> None:
        self.end.close()

    def filter_by(self, subsystem: str) -> None:
        assert subsystem == "tty"

    def start(self) -> None:
        pass

    def poll(self, timeout: float) -> SimpleNamespace | None:
        assert timeout == 0, "the event loop must not wait"
        try:
            action, node = self.end.recv(1000).decode().split()
        except BlockingIOError:
            return None
        return SimpleNamespace(action=action, device_node=node)


@pytest.fixture
def pty(tmp_path: Path) -> Iterator[Pty]:
    far = Pty(tmp_path / "usb-FTDI_FT232R-if00-port0")
    yield far
    far.unplug()


@pytest.fixture
async def recorder() -> Recorder:
    return Recorder()


class TestContract(AdapterContract):
    @pytest.fixture
    def far(self, pty: Pty) -> Pty:
        return pty

    @pytest.fixture
    def absent(self, tmp_path: Path) -> Adapter:
        return Serial(device=str(tmp_path / "nothing"))


class TestContractPaced(TestContract):
    @pytest.fixture
    def far(self, tmp_path: Path) -> Iterator[Pty]:
        far = Pty(tmp_path / "paced", pace=True, baudrate=1_000_000)
        yield far
        far.unplug()


class TestUnplugging:
    async def test_a_frame_that_was_cut_by_unplugging_does_not_leave_after_the_return(
        self, pty: Pty, recorder: Recorder
    ) -> None:
        transport = await pty.adapter.open(recorder)
        big = bytes(64) * 512
        assert transport.write(big, None) is True
        assert transport.write(b"refused", None) is False
        pty.unplug()
        await recorder.until(lambda: recorder.losses)
        await transport.close()
        pty.plug_in()
        again = await pty.adapter.open(recorder)
        assert again.write(FRAME, None) is True
        assert await pty.heard(len(FRAME)) == FRAME
        await again.close()
        with pytest.raises(OSError, match=r"Input/output|Resource temporarily"):
            os.read(pty.master, 1)

    async def test_the_loss_names_the_device(self, pty: Pty, recorder: Recorder) -> None:
        transport = await pty.adapter.open(recorder)
        pty.unplug()
        await recorder.until(lambda: recorder.losses)
        assert str(recorder.losses[0]) == f"{pty.link}: gone (unplugged or disconnected)"
        await transport.close()

    async def test_bytes_that_came_before_the_loss_are_received(self, pty: Pty, recorder: Recorder) -> None:
        transport = await pty.adapter.open(recorder)
        await pty.say(b"[BASE ROBO 007 oi")
        await recorder.until(lambda: recorder.data)
        pty.unplug()
        await recorder.until(lambda: recorder.losses)
        assert recorder.data == b"[BASE ROBO 007 oi"
        await transport.close()

    async def test_unplugging_while_a_close_waits_for_a_slow_robot_ends_it(self, pty: Pty, recorder: Recorder) -> None:
        before = open_descriptors()
        transport = await pty.adapter.open(recorder)
        assert transport.write(bytes(64) * 512, None) is True
        closing = asyncio.create_task(transport.close())
        await asyncio.sleep(0)
        pty.unplug()
        async with asyncio.timeout(PATIENCE_S):
            await closing
        assert recorder.losses == []
        assert len(open_descriptors()) == len(before) - 1

    async def test_the_return_of_the_device_is_noticed(self, pty: Pty) -> None:
        pty.unplug()
        waiting = asyncio.create_task(pty.adapter.changed())
        await asyncio.sleep(0.01)
        pty.plug_in()
        async with asyncio.timeout(PATIENCE_S):
            await waiting

    async def test_a_device_that_changed_hands_is_worth_another_try(self, pty: Pty) -> None:
        waiting = asyncio.create_task(pty.adapter.changed())
        await asyncio.sleep(0.01)
        pty.link.chmod(0o660)
        async with asyncio.timeout(PATIENCE_S):
            await waiting

    async def test_a_device_that_stays_away_is_not_worth_another_try(self, tmp_path: Path) -> None:
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(1.3):
                await Serial(device=str(tmp_path / "nothing")).changed()

    async def test_an_event_of_the_device_is_worth_another_try_at_once(
        self, pty: Pty, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        udev = FakeUdev()
        monkeypatch.setitem(sys.modules, "pyudev", udev)
        monkeypatch.setattr("psiu_adapters.serial.POLL_S", 3600)
        waiting = asyncio.create_task(pty.adapter.changed())
        usb = asyncio.create_task(Serial(device="0403:6001").changed())
        await asyncio.sleep(0)
        udev.tell("remove", str(pty.link.readlink()))
        udev.tell("add", "/dev/ttyUSB93")
        async with asyncio.timeout(PATIENCE_S):
            await usb
        assert not waiting.done()
        udev.tell("change", str(pty.link.readlink()))
        async with asyncio.timeout(PATIENCE_S):
            await waiting
        udev.close()

    async def test_without_pyudev_the_return_is_noticed_by_looking(
        self, pty: Pty, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setitem(sys.modules, "pyudev", None)
        monkeypatch.setattr("psiu_adapters.serial.POLL_S", 0.02)
        pty.unplug()
        waiting = asyncio.create_task(pty.adapter.changed())
        await asyncio.sleep(0.05)
        assert not waiting.done()
        pty.plug_in()
        async with asyncio.timeout(PATIENCE_S):
            await waiting

    async def test_a_wake_up_for_nothing_does_not_look_like_unplugging(self, pty: Pty, recorder: Recorder) -> None:
        transport = await pty.adapter.open(recorder)
        # As when another program was quicker to read what had come.
        transport._read()  # type: ignore[attr-defined]
        await pty.say(b"still here")
        await recorder.until(lambda: recorder.data == b"still here")
        assert recorder.losses == []
        await transport.close()


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
        before = open_descriptors()
        with pytest.raises(LinkError, match=r"its driver refuses 9600 baud \(it set 38400\)$"):
            await pty.adapter.open(recorder)
        assert open_descriptors() == before

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
        before = open_descriptors()
        opening = asyncio.create_task(far.adapter.open(recorder))
        async with asyncio.timeout(PATIENCE_S):
            while open_descriptors() == before:  # noqa: ASYNC110 — a thread opens it
                await asyncio.sleep(0.01)
        opening.cancel()
        with pytest.raises(asyncio.CancelledError):
            await opening
        await descriptors_become(before)
        far.unplug()

    @pytest.mark.parametrize(
        "wrong",
        [{"baudrate": 0}, {"baudrate": "fast"}, {"parity": "N"}, {"stopbits": 3}, {"device": ""}, {"open_delay_s": -1}],
    )
    def test_wrong_options_are_refused(self, wrong: dict[str, object]) -> None:
        with pytest.raises(ValidationError):
            Serial(**{"device": "/dev/null", **wrong})  # type: ignore[arg-type]


class TestPacing:
    async def test_only_one_frame_is_taken_beyond_the_one_on_the_wire(self, tmp_path: Path, recorder: Recorder) -> None:
        far = Pty(tmp_path / "slow", pace=True, baudrate=9600)
        transport = await far.adapter.open(recorder)
        assert [transport.write(FRAME, None) for _ in range(4)] == [True, True, False, False]
        await transport.close()
        far.unplug()

    async def test_frames_leave_at_the_speed_of_the_wire(self, tmp_path: Path, recorder: Recorder) -> None:
        far = Pty(tmp_path / "slow", pace=True, baudrate=9600)
        transport = await far.adapter.open(recorder)
        wire_s = 4 * len(FRAME) * 10 / 9600
        began = time.monotonic()
        for _ in range(6):
            while not transport.write(FRAME, None):
                rooms = recorder.rooms
                await recorder.until(lambda rooms=rooms: recorder.rooms > rooms)  # type: ignore[misc]
        assert wire_s - 0.01 <= time.monotonic() - began < 3 * wire_s
        assert await far.heard(6 * len(FRAME)) == 6 * FRAME
        await transport.close()
        far.unplug()

    async def test_a_refusal_is_answered_by_room_once_the_wire_is_free(
        self, tmp_path: Path, recorder: Recorder
    ) -> None:
        far = Pty(tmp_path / "slow", pace=True, baudrate=9600)
        transport = await far.adapter.open(recorder)
        for _ in range(5):
            transport.write(FRAME, None)
        await recorder.until(lambda: recorder.rooms)
        assert transport.write(FRAME, None) is True
        assert recorder.rooms == 1
        await transport.close()
        far.unplug()

    def test_the_wire_carries_what_the_baud_rate_says_unless_it_is_a_fiction(self) -> None:
        assert Serial(device="/dev/x", baudrate=2000).bits_per_second == 2000
        assert Serial(device="/dev/x", pace=False).bits_per_second is None
        assert Serial(device="socket://robot:23").bits_per_second is None
        assert Serial(device="rfc2217://robot:23", baudrate=115200).bits_per_second == 115200


class TestClosing:
    async def test_a_frame_already_begun_leaves_whole_for_a_robot_that_reads(
        self, pty: Pty, recorder: Recorder
    ) -> None:
        transport = await pty.adapter.open(recorder)
        big = os.urandom(20_000)
        assert transport.write(big, None) is True
        assert transport.write(b"refused", None) is False
        reading = asyncio.create_task(pty.heard(len(big)))
        await transport.close()
        assert await reading == big

    async def test_a_robot_that_never_reads_does_not_hold_up_the_close(self, pty: Pty, recorder: Recorder) -> None:
        transport = await pty.adapter.open(recorder)
        assert transport.write(os.urandom(20_000), None) is True
        began = time.monotonic()
        await transport.close()
        assert time.monotonic() - began < 1.5

    async def test_the_lock_is_released(self, pty: Pty, recorder: Recorder) -> None:
        transport = await pty.adapter.open(recorder)
        await transport.close()
        descriptor = os.open(pty.link, os.O_RDWR | os.O_NOCTTY)
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.close(descriptor)


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


class TestUrls:
    async def test_a_port_without_a_descriptor_works_through_threads(self, recorder: Recorder) -> None:
        before, threads = open_descriptors(), threading.active_count()
        transport = await Serial(device="loop://").open(recorder)
        for number in range(50):
            while not transport.write(b"%03d" % number + FRAME, None):
                rooms = recorder.rooms
                await recorder.until(lambda rooms=rooms: recorder.rooms > rooms)  # type: ignore[misc]
        await recorder.until(lambda: len(recorder.data) == 50 * (3 + len(FRAME)))
        assert recorder.data == b"".join(b"%03d" % number + FRAME for number in range(50))
        await transport.close()
        assert open_descriptors() == before
        assert threading.active_count() <= threads + 1, "only the event loop's own executor thread stays"

    async def test_a_network_port_works_and_its_end_is_a_loss(self, recorder: Recorder) -> None:
        connected: asyncio.Queue[tuple[asyncio.StreamReader, asyncio.StreamWriter]] = asyncio.Queue()
        server = await asyncio.start_server(lambda *ends: connected.put_nowait(ends), "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        transport = await Serial(device=f"socket://127.0.0.1:{port}").open(recorder)
        reader, writer = await connected.get()
        assert transport.write(FRAME, None) is True
        assert await reader.readexactly(len(FRAME)) == FRAME
        writer.write(FRAME)
        await recorder.until(lambda: recorder.data == FRAME)
        writer.close()
        await writer.wait_closed()
        await recorder.until(lambda: recorder.losses)
        await transport.close()
        server.close()
        await server.wait_closed()

    async def test_a_server_that_is_not_there_is_waited_for(self, recorder: Recorder) -> None:
        for scheme in ("socket", "rfc2217"):
            with pytest.raises(LinkAbsent, match="connection refused"):
                await Serial(device=f"{scheme}://127.0.0.1:1").open(recorder)

    async def test_a_scheme_that_pyserial_does_not_know_is_named(self, recorder: Recorder) -> None:
        with pytest.raises(LinkError, match="'nix' not known"):
            await Serial(device="nix://x").open(recorder)

    async def test_a_spied_port_shows_its_bytes_and_is_lost_when_unplugged(
        self, tmp_path: Path, recorder: Recorder, capsys: pytest.CaptureFixture[str]
    ) -> None:
        far = Pty(tmp_path / "spied")
        before = open_descriptors()
        transport = await Serial(device=f"spy://{far.link}", pace=False).open(recorder)
        await far.say(b"\xa5")
        await recorder.until(lambda: recorder.data == b"\xa5")
        far.unplug()
        await recorder.until(lambda: recorder.losses)
        await transport.close()
        assert "A5" in capsys.readouterr().err
        assert len(open_descriptors()) == len(before) - 1

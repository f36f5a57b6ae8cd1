"""Serial ports in use: the speed of the wire, the end of a link, and pyserial's URLs."""

import asyncio
import fcntl
import os
import select
import socket
import struct
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from adapter_contract import FRAME, Recorder, open_descriptors
from pty_robot import Pty
from serial.urlhandler import protocol_socket

from psiu_adapters import serial
from psiu_adapters.serial import Serial
from psiu_broker.errors import LinkAbsent, LinkError


class TestPacing:
    async def test_only_one_frame_is_taken_beyond_the_one_on_the_wire(self, tmp_path: Path, recorder: Recorder) -> None:
        far = Pty(tmp_path / "slow", pace=True, baudrate=9600)
        transport = await far.adapter.open(recorder)
        assert [transport.write(FRAME, None) for _ in range(4)] == [True, True, False, False]
        await transport.close()
        far.unplug()

    @pytest.mark.parametrize(("parity", "stopbits", "character_bits"), [("none", 1, 10), ("even", 2, 12)])
    async def test_frames_leave_at_the_speed_of_the_wire(
        self, tmp_path: Path, recorder: Recorder, parity: str, stopbits: int, character_bits: int
    ) -> None:
        far = Pty(tmp_path / "slow", pace=True, baudrate=9600, parity=parity, stopbits=stopbits)
        transport = await far.adapter.open(recorder)
        wire_s = 4 * len(FRAME) * character_bits / 9600
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

    @pytest.mark.parametrize(
        ("settings", "as_if_of_ten_bits"),
        [
            ({}, 9600),
            ({"parity": "even"}, 8727),
            ({"parity": "even", "stopbits": 2}, 8000),
            ({"bytesize": 7}, 10666),
            ({"parity": "odd", "baudrate": 1}, 1),
        ],
    )
    def test_every_bit_of_a_character_takes_its_time(self, settings: dict[str, Any], as_if_of_ten_bits: int) -> None:
        assert Serial(device="/dev/x", **settings).bits_per_second == as_if_of_ten_bits

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

    async def test_nothing_is_lost_that_a_network_port_says_while_it_is_opened(
        self, recorder: Recorder, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def has_spoken(port: protocol_socket.Serial) -> None:
            assert select.select([port._socket], [], [], 5)[0]

        monkeypatch.setattr(protocol_socket.Serial, "_reconfigure_port", has_spoken)
        ends: list[asyncio.StreamWriter] = []

        def speak(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            ends.append(writer)
            writer.write(FRAME)

        server = await asyncio.start_server(speak, "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        transport = await Serial(device=f"socket://127.0.0.1:{port}").open(recorder)
        await recorder.until(lambda: recorder.data == FRAME)
        await transport.close()
        ends[0].close()
        server.close()
        await server.wait_closed()

    async def test_a_network_port_that_does_not_read_is_given_little(self, recorder: Recorder) -> None:
        with socket.socket() as server:
            server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            server.bind(("127.0.0.1", 0))
            server.listen()
            transport = await Serial(device=f"socket://127.0.0.1:{server.getsockname()[1]}").open(recorder)
            far, _ = server.accept()
            taken = 0
            while transport.write(bytes(1000), None):
                taken += 1
                assert taken < 64, "an urgent frame would wait behind all that"
            assert len(far.recv(2000)) == 2000
            far.close()
            await transport.close()

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


async def test_what_the_uart_lost_since_it_was_opened_is_told(
    tmp_path: Path, recorder: Recorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    counted = [0, 0, 0, 0, 900, 900, 2, 30, 4, 5, 6, *[0] * 9]
    real = fcntl.ioctl

    def ioctl(descriptor: int, request: int, *arguments: Any) -> Any:
        if request != serial.TIOCGICOUNT:
            return real(descriptor, request, *arguments)
        return struct.pack("20i", *counted)

    far = Pty(tmp_path / "uart")
    monkeypatch.setattr(serial.fcntl, "ioctl", ioctl)
    transport = await far.adapter.open(recorder)
    counted[7] += 3
    counted[10] += 1
    status = transport.status()
    assert {name: status[name] for name in serial.LINE_ERRORS} == {
        "frame_errors": 0,
        "overruns": 3,
        "parity_errors": 0,
        "breaks": 0,
        "buffer_overruns": 1,
    }
    await transport.close()
    assert "device" in transport.status()
    far.unplug()


async def test_a_driver_that_counts_nothing_tells_nothing_of_losses(tmp_path: Path, recorder: Recorder) -> None:
    far = Pty(tmp_path / "uart")
    transport = await far.adapter.open(recorder)
    assert not serial.LINE_ERRORS.keys() & transport.status().keys()
    await transport.close()
    far.unplug()

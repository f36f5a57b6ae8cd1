"""RFCOMM by the kernel's sockets. Where the kernel has no Bluetooth, the connecting itself is tried over TCP."""

import asyncio
import errno
import os
import socket
import struct
from collections.abc import Iterator

import pytest
from adapter_contract import Recorder, open_descriptors

from psiu_adapters import rfcomm, rfcomm_socket
from psiu_adapters.rfcomm import Rfcomm
from psiu_adapters.rfcomm_socket import connected, explained, hold_little, sockaddr_rc
from psiu_broker.adapter import Transport
from psiu_broker.errors import LinkAbsent, LinkBusy, LinkError

ROBOT = "98:D3:31:00:00:01"


def sockaddr_in(port: int) -> bytes:
    return struct.pack("=H", socket.AF_INET) + struct.pack("!H4s8x", port, bytes([127, 0, 0, 1]))


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        yield listener


def test_the_address_is_the_ten_bytes_of_sockaddr_rc() -> None:
    assert sockaddr_rc(ROBOT, 5) == struct.pack("=H", 31) + bytes.fromhex("0100 0031 d398") + b"\x05\x00"


async def test_connecting_gives_a_usable_socket(listener: socket.socket) -> None:
    with socket.socket() as ours:
        await connected(ours, sockaddr_in(listener.getsockname()[1]))
        theirs, _ = listener.accept()
        with theirs:
            theirs.sendall(b"psiu")
            assert await asyncio.get_running_loop().sock_recv(ours, 4) == b"psiu"


async def test_a_refused_connection_is_said() -> None:
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        port = closed.getsockname()[1]
        with socket.socket() as ours, pytest.raises(ConnectionRefusedError):
            await connected(ours, sockaddr_in(port))


async def test_connecting_can_be_cancelled() -> None:
    before = open_descriptors()
    with socket.create_server(("127.0.0.1", 0), backlog=0) as full:
        address = sockaddr_in(full.getsockname()[1])
        with socket.socket() as first, socket.socket() as second:
            await connected(first, address)
            connecting = asyncio.ensure_future(connected(second, address))
            await asyncio.sleep(0)
            connecting.cancel()
            await asyncio.wait({connecting})
            assert connecting.cancelled()
    assert open_descriptors() == before


def test_the_kernel_keeps_few_frames_that_a_stop_cannot_overtake() -> None:
    before = open_descriptors()
    ours, theirs = socket.socketpair()
    with ours, theirs:
        ours.setblocking(False)
        hold_little(ours.fileno())
        taken = 0
        with pytest.raises(BlockingIOError):
            while True:
                taken += ours.send(b"MNERIM 034 parafrente 100 PC 02123") > 0
        assert 1 <= taken <= 16
    assert open_descriptors() == before


@pytest.mark.parametrize(
    ("code", "kind", "said"),
    [
        (errno.EAFNOSUPPORT, LinkAbsent, "modprobe rfcomm"),
        (errno.EPROTONOSUPPORT, LinkAbsent, "modprobe rfcomm"),
        (errno.EHOSTUNREACH, LinkAbsent, "no Bluetooth controller"),
        (errno.EHOSTDOWN, LinkAbsent, f"{ROBOT} does not answer"),
        (errno.ECONNREFUSED, LinkBusy, "refuses channel 3"),
        (errno.EBUSY, LinkBusy, "already connected by another process"),
        (errno.EACCES, LinkAbsent, f"bluetoothctl pair {ROBOT}"),
        (errno.EINVAL, LinkAbsent, "channel 3: invalid argument"),
    ],
)
def test_each_refusal_of_the_kernel_says_what_to_do(code: int, kind: type[LinkError], said: str) -> None:
    error = explained(OSError(code, os.strerror(code)), ROBOT, 3)
    assert type(error) is kind
    assert said in str(error)


async def test_an_absent_robot_or_kernel_is_a_link_error_and_no_hang() -> None:
    with pytest.raises(LinkError):
        await Rfcomm(address=ROBOT, route="socket", connect_timeout_s=0.2).open(Recorder())


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[tuple[str, int]]]:
    """The kernel's route replaced by a socket pair: whom it was asked to connect."""
    asked: list[tuple[str, int]] = []
    ours, theirs = socket.socketpair()

    async def connect(address: str, channel: int, _timeout_s: float) -> int:
        asked.append((address, channel))
        return ours.detach()

    monkeypatch.setattr(rfcomm.rfcomm_socket, "connect", connect)
    assert rfcomm_socket.connect is connect
    with theirs, ours:
        yield asked


async def opened_and_closed(adapter: Rfcomm) -> Transport:
    transport = await adapter.open(Recorder())
    await transport.close()
    return transport


async def test_a_given_channel_goes_to_the_kernel_at_once(kernel: list[tuple[str, int]]) -> None:
    transport = await opened_and_closed(Rfcomm(address=ROBOT, channel=7))
    assert kernel == [(ROBOT, 7)]
    assert transport.status() == {"address": ROBOT, "route": "socket", "channel": 7}


async def test_without_bluez_channel_one_is_guessed_and_the_guess_is_said(
    kernel: list[tuple[str, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DBUS_SYSTEM_BUS_ADDRESS", "unix:path=/nonexistent/bus")
    transport = await opened_and_closed(Rfcomm(address=ROBOT))
    assert kernel == [(ROBOT, 1)]
    assert "1 is a guess" in str(transport.status()["remark"])

"""Ending connections of this process from outside."""

import os
import socket
from pathlib import Path

import pytest
from ports import free_port

from psiu_broker.bus.hang_up import hang_up
from psiu_broker.bus.session import Session


def connected(family: socket.AddressFamily, address: object) -> tuple[socket.socket, socket.socket]:
    with socket.socket(family) as listening:
        listening.bind(address)
        listening.listen()
        near = socket.socket(family)
        near.connect(listening.getsockname())
        far, _ = listening.accept()
    return near, far


def open_files() -> int:
    return len(os.listdir("/proc/self/fd"))  # noqa: PTH208


@pytest.mark.parametrize("family", [socket.AF_INET, socket.AF_INET6])
def test_a_connection_ends_at_both_sides_and_others_go_on(family: socket.AddressFamily) -> None:
    host = "127.0.0.1" if family == socket.AF_INET else "::1"
    near, far = connected(family, (host, 0))
    other, other_far = connected(family, (host, 0))
    before = open_files()
    ours, theirs = (
        f"tcp/{'[' + host + ']' if family == socket.AF_INET6 else host}:{each.getsockname()[1]}" for each in (near, far)
    )
    assert hang_up([(ours, theirs)]) == 1
    assert near.recv(1) == far.recv(1) == b""
    other.send(b"x")
    assert other_far.recv(1) == b"x"
    assert open_files() == before
    for each in (near, far, other, other_far):
        each.close()


def test_a_connection_over_a_unix_socket_ends_too(tmp_path: Path) -> None:
    path = str(tmp_path / "zenoh.sock")
    near, far = connected(socket.AF_UNIX, path)
    assert hang_up([(f"unixsock-stream/{path}", "unixsock-stream/a1d584ba-e0a3-464c-a615-4be4e28b6f63")]) == 1
    assert near.recv(1) == far.recv(1) == b""
    near.close()
    far.close()


@pytest.mark.parametrize("endpoint", ["udp/127.0.0.1:1", "", "tcp/nowhere", "serial//dev/ttyUSB0#baudrate=1"])
def test_what_is_no_stream_is_left_alone(endpoint: str) -> None:
    assert hang_up([(endpoint, endpoint)]) == 0


async def test_zenoh_sessions_that_were_hung_up_on_find_each_other_again() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    first = await Session.open([endpoint])
    second = await Session.open([], connect=[endpoint])
    try:
        ended: list[tuple[str, str]] = []
        while len(ended) < 2:  # each link is another one: they have found each other in between
            links = [(str(link.src), str(link.dst)) for link in second.zenoh.info.links()]
            if links and links[0] not in ended and hang_up(links) == 1:
                ended += links
    finally:
        await second.close()
        await first.close()

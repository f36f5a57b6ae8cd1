"""A stop passes what waits, on real lines of each kind; what the transport has taken already goes before it."""

import asyncio
import os
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, cast

import pytest
from memory_adapter import codec_of, configuration
from pty_robot import Pty
from test_link import Hub
from udp_robot import Robot

from psiu_adapters.rfcomm import Called, Rfcomm
from psiu_adapters.udp import Udp
from psiu_broker.adapter import Adapter, Peer, Transport
from psiu_broker.codecs import psiu_ascii
from psiu_broker.frame import Address, Frame, Way
from psiu_broker.link import Link

PC, MNERIM = Address.named("PC"), Address.named("MNERIM")
QUEUED = 60
PATIENCE_S = 30.0
ROBOT = "98:D3:31:00:00:01"


def lamp(number: int) -> Frame:
    return psiu_ascii.message(PC, Address.named("LAMP"), "brilho", str(number))


class Line:
    """A link over a real transport, and the robots' ear at its far end."""

    def __init__(self, link: Link, hub: Hub, peer: Peer, hear: Callable[[], Any]) -> None:
        self.link, self.hub, self.peer, self._hear = link, hub, peer, hear

    def offer(self, frame: Frame, arrived: str = "wifi") -> str | None:
        return self.link.offer(frame, self.peer, Way(arrived), asyncio.get_running_loop().time())

    async def heard(self, frames: int) -> list[str]:
        """The command words of so many frames, in the order in which they came."""
        return [frame.subject for frame in await self.frames(frames)]

    async def frames(self, count: int) -> list[Frame]:
        data = b""
        async with asyncio.timeout(PATIENCE_S):
            while len(frames := _frames(data)) < count:
                data += await self._hear()
        return frames


def _frames(data: bytes) -> list[Frame]:
    made = configuration()
    return [event for event in codec_of(made).decode(data, 0.0) if isinstance(event, Frame)]


def make(adapter: Adapter, hub: Hub, **options: object) -> Link:
    made = configuration(adapter=adapter, queue_frames=2 * QUEUED, max_age_s=60.0, **options)  # type: ignore[arg-type]
    return Link(made, lambda: codec_of(made), cast(Any, hub), clock=asyncio.get_running_loop().time)


@asynccontextmanager
async def serial(folder: Path, **options: object) -> AsyncIterator[Line]:
    pty, hub = Pty(folder / "radio", pace=True, baudrate=38400), Hub()
    link = make(pty.adapter, hub, **options)
    transport = await pty.adapter.open(link)
    link.connected(transport)
    loop, heard = asyncio.get_running_loop(), asyncio.Queue[bytes]()
    loop.add_reader(pty.master, lambda: heard.put_nowait(os.read(pty.master, 4096)))
    try:
        yield Line(link, hub, None, heard.get)
    finally:
        loop.remove_reader(pty.master)
        await transport.close()
        pty.unplug()


@asynccontextmanager
async def rfcomm(_folder: Path, **options: object) -> AsyncIterator[Line]:
    """The transport of an RFCOMM link over a socket whose far end does not read until it is to hear."""
    ours, theirs = socket.socketpair()
    ours.setblocking(False)
    theirs.setblocking(False)
    hub = Hub()
    link = make(Rfcomm(address=ROBOT), hub, **options)
    transport: Transport = Called(ours.detach(), link, ROBOT, {})
    link.connected(transport)
    loop = asyncio.get_running_loop()
    try:
        yield Line(link, hub, None, lambda: loop.sock_recv(theirs, 256))
    finally:
        await transport.close()
        theirs.close()


@asynccontextmanager
async def udp(_folder: Path, **options: object) -> AsyncIterator[Line]:
    robot, hub = Robot(), Hub()
    adapter = Udp(listen="127.0.0.1:0", peers=(robot.text,))
    link = make(adapter, hub, **options)
    transport = await adapter.open(link)
    link.connected(transport)
    try:
        yield Line(link, hub, robot.peer, lambda: robot.heard(1))
    finally:
        await transport.close()
        robot.socket.close()


LINES = pytest.mark.parametrize("line_of", [serial, rfcomm, udp])


@LINES
async def test_a_stop_passes_all_that_limits_hold_back(line_of: Any, tmp_path: Path) -> None:
    async with line_of(tmp_path, max_frames_s=1.0, max_bytes_s=30.0, limits={"pare": {"frames_s": 0.1}}) as line:
        assert line.offer(lamp(0)) == "delivered"
        assert [line.offer(lamp(number)) for number in range(QUEUED)] == [None] * QUEUED
        for _ in range(2):
            line.offer(psiu_ascii.message(PC, MNERIM, "pare"))
        assert await line.heard(3) == ["brilho", "pare", "pare"]
        assert line.link.outbox.size == QUEUED, "the rest waits for its moment"


@pytest.mark.parametrize(("line_of", "ahead"), [(serial, 2), (rfcomm, 16)])
async def test_a_stop_passes_all_that_waits_for_the_wire(line_of: Any, ahead: int, tmp_path: Path) -> None:
    async with line_of(tmp_path) as line:
        taken = sum(line.offer(lamp(number)) == "delivered" for number in range(QUEUED))
        assert taken <= ahead, "what the transport takes cannot be called back, so it takes little"
        assert line.link.outbox.size >= QUEUED - ahead
        line.offer(psiu_ascii.message(PC, MNERIM, "pare"))
        words = await line.heard(QUEUED + 1)
    assert words.index("pare") == taken
    assert words.count("brilho") == QUEUED


@pytest.mark.parametrize("line_of", [serial, rfcomm])
async def test_no_other_way_s_stops_keep_a_stop_from_leaving_in_its_turn(line_of: Any, tmp_path: Path) -> None:
    """Each with another name and other words, before it and after it, and more than fit."""
    async with line_of(tmp_path) as line:
        while line.offer(lamp(0)) == "delivered":
            pass

        def flood(first: int) -> None:
            for number in range(first, first + 3 * QUEUED):
                evil = Address.named(f"EVIL{number}")
                line.offer(psiu_ascii.message(evil, Address.named("LAMP"), "pare", str(number)), "radio")

        flood(0)
        line.offer(psiu_ascii.message(PC, MNERIM, "pare"))
        flood(1000)
        line.offer(psiu_ascii.message(PC, Address.named("BETA"), "pare"), "cable")
        flood(2000)
        stops = [frame for frame in await line.frames(2 * QUEUED) if frame.subject == "pare"]
    assert {str(frame.destination) for frame in stops[:4]} == {"LAMP", "MNERIM", "BETA"}


async def test_a_stop_passes_datagrams_that_wait_for_the_network(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with udp(tmp_path) as line:
        transport = cast(Any, line.link._transport)
        sends = transport._sendto

        def full(*_: object) -> int:
            raise BlockingIOError

        transport._sendto = full
        for number in range(QUEUED):
            assert line.offer(lamp(number)) is None
        assert line.offer(psiu_ascii.message(PC, MNERIM, "pare")) is None
        transport._sendto = sends
        assert await line.heard(QUEUED + 1) == ["pare", *["brilho"] * QUEUED]

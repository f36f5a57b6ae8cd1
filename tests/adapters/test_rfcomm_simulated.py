"""RFCOMM end to end: adapter, mocked D-Bus, then real RFCOMM and SDP to a simulated robot on virtual controllers."""

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from adapter_contract import PATIENCE_S, Recorder
from mocked_bluez import PAIRED, ROBOT, Bluetooth, mocked, needs_mock, opened

from psiu_adapters.rfcomm import Rfcomm

pytest.importorskip("bumble", reason="bumble is missing: pip install 'psiu-broker[bluetooth-simulator]'")

from bumble.controller import Controller
from bumble.link import LocalLink
from bumble.rfcomm import DLC
from bumble.transport.common import StreamPacketSink, StreamPacketSource
from virtual_bluetooth import bridged, computer, radio_of

from psiu_broker.simulator import AsciiRobot
from psiu_broker.simulator.rfcomm import RfcommPort, serve

FORWARD = b"MNERIM 034 parafrente 100 PC 02123"
DONE = b"PC 038 parafrente sucesso MNERIM 02755"


@pytest.fixture
async def air() -> AsyncIterator[LocalLink]:
    return LocalLink()


def robot() -> AsciiRobot:
    return AsciiRobot("MNERIM", answer_s=0.0)


async def answer(dlc: DLC, question: bytes, size: int) -> bytes:
    """Send `question` and wait for `size` bytes."""
    answers: asyncio.Queue[bytes] = asyncio.Queue()
    dlc.sink = answers.put_nowait
    dlc.write(question)
    heard = b""
    async with asyncio.timeout(PATIENCE_S):
        while len(heard) < size:
            heard += await answers.get()
    return heard


async def test_a_simulated_robot_is_found_by_sdp_and_answers(air: LocalLink) -> None:
    radio = await radio_of(air)
    async with RfcommPort(robot(), device=computer(air, "HC-05", ROBOT), channel=5), radio.connected(ROBOT) as dlc:
        assert radio.channel == 5
        assert await answer(dlc, FORWARD, len(DONE)) == DONE


async def test_a_simulated_robot_that_is_switched_off_hangs_up(air: LocalLink) -> None:
    radio = await radio_of(air)
    async with RfcommPort(robot(), device=computer(air, "HC-05", ROBOT)) as port, radio.connected(ROBOT) as dlc:
        closed = asyncio.Event()
        dlc.on(dlc.EVENT_CLOSE, closed.set)
        await port.until(lambda: port.callers == 1)
        port.unplug()
        async with asyncio.timeout(PATIENCE_S):
            await closed.wait()


async def test_a_robot_behind_a_controller_of_its_own_is_served_until_left(air: LocalLink) -> None:
    class Chip(StreamPacketSource):
        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            Controller("HC-05", host_source=self, host_sink=StreamPacketSink(transport), link=air, public_address=ROBOT)

        def connection_lost(self, error: Exception | None) -> None:
            gone.set()

    gone = asyncio.Event()
    radio = await radio_of(air)
    async with await asyncio.get_running_loop().create_server(Chip, "127.0.0.1", 0) as server:
        port = server.sockets[0].getsockname()[1]
        async with RfcommPort(robot(), hci=f"tcp-client:127.0.0.1:{port}", address=ROBOT, channel=3) as served:
            async with radio.connected(ROBOT) as dlc:
                assert radio.channel == 3
                assert await answer(dlc, FORWARD, len(DONE)) == DONE
            await served.until(lambda: served.callers == 0)
        async with asyncio.timeout(PATIENCE_S):
            await gone.wait()


@pytest.fixture
async def bluetooth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Bluetooth]:
    async with mocked(tmp_path, monkeypatch) as bluetooth:
        await bluetooth.start(known=PAIRED)
        yield bluetooth


@needs_mock
async def test_the_adapter_talks_to_the_robot_over_real_rfcomm(air: LocalLink, bluetooth: Bluetooth) -> None:
    recorder = Recorder()
    async with (
        RfcommPort(robot(), device=computer(air, "HC-05", ROBOT)),
        bridged(bluetooth.folder / ROBOT.replace(":", "_"), await radio_of(air), ROBOT),
        opened(Rfcomm(address=ROBOT), recorder) as transport,
    ):
        for turn in range(1, 51):
            assert transport.write(FORWARD, None)
            await recorder.until(lambda turn=turn: recorder.data == DONE * turn)  # type: ignore[misc]


@needs_mock
async def test_a_robot_that_is_switched_off_is_a_lost_link_and_comes_back(air: LocalLink, bluetooth: Bluetooth) -> None:
    async with (
        RfcommPort(robot(), device=computer(air, "HC-05", ROBOT)) as port,
        bridged(bluetooth.folder / ROBOT.replace(":", "_"), await radio_of(air), ROBOT),
    ):
        for _ in range(2):
            port.plug()
            recorder = Recorder()
            async with opened(Rfcomm(address=ROBOT), recorder) as transport:
                assert transport.write(FORWARD, None)
                await recorder.until(lambda recorder=recorder: recorder.data == DONE)  # type: ignore[misc]
                port.unplug()
                await recorder.until(lambda recorder=recorder: recorder.losses)  # type: ignore[misc]


@needs_mock
async def test_a_long_stream_is_cut_into_rfcomm_frames_and_comes_back_whole(
    air: LocalLink, bluetooth: Bluetooth
) -> None:
    await serve(computer(air, "HC-05", ROBOT), lambda dlc: setattr(dlc, "sink", dlc.write))
    recorder = Recorder()
    frames = [b"%05d" % number * 60 for number in range(200)]
    async with (
        bridged(bluetooth.folder / ROBOT.replace(":", "_"), await radio_of(air), ROBOT),
        opened(Rfcomm(address=ROBOT), recorder) as transport,
    ):
        for frame in frames:
            while not transport.write(frame, None):
                rooms = recorder.rooms
                await recorder.until(lambda rooms=rooms: recorder.rooms > rooms)  # type: ignore[misc]
        await recorder.until(lambda: len(recorder.data) >= sum(map(len, frames)))
        assert recorder.data == b"".join(frames)

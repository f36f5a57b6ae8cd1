"""RFCOMM end to end: the adapter, mocked D-Bus, and an HC-05-like robot over real RFCOMM and SDP between controllers."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest
from adapter_contract import PATIENCE_S, Recorder
from mocked_bluez import PAIRED, ROBOT, Bluetooth, mocked, needs_mock, opened

from psiu_adapters.rfcomm import Rfcomm

pytest.importorskip("bumble", reason="bumble is missing: pip install 'psiu-broker[bluetooth-simulator]'")

from bumble.controller import Controller
from bumble.device import Device
from bumble.hci import Address
from bumble.host import Host
from bumble.link import LocalLink
from bumble.rfcomm import DLC, Client, find_rfcomm_channel_with_uuid
from bumble.transport import open_transport
from bumble.transport.common import AsyncPipeSink

from psiu_broker.simulator import rfcomm

HOST = "F0:F1:F2:F3:F4:F5"
QUESTION = b"?? 029 qualseunome PC "
ANSWER = b"PC 042 qualseunome HC05 HC05 "


def checked(frame: bytes) -> bytes:
    """`frame` with its PSIU checksum."""
    return frame + b"%05d" % sum(frame)


def psiu_robot(write: Callable[[bytes], None]) -> Callable[[bytes], None]:
    """Tells its name to whoever asks, however the question is cut."""
    heard = bytearray()

    def received(data: bytes) -> None:
        heard.extend(data)
        if heard.endswith(checked(QUESTION)):
            heard.clear()
            write(checked(ANSWER))

    return received


def computer(link: LocalLink, name: str, address: str) -> Device:
    """A device with a virtual controller in the air of `link`."""
    controller = Controller(name, link=link, public_address=address)
    return Device(name, Address(address), host=Host(controller, AsyncPipeSink(controller)))


class Radio:
    """The computer's own Bluetooth, which finds the robot's serial port by SDP and connects to it."""

    def __init__(self, device: Device) -> None:
        self._device = device
        self.channel: int | None = None

    @contextlib.asynccontextmanager
    async def connected(self, address: str) -> AsyncIterator[DLC]:
        connection = await self._device.connect_classic(address)
        self.channel = await find_rfcomm_channel_with_uuid(connection, rfcomm.SERIAL_PORT)
        assert self.channel is not None
        multiplexer = await Client(connection).start()
        dlc = await multiplexer.open_dlc(self.channel)
        try:
            yield dlc
        finally:
            await connection.disconnect()


async def radio_of(air: LocalLink) -> Radio:
    device = computer(air, "computer", HOST)
    device.classic_enabled = True
    await device.power_on()
    return Radio(device)


@pytest.fixture
async def air() -> AsyncIterator[LocalLink]:
    return LocalLink()


async def test_a_simulated_robot_is_found_by_sdp_and_answers(air: LocalLink) -> None:
    await rfcomm.serve(computer(air, "HC-05", ROBOT), psiu_robot, channel=5)
    radio = await radio_of(air)
    answers: asyncio.Queue[bytes] = asyncio.Queue()
    async with asyncio.timeout(PATIENCE_S), radio.connected(ROBOT) as dlc:
        assert radio.channel == 5
        dlc.sink = answers.put_nowait
        dlc.write(checked(QUESTION))
        assert await answers.get() == checked(ANSWER)


@contextlib.asynccontextmanager
async def bridged(path: Path, radio: Radio, address: str) -> AsyncIterator[None]:
    """The kernel's part: whoever connects to the Unix socket `path` talks RFCOMM with `address`."""
    ended: list[asyncio.Task[None]] = []

    async def bridge(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        async with radio.connected(address) as dlc:
            dlc.sink = writer.write
            dlc.on(dlc.EVENT_CLOSE, writer.close)
            while data := await reader.read(4096):
                dlc.write(data)
        writer.close()

    def begin(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        ended.append(asyncio.ensure_future(bridge(reader, writer)))

    server = await asyncio.start_unix_server(begin, path)
    try:
        yield
    finally:
        server.close()
        async with asyncio.timeout(PATIENCE_S):
            await asyncio.gather(*ended)


@pytest.fixture
async def bluetooth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Bluetooth]:
    async with mocked(tmp_path, monkeypatch) as bluetooth:
        await bluetooth.start(known=PAIRED)
        yield bluetooth


@needs_mock
async def test_the_adapter_talks_to_the_robot_over_real_rfcomm(air: LocalLink, bluetooth: Bluetooth) -> None:
    await rfcomm.serve(computer(air, "HC-05", ROBOT), psiu_robot)
    recorder = Recorder()
    async with (
        bridged(bluetooth.folder / ROBOT.replace(":", "_"), await radio_of(air), ROBOT),
        opened(Rfcomm(address=ROBOT), recorder) as transport,
    ):
        for turn in range(1, 51):
            assert transport.write(checked(QUESTION), None)
            await recorder.until(lambda turn=turn: recorder.data == checked(ANSWER) * turn)  # type: ignore[misc]


@needs_mock
async def test_a_long_stream_is_cut_into_rfcomm_frames_and_comes_back_whole(
    air: LocalLink, bluetooth: Bluetooth
) -> None:
    await rfcomm.serve(computer(air, "HC-05", ROBOT), lambda write: write)
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


async def test_a_robot_behind_a_controller_of_its_own_is_served_until_left(
    air: LocalLink, unused_tcp_port: int
) -> None:
    port = f"127.0.0.1:{unused_tcp_port}"
    async with await open_transport(f"tcp-server:{port}") as hci:
        Controller("robot", host_source=hci.source, host_sink=hci.sink, link=air, public_address=ROBOT)
        async with rfcomm.serial_port(f"tcp-client:{port}", psiu_robot, address=ROBOT, channel=3):
            radio = await radio_of(air)
            answers: asyncio.Queue[bytes] = asyncio.Queue()
            async with asyncio.timeout(PATIENCE_S), radio.connected(ROBOT) as dlc:
                dlc.sink = answers.put_nowait
                dlc.write(checked(QUESTION))
                assert await answers.get() == checked(ANSWER)
                assert radio.channel == 3

"""Virtual Bluetooth controllers in one air, and the kernel's part between them and a Unix socket."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path

from adapter_contract import PATIENCE_S
from bumble.controller import Controller
from bumble.device import Device
from bumble.hci import Address
from bumble.host import Host
from bumble.link import LocalLink
from bumble.rfcomm import DLC, Client, find_rfcomm_channel_with_uuid
from bumble.transport.common import AsyncPipeSink

from psiu_broker.simulator.rfcomm import SERIAL_PORT

HOST = "F0:F1:F2:F3:F4:F5"


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
        ended = asyncio.Event()
        connection.on(connection.EVENT_DISCONNECTION, lambda *_: ended.set())
        self.channel = await find_rfcomm_channel_with_uuid(connection, SERIAL_PORT)
        assert self.channel is not None
        multiplexer = await Client(connection).start()
        dlc = await multiplexer.open_dlc(self.channel)
        try:
            yield dlc
        finally:
            if not ended.is_set():
                await connection.disconnect()


async def radio_of(air: LocalLink) -> Radio:
    device = computer(air, "computer", HOST)
    device.classic_enabled = True
    await device.power_on()
    return Radio(device)


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

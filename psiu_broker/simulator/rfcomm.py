"""Simulated robots behind a Bluetooth serial port like that of an HC-05, over bumble."""

import asyncio
import contextlib
from collections.abc import Callable

try:
    from bumble.core import UUID
    from bumble.device import Device
    from bumble.hci import Address
    from bumble.pairing import PairingConfig, PairingDelegate
    from bumble.rfcomm import DLC, Server, make_service_sdp_records
    from bumble.transport import open_transport
except ImportError as error:
    raise ImportError("a Bluetooth robot needs bumble: pip install 'psiu-broker[bluetooth-simulator]'") from error

from psiu_broker.simulator.faults import Faults
from psiu_broker.simulator.port import Observer, Port
from psiu_broker.simulator.robot import Robot

__all__ = ["RfcommPort", "serve"]

SERIAL_PORT = UUID.from_16_bits(0x1101)
RECORD_HANDLE = 0x00010001
HANG_UP_S = 2.0


async def serve(device: Device, connected: Callable[[DLC], None], *, channel: int = 1, pin: str = "1234") -> None:
    """Switch `device` on with one serial port, listed by SDP; `connected` is told of everyone who opens it."""
    device.classic_enabled = True
    device.le_enabled = False
    device.pairing_config_factory = lambda _: PairingConfig(delegate=_Pin(pin))
    Server(device).listen(connected, channel)
    device.sdp_service_records = {RECORD_HANDLE: make_service_sdp_records(RECORD_HANDLE, channel, SERIAL_PORT)}
    await device.power_on()
    await device.set_discoverable(True)
    await device.set_connectable(True)


class RfcommPort(Port):
    """Robots behind the Bluetooth controller `hci`, in bumble's words: "usb:0", "tcp-client:127.0.0.1:9001".

    A virtual controller takes the place of `hci` by a ready `device`.
    """

    def __init__(
        self,
        *robots: Robot,
        hci: str = "usb:0",
        device: Device | None = None,
        name: str = "HC-05",
        address: str = "98:D3:31:00:00:01",
        channel: int = 1,
        pin: str = "1234",
        faults: Faults | None = None,
        observer: Observer | None = None,
    ) -> None:
        super().__init__(*robots, faults=faults, observer=observer)
        self._hci = hci
        self._device = device
        self._name = name
        self._address = address
        self._channel = channel
        self._pin = pin
        self._callers: list[DLC] = []
        self._leaving: set[asyncio.Task[None]] = set()
        self._opened = contextlib.AsyncExitStack()

    @property
    def callers(self) -> int:
        """How many are connected."""
        return len(self._callers)

    async def open(self) -> None:
        """Begin, with the controller switched on.

        Raises:
            Exception: bumble's own when the controller cannot be opened.
        """
        device = self._device
        async with contextlib.AsyncExitStack() as opened:
            if device is None:
                transport = await opened.enter_async_context(await open_transport(self._hci))
                device = Device.with_hci(self._name, Address(self._address), transport.source, transport.sink)
            await serve(device, self._connected, channel=self._channel, pin=self._pin)
            opened.push_async_callback(device.power_off)
            await super().open()
            self._opened = opened.pop_all()

    async def close(self) -> None:
        await super().close()
        if self._leaving:
            # A controller says nothing of the end of a connection that ended by itself meanwhile.
            await asyncio.wait(self._leaving, timeout=HANG_UP_S)
            for task in self._leaving:
                task.cancel()
        await self._opened.aclose()

    def _attach(self) -> None:
        """Connections are answered from now on."""

    def _detach(self) -> None:
        for caller in self._callers:
            self._hang_up(caller)
        self._callers.clear()

    def _connected(self, caller: DLC) -> None:
        if not self.plugged:
            self._hang_up(caller)
            return
        self._callers.append(caller)
        caller.on(caller.EVENT_CLOSE, lambda: self._left(caller))
        caller.sink = lambda data: self._deliver(data, caller)
        for robot in self.robots:
            robot.boundary()
        self._changed()

    def _hang_up(self, caller: DLC) -> None:
        task = self._loop.create_task(caller.multiplexer.l2cap_channel.connection.disconnect())
        self._leaving.add(task)
        task.add_done_callback(self._leaving.discard)

    def _left(self, caller: DLC) -> None:
        if caller in self._callers:
            self._callers.remove(caller)
            self._changed()

    def _put(self, data: bytes, peer: object) -> None:
        for caller in self._callers:
            if peer is None or peer is caller:
                caller.write(data)


class _Pin(PairingDelegate):
    def __init__(self, pin: str) -> None:
        super().__init__(PairingDelegate.IoCapability.NO_OUTPUT_NO_INPUT)
        self._pin = pin

    async def get_string(self, max_length: int) -> str | None:
        return self._pin[:max_length]

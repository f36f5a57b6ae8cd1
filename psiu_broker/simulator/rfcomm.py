"""The Bluetooth side of a simulated robot: a serial port like that of an HC-05, over bumble."""

import contextlib
from collections.abc import AsyncIterator, Callable

try:
    from bumble.core import UUID
    from bumble.device import Device
    from bumble.hci import Address
    from bumble.pairing import PairingConfig, PairingDelegate
    from bumble.rfcomm import DLC, Server, make_service_sdp_records
    from bumble.transport import open_transport
except ImportError as error:
    raise ImportError("a Bluetooth robot needs bumble: pip install 'psiu-broker[bluetooth-simulator]'") from error

SERIAL_PORT = UUID.from_16_bits(0x1101)
RECORD_HANDLE = 0x00010001

Write = Callable[[bytes], None]
Connected = Callable[[Write], Callable[[bytes], None]]
"""Somebody connects: takes how to write to them and gives what takes their bytes."""


class _Pin(PairingDelegate):
    def __init__(self, pin: str) -> None:
        super().__init__(PairingDelegate.IoCapability.NO_OUTPUT_NO_INPUT)
        self._pin = pin

    async def get_string(self, max_length: int) -> str | None:
        return self._pin[:max_length]


async def serve(device: Device, connected: Connected, *, channel: int = 1, pin: str = "1234") -> None:
    """Switch `device` on with one serial port, listed by SDP; several may connect, one after the other or at once."""

    def on_open(dlc: DLC) -> None:
        dlc.sink = connected(dlc.write)

    device.classic_enabled = True
    device.le_enabled = False
    device.pairing_config_factory = lambda _: PairingConfig(delegate=_Pin(pin))
    Server(device).listen(on_open, channel)
    device.sdp_service_records = {RECORD_HANDLE: make_service_sdp_records(RECORD_HANDLE, channel, SERIAL_PORT)}
    await device.power_on()
    await device.set_discoverable(True)
    await device.set_connectable(True)


@contextlib.asynccontextmanager
async def serial_port(
    transport: str,
    connected: Connected,
    *,
    name: str = "HC-05",
    address: str = "98:D3:31:00:00:01",
    channel: int = 1,
    pin: str = "1234",
) -> AsyncIterator[Device]:
    """`serve` on the controller behind `transport` in bumble's words ("usb:0", "tcp-client:127.0.0.1:9001") till left.

    Raises:
        Exception: bumble's own when the controller cannot be opened.
    """
    async with await open_transport(transport) as hci:
        device = Device.with_hci(name, Address(address), hci.source, hci.sink)
        await serve(device, connected, channel=channel, pin=pin)
        try:
            yield device
        finally:
            await device.power_off()

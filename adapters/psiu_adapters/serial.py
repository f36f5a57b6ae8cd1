"""Serial ports: USB adapters, Arduino boards, on-board UARTs, /dev/rfcommN, ptys and pyserial's URLs."""

import array
import asyncio
import fcntl
import logging
import os
import re
import socket
import struct
import termios
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Literal

import serial
from pydantic import Field
from serial.tools import list_ports

from psiu_adapters.aside import Aside
from psiu_adapters.descriptor import BITS_A_BYTE, DescriptorTransport
from psiu_adapters.hotplug import tty_events
from psiu_adapters.serial_faults import explain, holders, refused_baudrate
from psiu_adapters.serial_pump import READ_TIMEOUT_S, Pump, close_port
from psiu_broker.adapter import Adapter, Receiver, Transport
from psiu_broker.errors import LinkAbsent, LinkBusy, LinkError

POLL_S = 1.0
EMPTY_S = 0.1
BAUD_TOLERANCE = 0.03
TCGETS2 = 0x802C542A
TIOCGICOUNT = 0x545D
LINE_ERRORS = {"frame_errors": 6, "overruns": 7, "parity_errors": 8, "breaks": 9, "buffer_overruns": 10}
"""Where each is among the 20 numbers that a driver counts, of bytes that never came to us as they were sent."""
UNSENT_MAX = 4096
"""Bytes that the kernel holds back for a slow network port: by default megabytes, and an urgent frame behind them."""
USB_ID = re.compile(r"([0-9a-fA-F]{4}):([0-9a-fA-F]{4})(?::(.+))?")
BARE_NAME = re.compile(r"/dev/tty(USB|ACM)\d+")
PARITY = {
    "none": serial.PARITY_NONE,
    "even": serial.PARITY_EVEN,
    "odd": serial.PARITY_ODD,
    "mark": serial.PARITY_MARK,
    "space": serial.PARITY_SPACE,
}

Facts = dict[str, str | int | float]

log = logging.getLogger(__name__)


class Serial(Adapter):
    """A serial port."""

    device: str = Field(
        min_length=1,
        description="path (best below /dev/serial/by-id/), USB id as vendor:product or vendor:product:serial "
        "in hexadecimal, or a pyserial URL such as socket://host:port",
    )
    baudrate: int = Field(default=9600, ge=1, le=2**31 - 1, description="bits a second")
    bytesize: Literal[5, 6, 7, 8] = Field(default=8, description="data bits")
    parity: Literal["none", "even", "odd", "mark", "space"] = Field(default="none", description="parity bit")
    stopbits: Literal[1, 2] = Field(default=1, description="stop bits")
    exclusive: bool = Field(default=True, description="refuse to share the port with another program that locks it")
    dtr: bool | None = Field(default=None, description="DTR after opening; false keeps many boards from resetting")
    rts: bool | None = Field(default=None, description="RTS after opening")
    open_delay_s: float = Field(default=0.0, ge=0, le=60, description="pause after opening, while a board starts")
    low_latency: bool = Field(default=True, description="ask the driver to hand bytes on at once, where it can")
    pace: bool = Field(
        default=True,
        description="send no faster than the baud rate; false where the rate is a fiction (native USB boards, ptys)",
    )

    @property
    def bits_per_second(self) -> int | None:
        """The line rate as if a character had ten bits, as 8N1 has: 9600 baud with 8E2 carry what 8000 would."""
        if not self.pace or self.scheme in {"socket", "loop"}:
            return None
        character_bits = 1 + self.bytesize + (self.parity != "none") + self.stopbits
        return max(1, self.baudrate * BITS_A_BYTE // character_bits)

    @property
    def reliable_stream(self) -> bool:
        """TCP's promise; a serial line knows nothing of what it lost."""
        return self.scheme == "socket"

    async def open(self, receiver: Receiver) -> Transport:
        port, facts = await self._aside.run(self._open_port, unwanted=lambda opened: close_port(opened[0]))
        try:
            await asyncio.sleep(self.open_delay_s)
            return _SerialTransport(self, port, facts, receiver)
        except BaseException:
            await self._aside.run(lambda: close_port(port))
            raise

    @cached_property
    def _aside(self) -> Aside:
        return Aside(f"{self.device} opens")

    async def changed(self) -> None:
        if self.scheme:
            await asyncio.Event().wait()
        nodes: set[str] = set()
        event = asyncio.Event()

        def appeared(node: str) -> None:
            nodes.add(node)
            event.set()

        # Before udev's help is there, which may take a while: what changes meanwhile counts.
        before = self._seen()
        async with tty_events(appeared):
            while True:
                with suppress(TimeoutError):
                    async with asyncio.timeout(POLL_S):
                        await event.wait()
                if self._is_among(nodes):
                    return
                now = self._seen()
                if now and now != before:
                    return
                before = now
                nodes.clear()
                event.clear()

    @property
    def scheme(self) -> str:
        """What comes before ``://`` in a URL, "" for a path or an id."""
        scheme, separator, _ = self.device.partition("://")
        return scheme.lower() if separator else ""

    def _seen(self) -> frozenset[tuple[int | str, ...]]:
        """What is there now of this device; it differs after it came, went or was opened to others."""
        if USB_ID.fullmatch(self.device):
            with suppress(OSError):
                return frozenset((name,) for name in os.listdir("/sys/class/tty"))  # noqa: PTH208
        with suppress(OSError):
            status = Path(self.device).stat()
            return frozenset({(status.st_dev, status.st_ino, status.st_rdev, status.st_ctime_ns)})
        return frozenset()

    def _is_among(self, nodes: set[str]) -> bool:
        if USB_ID.fullmatch(self.device):
            return bool(nodes)
        return os.path.realpath(self.device) in nodes

    def _open_port(self) -> tuple[serial.Serial, Facts]:
        """The open port and what there is to say of it; blocks."""
        path = ""
        try:
            path = "" if self.scheme else self._find()
            port = serial.serial_for_url(
                path or self.device,
                do_not_open=True,
                baudrate=self.baudrate,
                bytesize=self.bytesize,
                parity=PARITY[self.parity],
                stopbits=self.stopbits,
                exclusive=self.exclusive or None,
                timeout=READ_TIMEOUT_S,
                # VMIN 1: with pyserial's 0 a wake-up for nothing reads as b"", which is how an unplugged port looks.
                inter_byte_timeout=0,
            )
            if self.dtr is not None:
                port.dtr = self.dtr
            if self.rts is not None:
                port.rts = self.rts
            if self.scheme == "socket":
                # Else pyserial throws away what the far end says between connecting and its last step of opening.
                port.reset_input_buffer = _nothing  # type: ignore[method-assign]
            port.open()
        except LinkError:
            raise
        except Exception as error:
            # URL handlers raise whatever they like: ValueError, AttributeError, SerialException.
            raise explain(self.device, path, self.baudrate, error) from error
        try:
            self._settle(port, path)
            return port, _facts(self.device, path)
        except BaseException:
            close_port(port)
            raise

    def _settle(self, port: serial.Serial, path: str) -> None:
        """Check and set what can be only on an open port."""
        if self.scheme == "socket":
            with socket.socket(fileno=os.dup(port.fileno())) as connection:
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT_MAX)
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        if not path:
            return
        actual = _actual_baudrate(port.fileno())
        if actual and abs(actual - self.baudrate) > BAUD_TOLERANCE * self.baudrate:
            raise LinkError(refused_baudrate(self.device, self.baudrate, actual))
        if self.low_latency:
            with suppress(ValueError, NotImplementedError, OSError):
                port.set_low_latency_mode(True)

    def _find(self) -> str:
        """The path of the device.

        Raises:
            LinkAbsent: no USB device has this id.
            LinkBusy: several have, and we cannot choose.
        """
        usb_id = USB_ID.fullmatch(self.device)
        if not usb_id:
            return self.device
        vendor, product, number = int(usb_id[1], 16), int(usb_id[2], 16), usb_id[3]
        found = [
            port
            for port in list_ports.comports()
            if (port.vid, port.pid) == (vendor, product) and number in (None, port.serial_number)
        ]
        if not found:
            raise LinkAbsent(f"{self.device}: no such USB device; waiting for it")
        if len(found) > 1:
            which = ", ".join(sorted(f"{port.device} is {self.device}:{port.serial_number}" for port in found))
            raise LinkBusy(f"{self.device}: several devices have this id, say which ({which})")
        return str(found[0].device)


class _SerialTransport(DescriptorTransport):
    """The open port, and what there is to say of it."""

    def __init__(self, options: Serial, port: serial.Serial, facts: Facts, receiver: Receiver) -> None:
        self._facts = facts
        # spy:// has a descriptor, but would not see what goes through it.
        pump = None if options.scheme != "spy" and _has_descriptor(port) else Pump(port)
        super().__init__(
            pump.fileno() if pump else port.fileno(),
            receiver,
            bits_per_second=options.bits_per_second,
            close=pump.close if pump else _closer(port),
            name=options.device,
        )
        self._port = port
        self._errors_before = _line_errors(port)
        if "hint" in facts:
            log.warning("%s: %s", options.device, facts["hint"])

    def status(self) -> Mapping[str, str | int | float]:
        before = self._errors_before
        errors = {name: count - before[name] for name, count in _line_errors(self._port).items() if name in before}
        return self._facts | errors


def _nothing() -> None: ...


def _has_descriptor(port: serial.Serial) -> bool:
    try:
        return port.fileno() >= 0
    except OSError:
        return False


def _closer(port: serial.Serial) -> Callable[[], None]:
    """Closes `port`, when its driver has sent the bytes it took or is stuck with them."""

    def close() -> None:
        with suppress(OSError, termios.error):
            descriptor = port.fileno()
            deadline = time.monotonic() + EMPTY_S
            while _waiting_bytes(descriptor) and time.monotonic() < deadline:
                time.sleep(EMPTY_S / 20)
            if _waiting_bytes(descriptor):
                # Else the kernel's close would wait for them, half a minute where flow control holds them.
                termios.tcflush(descriptor, termios.TCOFLUSH)
        close_port(port)

    return close


def _waiting_bytes(descriptor: int) -> int:
    return int(struct.unpack("I", fcntl.ioctl(descriptor, termios.TIOCOUTQ, b"\0" * 4))[0])


def _line_errors(port: serial.Serial) -> Mapping[str, int]:
    """What the driver has counted since it found the device; nothing where it counts nothing, as for a pty."""
    try:
        counted = struct.unpack("20i", fcntl.ioctl(port.fileno(), TIOCGICOUNT, bytes(80)))
    except OSError:
        return {}
    return {name: counted[place] for name, place in LINE_ERRORS.items()}


def _actual_baudrate(descriptor: int) -> int | None:
    """What the driver made of the rate we asked for, None where it cannot be asked."""
    settings = array.array("i", [0] * 64)
    try:
        fcntl.ioctl(descriptor, TCGETS2, settings)
    except OSError:
        return None
    return settings[10]


def _facts(device: str, path: str) -> Facts:
    if not path:
        return {}
    real = os.path.realpath(path)
    facts: Facts = {"device": real}
    if others := [who for who in holders(path) if who.startswith("pid ")]:
        facts["also_open_in"] = "; ".join(others)
    if BARE_NAME.fullmatch(device):
        stable = next((link for link in Path("/dev/serial/by-id").glob("*") if os.path.realpath(link) == real), None)
        facts["hint"] = "its number may change when it is plugged in again; use " + (
            str(stable) if stable else "its name below /dev/serial/by-id/"
        )
    return facts

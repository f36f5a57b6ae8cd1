"""A private system bus with a mocked bluetoothd on it, and robots that are Unix sockets."""

import asyncio
import contextlib
import json
import shutil
import socket
import subprocess
import sys
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import pytest
from adapter_contract import PATIENCE_S, Recorder
from dbus_fast import BusType, Message, MessageType
from dbus_fast.aio import MessageBus

from psiu_adapters.rfcomm import Rfcomm
from psiu_broker.adapter import Transport

SYSTEM_PYTHON = "/usr/bin/python3"
TEMPLATE = Path(__file__).parent / "bluez_mock.py"
ROBOT = "98:D3:31:00:00:01"
OTHER = "98:D3:31:00:00:02"
PAIRED = {ROBOT: {"paired": True}}
BOTH = {**PAIRED, OTHER: {"paired": True}}

Ends = tuple[asyncio.StreamReader, asyncio.StreamWriter]


def missing() -> str:
    """The Debian package that these tests need and this machine lacks."""
    if not shutil.which("dbus-daemon"):
        return "dbus-daemon is missing: apt-get install dbus-daemon"
    probe = "import dbusmock, gi"
    if (
        not Path(SYSTEM_PYTHON).exists()
        or subprocess.run([SYSTEM_PYTHON, "-c", probe], capture_output=True, check=False).returncode
    ):
        return "dbusmock is missing in the system's Python: apt-get install python3-dbusmock python3-gi"
    return ""


MISSING = missing() if sys.platform == "linux" else "D-Bus is for Linux"
needs_mock = pytest.mark.skipif(bool(MISSING), reason=MISSING)


class Robot:
    """A robot that is switched on; whoever connects to it waits until `joined`."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._listening = socket.socket(socket.AF_UNIX)
        self._writers: list[asyncio.StreamWriter] = []

    async def __aenter__(self) -> "Robot":
        self._listening.setblocking(False)
        self._listening.bind(str(self._path))
        self._listening.listen()
        return self

    async def __aexit__(self, *_: object) -> None:
        self._listening.close()
        self._path.unlink()
        for writer in self._writers:
            writer.close()

    async def joined(self) -> Ends:
        async with asyncio.timeout(PATIENCE_S):
            connection, _ = await asyncio.get_running_loop().sock_accept(self._listening)
        ends = await asyncio.open_connection(sock=connection)
        self._writers.append(ends[1])
        return ends


class Bluetooth:
    """A private system bus with a mocked bluetoothd on it."""

    def __init__(self, folder: Path, bus: subprocess.Popen[str]) -> None:
        self.folder = folder
        self.bus_daemon = bus
        self.process: subprocess.Popen[bytes] | None = None
        self._bus: MessageBus | None = None
        self._owned = asyncio.Event()

    def robot(self, address: str = ROBOT) -> Robot:
        return Robot(self.folder / address.replace(":", "_"))

    async def start(self, **parameters: Any) -> None:
        """bluetoothd starts and is ready."""
        bus = await self.steering()
        text = json.dumps({"robots": str(self.folder), **parameters})
        command = [SYSTEM_PYTHON, "-m", "dbusmock", "--system", "--template", str(TEMPLATE), "-p", text]
        self.process = await asyncio.to_thread(
            subprocess.Popen, command, stdout=subprocess.DEVNULL, cwd=self.folder, start_new_session=True
        )
        async with asyncio.timeout(20):
            await self._owned.wait()
            await bus.call(Message("org.bluez", "/", "org.freedesktop.DBus.ObjectManager", "GetManagedObjects"))

    async def stop(self) -> None:
        """bluetoothd dies."""
        if self.process is not None:
            self.process.kill()
            await asyncio.to_thread(self.process.wait)
            self.process = None
            self._owned.clear()

    async def steer(self, member: str, signature: str = "", *body: Any) -> Any:
        bus = await self.steering()
        reply = await bus.call(Message("org.bluez", "/", "org.psiu.Mock", member, signature=signature, body=list(body)))
        assert reply is not None
        assert reply.message_type is MessageType.METHOD_RETURN, reply.body
        return reply.body[0] if reply.body else None

    async def log(self) -> list[str]:
        return list(await self.steer("Log"))

    async def steering(self) -> MessageBus:
        if self._bus is None:
            self._bus = await MessageBus(bus_type=BusType.SYSTEM).connect()
            self._bus.add_message_handler(self._signal)
            rule = "type='signal',member='NameOwnerChanged',arg0='org.bluez'"
            bus = "org.freedesktop.DBus"
            await self._bus.call(Message(bus, "/org/freedesktop/DBus", bus, "AddMatch", signature="s", body=[rule]))
        return self._bus

    def _signal(self, message: Message) -> None:
        if message.member == "NameOwnerChanged" and message.body[0] == "org.bluez" and message.body[2]:
            self._owned.set()

    async def close(self) -> None:
        await self.stop()
        if self._bus is not None:
            self._bus.disconnect()
            await self._bus.wait_for_disconnect()
            self._bus = None

    async def end(self) -> None:
        """The bus dies, and bluetoothd with it."""
        await self.close()
        self.bus_daemon.kill()
        await asyncio.to_thread(self.bus_daemon.wait)

    async def again(self) -> None:
        """The bus starts anew, without bluetoothd."""
        with self.bus_daemon:  # which has ended
            self.bus_daemon = await asyncio.to_thread(bus_daemon, self.folder.parent)


def bus_daemon(folder: Path) -> subprocess.Popen[str]:
    """A D-Bus of its own at `folder`/bus, which is ready."""
    address = f"unix:path={folder}/bus"
    command = ["dbus-daemon", "--session", "--nofork", "--print-address=1", f"--address={address}"]
    daemon = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    assert daemon.stdout is not None
    daemon.stdout.readline()
    return daemon


@contextlib.contextmanager
def system_bus(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[subprocess.Popen[str]]:
    """A private dbus-daemon, which is the system bus meanwhile."""
    with bus_daemon(folder) as daemon:
        monkeypatch.setenv("DBUS_SYSTEM_BUS_ADDRESS", f"unix:path={folder}/bus")
        try:
            yield daemon
        finally:
            daemon.kill()


@contextlib.asynccontextmanager
async def mocked(folder: Path, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Bluetooth]:
    """A bus without bluetoothd, which `Bluetooth.start` starts."""
    robots = folder / "robots"
    robots.mkdir()
    with system_bus(folder, monkeypatch) as bus:
        bluetooth = Bluetooth(robots, bus)
        try:
            yield bluetooth
        finally:
            await bluetooth.close()
            with bluetooth.bus_daemon:  # it may be another one by now
                bluetooth.bus_daemon.kill()


@contextlib.asynccontextmanager
async def opened(adapter: Rfcomm, recorder: Recorder) -> AsyncIterator[Transport]:
    transport = await adapter.open(recorder)
    try:
        yield transport
    finally:
        await transport.close()

"""A serial device that comes back is noticed, by udev's word or by looking."""

import asyncio
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
from adapter_contract import PATIENCE_S
from pty_robot import Pty

from psiu_adapters import hotplug
from psiu_adapters.serial import Serial


class FakeUdev(ModuleType):
    """The part of pyudev that is used, its events told by the test: no udev runs where tests do."""

    def __init__(self) -> None:
        super().__init__("pyudev")
        self.ends: list[socket.socket] = []
        self.watched = asyncio.Semaphore(0)
        self.made_in: list[threading.Thread] = []
        self.Monitor = self

    def Context(self) -> object:  # noqa: N802
        self.made_in.append(threading.current_thread())
        return object()

    def from_netlink(self, _context: object, *, source: str) -> "FakeMonitor":
        assert source == "udev", "the kernel's events come before udev has set owner and links"
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.ends.append(ours)
        self.watched.release()
        return FakeMonitor(theirs)

    def tell(self, action: str, node: str) -> None:
        for end in self.ends:
            with suppress(BrokenPipeError):
                end.send(f"{action} {node}".encode())

    def close(self) -> None:
        for end in self.ends:
            end.close()


@pytest.fixture(autouse=True)
def _udev_is_looked_for_anew() -> Iterator[None]:
    hotplug._udev.cache_clear()
    yield
    hotplug._udev.cache_clear()


class FakeMonitor:
    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        self.end = end
        self.fileno = end.fileno

    def __del__(self) -> None:
        self.end.close()

    def filter_by(self, subsystem: str) -> None:
        assert subsystem == "tty"

    def start(self) -> None:
        pass

    def poll(self, timeout: float) -> SimpleNamespace | None:
        assert timeout == 0, "the event loop must not wait"
        try:
            action, node = self.end.recv(1000).decode().split()
        except BlockingIOError:
            return None
        return SimpleNamespace(action=action, device_node=node)


@pytest.fixture
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """It looks often."""
    monkeypatch.setattr("psiu_adapters.serial.POLL_S", 0.05)


@pytest.mark.usefixtures("soon")
async def test_the_return_of_the_device_is_noticed(pty: Pty) -> None:
    pty.unplug()
    waiting = asyncio.create_task(pty.adapter.changed())
    await asyncio.sleep(0.01)
    pty.plug_in()
    async with asyncio.timeout(PATIENCE_S):
        await waiting


@pytest.mark.usefixtures("soon")
async def test_a_device_that_changed_hands_is_worth_another_try(pty: Pty) -> None:
    waiting = asyncio.create_task(pty.adapter.changed())
    await asyncio.sleep(0.01)
    pty.link.chmod(0o660)
    async with asyncio.timeout(PATIENCE_S):
        await waiting


@pytest.mark.usefixtures("soon")
async def test_a_device_that_stays_away_is_not_worth_another_try(tmp_path: Path) -> None:
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(0.3):
            await Serial(device=str(tmp_path / "nothing")).changed()


async def test_an_event_of_the_device_is_worth_another_try_at_once(pty: Pty, monkeypatch: pytest.MonkeyPatch) -> None:
    udev = FakeUdev()
    monkeypatch.setitem(sys.modules, "pyudev", udev)
    monkeypatch.setattr("psiu_adapters.serial.POLL_S", 3600)
    waiting = asyncio.create_task(pty.adapter.changed())
    usb = asyncio.create_task(Serial(device="0403:6001").changed())
    async with asyncio.timeout(PATIENCE_S):
        for _ in range(2):
            await udev.watched.acquire()
    udev.tell("remove", str(pty.link.readlink()))
    udev.tell("add", "/dev/ttyUSB93")
    async with asyncio.timeout(PATIENCE_S):
        await usb
    assert not waiting.done()
    udev.tell("change", str(pty.link.readlink()))
    async with asyncio.timeout(PATIENCE_S):
        await waiting
    udev.close()


async def test_udev_is_looked_for_once_and_not_on_the_event_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    udev = FakeUdev()
    monkeypatch.setitem(sys.modules, "pyudev", udev)
    for _ in range(3):
        waiting = asyncio.create_task(Serial(device="/dev/ttyUSB93").changed())
        async with asyncio.timeout(PATIENCE_S):
            await udev.watched.acquire()
        waiting.cancel()
        await asyncio.wait({waiting})
    assert len(udev.made_in) == 1
    assert udev.made_in[0] is not threading.current_thread()
    udev.close()


async def test_without_pyudev_the_return_is_noticed_by_looking(pty: Pty, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyudev", None)
    monkeypatch.setattr("psiu_adapters.serial.POLL_S", 0.02)
    pty.unplug()
    waiting = asyncio.create_task(pty.adapter.changed())
    await asyncio.sleep(0.05)
    assert not waiting.done()
    pty.plug_in()
    async with asyncio.timeout(PATIENCE_S):
        await waiting

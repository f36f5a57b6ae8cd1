"""The moment at which a serial device appears, told by udev where there is one."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from functools import cache
from typing import Any

from psiu_adapters.aside import Aside

_aside = Aside("udev")


@asynccontextmanager
async def tty_events(appeared: Callable[[str], None]) -> AsyncIterator[None]:
    """Inside, udev's tty events reach `appeared`, on the event loop, with the node (``/dev/ttyUSB0``) that is ready.

    udev's own events come after it has set owner and links, the kernel's before. Without pyudev or
    without its socket there are simply no calls.
    """
    monitor = await _monitor()
    if monitor is None:
        yield
        return

    def read() -> None:
        while (device := monitor.poll(timeout=0)) is not None:
            if device.action != "remove" and device.device_node:
                appeared(device.device_node)

    loop = asyncio.get_running_loop()
    descriptor = monitor.fileno()
    loop.add_reader(descriptor, read)
    try:
        yield
    finally:
        loop.remove_reader(descriptor)


async def _monitor() -> Any:
    udev = await _aside.run(_udev)
    if udev is None:
        return None
    pyudev, context = udev
    try:
        monitor = pyudev.Monitor.from_netlink(context, source="udev")
        monitor.filter_by("tty")
        monitor.start()
    except OSError:
        return None
    return monitor


@cache
def _udev() -> tuple[Any, Any] | None:
    """pyudev and its context, made once: it runs ldconfig (or a compiler) to find its library. None without either."""
    try:
        import pyudev  # type: ignore[import-untyped, unused-ignore]  # noqa: PLC0415

        return pyudev, pyudev.Context()
    except (ImportError, OSError):
        return None

"""The moment at which a serial device appears, told by udev where there is one."""

import asyncio
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def tty_events(appeared: Callable[[str], None]) -> Iterator[None]:
    """Inside, udev's tty events reach `appeared`, on the event loop, with the node (``/dev/ttyUSB0``) that is ready.

    udev's own events come after it has set owner and links, the kernel's before. Without pyudev or
    without its socket there are simply no calls.
    """
    try:
        import pyudev  # type: ignore[import-untyped, unused-ignore]  # noqa: PLC0415

        monitor = pyudev.Monitor.from_netlink(pyudev.Context(), source="udev")
        monitor.filter_by("tty")
        monitor.start()
        descriptor = monitor.fileno()
    except (ImportError, OSError):
        yield
        return

    def read() -> None:
        while (device := monitor.poll(timeout=0)) is not None:
            if device.action != "remove" and device.device_node:
                appeared(device.device_node)

    loop = asyncio.get_running_loop()
    loop.add_reader(descriptor, read)
    try:
        yield
    finally:
        loop.remove_reader(descriptor)

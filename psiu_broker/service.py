"""What the service manager is told (sd_notify): ready, stopping, a status line, and that work goes on."""

import asyncio
import logging
import os
import socket
from collections.abc import Awaitable, Callable, Mapping

log = logging.getLogger(__name__)


class Notifier:
    """Talks to the service manager named in the environment; says nothing where there is none.

    `watchdog_s` is how often the service manager must hear that all is well, None where it does not ask.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._address = _address(environment.get("NOTIFY_SOCKET", ""))
        self.watchdog_s = _watchdog_s(environment)

    def ready(self, status: str) -> None:
        """The core runs; `status` is what ``systemctl status`` shows."""
        self._tell(f"READY=1\nSTATUS={_one_line(status)}")

    def status(self, text: str) -> None:
        self._tell(f"STATUS={_one_line(text)}")

    def stopping(self) -> None:
        self._tell("STOPPING=1")

    async def feed(self, progress: Callable[[], Awaitable[bool]]) -> None:
        """Feed the watchdog, until cancelled, twice a period and only when `progress` says all is well.

        Returns at once where no watchdog is asked for. A `progress` that hangs feeds nothing, on purpose.
        """
        if self.watchdog_s is None:
            return
        clock = asyncio.get_running_loop().time
        while True:
            began = clock()
            if await progress():
                self._tell("WATCHDOG=1")
            await asyncio.sleep(max(0.0, began + self.watchdog_s / 2 - clock()))

    def _tell(self, message: str) -> None:
        if self._address is None:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as manager:
                manager.settimeout(1.0)  # a lost READY would have us killed, a full queue for ever would hang us
                manager.sendto(message.encode(), self._address)
        except OSError as error:
            log.warning("the service manager cannot be told %s: %s", message.partition("=")[0], error)


def _address(text: str) -> str | None:
    """A path, or an abstract name, which systemd writes with an @."""
    if text.startswith("@"):
        return "\0" + text[1:]
    return text if text.startswith("/") else None


def _watchdog_s(environment: Mapping[str, str]) -> float | None:
    """WATCHDOG_USEC in seconds, where it is meant for this process."""
    period = environment.get("WATCHDOG_USEC", "")
    if environment.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return None
    return int(period) / 1e6 if period.isdecimal() and int(period) > 0 else None


def _one_line(text: str) -> str:
    return " ".join(text.split())

"""A pause between two lives of a broker whose session is a Zenoh router.

A router that comes back within a second or so of its end is sometimes taken for its former self by
its neighbours, and stays unheard for good. So a running broker notes when it was last alive, and
the next life waits until that is long enough ago.
"""

import asyncio
import contextlib
import os
import tempfile
import time
from pathlib import Path
from typing import Final
from urllib.parse import quote

HOLD_OFF_S: Final = 2.0
"""Nothing went wrong in 25 restarts after this long; after half a second, up to every second one did."""

CLOCK: Final = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)


class LastAlive:
    """When the broker of this name was last alive on this machine, in a file that outlives it."""

    def __init__(self, broker: str, directory: Path | None = None) -> None:
        self._path = (directory or _directory()) / f"psiu-broker-{os.getuid()}-{quote(broker, safe='')}.alive"

    def note(self) -> None:
        """It is alive now. A file that cannot be written is in nobody's way: then there is no pause."""
        with contextlib.suppress(OSError):
            flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC
            file = os.open(self._path, flags, 0o600)
            try:
                os.write(file, f"{time.clock_gettime(CLOCK):.3f}\n".encode())
            finally:
                os.close(file)

    def rest_s(self) -> float:
        """How long to wait before the session may open."""
        try:
            noted = float(self._path.read_text("ascii"))
        except (OSError, ValueError):
            return 0.0
        ago = time.clock_gettime(CLOCK) - noted  # negative after the machine has started anew
        return HOLD_OFF_S - ago if 0 <= ago < HOLD_OFF_S else 0.0

    async def hold_off(self) -> float:
        """Wait if need be; how long it was."""
        rest_s = self.rest_s()
        if rest_s > 0:
            await asyncio.sleep(rest_s)
        return rest_s


def _directory() -> Path:
    """Where files of running services are; a systemd unit gives us one that outlives a restart."""
    given = os.environ.get("RUNTIME_DIRECTORY") or os.environ.get("XDG_RUNTIME_DIR")
    return Path(given.split(":")[0]) if given else Path(tempfile.gettempdir())

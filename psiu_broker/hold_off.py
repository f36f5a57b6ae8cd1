"""A pause between two lives of a broker whose session is a Zenoh router.

A router that comes back within a second or so of its end is sometimes taken for its former self by
its neighbours, and stays unheard for good. So a running broker notes when it was last alive, and
the next life waits until that is long enough ago.
"""

import asyncio
import contextlib
import os
import stat
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final
from urllib.parse import quote

HOLD_OFF_S: Final = 2.0
"""Nothing went wrong in 25 restarts after this long; after half a second, up to every second one did."""

LONGEST: Final = 64

CLOCK: Final = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)


class LastAlive:
    """When the broker of this name was last alive on this machine, in a file that outlives it."""

    def __init__(self, broker: str, directory: Path | None = None) -> None:
        self._path = (directory or _directory()) / f"psiu-broker-{os.getuid()}-{quote(broker, safe='')}.alive"

    def note(self) -> None:
        """It is alive now. A file that cannot be written is in nobody's way: then there is no pause."""
        with contextlib.suppress(OSError), self._opened(os.O_WRONLY | os.O_CREAT) as file:
            os.ftruncate(file, 0)
            os.write(file, f"{time.clock_gettime(CLOCK):.3f}\n".encode())

    def rest_s(self) -> float:
        """How long to wait before the session may open."""
        try:
            with self._opened(os.O_RDONLY) as file:
                noted = float(os.read(file, LONGEST).decode("ascii"))
        except (OSError, ValueError):
            return 0.0
        ago = time.clock_gettime(CLOCK) - noted  # negative after the machine has started anew
        return HOLD_OFF_S - ago if 0 <= ago < HOLD_OFF_S else 0.0

    @contextlib.contextmanager
    def _opened(self, flags: int) -> Iterator[int]:
        """The file's descriptor; raises OSError unless it is a plain file of our own: others may put theirs there."""
        file = os.open(self._path, flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o600)
        try:
            state = os.fstat(file)
            if not stat.S_ISREG(state.st_mode) or state.st_uid != os.getuid():
                raise OSError(f"{self._path} is not a file of our own")
            yield file
        finally:
            os.close(file)

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

"""A folder for Unix sockets that only this user may enter, and that does not outlive its broker for long.

Its lock says that its broker lives: the kernel opens it when the process ends, however that ends.
So the next broker to start removes what one that was killed has left, and no folder in use, also
where brokers in several containers share one temporary folder and know nothing of each other's processes.
"""

import fcntl
import logging
import os
import shutil
import tempfile
from pathlib import Path
from typing import Final

PREFIX: Final = "psiu-meeting-"
PARENT_MAX: Final = 60
"""A Unix socket's path has no more than 107 bytes."""

log = logging.getLogger(__name__)


class Folder:
    """One that is ours until `remove`."""

    def __init__(self, path: Path, lock: int) -> None:
        self.path = path
        self._lock = lock

    @classmethod
    def make(cls) -> "Folder | None":
        """A new one; None where none can be made, which stops nothing but the trunks."""
        parent = tempfile.gettempdir()
        if len(os.fsencode(parent)) > PARENT_MAX:
            parent = "/tmp"  # noqa: S108 - mkdtemp
        _tidy(Path(parent))
        try:
            while True:
                path = Path(tempfile.mkdtemp(prefix=PREFIX, dir=parent))
                lock = _lock(path)
                if lock is not None:
                    return cls(path, lock)
                # Another broker that starts took it for one left behind.
        except OSError as error:
            log.warning("the trunks cannot meet Zenoh: %s", error)
            return None

    def remove(self) -> None:
        shutil.rmtree(self.path, ignore_errors=True)
        os.close(self._lock)


def _tidy(parent: Path) -> None:
    """Remove the folders of brokers that were killed."""
    for path in parent.glob(f"{PREFIX}*"):
        try:
            lock = _lock(path)
        except OSError:
            continue
        if lock is not None:
            log.info("removing %s, which a broker that was killed has left", path)
            Folder(path, lock).remove()


def _lock(path: Path) -> int | None:
    """Lock the folder at `path`; None where it is locked, gone or another user's.

    Raises:
        OSError: it cannot be opened or locked, or is no folder.
    """
    try:
        lock = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except FileNotFoundError:
        return None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.fstat(lock).st_uid == os.geteuid() and path.exists():
            return lock
    except BlockingIOError:
        pass
    except BaseException:
        os.close(lock)
        raise
    os.close(lock)
    return None

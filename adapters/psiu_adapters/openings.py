"""The moment at which somebody opens or closes a file, told by inotify where it can be had."""

import ctypes
import os
import struct
from collections.abc import Iterator
from typing import Final

IN_OPEN: Final = 0x20
IN_CLOSE: Final = 0x18
_EVENT: Final = struct.Struct("iIII")
_READ_BYTES: Final = 4096


class Openings:
    """Openings and closings of one file at a time; `fd` is readable when there is news."""

    def __init__(self) -> None:
        """Begin to watch, nothing yet.

        Raises:
            OSError: this system has no inotify, or none left for us.
        """
        self._libc = ctypes.CDLL(None, use_errno=True)
        self._file = -1
        self.fd = self._checked(self._libc.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC))

    def watch(self, path: str) -> None:
        """Watch `path` and nothing else from now on.

        Raises:
            OSError: it cannot be watched.
        """
        file = self._checked(self._libc.inotify_add_watch(self.fd, os.fsencode(path), IN_OPEN | IN_CLOSE))
        if self._file >= 0:
            # Harmless where the file is gone and the kernel has forgotten it by itself.
            self._libc.inotify_rm_watch(self.fd, self._file)
        self._file = file

    def news(self) -> Iterator[bool]:
        """What happened since it was last asked, in order: True for an opening, False for a closing."""
        try:
            data = os.read(self.fd, _READ_BYTES)
        except (BlockingIOError, InterruptedError):
            return
        at = 0
        while at < len(data):
            file, mask, _, name_bytes = _EVENT.unpack_from(data, at)
            at += _EVENT.size + name_bytes
            if file == self._file and mask & (IN_OPEN | IN_CLOSE):
                yield bool(mask & IN_OPEN)

    def close(self) -> None:
        os.close(self.fd)

    @staticmethod
    def _checked(result: int) -> int:
        if result < 0:
            code = ctypes.get_errno()
            raise OSError(code, os.strerror(code))
        return result

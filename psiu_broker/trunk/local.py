"""The Unix sockets between a trunk and the Zenoh session of its own broker. Nothing here waits."""

import asyncio
import contextlib
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

from psiu_broker.trunk.wire import CHUNK_MAX

BACKLOG_MAX: Final = 256 * 1024
"""Bytes that may wait for Zenoh to read them."""


class Meeting(NamedTuple):
    """Where a trunk and the broker's session meet, in a folder that only this user may enter."""

    door: Path
    """Where the session connects, when the trunk has opened a `Door` there."""
    session: Path
    """Where the session listens."""


class Door:
    """Where Zenoh connects to us, one connection at a time: after each, closed until `ready`."""

    def __init__(self, path: Path, came: Callable[[socket.socket], None]) -> None:
        self._path = path
        self._came = came
        self._loop = asyncio.get_running_loop()
        self._socket = socket.socket(socket.AF_UNIX)
        self._ready = False
        try:
            self._socket.setblocking(False)
            self._socket.bind(str(path))
            self._socket.listen(1)
        except BaseException:
            self._socket.close()
            raise

    def ready(self) -> None:
        """The next connection may come."""
        if not self._ready:
            self._ready = True
            self._loop.add_reader(self._socket, self._accept)

    def close(self) -> None:
        self._loop.remove_reader(self._socket)
        self._socket.close()
        self._path.unlink(missing_ok=True)

    def _accept(self) -> None:
        try:
            connection, _ = self._socket.accept()
        except OSError:
            return  # it has given up already, or this process has no descriptor left for it
        self._ready = False
        self._loop.remove_reader(self._socket)
        self._came(connection)


class Local:
    """A connection with Zenoh: `received` is told what it says and `ended` that it is over, not after `close`."""

    def __init__(self, connection: socket.socket, received: Callable[[bytes], None], ended: Callable[[], None]) -> None:
        self._socket = connection
        self._received = received
        self._ended = ended
        self._loop = asyncio.get_running_loop()
        self._backlog = bytearray()
        self._reading = False
        self._closed = False
        connection.setblocking(False)

    @classmethod
    def connect(cls, path: Path, received: Callable[[bytes], None], ended: Callable[[], None]) -> "Local":
        """Connect to the session that listens at `path`.

        Raises:
            OSError: none does, or it takes nobody now.
        """
        connection = socket.socket(socket.AF_UNIX)
        try:
            connection.setblocking(False)
            connection.connect(str(path))
        except BaseException:
            connection.close()
            raise
        return cls(connection, received, ended)

    def read(self, reading: bool) -> None:
        """Take what Zenoh says, or let it wait; at first, it waits."""
        if reading == self._reading or self._closed:
            return
        self._reading = reading
        if reading:
            self._loop.add_reader(self._socket, self._read)
        else:
            self._loop.remove_reader(self._socket)

    def write(self, data: bytes) -> bool:
        """Hand `data` to Zenoh; False: too much of it waits already, and it must be told that some is missing.

        Raises:
            OSError: Zenoh has closed the connection.
        """
        if not self._backlog:
            with contextlib.suppress(BlockingIOError, InterruptedError):
                data = data[self._socket.send(data) :]
            if not data:
                return True
            self._loop.add_writer(self._socket, self._flush)
        if len(self._backlog) + len(data) > BACKLOG_MAX:
            return False
        self._backlog += data
        return True

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        self._loop.remove_reader(self._socket)
        self._loop.remove_writer(self._socket)
        self._socket.close()

    def _read(self) -> None:
        try:
            data = self._socket.recv(CHUNK_MAX)
        except (BlockingIOError, InterruptedError):
            return
        except OSError:
            data = b""
        if data:
            self._received(data)
        else:
            self._ended()

    def _flush(self) -> None:
        try:
            del self._backlog[: self._socket.send(self._backlog)]
        except (BlockingIOError, InterruptedError):
            return
        except OSError:
            self._ended()
            return
        if not self._backlog:
            self._loop.remove_writer(self._socket)

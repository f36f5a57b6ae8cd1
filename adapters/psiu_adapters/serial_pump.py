"""Ports that have no descriptor (rfc2217://, loop://, spy://): pyserial's blocking calls behind one end of a socket."""

import socket
import threading
from contextlib import suppress

import serial

READ_TIMEOUT_S = 0.2
JOIN_S = 2.0
BUFFER_BYTES = 4096


class Pump:
    """Carries bytes between `port` and a socket whose far end, `fileno`, is ours to read and write.

    `port` must have been opened with a read timeout, after which its reader looks whether it is
    time to stop. When the port fails the far end comes to its end of file.
    """

    def __init__(self, port: serial.Serial) -> None:
        self._port = port
        self._outer, self._inner = socket.socketpair()
        # Small, or a late frame would wait behind a whole buffer of others.
        self._outer.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
        self._closing = threading.Event()
        self._threads = [
            threading.Thread(target=target, name=f"{port.port} {name}", daemon=True)
            for target, name in ((self._carry_in, "reader"), (self._carry_out, "writer"))
        ]
        for thread in self._threads:
            thread.start()

    def fileno(self) -> int:
        return self._outer.fileno()

    def close(self) -> None:
        """Send what was taken, stop both threads and close the port; blocks."""
        self._closing.set()
        with suppress(OSError):
            self._outer.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join(JOIN_S)
        self._outer.close()
        close_port(self._port)
        for thread in self._threads:
            thread.join(JOIN_S)
        self._inner.close()

    def _carry_in(self) -> None:
        try:
            while not self._closing.is_set():
                data = self._port.read(1)
                if data:
                    self._inner.sendall(data + self._port.read(self._port.in_waiting))
        except Exception:
            # Whatever a URL handler raises from its own threads and sockets, the port is of no more use.
            self._fail()

    def _carry_out(self) -> None:
        try:
            while data := self._inner.recv(BUFFER_BYTES):
                self._port.write(data)
        except Exception:
            self._fail()

    def _fail(self) -> None:
        with suppress(OSError):
            self._inner.shutdown(socket.SHUT_RDWR)


def close_port(port: serial.Serial) -> None:
    """Close `port`; blocks.

    pyserial's network ports forget their socket when the far end was quicker to close it.
    """
    connection = getattr(port, "_socket", None)
    with suppress(OSError):
        port.close()
    if connection is not None:
        connection.close()

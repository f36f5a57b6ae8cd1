"""Simulated robots on a pseudo-terminal (a serial port to everyone else) and on UDP."""

import os
import socket
import tty
from contextlib import suppress
from pathlib import Path
from typing import Any

from psiu_broker.simulator.faults import Faults
from psiu_broker.simulator.port import Observer, Port, Simulation
from psiu_broker.simulator.robot import Robot

__all__ = ["Port", "PtyPort", "Simulation", "UdpPort"]

READ_BYTES = 4096
DATAGRAM_BYTES = 65536


class PtyPort(Port):
    """Robots behind a pseudo-terminal that looks like a serial port, under the fixed name `link` where given.

    `unplug` hangs up whoever has it open and takes the name away; `plug` brings a new one.
    """

    def __init__(
        self,
        *robots: Robot,
        link: Path | str | None = None,
        faults: Faults | None = None,
        observer: Observer | None = None,
    ) -> None:
        super().__init__(*robots, faults=faults, observer=observer)
        self._link = None if link is None else Path(link)
        self._device = ""
        self._master = -1
        self._slave = -1

    @property
    def path(self) -> str:
        """What to open: the link where there is one, else the device of this moment."""
        return self._device if self._link is None else str(self._link)

    def _attach(self) -> None:
        # The slave stays open on our side: without it the master is at end of file until somebody opens it.
        self._master, self._slave = os.openpty()
        try:
            tty.setraw(self._slave)
            os.set_blocking(self._master, False)
            self._device = os.ttyname(self._slave)
            if self._link is not None:
                _point(self._link, self._device)
        except OSError:
            self._close_both()
            raise
        self._loop.add_reader(self._master, self._read)

    def _detach(self) -> None:
        self._loop.remove_reader(self._master)
        if self._link is not None and _target(self._link) == self._device:
            self._link.unlink(missing_ok=True)
        self._close_both()

    def _close_both(self) -> None:
        os.close(self._master)
        os.close(self._slave)
        self._master = self._slave = -1

    def _read(self) -> None:
        try:
            data = os.read(self._master, READ_BYTES)
        except BlockingIOError:
            return
        self._deliver(data, None)

    def _put(self, data: bytes, peer: object) -> None:
        # Nobody reads and the buffer is full: a serial line overruns too.
        with suppress(BlockingIOError):
            os.write(self._master, data)


class UdpPort(Port):
    """Robots on a UDP socket bound to `listen` that answer whoever spoke.

    What they say unasked goes to `peer`, whom they greet first, else to whoever spoke last.
    """

    datagrams = True

    def __init__(
        self,
        *robots: Robot,
        listen: str = "127.0.0.1:0",
        peer: str | None = None,
        faults: Faults | None = None,
        observer: Observer | None = None,
    ) -> None:
        """Make the port.

        Raises:
            ValueError: an address is not HOST:PORT, or the faults are those of a stream.
        """
        super().__init__(*robots, faults=faults, observer=observer)
        if self._faults.one_byte_at_a_time:
            raise ValueError("one_byte_at_a_time is for serial lines: a datagram arrives whole")
        self._listen = _split(listen)
        self._peer = None if peer is None else _split(peer)
        self._home: Any = None
        self._last_sender: Any = None
        self._socket: socket.socket

    @property
    def address(self) -> str:
        """Where the robots are, as HOST:PORT; known once open."""
        host, port = self._socket.getsockname()[:2]
        return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"

    def _attach(self) -> None:
        family, kind, protocol, _, bound = _resolve(*self._listen)
        self._socket = socket.socket(family, kind, protocol)
        try:
            self._socket.setblocking(False)
            self._socket.bind(bound)
            self._listen = self._socket.getsockname()[:2]
            self._home = None if self._peer is None else _resolve(*self._peer, family)[4]
        except OSError:
            self._socket.close()
            raise
        self._loop.add_reader(self._socket, self._read)
        if self._home is not None:
            for robot in self.robots:
                self._loop.call_soon(self._greet, robot)

    def _greet(self, robot: Robot) -> None:
        if self.plugged:
            self.send(robot.hello(), robot)

    def _detach(self) -> None:
        self._loop.remove_reader(self._socket)
        self._socket.close()

    def _read(self) -> None:
        try:
            data, sender = self._socket.recvfrom(DATAGRAM_BYTES)
        except OSError:
            return  # Nothing there after all, or a complaint about an earlier datagram that nobody took.
        self._last_sender = sender
        self._deliver(data, sender)

    def _put(self, data: bytes, peer: object) -> None:
        to: Any = peer or self._home or self._last_sender
        if to is not None:
            with suppress(OSError):
                self._socket.sendto(data, to)


def _split(address: str) -> tuple[str, int]:
    host, _, port = address.rpartition(":")
    if not host or not port.isascii() or not port.isdigit() or int(port) > 65535:
        raise ValueError(f"{address!r} is not HOST:PORT, such as 127.0.0.1:9001")
    return host.removeprefix("[").removesuffix("]"), int(port)


def _resolve(host: str, port: int, family: int = 0) -> tuple[Any, ...]:
    return socket.getaddrinfo(host, port, family, socket.SOCK_DGRAM)[0]


def _target(link: Path) -> str:
    try:
        return str(link.readlink())
    except OSError:
        return ""


def _point(link: Path, device: str) -> None:
    """Make `link` point to `device`, in one step; only a link to another pseudo-terminal is replaced.

    Raises:
        FileExistsError: something else has this name.
    """
    if (link.exists() or link.is_symlink()) and not _target(link).startswith("/dev/pts/"):
        raise FileExistsError(f"{link} exists and is not a link to a pseudo-terminal: remove it or choose another name")
    fresh = link.with_name(f".{link.name}.{os.getpid()}")
    fresh.symlink_to(device)
    fresh.replace(link)

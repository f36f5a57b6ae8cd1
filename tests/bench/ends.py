"""The two far ends of a router, both held by the load: frames go in on the left and are awaited on the right."""

import os
import re
import select
import socket
import tty
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress

from tests.bench.batches import Basket, Volley

LEFT, RIGHT = 0, 1
HOST = "127.0.0.1"


class Ends(ABC):
    """One router's ends. `send` and `receive` are for the load, `say` and `hear` for what comes before it."""

    @abstractmethod
    def use(self, frames: Sequence[bytes]) -> None:
        """Prepare what `send` sends."""

    @abstractmethod
    def send(self, start: int, count: int) -> int:
        """Send frames from the left, as many as go at once; how many went."""

    @abstractmethod
    def receive(self) -> list[bytes]:
        """Whole frames that have come to the right."""

    @abstractmethod
    def say(self, side: int, frame: bytes) -> None: ...

    @abstractmethod
    def hear(self, side: int, timeout_s: float) -> list[bytes]:
        """What has come to one side, waiting for something at most so long."""

    @abstractmethod
    def close(self) -> None: ...


class UdpEnds(Ends):
    """A socket on each side, connected to the router's port on that side; to one another without a router."""

    def __init__(self, *, routed: bool) -> None:
        self._sides = tuple(socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) for _ in range(2))
        for side in self._sides:
            side.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
            side.bind((HOST, 0))
        self.ports = tuple(int(side.getsockname()[1]) for side in self._sides)
        self.router_ports = _free_ports(2) if routed else self.ports[::-1]
        for side, port in zip(self._sides, self.router_ports, strict=True):
            side.connect((HOST, port))
        self._basket = Basket()

    def use(self, frames: Sequence[bytes]) -> None:
        self._volley = Volley(frames)

    def send(self, start: int, count: int) -> int:
        return self._volley.send(self._sides[LEFT], start, count)

    def receive(self) -> list[bytes]:
        return self._basket.catch(self._sides[RIGHT])

    def say(self, side: int, frame: bytes) -> None:
        with suppress(ConnectionRefusedError):  # the router is not there yet
            self._sides[side].send(frame)

    def hear(self, side: int, timeout_s: float) -> list[bytes]:
        select.select([self._sides[side]], [], [], timeout_s)
        return self._basket.catch(self._sides[side])

    def close(self) -> None:
        for side in self._sides:
            side.close()


class PtyEnds(Ends):
    """The master of a pty on each side; of one and the same pty without a router."""

    FRAME = re.compile(rb"\S+ \d{3} [ -~]*? \S+ \d{5}")

    def __init__(self, *, routed: bool) -> None:
        pairs = [os.openpty() for _ in range(2 if routed else 1)]
        for fd in sum(pairs, ()):
            tty.setraw(fd)
            os.set_blocking(fd, False)
        self.devices = [os.ttyname(slave) for _, slave in pairs]
        self._open = list(sum(pairs, ()))
        self._sides = [master for master, _ in pairs] if routed else list(pairs[0])
        self._unsent = [b"", b""]
        self._cut = [b"", b""]

    def use(self, frames: Sequence[bytes]) -> None:
        self._frames = frames

    def send(self, start: int, count: int) -> int:
        self._write(LEFT, b"".join(self._frames[start : start + count]))
        return count

    def receive(self) -> list[bytes]:
        if self._unsent[LEFT]:
            self._write(LEFT, b"")
        return self._read(RIGHT)

    def say(self, side: int, frame: bytes) -> None:
        # The router may not be there yet: then nothing more is added to what waits.
        self._write(side, b"" if self._unsent[side] else frame)

    def hear(self, side: int, timeout_s: float) -> list[bytes]:
        select.select([self._sides[side]], [], [], timeout_s)
        return self._read(side)

    def close(self) -> None:
        for fd in self._open:
            os.close(fd)

    def _write(self, side: int, data: bytes) -> None:
        """Write what there is room for, and the rest at the next occasion: frames leave whole."""
        data = self._unsent[side] + data
        try:
            self._unsent[side] = data[os.write(self._sides[side], data) :]
        except BlockingIOError:
            self._unsent[side] = data

    def _read(self, side: int) -> list[bytes]:
        try:
            data = self._cut[side] + os.read(self._sides[side], 65536)
        except BlockingIOError:
            return []
        frames, end = [], 0
        for match in self.FRAME.finditer(data):
            frames.append(match[0])
            end = match.end()
        self._cut[side] = data[end:]
        return frames


def _free_ports(count: int) -> tuple[int, ...]:
    probes = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    for probe in probes:
        probe.bind((HOST, 0))
    ports = tuple(int(probe.getsockname()[1]) for probe in probes)
    for probe in probes:
        probe.close()
    return ports

"""The far ends of the link that is in trouble: MNERIM on a serial port, behind Bluetooth, and on UDP."""

import os
import socket
from abc import abstractmethod
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, Literal

from mocked_bluez import ROBOT
from ports import free_port

from psiu_broker.simulator import AsciiRobot, Extra, Faults, Port, PtyPort, UdpPort

Kind = Literal["serial", "rfcomm", "udp"]
READ_BYTES: Final = 4096
SAMPLES: Final = 16
"""Of a bit, as UARTs take them."""

QUESTION: Final = "distancia"
"""What is asked of robots; they answer every time, as they do not when asked who they are."""

SPEAKS_EVERY_S: Final = 0.2


def robot(name: str, speaks_every_s: float | None = None) -> AsciiRobot:
    extras = [Extra.parse(f"{QUESTION}:0=42")]
    return AsciiRobot(name, answer_s=0, extras=extras, telemetry_s=speaks_every_s, telemetry_to="base")


class End(Port):
    """What may befall the far end of a link, whichever it is."""

    robot: AsciiRobot
    wrong: Callable[[bytes], bytes] | None = None
    """What becomes of all bytes, both ways."""
    longest_piece = 0
    """Bytes that left at once."""

    @property
    @abstractmethod
    def options(self) -> str:
        """Of the broker's link, in TOML."""

    def say(self, data: bytes) -> None:
        """Put these very bytes on the line."""
        self._put(data, None)

    @abstractmethod
    def freeze(self) -> None:
        """Read nothing any more: what is written to us stays where it is."""

    @abstractmethod
    def thaw(self) -> None: ...

    @abstractmethod
    def move(self) -> None:
        """Come back under another node."""

    def _deliver(self, data: bytes, peer: object) -> None:
        super()._deliver(data if self.wrong is None else self.wrong(data), peer)

    def _leave(self, data: bytes, peer: object) -> None:
        self.longest_piece = max(self.longest_piece, len(data))
        super()._leave(data if self.wrong is None else self.wrong(data), peer)


class SerialEnd(End, PtyPort):
    def __init__(self, folder: Path, faults: Faults | None) -> None:
        super().__init__(robot("MNERIM"), link=folder / "mnerim", faults=faults)
        self._others: list[int] = []

    @property
    def options(self) -> str:
        return f'adapter = "serial"\ndevice = "{self.path}"\nbaudrate = 115200'

    def freeze(self) -> None:
        self._loop.remove_reader(self._master)

    def thaw(self) -> None:
        self._loop.add_reader(self._master, self._read)

    def move(self) -> None:
        before = self._device
        self.unplug()
        self._others += os.openpty()  # which take the number that is free now
        self.plug()
        assert self._device != before

    async def close(self) -> None:
        await super().close()
        for each in self._others:
            os.close(each)


class RfcommEnd(End):
    """A Unix socket, which the mocked bluetoothd connects and hands to the broker."""

    def __init__(self, folder: Path, faults: Faults | None) -> None:
        super().__init__(robot("MNERIM"), faults=faults)
        self._path = folder / ROBOT.replace(":", "_")
        self._listening: socket.socket
        self._callers: list[socket.socket] = []

    @property
    def options(self) -> str:
        return f'adapter = "rfcomm"\naddress = "{ROBOT}"\nroute = "bluez"'

    def freeze(self) -> None:
        for caller in self._callers:
            self._loop.remove_reader(caller)

    def thaw(self) -> None:
        for caller in self._callers:
            self._loop.add_reader(caller, self._read, caller)

    def move(self) -> None:
        raise NotImplementedError("a Bluetooth device is known by its address, wherever it is")

    def _attach(self) -> None:
        self._listening = socket.socket(socket.AF_UNIX)
        self._listening.setblocking(False)
        self._listening.bind(str(self._path))
        self._listening.listen()
        self._loop.add_reader(self._listening, self._accept)

    def _detach(self) -> None:
        self._loop.remove_reader(self._listening)
        self._listening.close()
        self._path.unlink()
        for caller in tuple(self._callers):
            self._hang_up(caller)

    def _accept(self) -> None:
        with suppress(OSError):
            caller, _ = self._listening.accept()
            caller.setblocking(False)
            self._callers.append(caller)
            self._loop.add_reader(caller, self._read, caller)

    def _read(self, caller: socket.socket) -> None:
        try:
            data = caller.recv(READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            self._deliver(data, caller)
        else:
            self._hang_up(caller)

    def _hang_up(self, caller: socket.socket) -> None:
        self._loop.remove_reader(caller)
        self._callers.remove(caller)
        caller.close()

    def _put(self, data: bytes, peer: object) -> None:
        for caller in self._callers:
            if peer is None or peer is caller:
                with suppress(OSError):  # nobody reads, or nobody is there any more
                    caller.send(data)


class UdpEnd(End, UdpPort):
    """Where nobody calls, so that a robot is found by what it says."""

    def __init__(self, folder: Path, faults: Faults | None) -> None:
        self._broker = free_port(socket.SOCK_DGRAM)
        own = f"127.0.0.1:{free_port(socket.SOCK_DGRAM)}"
        super().__init__(robot("MNERIM", SPEAKS_EVERY_S), listen=own, peer=f"127.0.0.1:{self._broker}", faults=faults)

    @property
    def options(self) -> str:
        return f'adapter = "udp"\nlisten = "127.0.0.1:{self._broker}"'

    def freeze(self) -> None:
        self._loop.remove_reader(self._socket)

    def thaw(self) -> None:
        self._loop.add_reader(self._socket, self._read)

    def move(self) -> None:
        self.unplug()
        self._listen = ("127.0.0.1", 0)
        self.plug()


ENDS: Final[dict[Kind, type[SerialEnd | RfcommEnd | UdpEnd]]] = {
    "serial": SerialEnd,
    "rfcomm": RfcommEnd,
    "udp": UdpEnd,
}


def at_another_rate(data: bytes, sent: int = 9600, read: int = 115200) -> bytes:
    """What a UART at `read` baud makes of bytes that left at `sent` baud, without a break between them."""
    levels = [level for byte in data for level in (0, *(byte >> bit & 1 for bit in range(8)), 1)]
    step = sent / read
    heard = bytearray()
    now, end = 0.0, len(levels)
    while now < end:
        if levels[int(now)]:
            now += step / SAMPLES
            continue
        heard.append(sum(_level(levels, now + (bit + 1.5) * step) << bit for bit in range(8)))
        now += 9.5 * step
        while now < end and not levels[int(now)]:  # a framing error: wait for the line to rise
            now += step / SAMPLES
    return bytes(heard)


def _level(levels: Sequence[int], at: float) -> int:
    return levels[int(at)] if at < len(levels) else 1

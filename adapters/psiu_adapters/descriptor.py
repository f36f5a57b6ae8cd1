"""A stream over a non-blocking file descriptor: what serial ports and RFCOMM connections have in common."""

import asyncio
import errno
import os
from collections.abc import Callable, Collection

from psiu_adapters.aside import Aside
from psiu_broker.adapter import Peer, Receiver, Transport
from psiu_broker.errors import LinkError, LinkLost

READ_BYTES = 4096
BITS_A_BYTE = 10
UNPLUGGED = {errno.EIO, errno.ENODEV, errno.ENXIO}

WIRE_SLACK_S = 0.002
"""The event loop's timers come up to this late; without the slack a fast line would idle between frames."""

DRAIN_S = 0.25
"""How long closing waits for a frame already begun, beyond the time that the wire itself needs."""

DRAIN_LIMIT_S = 2.0


class DescriptorTransport(Transport):
    """One peer behind the non-blocking descriptor `fd`, which `close` (called in a thread) releases.

    Made on the event loop's thread; reading begins at once. With `bits_per_second` a frame is taken
    only when all frames before it, except the one on the wire, have left by the clock. End of file
    and every error except "try again" are `LinkLost`; `name` begins its text.
    """

    def __init__(
        self,
        fd: int,
        receiver: Receiver,
        *,
        peer: Peer = None,
        bits_per_second: int | None = None,
        close: Callable[[], None],
        name: str,
    ) -> None:
        self._fd = fd
        self._receiver = receiver
        self._received = receiver.received
        self._peer = peer
        self._close = close
        self._name = name
        self._loop = asyncio.get_running_loop()
        self._time = self._loop.time
        self._byte_s = BITS_A_BYTE / bits_per_second if bits_per_second else 0.0
        self._last_start = 0.0
        self._wire_free = 0.0
        self._rest = b""
        self._refused = False
        self._open = True
        self._dead = False
        self._closed = False
        self._timer: asyncio.TimerHandle | None = None
        self._drained: asyncio.Event | None = None
        os.set_blocking(fd, False)
        self._loop.add_reader(fd, self._read)

    @property
    def peers(self) -> Collection[Peer]:
        return (self._peer,)

    def write(self, data: bytes, peer: Peer) -> bool:
        if not self._open or peer != self._peer:
            return True
        if self._rest:
            self._refused = True
            return False
        now = 0.0
        if self._byte_s:
            now = self._time()
            wait_s = self._last_start - now
            if wait_s > WIRE_SLACK_S:
                if self._timer is None:
                    self._timer = self._loop.call_later(wait_s, self._wire_has_room)
                return False
        try:
            sent = os.write(self._fd, data)
        except (BlockingIOError, InterruptedError):
            self._refused = True
            self._loop.add_writer(self._fd, self._flush)
            return False
        except OSError as error:
            # Not from inside write: the caller is in the middle of emptying its outbox.
            self._stop()
            self._loop.call_soon(self._say_lost, self._lost(error))
            return True
        if self._byte_s:
            self._last_start = max(now, self._wire_free)
            self._wire_free = self._last_start + len(data) * self._byte_s
        if sent < len(data):
            self._rest = data[sent:]
            self._loop.add_writer(self._fd, self._flush)
        return True

    async def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        self._open = False
        try:
            if not self._dead:
                await self._drain()
        finally:
            self._stop()
            # In a thread: the kernel may wait for a modem that holds its flow control.
            await Aside(f"{self._name} closes").run(self._close)

    async def _drain(self) -> None:
        """Let the frames that were taken leave whole, within a limit; nothing is received any more."""
        self._loop.remove_reader(self._fd)
        limit_s = min(DRAIN_LIMIT_S, max(0.0, self._wire_free - self._time()) + DRAIN_S)
        try:
            async with asyncio.timeout(limit_s):
                if self._rest:
                    self._drained = asyncio.Event()
                    await self._drained.wait()
                await asyncio.sleep(self._wire_free - self._time())
        except TimeoutError:
            pass

    def _read(self) -> None:
        try:
            data = os.read(self._fd, READ_BYTES)
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:
            self._lose(error)
            return
        if data:
            self._received(data, self._peer)
        else:
            self._lose()

    def _flush(self) -> None:
        """The descriptor has room: finish the frame that was cut, then say so."""
        if self._rest:
            try:
                self._rest = self._rest[os.write(self._fd, self._rest) :]
            except (BlockingIOError, InterruptedError):
                return
            except OSError as error:
                self._lose(error)
                return
            if self._rest:
                return
        self._loop.remove_writer(self._fd)
        if self._drained is not None:
            self._drained.set()
        if self._refused:
            self._refused = False
            self._say_writable()

    def _wire_has_room(self) -> None:
        self._timer = None
        if self._rest:
            self._refused = True
        else:
            self._say_writable()

    def _say_writable(self) -> None:
        if not self._closed:
            self._receiver.writable()

    def _say_lost(self, error: LinkError) -> None:
        if not self._closed:
            self._receiver.lost(error)

    def _lose(self, error: OSError | None = None) -> None:
        """The far end is gone, by `error` or by end of file."""
        self._stop()
        self._say_lost(self._lost(error))

    def _lost(self, error: OSError | None) -> LinkLost:
        if error is None or error.errno in UNPLUGGED:
            reason = "unplugged or disconnected"
        else:
            reason = os.strerror(error.errno or 0).lower()
        return LinkLost(f"{self._name}: gone ({reason})")

    def _stop(self) -> None:
        """Leave the descriptor alone from now on: nothing is read, written or said."""
        if self._dead:
            return
        self._dead = True
        self._open = False
        self._loop.remove_reader(self._fd)
        self._loop.remove_writer(self._fd)
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._drained is not None:
            self._drained.set()

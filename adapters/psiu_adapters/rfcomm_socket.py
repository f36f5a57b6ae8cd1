"""RFCOMM by the kernel's own sockets, for systems without BlueZ's D-Bus.

Through ctypes, because many builds of Python lack AF_BLUETOOTH in their socket module.
"""

import asyncio
import contextlib
import ctypes
import errno
import os
import socket
import sys

from psiu_broker.errors import LinkAbsent, LinkBusy, LinkError

AF_BLUETOOTH = 31
BTPROTO_RFCOMM = 3

BUFFER_BYTES = 2048

SILENT = {errno.EHOSTDOWN, errno.ETIMEDOUT, errno.ECONNABORTED, errno.ECONNRESET}
NO_CONTROLLER = {errno.EHOSTUNREACH, errno.ENODEV, errno.ENETDOWN, errno.ENETUNREACH}
NOT_PAIRED = {errno.EACCES, errno.EPERM, errno.EBADE, errno.EKEYREJECTED}


def sockaddr_rc(address: str, channel: int) -> bytes:
    """The kernel's address of `channel` on the device "98:D3:31:00:00:01": ten bytes, the address backwards."""
    family = AF_BLUETOOTH.to_bytes(2, sys.byteorder)
    return family + bytes.fromhex(address.replace(":", ""))[::-1] + bytes([channel, 0])


async def connect(address: str, channel: int, timeout_s: float) -> int:
    """A connected non-blocking descriptor; cancelling stops the call to the device.

    Raises:
        LinkError: in words for a person.
    """
    try:
        connection = socket.socket(AF_BLUETOOTH, socket.SOCK_STREAM, BTPROTO_RFCOMM)
    except OSError as error:
        raise explained(error, address, channel) from error
    try:
        async with asyncio.timeout(timeout_s):
            await connected(connection, sockaddr_rc(address, channel))
    except TimeoutError:
        connection.close()
        raise explained(OSError(errno.ETIMEDOUT, "timed out"), address, channel) from None
    except OSError as error:
        connection.close()
        raise explained(error, address, channel) from error
    except BaseException:
        connection.close()
        raise
    return connection.detach()


def hold_little(fd: int) -> None:
    """Let the kernel keep few frames for the robot: what it has taken no stop can overtake."""
    with socket.socket(fileno=os.dup(fd)) as connection, contextlib.suppress(OSError):
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)


async def connected(connection: socket.socket, sockaddr: bytes) -> None:
    """Connect to a raw socket address without blocking.

    Raises:
        OSError: as connect(2) would.
    """
    connection.setblocking(False)
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.connect(connection.fileno(), sockaddr, len(sockaddr)) == 0:
        return
    code = ctypes.get_errno()
    if code != errno.EINPROGRESS:
        raise OSError(code, os.strerror(code))
    loop = asyncio.get_running_loop()
    writable = asyncio.Event()
    loop.add_writer(connection, writable.set)
    try:
        await writable.wait()
    finally:
        loop.remove_writer(connection)
    code = connection.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
    if code:
        raise OSError(code, os.strerror(code))


def explained(error: OSError, address: str, channel: int) -> LinkError:
    """What `error` means for the person who wants `address`."""
    code = error.errno or 0
    if code in (errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT):
        return LinkAbsent("this kernel has no Bluetooth RFCOMM: modprobe rfcomm")
    if code in NO_CONTROLLER:
        return LinkAbsent("no Bluetooth controller is switched on: plug one in, or bluetoothctl power on")
    if code in SILENT:
        return LinkAbsent(f"{address} does not answer: switch it on and bring it into reach")
    if code == errno.ECONNREFUSED:
        return LinkBusy(
            f"{address} refuses channel {channel}: see that the channel is right and nothing else is connected"
        )
    if code in (errno.EBUSY, errno.EADDRINUSE):
        return LinkBusy(f"{address} is already connected by another process on channel {channel}")
    if code in NOT_PAIRED:
        return LinkAbsent(f"{address} wants to be paired first: bluetoothctl pair {address}")
    return LinkAbsent(f"{address}, channel {channel}: {os.strerror(code).lower()}")

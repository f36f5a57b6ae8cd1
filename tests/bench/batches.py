"""Many datagrams in one system call, so that the load costs less than what it measures.

Linux's sendmmsg(2) and recvmmsg(2), which the socket module lacks.
"""

import ctypes
import socket
from collections.abc import Sequence

SLOTS = 64
SLOT_BYTES = 256


class _Piece(ctypes.Structure):
    """struct iovec."""

    _fields_ = (("base", ctypes.c_void_p), ("size", ctypes.c_size_t))


class _Header(ctypes.Structure):
    """struct msghdr."""

    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_size", ctypes.c_uint32),
        ("pieces", ctypes.POINTER(_Piece)),
        ("pieces_count", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_size", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _Datagram(ctypes.Structure):
    """struct mmsghdr."""

    _fields_ = (("header", _Header), ("size", ctypes.c_uint))


_libc = ctypes.CDLL(None, use_errno=True)


class Volley:
    """Datagrams ready to be sent through a connected socket."""

    def __init__(self, datagrams: Sequence[bytes]) -> None:
        self._memory = ctypes.create_string_buffer(b"".join(datagrams))
        self._pieces = (_Piece * len(datagrams))()
        self._datagrams = (_Datagram * len(datagrams))()
        at = ctypes.addressof(self._memory)
        for datagram, piece, entry in zip(datagrams, self._pieces, self._datagrams, strict=True):
            piece.base, piece.size = at, len(datagram)
            entry.header.pieces, entry.header.pieces_count = ctypes.pointer(piece), 1
            at += len(datagram)

    def send(self, to: socket.socket, start: int, count: int) -> int:
        """Send `count` of them from `start` on; how many went."""
        first = ctypes.byref(self._datagrams, start * ctypes.sizeof(_Datagram))
        return max(0, int(_libc.sendmmsg(to.fileno(), first, count, socket.MSG_DONTWAIT)))


class Basket:
    """Catches what has come, up to 64 datagrams at once."""

    def __init__(self) -> None:
        self._memory = ctypes.create_string_buffer(SLOTS * SLOT_BYTES)
        self._view = memoryview(self._memory)
        self._pieces = (_Piece * SLOTS)()
        self._datagrams = (_Datagram * SLOTS)()
        for slot, (piece, entry) in enumerate(zip(self._pieces, self._datagrams, strict=True)):
            piece.base, piece.size = ctypes.addressof(self._memory) + slot * SLOT_BYTES, SLOT_BYTES
            entry.header.pieces, entry.header.pieces_count = ctypes.pointer(piece), 1

    def catch(self, receiving: socket.socket) -> list[bytes]:
        count = _libc.recvmmsg(receiving.fileno(), self._datagrams, SLOTS, socket.MSG_DONTWAIT, None)
        starts = range(0, max(0, count) * SLOT_BYTES, SLOT_BYTES)
        return [
            bytes(self._view[start : start + entry.size]) for start, entry in zip(starts, self._datagrams, strict=False)
        ]

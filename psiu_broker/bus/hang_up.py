"""Ending Zenoh's connections from outside.

Two sessions that connect to each other share one transport over two links. When both break and
only one side gives up, the other takes the new connection for a part of the old one and never
tells what it has declared (Zenoh's issue 2806); only the end of all their links mends that. Zenoh
offers no way to end a link, so the sockets of this process are shut down under it.
"""

import os
import re
import socket
from collections.abc import Collection, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

OPEN_FILES: Final = Path("/proc/self/fd")

_ADDRESS: Final = re.compile(r"(?:tcp|tls|ws|wss)/\[?(?P<host>[^\]\s]+?)\]?:(?P<port>\d+)(?:[?#].*)?")
_PATH: Final = re.compile(r"unixsock-stream/(?P<path>[^?#]+)")


def hang_up(links: Iterable[tuple[str, str]]) -> int:
    """Shut down the connections of this process with these endpoints, ours and theirs, as Zenoh names them.

    Returns how many there were.

    Raises:
        OSError: what files are open cannot be told: there are too many.
    """
    wanted = {
        (own, far) for ours, theirs in links if (own := _name(ours)) is not None and (far := _name(theirs)) is not None
    }
    wanted.discard(("", ""))
    ended = 0
    for number in [int(open_file.name) for open_file in OPEN_FILES.iterdir()] if wanted else []:
        with suppress(OSError):
            ended += _end(number, wanted)
    return ended


def _end(number: int, wanted: Collection[tuple[str, str]]) -> bool:
    """Shut the open file down if it is one of the connections. Raises OSError where it is none at all."""
    copy = os.dup(number)  # Zenoh may close its own at any moment, and another file may get the number
    try:
        connection = socket.socket(fileno=copy)
    except OSError:
        os.close(copy)
        raise
    with connection:
        if _ends(connection) not in wanted:
            return False
        connection.shutdown(socket.SHUT_RDWR)
        return True


def _ends(connection: socket.socket) -> tuple[str, str]:
    return _text(connection.getsockname()), _text(connection.getpeername())


def _text(address: Any) -> str:
    """An address of a socket in the form of `_name`."""
    match address:
        case (str(host), int(port), *_):
            return f"{host.removeprefix('::ffff:')}:{port}"
        case bytes():
            return os.fsdecode(address)
        case _:
            return str(address)


def _name(endpoint: str) -> str | None:
    """``tcp/127.0.0.1:7447`` as ``127.0.0.1:7447``; None for what is no stream.

    Of a Unix socket's two ends one has a path; the other has no name, whatever Zenoh calls it.
    """
    if found := _ADDRESS.fullmatch(endpoint):
        return f"{found['host'].removeprefix('::ffff:')}:{found['port']}"
    if found := _PATH.fullmatch(endpoint):
        return found["path"] if found["path"].startswith("/") else ""
    return None

"""The measure of all things here: the least that Python can do to a PSIU ASCII frame and still call it forwarded.

    python forwarder.py udp PORT [NAME=PORT ...] PORT [NAME=PORT ...]
    python forwarder.py pty DEVICE [NAME ...] DEVICE [NAME ...]

Two links, each with the robots behind it. A frame is checked (size, checksum), its destination looked up in one
dictionary, and the frame sent. No routes are learned, no doubles noticed, nothing is counted, queued or told.
"""

import asyncio
import os
import socket
import sys
from collections.abc import Callable, Iterator, Sequence
from zlib import adler32

DRAIN_DATAGRAMS = 32
LONGEST = 999
SIZES = tuple(b"%03d" % size for size in range(LONGEST + 1))

Send = Callable[[bytes], object]


def destination(data: bytes) -> bytes:
    """Whom the frame `data` is for; nobody if it is no whole, intact frame."""
    words = data.split(b" ", 2)
    size = len(data)
    # The low half of Adler-32 is 1 + the byte sum, up to 256 bytes.
    total = (adler32(data[:-5]) & 0xFFFF) - 1 if size <= 256 else sum(data[:-5]) & 0xFFFF
    if len(words) < 3 or size > LONGEST or words[1] != SIZES[size] or data[-5:] != b"%05d" % total:
        return b""
    return words[0]


def forward_datagrams(receiving: socket.socket, ways: dict[bytes, tuple[socket.socket, tuple[str, int]]]) -> None:
    recvfrom = receiving.recvfrom
    routes = {name: (sending.sendto, address) for name, (sending, address) in ways.items()}

    def read() -> None:
        for _ in range(DRAIN_DATAGRAMS):
            try:
                data, _ = recvfrom(2048)
            except BlockingIOError:
                return
            route = routes.get(destination(data))
            if route is not None:
                sendto, address = route
                sendto(data, address)

    asyncio.get_running_loop().add_reader(receiving.fileno(), read)


def forward_stream(fd: int, routes: dict[bytes, int]) -> None:
    """Frames stand in the stream without gaps; a piece of one waits for the rest."""
    waiting = b""

    def read() -> None:
        nonlocal waiting
        data = waiting + os.read(fd, 4096)
        start = 0
        while True:
            field = data.find(b" ", start) + 1
            size = data[field : field + 3]
            end = start + int(size) if field and size.isdigit() and len(size) == 3 else len(data) + 1
            if end > len(data):
                break
            frame = data[start:end]
            route = routes.get(destination(frame))
            if route is not None:
                os.write(route, frame)
            start = end
        waiting = data[start:]

    asyncio.get_running_loop().add_reader(fd, read)


def opened_socket(port: int) -> socket.socket:
    link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
    link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
    link.bind(("127.0.0.1", port))
    return link


def links(arguments: Sequence[str], is_link: Callable[[str], bool]) -> Iterator[tuple[str, list[str]]]:
    """Each link with the robots named behind it."""
    starts = [at for at, argument in enumerate(arguments) if is_link(argument)]
    for start, end in zip(starts, [*starts[1:], len(arguments)], strict=True):
        yield arguments[start], list(arguments[start + 1 : end])


async def main() -> None:
    kind, *arguments = sys.argv[1:]
    if kind == "udp":
        ways: dict[bytes, tuple[socket.socket, tuple[str, int]]] = {}
        sockets = []
        for port, robots in links(arguments, str.isdecimal):
            link = opened_socket(int(port))
            sockets.append(link)
            for name, _, robot_port in (robot.partition("=") for robot in robots):
                ways[name.encode()] = link, ("127.0.0.1", int(robot_port))
        for link in sockets:
            forward_datagrams(link, ways)
    else:
        routes: dict[bytes, int] = {}
        descriptors = []
        for path, robots in links(arguments, lambda argument: argument.startswith("/")):
            fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            descriptors.append(fd)
            routes.update((name.encode(), fd) for name in robots)
        for fd in descriptors:
            forward_stream(fd, routes)
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(main())

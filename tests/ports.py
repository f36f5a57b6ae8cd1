"""Ports of this computer that nobody uses."""

import itertools
import os
import random
import socket
from typing import Final

_WORKERS: Final = 8
"""That many processes may run tests at a time, each with ports of its own: `PYTEST_XDIST_WORKER` is gw0, gw1, …"""
_OURS: Final = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:]) % _WORKERS
# Below those that systems give to whoever asks for any, so that nobody else is given one before its test listens there.
_PORTS: Final = range(10_000 + _OURS, 30_000, _WORKERS)
_NEXT: Final = itertools.cycle(_PORTS)
# Two runs at a time begin elsewhere.
for _ in range(random.randrange(len(_PORTS))):
    next(_NEXT)


def free_port(kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    """One that this process was not told before; only after thousands they are told again."""
    for port in _NEXT:
        with socket.socket(socket.AF_INET, kind) as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
    raise AssertionError

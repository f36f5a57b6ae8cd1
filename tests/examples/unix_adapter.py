"""Links over a UNIX socket, for example to a simulator: adapter = "unix", path = "/run/arena.sock"."""

import socket

from pydantic import Field

from psiu_adapters.descriptor import DescriptorTransport
from psiu_broker.adapter import Adapter, Receiver, Transport
from psiu_broker.errors import LinkAbsent


class Unix(Adapter):
    path: str = Field(description="the socket's path")

    async def open(self, receiver: Receiver) -> Transport:
        wire = socket.socket(socket.AF_UNIX)
        wire.setblocking(False)
        try:
            wire.connect(self.path)
        except OSError as error:
            wire.close()
            raise LinkAbsent(f"{self.path}: {error.strerror}") from error
        return DescriptorTransport(wire.fileno(), receiver, close=wire.close, name=self.path)

"""A robot with a UDP socket, and the adapter that talks with it."""

import asyncio
import socket
from contextlib import suppress
from typing import Any

from adapter_contract import PATIENCE_S, FarEnd, Recorder

from psiu_adapters import udp_sockets
from psiu_adapters.udp import Udp
from psiu_broker.adapter import Transport

SILENCE_S = 0.05


class Robot(FarEnd):
    """A robot with a UDP socket of its own, and the adapter that knows it beforehand."""

    def __init__(self, family: int = socket.AF_INET, host: str = "127.0.0.1") -> None:
        self.socket = socket.socket(family, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        self.socket.bind((host, 0))
        self.peer = self.socket.getsockname()[:2]
        bracketed = f"[{host}]" if family == socket.AF_INET6 else host
        self.text = f"{bracketed}:{self.peer[1]}"
        self.adapter = Udp(listen=f"{bracketed}:0", peers=(self.text,))

    def meet(self, transport: Transport) -> None:
        self.broker = udp_sockets.numeric(str(transport.status()["listen"]))[1]  # type: ignore[index]

    async def say(self, data: bytes) -> None:
        assert self.socket.sendto(data, self.broker) == len(data)

    async def heard(self, size: int) -> bytes:
        data = b""
        async with asyncio.timeout(PATIENCE_S):
            while len(data) < size:
                data += await asyncio.get_running_loop().sock_recv(self.socket, 65536)
        return data

    async def hears_nothing(self) -> bool:
        with suppress(TimeoutError):
            async with asyncio.timeout(SILENCE_S):
                await asyncio.get_running_loop().sock_recv(self.socket, 65536)
                return False
        return True


async def open_for(recorder: Recorder, robots: list[Robot], **options: Any) -> Transport:
    transport = await Udp(**{"listen": "127.0.0.1:0", **options}).open(recorder)
    for each in robots:
        each.meet(transport)
    return transport

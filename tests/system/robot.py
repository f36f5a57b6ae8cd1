"""Robots that count: every order has a word of its own, so that a lost or doubled one is seen."""

import asyncio
import socket
import time
from collections.abc import Callable
from typing import cast

from psiu_broker.codecs import psiu_ascii
from psiu_broker.codecs.codec import Directory
from psiu_broker.codecs.psiu_ascii import PsiuAscii
from psiu_broker.frame import EVERYONE, Address, Frame

ORDER = "marca"
"""The command word of all orders; ``marca order17`` is answered with ``marca sucesso order17``."""
DONE = "sucesso"


class CountingRobot(asyncio.DatagramProtocol):
    """A PSIU ASCII robot on a UDP socket of a broker's namespace.

    `obeyed` has the times at which each order came, by its word, and `answers` those of the answers to its own;
    `news` is called after each.
    """

    def __init__(self, name: str, broker: tuple[str, int], news: Callable[[], None]) -> None:
        self.name = name
        self.obeyed: dict[str, list[float]] = {}
        self.answers: dict[str, list[float]] = {}
        self._own = Address.named(name)
        self._broker = broker
        self._news = news
        self._codec = PsiuAscii(PsiuAscii.Options(), Directory())
        self._transport: asyncio.DatagramTransport

    async def open(self, wire: socket.socket) -> None:
        """Speak and listen on `wire`; the broker asks who is there."""
        await asyncio.get_running_loop().create_datagram_endpoint(lambda: self, sock=wire)

    def close(self) -> None:
        self._transport.close()

    def order(self, robot: str, word: str) -> None:
        """Send one order, once."""
        self._send(Address.named(robot), ORDER, word)

    # asyncio.DatagramProtocol

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.DatagramTransport, transport)

    def datagram_received(self, data: bytes, addr: object) -> None:
        now = time.monotonic()
        for event in (*self._codec.decode(data, now), *self._codec.flush(now)):
            if isinstance(event, Frame):
                self._heard(event, now)

    def error_received(self, exc: Exception) -> None:
        """Its broker is down: what was sent is lost, as on any radio."""

    def _heard(self, frame: Frame, now: float) -> None:
        words = frame.payload.decode("ascii").split()
        match words:
            case ["qualseunome"] if frame.destination in (self._own, EVERYONE):
                self._send(frame.source, "qualseunome")
            case [command, outcome, word] if (command, outcome) == (ORDER, DONE) and frame.destination == self._own:
                self.answers.setdefault(word, []).append(now)
                self._news()
            case [command, word] if command == ORDER and frame.destination == self._own:
                self.obeyed.setdefault(word, []).append(now)
                self._news()
                self._send(frame.source, ORDER, DONE, word)

    def _send(self, destination: Address, *words: str) -> None:
        self._transport.sendto(self._codec.encode(psiu_ascii.message(self._own, destination, *words)), self._broker)

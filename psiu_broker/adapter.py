"""What an adapter must provide: everything that a new kind of link needs to know of the broker.

An adapter *is* its options: a frozen pydantic model whose fields are what the user writes in
``[links.NAME]``. `Adapter.open` gives a `Transport`; the transport hands what it reads to its
`Receiver`, on the event loop's thread and without waiting. An adapter is found by its entry point
in the group ``psiu_broker.adapters``; nothing outside this module and `psiu_broker.errors` is
meant for it.
"""

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Collection, Hashable, Mapping
from typing import ClassVar, Protocol

from pydantic import BaseModel, ConfigDict

from psiu_broker.errors import LinkError

Peer = Hashable
"""Who is at the far end: None where there is only one, ``(host, port)`` over UDP, an address over RFCOMM."""


class Receiver(Protocol):
    """The broker's end of a transport. None of these waits or raises."""

    def received(self, data: bytes, peer: Peer, /) -> None:
        """Bytes from `peer`: any piece of a stream, or exactly one datagram. An empty piece: `peer` has come."""

    def writable(self) -> None:
        """After a refused `Transport.write`: there is room again."""

    def peer_lost(self, peer: Peer, /) -> None:
        """`peer` is gone (disconnected, aged) while the transport goes on."""

    def lost(self, error: LinkError, /) -> None:
        """The transport is dead; said at most once, and not after `Transport.close`."""


class Transport(ABC):
    """An open way to one or more peers."""

    @abstractmethod
    def write(self, data: bytes, peer: Peer) -> bool:
        """Take one whole frame for `peer`; never waits, never raises.

        True: the frame is the transport's now and will leave whole or, if the transport is lost,
        not at all. False: no room (a peer that is gone counts as room: it is dropped, True);
        `Receiver.writable` follows when there is room. At most one frame's worth of wire time is
        taken beyond what the wire is carrying, so that a later, more urgent frame waits for one
        frame and not for a buffer full of them.
        """

    @property
    @abstractmethod
    def peers(self) -> Collection[Peer]:
        """Whom a frame to everyone goes to now; ``(None,)`` where there is only one far end."""

    @abstractmethod
    async def close(self) -> None:
        """Release everything; harmless twice."""

    def is_named(self, peer: Peer) -> bool:
        """Whether `peer` is this computer, or the adapter's options name it; asked only where it is `exposed`."""
        return False

    def status(self) -> Mapping[str, str | int | float]:
        """Facts for `psiu links`: the device behind a by-id name, datagrams lost, …"""
        return {}


class Adapter(BaseModel, ABC):
    """The options of one link and how to open it.

    A secret is a field with ``repr=False``: the broker tells it to nobody.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    datagrams: ClassVar[bool] = False
    """True: each `Receiver.received` is one whole datagram, so a frame never spans two of them."""

    @abstractmethod
    async def open(self, receiver: Receiver) -> Transport:
        """Open the link.

        Raises:
            LinkError: it cannot be opened now; the broker waits and tries again.
        """

    async def changed(self) -> None:
        """Return when opening has become worth another try (a device appeared); default: never."""
        await asyncio.Event().wait()

    @property
    def many_peers(self) -> bool:
        """Whether there may be more than one peer at a time; default: no."""
        return False

    def peer_named(self, text: str) -> Peer:
        """Whom ``peer = text`` of a robot means.

        Raises:
            ValueError: nobody; the text says what to write instead. Default: always.
        """
        raise ValueError("is for links with several far ends, and this one has a single one; remove it")

    @property
    def exposed(self) -> bool:
        """Whether other computers can reach the link without anybody's leave; default: no.

        Whoever comes from there, and is not `Transport.is_named`, may not command robots unless the policy says so.
        """
        return False

    @property
    def reliable_stream(self) -> bool:
        """Whether every byte arrives, unchanged and in order, or the transport is lost; default: no."""
        return False

    @property
    def bits_per_second(self) -> int | None:
        """What the line carries, ten bits a byte; None where it does not limit us."""
        return None

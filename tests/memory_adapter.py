"""An adapter whose far ends are lists: for tests of what stands above adapters."""

from collections.abc import Collection
from typing import ClassVar

from pydantic import BaseModel, ConfigDict, PrivateAttr

from psiu_broker.adapter import Adapter, Peer, Receiver, Transport
from psiu_broker.codecs.codec import Codec, Directory
from psiu_broker.config import LinkConfiguration, LinkOptions
from psiu_broker.errors import LinkAbsent, LinkError
from psiu_broker.protocols import CODECS


class MemoryTransport(Transport):
    """Remembers what was written; refuses while `full`, and `full_peers` always."""

    def __init__(self, peers: Collection[Peer] = (None,)) -> None:
        self.written: list[tuple[bytes, Peer]] = []
        self.full = False
        self.full_peers: set[Peer] = set()
        self.closed = False
        self.ends = list(peers)

    def write(self, data: bytes, peer: Peer) -> bool:
        full = self.full or peer in self.full_peers
        if not full:
            self.written.append((data, peer))
        return not full

    @property
    def peers(self) -> Collection[Peer]:
        return self.ends

    async def close(self) -> None:
        self.closed = True

    @property
    def wires(self) -> list[bytes]:
        return [data for data, _ in self.written]


class MemoryAdapter(Adapter):
    """Opens a `MemoryTransport`, unless told to fail."""

    model_config = ConfigDict(frozen=False)

    ends: tuple[Peer, ...] = (None,)
    transport_class: type[MemoryTransport] = MemoryTransport
    _transports: list[MemoryTransport] = PrivateAttr(default_factory=list)
    _failure: list[Exception] = PrivateAttr(default_factory=list)

    async def open(self, receiver: Receiver) -> MemoryTransport:
        if self._failure:
            raise self._failure[0]
        transport = self.transport_class(self.ends)
        self._transports.append(transport)
        return transport

    def fail(self, error: Exception | None = None) -> None:
        self._failure[:] = [error or LinkAbsent("nobody there; waiting")]

    def mend(self) -> None:
        self._failure.clear()

    @property
    def transport(self) -> MemoryTransport:
        return self._transports[-1]

    @property
    def openings(self) -> int:
        return len(self._transports)


class MemoryDatagrams(MemoryAdapter):
    datagrams: ClassVar[bool] = True


def configuration(
    name: str = "radio",
    protocol: str = "psiu-ascii",
    adapter: Adapter | None = None,
    codec: dict[str, object] | None = None,
    **options: object,
) -> LinkConfiguration:
    codec_options: BaseModel = CODECS[protocol].Options.model_validate(codec or {})
    link_options = LinkOptions.model_validate(options)
    return LinkConfiguration(name, "memory", adapter or MemoryAdapter(), protocol, codec_options, link_options)


def codec_of(link: LinkConfiguration, directory: Directory | None = None) -> Codec:
    return CODECS[link.protocol](link.codec, directory or Directory())


__all__ = ["LinkError", "MemoryAdapter", "MemoryDatagrams", "MemoryTransport", "codec_of", "configuration"]

"""UDP: every (host, port) is a peer; unicast, broadcast and multicast, IPv4 and IPv6."""

import asyncio
import errno
import logging
import os
import socket
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from typing import ClassVar, Self

from pydantic import Field, field_validator, model_validator

from psiu_adapters.aside import Aside
from psiu_adapters.udp_sockets import (
    NO_NETWORK,
    Address,
    bound,
    has_route,
    is_broadcast,
    is_loopback,
    is_multicast,
    is_own,
    joined,
    kernel_drops,
    numeric,
    resolve,
    split,
)
from psiu_broker.adapter import Adapter, Peer, Receiver, Transport
from psiu_broker.errors import LinkAbsent, LinkError, LinkLost

DATAGRAM_BYTES = 2048
DRAIN_DATAGRAMS = 32
DRAIN_BYTES = 4096
"""Where a turn of this link ends, whichever comes first: the other links wait for it, and a byte of garbage takes as
long here as on a stream, of which a turn reads no more."""
SWEEPS = 4
OTHER_PORTS = 256
"""How many of the ports that peers send from are remembered; the rest are looked up each time."""
RESOLVE_FIRST_S = 2.0
RESOLVE_LAST_S = 60.0
PASSING = {
    errno.ECONNREFUSED,
    errno.ECONNRESET,
    errno.EHOSTUNREACH,
    errno.EHOSTDOWN,
    errno.ENETUNREACH,
    errno.ENETDOWN,
    errno.ENETRESET,
    errno.ENOPROTOOPT,
    errno.EPROTO,
    errno.EMSGSIZE,
    errno.EACCES,
    errno.ENOBUFS,
    errno.ENOMEM,
    errno.EINTR,
}
"""What an ICMP message or a full queue may leave on a socket that stays good."""

log = logging.getLogger(__name__)


class Udp(Adapter):
    """A UDP socket, and who may talk through it."""

    datagrams: ClassVar[bool] = True

    listen: str = Field(
        description="host:port or [IPv6]:port to listen on, port 0 for any; broadcasts are heard only on 0.0.0.0"
    )
    peers: tuple[str, ...] = Field(
        default=(), description="host:port of each robot known beforehand, or of a broadcast or multicast group"
    )
    interface: str = Field(default="", description="name of the network interface for multicast groups, such as wlan0")
    learn: bool = Field(default=True, description="also talk with whoever sends to us; false: only with `peers`")
    max_peers: int = Field(default=64, ge=1, description="how many senders are learned; the rest are refused")
    peer_ttl_s: float = Field(default=300.0, ge=1, description="a learned sender silent for so long is forgotten")
    any_port: bool = Field(
        default=False, description="peers send from other ports than they listen on: know them by their host alone"
    )
    reuse: bool = Field(default=False, description="share the port with other programs that do the same")

    @field_validator("listen")
    @classmethod
    def _check_listen(cls, value: str) -> str:
        split(value)
        return value

    @field_validator("peers")
    @classmethod
    def _check_peers(cls, values: tuple[str, ...]) -> tuple[str, ...]:
        for value in values:
            if split(value)[1] == 0:
                raise ValueError(f"{value!r} has no port to send to: expected 1–65535")
        return values

    @model_validator(mode="after")
    def _check_families(self) -> Self:
        ours = numeric(self.listen)
        for peer in self.peers:
            theirs = numeric(peer)
            if ours and theirs and ours[0] != theirs[0]:
                raise ValueError(
                    f"listen = {self.listen!r} and the peer {peer!r} cannot talk: one IPv4, the other IPv6"
                )
        return self

    @model_validator(mode="after")
    def _check_hosts(self) -> Self:
        hosts = [split(peer)[0] for peer in self.peers]
        twice = next((host for host in hosts if hosts.count(host) > 1), None)
        if self.any_port and twice is not None:
            raise ValueError(f"any_port knows a peer by its host, and two of them are at {twice}; leave it out")
        return self

    @property
    def many_peers(self) -> bool:
        numbers = map(numeric, self.peers)
        return self.learn or len(self.peers) > 1 or any(found and is_multicast(found[1]) for found in numbers)

    @property
    def exposed(self) -> bool:
        """Where whoever sends is learned, unless nothing beyond this computer can send there."""
        return self.learn and not is_loopback(split(self.listen)[0])

    def peer_named(self, text: str) -> Peer:
        try:
            found = numeric(text)
        except ValueError:
            found = None
        if found is None:
            raise ValueError(f'expected "ADDRESS:PORT", got "{text}"; write it in numbers, like "192.168.1.20:9001"')
        if found not in map(numeric, self.peers):
            raise ValueError(f"{text} is not among the peers of its link; add it there")
        return _peer(found[1])

    @cached_property
    def _aside(self) -> Aside:
        """At most one thread of a link waits for the name server, however often the link is opened."""
        return Aside(f"{self.listen} resolves")

    async def open(self, receiver: Receiver) -> Transport:
        family, address = (await resolve(self.listen, socket.AF_UNSPEC, self._aside))[0]
        transport = _UdpTransport(
            self, family, bound(family, address, self.listen, reuse=self.reuse), receiver, self._aside
        )
        try:
            await transport.begin()
        except BaseException:
            await transport.close()
            raise
        return transport


def _peer(address: Address) -> tuple[str, int]:
    return address[0], address[1]


class _Entry:
    """One peer: the very object that `Receiver.received` is told, where to send, and how long it has been silent."""

    __slots__ = ("address", "fixed", "peer", "silent")

    def __init__(self, address: Address, fixed: bool) -> None:
        self.peer = _peer(address)
        self.address = address
        self.fixed = fixed
        self.silent = 0


class _UdpTransport(Transport):
    """`_by_address` answers "who sent this", `_by_peer` "where to"; both hold the same entries."""

    def __init__(self, options: Udp, family: int, main: socket.socket, receiver: Receiver, aside: Aside) -> None:
        self._options = options
        self._family = family
        self._receiver = receiver
        self._loop = asyncio.get_running_loop()
        self._main = main
        self._sendto = main.sendto
        self._sockets = [main]
        self._by_address: dict[Address, _Entry] = {}
        self._by_peer: dict[Peer, _Entry] = {}
        self._everyone: tuple[Peer, ...] = ()
        self._groups = False
        self._own: set[Address] = set()
        self._reading = False
        self._aside = aside
        self._placed: dict[str, Address] = {}
        self._looked_up = asyncio.Event()
        self._learned = 0
        self._refused = 0
        self._oversized = 0
        self._send_errors = 0
        self._last_send_error = ""
        self._closed = False
        self._sweeper: asyncio.TimerHandle | None = None
        self._resolver: asyncio.Task[None] | None = None

    async def begin(self) -> None:
        """Find the fixed peers, join their groups, and read from now on.

        Raises:
            LinkError: a group cannot be joined, or the network of every peer is down.
        """
        names = []
        for text in self._options.peers:
            if found := numeric(text):
                self._add_fixed(text, found[1])
            else:
                names.append(text)
        if names:
            self._resolver = self._loop.create_task(self._follow(names))
            with suppress(TimeoutError):
                async with asyncio.timeout(RESOLVE_FIRST_S):
                    await self._looked_up.wait()
        if self._by_address and not self._has_network():
            raise LinkAbsent(f"{self._options.listen}: no network leads to its peers; waiting for one")
        for receiving in self._sockets:
            self._read_from(receiving)
        self._reading = True
        self._sweeper = self._loop.call_later(self._options.peer_ttl_s / SWEEPS, self._sweep)

    @property
    def peers(self) -> Collection[Peer]:
        """Fixed and learned; the fixed alone where a group is among them, or its members would hear all twice."""
        return self._everyone

    def is_named(self, peer: Peer) -> bool:
        entry = self._by_peer.get(peer)
        return entry is not None and (entry.fixed or is_loopback(entry.address[0]))

    def write(self, data: bytes, peer: Peer) -> bool:
        entry = self._by_peer.get(peer)
        if entry is None:
            return True
        try:
            self._sendto(data, entry.address)
        except BlockingIOError:
            self._loop.add_writer(self._main.fileno(), self._has_room)
            return False
        except OSError as error:
            self._send_failed(error)
        return True

    async def close(self) -> None:
        if not self._closed:
            self._stop()
        if self._resolver is not None:
            await asyncio.wait({self._resolver})

    def status(self) -> Mapping[str, str | int | float]:
        facts: dict[str, str | int | float] = {
            "peers": len(self._by_peer),
            "refused": self._refused,
            "oversized": self._oversized,
            "send_errors": self._send_errors,
        }
        if not self._closed:
            host, port = self._main.getsockname()[:2]
            facts["listen"] = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
            facts["lost"] = sum(map(kernel_drops, self._sockets))
        if self._last_send_error:
            facts["last_send_error"] = self._last_send_error
        if unresolved := [text for text in self._options.peers if text not in self._placed]:
            facts["unresolved"] = ", ".join(unresolved)
        return facts

    def _read_from(self, receiving: socket.socket) -> None:
        self._loop.add_reader(receiving.fileno(), self._reader(receiving))

    def _reader(self, receiving: socket.socket) -> Callable[[], None]:
        """The callback for a readable socket: what it needs is bound once, for it runs for every datagram."""
        recvfrom = receiving.recvfrom
        known = self._by_address.get
        received = self._receiver.received
        turns = range(DRAIN_DATAGRAMS)
        too_long = DATAGRAM_BYTES + 1

        def read() -> None:
            room = DRAIN_BYTES
            for _ in turns:
                try:
                    data, address = recvfrom(too_long)
                except BlockingIOError:
                    return
                except OSError as error:
                    if error.errno in PASSING:
                        continue
                    self._lose(error)
                    return
                entry = known(address)
                if entry is None:
                    entry = self._stranger(address)
                    if entry is None:
                        continue
                entry.silent = 0
                size = len(data)
                if size == too_long:
                    self._oversized += 1
                    data = data[:-1]
                received(data, entry.peer)
                room -= size
                if room <= 0:
                    return

        return read

    def _stranger(self, address: Address) -> _Entry | None:
        """The new entry for `address`; None if it is ourselves, or one too many."""
        if self._groups and (address in self._own or is_own(self._main, address)):
            self._own.add(address)
            return None
        entry = self._elsewhere(address) if self._options.any_port else None
        if entry is not None:
            return entry
        if not self._options.learn or self._learned >= self._options.max_peers:
            self._refused += 1
            return None
        self._learned += 1
        return self._add(address, fixed=False)

    def _elsewhere(self, address: Address) -> _Entry | None:
        """The fixed peer at this host, which sends from another port than the one it listens on."""
        entry = next((each for each in self._by_peer.values() if each.fixed and each.address[0] == address[0]), None)
        if entry is not None and len(self._by_address) - len(self._by_peer) < OTHER_PORTS:
            self._by_address[address] = entry
        return entry

    def _add(self, address: Address, *, fixed: bool) -> _Entry:
        entry = self._by_address.get(address)
        if entry is None:
            entry = _Entry(address, fixed)
            self._by_address[address] = self._by_peer[entry.peer] = entry
        elif fixed and not entry.fixed:
            entry.fixed = True
            self._learned -= 1
        self._count_everyone()
        return entry

    def _count_everyone(self) -> None:
        self._everyone = tuple(entry.peer for entry in self._by_peer.values() if entry.fixed or not self._groups)

    def _sweep(self) -> None:
        """Forget the learned peers that were silent for all of `peer_ttl_s`."""
        self._sweeper = self._loop.call_later(self._options.peer_ttl_s / SWEEPS, self._sweep)
        gone = []
        for entry in self._by_peer.values():
            entry.silent += 1
            if entry.silent > SWEEPS and not entry.fixed:
                gone.append(entry)
        if not gone:
            return
        for entry in gone:
            del self._by_address[entry.address], self._by_peer[entry.peer]
        self._learned -= len(gone)
        self._count_everyone()
        for entry in gone:
            self._receiver.peer_lost(entry.peer)

    async def _follow(self, names: Sequence[str]) -> None:
        """Add the fixed peers that are known by name once they have an address, and go along when they move."""
        pause_s = RESOLVE_FIRST_S
        while True:
            for text in names:
                try:
                    found = await resolve(text, self._family, self._aside)
                    self._place(text, [address for _, address in found])
                except LinkError as error:
                    log.debug("%s", error)
            self._looked_up.set()
            await asyncio.sleep(pause_s)
            pause_s = min(2 * pause_s, RESOLVE_LAST_S)

    def _place(self, text: str, addresses: Sequence[Address]) -> None:
        """The fixed peer `text` has these addresses now: it stays where it is if that is one of them."""
        before = self._placed.get(text)
        if before in addresses or (before is not None and is_multicast(before)):
            return
        self._add_fixed(text, addresses[0])
        if before is not None and before not in self._placed.values():
            entry = self._by_address[before]
            for address in [address for address, each in self._by_address.items() if each is entry]:
                del self._by_address[address]
            del self._by_peer[entry.peer]
            self._count_everyone()
            self._receiver.peer_lost(entry.peer)

    def _add_fixed(self, text: str, address: Address) -> None:
        if is_multicast(address):
            extra = joined(self._main, address, self._options.interface)
            if extra is not None:
                self._sockets.append(extra)
                if self._reading:
                    self._read_from(extra)
            self._groups = True
        elif is_broadcast(self._family, address):
            self._groups = True
        self._placed[text] = address
        self._add(address, fixed=True)

    def _has_room(self) -> None:
        self._loop.remove_writer(self._main.fileno())
        self._receiver.writable()

    def _send_failed(self, error: OSError) -> None:
        self._send_errors += 1
        self._last_send_error = os.strerror(error.errno or 0).lower()
        if error.errno in NO_NETWORK and not self._has_network():
            # Not from inside write: the caller is in the middle of emptying its outbox.
            self._loop.call_soon(self._lose, error)

    def _has_network(self) -> bool:
        """Whether there is a way to any peer: a single one without may be wrong, all of them mean no network."""
        return any(has_route(self._family, address) for address in self._by_address)

    def _lose(self, error: OSError) -> None:
        if not self._closed:
            self._stop()
            self._receiver.lost(LinkLost(f"{self._options.listen}: {os.strerror(error.errno or 0).lower()}"))

    def _stop(self) -> None:
        self._closed = True
        self._by_address.clear()
        self._by_peer.clear()
        self._everyone = ()
        if self._sweeper is not None:
            self._sweeper.cancel()
        if self._resolver is not None:
            self._resolver.cancel()
        for each in self._sockets:
            self._loop.remove_reader(each.fileno())
            self._loop.remove_writer(each.fileno())
            each.close()

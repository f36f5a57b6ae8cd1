"""UDP sockets as the adapter needs them: addresses read, bound, groups joined; refusals in words."""

import errno
import ipaddress
import logging
import os
import re
import socket
import struct
from typing import Any

from psiu_adapters.aside import Aside
from psiu_broker.errors import LinkAbsent, LinkBusy, LinkError

Address = tuple[Any, ...]
"""As the socket module has it: ``(host, port)``, with flow and scope behind for IPv6."""

RECEIVE_BUFFER_BYTES = 1 << 20
HOST_PORT = re.compile(r"(?:\[(?P<v6>[^\[\]]+)\]|(?P<host>[^:\[\]\s]+)):(?P<port>[0-9]{1,5})")

# Linux's numbers, which the socket module of Python 3.11 lacks.
IP_MULTICAST_ALL = 49
IPV6_MULTICAST_ALL = 29
SO_MEMINFO = 55
MEMINFO_DROPS = 8

NO_NETWORK = {errno.ENETUNREACH, errno.ENETDOWN}

log = logging.getLogger(__name__)


def split(text: str) -> tuple[str, int]:
    """Host and port of ``host:port`` or ``[IPv6]:port``.

    Raises:
        ValueError: it is neither.
    """
    match = HOST_PORT.fullmatch(text)
    if not match or int(match["port"]) > 65535:
        raise ValueError(f"expected host:port, such as 127.0.0.1:9000 or [::1]:9000, got {text!r}")
    host = match["v6"] or match["host"]
    try:
        host.encode("idna")
    except UnicodeError:
        raise ValueError(
            f"got {text!r}: no host can be called {host!r}, whose parts between dots must have 1 to 63 letters"
        ) from None
    return host, int(match["port"])


def numeric(text: str) -> tuple[int, Address] | None:
    """Family and address of ``host:port``; None where the host is a name, which takes time to find."""
    host, port = split(text)
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM, flags=socket.AI_NUMERICHOST)
    except socket.gaierror:
        return None
    return found[0][0], found[0][4]


async def resolve(text: str, family: int, aside: Aside) -> list[tuple[int, Address]]:
    """Family and address of ``host:port``, and of every other address that the host has.

    Raises:
        LinkAbsent: the name has no address of this family (now).
    """
    if known := numeric(text):
        return [known]
    host, port = split(text)
    try:
        found = await aside.run(lambda: socket.getaddrinfo(host, port, family, socket.SOCK_DGRAM))
    except OSError as error:
        raise LinkAbsent(f"{text}: cannot find the address of {host} ({error.strerror})") from error
    return [(each[0], each[4]) for each in found]


def bound(family: int, address: Address, text: str, *, reuse: bool) -> socket.socket:
    """A non-blocking socket bound to `address`, which the user wrote as `text`.

    Raises:
        LinkError: and its kinds, when it cannot be bound now.
    """
    opened = socket.socket(family, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
    try:
        if reuse:
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        # Linux hands every socket the groups that any other program has joined, unless told not to.
        if family == socket.AF_INET6:
            opened.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
            opened.setsockopt(socket.IPPROTO_IPV6, IPV6_MULTICAST_ALL, 0)
        else:
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            opened.setsockopt(socket.IPPROTO_IP, IP_MULTICAST_ALL, 0)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        opened.bind(address)
    except OSError as error:
        opened.close()
        raise _refusal(text, error) from error
    # The kernel doubles the figure for its own use.
    actual = opened.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2
    if actual < RECEIVE_BUFFER_BYTES:
        log.warning(
            "%s: the kernel gives a receive buffer of %d KiB, not %d; bursts may be lost (sysctl net.core.rmem_max=%d)",
            text,
            actual // 1024,
            RECEIVE_BUFFER_BYTES // 1024,
            RECEIVE_BUFFER_BYTES,
        )
    return opened


def joined(main: socket.socket, group: Address, interface: str) -> socket.socket | None:
    """Join the multicast `group` on `interface` ("" for what `main` is bound to, else what the routes say).

    Returns a second socket to read the group from, or None where `main` hears it itself.

    Raises:
        LinkError: there is no such interface, or the group cannot be joined on it.
    """
    text = f"{group[0]}:{group[1]}"
    try:
        index = socket.if_nametoindex(interface) if interface else 0
    except OSError as error:
        raise LinkAbsent(f"{text}: there is no network interface {interface!r}; waiting for it") from error
    host, port = main.getsockname()[:2]
    hears = port == group[1] and ipaddress.ip_address(host.partition("%")[0]).is_unspecified
    if main.family == socket.AF_INET6:
        index = index or group[3]
        group = (*group[:3], index)
    extra = None if hears else bound(main.family, group, text, reuse=True)
    receiving = extra or main
    try:
        if main.family == socket.AF_INET6:
            binary = socket.inet_pton(socket.AF_INET6, group[0].partition("%")[0])
            receiving.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_JOIN_GROUP, binary + struct.pack("@I", index))
            main.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_IF, index)
        else:
            membership = struct.pack("@4s4si", socket.inet_aton(group[0]), socket.inet_aton(host), index)
            receiving.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
            main.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, membership)
    except OSError as error:
        if extra is not None:
            extra.close()
        raise LinkAbsent(f"{text}: cannot join the group ({os.strerror(error.errno or 0).lower()})") from error
    return extra


def is_loopback(host: str) -> bool:
    """Whether nothing but this computer sends from, or to, `host`; of a name only localhost is known."""
    try:
        return ipaddress.ip_address(host.partition("%")[0]).is_loopback
    except ValueError:
        return host == "localhost"


def is_multicast(address: Address) -> bool:
    return ipaddress.ip_address(address[0].partition("%")[0]).is_multicast


def is_broadcast(family: int, address: Address) -> bool:
    """Whether the kernel's routes know `address` as a broadcast one: it asks for permission to send there."""
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(address)
        except PermissionError:
            return True
        except OSError:
            return bool(address[0] == "255.255.255.255")
    return False


def has_route(family: int, address: Address) -> bool:
    """Whether the kernel knows a way to `address`, or at least does not say that there is none."""
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(address)
        except OSError as error:
            return error.errno not in NO_NETWORK
    return True


def is_own(main: socket.socket, address: Address) -> bool:
    """Whether what comes from `address` was sent by `main` itself."""
    host, port = main.getsockname()[:2]
    if address[1] != port:
        return False
    if not ipaddress.ip_address(host.partition("%")[0]).is_unspecified:
        return bool(address[0] == host)
    with socket.socket(main.family, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((address[0], 0, *address[2:]))
        except OSError:
            return False
    return True


def kernel_drops(receiving: socket.socket) -> int:
    """Datagrams that came while the receive buffer was full."""
    try:
        facts = receiving.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, 4 * (MEMINFO_DROPS + 1))
        return int(struct.unpack_from("@I", facts, 4 * MEMINFO_DROPS)[0])
    except (OSError, struct.error):
        return 0


def _refusal(text: str, error: OSError) -> LinkError:
    if error.errno == errno.EADDRINUSE:
        return LinkBusy(f"{text}: another program listens on this port")
    if error.errno == errno.EADDRNOTAVAIL:
        return LinkAbsent(f"{text}: no network interface has this address; waiting for it")
    if error.errno == errno.EACCES:
        return LinkBusy(f"{text}: permission denied; ports below 1024 are for root")
    return LinkError(f"{text}: {os.strerror(error.errno or 0).lower()}")

"""UDP groups: multicast and broadcast, told and heard without our own echo."""

import asyncio
import socket
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from adapter_contract import PATIENCE_S, Recorder, open_descriptors
from udp_robot import Robot

from psiu_adapters.udp import Udp
from psiu_broker.errors import LinkAbsent

GROUP = "239.255.83.105"
INTERFACES_IPV6 = [
    line.split()[5]
    for line in (Path("/proc/net/if_inet6").read_text().splitlines() if Path("/proc/net/if_inet6").exists() else [])
    if line.startswith("fe80")
]


def group_member(port: int = 0) -> socket.socket:
    """A robot's socket that hears the multicast group on the loopback interface."""
    member = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    member.setblocking(False)
    member.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    member.bind((GROUP, port))
    index = socket.if_nametoindex("lo")
    where = struct.pack("@4s4si", socket.inet_aton(GROUP), bytes(4), index)
    member.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, where)
    return member


@pytest.fixture
def member() -> Iterator[socket.socket]:
    with group_member() as opened:
        yield opened


async def hear(member: socket.socket) -> bytes:
    async with asyncio.timeout(PATIENCE_S):
        return await asyncio.get_running_loop().sock_recv(member, 65536)


class TestGroups:
    @pytest.mark.parametrize("listen", ["127.0.0.1:0", "0.0.0.0:0", "0.0.0.0:same"])
    async def test_a_multicast_group_is_told_and_heard_without_our_own_echo(
        self, member: socket.socket, robot: Robot, recorder: Recorder, listen: str
    ) -> None:
        group = (GROUP, member.getsockname()[1])
        text = f"{GROUP}:{group[1]}"
        before = open_descriptors()
        transport = await Udp(
            listen=listen.replace("same", str(group[1])),
            peers=(text,),
            interface="lo",
            reuse=listen.endswith("same"),
        ).open(recorder)
        assert list(transport.peers) == [group]
        assert transport.write(b"to all", group) is True
        assert await hear(member) == b"to all"
        robot.socket.setsockopt(
            socket.IPPROTO_IP,
            socket.IP_MULTICAST_IF,
            struct.pack("@4s4si", bytes(4), bytes(4), socket.if_nametoindex("lo")),
        )
        robot.socket.sendto(b"from one", group)
        await recorder.until(lambda: recorder.heard)
        assert recorder.heard == [(b"from one", robot.peer)]
        assert transport.write(b"to one", robot.peer) is True
        assert await robot.heard(1) == b"to one"
        assert list(transport.peers) == [group], "members would hear a frame to everyone twice"
        await transport.close()
        assert open_descriptors() == before

    async def test_two_brokers_in_one_group_hear_each_other(self, recorder: Recorder) -> None:
        with group_member() as member:
            text = f"{GROUP}:{member.getsockname()[1]}"
        other = Recorder()
        one = await Udp(listen="127.0.0.1:0", peers=(text,), interface="lo").open(recorder)
        two = await Udp(listen="127.0.0.1:0", peers=(text,), interface="lo").open(other)
        assert one.write(b"one", *one.peers) is True
        await other.until(lambda: other.heard)
        assert two.write(b"two", *two.peers) is True
        await recorder.until(lambda: recorder.heard)
        assert (recorder.data, other.data) == (b"two", b"one")
        await one.close()
        await two.close()

    async def test_multicast_stays_on_the_local_network(self, recorder: Recorder) -> None:
        transport = await Udp(listen="127.0.0.1:0", peers=(f"{GROUP}:9",), interface="lo").open(recorder)
        main = transport._main  # type: ignore[attr-defined]
        assert main.getsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL) == 1
        await transport.close()

    async def test_groups_that_other_programs_joined_are_not_heard(
        self, member: socket.socket, robot: Robot, recorder: Recorder
    ) -> None:
        port = member.getsockname()[1]
        transport = await Udp(listen=f"0.0.0.0:{port}", reuse=True).open(recorder)
        index = socket.if_nametoindex("lo")
        robot.socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, struct.pack("@8xi", index))
        robot.socket.sendto(b"to the group", (GROUP, port))
        robot.socket.sendto(b"to us", ("127.0.0.1", port))
        await recorder.until(lambda: recorder.heard)
        assert recorder.data == b"to us"
        await transport.close()

    async def test_a_group_that_cannot_be_joined_is_a_link_error_in_one_line(
        self, recorder: Recorder, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(socket, "IP_ADD_MEMBERSHIP", 9999)
        with pytest.raises(LinkAbsent, match=r"cannot join the group \(protocol not available\)"):
            await Udp(listen="127.0.0.1:0", peers=(f"{GROUP}:9",), interface="lo").open(recorder)

    async def test_an_interface_that_is_not_there_is_waited_for(self, recorder: Recorder) -> None:
        before = open_descriptors()
        with pytest.raises(LinkAbsent, match="there is no network interface 'wlan93'"):
            await Udp(listen="127.0.0.1:0", peers=(f"{GROUP}:9",), interface="wlan93").open(recorder)
        assert open_descriptors() == before

    @pytest.mark.skipif(not INTERFACES_IPV6, reason="no network interface with IPv6 here")
    async def test_an_ipv6_group_is_told_and_heard_without_our_own_echo(self, recorder: Recorder) -> None:
        other = Recorder()
        options: dict[str, Any] = {
            "listen": "[::]:0",
            "peers": ("[ff02::7073]:47111",),
            "interface": INTERFACES_IPV6[0],
        }
        one = await Udp(**options).open(recorder)
        two = await Udp(**options).open(other)
        for each in (one, two):
            # Hop limit 0: the datagrams of a test stay inside this machine.
            each._main.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_HOPS, 0)  # type: ignore[attr-defined]
        assert one.write(b"one", *one.peers) is True
        await other.until(lambda: other.heard)
        assert two.write(b"to one", other.heard[0][1]) is True
        await recorder.until(lambda: recorder.heard)
        assert (recorder.data, other.data) == (b"to one", b"one")
        await one.close()
        await two.close()

    async def test_a_broadcast_reaches_all_without_our_own_echo(self, recorder: Recorder) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("0.0.0.0", 0))
            port = probe.getsockname()[1]
        peer = ("127.255.255.255", port)
        other = Recorder()
        # As two machines on one network would be, each on the port that the broadcasts go to.
        options: dict[str, Any] = {"peers": (f"127.255.255.255:{port}",), "reuse": True}
        one = await Udp(listen=f"0.0.0.0:{port}", **options).open(recorder)
        two = await Udp(listen=f"127.255.255.255:{port}", **options).open(other)
        assert one.write(b"to all", peer) is True
        await other.until(lambda: other.heard)
        assert other.data == b"to all"
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as robot:
            robot.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            robot.bind(("127.0.0.1", 0))
            robot.sendto(b"from one", peer)
            await recorder.until(lambda: recorder.heard)
            assert recorder.heard == [(b"from one", robot.getsockname())]
        assert list(one.peers) == [peer]
        await one.close()
        await two.close()

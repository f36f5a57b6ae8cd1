"""The UDP adapter on real sockets: loopback, IPv6, groups, and peers that come and go."""

import asyncio
import errno
import logging
import os
import socket
import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar

import pytest
from adapter_contract import FRAME, PATIENCE_S, AdapterContract, FarEnd, Recorder, open_descriptors
from pydantic import ValidationError

from psiu_adapters import udp, udp_sockets
from psiu_adapters.udp import Udp
from psiu_broker.adapter import Adapter, Transport
from psiu_broker.errors import LinkAbsent, LinkBusy

GROUP = "239.255.83.105"
SILENCE_S = 0.05
INTERFACES_IPV6 = [
    line.split()[5]
    for line in (Path("/proc/net/if_inet6").read_text().splitlines() if Path("/proc/net/if_inet6").exists() else [])
    if line.startswith("fe80")
]


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


@pytest.fixture
async def recorder() -> Recorder:
    return Recorder()


@pytest.fixture
def robot() -> Iterator[Robot]:
    far = Robot()
    yield far
    far.socket.close()


@pytest.fixture
def strangers() -> Iterator[list[Robot]]:
    far = [Robot() for _ in range(4)]
    yield far
    for each in far:
        each.socket.close()


class TestContract(AdapterContract):
    losable: ClassVar[bool] = False
    refuses: ClassVar[bool] = False

    @pytest.fixture
    def far(self, robot: Robot) -> Robot:
        return robot

    @pytest.fixture
    def absent(self) -> Adapter:
        return Udp(listen="192.0.2.250:9000")


@pytest.mark.skipif(not socket.has_ipv6, reason="no IPv6 here")
class TestContractIPv6(TestContract):
    @pytest.fixture
    def far(self) -> Iterator[Robot]:
        far = Robot(socket.AF_INET6, "::1")
        yield far
        far.socket.close()


async def open_for(recorder: Recorder, robots: list[Robot], **options: Any) -> Transport:
    transport = await Udp(**{"listen": "127.0.0.1:0", **options}).open(recorder)
    for each in robots:
        each.meet(transport)
    return transport


class TestPeers:
    async def test_several_robots_on_one_port_each_get_their_own_answers(
        self, strangers: list[Robot], recorder: Recorder
    ) -> None:
        transport = await open_for(recorder, strangers)
        for number, each in enumerate(strangers):
            await each.say(b"robot %d" % number)
        await recorder.until(lambda: len(recorder.heard) == 4)
        assert {peer for _, peer in recorder.heard} == {each.peer for each in strangers}
        for data, peer in recorder.heard:
            assert transport.write(b"to " + data, peer) is True
        for number, each in enumerate(strangers):
            assert await each.heard(1) == b"to robot %d" % number
        await transport.close()

    async def test_each_datagram_is_received_by_itself(self, robot: Robot, recorder: Recorder) -> None:
        transport = await open_for(recorder, [robot])
        for number in range(100):
            await robot.say(b"%d" % number)
        await recorder.until(lambda: len(recorder.heard) == 100)
        assert [data for data, _ in recorder.heard] == [b"%d" % number for number in range(100)]
        await transport.close()

    async def test_one_wake_up_reads_no_more_than_its_share(self, robot: Robot, recorder: Recorder) -> None:
        transport = await open_for(recorder, [robot])
        for _ in range(3 * udp.DRAIN_DATAGRAMS):
            await robot.say(FRAME)
        await recorder.until(lambda: recorder.heard)
        assert len(recorder.heard) == udp.DRAIN_DATAGRAMS
        await recorder.until(lambda: len(recorder.heard) == 3 * udp.DRAIN_DATAGRAMS)
        await transport.close()

    async def test_an_empty_datagram_is_not_the_end(self, robot: Robot, recorder: Recorder) -> None:
        transport = await open_for(recorder, [robot])
        await robot.say(b"")
        await robot.say(b"after")
        await recorder.until(lambda: len(recorder.heard) == 2)
        assert recorder.losses == []
        await transport.close()

    async def test_a_learned_sender_is_a_peer_from_its_first_datagram(self, robot: Robot, recorder: Recorder) -> None:
        transport = await open_for(recorder, [robot])
        assert list(transport.peers) == []
        await robot.say(b"hello")
        await recorder.until(lambda: recorder.heard)
        assert list(transport.peers) == [robot.peer]
        await transport.close()

    async def test_senders_beyond_the_cap_are_refused_and_counted(
        self, strangers: list[Robot], recorder: Recorder
    ) -> None:
        transport = await open_for(recorder, strangers, max_peers=2)
        for each in (*strangers, strangers[0]):
            await each.say(b"hello")
        await recorder.until(lambda: len(recorder.heard) == 3)
        assert list(transport.peers) == [each.peer for each in strangers[:2]]
        assert transport.status()["refused"] == 2
        assert transport.write(b"refused", strangers[2].peer) is True
        assert await strangers[2].hears_nothing()
        await transport.close()

    async def test_without_learning_only_the_fixed_peers_are_heard(
        self, strangers: list[Robot], recorder: Recorder
    ) -> None:
        known, unknown = strangers[:2]
        transport = await open_for(recorder, strangers, learn=False, peers=(known.text,))
        await unknown.say(b"no")
        await known.say(b"yes")
        await recorder.until(lambda: recorder.heard)
        assert recorder.data == b"yes"
        assert transport.status()["refused"] == 1
        await transport.close()

    async def test_a_silent_learned_peer_is_forgotten_and_a_fixed_one_never(
        self, strangers: list[Robot], recorder: Recorder
    ) -> None:
        fixed, silent, talking = strangers[:3]
        transport = await open_for(recorder, strangers, peer_ttl_s=0.2, peers=(fixed.text,))
        loop = asyncio.get_running_loop()
        began = loop.time()
        await silent.say(b"once")
        await talking.say(b"first")

        async def talk() -> None:
            while True:
                await talking.say(b"and on")
                await asyncio.sleep(0.02)

        chatter = asyncio.create_task(talk())
        await recorder.until(lambda: recorder.gone)
        assert loop.time() - began >= 0.2
        assert recorder.gone == [silent.peer]
        assert set(transport.peers) == {fixed.peer, talking.peer}
        assert transport.write(b"too late", silent.peer) is True
        assert await silent.hears_nothing()
        chatter.cancel()
        await recorder.until(lambda: talking.peer in recorder.gone)
        assert list(transport.peers) == [fixed.peer]
        await transport.close()

    async def test_a_forgotten_peer_makes_room_for_another(self, strangers: list[Robot], recorder: Recorder) -> None:
        transport = await open_for(recorder, strangers, peer_ttl_s=0.1, max_peers=1)
        await strangers[0].say(b"first")
        await recorder.until(lambda: recorder.gone)
        await strangers[1].say(b"second")
        await recorder.until(lambda: len(recorder.heard) == 2)
        assert list(transport.peers) == [strangers[1].peer]
        await transport.close()

    async def test_a_peer_by_name_is_found(self, robot: Robot, recorder: Recorder) -> None:
        transport = await open_for(recorder, [robot], peers=(f"localhost:{robot.peer[1]}",))
        assert list(transport.peers) == [robot.peer]
        await transport.close()

    async def test_a_name_without_an_address_is_asked_for_again_while_the_others_work(
        self, robot: Robot, recorder: Recorder, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(udp, "RESOLVE_FIRST_S", 0.02)
        loop = asyncio.get_running_loop()
        known = asyncio.Event()

        async def getaddrinfo(host: str, port: int, **_: object) -> object:
            if not known.is_set():
                raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")
            return [(socket.AF_INET, socket.SOCK_DGRAM, 17, "", ("127.0.0.1", port))]

        monkeypatch.setattr(loop, "getaddrinfo", getaddrinfo)
        transport = await open_for(recorder, [robot], peers=("robo.local:9", "127.0.0.1:8"))
        assert list(transport.peers) == [("127.0.0.1", 8)]
        assert transport.status()["unresolved"] == "robo.local:9"
        known.set()
        async with asyncio.timeout(PATIENCE_S):
            while len(transport.peers) < 2:  # noqa: ASYNC110 — a new fixed peer is not told
                await asyncio.sleep(0.01)
        assert "unresolved" not in transport.status()
        await transport.close()

    async def test_closing_while_a_name_is_looked_for_ends_the_search(
        self, recorder: Recorder, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(udp, "RESOLVE_FIRST_S", 0.01)
        tasks = asyncio.all_tasks()

        async def getaddrinfo(*_: object, **__: object) -> None:
            await asyncio.Event().wait()

        monkeypatch.setattr(asyncio.get_running_loop(), "getaddrinfo", getaddrinfo)
        transport = await open_for(recorder, [], peers=("robo.local:9",))
        assert asyncio.all_tasks() != tasks
        await transport.close()
        assert asyncio.all_tasks() == tasks


class TestOpening:
    async def test_a_port_in_use_is_busy(self, robot: Robot, recorder: Recorder) -> None:
        listen = robot.text
        with pytest.raises(LinkBusy, match=f"^{listen}: another program listens on this port$"):
            await Udp(listen=listen).open(recorder)

    async def test_an_address_of_another_machine_is_waited_for(self, recorder: Recorder) -> None:
        with pytest.raises(LinkAbsent, match="no network interface has this address; waiting for it"):
            await Udp(listen="192.0.2.250:9000").open(recorder)

    async def test_a_listen_name_without_an_address_is_waited_for(self, recorder: Recorder) -> None:
        with pytest.raises(LinkAbsent, match=r"cannot find the address of nowhere\.invalid"):
            await Udp(listen="nowhere.invalid:9000").open(recorder)

    async def test_port_0_listens_somewhere_and_says_where(self, recorder: Recorder) -> None:
        transport = await Udp(listen="127.0.0.1:0").open(recorder)
        host, port = udp_sockets.split(str(transport.status()["listen"]))
        assert host == "127.0.0.1"
        assert port > 0
        await transport.close()

    @pytest.mark.parametrize(
        ("options", "expected"),
        [
            ({"listen": "9000"}, "expected host:port"),
            ({"listen": "::1:9000"}, "expected host:port"),
            ({"listen": "127.0.0.1:65536"}, "expected host:port"),
            ({"listen": "127.0.0.1:0", "peers": ["127.0.0.1:0"]}, "has no port to send to"),
            ({"listen": "127.0.0.1:0", "peers": ["[::1]:9000"]}, "one IPv4, the other IPv6"),
            ({"listen": "127.0.0.1:0", "max_peers": 0}, "greater than or equal to 1"),
            ({"listen": "127.0.0.1:0", "peer_ttl_s": 0}, "greater than 0"),
        ],
    )
    def test_wrong_options_are_refused_in_words(self, options: dict[str, Any], expected: str) -> None:
        with pytest.raises(ValidationError, match=expected):
            Udp(**options)

    async def test_a_small_receive_buffer_is_warned_about(
        self, recorder: Recorder, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(udp_sockets, "RECEIVE_BUFFER_BYTES", 1 << 30)
        with caplog.at_level(logging.WARNING):
            transport = await Udp(listen="127.0.0.1:0").open(recorder)
        assert "receive buffer" in caplog.text
        assert "net.core.rmem_max" in caplog.text
        await transport.close()


class TestTrouble:
    async def test_a_robot_that_is_not_there_does_not_end_the_link(self, robot: Robot, recorder: Recorder) -> None:
        dead = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        dead.bind(("127.0.0.1", 0))
        address = dead.getsockname()
        dead.close()
        transport = await open_for(recorder, [robot], peers=(f"127.0.0.1:{address[1]}",))
        for _ in range(3):
            assert transport.write(b"anybody?", address) is True
            await asyncio.sleep(0)
        await robot.say(b"I am")
        await recorder.until(lambda: recorder.heard)
        assert recorder.losses == []
        await transport.close()

    async def test_an_error_that_passes_does_not_end_the_link(self, robot: Robot, recorder: Recorder) -> None:
        transport = await open_for(recorder, [robot])
        main = transport._main  # type: ignore[attr-defined]
        # With IP_RECVERR the kernel reports what ICMP said to this socket, on reading as on writing.
        main.setsockopt(socket.IPPROTO_IP, 11, 1)
        dead = Robot()
        dead.meet(transport)
        await dead.say(b"my last words")
        await recorder.until(lambda: recorder.heard)
        dead.socket.close()
        for _ in range(3):
            assert transport.write(b"anybody?", dead.peer) is True
            await asyncio.sleep(0.01)
        await robot.say(b"I am")
        await recorder.until(lambda: len(recorder.heard) == 2)
        assert recorder.losses == []
        await transport.close()

    async def test_an_error_that_stays_is_a_loss_said_once(
        self, robot: Robot, recorder: Recorder, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        before = open_descriptors()
        transport = await open_for(recorder, [robot])
        monkeypatch.setattr(udp, "PASSING", set())
        transport._lose(OSError(errno.ENOTSOCK, os.strerror(errno.ENOTSOCK)))  # type: ignore[attr-defined]
        transport._lose(OSError(errno.ENOTSOCK, os.strerror(errno.ENOTSOCK)))  # type: ignore[attr-defined]
        assert len(recorder.losses) == 1
        await transport.close()
        assert open_descriptors() == before

    async def test_a_datagram_that_is_too_long_to_be_frames_is_cut_and_counted(
        self, robot: Robot, recorder: Recorder
    ) -> None:
        transport = await open_for(recorder, [robot])
        await robot.say(bytes(udp.DATAGRAM_BYTES))
        await robot.say(bytes(udp.DATAGRAM_BYTES + 1))
        await robot.say(bytes(60_000))
        await recorder.until(lambda: len(recorder.heard) == 3)
        assert [len(data) for data, _ in recorder.heard] == [udp.DATAGRAM_BYTES] * 3
        assert transport.status()["oversized"] == 2
        await transport.close()

    async def test_a_frame_that_is_too_long_to_send_is_dropped_and_counted(
        self, robot: Robot, recorder: Recorder
    ) -> None:
        transport = await open_for(recorder, [robot], peers=(robot.text,))
        assert transport.write(bytes(70_000), robot.peer) is True
        assert transport.status()["send_errors"] == 1
        await transport.close()

    async def test_a_full_send_buffer_refuses_and_then_tells_of_room(self, robot: Robot, recorder: Recorder) -> None:
        transport = await open_for(recorder, [robot], peers=(robot.text,))

        def full(*_: object) -> int:
            raise BlockingIOError(errno.EAGAIN, "try again")

        really = transport._sendto  # type: ignore[attr-defined]
        transport._sendto = full  # type: ignore[attr-defined]
        assert transport.write(FRAME, robot.peer) is False
        assert transport.write(FRAME, robot.peer) is False
        transport._sendto = really  # type: ignore[attr-defined]
        await recorder.until(lambda: recorder.rooms)
        assert transport.write(FRAME, robot.peer) is True
        assert await robot.heard(1) == FRAME
        assert recorder.rooms == 1
        await transport.close()

    async def test_what_the_kernel_had_to_drop_is_shown(self, robot: Robot, recorder: Recorder) -> None:
        transport = await open_for(recorder, [robot])
        transport._main.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 0)  # type: ignore[attr-defined]
        for _ in range(100):
            await robot.say(FRAME)
        assert int(transport.status()["lost"]) > 0
        await transport.close()


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

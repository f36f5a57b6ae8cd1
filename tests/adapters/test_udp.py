"""The UDP adapter on real sockets: what every adapter promises, and peers that come and go."""

import asyncio
import logging
import socket
from collections.abc import Iterator
from typing import Any, ClassVar

import pytest
from adapter_contract import FRAME, AdapterContract, Recorder
from pydantic import ValidationError
from udp_robot import Robot, open_for

from psiu_adapters import udp, udp_sockets
from psiu_adapters.descriptor import READ_BYTES
from psiu_adapters.udp import Udp
from psiu_broker.adapter import Adapter
from psiu_broker.errors import LinkAbsent, LinkBusy


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

    async def test_a_flood_of_long_datagrams_gets_no_more_bytes_a_turn_than_a_stream(
        self, robot: Robot, recorder: Recorder
    ) -> None:
        transport = await open_for(recorder, [robot])
        for _ in range(20):
            await robot.say(bytes(udp.DATAGRAM_BYTES))
        await recorder.until(lambda: recorder.heard)
        assert len(recorder.heard) == READ_BYTES / udp.DATAGRAM_BYTES
        await recorder.until(lambda: len(recorder.heard) == 20)
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
        transport = await open_for(recorder, strangers, peer_ttl_s=1, peers=(fixed.text,))
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
        assert loop.time() - began >= 1
        assert recorder.gone == [silent.peer]
        assert set(transport.peers) == {fixed.peer, talking.peer}
        assert transport.write(b"too late", silent.peer) is True
        assert await silent.hears_nothing()
        chatter.cancel()
        await recorder.until(lambda: talking.peer in recorder.gone)
        assert list(transport.peers) == [fixed.peer]
        await transport.close()

    async def test_a_peer_that_sends_from_another_port_than_it_listens_on_is_known_by_its_host(
        self, strangers: list[Robot], recorder: Recorder
    ) -> None:
        listening, sending, *_ = strangers
        transport = await open_for(recorder, strangers, learn=False, peers=(listening.text,), any_port=True)
        await sending.say(b"E0001")
        await sending.say(b"E0002")
        await recorder.until(lambda: len(recorder.heard) == 2)
        assert recorder.heard == [(b"E0001", listening.peer), (b"E0002", listening.peer)]
        assert list(transport.peers) == [listening.peer]
        transport.write(b"D0064", recorder.heard[0][1])
        assert await listening.heard(5) == b"D0064"
        await transport.close()

    def test_two_peers_of_one_host_cannot_be_known_by_it(self) -> None:
        with pytest.raises(ValueError, match=r"two of them are at 10\.0\.0\.1"):
            Udp(listen="0.0.0.0:1", peers=("10.0.0.1:1", "10.0.0.1:2"), any_port=True)

    async def test_a_forgotten_peer_makes_room_for_another(self, strangers: list[Robot], recorder: Recorder) -> None:
        transport = await open_for(recorder, strangers, peer_ttl_s=1, max_peers=1)
        await strangers[0].say(b"first")
        await recorder.until(lambda: recorder.gone)
        await strangers[1].say(b"second")
        await recorder.until(lambda: len(recorder.heard) == 2)
        assert list(transport.peers) == [strangers[1].peer]
        await transport.close()


class TestOpening:
    async def test_a_port_in_use_is_busy(self, robot: Robot, recorder: Recorder) -> None:
        listen = robot.text
        with pytest.raises(LinkBusy, match=f"^{listen}: another program listens on this port$"):
            await Udp(listen=listen).open(recorder)

    async def test_an_address_of_another_machine_is_waited_for(self, recorder: Recorder) -> None:
        with pytest.raises(LinkAbsent, match="no network interface has this address; waiting for it"):
            await Udp(listen="192.0.2.250:9000").open(recorder)

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
            ({"listen": "127.0.0.1:0", "peer_ttl_s": 0.9}, "greater than or equal to 1"),
            ({"listen": "a..b:9000"}, r"no host can be called 'a\.\.b'"),
            ({"listen": "127.0.0.1:0", "peers": ["a" * 64 + ":9000"]}, "must have 1 to 63 letters"),
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


class TestOptions:
    @pytest.mark.parametrize(
        ("options", "many"),
        [
            ({}, True),
            ({"learn": False, "peers": ("127.0.0.1:1",)}, False),
            ({"learn": False, "peers": ("127.0.0.1:1", "127.0.0.1:2")}, True),
            ({"learn": False, "peers": ("239.255.83.105:1",)}, True),
        ],
    )
    def test_there_may_be_many_peers_unless_one_is_named_and_none_learned(
        self, options: dict[str, Any], many: bool
    ) -> None:
        assert Udp(listen="127.0.0.1:0", **options).many_peers is many

    @pytest.mark.parametrize("robot", [(socket.AF_INET, "127.0.0.1"), (socket.AF_INET6, "::1")], indirect=True)
    async def test_a_robot_s_peer_is_named_as_the_transport_names_it(self, robot: Robot, recorder: Recorder) -> None:
        transport = await robot.adapter.open(recorder)
        robot.meet(transport)
        await robot.say(b"hello")
        await recorder.until(lambda: recorder.heard)
        assert robot.adapter.peer_named(robot.text) == recorder.heard[0][1]
        await transport.close()

    @pytest.mark.parametrize(
        ("text", "expected"),
        [
            ("robo.lan:9001", 'expected "ADDRESS:PORT", got "robo.lan:9001"; write it in numbers'),
            ("127.0.0.1", 'expected "ADDRESS:PORT"'),
            ("127.0.0.1:9002", "127.0.0.1:9002 is not among the peers of its link; add it there"),
        ],
    )
    def test_a_peer_that_nobody_is_is_refused_in_words(self, text: str, expected: str) -> None:
        with pytest.raises(ValueError, match=expected):
            Udp(listen="127.0.0.1:0", peers=("127.0.0.1:9001",)).peer_named(text)

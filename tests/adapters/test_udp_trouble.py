"""UDP sockets in trouble: what passes, what is counted, what ends the link."""

import asyncio
import errno
import os
import shutil
import socket
import subprocess
import sys

import pytest
from adapter_contract import FRAME, Recorder, open_descriptors
from udp_robot import Robot, open_for

from psiu_adapters import udp


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
        assert "last_send_error" not in transport.status()
        assert transport.write(bytes(70_000), robot.peer) is True
        assert transport.status()["send_errors"] == 1
        assert transport.status()["last_send_error"] == "message too long"
        assert transport.write(FRAME, robot.peer) is True
        assert await robot.heard(1) == FRAME
        assert recorder.losses == []
        await transport.close()

    async def test_a_peer_without_a_network_is_counted_while_another_has_one(
        self, strangers: list[Robot], recorder: Recorder, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        cut_off, reached = strangers[:2]
        transport = await open_for(recorder, strangers, peers=(cut_off.text, reached.text))
        really = transport._sendto  # type: ignore[attr-defined]

        def sendto(data: bytes, address: tuple[str, int]) -> int:
            if address == cut_off.peer:
                raise OSError(errno.ENETUNREACH, os.strerror(errno.ENETUNREACH))
            return int(really(data, address))

        transport._sendto = sendto  # type: ignore[attr-defined]
        monkeypatch.setattr(udp, "has_route", lambda _family, address: address != cut_off.peer)
        assert transport.write(b"lost", cut_off.peer) is True
        assert transport.write(FRAME, reached.peer) is True
        assert await reached.heard(1) == FRAME
        await asyncio.sleep(0)
        assert recorder.losses == []
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


WITHOUT_A_NETWORK = """
import asyncio, subprocess
from psiu_adapters.udp import Udp
from psiu_broker.errors import LinkError

class Receiver:
    def __init__(self):
        self.losses = []
        self.told = asyncio.Event()

    def received(self, data, peer):
        pass

    def lost(self, error):
        self.losses.append(str(error))
        self.told.set()

def ip(*words):
    subprocess.run(["ip", *words], check=True)

async def main():
    receiver = Receiver()
    adapter = Udp(listen="0.0.0.0:9000", peers=("127.0.0.1:9001",))
    try:
        await adapter.open(receiver)
    except LinkError as error:
        print(type(error).__name__, error)
    ip("link", "set", "lo", "up")
    transport = await adapter.open(receiver)
    assert transport.write(b"reaches nobody, and nobody knows", ("127.0.0.1", 9001))
    ip("address", "flush", "dev", "lo")
    assert transport.write(b"cannot leave", ("127.0.0.1", 9001))
    assert not receiver.losses, "said from inside write"
    assert transport.write(b"cannot leave", ("127.0.0.1", 9001))
    await asyncio.wait_for(receiver.told.wait(), 5)
    await asyncio.sleep(0)
    print(*receiver.losses, transport.status()["send_errors"])
    await transport.close()

asyncio.run(main())
"""

IN_A_NETWORK_OF_ITS_OWN = ["unshare", "--map-root-user", "--net"]


@pytest.mark.skipif(
    not shutil.which("ip")
    or not shutil.which("unshare")
    or bool(subprocess.run([*IN_A_NETWORK_OF_ITS_OWN, "true"], capture_output=True, check=False).returncode),
    reason="a network of its own cannot be had: the loss of a network is NOT checked",
)
def test_a_network_that_is_down_is_waited_for_and_one_that_goes_down_is_a_loss() -> None:
    command = [*IN_A_NETWORK_OF_ITS_OWN, sys.executable, "-c", WITHOUT_A_NETWORK]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    assert (done.stdout, done.stderr) == (
        "LinkAbsent 0.0.0.0:9000: no network leads to its peers; waiting for one\n"
        "0.0.0.0:9000: network is unreachable 2\n",
        "",
    )

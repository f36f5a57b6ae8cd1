"""RFCOMM: robots that we call, over BlueZ's D-Bus interface with real descriptors."""

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from adapter_contract import PATIENCE_S, AdapterContract, FarEnd, Recorder
from mocked_bluez import BOTH, OTHER, PAIRED, ROBOT, Bluetooth, Ends, Robot, mocked, needs_mock, opened
from pydantic import ValidationError

from psiu_adapters.rfcomm import Rfcomm
from psiu_broker.adapter import Adapter, Transport
from psiu_broker.errors import LinkAbsent, LinkBusy, LinkLost

pytestmark = needs_mock


@pytest.fixture
async def bluetooth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Bluetooth]:
    async with mocked(tmp_path, monkeypatch) as bluetooth:
        yield bluetooth


async def test_a_robot_is_called_by_its_address_and_bytes_pass_both_ways(bluetooth: Bluetooth) -> None:
    await bluetooth.start(known=PAIRED)
    recorder = Recorder()
    async with bluetooth.robot() as robot, opened(Rfcomm(address=ROBOT), recorder) as transport:
        reader, writer = await robot.joined()
        writer.write(b"from the robot")
        await recorder.until(lambda: recorder.data == b"from the robot")
        assert tuple(transport.peers) == (None,)
        assert transport.write(b"to the robot", None)
        assert await reader.readexactly(12) == b"to the robot"
        assert transport.status() == {"address": ROBOT, "route": "bluez", "controller": "hci0"}
        await transport.close()
        assert await reader.read() == b""
        writer.close()


async def test_closing_hangs_up_although_bluetoothd_holds_a_copy(bluetooth: Bluetooth) -> None:
    await bluetooth.start(known=PAIRED)
    async with bluetooth.robot() as robot:
        transport = await Rfcomm(address=ROBOT).open(Recorder())
        reader, writer = await robot.joined()
        await transport.close()
        await transport.close()
        async with asyncio.timeout(5):
            assert await reader.read() == b""
        writer.close()


async def test_a_robot_that_goes_away_is_a_lost_link(bluetooth: Bluetooth) -> None:
    await bluetooth.start(known=PAIRED)
    recorder = Recorder()
    async with bluetooth.robot() as robot, opened(Rfcomm(address=ROBOT), recorder):
        _, writer = await robot.joined()
        writer.close()
        await recorder.until(lambda: recorder.losses)
        assert isinstance(recorder.losses[0], LinkLost)
        assert str(recorder.losses[0]).startswith(ROBOT)


async def test_a_reset_connection_is_a_lost_link(bluetooth: Bluetooth) -> None:
    await bluetooth.start(known=PAIRED)
    recorder = Recorder()
    async with bluetooth.robot() as robot, opened(Rfcomm(address=ROBOT), recorder) as transport:
        _, writer = await robot.joined()
        transport.write(b"unread", None)
        writer.transport.abort()  # with unread bytes: ECONNRESET instead of end of file
        await recorder.until(lambda: recorder.losses)
        assert isinstance(recorder.losses[0], LinkLost)


async def test_a_lost_robot_is_connected_again_by_the_next_open(bluetooth: Bluetooth) -> None:
    await bluetooth.start(known=PAIRED)
    adapter = Rfcomm(address=ROBOT)
    async with bluetooth.robot() as robot:
        for _ in range(3):
            recorder = Recorder()
            async with opened(adapter, recorder):
                reader, writer = await robot.joined()
                writer.write(b"x")
                await recorder.until(lambda recorder=recorder: recorder.data)
            assert await reader.read() == b""
            writer.close()


async def test_bluez_asking_to_disconnect_ends_the_link(bluetooth: Bluetooth) -> None:
    await bluetooth.start(known=PAIRED)
    recorder = Recorder()
    async with bluetooth.robot() as robot, opened(Rfcomm(address=ROBOT), recorder):
        reader, writer = await robot.joined()
        await bluetooth.steer("Disconnect", "s", ROBOT)
        await recorder.until(lambda: recorder.losses)
        assert await reader.read() == b""
        writer.close()


async def test_two_links_share_one_registration_and_go_to_their_own_robots(bluetooth: Bluetooth) -> None:
    await bluetooth.start(known=BOTH)
    first, second = Recorder(), Recorder()
    async with bluetooth.robot(ROBOT) as one, bluetooth.robot(OTHER) as other:
        transports = await asyncio.gather(Rfcomm(address=ROBOT).open(first), Rfcomm(address=OTHER).open(second))
        ends = [await one.joined(), await other.joined()]
        for (_, writer), word in zip(ends, (b"one", b"other"), strict=True):
            writer.write(word)
        await first.until(lambda: first.heard == [(b"one", None)])
        await second.until(lambda: second.heard == [(b"other", None)])
        assert (await bluetooth.log()).count("RegisterProfile") == 1
        await transports[0].close()
        assert transports[1].write(b"still here", None)
        assert await ends[1][0].readexactly(10) == b"still here"
        await transports[1].close()
        for _, writer in ends:
            writer.close()


async def test_one_robot_cannot_be_two_links(bluetooth: Bluetooth) -> None:
    await bluetooth.start(known=PAIRED)
    async with bluetooth.robot() as robot, opened(Rfcomm(address=ROBOT), Recorder()):
        _, writer = await robot.joined()
        with pytest.raises(LinkBusy, match="another link of this broker"):
            await Rfcomm(address=ROBOT.lower()).open(Recorder())
        writer.close()


async def test_an_unknown_robot_is_searched_for_and_paired_with_its_pin(bluetooth: Bluetooth) -> None:
    await bluetooth.start(hidden={ROBOT: {"pin": "4321"}})
    async with bluetooth.robot() as robot, opened(Rfcomm(address=ROBOT, pin="4321"), Recorder()):
        _, writer = await robot.joined()
        writer.close()
    log = await bluetooth.log()
    assert log.index("SetDiscoveryFilter bredr") < log.index("StartDiscovery") < log.index("StopDiscovery")
    assert log.index("StopDiscovery") < log.index("Pair") < log.index("PIN 4321") < log.index("ConnectProfile 00001101")


async def test_the_agent_leaves_when_pairing_is_over(bluetooth: Bluetooth) -> None:
    await bluetooth.start(known={ROBOT: {"pin": "1234"}})
    async with bluetooth.robot() as robot, opened(Rfcomm(address=ROBOT), Recorder()):
        _, writer = await robot.joined()
        writer.close()
        log = await bluetooth.log()
        assert log.index("PIN 1234") < log.index("UnregisterAgent") < log.index("ConnectProfile 00001101")


async def test_a_wrong_pin_says_so(bluetooth: Bluetooth) -> None:
    await bluetooth.start(known={ROBOT: {"pin": "0000"}})
    async with bluetooth.robot():
        with pytest.raises(LinkAbsent, match="see that pin is right"):
            await Rfcomm(address=ROBOT).open(Recorder())


async def test_connecting_waits_while_bluez_reads_the_services(bluetooth: Bluetooth) -> None:
    await bluetooth.start(known={ROBOT: {"paired": True, "pin": "busy once"}})
    async with bluetooth.robot() as robot, opened(Rfcomm(address=ROBOT), Recorder()):
        _, writer = await robot.joined()
        writer.close()
    assert (await bluetooth.log()).count("ConnectProfile 00001101") == 2


class Connected(FarEnd):
    """A robot behind the mocked BlueZ; it takes the newest connection."""

    adapter: Adapter = Rfcomm(address=ROBOT)

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._ends: Ends | None = None

    def meet(self, transport: Transport) -> None:
        self._ends = None

    async def ends(self) -> Ends:
        if self._ends is None:
            self._ends = await self._robot.joined()
        return self._ends

    async def say(self, data: bytes) -> None:
        (await self.ends())[1].write(data)

    async def heard(self, size: int) -> bytes:
        async with asyncio.timeout(PATIENCE_S):
            return await (await self.ends())[0].readexactly(size)

    async def vanish(self) -> None:
        (await self.ends())[1].transport.abort()


class TestContract(AdapterContract):
    @pytest.fixture
    async def far(self, bluetooth: Bluetooth) -> AsyncIterator[FarEnd]:
        await bluetooth.start(known=PAIRED)
        async with bluetooth.robot() as robot:
            yield Connected(robot)

    @pytest.fixture
    async def absent(self, bluetooth: Bluetooth) -> Adapter:
        await bluetooth.start(known=BOTH)
        return Rfcomm(address=OTHER)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({}, "give either address"),
        ({"address": ROBOT, "accept": True}, "give either address"),
        ({"address": "98:D3:31:00:00"}, "not a Bluetooth address: six hex pairs"),
        ({"address": ROBOT, "channel": 31}, "less than or equal to 30"),
        ({"address": ROBOT, "channel": 2, "route": "bluez"}, "BlueZ looks it up"),
        ({"accept": True, "route": "socket"}, "accept = true needs BlueZ"),
        ({"address": ROBOT, "controller": "usb0"}, "should match pattern"),
    ],
)
def test_impossible_options_are_told(options: dict[str, object], said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        Rfcomm.model_validate(options)


def test_an_address_is_written_in_one_way() -> None:
    assert Rfcomm(address="98:d3:31:00:00:0a").address == "98:D3:31:00:00:0A"

"""RFCOMM: phones and robots that call us."""

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from adapter_contract import PATIENCE_S, AdapterContract, FarEnd, Recorder, held, no_more_than
from mocked_bluez import BOTH, OTHER, PAIRED, ROBOT, Bluetooth, Ends, Robot, mocked, needs_mock, opened

from psiu_adapters.rfcomm import Rfcomm
from psiu_broker.adapter import Adapter, Transport
from psiu_broker.errors import LinkBusy

pytestmark = needs_mock


@pytest.fixture
async def bluetooth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Bluetooth]:
    async with mocked(tmp_path, monkeypatch) as bluetooth:
        yield bluetooth


async def test_phones_that_call_are_peers_by_their_address(bluetooth: Bluetooth) -> None:
    await bluetooth.start(known=BOTH)
    recorder = Recorder()
    async with (
        bluetooth.robot(ROBOT) as one,
        bluetooth.robot(OTHER) as other,
        opened(Rfcomm(accept=True), recorder) as transport,
    ):
        assert tuple(transport.peers) == ()
        assert transport.write(b"to nobody", ROBOT)
        ends = {}
        for address, phone in ((ROBOT, one), (OTHER, other)):
            assert await bluetooth.steer("Call", "sb", address, False) == "connected"
            ends[address] = await phone.joined()
            ends[address][1].write(address.encode())
        await recorder.until(lambda: sorted(recorder.heard) == [(ROBOT.encode(), ROBOT), (OTHER.encode(), OTHER)])
        assert set(transport.peers) == {ROBOT, OTHER}
        assert transport.write(b"to the other", OTHER)
        assert await ends[OTHER][0].readexactly(12) == b"to the other"
        ends[ROBOT][1].close()
        await recorder.until(lambda: recorder.gone == [ROBOT])
        assert transport.status()["connected"] == 1
        assert not recorder.losses
        await transport.close()
        assert await ends[OTHER][0].read() == b""
        ends[OTHER][1].close()


async def test_a_phone_that_calls_again_replaces_its_dead_call(bluetooth: Bluetooth) -> None:
    await bluetooth.start(known=PAIRED)
    recorder = Recorder()
    async with bluetooth.robot() as phone, opened(Rfcomm(accept=True), recorder) as transport:
        await bluetooth.steer("Call", "sb", ROBOT, False)
        reader, first = await phone.joined()
        await bluetooth.steer("Call", "sb", ROBOT, False)
        _, second = await phone.joined()
        assert await reader.read() == b""
        second.write(b"again")
        await recorder.until(lambda: recorder.heard == [(b"again", ROBOT)])
        assert tuple(transport.peers) == (ROBOT,)
        assert recorder.gone == [ROBOT]
        first.close()
        second.close()


async def test_nobody_may_call_when_no_link_accepts(bluetooth: Bluetooth) -> None:
    await bluetooth.start(known=BOTH)
    before = held()
    async with (
        bluetooth.robot(ROBOT),
        bluetooth.robot(OTHER) as phone,
        opened(Rfcomm(accept=True), Recorder()) as accepting,
        opened(Rfcomm(address=ROBOT), Recorder()),
    ):
        await accepting.close()
        assert await bluetooth.steer("Call", "sb", OTHER, False) == "not authorized"
        assert await bluetooth.steer("Call", "sb", OTHER, True) == "rejected"
        reader, _ = await phone.joined()
        assert await reader.read() == b""
    await no_more_than(before)


async def test_bluetoothd_stopping_is_told_to_a_link_that_accepts(bluetooth: Bluetooth) -> None:
    await bluetooth.start(known=PAIRED)
    recorder = Recorder()
    adapter = Rfcomm(accept=True)
    async with opened(adapter, recorder):
        await bluetooth.stop()
        await recorder.until(lambda: recorder.losses)
        assert len(recorder.losses) == 1
    await bluetooth.start(known=PAIRED)
    async with bluetooth.robot() as phone, opened(adapter, Recorder()):
        assert await bluetooth.steer("Call", "sb", ROBOT, False) == "connected"
        (await phone.joined())[1].close()


async def test_only_one_link_accepts(bluetooth: Bluetooth) -> None:
    await bluetooth.start()
    async with opened(Rfcomm(accept=True), Recorder()):
        with pytest.raises(LinkBusy, match="another link of this broker accepts connections on hci0"):
            await Rfcomm(accept=True).open(Recorder())


async def test_each_controller_has_its_own_link_that_accepts(bluetooth: Bluetooth) -> None:
    await bluetooth.start(controllers=["hci0", "hci1"], known={ROBOT: {}, OTHER: {"controller": "hci1"}})
    first, second = Recorder(), Recorder()
    async with (
        bluetooth.robot(ROBOT) as one,
        bluetooth.robot(OTHER) as other,
        opened(Rfcomm(accept=True), first),
        opened(Rfcomm(accept=True, controller="hci1"), second) as closing,
    ):
        for address, phone in ((ROBOT, one), (OTHER, other)):
            assert await bluetooth.steer("Call", "sb", address, False) == "connected"
            (await phone.joined())[1].write(address.encode())
        await first.until(lambda: first.heard)
        await second.until(lambda: second.heard)
        assert (first.heard, second.heard) == ([(ROBOT.encode(), ROBOT)], [(OTHER.encode(), OTHER)])
        await closing.close()
        assert await bluetooth.steer("Call", "sb", OTHER, True) == "rejected"
        assert await bluetooth.steer("Call", "sb", ROBOT, True) == "connected"


class Caller(FarEnd):
    """A phone that calls a link that accepts."""

    adapter: Adapter = Rfcomm(accept=True)
    peer = ROBOT

    def __init__(self, bluetooth: Bluetooth, phone: Robot) -> None:
        self._bluetooth = bluetooth
        self._phone = phone
        self._ends: Ends | None = None

    async def call(self) -> None:
        assert await self._bluetooth.steer("Call", "sb", ROBOT, False) == "connected"

    async def ends(self) -> Ends:
        if self._ends is None:
            self._ends = await self._phone.joined()
        return self._ends

    async def say(self, data: bytes) -> None:
        (await self.ends())[1].write(data)

    async def heard(self, size: int) -> bytes:
        async with asyncio.timeout(PATIENCE_S):
            return await (await self.ends())[0].readexactly(size)


class TestContract(AdapterContract):
    losable = False  # a phone that vanishes is a lost peer, not a lost link

    async def open(self, far: FarEnd, recorder: Recorder) -> Transport:
        transport = await super().open(far, recorder)
        assert isinstance(far, Caller)
        await far.call()
        return transport

    @pytest.fixture
    async def far(self, bluetooth: Bluetooth) -> AsyncIterator[FarEnd]:
        await bluetooth.start(known=PAIRED)
        async with bluetooth.robot() as phone:
            yield Caller(bluetooth, phone)

    @pytest.fixture
    async def absent(self, bluetooth: Bluetooth) -> Adapter:
        await bluetooth.start(controllers=[])
        return Rfcomm(accept=True)

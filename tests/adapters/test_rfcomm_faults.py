"""RFCOMM: what is absent, refuses, hangs or dies, and how its return is noticed."""

import asyncio
import signal
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest
from adapter_contract import PATIENCE_S, Recorder, held, no_more_than
from dbus_fast import Message, Variant
from mocked_bluez import BOTH, OTHER, PAIRED, ROBOT, Bluetooth, mocked, needs_mock, opened

from psiu_adapters.bluez import Bluez
from psiu_adapters.rfcomm import Rfcomm
from psiu_broker.errors import LinkAbsent, LinkBusy, LinkError

pytestmark = needs_mock


@pytest.fixture
async def bluetooth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Bluetooth]:
    async with mocked(tmp_path, monkeypatch) as bluetooth:
        yield bluetooth


async def test_an_absent_robot_is_named_with_what_to_do(bluetooth: Bluetooth) -> None:
    await bluetooth.start(known=PAIRED)
    with pytest.raises(LinkAbsent, match=rf"^{ROBOT} does not answer: switch it on"):
        await Rfcomm(address=ROBOT).open(Recorder())


async def test_a_robot_that_refuses_is_busy(bluetooth: Bluetooth) -> None:
    await bluetooth.start(known=PAIRED)
    async with bluetooth.robot():
        pass
    server = await asyncio.start_unix_server(lambda *_: None, bluetooth.folder / ROBOT.replace(":", "_"))
    server.close()  # the name stays and nobody listens
    with pytest.raises(LinkBusy, match="refuses the connection"):
        await Rfcomm(address=ROBOT).open(Recorder())


async def test_a_robot_out_of_reach_is_searched_for_a_bounded_time(bluetooth: Bluetooth) -> None:
    await bluetooth.start()
    with pytest.raises(LinkAbsent, match=r"not in reach: switch it on \(searched for 0.1 s\)"):
        await Rfcomm(address=ROBOT, discovery_s=0.1).open(Recorder())
    assert "StopDiscovery" in await bluetooth.log()


@pytest.mark.parametrize(
    ("absent", "under_way"),
    [
        ({ROBOT: {"paired": True, "pin": "silent"}}, "ConnectProfile 00001101"),
        ({}, "StartDiscovery"),
    ],
    ids=["called", "searched for"],
)
async def test_an_absent_robot_delays_no_other(
    bluetooth: Bluetooth, absent: dict[str, dict[str, object]], under_way: str
) -> None:
    await bluetooth.start(known={**absent, OTHER: {"paired": True}})
    async with bluetooth.robot(OTHER) as robot:
        calling = asyncio.create_task(Rfcomm(address=ROBOT, discovery_s=60).open(Recorder()))
        async with asyncio.timeout(PATIENCE_S):
            while under_way not in await bluetooth.log():  # noqa: ASYNC110 — the mock tells nobody
                await asyncio.sleep(0.01)
            async with opened(Rfcomm(address=OTHER), Recorder()):
                (await robot.joined())[1].close()
        assert not calling.done()
        calling.cancel()
        await asyncio.wait({calling})


async def test_without_a_bus_both_routes_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DBUS_SYSTEM_BUS_ADDRESS", f"unix:path={tmp_path}/nothing")
    with pytest.raises(LinkError, match="there is no D-Bus system bus") as raised:
        await Rfcomm(address=ROBOT, connect_timeout_s=0.1).open(Recorder())
    assert "and by BlueZ" in str(raised.value)
    with pytest.raises(LinkAbsent, match="there is no D-Bus system bus"):
        await Rfcomm(address=ROBOT, route="bluez").open(Recorder())
    with pytest.raises(LinkAbsent, match="there is no D-Bus system bus"):
        await Rfcomm(accept=True).open(Recorder())


async def test_without_bluetoothd_the_command_that_starts_it_is_said(bluetooth: Bluetooth) -> None:
    with pytest.raises(LinkAbsent, match="bluetoothd is not running: systemctl start bluetooth"):
        await Rfcomm(address=ROBOT, route="bluez").open(Recorder())


async def test_without_the_controller_those_that_are_there_are_said(bluetooth: Bluetooth) -> None:
    await bluetooth.start(known=PAIRED)
    with pytest.raises(LinkAbsent, match=r"no Bluetooth controller hci7.*there: hci0"):
        await Rfcomm(address=ROBOT, controller="hci7").open(Recorder())


async def test_a_controller_switched_off_says_so_and_its_return_is_noticed(
    bluetooth: Bluetooth, monkeypatch: pytest.MonkeyPatch
) -> None:
    await bluetooth.start(known=PAIRED, powered=False)
    adapter = Rfcomm(address=ROBOT)
    with pytest.raises(LinkAbsent, match="hci0 is switched off: bluetoothctl power on"):
        await adapter.open(Recorder())
    await noticed(adapter, bluetooth.steer("SetPowered", "b", True), monkeypatch)


async def noticed(adapter: Rfcomm, event: Awaitable[object], monkeypatch: pytest.MonkeyPatch) -> None:
    """`adapter.changed` returns by `event` and not before."""
    changed = await watching(adapter, monkeypatch)
    assert not changed.done()
    await event
    async with asyncio.timeout(PATIENCE_S):
        await changed


async def watching(adapter: Rfcomm, monkeypatch: pytest.MonkeyPatch) -> "asyncio.Future[None]":
    """`adapter.changed` under way, its watch set."""
    bus = Bluez.here().bus
    watch, watched = bus.watch, asyncio.Event()

    def noted(wanted: Callable[[Message], bool]) -> AbstractContextManager["asyncio.Future[None]"]:
        watched.set()
        return watch(wanted)

    monkeypatch.setattr(bus, "watch", noted)
    changed = asyncio.ensure_future(adapter.changed())
    await watched.wait()
    return changed


async def test_bluetoothd_starting_is_noticed(bluetooth: Bluetooth, monkeypatch: pytest.MonkeyPatch) -> None:
    await noticed(Rfcomm(address=ROBOT), bluetooth.start(), monkeypatch)


async def test_a_device_that_appears_is_noticed(bluetooth: Bluetooth, monkeypatch: pytest.MonkeyPatch) -> None:
    await bluetooth.start()
    await noticed(Rfcomm(address=ROBOT), bluetooth.steer("AddDevice", "ss", ROBOT, "1234"), monkeypatch)


async def test_another_device_that_appears_is_not_our_business(
    bluetooth: Bluetooth, monkeypatch: pytest.MonkeyPatch
) -> None:
    await bluetooth.start()
    changed = await watching(Rfcomm(address=ROBOT), monkeypatch)
    await bluetooth.steer("AddDevice", "ss", OTHER, "1234")
    await bluetooth.log()
    assert not changed.done()
    changed.cancel()
    await asyncio.wait({changed})


async def test_a_restart_of_bluetoothd_is_survived(bluetooth: Bluetooth) -> None:
    await bluetooth.start(known=PAIRED)
    adapter = Rfcomm(address=ROBOT)
    async with bluetooth.robot() as robot, opened(adapter, Recorder()):
        _, first = await robot.joined()
        await bluetooth.stop()
        await bluetooth.start(known=BOTH)
        async with bluetooth.robot(OTHER) as other, opened(Rfcomm(address=OTHER), Recorder()):
            _, second = await other.joined()
            second.close()
        first.close()
    assert "RegisterProfile" in await bluetooth.log()


async def test_bluetoothd_dying_while_we_connect_is_an_absent_link(bluetooth: Bluetooth) -> None:
    await bluetooth.start(known=PAIRED)
    assert bluetooth.process is not None
    bluetooth.process.send_signal(signal.SIGSTOP)
    opening = asyncio.ensure_future(Rfcomm(address=ROBOT, route="bluez").open(Recorder()))
    await asyncio.sleep(0.1)
    await bluetooth.stop()
    with pytest.raises(LinkError, match="bluetoothd is not running"):
        await opening


async def test_the_bus_going_away_while_we_connect_is_an_absent_link(
    bluetooth: Bluetooth,
) -> None:
    await bluetooth.start(known=PAIRED)
    assert bluetooth.process is not None
    bluetooth.process.send_signal(signal.SIGSTOP)
    opening = asyncio.ensure_future(Rfcomm(address=ROBOT, route="bluez").open(Recorder()))
    await asyncio.sleep(0.1)
    bluetooth.bus_daemon.kill()
    with pytest.raises(LinkError, match="D-Bus has gone"):
        await opening
    with pytest.raises((EOFError, OSError)):
        await (await bluetooth.steering()).wait_for_disconnect()
    bluetooth._bus = None


async def test_a_hanging_bluetoothd_ends_in_a_refusal_and_not_in_a_hang(
    bluetooth: Bluetooth, monkeypatch: pytest.MonkeyPatch
) -> None:
    await bluetooth.start(known=PAIRED)
    async with bluetooth.robot() as robot, opened(Rfcomm(address=ROBOT), Recorder()):
        _, writer = await robot.joined()
        writer.close()
        assert bluetooth.process is not None
        bluetooth.process.send_signal(signal.SIGSTOP)
        bluez = Bluez.here()
        call = bluez.bus.call
        monkeypatch.setattr(bluez.bus, "call", lambda *a, **k: call(*a, **{**k, "timeout_s": 0.2}))
        with pytest.raises(LinkAbsent, match="does not answer"):
            await Rfcomm(address=OTHER).open(Recorder())
    bluetooth.process.send_signal(signal.SIGCONT)


async def test_connecting_can_be_cancelled_and_leaves_nothing_behind(bluetooth: Bluetooth) -> None:
    await bluetooth.start(known=PAIRED)
    before = held()
    for wait_s in (0, 0.001, 0.005, 0.02, 0.05):
        async with bluetooth.robot():
            opening = asyncio.ensure_future(Rfcomm(address=ROBOT).open(Recorder()))
            await asyncio.sleep(wait_s)
            opening.cancel()
            (done,), _ = await asyncio.wait({opening})
            if not done.cancelled():
                await done.result().close()
    await no_more_than(before)


async def test_no_descriptor_leaks_over_connections_and_failures(bluetooth: Bluetooth) -> None:
    await bluetooth.start(known=PAIRED)
    before = held()
    for _ in range(3):
        async with bluetooth.robot() as robot, opened(Rfcomm(address=ROBOT), Recorder()):
            _, writer = await robot.joined()
            writer.close()
            await writer.wait_closed()
        with pytest.raises(LinkAbsent):
            await Rfcomm(address=ROBOT).open(Recorder())
    await no_more_than(before)


async def test_another_program_with_the_profile_is_named(bluetooth: Bluetooth) -> None:
    await bluetooth.start(known=PAIRED)
    bus = await bluetooth.steering()
    body = ["/other", "00001101-0000-1000-8000-00805f9b34fb", {"Name": Variant("s", "other")}]
    await bus.call(
        Message(
            "org.bluez", "/org/bluez", "org.bluez.ProfileManager1", "RegisterProfile", signature="osa{sv}", body=body
        )
    )
    with pytest.raises(LinkBusy, match="another program has registered"):
        await Rfcomm(address=ROBOT).open(Recorder())

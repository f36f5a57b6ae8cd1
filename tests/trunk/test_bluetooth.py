"""Two brokers, each a process with a bluetoothd of its own, that share nothing but the air."""

import asyncio
import contextlib
import os
from pathlib import Path
from typing import Any

import pytest
from broker_process import BrokerProcess
from mocked_bluez import Bluetooth, mocked, needs_mock

pytest.importorskip("bumble", reason="bumble is missing: pip install 'psiu-broker[bluetooth-simulator]'")

from bumble.device import Connection
from bumble.link import LocalLink
from bumble.rfcomm import DLC
from virtual_bluetooth import HOST, bridged, computer, radio_of

from psiu_broker.simulator.rfcomm import serve

BASE = "98:D3:31:00:00:07"
TRUNK = """
[trunks.air]
adapter = "rfcomm"
"""


class Receiving:
    """The kernel's part at the base: who opens its serial port over the air has called its bluetoothd."""

    def __init__(self, bluetooth: Bluetooth) -> None:
        self.away = False
        self._bluetooth = bluetooth
        self._calls: set[asyncio.Task[None]] = set()
        self._connected: dict[DLC, Connection] = {}

    def came(self, dlc: DLC) -> None:
        early: list[bytes] = []
        dlc.sink = early.append
        connection = dlc.multiplexer.l2cap_channel.connection
        self._connected[dlc] = connection
        connection.on(connection.EVENT_DISCONNECTION, lambda *_: self._connected.pop(dlc, None))
        if self.away:
            self._begin(self._hang_up(dlc))
        else:
            self._begin(self._pass_on(dlc, early))

    async def leave(self) -> None:
        """Out of reach, until `away` is False."""
        self.away = True
        for dlc in list(self._connected):
            await self._hang_up(dlc)

    async def close(self) -> None:
        await self.leave()
        if self._calls:
            await asyncio.wait(self._calls)

    async def _pass_on(self, dlc: DLC, early: list[bytes]) -> None:
        async with self._bluetooth.robot(HOST) as phone:
            assert await self._bluetooth.steer("Call", "sb", HOST, True) == "connected"
            reader, writer = await phone.joined()
            writer.write(b"".join(early))
            dlc.sink = writer.write
            dlc.on(dlc.EVENT_CLOSE, writer.close)
            while data := await reader.read(4096):
                dlc.write(data)

    async def _hang_up(self, dlc: DLC) -> None:
        connection = self._connected.pop(dlc, None)
        if connection is not None:
            await connection.disconnect()

    def _begin(self, work: Any) -> None:
        task = asyncio.ensure_future(work)
        self._calls.add(task)
        task.add_done_callback(self._calls.discard)


@needs_mock
async def test_two_brokers_with_nothing_but_bluetooth_are_one_network(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    air = LocalLink()
    async with contextlib.AsyncExitStack() as stack:
        buses, bluetooths = {}, {}
        for name, known in (("base", HOST), ("robo", BASE)):
            (folder := tmp_path / name).mkdir()
            bluetooths[name] = await stack.enter_async_context(mocked(folder, monkeypatch))
            buses[name] = os.environ["DBUS_SYSTEM_BUS_ADDRESS"]
            await bluetooths[name].start(known={known: {"paired": True}})
        receiving = Receiving(bluetooths["base"])
        stack.push_async_callback(receiving.close)
        await serve(computer(air, "base", BASE), receiving.came)
        path = bluetooths["robo"].folder / BASE.replace(":", "_")
        await stack.enter_async_context(bridged(path, await radio_of(air), BASE))
        base = BrokerProcess(tmp_path, "base", TRUNK + "accept = true")
        robo = BrokerProcess(tmp_path, "robo", TRUNK + f'address = "{BASE}"')
        for broker in (base, robo):
            await stack.enter_async_context(broker.running(DBUS_SYSTEM_BUS_ADDRESS=buses[broker.name]))

        both = {name: {"broker": name} for name in ("base", "robo")}
        joined = {"base": {"state": "open", "far": "robo"}, "robo": {"state": "open", "far": "base"}}
        for broker in (base, robo):
            await broker.until("status", both)
            await broker.until("trunks", joined)
        await receiving.leave()
        await base.until("trunks", {"base": {"state": "waiting", "far": None}})
        await robo.until("trunks", {"robo": {"far": None}})
        receiving.away = False
        for broker in (base, robo):
            await broker.until("status", both)
            await broker.until("trunks", joined)

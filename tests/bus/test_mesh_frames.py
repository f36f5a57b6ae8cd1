"""Whatever comes where brokers give each other frames is in the ledger, and what does not leave is not called sent."""

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh
from ports import free_port

from psiu_broker.broker import Broker
from psiu_broker.bus.keys import Keys
from psiu_broker.bus.mesh import ZenohMesh
from psiu_broker.codecs import psiu_ascii
from psiu_broker.config import load
from psiu_broker.frame import MESH, Address
from psiu_broker.mesh.envelope import Envelope, pack

CONFIGURATION = '[broker]\nname = "base"\n[zenoh]\nlisten = ["tcp/127.0.0.1:{port}"]\n'
FRAME = psiu_ascii.message(Address.named("PC"), Address.named("base"), "quantoscomandos")
ENVELOPE = pack(Envelope(1, 2, 1, 0, 0, FRAME))


class Lab:
    def __init__(self, broker: Broker, session: zenoh.Session) -> None:
        self.broker = broker
        self.session = session

    @property
    def fates(self) -> dict[str, int]:
        account = self.broker.exchange.accounts[MESH]
        assert account.arrived == account.settled()
        return {verdict: count for verdict, count in account.fates.items() if count}

    async def until(self, fates: dict[str, int]) -> None:
        async with asyncio.timeout(10):
            while self.fates != fates:  # noqa: ASYNC110 - the books are values, not events
                await asyncio.sleep(0.005)
        assert self.broker.ledger().balances


@pytest.fixture
async def lab(tmp_path: Path) -> AsyncIterator[Lab]:
    port = free_port()
    file = tmp_path / "base.toml"
    file.write_text(CONFIGURATION.format(port=port))
    broker = Broker(load(file))
    await broker.start()
    config = zenoh.Config.from_json5(f'{{mode: "client", connect: {{endpoints: ["tcp/127.0.0.1:{port}"]}}}}')
    session = await asyncio.to_thread(zenoh.open, config)
    try:
        yield Lab(broker, session)
    finally:
        await asyncio.to_thread(session.close)
        await broker.stop()


async def test_what_is_no_frame_for_us_is_counted_wherever_it_fails(lab: Lab) -> None:
    frames = "psiu/@mesh/frame/base"
    lab.session.put(f"{frames}/hill/1", b"garbage")
    lab.session.put(f"{frames}/hill/9", ENVELOPE)
    lab.session.put(f"{frames}/%FF/1", ENVELOPE)
    lab.session.put("psiu/@mesh/frame/*/hill/1", ENVELOPE)
    lab.session.delete(f"{frames}/hill/1")
    await lab.until({"malformed": 5})
    lab.session.put(f"{frames}/hill/1", ENVELOPE)
    await lab.until({"malformed": 5, "refused": 1})


async def test_what_the_session_before_still_brings_is_counted(lab: Lab) -> None:
    bus = lab.broker._bus
    assert bus is not None
    await bus.mesh.close()
    lab.session.put("psiu/@mesh/frame/base/hill/1", ENVELOPE)
    await lab.until({"refused": 1})


async def test_what_brokers_say_that_cannot_be_read_is_counted_and_fills_no_log(
    lab: Lab, caplog: pytest.LogCaptureFixture
) -> None:
    for key in ("beat/hill", "notice/base"):
        lab.session.put(f"psiu/@mesh/{key}", b"garbage")
    tokens = [
        lab.session.liveliness().declare_token(f"psiu/@mesh/{key}")
        for key in (
            "broker/hill/life/abc/0",
            "broker/hill",
            "robot/hill/1/MNERIM/-/psiu-ascii/wifi/9/99/1/0",
            "robot/x",
        )
    ]
    async with asyncio.timeout(10):
        while lab.broker.mesh_seen().unreadable < 6:  # noqa: ASYNC110
            await asyncio.sleep(0.005)
    assert lab.broker.mesh_seen().unreadable == 6
    assert not caplog.records
    del tokens


def test_a_frame_that_zenoh_refuses_has_not_left() -> None:
    def put(*_: object, **__: object) -> None:
        raise zenoh.ZError("the session is closed")

    session: Any = SimpleNamespace(
        zenoh_id="a", zenoh=SimpleNamespace(put=put), worker=lambda _: None, panicked=lambda _: False
    )
    nobody: Any = None
    mesh = ZenohMesh(session, Keys(), "base", nobody)
    assert not mesh.put_frame("hill", 1, ENVELOPE)
    session.zenoh.put = lambda *_, **__: None
    assert mesh.put_frame("hill", 1, ENVELOPE)

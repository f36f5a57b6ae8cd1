"""How well a fixed rate is kept, and what it does on a real line."""

import asyncio
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st
from memory_adapter import MemoryAdapter, MemoryTransport
from paced_lab import ARRIVED, ONE, STOPPED, THREE, Lab, Ledger, configuration, set_point

from psiu_adapters.serial import Serial
from psiu_adapters.udp import Udp
from psiu_broker import kept, paced_link
from psiu_broker.codecs.soccer import Soccer
from psiu_broker.errors import LinkLost
from psiu_broker.frame import NOBODY, Address, Frame
from psiu_broker.link import Hub, Link
from psiu_broker.paced_link import Pace, PacedLink
from psiu_broker.simulator.soccer import SoccerRobot
from psiu_broker.simulator.transports import PtyPort, UdpPort


def test_the_jitter_of_an_exact_rate_is_nothing() -> None:
    lab = Lab().open()
    assert "jitter_p99_ms" not in lab.link.details()
    lab.clock.slots(50)
    details = lab.link.details()
    assert (details["jitter_p50_ms"], details["jitter_p99_ms"]) == (0, 0)
    assert (details["rate_hz"], details["packets"]) == (32, 50)


def test_the_jitter_is_how_far_periods_are_from_the_nominal_one() -> None:
    pace = Pace(10)
    pace.begin(0.0)
    for packet in range(1000):
        pace.sent(packet * 0.1 + (0.004 if packet % 100 == 50 else 0.0))
    p50, p99 = pace.jitter_ms() or (0.0, 0.0)
    assert p50 == pytest.approx(0, abs=1e-6)
    assert p99 == pytest.approx(4, abs=1e-6)


def test_a_pause_between_two_openings_is_no_jitter() -> None:
    lab = Lab().open()
    lab.clock.slots(3)
    lab.link.lost(LinkLost("unplugged"))
    lab.clock.pass_on(100.0)
    lab.link.connected(MemoryTransport())
    lab.clock.slots(3)
    assert lab.link.details()["jitter_p99_ms"] == 0
    assert lab.link.details()["missed"] == 0


@given(rate_hz=st.floats(0.1, 1000), lates=st.lists(st.floats(0, 3), max_size=30))
def test_slots_never_drift_and_never_come_twice(rate_hz: float, lates: list[float]) -> None:
    pace = Pace(rate_hz)
    pace.begin(1000.0)
    now, slot = 1000.0, 0
    for late in lates:
        now = max(now, pace.due + late / rate_hz)
        pace.reached(now)
        following = round((pace.due - 1000.0) * rate_hz)
        assert following > slot
        assert pace.due == pytest.approx(1000.0 + following / rate_hz)
        assert pace.due - now <= 1.001 / rate_hz
        slot = following
    assert pace.missed == slot - len(lates)


async def run(link: Link) -> None:
    with suppress(asyncio.CancelledError):
        await link.run()


async def test_a_team_on_a_serial_line_of_2000_baud_is_driven_and_stopped(tmp_path: Path) -> None:
    team = SoccerRobot.team("cendori")
    async with PtyPort(*team, link=tmp_path / "radio") as port:
        made = configuration(Serial(device=port.path, baudrate=2000), preset="cendori", rate_hz=11, hold_s=1.5)
        hub = Ledger()
        link = PacedLink(made, lambda: Soccer(cast(Any, made.codec)), cast(Hub, hub))
        task = asyncio.create_task(run(link))
        await port.until(lambda: all(robot.packets > 0 for robot in team))
        frame = Frame(NOBODY, Address.numbered(4), "bytes", b"\x01\x02\x03", "soccer")
        assert link.offer(frame, None, ARRIVED, asyncio.get_running_loop().time()) is None
        await port.until(lambda: team[3].wheels == (1, 2, 3))
        assert [robot.wheels for robot in team if robot is not team[3]] == [(0, 0, 0)] * 4
        assert hub.verdicts == ["delivered"]
        await port.until(lambda: team[3].wheels == (0, 0, 0))
        assert {robot.dropped for robot in team} == {0}
        task.cancel()
        await task


async def test_robots_stop_when_the_broker_does(tmp_path: Path) -> None:
    team = SoccerRobot.team("mirosot")
    async with PtyPort(*team, link=tmp_path / "radio") as port:
        made = configuration(Serial(device=port.path, baudrate=19200), hold_s=3600)
        link = PacedLink(made, lambda: Soccer(cast(Any, made.codec)), cast(Hub, Ledger()))
        task = asyncio.create_task(run(link))
        await port.until(lambda: team[0].packets > 0)
        link.offer(set_point(ONE, 31, 31), None, ARRIVED, asyncio.get_running_loop().time())
        await port.until(lambda: team[0].wheels == (31, 31))
        task.cancel()
        await task
        await port.until(lambda: team[0].wheels == (0, 0))


async def test_closing_waits_for_room_for_the_packet_that_stops_the_robots() -> None:
    adapter = MemoryAdapter()
    link = PacedLink(made := configuration(adapter), lambda: Soccer(cast(Any, made.codec)), cast(Hub, Ledger()))
    task = asyncio.create_task(run(link))
    for _ in range(5):
        await asyncio.sleep(0)
    adapter.transport.full = True
    task.cancel()
    for _ in range(5):
        await asyncio.sleep(0)
    assert not adapter.transport.closed
    adapter.transport.full = False
    before = len(adapter.transport.written)
    link.writable()
    await task
    assert [wire.hex() for wire in adapter.transport.wires[before:]] == [STOPPED]
    assert adapter.transport.closed


async def test_closing_does_not_wait_for_room_without_end(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(paced_link, "LAST_PACKET_S", 0.01)
    adapter = MemoryAdapter(ends=("a", "b"))
    link = PacedLink(made := configuration(adapter), lambda: Soccer(cast(Any, made.codec)), cast(Hub, Ledger()))
    task = asyncio.create_task(run(link))
    for _ in range(5):
        await asyncio.sleep(0)
    adapter.transport.full_peers = {"b"}
    task.cancel()
    await task
    assert adapter.transport.written[-1] == (bytes.fromhex(STOPPED), "a")
    assert adapter.transport.closed
    assert "closed without room for the packet that stops its robots" in caplog.text


async def test_a_team_over_udp_is_driven() -> None:
    team = SoccerRobot.team("mirosot")
    async with UdpPort(*team) as port:
        adapter = Udp(listen="127.0.0.1:0", peers=(port.address,), learn=False)
        made = configuration(adapter, hold_s=3600)
        link = PacedLink(made, lambda: Soccer(cast(Any, made.codec)), cast(Hub, Ledger()))
        task = asyncio.create_task(run(link))
        await port.until(lambda: team[2].packets > 0)
        link.offer(set_point(THREE, -5, 5), None, ARRIVED, asyncio.get_running_loop().time())
        await port.until(lambda: team[2].wheels == (-5, 5))
        task.cancel()
        await task


async def test_a_link_that_comes_back_goes_on_with_stops(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept, "FIRST_PAUSE_S", 0.01)
    team = SoccerRobot.team("mirosot")
    async with PtyPort(*team, link=tmp_path / "radio") as port:
        made = configuration(Serial(device=port.path, baudrate=19200), hold_s=3600)
        hub = Ledger()
        link = PacedLink(made, lambda: Soccer(cast(Any, made.codec)), cast(Hub, hub))
        task = asyncio.create_task(run(link))
        await port.until(lambda: team[0].packets > 0)
        link.offer(set_point(ONE, 31, 31), None, ARRIVED, asyncio.get_running_loop().time())
        await port.until(lambda: team[0].wheels == (31, 31))
        port.unplug()
        port.plug()
        await port.until(lambda: team[0].wheels == (0, 0), 20)
        assert link.opened == 2
        task.cancel()
        await task


def test_the_bench_prints_how_steadily_packets_leave() -> None:
    command = [sys.executable, "-m", "tests.bench.soccer", "--quick"]
    bench = subprocess.run(command, cwd=Path(__file__).parent.parent, capture_output=True, text=True, check=False)
    assert bench.returncode == 0, bench.stdout + bench.stderr
    for line in ("How far periods are from the nominal one", "cendori, serial 2000", "mirosot, UDP", "heard p99"):
        assert line in bench.stdout

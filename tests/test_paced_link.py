"""Packets at a fixed rate: a clock and timers of our own, and at the end a real line."""

import asyncio
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from math import inf
from pathlib import Path
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st
from memory_adapter import MemoryAdapter, MemoryDatagrams, MemoryTransport

from psiu_adapters.serial import Serial
from psiu_adapters.udp import Udp
from psiu_broker import kept, paced_link
from psiu_broker.adapter import Adapter, Peer
from psiu_broker.codecs.codec import Directory
from psiu_broker.codecs.paced import Rest
from psiu_broker.codecs.soccer import Soccer, byte_of
from psiu_broker.config import LinkConfiguration, LinkOptions
from psiu_broker.errors import EncodeError, LinkLost
from psiu_broker.exchange import Exchange
from psiu_broker.frame import NOBODY, Address, Frame, Malformed, Way
from psiu_broker.link import Hub, Link
from psiu_broker.paced_link import Pace, PacedLink
from psiu_broker.routing.outbox import Fate
from psiu_broker.routing.router import SELF, Router
from psiu_broker.routing.table import Binding
from psiu_broker.simulator.soccer import SoccerRobot
from psiu_broker.simulator.transports import PtyPort, UdpPort

PERIOD_S = 1 / 32
"""A power of two, so that slots are exact."""
STOPPED = "aa03030303030355"
ARRIVED = Way("wifi")
ONE, TWO, THREE = map(Address.numbered, (1, 2, 3))


class Handle:
    def __init__(self, when: float, call: Callable[[], None]) -> None:
        self.when, self.call, self.cancelled = when, call, False

    def cancel(self) -> None:
        self.cancelled = True


class Clock:
    """Time that passes only when told, and timers that then ring."""

    def __init__(self) -> None:
        self.now = 100.0
        self.handles: list[Handle] = []

    def __call__(self) -> float:
        return self.now

    def call_at(self, when: float, call: Callable[[], None]) -> Handle:
        handle = Handle(when, call)
        self.handles.append(handle)
        return handle

    @property
    def next(self) -> float:
        return min((handle.when for handle in self.handles if not handle.cancelled), default=inf)

    def pass_to(self, moment: float, late_s: float = 0.0) -> None:
        """Ring what is due until `moment`, each timer `late_s` too late."""
        while self.next <= moment:
            first = min((handle for handle in self.handles if not handle.cancelled), key=lambda handle: handle.when)
            self.handles.remove(first)
            self.now = max(self.now, first.when + late_s)
            first.call()
        self.now = max(self.now, moment)

    def pass_on(self, seconds: float, late_s: float = 0.0) -> None:
        self.pass_to(self.now + seconds, late_s)

    def slots(self, count: int = 1) -> None:
        """Let so many packets leave."""
        for _ in range(count):
            self.pass_to(self.next)


class Tap:
    raw_listened = False


class Ledger:
    """A hub that writes down the fate of each frame."""

    def __init__(self) -> None:
        self.bus = Tap()
        self.fates: list[tuple[int, str]] = []
        self.out: list[tuple[str, str]] = []
        self.frames: list[Frame] = []
        self.opened_links = 0

    def settled(self, fate: Fate, verdict: str, now: float) -> None:
        self.fates.append((fate.frame.destination.number, verdict))

    def sent(self, frame: Frame, wire: bytes, way: Way) -> None:
        self.out.append((frame.subject, wire.hex()))

    def heard(self, frame: Frame, way: Way, now: float) -> None:
        self.frames.append(frame)

    def malformed(self, malformed: Malformed, way: Way, now: float) -> None: ...

    def opened(self, link: Link, now: float) -> None:
        self.opened_links += 1

    def closed(self, link: Link, now: float) -> None: ...

    def peer_lost(self, way: Way, now: float) -> None: ...

    @property
    def verdicts(self) -> list[str]:
        return [verdict for _, verdict in self.fates]


def set_point(robot: Address, left: int, right: int, subject: str = "rodas") -> Frame:
    payload = bytes((byte_of(left, "mirosot"), byte_of(right, "mirosot")))
    return Frame(NOBODY, robot, subject, payload, "soccer")


def asked(robot: Address) -> Frame:
    """A set-point under a word for which other links have a lane of its own."""
    return set_point(robot, 3, 3, "qualseunome")


def pare(robot: Address) -> Frame:
    return set_point(robot, 0, 0, "pare")


def rest(robot: Address) -> Frame:
    """What stops a robot by the word of those who watch over it alone."""
    return set_point(robot, 0, 0, "repouso")


class Watch:
    def stops(self, frame: Frame) -> bool:
        return frame.subject == "repouso"

    def left(self, link: str, frame: Frame, now: float) -> None: ...


STOPS = pytest.mark.parametrize("stop", [pare, rest])


def configuration(adapter: Adapter | None = None, max_age_s: float = 2.0, **codec: Any) -> LinkConfiguration:
    options = Soccer.Options(**{"rate_hz": 1 / PERIOD_S, **codec})
    return LinkConfiguration(
        "time", "memory", adapter or MemoryAdapter(), "soccer", options, LinkOptions(max_age_s=max_age_s)
    )


class Lab:
    """A link with a transport in memory, and all that it told and wrote."""

    def __init__(
        self, *, rests: dict[int, Rest] | None = None, transport: MemoryTransport | None = None, **options: Any
    ) -> None:
        self.clock = Clock()
        self.hub = Ledger()
        self.transport = transport or MemoryTransport()
        made = configuration(**options)
        self.link = PacedLink(
            made,
            lambda: Soccer(cast(Soccer.Options, made.codec), Directory()),
            cast(Hub, self.hub),
            rests=rests,
            clock=self.clock,
            call_at=self.clock.call_at,
        )
        self.link.watch = Watch()

    def open(self) -> "Lab":
        self.link.connected(self.transport)
        return self

    def offer(self, frame: Frame, peer: Peer = None, patience_s: float = inf) -> str | None:
        return self.link.offer(frame, peer, ARRIVED, self.clock.now, patience_s)

    @property
    def packets(self) -> list[str]:
        return [wire.hex() for wire in self.transport.wires]


# The books.


def test_whatever_their_words_no_set_point_is_lost_without_a_trace() -> None:
    lab = Lab().open()
    offered = [make(robot) for robot in (ONE, TWO, THREE) for make in (pare, lambda each: set_point(each, 5, 5), asked)]
    assert [lab.offer(frame) for frame in offered] == [None] * len(offered)
    assert len(lab.hub.fates) + lab.link.outbox.size == len(offered)
    lab.clock.slots(5)
    assert (len(lab.hub.fates), lab.link.outbox.size) == (len(offered), 0)


# The stream of packets.


def test_a_team_is_told_to_stop_from_the_moment_its_link_opens() -> None:
    lab = Lab().open()
    lab.clock.pass_on(2.5 * PERIOD_S)
    assert lab.packets == [STOPPED] * 3


def test_a_link_that_is_not_steady_is_quiet_until_the_first_set_point() -> None:
    lab = Lab(steady=False).open()
    lab.clock.pass_on(10.0)
    assert lab.packets == []
    lab.offer(set_point(ONE, 15, 15))
    lab.clock.pass_on(0.0)
    assert lab.packets == ["aa3e3e0303030355"], "the first packet need not wait for a slot"
    lab.clock.pass_on(2.0)
    assert lab.packets[-1] == STOPPED, "once begun it goes on"


def test_a_link_that_was_not_steady_stops_its_robots_when_it_comes_back() -> None:
    lab = Lab(steady=False).open()
    lab.offer(set_point(ONE, 15, 15))
    lab.clock.slots()
    lab.link.lost(LinkLost("unplugged"))
    lab.transport = MemoryTransport()
    lab.link.connected(lab.transport)
    lab.clock.slots()
    assert lab.packets == [STOPPED]


def test_one_packet_carries_the_newest_set_point_of_each_robot() -> None:
    lab = Lab().open()
    lab.clock.slots()
    for frame in (set_point(ONE, 1, 1), set_point(TWO, -31, 31), set_point(ONE, 15, 15)):
        assert lab.offer(frame) is None
    assert lab.packets == [STOPPED]
    lab.clock.slots()
    assert lab.packets[1:] == ["aa3e3efc7e030355"]
    assert lab.hub.fates == [(1, "superseded"), (1, "delivered"), (2, "delivered")]


def test_a_set_point_is_repeated_until_it_is_too_old_and_then_the_robot_stops() -> None:
    lab = Lab(hold_s=4 * PERIOD_S).open()
    lab.clock.slots()
    lab.offer(set_point(ONE, 15, 15))
    lab.clock.slots(6)
    assert lab.packets[1:] == ["aa3e3e0303030355"] * 3 + [STOPPED] * 3
    assert lab.hub.verdicts == ["delivered"], "its verdict is that of the packet that carried it first"


def test_each_robot_has_its_own_patience_and_its_own_stop() -> None:
    rests = {1: Rest(b"\x81\x81", 2 * PERIOD_S), 3: Rest(b"\x07\x07", 0.5)}
    lab = Lab(rests=rests, hold_s=3 * PERIOD_S).open()
    lab.clock.slots()
    lab.offer(set_point(ONE, 15, 15))
    lab.offer(set_point(TWO, 15, 15))
    lab.clock.slots(3)
    assert lab.packets == ["aa81810303070755", "aa3e3e3e3e070755", "aa81813e3e070755", "aa81810303070755"]


def test_a_rest_that_does_not_fit_the_packets_is_refused_at_once() -> None:
    for rests in ({1: Rest(b"\x03", 0.5)}, {4: Rest(b"\x03\x03", 0.5)}):
        with pytest.raises(EncodeError):
            Lab(rests=rests)


def test_packets_leave_on_a_fixed_grid_however_late_the_timers_are() -> None:
    lab = Lab().open()
    began = lab.clock.now
    due = []
    for late_s in (0.0, 0.01, 0.02, 0.0, 0.03, 0.001):
        due.append(lab.clock.next - began)
        lab.clock.pass_to(lab.clock.next, late_s)
    assert due == [slot * PERIOD_S for slot in range(6)]
    assert lab.link.details()["missed"] == 0


def test_slots_that_were_missed_are_skipped_and_counted() -> None:
    lab = Lab().open()
    began = lab.clock.now
    lab.clock.slots()
    lab.clock.pass_to(lab.clock.next, late_s=3.5 * PERIOD_S)
    assert len(lab.packets) == 2, "no burst to catch up"
    assert lab.clock.next == began + 5 * PERIOD_S
    assert lab.link.details()["missed"] == 3


def test_a_slot_without_room_is_skipped_and_counted_and_its_set_points_wait() -> None:
    lab = Lab().open()
    lab.clock.slots()
    lab.offer(set_point(ONE, 15, 15))
    lab.transport.full = True
    lab.clock.slots(2)
    assert (lab.packets, lab.hub.fates, lab.link.outbox.size) == ([STOPPED], [], 1)
    lab.transport.full = False
    lab.link.writable()
    assert lab.packets == [STOPPED], "the next slot is soon enough"
    lab.clock.slots()
    assert lab.packets == [STOPPED, "aa3e3e0303030355"]
    assert (lab.hub.verdicts, lab.link.details()["no_room"]) == (["delivered"], 2)


# The fate of each frame.


def test_a_frame_offered_to_a_link_that_is_down_is_dropped_at_once() -> None:
    lab = Lab()
    assert lab.offer(set_point(ONE, 1, 1)) == "link_down"
    assert lab.clock.handles == []


@pytest.mark.parametrize(
    "frame", [set_point(Address.numbered(4), 1, 1), set_point(ONE, 1, 1)._replace(payload=b"\x00")]
)
def test_what_no_packet_can_carry_is_refused(frame: Frame) -> None:
    lab = Lab().open()
    assert lab.offer(frame) == "refused"
    assert lab.link.outbox.size == 0


def test_what_waits_when_the_link_goes_down_moves_nobody_later() -> None:
    lab = Lab().open()
    lab.offer(set_point(ONE, 15, 15))
    lab.offer(pare(TWO))
    lab.link.lost(LinkLost("unplugged"))
    assert lab.hub.verdicts == ["link_down", "link_down"]
    lab.transport = MemoryTransport()
    lab.link.connected(lab.transport)
    lab.clock.slots(2)
    assert lab.packets == [STOPPED] * 2


def test_what_was_held_when_the_link_went_down_is_not_taken_up_again() -> None:
    lab = Lab().open()
    lab.offer(set_point(ONE, 15, 15))
    lab.clock.slots()
    lab.link.lost(LinkLost("unplugged"))
    lab.transport = MemoryTransport()
    lab.link.connected(lab.transport)
    lab.clock.slots()
    assert lab.packets == [STOPPED]


def test_a_set_point_that_waited_too_long_expires_and_what_was_held_goes_on() -> None:
    lab = Lab().open()
    lab.offer(set_point(ONE, 15, 15))
    lab.clock.slots()
    lab.offer(set_point(ONE, 31, 31), patience_s=PERIOD_S / 2)
    lab.clock.slots()
    assert lab.hub.verdicts == ["delivered", "expired"]
    assert lab.packets == ["aa3e3e0303030355"] * 2


@pytest.mark.parametrize(("max_age_s", "hold_s"), [(2.0, 2 * PERIOD_S), (2 * PERIOD_S, 3.0)])
def test_neither_the_link_s_age_limit_nor_the_robot_s_is_outlived_in_waiting(max_age_s: float, hold_s: float) -> None:
    lab = Lab(max_age_s=max_age_s, hold_s=hold_s).open()
    lab.clock.slots()
    lab.transport.full = True
    lab.offer(set_point(ONE, 15, 15))
    lab.clock.slots(3)
    lab.transport.full = False
    lab.clock.slots()
    assert (lab.hub.verdicts, lab.packets) == (["expired"], [STOPPED] * 2)


@STOPS
def test_whoever_sends_without_pause_does_not_undo_a_stop(stop: Callable[[Address], Frame]) -> None:
    lab = Lab().open()
    lab.clock.slots()
    lab.offer(set_point(ONE, 1, 1))
    lab.offer(stop(ONE))
    assert lab.hub.fates == [(1, "superseded")]
    lab.offer(set_point(ONE, 2, 2))
    lab.offer(set_point(ONE, 15, 15))
    lab.clock.slots(2)
    assert lab.packets[1:] == [STOPPED, "aa3e3e0303030355"]
    assert lab.hub.verdicts == ["superseded", "superseded", "delivered", "delivered"]


@STOPS
def test_a_stop_that_found_no_room_in_time_stops_its_robot_all_the_same(stop: Callable[[Address], Frame]) -> None:
    lab = Lab(hold_s=60.0).open()
    lab.offer(set_point(ONE, 15, 15))
    lab.clock.slots()
    lab.transport.full = True
    lab.offer(stop(ONE), patience_s=0.05)
    lab.clock.slots(5)
    lab.transport.full = False
    lab.clock.slots()
    assert (lab.hub.verdicts, lab.packets[-1]) == (["delivered", "expired"], STOPPED)


@STOPS
def test_a_newer_stop_takes_the_place_of_all_that_waits_for_its_robot_alone(stop: Callable[[Address], Frame]) -> None:
    lab = Lab().open()
    lab.offer(stop(ONE))
    lab.offer(set_point(ONE, 1, 1))
    lab.offer(set_point(TWO, 15, 15))
    lab.offer(stop(ONE))
    lab.clock.slots()
    assert sorted(lab.hub.fates) == [(1, "delivered"), (1, "superseded"), (1, "superseded"), (2, "delivered")]
    assert lab.packets == ["aa03033e3e030355"]


def test_a_packet_goes_to_every_far_end_of_the_line() -> None:
    lab = Lab(transport=MemoryTransport(("a", "b")), adapter=MemoryDatagrams()).open()
    lab.offer(set_point(ONE, 15, 15), "a")
    lab.transport.full_peers = {"a"}
    lab.clock.slots()
    lab.transport.full_peers = set()
    lab.clock.slots()
    assert [(wire.hex(), peer) for wire, peer in lab.transport.written] == [
        ("aa3e3e0303030355", "b"), ("aa3e3e0303030355", "a"), ("aa3e3e0303030355", "b")
    ]  # fmt: skip
    assert (lab.hub.verdicts, lab.link.details()["no_room"]) == (["delivered"], 0)


def test_with_nobody_there_a_set_point_waits_until_it_is_too_old() -> None:
    lab = Lab(transport=MemoryTransport(()), adapter=MemoryDatagrams(), hold_s=0.1).open()
    lab.offer(set_point(ONE, 15, 15))
    lab.clock.pass_on(0.2)
    assert (lab.hub.verdicts, lab.link.packets, lab.link.details()["no_room"]) == (["expired"], 0, 0)


def test_a_frame_that_went_two_ways_on_one_line_is_delivered() -> None:
    lab = Lab(transport=MemoryTransport(("a", "b")), adapter=MemoryDatagrams()).open()
    settled: list[str] = []
    lab.hub.settled = lambda fate, verdict, now: settled.append(str(fate.settle(verdict)))  # type: ignore[method-assign, arg-type]
    frame = set_point(ONE, 15, 15)
    fate = Fate(frame, ARRIVED, 2)
    for peer in ("a", "b"):
        assert lab.link.offer(frame, peer, ARRIVED, lab.clock.now, fate=fate) is None
    lab.clock.slots()
    assert settled == ["None", "delivered"]


def test_a_transport_that_is_lost_in_the_middle_of_a_packet_delivers_nothing() -> None:
    class Lost(MemoryTransport):
        def write(self, data: bytes, peer: Peer) -> bool:
            if not self.closed:
                self.closed = True
                lab.link.lost(LinkLost("gone"))
            return True

    lab = Lab(transport=Lost()).open()
    lab.offer(set_point(ONE, 1, 1))
    lab.clock.pass_on(1.0)
    assert lab.hub.verdicts == ["link_down"]
    assert lab.link.packets == 0


def test_every_packet_can_be_watched() -> None:
    lab = Lab().open()
    lab.clock.slots()
    lab.hub.bus.raw_listened = True
    lab.offer(set_point(ONE, 15, 15))
    lab.clock.slots(2)
    assert lab.hub.out == [("rodas", "aa3e3e0303030355"), ("packet", "aa3e3e0303030355")]


async def test_a_link_is_drained_when_its_last_set_point_has_left() -> None:
    lab = Lab().open()
    await lab.link.drained()
    lab.offer(set_point(ONE, 15, 15))
    waiting = asyncio.ensure_future(lab.link.drained())
    await asyncio.sleep(0)
    assert not waiting.done()
    lab.clock.slots()
    await asyncio.wait_for(waiting, 1)


def test_what_is_heard_on_such_a_link_is_read_as_on_any() -> None:
    lab = Lab().open()
    lab.link.received(bytes.fromhex("aa3e3efc7e030355"), None)
    assert [frame.payload.hex() for frame in lab.hub.frames] == ["3e3e", "fc7e", "0303"]
    assert lab.link.frames_in == 3


Action = tuple[str, int, int]
actions = st.lists(
    st.tuples(
        st.sampled_from(["offer", "stop", "offer", "pass", "pass", "full", "room", "lose", "open", "expire", "late"]),
        st.integers(1, 4),
        st.integers(0, 31),
    ),
    max_size=40,
)


@given(actions=actions, steady=st.booleans())
def test_each_frame_has_one_verdict_or_waits_and_the_sum_is_exact(actions: list[Action], steady: bool) -> None:
    clock = Clock()
    made = configuration(steady=steady, hold_s=0.1)
    router = Router({Address.named("base"): "psiu-ascii"}, tuple(
        Binding(Address.named(f"robo{robot}"), Address.numbered(robot), Way("time"), "soccer") for robot in range(1, 5)
    ), id)  # fmt: skip
    exchange = Exchange(Address.named("base"), router)
    exchange.resident = cast(Any, Resident())
    link = PacedLink(made, lambda: Soccer(cast(Any, made.codec)), exchange, clock=clock, call_at=clock.call_at)
    exchange.add(link)
    transport = MemoryTransport()
    frames = []
    for action, robot, value in actions:
        match action:
            case "offer" | "stop":
                frame = set_point(Address.numbered(robot), value, -value, "pare" if action == "stop" else "rodas")
                frames.append(frame)
                exchange.send(frame, clock.now, patience_s=value / 100 or inf)
            case "pass":
                clock.pass_on(value / 100)
            case "late":
                clock.pass_on(0.1, late_s=value / 100)
            case "full":
                transport.full = True
            case "room":
                transport.full = False
                link.writable()
            case "lose":
                link.lost(LinkLost("unplugged"))
            case "open":
                if link.ways() == ():
                    transport = MemoryTransport()
                    link.connected(transport)
            case _:
                exchange.expire(clock.now)
        account = exchange.accounts[SELF.link]
        assert account.arrived == len(frames) == account.settled() + exchange.waiting()[SELF.link]
        assert link.outbox.size <= 6
        for wire in transport.wires:
            assert len(Soccer(cast(Any, made.codec)).decode(wire, 0.0)) == 3
    link.lost(LinkLost("unplugged"))
    assert exchange.waiting()[SELF.link] == 0
    fates = Counter({verdict: count for verdict, count in exchange.accounts[SELF.link].fates.items() if count})
    assert set(fates) <= {"delivered", "superseded", "expired", "link_down", "refused"}


class Resident:
    """Takes what it is told."""

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *_, **__: None


# How well it keeps to its rate.


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


# On a real line.


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

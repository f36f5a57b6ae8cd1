"""Packets at a fixed rate, on a clock of our own: what they carry, and what becomes of each frame."""

import asyncio
from collections import Counter
from collections.abc import Callable
from math import inf
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st
from memory_adapter import MemoryDatagrams, MemoryTransport
from paced_lab import (
    ARRIVED,
    ONE,
    PERIOD_S,
    STOPPED,
    STOPS,
    THREE,
    TWO,
    Clock,
    Lab,
    asked,
    configuration,
    pare,
    set_point,
)

from psiu_broker.adapter import Peer
from psiu_broker.codecs.paced import Rest
from psiu_broker.codecs.soccer import Soccer
from psiu_broker.errors import EncodeError, LinkLost
from psiu_broker.exchange import Exchange
from psiu_broker.frame import Address, Frame, Way
from psiu_broker.paced_link import PacedLink
from psiu_broker.routing.outbox import Fate
from psiu_broker.routing.router import SELF, Router
from psiu_broker.routing.table import Binding


class Resident:
    """Takes what it is told."""

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *_, **__: None


def test_whatever_their_words_no_set_point_is_lost_without_a_trace() -> None:
    lab = Lab().open()
    offered = [make(robot) for robot in (ONE, TWO, THREE) for make in (pare, lambda each: set_point(each, 5, 5), asked)]
    assert [lab.offer(frame) for frame in offered] == [None] * len(offered)
    assert len(lab.hub.fates) + lab.link.outbox.size == len(offered)
    lab.clock.slots(5)
    assert (len(lab.hub.fates), lab.link.outbox.size) == (len(offered), 0)


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

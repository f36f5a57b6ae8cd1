import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress

import pytest
from memory_adapter import MemoryAdapter, MemoryDatagrams, MemoryTransport, codec_of, configuration

from psiu_broker import kept
from psiu_broker import link as link_module
from psiu_broker.codecs import psiu_ascii, psiu_hexa
from psiu_broker.errors import LinkLost
from psiu_broker.frame import EVERYONE, Address, Frame, Malformed, Way
from psiu_broker.link import CUT_OFF, Link
from psiu_broker.routing.outbox import Fate

PC, MNERIM = Address.named("PC"), Address.named("MNERIM")
COMMAND = b"MNERIM 034 parafrente 100 PC 02123"
ARRIVED = Way("wifi")


class Tap:
    raw_listened = False


class Hub:
    """Remembers what the link told it."""

    def __init__(self) -> None:
        self.bus = Tap()
        self.frames: list[tuple[Frame, Way]] = []
        self.noise: list[Malformed] = []
        self.fates: list[str] = []
        self.lost_peers: list[Way] = []
        self.events: list[str] = []
        self.out: list[bytes] = []
        self._told = asyncio.Event()

    def heard(self, frame: Frame, way: Way, now: float) -> None:
        self.frames.append((frame, way))
        self._told.set()

    def malformed(self, malformed: Malformed, way: Way, now: float) -> None:
        self.noise.append(malformed)
        self._told.set()

    def settled(self, fate: Fate, verdict: str, now: float) -> None:
        self.fates.append(verdict)

    def sent(self, frame: Frame, wire: bytes, way: Way) -> None:
        self.out.append(wire)

    def opened(self, link: Link, now: float) -> None:
        self.events.append("opened")
        self._told.set()

    def closed(self, link: Link, now: float) -> None:
        self.events.append("closed")
        self._told.set()

    def peer_came(self, way: Way, now: float) -> None: ...
    def peer_lost(self, way: Way, now: float) -> None:
        self.lost_peers.append(way)

    async def until(self, true: Callable[[], object]) -> None:
        async with asyncio.timeout(5):
            while not true():
                self._told.clear()
                await self._told.wait()


def command(distance: int = 100) -> Frame:
    return psiu_ascii.message(PC, MNERIM, "parafrente", str(distance))


def make(
    hub: Hub, adapter: MemoryAdapter | None = None, clock: Callable[[], float] = lambda: 0.0, **options: object
) -> Link:
    made = configuration(adapter=adapter, **options)  # type: ignore[arg-type]
    return Link(made, lambda: codec_of(made), hub, clock=clock)


def connected(hub: Hub, transport: MemoryTransport, **options: object) -> Link:
    link = make(hub, **options)  # type: ignore[arg-type]
    link.connected(transport)
    return link


async def turns(true: Callable[[], object]) -> None:
    """Let the loop turn until it is so: a link's state is a value, not an event."""
    async with asyncio.timeout(5):
        while not true():  # noqa: ASYNC110
            await asyncio.sleep(0)


@asynccontextmanager
async def running(link: Link) -> AsyncIterator[None]:
    task = asyncio.create_task(link.run())
    try:
        yield
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task


@pytest.fixture
async def hub() -> Hub:
    return Hub()


@pytest.fixture(autouse=True)
def short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept, "FIRST_PAUSE_S", 0.002)
    monkeypatch.setattr(link_module, "FIRST_PAUSE_S", 0.002)
    monkeypatch.setattr(kept, "SHORTEST_PAUSE_S", 0.001)


async def test_a_frame_heard_reaches_the_hub_with_its_way(hub: Hub) -> None:
    link = connected(hub, MemoryTransport())
    link.received(COMMAND, None)
    [(frame, way)] = hub.frames
    assert (frame.source, frame.destination, frame.subject) == (PC, MNERIM, "parafrente")
    assert way == Way("radio")


async def test_a_frame_counts_alike_alone_and_among_others(hub: Hub) -> None:
    link = connected(hub, MemoryTransport(), clock=lambda: 5.0)
    for data in (COMMAND, COMMAND, COMMAND[:10], COMMAND[10:], COMMAND + COMMAND):
        link.received(data, None)
    assert (link.frames_in, link.last_heard, link.malformed) == (5, 5.0, 0)
    assert len(hub.frames) == 5
    assert len(set(hub.frames)) == 1


async def test_an_offered_frame_leaves_whole_at_once(hub: Hub) -> None:
    transport = MemoryTransport()
    link = connected(hub, transport)
    assert link.offer(command(), None, ARRIVED, 0.0) == "delivered"
    assert transport.wires == [COMMAND]


async def test_a_frame_offered_to_a_link_that_is_down_is_dropped_at_once(hub: Hub) -> None:
    assert make(hub).offer(command(), None, ARRIVED, 0.0) == "link_down"


async def test_what_the_link_cannot_say_is_refused(hub: Hub) -> None:
    link = connected(hub, MemoryTransport())
    packet = psiu_hexa.packet(Address.numbered(1), Address.numbered(2), b"")
    assert link.offer(packet, None, ARRIVED, 0.0) == "refused"


async def test_a_full_wire_makes_frames_wait_and_they_leave_in_order_when_there_is_room(hub: Hub) -> None:
    transport = MemoryTransport()
    link = connected(hub, transport)
    transport.full = True
    assert link.offer(command(1), None, ARRIVED, 0.0) is None
    transport.full = False
    assert link.offer(command(2), None, ARRIVED, 0.0) is None, "a later frame may not overtake"
    assert transport.wires == []
    link.writable()
    assert [wire.split()[3] for wire in transport.wires] == [b"1", b"2"]
    assert hub.fates == ["delivered", "delivered"]


async def test_a_peer_that_takes_nothing_holds_up_no_other(hub: Hub) -> None:
    transport = MemoryTransport(peers=("a", "b"))
    link = connected(hub, transport, adapter=MemoryDatagrams())
    transport.full_peers = {"a"}
    assert link.offer(command(1), "a", ARRIVED, 0.0) is None
    assert link.offer(command(2), "b", ARRIVED, 0.0) == "delivered"
    transport.full = True
    assert link.offer(command(3), "b", ARRIVED, 0.0) is None
    assert link.offer(command(4), "a", ARRIVED, 0.0) is None
    transport.full = False
    link.writable()
    assert [(wire.split()[3], peer) for wire, peer in transport.written] == [(b"2", "b"), (b"3", "b")]
    transport.full_peers = set()
    link.writable()
    assert [wire.split()[3] for wire in transport.wires[2:]] == [b"1", b"4"]


async def test_a_stop_overtakes_what_waits(hub: Hub) -> None:
    transport = MemoryTransport()
    link = connected(hub, transport)
    transport.full = True
    link.offer(psiu_ascii.message(PC, Address.named("CARRO"), "parafrente", "100"), None, ARRIVED, 0.0)
    link.offer(psiu_ascii.message(PC, MNERIM, "pare"), None, ARRIVED, 0.0)
    transport.full = False
    link.writable()
    assert [wire.split()[2] for wire in transport.wires] == [b"pare", b"parafrente"]


@pytest.mark.parametrize("everyone", [False, True])
async def test_a_robot_that_is_stopped_is_not_moved_by_what_waited_before(hub: Hub, everyone: bool) -> None:
    transport = MemoryTransport()
    link = connected(hub, transport)
    transport.full = True
    link.offer(command(1), None, ARRIVED, 0.0)
    link.offer(psiu_ascii.message(PC, EVERYONE if everyone else MNERIM, "pare"), None, ARRIVED, 0.0)
    link.offer(command(2), None, ARRIVED, 0.0)
    assert hub.fates == ["superseded"]
    transport.full = False
    link.writable()
    assert [wire.split()[2:4] for wire in transport.wires[1:]] == [[b"parafrente", b"2"]]
    assert b"pare" in transport.wires[0]
    assert hub.fates == ["superseded", "delivered", "delivered"]


async def test_a_robot_that_is_stopped_is_not_moved_by_what_waited_for_everyone(hub: Hub) -> None:
    transport = MemoryTransport()
    link = connected(hub, transport)
    transport.full = True
    link.offer(psiu_ascii.message(PC, EVERYONE, "anda", "10"), None, ARRIVED, 0.0)
    link.offer(psiu_ascii.message(PC, MNERIM, "pare"), None, ARRIVED, 0.0)
    assert hub.fates == ["superseded"]
    transport.full = False
    link.writable()
    assert [wire.split()[2] for wire in transport.wires] == [b"pare"]


async def test_where_no_more_stops_fit_one_takes_the_place_of_its_equal(hub: Hub) -> None:
    transport = MemoryTransport()
    link = connected(hub, transport, queue_frames=2)
    transport.full = True
    for source, robot in (("PC", "MNERIM"), ("PC", "LAMP"), ("BETA", "MNERIM")):
        link.offer(psiu_ascii.message(Address.named(source), Address.named(robot), "pare"), None, ARRIVED, 0.0)
    assert hub.fates == ["superseded"]
    assert link.offer(psiu_ascii.message(PC, MNERIM, "pare", "agora"), None, Way("cable"), 0.0) is None
    assert hub.fates == ["superseded", "queue_full"]
    transport.full = False
    link.writable()
    assert [(wire.split()[0], wire.split()[-2]) for wire in transport.wires] == [(b"LAMP", b"PC"), (b"MNERIM", b"PC")]


async def test_what_waited_too_long_never_moves_a_robot(hub: Hub) -> None:
    transport = MemoryTransport()
    made = configuration(max_age_s=2.0)
    now = 0.0
    link = Link(made, lambda: codec_of(made), hub, clock=lambda: now)
    link.connected(transport)
    transport.full = True
    link.offer(command(1), None, ARRIVED, 0.0)
    link.offer(command(2), None, ARRIVED, 0.0, 0.5)
    transport.full = False
    now = 1.0
    link.expire(now)
    assert hub.fates == ["expired"], "the caller's patience was shorter"
    now = 2.0
    link.writable()
    assert hub.fates == ["expired", "expired"]
    assert transport.wires == []


async def test_when_the_link_goes_down_everything_that_waits_is_dropped(hub: Hub) -> None:
    transport = MemoryTransport()
    link = connected(hub, transport)
    transport.full = True
    link.offer(command(), None, ARRIVED, 0.0)
    link.lost(LinkLost("unplugged"))
    assert hub.fates == ["link_down"]
    assert hub.events == ["opened", "closed"]
    assert (link.state, link.reason) == ("waiting", "unplugged")
    link.connected(MemoryTransport())
    link.writable()
    assert hub.fates == ["link_down"]


async def test_a_crowded_outbox_says_which_frame_it_dropped(hub: Hub) -> None:
    transport = MemoryTransport()
    link = connected(hub, transport, queue_frames=1)
    transport.full = True
    assert link.offer(command(1), None, ARRIVED, 0.0) is None
    assert link.offer(command(2), None, ARRIVED, 0.0) is None
    assert hub.fates == ["queue_full"]
    assert link.offer(psiu_ascii.message(PC, MNERIM, "qualseunome"), None, ARRIVED, 0.0) == "queue_full"


async def test_a_lost_peer_takes_only_its_own_frames_with_it(hub: Hub) -> None:
    transport = MemoryTransport(peers=("a", "b"))
    link = connected(hub, transport, adapter=MemoryDatagrams())
    link.received(COMMAND, "a")
    transport.full = True
    link.offer(command(1), "a", ARRIVED, 0.0)
    link.offer(command(2), "b", ARRIVED, 0.0)
    link.peer_lost("a")
    assert hub.fates == ["link_down"]
    assert hub.lost_peers == [Way("radio", "a")]
    transport.full = False
    link.writable()
    assert [peer for _, peer in transport.written] == ["b"]


async def test_each_peer_of_a_stream_link_has_a_stream_of_its_own(hub: Hub) -> None:
    link = connected(hub, MemoryTransport(peers=("a", "b")))
    link.received(COMMAND[:10], "a")
    link.received(COMMAND, "b")
    link.received(COMMAND[10:], "a")
    assert [way.peer for _, way in hub.frames] == ["b", "a"]


async def test_half_a_datagram_does_not_wait_for_the_next(hub: Hub) -> None:
    link = connected(hub, MemoryTransport(), adapter=MemoryDatagrams())
    link.received(COMMAND[:20], "a")
    link.received(COMMAND, "a")
    assert len(hub.frames) == 1
    assert len(hub.noise) == 1


async def test_half_a_frame_on_a_stream_is_given_up_after_silence(hub: Hub) -> None:
    link = connected(hub, MemoryTransport(), clock=time.monotonic, codec={"silence_ms": 20})
    link.received(COMMAND[:20], None)
    assert not hub.noise
    await hub.until(lambda: hub.noise)
    link.received(COMMAND, None)
    assert len(hub.frames) == 1


async def test_a_codec_that_becomes_impatient_is_asked_sooner(hub: Hub) -> None:
    link = connected(hub, MemoryTransport(), clock=time.monotonic, codec={"silence_ms": 60_000})
    link.received(b"PC 999 lixo " + COMMAND[:10], None)
    link.received(COMMAND[10:], None)
    await hub.until(lambda: hub.frames)
    assert hub.frames[0][0].source == PC


async def test_what_comes_behind_the_frame_that_ended_the_link_is_not_heard(hub: Hub) -> None:
    link = connected(hub, MemoryTransport())
    hub.heard = lambda frame, way, now: hub.frames.append((frame, way)) or link.lost(LinkLost("gone"))  # type: ignore[func-returns-value, method-assign]
    link.received(COMMAND + COMMAND, None)
    assert len(hub.frames) == 1
    assert hub.noise == [Malformed(CUT_OFF, COMMAND, len(COMMAND))]


@pytest.mark.parametrize("begun", [COMMAND[:10], COMMAND[:-1]])
async def test_half_a_frame_counts_when_the_link_goes_down_in_its_midst(hub: Hub, begun: bytes) -> None:
    link = connected(hub, MemoryTransport())
    link.received(begun, None)
    link.lost(LinkLost("gone"))
    assert hub.noise == [Malformed(CUT_OFF, begun, len(begun))]
    assert link.malformed == 1
    assert not hub.frames


async def test_half_a_frame_counts_when_its_sender_leaves(hub: Hub) -> None:
    link = connected(hub, MemoryTransport())
    link.received(COMMAND[:10], "a")
    link.peer_lost("a")
    assert hub.noise == [Malformed(CUT_OFF, COMMAND[:10], 10)]


async def test_an_answer_without_a_destination_is_for_whom_the_robot_was_last_addressed_by(hub: Hub) -> None:
    made = configuration("arm", "psiu-hexa", codec={"topology": "point-to-point", "remote": 0x12, "local": 0})
    link = Link(made, lambda: codec_of(made), hub, unaddressed=True)
    link.connected(MemoryTransport())
    far_end = configuration("arm", "psiu-hexa", codec={"topology": "point-to-point", "remote": 0, "local": 0x12})
    ping = codec_of(far_end).encode(psiu_hexa.packet(Address.numbered(0x12), Address.numbered(0), b""))
    link.received(ping, None)
    link.offer(psiu_hexa.packet(Address.numbered(7), Address.numbered(0x12), b""), None, ARRIVED, link.since)
    link.received(ping, None)
    assert [frame.destination.number for frame, _ in hub.frames] == [0, 7]


async def test_a_robot_with_small_buffers_is_warned_about_and_gets_its_frame(
    hub: Hub, caplog: pytest.LogCaptureFixture
) -> None:
    transport = MemoryTransport()
    link = connected(hub, transport, avr_limits=True)
    link.offer(command(), None, ARRIVED, 0.0)
    assert not caplog.records
    link.offer(psiu_ascii.message(PC, MNERIM, "x" * 21), None, ARRIVED, 0.0)
    assert "may not understand" in caplog.text
    assert len(transport.wires) == 2


async def test_every_frame_that_leaves_can_be_watched(hub: Hub) -> None:
    transport = MemoryTransport()
    link = connected(hub, transport)
    link.offer(command(1), None, ARRIVED, 0.0)
    hub.bus.raw_listened = True
    link.offer(command(2), None, ARRIVED, 0.0)
    transport.full = True
    link.offer(command(3), None, ARRIVED, 0.0)
    transport.full = False
    link.writable()
    assert hub.out == transport.wires[1:]


async def test_a_link_opens_and_says_so(hub: Hub) -> None:
    adapter = MemoryAdapter()
    link = make(hub, adapter)
    async with running(link):
        await hub.until(lambda: hub.events == ["opened"])
        assert link.state == "open"
        assert link.ways() == (Way("radio"),)
    assert adapter.transport.closed
    assert link.state == "closed"
    assert hub.events == ["opened", "closed"]


async def test_an_absent_device_is_waited_for_and_the_reason_is_shown(hub: Hub) -> None:
    adapter = MemoryAdapter()
    adapter.fail()
    link = make(hub, adapter)
    async with running(link):
        await turns(lambda: link.state == "waiting" and link.reason != "not opened yet")
        assert link.reason == "nobody there; waiting"
        adapter.mend()
        await hub.until(lambda: hub.events == ["opened"])
        assert link.reason is None


async def test_a_lost_link_comes_back_by_itself(hub: Hub) -> None:
    adapter = MemoryAdapter()
    link = make(hub, adapter)
    async with running(link):
        await hub.until(lambda: hub.events == ["opened"])
        first = adapter.transport
        link.lost(LinkLost("unplugged"))
        await hub.until(lambda: hub.events == ["opened", "closed", "opened"])
        assert first.closed
        assert adapter.openings == link.opened == 2


async def test_a_transport_that_cannot_be_closed_does_not_end_the_link(
    hub: Hub, caplog: pytest.LogCaptureFixture
) -> None:
    class Stuck(MemoryTransport):
        async def close(self) -> None:
            raise OSError(5, "EIO")

    adapter = MemoryAdapter(transport_class=Stuck)
    link = make(hub, adapter)
    async with running(link):
        await hub.until(lambda: hub.events == ["opened"])
        link.lost(LinkLost("unplugged"))
        await hub.until(lambda: hub.events == ["opened", "closed", "opened"])
        adapter.transport_class = MemoryTransport
    assert "EIO" in caplog.text


async def test_an_adapter_that_breaks_its_word_is_tried_again_and_stops_nothing(
    hub: Hub, caplog: pytest.LogCaptureFixture
) -> None:
    adapter = MemoryAdapter()
    adapter.fail(ZeroDivisionError("oops"))
    link = make(hub, adapter)
    async with running(link):
        await turns(lambda: "its adapter failed" in (link.reason or ""))
        adapter.mend()
        await hub.until(lambda: hub.events == ["opened"])
    assert "its adapter failed" in caplog.text


async def test_a_device_that_appears_ends_the_pause(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    appeared = asyncio.Event()

    class Plugged(MemoryAdapter):
        async def changed(self) -> None:
            await appeared.wait()

    monkeypatch.setattr(kept, "FIRST_PAUSE_S", 3600.0)
    adapter = Plugged()
    adapter.fail()
    link = make(hub, adapter)
    async with running(link):
        await turns(lambda: link.state == "waiting" and link.reason != "not opened yet")
        adapter.mend()
        appeared.set()
        await hub.until(lambda: hub.events == ["opened"])


async def test_a_link_that_is_told_to_end_just_as_its_pause_ends_ends(hub: Hub) -> None:
    cleans_up, clean = asyncio.Event(), asyncio.Event()

    class Slow(MemoryAdapter):
        async def changed(self) -> None:
            try:
                await asyncio.Event().wait()
            finally:
                cleans_up.set()
                await clean.wait()

    adapter = Slow()
    adapter.fail()
    link = make(hub, adapter)
    task = asyncio.create_task(link.run())
    await cleans_up.wait()
    task.cancel()
    await asyncio.wait({task}, timeout=1)
    clean.set()
    assert task.cancelled()
    assert link.state == "closed"


async def test_the_pause_grows_in_vain_and_shrinks_only_when_bytes_arrive(hub: Hub) -> None:
    adapter = MemoryAdapter()
    adapter.fail()
    link = make(hub, adapter)
    pauses = []
    async with running(link):
        while len(pauses) < 4:
            await asyncio.sleep(0)
            if not pauses or link.pause_s != pauses[-1]:
                pauses.append(link.pause_s)
        adapter.mend()
        await hub.until(lambda: "opened" in hub.events)
        grown = link.pause_s
        assert pauses == sorted(pauses)
        assert grown >= pauses[-1]
        link.received(b"x", None)
        assert link.pause_s == kept.FIRST_PAUSE_S

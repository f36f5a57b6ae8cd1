"""What a link holds back, what passes, and how long it took: a clock and timers of our own."""

import asyncio
from collections import Counter
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st
from memory_adapter import MemoryAdapter, MemoryDatagrams, MemoryTransport, codec_of, configuration
from paced_lab import Clock
from test_link import Hub

from psiu_broker import link as link_module
from psiu_broker.codecs import psiu_ascii
from psiu_broker.errors import LinkLost
from psiu_broker.exchange import Exchange
from psiu_broker.frame import Address, Frame, Way
from psiu_broker.link import Link
from psiu_broker.report import Report
from psiu_broker.routing.outbox import is_stop
from psiu_broker.routing.router import Router

BASE, PC, MNERIM, BETA = map(Address.named, ("base", "PC", "MNERIM", "BETA"))
ARRIVED = Way("wifi")


def say(*words: str, to: Address = MNERIM) -> Frame:
    return psiu_ascii.message(PC, to, *words)


class Lab:
    """A link in memory, and what left on it in words."""

    def __init__(self, *peers: object, **options: Any) -> None:
        self.clock = Clock()
        self.hub = Hub()
        made = configuration(adapter=MemoryDatagrams() if peers else MemoryAdapter(), **options)
        self.link = Link(
            made, lambda: codec_of(made), cast(Any, self.hub), clock=self.clock, call_at=self.clock.call_at
        )
        self.transport = MemoryTransport(peers or (None,))
        self.link.connected(self.transport)

    def offer(self, frame: Frame, peer: object = None, patience_s: float = 1e9) -> str | None:
        return self.link.offer(frame, peer, ARRIVED, self.clock.now, patience_s)

    @property
    def left(self) -> list[str]:
        """The words of what left, without the addresses."""
        return [wire.decode().split(" ", 2)[2].rsplit(" PC ", 1)[0] for wire in self.transport.wires]


# Limits.


def test_over_the_limit_a_frame_waits_for_its_moment_and_for_no_tick() -> None:
    lab = Lab(max_frames_s=4.0)
    assert [lab.offer(say("parafrente", str(number))) for number in range(3)] == ["delivered", None, None]
    assert lab.link.outbox.size == 2
    moment = lab.clock.next
    assert moment == pytest.approx(100.25)
    lab.clock.pass_to(moment)
    assert lab.left == ["parafrente 0", "parafrente 1"]
    assert lab.hub.fates == ["delivered"]
    lab.clock.pass_on(10)
    assert lab.left == ["parafrente 0", "parafrente 1", "parafrente 2"]
    assert not [handle for handle in lab.clock.handles if not handle.cancelled], "nobody looks where nothing waits"


def test_bytes_are_limited_as_frames_are() -> None:
    lab = Lab(max_bytes_s=len(b"MNERIM 034 parafrente 100 PC 02123"))
    for _ in range(3):
        lab.offer(say("parafrente", "100"))
    assert len(lab.left) == 1
    lab.clock.pass_to(101.8)
    assert len(lab.left) == 2, "one a second, after what the first took beyond the burst"


def test_a_subject_over_its_own_limit_holds_up_no_other() -> None:
    lab = Lab(limits={"para*": {"frames_s": 1.0}})
    for words in (("parafrente", "1"), ("paratras", "1"), ("giradireita", "90")):
        lab.offer(say(*words))
    assert lab.left == ["parafrente 1", "giradireita 90"]
    lab.clock.pass_on(1.0)
    assert lab.left[2:] == ["paratras 1"]


def test_each_limit_opens_at_its_own_moment_whichever_is_asked_first() -> None:
    lab = Lab(limits={"slow": {"frames_s": 0.5}, "quick": {"frames_s": 4.0}}, max_age_s=9.0)
    for word in ("slow", "slow", "quick", "quick", "slow"):
        lab.offer(say(word))
    lab.clock.pass_on(0.25)
    assert lab.left == ["slow", "quick", "quick"]
    lab.clock.pass_on(2.0)
    assert lab.left == ["slow", "quick", "quick", "slow"]


def test_what_a_limit_holds_back_for_too_long_never_leaves() -> None:
    lab = Lab(max_frames_s=0.1, max_age_s=2.0)
    lab.offer(say("parafrente", "1"))
    lab.offer(say("parafrente", "2"))
    lab.clock.pass_on(60)
    assert lab.left == ["parafrente 1"]
    assert lab.hub.fates == ["expired"]


def test_a_limit_s_timer_dies_with_the_link() -> None:
    lab = Lab(max_frames_s=1.0)
    lab.offer(say("parafrente", "1"))
    lab.offer(say("parafrente", "2"))
    lab.link.lost(LinkLost("unplugged"))
    assert lab.hub.fates == ["link_down"]
    assert not [handle for handle in lab.clock.handles if not handle.cancelled]
    lab.link.connected(MemoryTransport())
    lab.clock.pass_on(5)
    assert lab.left == ["parafrente 1"]


def test_a_command_within_the_limit_goes_before_a_question_that_waits_for_it() -> None:
    lab = Lab(max_frames_s=4.0)
    for _ in range(3):
        lab.offer(say("qualseunome"))
    lab.offer(say("parafrente", "1"))
    lab.clock.pass_on(1)
    assert lab.left == ["qualseunome", "parafrente 1", "qualseunome", "qualseunome"]


def test_a_far_end_that_takes_nothing_uses_up_nobody_s_limit() -> None:
    lab = Lab("a", "b", max_frames_s=8.0)
    lab.transport.full_peers = {"a"}
    for number in range(3):
        lab.offer(say("parafrente", str(number)), "a")
    assert [lab.offer(say("paratras", str(number)), "b") for number in range(3)] == ["delivered", "delivered", None]
    lab.clock.pass_on(0.13)
    assert lab.left == ["paratras 0", "paratras 1", "paratras 2"]


def test_a_frame_that_waits_for_a_limit_counts_as_waiting_until_its_fate_is_known() -> None:
    exchange = Exchange(BASE, Router({BASE: "psiu-ascii"}, (), lambda frame: frame))
    exchange.resident = cast(Any, Mute())
    report = Report("base", exchange, lambda _: ())
    clock = Clock()
    for name, options in (("wifi", {}), ("radio", {"max_frames_s": 4.0})):
        made = configuration(name, **options)
        link = Link(made, lambda made=made: codec_of(made), exchange, clock=clock, call_at=clock.call_at)  # type: ignore[misc]
        exchange.add(link)
        link.connected(MemoryTransport())
    links = exchange.links
    links["radio"].received(links["radio"].codec.encode(psiu_ascii.message(MNERIM, PC, "ping")), None)
    for number in range(4):
        links["wifi"].received(links["wifi"].codec.encode(say("parafrente", str(number))), None)
    for waiting in (3, 2, 1, 0):
        ledger = report.ledger()
        assert ledger.balances
        assert next(each.waiting for each in ledger.accounts if each.link == "wifi") == waiting
        assert next(each for each in report.links() if each.name == "radio").queued == waiting
        if waiting:
            clock.pass_to(clock.next)
    radio = next(each for each in report.links() if each.name == "radio")
    assert (radio.delay_p50_ms, radio.delay_p99_ms) == (500.0, 750.0)


class Mute:
    """A resident to whom nothing matters."""

    def __getattr__(self, _: str) -> Any:
        return lambda *_: None


# The stop.


def test_a_stop_leaves_at_once_however_much_a_limit_holds_back() -> None:
    lab = Lab(max_frames_s=1.0, max_bytes_s=10.0, limits={"pare": {"frames_s": 0.1}})
    for number in range(9):
        lab.offer(say("parafrente", str(number), to=BETA))
    assert [lab.offer(say("pare")) for _ in range(3)] == ["delivered"] * 3
    assert lab.left == ["parafrente 0", "pare", "pare", "pare"]


def test_a_stop_does_not_use_up_the_limit_of_others() -> None:
    lab = Lab(max_frames_s=4.0)
    for _ in range(20):
        assert lab.offer(say("PARE")) == "delivered"
    assert lab.offer(say("parafrente", "1")) == "delivered"


@pytest.mark.parametrize("options", [{}, {"max_frames_s": 100.0}])
def test_a_stop_tries_the_wire_although_others_wait_for_it(options: dict[str, Any]) -> None:
    lab = Lab(**options)
    lab.transport.full = True
    lab.offer(say("luz", to=BETA))
    lab.transport.full = False
    assert lab.offer(say("pare")) == "delivered"
    assert lab.offer(say("luz", to=BETA)) is None, "a command does not overtake a command"
    lab.link.writable()
    assert lab.left == ["pare", "luz", "luz"]


@pytest.mark.parametrize("options", [{}, {"max_frames_s": 1.0}])
def test_what_waited_for_a_robot_does_not_move_it_after_its_stop_even_if_that_leaves_at_once(
    options: dict[str, Any],
) -> None:
    lab = Lab(**options)
    lab.transport.full = True
    lab.offer(say("parafrente", "1"))
    lab.transport.full = False
    lab.offer(say("pare"))
    lab.clock.pass_on(1.5)
    assert lab.left == ["pare"]
    assert lab.hub.fates == ["superseded"]


async def test_a_link_is_not_drained_while_what_came_as_the_last_left_waits() -> None:
    lab = Lab()
    lab.transport.full = True
    lab.offer(say("parafrente", "0"))
    drained = asyncio.ensure_future(lab.link.drained())
    await asyncio.sleep(0)
    lab.transport.full = False
    lab.link.writable()
    lab.transport.full = True
    lab.offer(say("pare"))
    for _ in range(3):
        await asyncio.sleep(0)
    assert not drained.done()
    lab.transport.full = False
    lab.link.writable()
    async with asyncio.timeout(5):
        await drained
    assert lab.left == ["parafrente 0", "pare"]


async def test_a_link_is_drained_when_a_stop_took_the_place_of_the_last_that_waited() -> None:
    lab = Lab(max_frames_s=1.0)
    for number in range(2):
        lab.offer(say("parafrente", str(number)))
    drained = asyncio.ensure_future(lab.link.drained())
    await asyncio.sleep(0)
    lab.transport.full = True
    lab.offer(say("pare"))
    lab.transport.full = False
    await asyncio.sleep(0)
    assert not drained.done(), "the stop itself waits"
    lab.offer(say("parafrente", "3", to=BETA))
    lab.link.writable()
    await asyncio.sleep(0)
    assert not drained.done(), "a limit holds another back"
    assert lab.offer(say("pare", to=BETA)) == "delivered"
    async with asyncio.timeout(5):
        await drained


def test_stops_keep_their_order() -> None:
    lab = Lab()
    lab.transport.full = True
    lab.offer(say("pare", to=BETA))
    lab.transport.full = False
    assert lab.offer(say("stop")) is None
    lab.link.writable()
    assert lab.left == ["pare", "stop"]


# The newest wins.


def test_of_a_set_point_only_the_newest_for_each_robot_waits() -> None:
    lab = Lab(newest_wins=["motor*"])
    lab.transport.full = True
    for words, robot in ((("motor1", "1"), MNERIM), (("motor1", "5"), BETA), (("luz", "1"), MNERIM)):
        assert lab.offer(say(*words, to=robot)) is None
    for speed in ("2", "3"):
        assert lab.offer(say("MOTOR1", speed)) is None
    assert lab.offer(say("motor2", "9")) is None
    lab.transport.full = False
    lab.link.writable()
    assert lab.left == ["MOTOR1 3", "motor1 5", "luz 1", "motor2 9"]
    assert Counter(lab.hub.fates) == {"superseded": 2, "delivered": 4}


def test_a_stream_of_set_points_neither_starves_nor_is_starved() -> None:
    lab = Lab(newest_wins=["motor"], max_frames_s=8.0)
    for tick in range(64):
        lab.offer(say("motor", str(tick)))
        lab.offer(say("motor", str(tick), to=BETA))
        lab.clock.pass_on(1 / 64)
    heard = Counter(wire.split()[0] for wire in lab.transport.wires)
    assert abs(heard[b"MNERIM"] - heard[b"BETA"]) <= 1
    assert sum(heard.values()) == 10, "a burst of two, and eight in the second"


def test_a_set_point_s_age_is_that_of_the_newest() -> None:
    lab = Lab(newest_wins=["motor"], max_age_s=1.0)
    lab.transport.full = True
    lab.offer(say("motor", "1"))
    lab.clock.pass_on(0.9)
    lab.offer(say("motor", "2"))
    lab.clock.pass_on(0.9)
    lab.transport.full = False
    lab.link.writable()
    assert lab.left == ["motor 2"]


def test_no_answer_question_or_stop_takes_another_s_place() -> None:
    lab = Lab(newest_wins=["*"])
    lab.transport.full = True
    for words in (("motor", "sucesso"), ("motor", "falha"), ("qualseunome",), ("qualseunome",), ("pare",), ("pare",)):
        lab.offer(say(*words, to=BETA))
    assert lab.hub.fates == []


# Ages and delays.


def test_a_question_may_wait_longer_than_what_moves_a_robot() -> None:
    lab = Lab(max_age_s=1.0, question_max_age_s=3.0)
    lab.transport.full = True
    lab.offer(say("parafrente", "1"))
    lab.offer(say("exibecomandos"))
    lab.clock.pass_on(1.5)
    lab.link.expire(lab.clock.now)
    assert lab.hub.fates == ["expired"]
    lab.transport.full = False
    lab.link.writable()
    assert lab.left == ["exibecomandos"]
    lab.transport.full = True
    lab.offer(say("exibecomandos"))
    lab.clock.pass_on(3.0)
    lab.link.expire(lab.clock.now)
    assert lab.hub.fates == ["expired", "delivered", "expired"]


def test_how_long_frames_waited_is_told() -> None:
    lab = Lab()
    assert lab.link.outbox.delays.ms(lab.link.frames_out) is None
    lab.offer(say("luz"))
    assert lab.link.outbox.delays.ms(lab.link.frames_out) == (0.0, 0.0)
    lab.transport.full = True
    lab.offer(say("luz"))
    lab.clock.pass_on(0.25)
    lab.transport.full = False
    lab.link.writable()
    assert lab.link.outbox.delays.ms(lab.link.frames_out) == (250.0, 250.0)


# Everything together.


@given(
    steps=st.lists(
        st.tuples(
            st.sampled_from(["motor", "luz", "pare", "qualseunome", "full", "free", "lost"]),
            st.sampled_from([MNERIM, BETA]),
            st.floats(0, 0.6),
        ),
        max_size=60,
    ),
    options=st.fixed_dictionaries(
        {"max_age_s": st.floats(0.1, 2), "queue_frames": st.integers(1, 6)},
        optional={
            "max_frames_s": st.floats(0.5, 20),
            "max_bytes_s": st.floats(20, 500),
            "limits": st.just({"m*": {"frames_s": 2.0}}),
            "newest_wins": st.just(["motor"]),
        },
    ),
)
def test_whatever_happens_each_frame_has_one_fate_none_leaves_late_and_stops_wait_for_the_wire_alone(
    steps: list[tuple[str, Address, float]], options: dict[str, Any]
) -> None:
    lab = Lab(question_max_age_s=2.5, **options)
    offered: Counter[str] = Counter()
    born: dict[str, float] = {}

    class Wire(MemoryTransport):
        def write(self, data: bytes, peer: object) -> bool:
            taken = super().write(data, peer)
            if taken:
                word, number = data.decode().split()[2:4]
                limit_s = 2.5 if word == "qualseunome" else options["max_age_s"]
                assert lab.clock.now - born[number] < limit_s
            return taken

    lab.transport = Wire()
    lab.link.lost(LinkLost("first"))
    lab.link.connected(lab.transport)
    for number, (word, robot, pause_s) in enumerate(steps):
        if word in ("full", "free"):
            lab.transport.full = word == "full"
            if word == "free":
                lab.link.writable()
        elif word == "lost":
            lab.link.lost(LinkLost("unplugged"))
            lab.link.connected(lab.transport)
        else:
            born[str(number)] = lab.clock.now
            verdict = lab.offer(say(word, str(number), to=robot))
            offered["offered"] += 1
            offered[verdict or "waiting"] += 1
            if is_stop(word) and not lab.transport.full:
                assert verdict == "delivered"
        settled = len(lab.hub.fates) + offered["offered"] - offered["waiting"]
        assert offered["offered"] == settled + lab.link.outbox.size
        assert lab.transport.full or lab.link._limits or not lab.link.outbox.size
        if lab.link.outbox.size and not lab.transport.full:
            assert lab.clock.next < float("inf"), "a timer, or what waits would wait for ever"
        lab.clock.pass_on(pause_s)
    lab.transport.full = False
    lab.link.writable()
    lab.clock.pass_on(1000)
    assert lab.link.outbox.size == 0
    assert len(lab.hub.fates) == offered["waiting"]


def test_every_look_at_a_link_is_short() -> None:
    assert len(vars(Lab().link)) <= 29, "with more, CPython 3.11 keeps them where it finds them slowly"


def test_who_configures_nothing_has_no_limits_to_ask() -> None:
    assert Lab().link._limits is None
    assert link_module._limits(configuration().options) is None

"""A link that sends packets at a fixed rate, with a clock and timers of our own."""

from collections.abc import Callable
from math import inf
from typing import Any, cast

import pytest
from memory_adapter import MemoryAdapter, MemoryTransport

from psiu_broker.adapter import Adapter, Peer
from psiu_broker.codecs.codec import Directory
from psiu_broker.codecs.paced import Rest
from psiu_broker.codecs.soccer import Soccer, byte_of
from psiu_broker.config import LinkConfiguration, LinkOptions
from psiu_broker.frame import NOBODY, Address, Frame, Malformed, Way
from psiu_broker.link import Hub, Link
from psiu_broker.paced_link import PacedLink
from psiu_broker.routing.outbox import Fate

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

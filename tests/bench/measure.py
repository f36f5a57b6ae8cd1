"""All figures in one run: every subject is measured in every round, one after the other, and compared in pairs."""

import gc
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

from tests.bench.ends import LEFT, RIGHT, Ends, PtyEnds, UdpEnds
from tests.bench.figures import Cost, Figures, Latency, cost, latency
from tests.bench.frames import introductions, load, names
from tests.bench.load import first_frame, flood, introduce, latencies, quiet
from tests.bench.routers import LOAD_CORE, Listener, Router, broker, forwarder, free_bus, on_core

PAIR = 2
FORWARDER = "bare forwarder"
BROKER = "psiu-broker"
UDP, PTY = "UDP → UDP", "pty → pty"
KINDS: dict[str, type[UdpEnds] | type[PtyEnds]] = {UDP: UdpEnds, PTY: PtyEnds}
SETTLED_S = 0.2

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Plan:
    """How much is measured. Many short rounds: a disturbance then falls on both of a pair, or on few pairs."""

    rounds: int = 31
    frames: int = 5_000
    latency_rounds: int = 6
    latency_frames: int = 1_000
    starts: int = 5
    robots: tuple[int, ...] = (10, 100, 1000)


QUICK = Plan(rounds=1, frames=300, latency_rounds=1, latency_frames=30, starts=1, robots=(10,))


@dataclass
class Subject:
    """A router under load, and what was measured of it, a round each."""

    name: str
    router: Router
    ends: Ends
    frames: Sequence[bytes]
    sent: int = 0
    lost: int = 0
    doubled: int = 0
    rates: list[float] = field(default_factory=list)
    cpu_us: list[float] = field(default_factory=list)

    def measure(self) -> None:
        before = self.router.cpu_s()
        flooded = flood(self.ends, self.frames)
        self.sent += len(self.frames)
        self.lost += flooded.lost
        self.doubled += flooded.doubled
        self.rates.append(flooded.delivered / flooded.seconds)
        self.cpu_us.append((self.router.cpu_s() - before) / max(1, flooded.delivered) * 1e6)

    def cost(self, baseline: "Subject", start_ms: float | None = None, told: float | None = None) -> Cost:
        return cost(
            self.name,
            self.rates,
            self.cpu_us,
            baseline.cpu_us,
            sent=self.sent,
            lost=self.lost,
            doubled=self.doubled,
            rss_mib=self.router.rss_mib(),
            start_ms=start_ms,
            told=told,
        )


def measure(plan: Plan, progress: Progress) -> Figures:
    """Everything.

    Raises:
        RuntimeError, TimeoutError: a router does not start, or ends by itself.
    """
    gc.disable()
    with on_core(LOAD_CORE), ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="psiu-bench-")))
        lab = _Lab(stack, folder, plan, progress)
        pairs = {kind: (lab.subject(FORWARDER, kind), lab.subject(BROKER, kind)) for kind in KINDS}
        listened, listener = lab.listened()
        crowds = [lab.crowd(robots) for robots in plan.robots]
        subjects = [*(subject for pair in pairs.values() for subject in pair), listened, *crowds]
        for subject in subjects:
            subject.ends.use(subject.frames)
            flood(subject.ends, subject.frames)
        before = _settled(listener)
        for turn in range(plan.rounds):
            progress(f"round {turn + 1} of {plan.rounds}")
            # There and back, so that a drift of the machine falls on all alike.
            for subject in subjects[:: -1 if turn % 2 else 1]:
                subject.measure()
        told = (_settled(listener) - before) / listened.sent
        costs = [
            subject.cost(bare, statistics.median(lab.starts_ms[subject.name]))
            for bare, routed in pairs.values()
            for subject in (bare, routed)
        ]
        return Figures(
            [*costs, listened.cost(pairs[UDP][0], told=told)],
            [crowd.cost(crowds[0]) for crowd in crowds],
            [each for kind, pair in pairs.items() for each in lab.latencies(kind, pair)],
        )


class _Lab:
    """Sets up what is measured; `stack` takes it down."""

    def __init__(self, stack: ExitStack, folder: Path, plan: Plan, progress: Progress) -> None:
        self.starts_ms: dict[str, list[float]] = {}
        """From exec to the first frame forwarded, by the subject's name."""
        self._stack = stack
        self._folder = folder
        self._plan = plan
        self._progress = progress

    def subject(self, name: str, kind: str) -> Subject:
        title = f"{kind}  {name}"
        self._progress(f"starting {title}")
        for _ in range(self._plan.starts - 1):
            with ExitStack() as once:
                self._start(once, title, name, KINDS[kind](routed=True), free_bus())
        ends = KINDS[kind](routed=True)
        return Subject(title, self._start(self._stack, title, name, ends, free_bus()), ends, self._load(PAIR))

    def listened(self) -> tuple[Subject, Listener]:
        """A broker between UDP ends, and a Zenoh client that listens to it."""
        title, ends, bus = f"{UDP}  {BROKER}, a client", UdpEnds(routed=True), free_bus()
        router = self._start(self._stack, title, BROKER, ends, bus)
        return Subject(title, router, ends, self._load(PAIR)), self._stack.enter_context(Listener(bus))

    def crowd(self, robots: int) -> Subject:
        """A broker between UDP ends that has heard so many robots, half of them on each side."""
        title, ends = f"{robots:,} robots known", UdpEnds(routed=True)
        self._progress(f"starting {title}")
        router = self._start(self._stack, title, BROKER, ends, free_bus())
        for side, known in zip((LEFT, RIGHT), names(robots), strict=True):
            introduce(ends, side, introductions(known))
        quiet(ends)
        return Subject(title, router, ends, self._load(robots))

    def latencies(self, kind: str, pair: Sequence[Subject]) -> list[Latency]:
        direct = KINDS[kind](routed=False)
        self._stack.callback(direct.close)
        frames = load(PAIR, self._plan.latency_frames)
        floor = f"{kind}  no router"
        ends: dict[str, Ends] = {floor: direct, **{subject.name: subject.ends for subject in pair}}
        took: dict[str, list[float]] = {name: [] for name in ends}
        for each in ends.values():
            each.use(frames)
        for turn in range(self._plan.latency_rounds):
            self._progress(f"{kind}: latency, round {turn + 1} of {self._plan.latency_rounds}")
            for name, each in ends.items():
                took[name] += latencies(each, frames)
        sent = self._plan.latency_rounds * self._plan.latency_frames
        return [latency(name, us, None if name == floor else took[floor], sent) for name, us in took.items()]

    def _load(self, robots: int) -> list[bytes]:
        return load(robots, self._plan.frames)

    def _start(self, stack: ExitStack, title: str, name: str, ends: UdpEnds | PtyEnds, bus: str) -> Router:
        """A running router that has forwarded its first frame."""
        stack.callback(ends.close)
        left, right = names(PAIR)
        made = forwarder(ends, (left, right), self._folder) if name == FORWARDER else broker(ends, self._folder, bus)
        router = stack.enter_context(made)
        first_frame(ends, (introductions(left)[0], introductions(right)[0]), load(PAIR, 1)[0])
        self.starts_ms.setdefault(title, []).append((time.perf_counter() - router.started) * 1000)
        quiet(ends)
        return router


def _settled(listener: Listener) -> int:
    """What the listener has been told of, once nothing more comes."""
    before, now = -1, listener.told()
    while now != before:
        time.sleep(SETTLED_S)
        before, now = now, listener.told()
    return now

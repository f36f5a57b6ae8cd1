"""How a mesh heals: what must be so after each event, and the figures."""

import asyncio
import itertools
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from system.events import Event
from system.lab import Lab
from system.traffic import Sent, Traffic

HEALED_S: Final = 5.0
"""Within this time of the end of an event everyone must reach everyone."""
SETTLED_S: Final = 5.0
"""Within this time of the last frame the books must agree."""
NEVER_S: Final = 20.0
"""How long one that is late is watched, for the report."""
START_S: Final = 20.0
POLL_S: Final = 0.05
DOUBLES_SHOWN: Final = 8


@dataclass(frozen=True)
class Healed:
    """What came of one event. `healed_s` is None where it never did; `faults` are in words."""

    text: str
    healed_s: float | None
    sent: Sent
    doubled: int
    faults: tuple[str, ...]


class Watch:
    """Puts a lab through events and checks it after each."""

    def __init__(self, lab: Lab) -> None:
        self._lab = lab
        self._traffic = Traffic(lab)
        self._books: _Books | None = None
        self.unequal: list[str] = []
        """Frames between brokers that were not accounted for at last; a later beat may still do it."""
        self._doubles: set[str] = set()

    async def start(self) -> Healed:
        """Wait until everyone reaches everyone for the first time, then until the books agree."""
        self._traffic.go()
        return await self._after("the start", time.monotonic(), START_S, [])

    async def stop(self) -> None:
        await self._traffic.pause()

    async def end(self) -> Healed:
        """Once more amid traffic, without an event: now every frame must be accounted for."""
        self._traffic.go()
        end = await self._after("the end", time.monotonic(), HEALED_S, [])
        return replace(end, faults=(*end.faults, *self.unequal))

    async def go_through(self, event: Event) -> Healed:
        """Let it happen amid traffic; wait until the mesh has healed, then until the books agree."""
        self._traffic.go()
        faults, _ = await self._heal("before it the mesh", time.monotonic(), HEALED_S)
        self._lab.note(f"begins: {event.text}")
        begun = time.monotonic()
        await event.begin()
        faults += await self._meanwhile(event, begun)
        await event.end()
        ended = time.monotonic()
        self._lab.note(f"is over: {event.text}")
        self._traffic.go()
        return await self._after(event.text, ended, HEALED_S, faults)

    async def _after(self, text: str, since: float, within_s: float, faults: list[str]) -> Healed:
        late, healed_at = await self._heal("after it the mesh", since, within_s)
        self._lab.note("healed" if healed_at else "not healed")
        await self._traffic.pause()
        unsettled = await self._settle()
        sent, doubles = self._traffic.sent(since, healed_at or time.monotonic()), self._new_doubles()
        healed_s = None if healed_at is None else healed_at - since
        shown = doubles[:DOUBLES_SHOWN]
        if len(doubles) > len(shown):
            shown.append(f"and {len(doubles) - len(shown)} more that came more than once")
        return Healed(text, healed_s, sent, len(doubles), (*faults, *late, *unsettled, *shown))

    async def _meanwhile(self, event: Event, begun: float) -> list[str]:
        """Stay until the event has lasted; a long one until the others have found each other too."""
        pairs = event.untouched(self._lab)
        faults: list[str] = []
        if event.is_long and pairs:
            try:
                async with asyncio.timeout(HEALED_S):
                    await self._traffic.good(time.monotonic(), pairs)
            except TimeoutError:
                faults = [f"the others did not reach each other in {HEALED_S:g} s: {self._traffic.missing(pairs)}"]
        await asyncio.sleep(begun + event.lasts_s - time.monotonic())
        return faults

    async def _heal(self, what: str, since: float, within_s: float) -> tuple[list[str], float | None]:
        """When everyone had reached everyone, and what is wrong with that."""
        pairs = self._traffic.pairs
        missing = ""
        try:
            async with asyncio.timeout(within_s):
                return [], await self._traffic.good(since, pairs)
        except TimeoutError:
            missing = self._traffic.missing(pairs)
        try:
            async with asyncio.timeout(NEVER_S):
                at = await self._traffic.good(since, pairs)
        except TimeoutError:
            never = f"{what} did not heal in {within_s + NEVER_S:g} s"
            return [f"{never}: {missing}; at last {self._traffic.missing(pairs)}", *await self._views()], None
        return [f"{what} healed after {at - since:.1f} s; missing at {within_s:g} s: {missing}"], at

    async def _views(self) -> list[str]:
        """What each broker says of the mesh and of its frames, for the report."""
        return [
            f"{self._lab.brokers[node].name} says {what}: {await self._lab.ask(node, what)}"
            for node in self._lab.nodes
            for what in ("mesh", "ledger", "routes")
        ]

    async def _settle(self) -> list[str]:
        """Wait until the books of all brokers agree; what does not, in words."""
        until = time.monotonic() + SETTLED_S
        while True:
            books = await _Books.of(self._lab)
            faults = books.faults(self._lab)
            self.unequal = [] if faults else books.unequal(self._lab, self._books)
            if not (faults or self.unequal) or time.monotonic() > until:
                break
            await asyncio.sleep(POLL_S)
        if not self.unequal:
            self._books = books
        return faults

    def _new_doubles(self) -> list[str]:
        found = [double for double in self._traffic.doubled() if double not in self._doubles]
        self._doubles.update(found)
        return found


@dataclass(frozen=True)
class _Books:
    """What all brokers said at one time: `Ledger` and `Mesh` by node; None where there was no answer."""

    ledgers: Sequence[dict[str, Any] | None]
    meshes: Sequence[dict[str, Any] | None]

    @classmethod
    async def of(cls, lab: Lab) -> "_Books":
        asked = [lab.ask(node, what) for what in ("ledger", "mesh") for node in lab.nodes]
        answers = await asyncio.gather(*asked)
        return cls(answers[: len(lab.nodes)], answers[len(lab.nodes) :])

    def faults(self, lab: Lab) -> list[str]:
        """What does not agree, in words, frames between brokers aside."""
        names = [broker.name for broker in lab.brokers]
        owners = {robot.name: broker for robot, broker in zip(lab.robots, names, strict=True)}
        faults: list[str] = []
        for name, ledger, mesh in zip(names, self.ledgers, self.meshes, strict=True):
            if ledger is None or mesh is None:
                faults.append(f"{name} does not answer")
                continue
            if not ledger["balances"] or ledger["total"]["waiting"]:
                faults.append(f"the ledger of {name} does not balance: {ledger['accounts']}")
            told = {robot["robot"]: robot["owner"] for robot in mesh["robots"] if robot["robot"] in owners}
            if told != owners:
                faults.append(f"{name} says that the robots are with {told}")
            others = sorted(broker["name"] for broker in mesh["brokers"])
            if others != sorted(set(names) - {name}):
                faults.append(f"{name} says that the other brokers are {others}")
            if mesh["conflicts"]:
                faults.append(f"{name} sees conflicts: {mesh['conflicts']}")
        return faults

    def unequal(self, lab: Lab, before: "_Books | None") -> list[str]:
        """The pairs, both of the same life as `before`, where one did not get, or miss, what the other sent."""
        names = [broker.name for broker in lab.brokers]
        same = [node for node in range(len(names)) if before is None or self._is_same_life(node, before)]
        faults: list[str] = []
        for a, b in itertools.permutations(same, 2):
            out = self._since(before, a, names[b], "frames_out")
            came, lost = (self._since(before, b, names[a], what) for what in ("frames_in", "lost"))
            if out != came + lost:
                faults.append(f"{names[a]} sent {names[b]} {out} frames, which got {came} and misses {lost}")
        return faults

    def _is_same_life(self, node: int, before: "_Books") -> bool:
        now, then = self.meshes[node], before.meshes[node]
        return now is not None and then is not None and bool(now["zenoh_id"] == then["zenoh_id"])

    def _since(self, before: "_Books | None", node: int, other: str, what: str) -> int:
        return self._count(node, other, what) - (0 if before is None else before._count(node, other, what))

    def _count(self, node: int, other: str, what: str) -> int:
        mesh = self.meshes[node] or {"brokers": []}
        return sum(broker[what] for broker in mesh["brokers"] if broker["name"] == other)


def figures(title: str, events: Sequence[Healed]) -> str:
    """One line: how many events, how long until healed, and what was lost and doubled."""
    times = [event.healed_s for event in events if event.healed_s is not None]
    frames, lost = sum(event.sent.frames for event in events), sum(event.sent.lost for event in events)
    doubled = sum(event.doubled for event in events)
    spread = f"median {statistics.median(times):.1f} s, worst {max(times):.1f} s" if times else "never"
    healed = f"{len(events)} events, {len(times)} healed; heal {spread}"
    return f"{title}: {healed}; {lost:,} of {frames:,} frames lost while healing, {doubled} doubled"

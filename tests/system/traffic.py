"""What the robots and programs of a lab say to each other, round after round.

In a round every robot orders every other, and every program calls the robot of every other broker,
all at once; each order has a word of its own.
"""

import asyncio
import itertools
import time
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Final

from system.lab import Lab

Pair = tuple[int, int]
"""From one node to another."""

PERIOD_S: Final = 0.25
"""A round begins this long after the one before, whether that has ended or not."""


@dataclass
class Round:
    """One round: which word went from whom to whom, and what came of the calls."""

    began: float
    orders: dict[Pair, str]
    calls: dict[Pair, str]
    called: dict[Pair, float] = field(default_factory=dict)
    """When the calls of programs were answered."""
    refused: dict[Pair, str] = field(default_factory=dict)
    """Why they were not."""


@dataclass(frozen=True)
class Sent:
    """Frames between robots, orders and answers, and how many of them did not arrive."""

    frames: int
    lost: int


class Traffic:
    """Rounds in a lab, until `pause`."""

    def __init__(self, lab: Lab) -> None:
        self.pairs: Final = list(itertools.permutations(lab.nodes, 2))
        self._lab = lab
        self._numbers = itertools.count(1)
        self._rounds: list[Round] = []
        self._calls: set[asyncio.Task[None]] = set()
        self._early = asyncio.Event()
        self._going: asyncio.Task[None] | None = None

    def go(self) -> None:
        """Begin a round now, and more after it."""
        if self._going is None:
            self._rounds.clear()
            self._going = asyncio.create_task(self._go())
        self._early.set()

    async def pause(self) -> None:
        """Begin no more rounds, and wait until every call has ended; what the robots still hear is counted."""
        if self._going is not None:
            self._going.cancel()
            with suppress(asyncio.CancelledError):
                await self._going
            self._going = None
        if self._calls:
            await asyncio.wait(self._calls)

    async def good(self, since: float, pairs: Collection[Pair]) -> float:
        """When the first round that began after `since` had succeeded between `pairs`; waits for it."""
        while True:
            self._lab.news.clear()
            for round_ in self._rounds:
                if round_.began >= since and (at := self._good_at(round_, pairs)) is not None:
                    return at
            await self._lab.news.wait()

    def sent(self, since: float, until: float) -> Sent:
        """What robots sent in the rounds that began between these times. For when all is quiet."""
        rounds = [round_ for round_ in self._rounds if since <= round_.began <= until]
        frames = lost = 0
        for round_ in rounds:
            for (a, b), word in round_.orders.items():
                obeyed, answered = word in self._lab.robots[b].obeyed, word in self._lab.robots[a].answers
                frames += 2 if obeyed else 1
                lost += not answered
        return Sent(frames, lost)

    def doubled(self) -> list[str]:
        """The orders and answers that some robot got more than once, in words."""
        found: list[str] = []
        for robot in self._lab.robots:
            for what, words in (("command", robot.obeyed), ("answer", robot.answers)):
                found += [
                    f"{robot.name} got the {what} {word} {len(times)} times, {times[-1] - times[0]:.3f} s apart"
                    for word, times in words.items()
                    if len(times) > 1
                ]
        return found

    def missing(self, pairs: Collection[Pair]) -> str:
        """What did not succeed in the newest round that had a second for it, in words."""
        now = time.monotonic()
        round_ = next((each for each in reversed(self._rounds) if each.began < now - 1), self._rounds[-1])
        orders = [f"{a + 1}→{b + 1}" for a, b in pairs if self._answered_at(round_, (a, b)) is None]
        calls = [
            f"{a + 1}→{b + 1} ({round_.refused.get((a, b), 'under way')})"
            for a, b in pairs
            if (a, b) not in round_.called
        ]
        return f"frames {' '.join(orders) or 'all arrived'}; calls {', '.join(calls) or 'all answered'}"

    def _answered_at(self, round_: Round, pair: Pair) -> float | None:
        times = self._lab.robots[pair[0]].answers.get(round_.orders[pair])
        return times[0] if times else None

    def _good_at(self, round_: Round, pairs: Collection[Pair]) -> float | None:
        """When the last exchange between `pairs` had succeeded; None while one has not."""
        latest = 0.0
        for pair in pairs:
            answered, called = self._answered_at(round_, pair), round_.called.get(pair)
            if answered is None or called is None:
                return None
            latest = max(latest, answered, called)
        return latest

    async def _go(self) -> None:
        while True:
            self._early.clear()
            self._begin()
            with suppress(TimeoutError):
                async with asyncio.timeout(PERIOD_S):
                    await self._early.wait()

    def _begin(self) -> None:
        words = {pair: f"order{next(self._numbers)}" for pair in self.pairs}
        calls = {pair: f"call{next(self._numbers)}" for pair in self.pairs}
        round_ = Round(time.monotonic(), words, calls)
        self._rounds.append(round_)
        for (a, b), word in words.items():
            self._lab.robots[a].order(self._lab.robots[b].name, word)
        for pair in calls:
            task = asyncio.create_task(self._call(round_, pair))
            self._calls.add(task)
            task.add_done_callback(self._calls.discard)

    async def _call(self, round_: Round, pair: Pair) -> None:
        a, b = pair
        refused = await self._lab.callers[a].call(self._lab.robots[b].name, round_.calls[pair])
        if refused is None:
            round_.called[pair] = time.monotonic()
            self._lab.news.set()
        else:
            round_.refused[pair] = refused

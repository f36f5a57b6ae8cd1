"""What can befall a mesh: chosen at random, begun, and ended."""

import random
import signal
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from typing import Final

from system.lab import Lab
from system.network import Cable
from system.traffic import Pair

LONGEST_S: Final = 4.0
DOWN_S: Final = 3.0
LONG_S: Final = 1.5


@dataclass(frozen=True)
class Event:
    """One thing that happens: `begin`, then `end` after `lasts_s`."""

    text: str
    begin: Callable[[], Awaitable[None]]
    end: Callable[[], Awaitable[None]]
    lasts_s: float = 0.0
    missing: frozenset[int] = frozenset()
    """Nodes whose brokers do nothing meanwhile."""
    cut: frozenset[Cable] = frozenset()
    """Cables that carry nothing meanwhile."""

    @property
    def is_long(self) -> bool:
        """It goes on until the others have found each other again."""
        return self.lasts_s >= LONG_S

    def untouched(self, lab: Lab) -> list[Pair]:
        """The pairs of nodes that have a way to each other meanwhile."""
        joined = {node: {node} for node in lab.nodes if node not in self.missing}
        whole = [cable for cable in lab.network.cables if cable not in self.cut and {cable.a, cable.b} <= joined.keys()]
        for cable in whole:
            joined[cable.a].add(cable.b)
            joined[cable.b].add(cable.a)
        if lab.mode == "router":
            for _ in lab.nodes:
                for node, others in joined.items():
                    joined[node] = others.union(*(joined[other] for other in others))
        return [(a, b) for a, others in joined.items() for b in others if a != b]


Draw = Callable[[Lab, random.Random], Event]


def killed(lab: Lab, chance: random.Random) -> Event:
    broker = lab.brokers[node := chance.choice(lab.nodes)]
    lasts_s = chance.choice((0.0, chance.uniform(0.0, DOWN_S), chance.uniform(LONG_S, DOWN_S)))
    text = f"{broker.name} killed, back after {lasts_s:.1f} s"
    return Event(text, broker.kill, broker.spawn, lasts_s, missing=frozenset({node}))


def restarted(lab: Lab, chance: random.Random) -> Event:
    broker = lab.brokers[node := chance.choice(lab.nodes)]

    async def terminate() -> None:
        broker.signal(signal.SIGTERM)
        code = await broker.ended()
        assert code == 0, f"{broker.name} ended with {code}"

    return Event(f"{broker.name} restarted", terminate, broker.spawn, missing=frozenset({node}))


def stopped(lab: Lab, chance: random.Random) -> Event:
    broker = lab.brokers[node := chance.choice(lab.nodes)]
    lasts_s = chance.uniform(0.3, LONGEST_S)
    begin, end = _later(broker.signal, signal.SIGSTOP), _later(broker.signal, signal.SIGCONT)
    return Event(f"{broker.name} held still for {lasts_s:.1f} s", begin, end, lasts_s, missing=frozenset({node}))


def pulled(lab: Lab, chance: random.Random) -> Event:
    cable = chance.choice(lab.network.cables)
    end = chance.choice((cable.a, cable.b))
    lasts_s = chance.uniform(0.3, LONGEST_S)
    text = f"cable {cable} pulled at {end + 1} for {lasts_s:.1f} s"
    return Event(text, _later(cable.pull, end), _later(cable.plug, end), lasts_s, cut=frozenset({cable}))


def silenced(lab: Lab, chance: random.Random) -> Event:
    cable = chance.choice(lab.network.cables)
    lasts_s = chance.uniform(0.3, LONGEST_S)
    text = f"cable {cable} loses all for {lasts_s:.1f} s"
    return Event(text, _later(cable.lose), _later(cable.keep), lasts_s, cut=frozenset({cable}))


def parted(lab: Lab, chance: random.Random) -> Event:
    group = frozenset(chance.sample(lab.nodes, chance.randint(1, len(lab.nodes) // 2)))
    cables = [cable for cable in lab.network.cables if cable.joins(group)]
    lasts_s = chance.uniform(0.3, LONGEST_S)

    async def begin() -> None:
        for cable in cables:
            cable.lose()

    async def end() -> None:
        for cable in cables:
            cable.keep()

    names = " ".join(str(node + 1) for node in sorted(group))
    return Event(f"{names} parted from the others for {lasts_s:.1f} s", begin, end, lasts_s, cut=frozenset(cables))


def reset(lab: Lab, chance: random.Random) -> Event:
    cable = chance.choice(lab.network.cables)
    end = chance.choice((cable.a, cable.b))
    return Event(f"connections over {cable} reset at {end + 1}", _later(cable.reset, end), _later(lambda: None))


KINDS: Final[tuple[Draw, ...]] = (killed, killed, restarted, stopped, pulled, silenced, parted, reset)
"""Killed twice: at once and after a while are two different things."""


def drawn(count: int, network: int, seed: int) -> Sequence[Draw]:
    """`count` kinds of events for one of several networks; of the first few there is each kind once.

    The networks begin `count` kinds apart, so that a few in each are many kinds in all.
    """
    first = random.Random(seed).sample(KINDS, len(KINDS))
    begin = network * count % len(first)
    more = random.Random(f"{seed}/{network}").choices(KINDS, k=max(0, count - len(first)))
    return [*first[begin:], *first[:begin], *more][:count]


def _later(do: Callable[..., object], *arguments: object) -> Callable[[], Awaitable[None]]:
    async def done() -> None:
        do(*arguments)

    return done

"""Five brokers in namespaces of their own, and what can befall them: `make mesh-proof EVENTS=100` for the figures."""

import os
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import pytest
from system import events, network
from system.healing import Healed, Watch, figures
from system.lab import Lab, Mode
from system.network import Network

NODES: Final = 5
EVENTS: Final = int(os.environ.get("PSIU_MESH_EVENTS", "3"))
"""In each of the three networks; with 3 there is every kind in one of them."""
SEED: Final = int(os.environ.get("PSIU_MESH_SEED", "1"))
"""The same seed draws the same events; what the machine makes of them differs."""

pytestmark = pytest.mark.timeout(120 + 40 * EVENTS)


class Topology(NamedTuple):
    name: str
    mode: Mode
    cables: Sequence[tuple[int, int]]


RING: Final = Topology("ring with a chord, router", "router", [(0, 1), (1, 2), (2, 3), (3, 4), (4, 0), (1, 4)])
LINE: Final = Topology("line, router", "router", [(0, 1), (1, 2), (2, 3), (3, 4)])
FULL: Final = Topology("fully connected, peer", "peer", [(a, b) for a in range(NODES) for b in range(a + 1, NODES)])
TOPOLOGIES: Final = (RING, LINE, FULL)


@pytest.fixture(scope="module", autouse=True)
def _networks_can_be_made() -> None:
    obstacle = network.obstacle()
    if obstacle is not None:
        pytest.skip(f"NO PROOF THAT THE MESH HEALS: {obstacle}")


@pytest.mark.parametrize("topology", TOPOLOGIES, ids=["ring", "line", "full"])
async def test_after_whatever_befalls_it_the_mesh_heals_within_five_seconds(topology: Topology, tmp_path: Path) -> None:
    chance = random.Random(f"{SEED}/{topology.name}")
    healed: list[Healed] = []
    with Network(NODES, topology.cables) as cables:
        async with Lab(cables, topology.mode, tmp_path) as lab:
            watch = Watch(lab)
            try:
                start = await watch.start()
                _tell(topology, 0, start)
                for number, draw in enumerate(events.drawn(EVENTS, TOPOLOGIES.index(topology), SEED), 1):
                    if (healed or [start])[-1].healed_s is None:
                        break
                    healed.append(await watch.go_through(draw(lab, chance)))
                    _tell(topology, number, healed[-1])
                end = await watch.end()
            finally:
                await watch.stop()
    print(figures(topology.name, healed))
    faults = [
        f"{number}, {one.text}: {fault}" for number, one in enumerate([start, *healed, end]) for fault in one.faults
    ]
    report = "\n".join(faults)
    assert not faults, f"{topology.name}, PSIU_MESH_SEED={SEED}, logs in {tmp_path}:\n{report}"


def _tell(topology: Topology, number: int, one: Healed) -> None:
    took = "never healed" if one.healed_s is None else f"healed in {one.healed_s:.2f} s"
    print(f"{topology.name} {number}: {one.text}; {took}; {one.sent.lost} lost", *one.faults, sep="\n  ", flush=True)

"""What several files have simulated brokers do."""

import itertools

from mesh.simulated import RADIO, WIFI, Simulation

from psiu_broker.frame import Address, Way
from psiu_broker.routing.table import Binding

MNERIM = Address.named("MNERIM")
NUMBER = Address.numbered(0x12)


def commanded(mesh: Simulation, at: str = "C") -> bytes:
    """A program says something new to MNERIM."""
    command = mesh.says(f"PC{at}", at, "MNERIM", "parafrente", str(int(mesh.now * 1000) % 10**9), link=WIFI)
    mesh.run(0.1)
    return command


def changes_of_owner(mesh: Simulation, robot: str, at: str, seconds: float, every_s: float = 0.2) -> int:
    owners = []
    until = mesh.now + seconds
    while mesh.now < until:
        mesh.talks(robot, at, every_s, every_s)
        owners.append(mesh.stations[at[0]].owner(robot))
    return sum(one != other for one, other in itertools.pairwise(owners))


def pinned(*names: str, number: Address | None = None) -> dict[str, tuple[Binding, ...]]:
    return {name: (Binding(MNERIM, number, Way(RADIO), "psiu-ascii"),) for name in names}

"""The lives of a broker: Zenoh may tell of a new one before the old one is gone."""

import pytest
from mesh.scenes import MNERIM
from mesh.simulated import RADIO, TICK_S, Simulation, Station

from psiu_broker.mesh.beat import Beat
from psiu_broker.mesh.mesh import FORMER_MAX
from psiu_broker.mesh.neighbour import ALIVE_S
from psiu_broker.routing.claims import Claim


@pytest.fixture
def alone() -> Station:
    return Simulation("Z").stations["Z"]


def life_of_a(station: Station) -> int | None:
    neighbour = station.neighbours.find("A")
    return None if neighbour is None else neighbour.epoch


def beat_of_a(station: Station, epoch: int) -> None:
    station.mesh.beat_came(Beat(broker="A", epoch=epoch, sent_us=0), station.now)


def test_a_broker_that_lives_is_not_displaced_by_an_announcement_alone(alone: Station) -> None:
    alone.mesh.broker_came("A", 5, "old", "0", alone.now)
    alone.mesh.broker_came("A", 6, "new", "0", alone.now)
    assert life_of_a(alone) == 5
    beat_of_a(alone, 6)
    assert life_of_a(alone) == 6


def test_a_broker_that_fell_silent_is_displaced_by_its_next_announcement_and_not_by_an_older_one(
    alone: Station,
) -> None:
    alone.mesh.broker_came("A", 5, "old", "0", alone.now)
    later = alone.now + ALIVE_S + 0.1
    alone.mesh.broker_came("A", 4, "older", "0", later)
    assert life_of_a(alone) == 5
    alone.mesh.broker_came("A", 6, "new", "0", later)
    assert life_of_a(alone) == 6


def test_when_one_life_goes_the_next_is_there_at_once(alone: Station) -> None:
    alone.mesh.broker_came("A", 5, "old", "0", alone.now)
    alone.mesh.broker_came("A", 6, "new", "0", alone.now)
    alone.mesh.broker_went("A", 5, "0", alone.now)
    assert life_of_a(alone) == 6
    alone.mesh.broker_went("A", 6, "0", alone.now)
    assert life_of_a(alone) is None


def test_what_a_former_life_claimed_is_not_the_new_one_s(alone: Station) -> None:
    alone.mesh.broker_came("A", 5, "old", "0", alone.now)
    alone.mesh.claimed("A", 5, Claim(MNERIM, None, "psiu-ascii", RADIO, 1, 10, 0), alone.now)
    alone.mesh.broker_came("A", 6, "new", "0", alone.now)
    assert alone.owner("MNERIM") == "A"
    beat_of_a(alone, 6)
    assert alone.owner("MNERIM") is None
    assert alone.route("MNERIM") is None


def test_memory_of_those_who_went_is_bounded(alone: Station) -> None:
    for epoch in range(FORMER_MAX + 50):
        alone.mesh.broker_came("A", epoch, "id", "0", alone.now)
        alone.mesh.broker_went("A", epoch, "0", alone.now)
    assert len(alone.mesh._former) == FORMER_MAX


def test_who_comes_hears_of_us_at_once(mesh: Simulation) -> None:
    before = mesh.beat
    mesh.run_until(lambda: mesh.beat is not before and mesh.beat is not None and mesh.beat.broker == "B", 1.0)
    newest = mesh.beat
    mesh.loses = lambda *_: True
    station = mesh.stations["B"]
    station.mesh.broker_came("D", 5, "id", "0", station.now)
    began = mesh.now
    mesh.run_until(lambda: mesh.beat is not newest and mesh.beat is not None and mesh.beat.broker == "B", 1.0)
    assert mesh.now - began <= TICK_S + 0.02

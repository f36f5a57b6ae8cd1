"""The brokers that several files begin with."""

import pytest
from mesh.simulated import WIFI, Simulation


@pytest.fixture
def mesh() -> Simulation:
    """Three brokers; PC is a program at C, MNERIM a robot at A."""
    mesh = Simulation("ABC")
    mesh.run(2)
    mesh.says("PC", "C", "C", "oi", link=WIFI)
    mesh.talks("MNERIM", "A", 1)
    assert mesh.owner("MNERIM") == "A"
    return mesh

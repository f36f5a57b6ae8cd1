"""The laboratory itself: a cut is a cut, and nothing is left behind."""

import socket
import subprocess
from collections.abc import Callable, Iterator

import pytest
from system import network
from system.network import Cable, Network

PATIENCE_S = 5.0
CUT_S = 0.3


@pytest.fixture
def pair() -> Iterator[Network]:
    """Two nodes and a cable."""
    obstacle = network.obstacle()
    if obstacle is not None:
        pytest.skip(obstacle)
    with Network(2, [(0, 1)]) as joined:
        yield joined


@pytest.fixture
def ends(pair: Network) -> Iterator[tuple[socket.socket, socket.socket]]:
    """A TCP connection over the cable."""
    near = pair.cables[0].address(0)
    with pair.inside(0, lambda: socket.create_server((near, 7447))) as server:
        far = pair.inside(1, lambda: socket.create_connection((near, 7447), PATIENCE_S))
        accepted, _ = server.accept()
    with far, accepted:
        accepted.settimeout(PATIENCE_S)
        yield accepted, far


CUTS: list[tuple[Callable[[Cable], None], Callable[[Cable], None]]] = [
    (lambda cable: cable.pull(0), lambda cable: cable.plug(0)),
    (lambda cable: cable.pull(1), lambda cable: cable.plug(1)),
    (Cable.lose, Cable.keep),
]


@pytest.mark.parametrize(("cut", "mend"), CUTS, ids=["near", "far", "lost"])
def test_a_cut_cable_carries_nothing_and_a_mended_one_all_that_waited(
    pair: Network,
    ends: tuple[socket.socket, socket.socket],
    cut: Callable[[Cable], None],
    mend: Callable[[Cable], None],
) -> None:
    near, far = ends
    cut(pair.cables[0])
    far.send(b"1")
    near.settimeout(CUT_S)
    with pytest.raises(TimeoutError):
        near.recv(1)
    mend(pair.cables[0])
    near.settimeout(PATIENCE_S)
    assert near.recv(1) == b"1"


def test_a_reset_ends_a_connection_at_both_sides(pair: Network, ends: tuple[socket.socket, socket.socket]) -> None:
    pair.cables[0].reset(1)
    for end in ends:
        with pytest.raises(ConnectionError):
            end.recv(1)


def test_a_network_leaves_nothing_behind_and_removes_what_a_killed_run_left(pair: Network) -> None:
    gone = subprocess.Popen(["true"])
    gone.wait()
    left = f"psiu-lab-{gone.pid}-1-1"
    subprocess.run(["ip", "netns", "add", left], check=True)
    with Network(1, []) as other:
        there = _namespaces()
        assert left not in there
        assert {*pair.namespaces, *other.namespaces} <= there
    assert not set(other.namespaces) & _namespaces()


def _namespaces() -> set[str]:
    listed = subprocess.run(["ip", "netns", "list"], capture_output=True, text=True, check=True)
    return {line.split()[0] for line in listed.stdout.splitlines()}

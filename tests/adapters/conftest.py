"""Far ends that several files meet; and the shared suite's assertions explain themselves like those of a test file."""

from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.register_assert_rewrite("adapter_contract")

# Only what is imported after that is rewritten.
from adapter_contract import Recorder  # noqa: E402
from pty_robot import Pty  # noqa: E402
from udp_robot import Robot  # noqa: E402


@pytest.fixture
async def recorder() -> Recorder:
    return Recorder()


@pytest.fixture
def pty(tmp_path: Path) -> Iterator[Pty]:
    far = Pty(tmp_path / "usb-FTDI_FT232R-if00-port0")
    yield far
    far.unplug()


@pytest.fixture
def robot(request: pytest.FixtureRequest) -> Iterator[Robot]:
    """One that speaks IPv4, or what the test's own parameters say."""
    far = Robot(*getattr(request, "param", ()))
    yield far
    far.socket.close()


@pytest.fixture
def strangers() -> Iterator[list[Robot]]:
    far = [Robot() for _ in range(4)]
    yield far
    for each in far:
        each.socket.close()

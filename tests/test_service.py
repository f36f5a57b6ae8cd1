import asyncio
import os
import socket

import pytest

from psiu_broker.service import Notifier


@pytest.fixture(params=["path", "abstract"])
def manager(request, tmp_path):
    """The service manager's end: a datagram socket and the name it has in NOTIFY_SOCKET."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ours:
        if request.param == "path":
            name = str(tmp_path / "notify")
            ours.bind(name)
        else:
            name = f"@psiu-broker-test-{os.getpid()}"
            ours.bind("\0" + name[1:])
        ours.settimeout(5)
        yield ours, name


def heard(ours: socket.socket) -> list[str]:
    """Every message that has arrived by now."""
    ours.setblocking(False)
    messages = []
    while True:
        try:
            messages.append(ours.recv(4096).decode())
        except BlockingIOError:
            return messages


def test_ready_stopping_and_status_reach_the_service_manager_in_order(manager):
    ours, name = manager
    notifier = Notifier({"NOTIFY_SOCKET": name})
    notifier.ready("2 links")
    notifier.status("radio\nwaits")
    notifier.stopping()
    assert heard(ours) == ["READY=1\nSTATUS=2 links", "STATUS=radio waits", "STOPPING=1"]


def test_without_a_service_manager_nothing_is_said_and_nothing_fails():
    notifier = Notifier({})
    notifier.ready("alone")
    assert notifier.watchdog_s is None


def test_a_service_manager_that_went_away_is_logged_and_does_not_stop_the_broker(tmp_path, caplog):
    Notifier({"NOTIFY_SOCKET": str(tmp_path / "gone")}).stopping()
    assert "cannot be told STOPPING" in caplog.text


async def test_the_watchdog_is_fed_for_as_long_as_progress_is_made(manager):
    ours, name = manager
    notifier = Notifier({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "20000", "WATCHDOG_PID": str(os.getpid())})
    asked = 0
    enough = asyncio.Event()

    async def progress() -> bool:
        nonlocal asked
        asked += 1
        if asked == 4:
            enough.set()
        return asked <= 2

    async with asyncio.timeout(10):
        feeding = asyncio.create_task(notifier.feed(progress))
        await enough.wait()
    feeding.cancel()
    assert heard(ours) == ["WATCHDOG=1"] * 2, "fed although no progress was made, or not fed although it was"


async def test_the_watchdog_is_fed_twice_a_period(manager):
    notifier = Notifier({"NOTIFY_SOCKET": manager[1], "WATCHDOG_USEC": "100000"})
    times: list[float] = []
    enough = asyncio.Event()

    async def progress() -> bool:
        times.append(asyncio.get_running_loop().time())
        if len(times) == 3:
            enough.set()
        return True

    async with asyncio.timeout(10):
        feeding = asyncio.create_task(notifier.feed(progress))
        await enough.wait()
    feeding.cancel()
    assert times[2] - times[0] >= 0.099
    assert notifier.watchdog_s == pytest.approx(0.1)


@pytest.mark.parametrize(
    "environment",
    [
        {},
        {"WATCHDOG_USEC": "0"},
        {"WATCHDOG_USEC": "soon"},
        {"WATCHDOG_USEC": "100000", "WATCHDOG_PID": "1"},
    ],
)
async def test_a_watchdog_that_is_not_asked_of_this_process_is_not_fed(environment):
    async def progress() -> bool:
        raise AssertionError("asked")

    await Notifier(environment).feed(progress)

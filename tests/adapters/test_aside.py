"""Blocking calls that hang hold up nothing: not the event loop's other work, not the end of the process."""

import asyncio
import subprocess
import sys
import threading
from collections.abc import Iterator

import pytest
from adapter_contract import PATIENCE_S

from psiu_adapters.aside import Aside

END_S = 20.0

HANGING_NAME = """
import socket
really = socket.getaddrinfo
def silent(host, port, family=0, type=0, proto=0, flags=0):
    if not flags & socket.AI_NUMERICHOST:
        hang()
    return really(host, port, family, type, proto, flags)
socket.getaddrinfo = silent
from psiu_adapters.udp import Udp as Adapter
options = {"listen": "robo.local:9000"}
"""
HANGING_PORT = """
import serial
serial.serial_for_url = lambda *_, **__: hang()
from psiu_adapters.serial import Serial as Adapter
options = {"device": "/dev/ttyS9"}
"""
CANCEL = """
async def main():
    opening = asyncio.create_task(Adapter(**options).open(None))
    await asyncio.to_thread(hangs.wait)
    opening.cancel()
    await asyncio.wait({opening})
    assert opening.cancelled()
    print("ends", flush=True)
asyncio.run(main())
"""
HANG = """
import asyncio, threading
hangs = threading.Event()
def hang():
    hangs.set()
    threading.Event().wait()
"""


@pytest.fixture
def stuck() -> Iterator[threading.Event]:
    """What a test's blocking work waits for; set at the end."""
    event = threading.Event()
    yield event
    event.set()


@pytest.mark.parametrize("hanging", [HANGING_NAME, HANGING_PORT], ids=["name server", "serial driver"])
def test_the_process_ends_although_an_opening_hangs(hanging: str) -> None:
    script = HANG + hanging + CANCEL
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=END_S, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "ends\n", "")


async def test_work_is_returned_and_its_errors_are_raised() -> None:
    aside = Aside("test")
    assert await aside.run(lambda: 7) == 7
    with pytest.raises(ZeroDivisionError):
        await aside.run(lambda: 1 // 0)
    assert await aside.run(lambda: 8) == 8


async def test_the_next_work_waits_for_the_last_although_that_was_cancelled(stuck: threading.Event) -> None:
    aside = Aside("test")
    began = threading.Event()
    order: list[str] = []

    def first() -> None:
        began.set()
        stuck.wait()
        order.append("first")
        raise ValueError("of no interest any more")

    cancelled = asyncio.create_task(aside.run(first))
    await asyncio.to_thread(began.wait)
    cancelled.cancel()
    await asyncio.wait({cancelled})
    second = asyncio.create_task(aside.run(lambda: order.append("second")))
    await asyncio.sleep(0.01)
    assert order == []
    stuck.set()
    async with asyncio.timeout(PATIENCE_S):
        await second
    assert order == ["first", "second"]


async def test_what_comes_with_a_cancellation_is_handed_over_in_a_thread_too() -> None:
    handed_over = threading.Event()
    threads: list[threading.Thread] = []

    def take(_: int) -> None:
        threads.append(threading.current_thread())
        handed_over.set()

    aside = Aside("test")
    cancelled = asyncio.create_task(aside.run(lambda: 7, take))
    await asyncio.sleep(0)
    work = aside._last
    assert work is not None
    work.result(PATIENCE_S)  # the loop stands still: the work ends before the loop can know
    cancelled.cancel()
    with pytest.raises(asyncio.CancelledError):
        await cancelled
    assert await asyncio.to_thread(handed_over.wait, PATIENCE_S)
    assert threads != [threading.current_thread()]
    async with asyncio.timeout(PATIENCE_S):
        assert await aside.run(lambda: 8) == 8


async def test_a_system_without_threads_for_a_moment_harms_only_that_moment(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    aside = Aside("test")
    with monkeypatch.context() as moment:
        moment.setattr(threading.Thread, "start", refuse)
        with pytest.raises(RuntimeError, match="thread"):
            await aside.run(lambda: 7)
    async with asyncio.timeout(PATIENCE_S):
        assert await aside.run(lambda: 8) == 8


async def test_what_comes_after_a_cancellation_is_handed_over(stuck: threading.Event) -> None:
    began, handed_over = threading.Event(), threading.Event()
    unwanted: list[str] = []

    def work() -> str:
        began.set()
        stuck.wait()
        return "port"

    def take(result: str) -> None:
        unwanted.append(result)
        handed_over.set()

    cancelled = asyncio.create_task(Aside("test").run(work, take))
    await asyncio.to_thread(began.wait)
    cancelled.cancel()
    with pytest.raises(asyncio.CancelledError):
        await cancelled
    assert unwanted == []
    stuck.set()
    assert await asyncio.to_thread(handed_over.wait, PATIENCE_S)
    assert unwanted == ["port"]

import asyncio
import queue
import threading
from typing import Any

import pytest

from psiu_broker.bus import bridge
from psiu_broker.bus.bridge import Bridge


class Ring:
    """A source that a test fills and ends."""

    def __init__(self) -> None:
        self.items: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def __iter__(self) -> "Ring":
        return self

    def __next__(self) -> Any:
        item = self.items.get()
        if isinstance(item, BaseException):
            raise item
        if item is None:
            raise StopIteration
        return item


async def test_what_arrives_is_handled_in_order_on_the_loop() -> None:
    ring, seen, done = Ring(), [], asyncio.Event()

    def handle(number: int) -> None:
        assert threading.current_thread() is threading.main_thread()
        seen.append(number)
        if number == 5000:
            done.set()

    made = Bridge(ring, lambda item: item, handle, name="test", failed=pytest.fail)
    for number in range(1, 5001):
        ring.items.put(number)
    await asyncio.wait_for(done.wait(), 5)
    ring.items.put(None)
    made.join(5)
    assert seen == sorted(seen)


async def test_a_busy_loop_costs_the_oldest_and_not_the_memory() -> None:
    ring, seen = Ring(), []
    made = Bridge(ring, lambda item: item, seen.append, name="test", failed=pytest.fail)
    surplus = 100
    for number in range(bridge.WAITING_MAX + surplus):
        ring.items.put(number)
    ring.items.put(None)
    made.join(5)  # the loop does nothing meanwhile
    while len(seen) < bridge.WAITING_MAX:
        before = len(seen)
        await asyncio.sleep(0)
        assert len(seen) - before <= bridge.TURN_MAX
    assert seen == list(range(surplus, bridge.WAITING_MAX + surplus))


async def test_the_loop_goes_on_between_items_that_are_much_work() -> None:
    ring, seen = Ring(), []
    made = Bridge(ring, lambda item: item, seen.append, name="test", failed=pytest.fail, turn_max=2)
    for number in (*range(6), None):
        ring.items.put(number)
    made.join(5)
    turns = []
    while len(seen) < 6:
        await asyncio.sleep(0)
        turns.append(len(seen))
    assert turns == [2, 4, 6]


async def test_one_item_that_cannot_be_handled_does_not_stop_the_next(caplog: pytest.LogCaptureFixture) -> None:
    ring, done = Ring(), asyncio.Event()

    def sift(item: str) -> str:
        if item == "sift":
            raise RuntimeError
        return item

    def handle(item: str) -> None:
        if item == "handle":
            raise RuntimeError
        done.set()

    made = Bridge(ring, sift, handle, name="test", failed=pytest.fail)
    for item in ("sift", "handle", "good", None):
        ring.items.put(item)
    await asyncio.wait_for(done.wait(), 5)
    made.join(5)
    assert len(caplog.records) == 2


async def test_a_broken_source_is_told() -> None:
    ring, failed = Ring(), []
    made = Bridge(ring, lambda item: item, lambda item: None, name="test", failed=failed.append)
    ring.items.put(OSError("gone"))
    made.join(5)
    assert [str(error) for error in failed] == ["gone"]


async def test_nothing_holds_an_item_that_was_sifted_out() -> None:
    class Query:
        def __init__(self, gone: threading.Event) -> None:
            self.gone = gone

        def __del__(self) -> None:
            self.gone.set()

    ring, gone = Ring(), threading.Event()
    made = Bridge(ring, lambda item: None, lambda item: None, name="test", failed=pytest.fail)
    ring.items.put(Query(gone))
    assert gone.wait(5)
    ring.items.put(None)
    made.join(5)

"""What every adapter promises, as tests that each adapter's own test file runs by subclassing `AdapterContract`."""

import asyncio
import gc
import os
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar

import pytest
from pydantic import ValidationError

from psiu_broker.adapter import Adapter, Peer, Transport
from psiu_broker.errors import LinkError, LinkLost

PATIENCE_S = 5.0
FRAME = b"????" * 10 + b"\x00\xff\r\n\x11\x13\x03\x04"


class Recorder:
    """A receiver that remembers all it was told."""

    def __init__(self) -> None:
        self.heard: list[tuple[bytes, Peer]] = []
        self.losses: list[LinkError] = []
        self.gone: list[Peer] = []
        self.rooms = 0
        self._told = asyncio.Event()

    def received(self, data: bytes, peer: Peer, /) -> None:
        self.heard.append((data, peer))
        self._told.set()

    def writable(self) -> None:
        self.rooms += 1
        self._told.set()

    def peer_lost(self, peer: Peer, /) -> None:
        self.gone.append(peer)
        self._told.set()

    def lost(self, error: LinkError, /) -> None:
        self.losses.append(error)
        self._told.set()

    @property
    def data(self) -> bytes:
        return b"".join(data for data, _ in self.heard)

    async def until(self, true: Callable[[], object], timeout_s: float = PATIENCE_S) -> None:
        """Wait for the telling that makes `true` so."""
        async with asyncio.timeout(timeout_s):
            while not true():
                self._told.clear()
                await self._told.wait()


class FarEnd(ABC):
    """The other side of a link, as real as the machine allows, and the adapter that reaches it."""

    adapter: Adapter
    peer: Peer = None

    def meet(self, transport: Transport) -> None:  # noqa: B027
        """The adapter was opened; for far ends that must learn something from `transport`."""

    @abstractmethod
    async def say(self, data: bytes) -> None:
        """Send `data`, as one datagram where there are datagrams."""

    @abstractmethod
    async def heard(self, size: int) -> bytes:
        """The next `size` bytes that arrived here."""

    async def vanish(self) -> None:
        """Go away as a robot does: without a word."""
        raise NotImplementedError


class AdapterContract:
    """Subclasses give the fixtures `far` (an open `FarEnd`) and `absent` (an adapter whose `open` fails)."""

    losable: ClassVar[bool] = True
    """False where the transport cannot notice that its far end went."""

    refuses: ClassVar[bool] = True
    """False where a far end that does not read never makes the transport refuse."""

    @pytest.fixture
    async def recorder(self) -> Recorder:
        return Recorder()

    async def open(self, far: FarEnd, recorder: Recorder) -> Transport:
        transport = await far.adapter.open(recorder)
        far.meet(transport)
        return transport

    async def test_what_the_far_end_says_is_received_unchanged(self, far: FarEnd, recorder: Recorder) -> None:
        transport = await self.open(far, recorder)
        await far.say(bytes(range(256)))
        await recorder.until(lambda: len(recorder.data) >= 256)
        assert recorder.data == bytes(range(256))
        await transport.close()

    async def test_everything_comes_from_one_and_the_same_peer_object(self, far: FarEnd, recorder: Recorder) -> None:
        transport = await self.open(far, recorder)
        await far.say(b"one")
        await recorder.until(lambda: recorder.data == b"one")
        await far.say(b"two")
        await recorder.until(lambda: recorder.data == b"onetwo")
        peers = [peer for _, peer in recorder.heard]
        assert peers[0] == far.peer
        assert all(peer is peers[0] for peer in peers)
        assert far.peer in transport.peers
        await transport.close()

    async def test_what_is_written_reaches_the_far_end_unchanged(self, far: FarEnd, recorder: Recorder) -> None:
        transport = await self.open(far, recorder)
        assert transport.write(bytes(range(256)), far.peer) is True
        assert await far.heard(256) == bytes(range(256))
        await transport.close()

    async def test_a_frame_to_a_peer_that_is_not_there_is_dropped(self, far: FarEnd, recorder: Recorder) -> None:
        transport = await self.open(far, recorder)
        assert transport.write(b"nobody", ("nobody", -1)) is True
        assert transport.write(b"known", far.peer) is True
        assert await far.heard(5) == b"known"
        await transport.close()

    async def test_frames_leave_whole_and_in_order_however_slow_the_far_end(
        self, far: FarEnd, recorder: Recorder
    ) -> None:
        transport = await self.open(far, recorder)
        frames = [b"%06d" % number + FRAME for number in range(300)]
        reading = asyncio.create_task(far.heard(sum(map(len, frames))))
        for frame in frames:
            while True:
                rooms = recorder.rooms
                if transport.write(frame, far.peer):
                    break
                await recorder.until(lambda rooms=rooms: recorder.rooms > rooms)  # type: ignore[misc]
            await asyncio.sleep(0)
        async with asyncio.timeout(PATIENCE_S):
            assert await reading == b"".join(frames)
        await transport.close()

    async def test_a_far_end_that_does_not_read_is_refused_until_it_does(self, far: FarEnd, recorder: Recorder) -> None:
        if not self.refuses:
            pytest.skip("this kind of link has no far end to wait for")
        transport = await self.open(far, recorder)
        taken = b""
        for number in range(100_000):
            frame = b"%06d" % number + FRAME
            if not transport.write(frame, far.peer):
                break
            taken += frame
        else:
            pytest.fail("never refused")
        rooms = recorder.rooms
        assert await far.heard(len(taken)) == taken
        await recorder.until(lambda: recorder.rooms > rooms)
        assert transport.write(b"room", far.peer) is True
        assert await far.heard(4) == b"room"
        await transport.close()

    async def test_a_far_end_that_vanishes_is_said_once(self, far: FarEnd, recorder: Recorder) -> None:
        if not self.losable:
            pytest.skip("this kind of link does not notice")
        transport = await self.open(far, recorder)
        await far.say(b"half a fra")
        await recorder.until(lambda: recorder.data == b"half a fra")
        await far.vanish()
        await recorder.until(lambda: recorder.losses)
        for _ in range(3):
            assert transport.write(b"too late", far.peer) is True
            await asyncio.sleep(0)
        await transport.close()
        assert len(recorder.losses) == 1
        assert isinstance(recorder.losses[0], LinkLost)
        assert "\n" not in str(recorder.losses[0])

    async def test_writing_to_a_far_end_that_just_vanished_does_not_raise(
        self, far: FarEnd, recorder: Recorder
    ) -> None:
        if not self.losable:
            pytest.skip("this kind of link does not notice")
        transport = await self.open(far, recorder)
        await far.vanish()
        transport.write(b"into the dark", far.peer)
        assert recorder.losses == [], "said from inside write"
        await recorder.until(lambda: recorder.losses)
        await transport.close()
        assert len(recorder.losses) == 1

    async def test_closing_is_harmless_twice_and_ends_all_talk(self, far: FarEnd, recorder: Recorder) -> None:
        transport = await self.open(far, recorder)
        await transport.close()
        await transport.close()
        assert transport.write(b"after the end", far.peer) is True
        transport.status()
        await asyncio.sleep(0)
        assert (recorder.heard, recorder.losses, recorder.gone, recorder.rooms) == ([], [], [], 0)

    async def test_closing_after_a_write_lets_the_frame_leave(self, far: FarEnd, recorder: Recorder) -> None:
        transport = await self.open(far, recorder)
        reading = asyncio.create_task(far.heard(len(FRAME)))
        await asyncio.sleep(0)
        assert transport.write(FRAME, far.peer) is True
        await transport.close()
        assert await reading == FRAME

    async def test_opening_and_closing_leaves_no_descriptor_and_can_be_done_again(
        self, far: FarEnd, recorder: Recorder
    ) -> None:
        before = open_descriptors()
        for _ in range(3):
            transport = await self.open(far, recorder)
            await transport.close()
            assert open_descriptors() == before
        assert recorder.losses == []

    async def test_an_opening_that_is_cancelled_leaves_no_descriptor(self, far: FarEnd, recorder: Recorder) -> None:
        before = held()
        for turns in range(6):
            opening = asyncio.create_task(far.adapter.open(recorder))
            for _ in range(turns):
                await asyncio.sleep(0)
            if not opening.done():
                opening.cancel()
            result = (await asyncio.gather(opening, return_exceptions=True))[0]
            if isinstance(result, Transport):
                await result.close()
            await no_more_than(before)

    async def test_waiting_for_a_change_leaves_nothing_when_it_is_cancelled(self, far: FarEnd) -> None:
        await self._wait_a_little(far)
        gc.collect()
        before = open_descriptors()
        await self._wait_a_little(far)
        gc.collect()
        assert open_descriptors() == before

    async def _wait_a_little(self, far: FarEnd) -> None:
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.05):
                await far.adapter.changed()

    async def test_an_absent_far_end_is_a_link_error_in_one_line(self, absent: Adapter, recorder: Recorder) -> None:
        before = held()
        with pytest.raises(LinkError) as raised:
            await absent.open(recorder)
        assert str(raised.value)
        assert "\n" not in str(raised.value)
        await no_more_than(before)

    async def test_the_options_are_frozen_and_unknown_ones_refused(self, far: FarEnd) -> None:
        options = far.adapter.model_dump()
        assert type(far.adapter)(**options) == far.adapter
        with pytest.raises(ValidationError):
            type(far.adapter)(**options, unknown_option=1)
        with pytest.raises(ValidationError):
            setattr(far.adapter, next(iter(options)), None)
        for name, field in type(far.adapter).model_fields.items():
            assert field.description, f"{name} has no description"


def open_descriptors() -> set[str]:
    """The numbers of this process's open descriptors."""
    return {name for name in os.listdir("/proc/self/fd") if os.path.exists(f"/proc/self/fd/{name}")}  # noqa: PTH110, PTH208


def held() -> set[str]:
    """What this process holds: open descriptors, and threads that may still open or close what was abandoned."""
    return open_descriptors() | {f"thread {thread.ident}" for thread in threading.enumerate() if thread.daemon}


async def no_more_than(expected: set[str]) -> None:
    """Wait until nothing is `held` beyond `expected`."""
    async with asyncio.timeout(PATIENCE_S):
        while not held() <= expected:  # noqa: ASYNC110 - the thread tells nobody
            await asyncio.sleep(0.01)

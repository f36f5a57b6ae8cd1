"""A trunk whose far end is the test, between it and a Zenoh that is Unix sockets."""

import asyncio
import itertools
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path

import pytest
from memory_adapter import MemoryAdapter

from psiu_broker import kept
from psiu_broker.config import TrunkConfiguration
from psiu_broker.errors import LinkLost
from psiu_broker.trunk import Trunk, channel, local, trunk
from psiu_broker.trunk.local import Meeting
from psiu_broker.trunk.wire import END, Greeting, Reader, chunk

OWN = Greeting("base", "1f", many=False)
HILL = Greeting("hill", "2e", many=False)
ALPHA = Greeting("alpha", "3d", many=False)
"""Its name is before ours, so that its Zenoh connects to ours."""


class Callers(MemoryAdapter):
    """Takes callers, of whom there are none at first."""

    ends: tuple[None, ...] = ()

    @property
    def many_peers(self) -> bool:
        return True


class Zenoh:
    """The Unix sockets of a session: it listens, and connects where told."""

    def __init__(self, folder: Path) -> None:
        self.meeting = Meeting(folder / "door", folder / "session")
        self.came: asyncio.Queue[tuple[asyncio.StreamReader, asyncio.StreamWriter]] = asyncio.Queue()
        self._server: asyncio.Server | None = None
        self._writers: list[asyncio.StreamWriter] = []

    async def listen(self) -> None:
        self._server = await asyncio.start_unix_server(self._accepted, self.meeting.session)

    async def connected(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        """A connection to the trunk's door."""
        ends = await asyncio.open_unix_connection(self.meeting.door)
        self._writers.append(ends[1])
        return ends

    async def leave(self) -> None:
        """Listen no more."""
        if self._server is not None:
            self._server.close()
            self.meeting.session.unlink(missing_ok=True)

    async def close(self) -> None:
        await self.leave()
        for writer in self._writers:
            writer.close()

    def _accepted(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writers.append(writer)
        self.came.put_nowait((reader, writer))


class Lab:
    def __init__(self, zenoh: Zenoh, adapter: MemoryAdapter) -> None:
        self.zenoh = zenoh
        self.adapter = adapter
        self.trunk = Trunk(TrunkConfiguration("far", "memory", adapter), OWN.broker, OWN.epoch, zenoh.meeting)

    def say(self, *data: bytes, peer: object = None) -> None:
        """As the far end."""
        for each in data:
            self.trunk.received(each, peer)

    def told(self, peer: object = None) -> bytes:
        """What the far end has heard since the stream opened, without our greeting."""
        data = b"".join(data for data, to in self.adapter.transport.written if to == peer)
        line, newline, rest = data.partition(b"\n")
        assert line + newline in (b"", OWN.line, OWN._replace(many=True).line)
        return rest

    async def until(self, true: Callable[[], object]) -> None:
        async with asyncio.timeout(5):
            while not true():  # noqa: ASYNC110
                await asyncio.sleep(0.001)

    async def reopened(self, openings: int) -> None:
        await self.until(lambda: self.adapter.openings == openings)


@pytest.fixture(autouse=True)
def short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept, "FIRST_PAUSE_S", 0.004)
    monkeypatch.setattr(trunk, "FIRST_PAUSE_S", 0.004)
    monkeypatch.setattr(kept, "SHORTEST_PAUSE_S", 0.002)


@pytest.fixture
async def zenoh(tmp_path: Path) -> AsyncIterator[Zenoh]:
    zenoh = Zenoh(tmp_path)
    await zenoh.listen()
    yield zenoh
    await zenoh.close()


@asynccontextmanager
async def running(zenoh: Zenoh, adapter: MemoryAdapter) -> AsyncIterator[Lab]:
    lab = Lab(zenoh, adapter)
    task = asyncio.create_task(lab.trunk.run())
    try:
        await lab.reopened(1)
        yield lab
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task
        assert not zenoh.meeting.door.exists()
        assert lab.trunk.state == "closed"


@pytest.fixture
async def lab(zenoh: Zenoh) -> AsyncIterator[Lab]:
    async with running(zenoh, MemoryAdapter()) as lab:
        yield lab


async def test_the_session_may_connect_only_when_the_far_end_has_said_who_it_is(lab: Lab) -> None:
    assert (lab.trunk.state, lab.trunk.far) == ("opening", [])
    assert "waiting for the far end to say who it is" in str(lab.trunk.reason)
    assert lab.adapter.transport.wires == [OWN.line]
    with pytest.raises(FileNotFoundError):
        await lab.zenoh.connected()
    lab.say(HILL.line)
    assert (lab.trunk.state, lab.trunk.reason, lab.trunk.far) == ("open", None, ["hill"])
    reader, writer = await lab.zenoh.connected()
    writer.write(b"init")
    await lab.until(lambda: lab.told() == chunk(b"init"))
    lab.say(chunk(b"ack"))
    assert await reader.readexactly(3) == b"ack"
    assert (lab.trunk.bytes_out, lab.trunk.bytes_in) == (len(OWN.line) + 6, len(HILL.line) + 5)


async def test_the_end_with_the_greater_name_passes_all_to_the_listening_session(lab: Lab) -> None:
    lab.say(ALPHA.line + chunk(b"init")[:3])
    assert not lab.zenoh.meeting.door.exists()
    reader, writer = await lab.zenoh.came.get()
    lab.say(chunk(b"init")[3:])
    assert await reader.readexactly(4) == b"init"
    writer.write(b"ack")
    await lab.until(lambda: lab.told() == chunk(b"ack"))


async def test_an_ended_connection_is_ended_at_the_other_end_and_the_next_needs_no_new_stream(lab: Lab) -> None:
    lab.say(HILL.line)
    told = b""
    for number in (1, 2):
        _, writer = await lab.zenoh.connected()
        writer.write(b"%d" % number)
        told += chunk(b"%d" % number)
        await lab.until(lambda told=told: lab.told() == told)  # type: ignore[misc]
        writer.close()
        told += END
        await lab.until(lambda told=told: lab.told() == told)  # type: ignore[misc]
        lab.say(END)
    reader, writer = await lab.zenoh.connected()
    writer.write(b"3")
    await lab.until(lambda: lab.told() == told + chunk(b"3"))
    lab.say(END)
    assert await reader.read() == b""
    assert lab.told() == told + chunk(b"3") + END
    assert lab.adapter.openings == 1


async def test_what_is_under_way_from_one_connection_never_reaches_the_next(lab: Lab) -> None:
    lab.say(HILL.line)
    _, first = await lab.zenoh.connected()
    first.write(b"1")
    await lab.until(lab.told)
    first.close()
    await lab.until(lambda: lab.told().endswith(END))
    reader, second = await lab.zenoh.connected()
    second.write(b"2")
    lab.say(chunk(b"for the first"))
    lab.say(END)
    await lab.until(lambda: lab.told() == chunk(b"1") + END + chunk(b"2"))
    lab.say(chunk(b"for the second"))
    assert await reader.readexactly(14) == b"for the second"


async def test_a_connection_that_says_nothing_leaves_no_trace(lab: Lab) -> None:
    lab.say(HILL.line)
    for _ in range(2):
        _, writer = await lab.zenoh.connected()
        writer.close()
    _, writer = await lab.zenoh.connected()
    writer.write(b"x")
    await lab.until(lambda: lab.told() == chunk(b"x"))


async def test_a_session_that_does_not_listen_now_ends_the_connection_and_no_more(zenoh: Zenoh, lab: Lab) -> None:
    await zenoh.leave()
    lab.say(ALPHA.line, chunk(b"init"), chunk(b"more"))
    assert lab.told() == END
    await zenoh.listen()
    lab.say(END, chunk(b"again"))
    reader, _ = await zenoh.came.get()
    assert await reader.readexactly(5) == b"again"
    assert lab.adapter.openings == 1


async def test_while_the_stream_takes_no_more_nothing_is_taken_from_zenoh(lab: Lab) -> None:
    lab.say(HILL.line)
    _, writer = await lab.zenoh.connected()
    lab.adapter.transport.full = True
    sent = bytes(itertools.islice(itertools.cycle(range(251)), 2_000_000))
    writer.write(sent)
    for _ in range(50):
        await asyncio.sleep(0)
    assert writer.transport.get_write_buffer_size() > len(sent) - 500_000, "it waits in Zenoh, not in the trunk"
    lab.adapter.transport.full = False
    lab.trunk.writable()
    await writer.drain()
    reader = Reader()
    reader.feed(HILL.line)
    await lab.until(lambda: len(lab.told()) >= len(sent))
    await lab.until(lambda: lab.trunk.bytes_out > len(sent) + 2 * (len(sent) // 8192))
    assert b"".join(each for each in reader.feed(lab.told()) if isinstance(each, bytes)) == sent


async def test_a_session_that_does_not_read_loses_its_connection_and_is_counted(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(local, "BACKLOG_MAX", 10_000)
    lab.say(ALPHA.line, chunk(b"init"))
    reader, _ = await lab.zenoh.came.get()
    reader._transport.pause_reading()  # type: ignore[attr-defined]
    for _ in range(1000):
        lab.say(chunk(b"x" * 4096))
    assert lab.trunk.overruns == 1
    assert lab.told() == END
    assert lab.trunk.state == "open"


async def test_a_cut_stream_hangs_up_on_zenoh_at_once(lab: Lab) -> None:
    lab.say(HILL.line)
    reader, writer = await lab.zenoh.connected()
    writer.write(b"init")
    await lab.until(lab.told)
    lab.say(chunk(b"only a part")[:5])
    lab.trunk.lost(LinkLost("out of reach"))
    assert (lab.trunk.state, lab.trunk.reason, lab.trunk.far) == ("waiting", "out of reach", [])
    assert not lab.zenoh.meeting.door.exists()
    assert await reader.read() == b"onl"
    await lab.reopened(2)
    lab.say(HILL.line)
    reader, writer = await lab.zenoh.connected()
    writer.write(b"init")
    await lab.until(lambda: lab.told() == chunk(b"init"))
    lab.say(chunk(b"ack"))
    assert await reader.readexactly(3) == b"ack"


async def test_another_session_is_served_at_its_own_place_without_a_new_stream(lab: Lab, tmp_path: Path) -> None:
    lab.say(HILL.line)
    reader, writer = await lab.zenoh.connected()
    writer.write(b"1")
    await lab.until(lab.told)
    (folder := tmp_path / "next").mkdir()
    lab.zenoh.meeting = Meeting(folder / "door", folder / "session")
    lab.trunk.move(lab.zenoh.meeting)
    assert await reader.read() == b""
    lab.say(END)
    _, writer = await lab.zenoh.connected()
    writer.write(b"2")
    await lab.until(lambda: lab.told() == chunk(b"1") + END + chunk(b"2"))
    assert not (tmp_path / "door").exists()


@pytest.mark.parametrize(
    ("said", "reason"),
    [
        (b"MNERIM 034 parafrente", 'the far end is no psiu-broker with a trunk: it says "MNERIM 034 parafrente"'),
        (OWN.line, "the stream leads back to this broker itself"),
        (OWN._replace(epoch="99").line, "the broker at the far end is called base too; rename one of them"),
        (HILL.line + chunk(b"x"), "the far end speaks out of turn"),
        (HILL.line + END, "the far end ends what has not begun"),
        (ALPHA.line + ALPHA.line, "the far end has begun anew in the middle of the stream"),
    ],
)
async def test_who_cannot_be_understood_is_told_and_tried_again(lab: Lab, said: bytes, reason: str) -> None:
    lab.say(said, b"and what it says then is not heard")
    assert (lab.trunk.state, lab.trunk.reason, lab.trunk.far) == ("waiting", reason, [])
    lab.say(HILL.line)
    assert lab.trunk.state == "waiting", "not before another stream is open"
    await lab.reopened(2)
    lab.say(HILL.line)
    assert (lab.trunk.state, lab.trunk.reason) == ("open", None)


async def test_who_says_nothing_is_tried_again_soon_however_often(
    zenoh: Zenoh, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(channel, "GREETING_S", 0.001)
    async with running(zenoh, MemoryAdapter()) as lab:
        await lab.reopened(20)
        assert lab.trunk.reason == "the far end says nothing; is there a psiu-broker with a trunk?"


async def test_who_does_not_end_what_we_ended_gets_a_new_stream(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(channel, "ANSWER_S", 0.001)
    lab.say(HILL.line)
    _, writer = await lab.zenoh.connected()
    writer.write(b"x")
    await lab.until(lab.told)
    writer.close()
    await lab.until(lambda: lab.trunk.reason == "the far end does not answer")
    await lab.reopened(2)


async def test_everyone_who_calls_is_joined_and_none_disturbs_another(zenoh: Zenoh) -> None:
    async with running(zenoh, Callers()) as lab:
        assert (lab.trunk.state, lab.trunk.reason) == ("waiting", "waiting for a broker to call")
        lab.say(HILL.line, chunk(b"hill"), peer="1")
        lab.say(ALPHA.line, chunk(b"alpha"), peer="2")
        lab.say(b"MNERIM 034 parafrente", peer="3")
        assert (lab.trunk.state, lab.trunk.far) == ("open", ["alpha", "hill"])
        ends = [await zenoh.came.get() for _ in range(2)]
        assert sorted([await reader.read(4) for reader, _ in ends]) == [b"alph", b"hill"]
        for _, writer in ends:
            writer.write(b"to all")
        await lab.until(lambda: lab.told("1") == lab.told("2") == chunk(b"to all"))
        lab.trunk.peer_lost("2")
        assert lab.trunk.far == ["hill"]
        lab.say(chunk(b"!"), peer="1")
        lab.trunk.peer_lost("1")
        assert (lab.trunk.state, lab.trunk.far) == ("waiting", [])
        assert lab.trunk.reason == "hill has gone; waiting for a broker to call"
        lab.say(HILL.line, peer="1")
        assert lab.trunk.far == ["hill"]
        assert lab.adapter.openings == 1


async def test_a_caller_that_is_none_of_ours_is_named(zenoh: Zenoh) -> None:
    async with running(zenoh, Callers()) as lab:
        lab.say(b"?? 027 qualseunome PC 01753", peer="98:D3:31:00:00:01")
        assert (lab.trunk.state, lab.trunk.far) == ("waiting", [])
        assert str(lab.trunk.reason).startswith("98:D3:31:00:00:01: the far end is no psiu-broker with a trunk")


async def test_without_a_socket_the_reason_is_told(zenoh: Zenoh) -> None:
    zenoh.meeting.door.touch()
    async with running(zenoh, MemoryAdapter()) as lab:
        lab.say(HILL.line)
        assert lab.trunk.state == "waiting"
        assert "address already in use" in str(lab.trunk.reason).lower()
        zenoh.meeting.door.unlink()

"""UDP peers that are known by name, which a name server must tell."""

import asyncio
import errno
import os
import socket
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from adapter_contract import PATIENCE_S, Recorder
from udp_robot import Robot, open_for

from psiu_adapters import udp
from psiu_adapters.udp import Udp
from psiu_broker.errors import LinkAbsent

LINKS = 40
"""More than an event loop's executor has threads."""


class NameServer:
    """Tells the addresses in `known`, once it `answers`."""

    def __init__(self) -> None:
        self.known: dict[str, list[str]] = {}
        self.answers = threading.Event()
        self.answers.set()
        self.asked = 0
        self._really = socket.getaddrinfo

    def getaddrinfo(
        self, host: str, port: int, family: int = 0, type: int = 0, proto: int = 0, flags: int = 0
    ) -> list[Any]:
        if flags & socket.AI_NUMERICHOST:
            return self._really(host, port, family, type, proto, flags)
        self.asked += 1
        self.answers.wait()
        if host not in self.known:
            raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")
        return [(socket.AF_INET, socket.SOCK_DGRAM, 17, "", (address, port)) for address in self.known[host]]


@pytest.fixture
def names(monkeypatch: pytest.MonkeyPatch) -> Iterator[NameServer]:
    server = NameServer()
    monkeypatch.setattr(socket, "getaddrinfo", server.getaddrinfo)
    monkeypatch.setattr(udp, "RESOLVE_FIRST_S", 0.02)
    monkeypatch.setattr(udp, "RESOLVE_LAST_S", 0.02)
    yield server
    server.answers.set()


async def becomes(true: Callable[[], bool]) -> None:
    """Wait for what nobody tells."""
    async with asyncio.timeout(PATIENCE_S):
        while not true():  # noqa: ASYNC110 — nor does it happen in this thread alone
            await asyncio.sleep(0.01)


async def test_a_peer_by_name_is_found(robot: Robot, recorder: Recorder) -> None:
    transport = await open_for(recorder, [robot], peers=(f"localhost:{robot.peer[1]}",))
    assert list(transport.peers) == [robot.peer]
    await transport.close()


async def test_a_listen_name_without_an_address_is_waited_for(names: NameServer, recorder: Recorder) -> None:
    with pytest.raises(LinkAbsent, match=r"nowhere\.lan:9000: cannot find the address of nowhere\.lan"):
        await Udp(listen="nowhere.lan:9000").open(recorder)


async def test_a_name_without_an_address_is_asked_for_again_while_the_others_work(
    names: NameServer, recorder: Recorder
) -> None:
    transport = await open_for(recorder, [], peers=("robo.lan:9", "127.0.0.1:8"))
    assert list(transport.peers) == [("127.0.0.1", 8)]
    assert transport.status()["unresolved"] == "robo.lan:9"
    names.known["robo.lan"] = ["127.0.0.1"]
    await becomes(lambda: len(transport.peers) == 2)
    assert "unresolved" not in transport.status()
    await transport.close()


async def test_a_robot_whose_name_moves_is_followed_and_its_old_address_is_a_lost_peer(
    names: NameServer, recorder: Recorder
) -> None:
    names.known["robo.lan"] = ["127.0.0.1"]
    transport = await open_for(recorder, [], peers=("robo.lan:9", "127.0.0.1:8"))
    assert set(transport.peers) == {("127.0.0.1", 9), ("127.0.0.1", 8)}
    names.known["robo.lan"] = ["127.0.0.2"]
    await recorder.until(lambda: recorder.gone)
    assert recorder.gone == [("127.0.0.1", 9)]
    assert set(transport.peers) == {("127.0.0.2", 9), ("127.0.0.1", 8)}
    await transport.close()


async def test_a_name_keeps_the_address_in_use_while_it_is_among_those_told_or_none_is(
    names: NameServer, recorder: Recorder
) -> None:
    names.known["robo.lan"] = ["127.0.0.1"]
    transport = await open_for(recorder, [], peers=("robo.lan:9",))
    for told in (["127.0.0.2", "127.0.0.1"], []):
        names.known["robo.lan"] = told
        if not told:
            del names.known["robo.lan"]
        asked = names.asked
        await becomes(lambda asked=asked: names.asked > asked + 2)  # type: ignore[misc]
        assert list(transport.peers) == [("127.0.0.1", 9)]
    assert recorder.gone == []
    await transport.close()


async def test_an_address_that_another_peer_has_too_stays(names: NameServer, recorder: Recorder) -> None:
    names.known["robo.lan"] = ["127.0.0.1"]
    transport = await open_for(recorder, [], peers=("robo.lan:9", "127.0.0.1:9"))
    names.known["robo.lan"] = ["127.0.0.2"]
    await becomes(lambda: len(transport.peers) == 2)
    assert recorder.gone == []
    await transport.close()


async def test_a_silent_name_server_takes_no_worker_of_the_event_loop(names: NameServer, recorder: Recorder) -> None:
    names.answers.clear()
    transports = [await open_for(recorder, [], peers=("robo.lan:9",)) for _ in range(LINKS)]
    async with asyncio.timeout(PATIENCE_S):
        assert await asyncio.to_thread(lambda: "other work") == "other work"
    for transport in transports:
        await transport.close()


async def test_a_link_waits_for_one_name_at_a_time_however_often_it_is_opened(
    names: NameServer, recorder: Recorder
) -> None:
    names.answers.clear()
    adapter = Udp(listen="127.0.0.1:0", peers=("robo.lan:9", "wall.lan:9"))
    for _ in range(3):
        await (await adapter.open(recorder)).close()
    assert names.asked == 1


async def test_closing_while_a_name_is_looked_for_ends_the_search(names: NameServer, recorder: Recorder) -> None:
    names.answers.clear()
    tasks = asyncio.all_tasks()
    transport = await open_for(recorder, [], peers=("robo.lan:9",))
    assert asyncio.all_tasks() != tasks
    await transport.close()
    assert asyncio.all_tasks() == tasks


async def test_a_loss_while_a_name_is_looked_for_ends_the_search(names: NameServer, recorder: Recorder) -> None:
    tasks = asyncio.all_tasks()
    transport = await open_for(recorder, [], peers=("robo.lan:9",))
    transport._lose(OSError(errno.EIO, os.strerror(errno.EIO)))  # type: ignore[attr-defined]
    assert recorder.losses
    await transport.close()
    assert asyncio.all_tasks() == tasks

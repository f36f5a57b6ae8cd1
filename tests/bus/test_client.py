import asyncio
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator
from typing import Any

import pytest
import zenoh
from quiet import Quiet

from psiu_broker.bus.calls import Calls
from psiu_broker.bus.client import OPEN_TIMEOUT_S, Client
from psiu_broker.bus.keys import KEY_LENGTH_MAX, Keys
from psiu_broker.bus.queries import Queries
from psiu_broker.bus.session import Session
from psiu_broker.errors import BusError, CallError
from psiu_broker.frame import Address
from psiu_broker.messages import Answer, CallRequest, Card

Until = Callable[[Callable[[], object]], Awaitable[None]]


def card(robot: str) -> Card:
    return Card(robot=robot, protocol="psiu-ascii", broker="base", link="radio", link_state="open")


class Source(Quiet):
    """Two robots are here."""

    def robots(self) -> Iterable[Address]:
        return [Address.named(name) for name in ("PC", "MNERIM")]

    def card(self, robot: Address) -> Card:
        return card(str(robot))


@pytest.fixture
async def sent() -> list[tuple[Address, str, CallRequest]]:
    return []


@pytest.fixture
async def broker(session: Session, keys: Keys, sent: list[Any]) -> AsyncIterator[Session]:
    async def call(robot: Address, command: str, request: CallRequest) -> Answer:
        if command == "absent":
            raise CallError("unknown_robot", "no robot A is known")
        if command == "slow":
            await asyncio.sleep(30)
        return Answer(status="sucesso", values=[str(robot), *request.parameters], elapsed_ms=1)

    async def send(robot: Address, command: str, request: CallRequest) -> None:
        sent.append((robot, command, request))

    await Queries.open(session, keys, "base", Source())
    calls = await Calls.open(session, keys, call, send)
    yield session
    await calls.close()


@pytest.fixture
def client(broker: Session, endpoint: str) -> Iterator[Client]:
    with Client([endpoint]) as client:
        yield client


@pytest.mark.parametrize("mute", [False, True], ids=["refused", "mute"])
def test_a_missing_broker_is_one_clear_line_within_three_seconds(
    endpoint: str, mute: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert OPEN_TIMEOUT_S <= 2.5, "the rest is for the machine"
    monkeypatch.setattr("psiu_broker.bus.client.OPEN_TIMEOUT_S", 0.5)
    with socket.socket() as other:
        if mute:
            other.bind(("127.0.0.1", int(endpoint.rpartition(":")[2])))
            other.listen()
        begun = time.monotonic()
        with pytest.raises(BusError) as raised:
            Client([endpoint])
    assert str(raised.value) == f"no broker answers at {endpoint}; is psiu-broker running?"
    assert time.monotonic() - begun < 3


def test_a_misspelt_endpoint_is_one_line() -> None:
    with pytest.raises(BusError) as raised:
        Client(["nonsense"])
    assert ".rs:" not in str(raised.value)


async def test_a_broker_that_comes_a_little_later_is_waited_for(endpoint: str) -> None:
    opening = asyncio.create_task(asyncio.to_thread(Client, [endpoint]))
    await asyncio.sleep(0.3)
    late = await Session.open([endpoint])
    client = await opening
    client.close()
    client.close()
    await late.close()


async def test_cards_and_brokers_come_as_models(client: Client) -> None:
    assert await asyncio.to_thread(client.cards) == [card("MNERIM"), card("PC")]
    assert await asyncio.to_thread(client.brokers) == [Source().status()]


async def test_every_broker_can_be_asked(client: Client) -> None:
    assert await asyncio.to_thread(client.ask, "links") == {"base": []}
    assert (await asyncio.to_thread(client.ask, "why", "A", "0x12"))["base"]["b"] == "0x12"
    assert await asyncio.to_thread(lambda: client.ask("links", broker="other")) == {}
    with pytest.raises(CallError) as raised:
        await asyncio.to_thread(client.ask, "nonsense")
    assert raised.value.code == "bad_request"


async def test_any_key_can_be_got(client: Client) -> None:
    found = await asyncio.to_thread(client.get_json, "psiu/*")
    assert set(found) == {"psiu/MNERIM", "psiu/PC"}


@pytest.mark.parametrize("key", ["", "/psiu", "psiu//x", "a*", "x" * (KEY_LENGTH_MAX + 1), "\ud800"])
async def test_a_wrong_key_is_one_line_and_leaves_the_client_whole(client: Client, key: str) -> None:
    with pytest.raises(BusError) as raised:
        await asyncio.to_thread(client.get_json, key)
    assert ".rs:" not in str(raised.value)
    with pytest.raises(BusError):
        next(client.monitor(key))
    assert await asyncio.to_thread(client.brokers)


async def test_a_call_returns_the_robots_answer(client: Client) -> None:
    answer = await asyncio.to_thread(client.call, "red.0x12", "garra", CallRequest(parameters=[45, "x"]))
    assert answer == Answer(status="sucesso", values=["red.0x12", 45, "x"], elapsed_ms=1)
    named = await asyncio.to_thread(client.call, Address.named("0x12"), "garra")
    assert named.values == ["0x12"]


async def test_a_refused_call_raises_its_code(client: Client) -> None:
    with pytest.raises(CallError, match="no robot A is known") as raised:
        await asyncio.to_thread(client.call, "A", "absent")
    assert raised.value.code == "unknown_robot"


async def test_a_call_ends_even_when_the_broker_forgets_it(client: Client) -> None:
    begun = time.monotonic()
    with pytest.raises(CallError) as raised:
        await asyncio.to_thread(client.call, "A", "slow", CallRequest(timeout_s=0.2))
    assert raised.value.code == "outcome_unknown"
    assert time.monotonic() - begun < 3


async def test_a_bus_without_calls_is_no_answer(session: Session, endpoint: str) -> None:
    with Client([endpoint]) as client, pytest.raises(CallError) as raised:
        await asyncio.to_thread(client.call, "A", "b")
    assert raised.value.code == "no_answer"


async def test_of_several_brokers_the_one_that_knows_the_robot_answers(
    client: Client, connect: Callable[[], zenoh.Session]
) -> None:
    def stranger(query: zenoh.Query) -> None:
        with query:
            query.reply_err(b'{"error": "unknown_robot", "message": "not here"}')

    other = connect()
    other.declare_queryable("psiu/@call/*/*", stranger)
    answer = await asyncio.to_thread(client.call, "A", "b")
    assert answer.status == "sucesso"


async def test_a_put_just_before_closing_arrives(endpoint: str, broker: Session, sent: list[Any], until: Until) -> None:
    def put_and_go(number: int) -> None:
        with Client([endpoint]) as client:
            client.put_call("MNERIM", "para", CallRequest(parameters=[number]))

    for number in range(10):
        await asyncio.to_thread(put_and_go, number)
    await until(lambda: len(sent) == 10)
    assert sent[3][:2] == (Address.named("MNERIM"), "para")
    assert sent[3][2].parameters == [3]
    assert len({request.program for _, _, request in sent}) == 10, "each is missed by itself"


async def test_monitor_tells_puts_and_deletes(client: Client, connect: Callable[[], zenoh.Session]) -> None:
    heard = client.monitor("psiu/**")
    first = asyncio.create_task(asyncio.to_thread(next, heard))
    other = connect()
    while not first.done():  # until the subscription has come through
        other.put("psiu/A/B/c", b"1")
        await asyncio.sleep(0.01)
    assert await first == ("psiu/A/B/c", "put", b"1")
    other.delete("psiu/A")
    while (event := await asyncio.to_thread(next, heard))[1] == "put":
        pass
    assert event == ("psiu/A", "delete", b"")
    await asyncio.to_thread(heard.close)


async def test_a_listener_is_handed_what_is_put_until_it_ends(
    client: Client, connect: Callable[[], zenoh.Session]
) -> None:
    heard: list[bytes] = []
    other = connect()
    with client.listening("psiu/*/B/**", heard.append):
        async with asyncio.timeout(5):
            while not heard:  # until the subscription has come through
                other.put("psiu/A/B/c", b"1")
                other.put("psiu/A/C/c", b"2")
                await asyncio.sleep(0.01)
    assert set(heard) == {b"1"}
    with pytest.raises(BusError), client.listening("psiu/#", heard.append):
        pass


async def test_ctrl_c_ends_a_monitor(endpoint: str, session: Session) -> None:
    script = f"""
from psiu_broker.bus.client import Client
with Client([{endpoint!r}]) as client:
    print("ready", flush=True)
    try:
        for _ in client.monitor("psiu/**"):
            pass
    except KeyboardInterrupt:
        print("interrupted")
"""
    process = await asyncio.to_thread(
        subprocess.Popen, [sys.executable, "-c", script], stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        assert await asyncio.to_thread(process.stdout.readline) == "ready\n"
        await asyncio.sleep(0.2)
        os.kill(process.pid, signal.SIGINT)
        output, _ = await asyncio.to_thread(process.communicate, timeout=5)
        assert output == "interrupted\n"
        assert process.returncode == 0
    finally:
        process.kill()
        process.wait()

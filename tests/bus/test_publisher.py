import asyncio
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Awaitable, Callable
from datetime import UTC, datetime
from typing import Any

import jsonschema
import pytest
import zenoh

from psiu_broker.bus.keys import Keys
from psiu_broker.bus.publisher import KEYS_MAX, PRIORITY, Publisher
from psiu_broker.bus.session import Session
from psiu_broker.errors import BusError
from psiu_broker.frame import EVERYONE, NOBODY, Address, Frame, Way
from psiu_broker.messages import Card, Decoded, RawFrame

Until = Callable[[Callable[[], object]], Awaitable[None]]

PC, MNERIM = Address.named("PC"), Address.named("MNERIM")
WIRE = b"MNERIM 034 parafrente 100 PC 02123"
COMMAND = Frame(PC, MNERIM, "parafrente", b"parafrente 100", "psiu-ascii", WIRE, "psiu-ascii/1")
RADIO = Way("radio")
HEARD = datetime(2026, 11, 22, 3, 4, 5, 678901, UTC)


def describe(frame: Frame) -> dict[str, Any]:
    if frame.subject == "bug":
        raise KeyError("bug")
    return {"kind": "command", "command": frame.subject, "parameters": [100]}


def raw(link: str) -> RawFrame:
    return RawFrame(direction="in", broker="base", link=link, verdict="delivered", received=HEARD, wire=WIRE.hex())


@pytest.fixture
async def publisher(session: Session, keys: Keys) -> Publisher:
    return await Publisher.open(session, keys, "base", describe)


@pytest.fixture
def subscribe(program: zenoh.Session) -> Callable[[str], Any]:
    kept: list[Any] = []  # a subscriber that nothing holds is undeclared

    def declare(key: str) -> Any:
        kept.append(program.declare_subscriber(key, zenoh.handlers.RingChannel(1000)))
        return kept[-1]

    return declare


async def test_nobody_listening_is_nobody_listened(publisher: Publisher) -> None:
    assert publisher.listened is False
    assert publisher.raw_listened is False
    assert not publisher.tapped("radio")


@pytest.mark.parametrize(
    "key",
    [
        "psiu/**",
        "**",
        "psiu/MNERIM/**",
        "psiu/*/MNERIM/*",
        "psiu/PC/MNERIM/parafrente",
        "psiu/*/*/node/4",
        "psiu/%3F%3F/**",
    ],
)
async def test_listened_follows_any_subscriber_that_comes_and_goes(
    publisher: Publisher, subscribe: Callable[[str], Any], until: Until, key: str
) -> None:
    for _ in range(3):
        subscriber = subscribe(key)
        await until(lambda: publisher.listened)
        subscriber.undeclare()
        await until(lambda: not publisher.listened)


@pytest.mark.parametrize("key", ["psiu/*", "psiu/MNERIM", "psiu/@raw/**", "psiu/@call/**", "psiu/@broker/**"])
async def test_other_subscribers_do_not_make_frames_listened(
    publisher: Publisher, subscribe: Callable[[str], Any], until: Until, key: str
) -> None:
    subscribe(key)
    marker = subscribe("psiu/@raw/base/marker")
    await until(lambda: publisher.tapped("marker"))
    assert publisher.listened is False
    marker.undeclare()


async def test_listened_ends_right_after_many_changes_of_many_programs(
    publisher: Publisher, connect: Callable[[], zenoh.Session], until: Until
) -> None:
    programs = [connect(), connect(), connect()]
    kept: list[Any] = []
    for number in range(150):
        subscriber = programs[number % 3].declare_subscriber(f"psiu/*/R{number}/**", zenoh.handlers.RingChannel(1))
        kept.append(subscriber)
        if number % 2:
            kept.pop(0).undeclare()
    await until(lambda: publisher.listened)
    for subscriber in kept:
        subscriber.undeclare()
    await until(lambda: not publisher.listened)
    last = programs[1].declare_subscriber("psiu/**", zenoh.handlers.RingChannel(1))
    await until(lambda: publisher.listened)
    last.undeclare()


async def test_a_program_that_dies_and_returns_is_listened_to_again(
    publisher: Publisher, connect: Callable[[], zenoh.Session], until: Until
) -> None:
    first = connect()
    first.declare_subscriber("psiu/**", lambda sample: None)
    await until(lambda: publisher.listened)
    first.close()
    await until(lambda: not publisher.listened)
    subscriber = connect().declare_subscriber("psiu/**", zenoh.handlers.RingChannel(10))
    await until(lambda: publisher.listened)
    publisher.publish(COMMAND, RADIO, time.time())
    sample = await asyncio.to_thread(subscriber.recv)
    assert str(sample.key_expr) == "psiu/PC/MNERIM/parafrente"


async def test_a_frame_arrives_as_a_decoded_message(
    publisher: Publisher, subscribe: Callable[[str], Any], until: Until
) -> None:
    subscriber = subscribe("psiu/**")
    await until(lambda: publisher.listened)
    publisher.publish(COMMAND, RADIO, HEARD.timestamp())
    sample = await asyncio.to_thread(subscriber.recv)
    assert str(sample.key_expr) == "psiu/PC/MNERIM/parafrente"
    assert str(sample.encoding) == "application/json;psiu/Decoded"
    message = json.loads(sample.payload.to_string())
    jsonschema.validate(message, Decoded.model_json_schema(mode="serialization"))
    assert message["source"] == "PC"
    assert message["parameters"] == [100]
    assert message["broker"] == "base"
    assert message["link"] == "radio"
    assert message["received"] == "2026-11-22T03:04:05.678901Z"
    assert bytes.fromhex(message["wire"]) == WIRE
    assert message["status"] is None
    assert publisher.puts == 1


async def test_only_what_somebody_listens_to_is_described_and_put(
    session: Session, keys: Keys, subscribe: Callable[[str], Any], until: Until
) -> None:
    described: list[str] = []

    def watched(frame: Frame) -> dict[str, Any]:
        described.append(str(frame.source))
        return describe(frame)

    publisher = await Publisher.open(session, keys, "base", watched)
    subscriber = subscribe("psiu/MNERIM/**")
    await until(lambda: publisher.listened)
    publisher.publish(COMMAND, RADIO, time.time())
    publisher.publish(COMMAND._replace(source=MNERIM, destination=PC), RADIO, time.time())
    sample = await asyncio.to_thread(subscriber.recv)
    assert str(sample.key_expr) == "psiu/MNERIM/PC/parafrente"
    assert described == ["MNERIM"]
    assert publisher.puts == 1


async def test_odd_names_arrive_under_keys_that_read_back(
    publisher: Publisher, keys: Keys, subscribe: Callable[[str], Any], until: Until
) -> None:
    subscriber = subscribe("psiu/**")
    await until(lambda: publisher.listened)
    odd = [
        (Address.named("@call"), Address.named("*/**"), "x#?$*"),
        (NOBODY, EVERYONE, ""),
        (Address.named("0x12"), Address.numbered(0x12), "node/4"),
        (Address.named("ROBÔ 1"), Address.named("~%/"), "/"),
    ]
    for source, destination, subject in odd:
        frame = COMMAND._replace(source=source, destination=destination, subject=subject)
        publisher.publish(frame, RADIO, time.time())
    heard = [await asyncio.to_thread(subscriber.recv) for _ in odd]
    assert [keys.read_decoded(str(sample.key_expr)) for sample in heard] == odd


async def test_a_frame_that_cannot_be_described_is_counted_and_raises_nothing(
    publisher: Publisher, subscribe: Callable[[str], Any], until: Until, caplog: pytest.LogCaptureFixture
) -> None:
    subscribe("psiu/**")
    await until(lambda: publisher.listened)
    for _ in range(5):
        publisher.publish(COMMAND._replace(subject="bug"), RADIO, time.time())
    publisher.publish(COMMAND._replace(source=Address.named("x" * 40_000)), RADIO, time.time())
    assert publisher.failures == 6
    assert publisher.puts == 0
    assert len([record for record in caplog.records if "could not be published" in record.message]) == 3


async def test_more_keys_than_are_kept_declared_all_arrive(
    publisher: Publisher, subscribe: Callable[[str], Any], program: zenoh.Session, until: Until
) -> None:
    heard: list[str] = []
    program.declare_subscriber("psiu/**", lambda sample: heard.append(str(sample.key_expr)))
    await until(lambda: publisher.listened)
    count = KEYS_MAX + 200
    for number in range(count):
        publisher.publish(COMMAND._replace(subject=f"s{number}"), RADIO, time.time())
        if number % 50 == 49:  # no more at once than the queue to a program holds: it drops
            await until(lambda: len(heard) == publisher.puts)
    await until(lambda: len(heard) == count)
    assert len(set(heard)) == count


async def test_a_link_is_tapped_only_while_somebody_listens_to_it(
    publisher: Publisher, subscribe: Callable[[str], Any], until: Until
) -> None:
    subscriber = subscribe("psiu/@raw/base/radio")
    await until(lambda: publisher.tapped("radio"))
    assert not publisher.tapped("wifi")
    publisher.publish_raw(raw("radio"))
    sample = await asyncio.to_thread(subscriber.recv)
    assert str(sample.encoding) == "application/json;psiu/RawFrame"
    assert RawFrame.model_validate_json(sample.payload.to_bytes()) == raw("radio")
    every = subscribe("psiu/@raw/**")
    await until(lambda: publisher.tapped("wifi"))
    subscriber.undeclare()
    every.undeclare()
    await until(lambda: not publisher.raw_listened)
    assert not publisher.tapped("radio")


async def test_a_card_is_put_when_it_changes_and_deleted_when_the_robot_is_gone(
    publisher: Publisher, subscribe: Callable[[str], Any], until: Until
) -> None:
    subscriber, marker = subscribe("psiu/*"), subscribe("psiu/@raw/base/x")
    await until(lambda: publisher.raw_listened)  # the two came in this order
    card = Card(robot="MNERIM", protocol="psiu-ascii", broker="base", link="radio", link_state="open")
    publisher.publish_card(MNERIM, card)
    publisher.publish_card(MNERIM, card.model_copy())
    publisher.publish_card(MNERIM, card.model_copy(update={"link_state": "waiting"}))
    publisher.withdraw_card(MNERIM)
    publisher.withdraw_card(MNERIM)
    heard = [await asyncio.to_thread(subscriber.recv) for _ in range(3)]
    assert subscriber.try_recv() is None
    assert {str(sample.key_expr) for sample in heard} == {"psiu/MNERIM"}
    assert [Card.model_validate_json(sample.payload.to_bytes()).link_state for sample in heard[:2]] == [
        "open",
        "waiting",
    ]
    assert heard[2].kind == zenoh.SampleKind.DELETE
    assert publisher.puts == 3
    marker.undeclare()


async def test_a_stopped_program_holds_nobody_up(
    publisher: Publisher, session: Session, endpoint: str, keys: Keys, until: Until
) -> None:
    script = f"""
import json, sys, zenoh
config = {{"mode": "client", "connect": {{"endpoints": [{endpoint!r}]}}}}
session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
subscriber = session.declare_subscriber("psiu/**", zenoh.handlers.RingChannel(10))
print("ready", flush=True)
sys.stdin.read()
"""
    pipe = subprocess.PIPE
    stopped = await asyncio.to_thread(subprocess.Popen, [sys.executable, "-c", script], stdin=pipe, stdout=pipe)
    with stopped:
        try:
            assert stopped.stdout is not None
            await asyncio.to_thread(stopped.stdout.readline)
            await until(lambda: publisher.listened)
            os.kill(stopped.pid, signal.SIGSTOP)
            flood = session.zenoh.declare_publisher("psiu/x/y/z", congestion_control=zenoh.CongestionControl.DROP)
            for _ in range(20_000):  # its queue and its socket are full now
                flood.put(b"x" * 1000)
            worst_s = 0.0
            for number in range(300):
                begun = time.monotonic()
                publisher.publish(COMMAND._replace(subject=f"s{number}"), RADIO, begun)
                worst_s = max(worst_s, time.monotonic() - begun)
            assert publisher.failures == 0
            assert publisher.puts == 300
            assert worst_s < 4  # one that waited for room would take five; a busy machine takes its share
        finally:
            stopped.kill()


async def test_a_panic_while_publishing_is_counted_and_ends_the_listening(
    publisher: Publisher, session: Session, subscribe: Callable[[str], Any], until: Until, losses: list[BusError]
) -> None:
    subscribe("psiu/**")
    await until(lambda: publisher.listened)
    with pytest.raises(BaseException, match="DidntWrite"):
        session.zenoh.put("psiu/x", b"", encoding=zenoh.Encoding("a/b").with_schema("x" * 300), priority=PRIORITY)
    publisher.publish(COMMAND, RADIO, time.time())
    assert publisher.failures == 1
    assert publisher.listened is False
    await until(lambda: losses)


async def test_publishing_after_the_end_raises_nothing(publisher: Publisher, session: Session) -> None:
    await session.close()
    publisher.publish(COMMAND, RADIO, time.time())
    publisher.publish_raw(raw("radio"))
    publisher.withdraw_card(MNERIM)
    assert publisher.failures == 2


async def test_a_closed_session_opens_no_publisher(session: Session, keys: Keys) -> None:
    await session.close()
    with pytest.raises(BusError, match="closed"):
        await Publisher.open(session, keys, "base", describe)

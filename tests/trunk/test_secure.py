"""A trunk between two brokers that have rules: the far end counts as a broker, and programs there as what they are."""

import asyncio
import json
from pathlib import Path

import zenoh
from ports import free_port
from secure_keys import files, make_keys
from secure_lab import CONFIGURATION, program, until
from stream_relay import Relay

from psiu_broker.broker import Broker
from psiu_broker.config import load

TRUNK = """
[trunks.line]
adapter = "serial"
device = "socket://127.0.0.1:{stream}"
"""


async def test_brokers_with_rules_meet_by_a_trunk_and_programs_keep_to_theirs(tmp_path: Path) -> None:
    keys = make_keys(tmp_path / "keys")
    ports = [free_port(), free_port()]
    brokers: list[Broker] = []
    async with Relay() as relay:
        try:
            for name, port, stream in zip(("base", "hill"), ports, relay.ports, strict=True):
                file = tmp_path / f"{name}.toml"
                text = CONFIGURATION.format(name=name, bus=port, keys="keys", mode="peer", connect="[]")
                file.write_text(text + TRUNK.format(stream=stream))
                brokers.append(Broker(load(file)))
                await brokers[-1].start()
            await until(lambda: all(len(broker.mesh_seen().brokers) == 1 for broker in brokers))
            endpoint = f"tls/127.0.0.1:{ports[0]}"
            for name, expected in (("operator", 1), ("screen", 0)):
                with program(endpoint, files(keys, name)) as session:
                    assert await asked(session, "psiu/@broker/*/status") == {"base", "hill"}
                    called = await asyncio.to_thread(call, session, "psiu/@call/hill/discover")
                    assert called == expected
        finally:
            for broker in brokers:
                await broker.stop()


async def asked(session: zenoh.Session, key: str) -> set[str]:
    """Who answers a get."""

    def get() -> set[str]:
        replies = session.get(key, target=zenoh.QueryTarget.ALL, timeout=5)
        return {json.loads(reply.ok.payload.to_bytes())["broker"] for reply in replies if reply.ok}

    return await asyncio.to_thread(get)


def call(session: zenoh.Session, key: str) -> int:
    """How many answers and refusals there are."""
    return len(list(session.get(key, timeout=5)))

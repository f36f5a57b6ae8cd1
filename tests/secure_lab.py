"""A broker that lets in only whom it knows, with one simulated robot, and raw Zenoh sessions that try."""

import asyncio
import json
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import zenoh
from ports import free_port
from secure_keys import files, make_keys

from psiu_broker.broker import Broker
from psiu_broker.bus.client import Client
from psiu_broker.config import TlsConfiguration, load
from psiu_broker.simulator import AsciiRobot, UdpPort

REMOTE = zenoh.Locality.REMOTE
FORGED = b"forged"

CONFIGURATION = """
[broker]
name = "{name}"
[zenoh]
listen = ["tls/127.0.0.1:{bus}"]
[zenoh.tls]
ca = "{keys}/ca.pem"
certificate = "{keys}/{name}.pem"
key = "{keys}/{name}.key"
[zenoh.access]
brokers = ["base", "hill", "valley", "spy"]
commanders = ["operator"]
listeners = ["screen"]
[mesh]
mode = "{mode}"
connect = {connect}
"""
WIFI = """
[links.wifi]
adapter = "udp"
listen = "127.0.0.1:{wifi}"
peers = ["127.0.0.1:{robot}"]
protocol = "psiu-ascii"
timeout_s = 0.5
"""


def zenoh_config(endpoint: str, tls: TlsConfiguration | None, *, listen: bool = False, mode: str = "client") -> Any:
    """What another program, in any language, would write."""
    own: dict[str, Any] = {}
    if tls is not None:
        own = {"root_ca_certificate": tls.ca, "enable_mtls": True, "verify_name_on_connect": False}
        for side in ("listen", "connect"):
            own |= {f"{side}_certificate": tls.certificate, f"{side}_private_key": tls.key}
    side = "listen" if listen else "connect"
    return zenoh.Config.from_json5(
        json.dumps(
            {
                "mode": mode,
                side: {"endpoints": [endpoint], "timeout_ms": 1000, "exit_on_failure": True},
                "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
                "transport": {"link": {"tls": own}},
            }
        )
    )


@contextmanager
def program(endpoint: str, tls: TlsConfiguration | None, mode: str = "client") -> Iterator[zenoh.Session]:
    """Another program, and nothing of ours in it. Raises zenoh.ZError where it is not let in."""
    session = zenoh.open(zenoh_config(endpoint, tls, mode=mode))
    try:
        yield session
    finally:
        session.close()


def in_order(note: Callable[[zenoh.Sample], None]) -> Any:
    """What several subscribers are told, in the order in which it came: each would have a thread of its own."""
    return zenoh.handlers.Callback(note, indirect=False)


class Spy:
    """All that comes by a session, in its order; `forged`: with the mark `FORGED`. Tokens are those that came."""

    def __init__(self, session: zenoh.Session) -> None:
        self.seen: list[str] = []
        self.forged: list[str] = []
        self.tokens: list[str] = []
        self._session = session
        self._declared: list[Any] = []
        for key in ("psiu/**", "psiu/@mesh/**", "psiu/@call/**", "psiu/@raw/**", "psiu/@broker/**"):
            self._declared.append(session.declare_subscriber(key, in_order(self._note), allowed_origin=REMOTE))
            self._declared.append(session.liveliness().declare_subscriber(key, in_order(self._note_token)))

    def _note(self, sample: zenoh.Sample) -> None:
        self.seen.append(str(sample.key_expr))
        if sample.attachment is not None and sample.attachment.to_bytes() == FORGED:
            self.forged.append(str(sample.key_expr))

    def _note_token(self, sample: zenoh.Sample) -> None:
        self.tokens.append(str(sample.key_expr))


class SecureLab:
    """Brokers, each connected to the one before it; MNERIM is at the last."""

    def __init__(self, folder: Path, names: Sequence[str] = ("base",), mode: str = "peer", extra: str = "") -> None:
        self.keys = make_keys(folder / "keys")
        self.ports = [free_port() for _ in names]
        self.endpoints = [f"tls/127.0.0.1:{port}" for port in self.ports]
        self._wifi, self._robot_port = (free_port(socket.SOCK_DGRAM) for _ in range(2))
        self.robot = AsciiRobot("MNERIM")
        self._port = UdpPort(self.robot, listen=f"127.0.0.1:{self._robot_port}")
        self.brokers = []
        for at, name in enumerate(names):
            others = self.endpoints[max(at - 1, 0) : at] if mode == "router" else self.endpoints[:at]
            text = CONFIGURATION.format(
                name=name, bus=self.ports[at], keys="keys", mode=mode, connect=json.dumps(others)
            )
            if at == len(names) - 1:
                text += WIFI.format(wifi=self._wifi, robot=self._robot_port) + extra
            file = folder / f"{name}.toml"
            file.write_text(text)
            self.brokers.append(Broker(load(file)))

    async def __aenter__(self) -> "SecureLab":
        await self._port.open()
        for broker in self.brokers:
            await broker.start()
        await until(lambda: all("MNERIM" in map(str, broker.robots()) for broker in self.brokers[-1:]))
        return self

    async def __aexit__(self, *_: object) -> None:
        for broker in self.brokers:
            await broker.stop()
        await self._port.close()

    def say(self, data: bytes) -> None:
        """The robot speaks."""
        self._port.send(data)

    def program(self, name: str, mode: str = "client") -> Any:
        return program(self.endpoints[0], files(self.keys, name), mode)

    def client(self, name: str) -> Client:
        return Client(self.endpoints[:1], tls=files(self.keys, name))


async def until(true: Callable[[], object], timeout_s: float = 15.0) -> None:
    """A broker's state is values, not events: look until it is so."""
    async with asyncio.timeout(timeout_s):
        while not true():  # noqa: ASYNC110
            await asyncio.sleep(0.01)

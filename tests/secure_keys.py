"""Keys that an authority of the tests' own has made."""

from collections.abc import Sequence
from pathlib import Path

from psiu_broker.cli.authority import Authority
from psiu_broker.config import TlsConfiguration

BROKERS = ("base", "hill", "valley", "spy")
PROGRAMS = ("operator", "screen", "stranger")


def make_keys(folder: Path, brokers: Sequence[str] = BROKERS, programs: Sequence[str] = PROGRAMS) -> Path:
    authority = Authority(folder)
    for name in (*brokers, *programs):
        authority.make(name, 365, broker=name in brokers)
    return folder


def files(keys: Path, name: str) -> TlsConfiguration:
    return TlsConfiguration(ca=f"{keys}/ca.pem", certificate=f"{keys}/{name}.pem", key=f"{keys}/{name}.key")

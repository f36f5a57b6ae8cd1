"""The configuration file: TOML in, one frozen `Configuration` out, or every mistake in it at once."""

from psiu_broker.config.reading import load
from psiu_broker.config.schema import json_schema
from psiu_broker.config.tables import (
    AccessConfiguration,
    BrokerConfiguration,
    Configuration,
    LinkConfiguration,
    LinkOptions,
    MeshConfiguration,
    RobotConfiguration,
    TlsConfiguration,
    TrunkConfiguration,
    ZenohConfiguration,
)

__all__ = [
    "AccessConfiguration",
    "BrokerConfiguration",
    "Configuration",
    "LinkConfiguration",
    "LinkOptions",
    "MeshConfiguration",
    "RobotConfiguration",
    "TlsConfiguration",
    "TrunkConfiguration",
    "ZenohConfiguration",
    "json_schema",
    "load",
]

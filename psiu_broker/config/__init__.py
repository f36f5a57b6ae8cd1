"""The configuration file: TOML in, one frozen `Configuration` out, or every mistake in it at once."""

from psiu_broker.config.reading import load
from psiu_broker.config.schema import json_schema
from psiu_broker.config.tables import (
    BrokerConfiguration,
    Configuration,
    LinkConfiguration,
    LinkOptions,
    MeshConfiguration,
    RobotConfiguration,
    TrunkConfiguration,
    ZenohConfiguration,
)

__all__ = [
    "BrokerConfiguration",
    "Configuration",
    "LinkConfiguration",
    "LinkOptions",
    "MeshConfiguration",
    "RobotConfiguration",
    "TrunkConfiguration",
    "ZenohConfiguration",
    "json_schema",
    "load",
]

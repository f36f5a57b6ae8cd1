"""The JSON schema of the file, for editors that complete and check while one types."""

from typing import Any

from pydantic import BaseModel

from psiu_broker.config.tables import (
    LINK_NAME,
    BrokerConfiguration,
    LinkOptions,
    MeshConfiguration,
    PolicyRule,
    RobotTable,
    ZenohConfiguration,
)
from psiu_broker.protocols import CODECS, PROTOCOLS
from psiu_broker.registry import adapter_class, adapter_names


def json_schema() -> dict[str, Any]:
    """The JSON schema (2020-12) of the file, with the options of every adapter and protocol, for editors."""
    definitions: dict[str, Any] = {}

    def schema(model: type[BaseModel]) -> dict[str, Any]:
        made = model.model_json_schema()
        definitions.update(made.pop("$defs", {}))
        return made

    def only_if(word: str, name: str, model: type[BaseModel]) -> dict[str, Any]:
        made = schema(model)
        then = {"properties": made.get("properties", {}), "required": made.get("required", [])}
        return {"if": {"properties": {word: {"const": name}}, "required": [word]}, "then": then}

    link: dict[str, Any] = {
        "type": "object",
        "properties": {
            "adapter": {"enum": adapter_names(), "description": "how the link is reached"},
            "protocol": {"enum": sorted(CODECS), "description": "what its robots speak"},
            **schema(LinkOptions)["properties"],
            "map": {"anyOf": [schema(each.persona.Options) for each in PROTOCOLS.values() if each.persona] or [{}]},
        },
        "required": ["adapter", "protocol"],
        "allOf": [only_if("adapter", name, adapter_class(name)) for name in adapter_names()]
        + [only_if("protocol", name, codec.Options) for name, codec in sorted(CODECS.items())],
        "unevaluatedProperties": False,
    }
    streams = [name for name in adapter_names() if not adapter_class(name).datagrams]
    trunk: dict[str, Any] = {
        "type": "object",
        "properties": {"adapter": {"enum": streams, "description": "how the other broker is reached"}},
        "required": ["adapter"],
        "allOf": [only_if("adapter", name, adapter_class(name)) for name in streams],
        "unevaluatedProperties": False,
    }
    robot = schema(RobotTable)
    for protocol in PROTOCOLS.values():
        # Which of them a robot may have depends on its link, and that no schema can follow.
        robot["properties"] |= schema(protocol.profile.Options).get("properties", {})
    names = {"pattern": f"^{LINK_NAME.pattern}$"}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "psiu-broker configuration",
        "type": "object",
        "properties": {
            "broker": schema(BrokerConfiguration),
            "zenoh": schema(ZenohConfiguration),
            "mesh": schema(MeshConfiguration),
            "policy": {"type": "array", "items": schema(PolicyRule)},
            "links": {
                "type": "object",
                "propertyNames": names,
                "additionalProperties": link,
            },
            "trunks": {"type": "object", "propertyNames": names, "additionalProperties": trunk},
            "robots": {"type": "object", "additionalProperties": robot},
        },
        "required": ["broker"],
        "additionalProperties": False,
        "$defs": definitions,
    }

"""The configuration as programs may read it: complete, and without secrets."""

from typing import Any

from psiu_broker.config.tables import Configuration, LinkConfiguration, TrunkConfiguration


def shown(configuration: Configuration) -> dict[str, Any]:
    """The whole of it as JSON values, by the names of its tables; options that are secret are left out."""
    return {
        "broker": configuration.broker.model_dump(mode="json"),
        "zenoh": configuration.zenoh.model_dump(mode="json"),
        "mesh": configuration.mesh.model_dump(mode="json"),
        "policy": [rule.model_dump(mode="json") for rule in configuration.policy],
        "links": {name: _link(link) for name, link in configuration.links.items()},
        "trunks": {name: _trunk(trunk) for name, trunk in configuration.trunks.items()},
        "robots": {
            robot.name: {
                "link": robot.link,
                "address": None if robot.address is None else robot.address.number,
                "repeatable": sorted(robot.repeatable),
                "failsafe": None if robot.failsafe is None else robot.failsafe.model_dump(mode="json"),
                **robot.options.model_dump(mode="json"),
            }
            for robot in configuration.robots.values()
        },
    }


def _trunk(trunk: TrunkConfiguration | LinkConfiguration) -> dict[str, Any]:
    secret = {name for name, field in type(trunk.adapter).model_fields.items() if not field.repr}
    return {"adapter": trunk.adapter_name, **trunk.adapter.model_dump(mode="json", exclude=secret)}


def _link(link: LinkConfiguration) -> dict[str, Any]:
    return {
        **_trunk(link),
        "protocol": link.protocol,
        **link.codec.model_dump(mode="json"),
        **link.options.model_dump(mode="json"),
        **({} if link.map is None else {"map": link.map.model_dump(mode="json")}),
    }

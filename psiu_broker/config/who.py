"""Who is who by the configuration: the broker's own addresses, and what its author calls robots and their nodes."""

from collections.abc import Callable, Mapping

from psiu_broker.codecs.psiu_hexa import PsiuHexa
from psiu_broker.config.tables import Configuration
from psiu_broker.frame import Address, Frame, Way
from psiu_broker.profiles import Description, Node, describe
from psiu_broker.routing.table import Binding


def own_addresses(configuration: Configuration) -> dict[Address, str]:
    """The broker's name and, for every link of numbers, its address there; with the protocol of each."""
    own = {Address.named(configuration.broker.name): "psiu-ascii"}
    for link in configuration.links.values():
        if isinstance(link.codec, PsiuHexa.Options):
            own[Address.numbered(link.codec.local, link.codec.domain)] = "psiu-hexa"
    return own


def bindings(configuration: Configuration) -> tuple[Binding, ...]:
    """The robots of the configuration, as the router knows them."""
    return tuple(
        Binding(Address.named(robot.name), robot.address, Way(robot.link, robot.peer), robot.protocol)
        for robot in configuration.robots.values()
    )


def names(configuration: Configuration) -> Mapping[Address, Address]:
    """What the configuration calls the numbers in it, the broker's own among them."""
    own = dict.fromkeys(own_addresses(configuration), Address.named(configuration.broker.name))
    robots = configuration.robots.values()
    return own | {robot.address: Address.named(robot.name) for robot in robots if robot.address is not None}


def describer(configuration: Configuration) -> Callable[[Frame], Description]:
    """How to say a frame in words, with the names that the configuration gives to nodes."""
    named: dict[Address, dict[int, tuple[str, Node]]] = {
        robot.address: {node.node: (name, node) for name, node in robot.nodes.items()}
        for robot in configuration.robots.values()
        if robot.address is not None
    }
    nothing: dict[int, tuple[str, Node]] = {}
    return lambda frame: describe(frame, lambda address: named.get(address, nothing))

"""Who is who by the configuration: the broker's own addresses, and what its author calls robots and their nodes."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from psiu_broker.adapter import Peer
from psiu_broker.codecs.paced import Rest
from psiu_broker.codecs.psiu_hexa import PsiuHexa
from psiu_broker.config.tables import Configuration, LinkConfiguration, domain_of
from psiu_broker.frame import NOBODY, Address, Frame, Way, peer_text
from psiu_broker.profiles import Description, Node, describe
from psiu_broker.profiles.hexa import HexaOptions
from psiu_broker.profiles.soccer import SoccerProfile
from psiu_broker.protocols import PROTOCOLS
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


@dataclass(frozen=True, slots=True)
class Ends:
    """Who is at both ends of a link whose packets do not say."""

    link: str
    own: Address
    """What we are there: the broker, or the robot that it plays."""
    plays: bool
    domain: str
    """Within what the numbers in its packets are unique."""
    robots: Mapping[Peer, Address]
    """The robots that the configuration puts there, by their far ends; by None, the one that may be at any."""

    def named(self, frame: Frame, peer: Peer) -> Frame:
        """`frame`, which came from `peer`, with the addresses that its packet left out."""
        source, destination = frame.source, frame.destination
        if source == NOBODY:
            source = self.far(peer)
        if destination == NOBODY:
            destination = self.own
        elif destination.is_numbered:
            destination = Address.numbered(destination.number, self.domain)
        return frame._replace(source=source, destination=destination)

    def far(self, peer: Peer) -> Address:
        """Who is at the far end `peer`; named after the link where the configuration does not say."""
        known = self.robots.get(peer) or self.robots.get(None)
        if known is not None:
            return known
        return Address.named(self.link if peer is None else f"{self.link}@{peer_text(peer)}")


def ends(configuration: Configuration, link: LinkConfiguration) -> Ends:
    """Who is on `link`, as far as the configuration tells."""
    plays = link.options.plays
    here = [robot for robot in configuration.robots.values() if robot.link == link.name and robot.address is None]
    alone = len([robot for robot in here if robot.peer is None]) == 1
    robots = {robot.peer: Address.named(robot.name) for robot in here if robot.peer is not None or alone}
    return Ends(
        link.name, Address.named(plays or configuration.broker.name), plays is not None, domain_of(link), robots
    )


def rests_of(configuration: Configuration, link: LinkConfiguration) -> dict[int, Rest]:
    """What stops each robot of a link whose packets tell all of them at once, by number."""
    made = {
        robot.address.number: PROTOCOLS[link.protocol].profile.make(link.codec, robot.options, link.options.timeout_s)
        for robot in configuration.robots.values()
        if robot.link == link.name and robot.address is not None
    }
    return {number: profile.rest for number, profile in made.items() if isinstance(profile, SoccerProfile)}


def describer(configuration: Configuration) -> Callable[[Frame], Description]:
    """How to say a frame in words, with the names that the configuration gives to nodes."""
    named: dict[Address, dict[int, tuple[str, Node]]] = {
        robot.address: {node.node: (name, node) for name, node in robot.options.nodes.items()}
        for robot in configuration.robots.values()
        if robot.address is not None and isinstance(robot.options, HexaOptions)
    }
    nothing: dict[int, tuple[str, Node]] = {}
    return lambda frame: describe(frame, lambda address: named.get(address, nothing))

"""Who is at the far end of a link whose packets name nobody, where the file does not say: named after the link."""

from collections.abc import Collection, Mapping

from psiu_broker.codecs.codec import Directory
from psiu_broker.config.problems import Problems
from psiu_broker.config.tables import BrokerConfiguration, LinkConfiguration, RobotConfiguration
from psiu_broker.frame import Address
from psiu_broker.protocols import PROTOCOLS


def check_far_names(
    broker: BrokerConfiguration | None,
    links: Collection[LinkConfiguration],
    robots: Mapping[str, RobotConfiguration],
    problems: Problems,
) -> None:
    """What is named after its link has no name that is another's: nothing that it says would be believed."""
    told = {robot.link for robot in robots.values() if robot.address is None and robot.peer is None}
    for link in links:
        # Where there may be several, each has its peer in its name.
        several = link.adapter.datagrams or link.adapter.many_peers
        if several or link.name in told or PROTOCOLS[link.protocol].codec(link.codec, Directory()).addressed:
            continue
        whose = None
        if broker is not None and link.name == broker.name:
            whose = "the broker's own name"
        elif link.name in robots:
            whose = "the name of a robot"
        elif Address.parse(link.name).is_numbered:
            whose = "a PSIU HEXA address"
        if whose is not None:
            text = f"who is there is known by the name of the link, which is {whose}; choose another word"
            problems.add(("links", link.name), text)

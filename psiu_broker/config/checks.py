"""What no single table shows: combinations that cannot work, and some that can but are risky."""

import os
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from datetime import datetime
from ipaddress import ip_address
from typing import Final
from urllib.parse import urlsplit

from psiu_broker.adapter import Adapter, Peer
from psiu_broker.codecs import psiu_ascii
from psiu_broker.codecs.codec import Codec, Directory
from psiu_broker.codecs.paced import PacedCodec
from psiu_broker.codecs.psiu_hexa import PsiuHexa
from psiu_broker.codecs.soccer import Soccer, rate_trouble
from psiu_broker.config.certificates import problem
from psiu_broker.config.certificates import warnings as validity
from psiu_broker.config.problems import Key, Problems, got, suggestion
from psiu_broker.config.tables import (
    ENDPOINT,
    LINK_NAME,
    AccessConfiguration,
    BrokerConfiguration,
    LinkConfiguration,
    MeshConfiguration,
    PolicyRule,
    RobotConfiguration,
    RobotTable,
    TrunkConfiguration,
    ZenohConfiguration,
)
from psiu_broker.errors import CallError
from psiu_broker.frame import Address
from psiu_broker.profiles.hexa import RESERVED, Node
from psiu_broker.profiles.profile import Profile
from psiu_broker.profiles.psiu import PsiuProfile
from psiu_broker.protocols import PROTOCOLS

_WORD: Final = re.compile(r"[!-~]+")
_NUMBERED_TTY: Final = re.compile(r"/dev/tty(USB|ACM)[0-9]+")
_EVERY_INTERFACE: Final = frozenset({"0.0.0.0", "[::]"})  # noqa: S104 (compared, not bound)
_ADD_TLS: Final = "write [zenoh.tls] with ca, certificate and key, which psiu-broker keys makes"
_PROTECT_RATHER: Final = "keep to 127.0.0.1, or to tls/ with [zenoh.tls] and [zenoh.access]"
_PROTECT: Final = f"{_PROTECT_RATHER}, or say unprotected = true in [zenoh]"


def check_nodes(nodes: Mapping[str, Node], key: Key, problems: Problems) -> None:
    """A node has one name, which is a word that can be sent as a command."""
    names: dict[int, str] = {}
    for name, node in nodes.items():
        at = (*key, "nodes", name)
        if not _WORD.fullmatch(name) or name in RESERVED:
            problems.add(at, f"expected one word, none of {', '.join(sorted(RESERVED))}; call the node something else")
        if (first := names.setdefault(node.node, name)) != name:
            problems.add((*at, "node"), f"node {node.node} is {first} already; give it one name")


def check_trunk(trunk: TrunkConfiguration, key: Key, problems: Problems) -> None:
    """Nothing that a trunk carries may be lost or changed unnoticed."""
    if trunk.adapter.reliable_stream:
        return
    device = getattr(trunk.adapter, "device", None)
    if isinstance(device, str):
        option, found = "device", f"{got(device)}: a raw serial line loses and corrupts bytes unnoticed"
    else:
        why = "whose datagrams may be lost" if trunk.adapter.datagrams else "which does not promise one"
        option, found = "adapter", f"{got(trunk.adapter_name)}, {why}"
    problems.add(
        (*key, option),
        f'expected a stream that loses nothing, got {found}; use adapter = "rfcomm" or device = "socket://HOST:PORT",'
        f" or write [links.{trunk.name}] with a protocol, and PSIU relays",
    )


def check_devices(
    links: Collection[LinkConfiguration], trunks: Collection[TrunkConfiguration], problems: Problems
) -> None:
    """A serial port, a UDP port, a robot's Bluetooth address or the calls to a controller belong to one of them."""
    held: list[tuple[str, str, str]] = []
    users = [("link", link.name, link.adapter) for link in links]
    users += [("trunk", trunk.name, trunk.adapter) for trunk in trunks]
    for kind, name, adapter in users:
        for option in ("device", "address", "listen"):
            mine = getattr(adapter, option, None)
            if not isinstance(mine, str) or getattr(adapter, "reuse", False):
                continue
            for other, theirs, holder in held:
                if option == other and _same(option, mine, theirs):
                    text = f"{got(mine)} is taken by {holder} already; give each its own"
                    problems.add((f"{kind}s", name, option), text)
            held.append((option, mine, f"{kind} {name}"))
    _check_own_ends(links, problems)
    accepting: dict[str, str] = {}
    for kind, name, adapter in users:
        if getattr(adapter, "accept", None) is True:
            controller = str(getattr(adapter, "controller", ""))
            if (first := accepting.setdefault(controller, f"{kind} {name}")) != f"{kind} {name}":
                text = f"{first} takes all who call {controller} already; keep one of them"
                problems.add((f"{kind}s", name, "accept"), text)


def _check_own_ends(links: Collection[LinkConfiguration], problems: Problems) -> None:
    """A broker that is its own peer hears all that it says: for ever, where packets name no sender."""
    listening = {
        link.name: listen for link in links if isinstance(listen := getattr(link.adapter, "listen", None), str)
    }
    for link in links:
        for position, peer in enumerate(getattr(link.adapter, "peers", ())):
            for name, listen in listening.items():
                if _same("listen", peer, listen):
                    text = f"link {name} of this broker listens there, and would hear itself; give where the robot is"
                    problems.add(("links", link.name, "peers", position), text)


def _same(option: str, a: str, b: str) -> bool:
    if option == "device" and a.startswith("/") and b.startswith("/"):
        return os.path.realpath(a) == os.path.realpath(b)
    if option == "listen":
        (host_a, _, port_a), (host_b, _, port_b) = a.rpartition(":"), b.rpartition(":")
        if port_a != port_b or port_a == "0":
            return False
        one_family = host_a.startswith("[") == host_b.startswith("[")
        return host_a == host_b or (one_family and not _EVERY_INTERFACE.isdisjoint((host_a, host_b)))
    return a == b


def check_far_end(
    adapter: Adapter, codec: PsiuHexa.Options, written: Collection[str], key: Key, problems: Problems
) -> None:
    """Point-to-point packets name nobody, so there must be one robot, another than the broker, to mean."""
    if codec.topology != "point-to-point":
        return
    if adapter.many_peers:
        problems.add(
            (*key, "topology"),
            "point-to-point packets name no robot, and this link may reach several;"
            " choose another topology, or leave it one robot (udp: a single one of peers, and learn = false)",
        )
    # Where a robot's table says who is there, the same mistake is its address's.
    if "remote" in written and codec.remote == codec.local:
        problems.add((*key, "remote"), f"{got(codec.remote)} is the broker's own address there; give the robot's")


def check_rate(adapter: Adapter, codec: Soccer.Options, key: Key, problems: Problems) -> None:
    """The line is as fast as its robots listen, and carries so many packets a second."""
    bits_per_second = adapter.bits_per_second
    if bits_per_second is not None and bits_per_second != codec.baud:
        text = f"the robots of {codec.preset} listen at {codec.baud}; write baudrate = {codec.baud}"
        problems.add((*key, "baudrate"), f"{text}, or baud = {bits_per_second} if yours do at that")
    trouble = rate_trouble(codec, adapter.bits_per_second)
    if trouble is not None:
        problems.add((*key, "rate_hz"), trouble)


def check_paced(codec: type[Codec], written: Collection[str], key: Key, problems: Problems) -> None:
    """Packets that leave at a fixed rate, with the newest for every robot, leave nothing to limit or to replace."""
    if not issubclass(codec, PacedCodec):
        return
    for option in ("newest_wins", "max_frames_s", "max_bytes_s", "limits"):
        if option in written:
            text = f"{codec.protocol} sends packets at rate_hz, each with the newest for every robot; remove it"
            problems.add((*key, option), text)


def check_proxied(links: Iterable[LinkConfiguration], problems: Problems) -> None:
    """Only PSIU ASCII has the word that the sender would hear."""
    for link in links:
        if link.options.proxy_errors and link.protocol != psiu_ascii.PROTOCOL:
            text = f"is for {psiu_ascii.PROTOCOL}, and link {link.name} speaks {link.protocol}; remove it"
            problems.add(("links", link.name, "proxy_errors"), text)


def check_promises(robot: RobotTable, profile: Profile, key: Key, problems: Problems) -> None:
    """The robot knows what it is to be told again, and what is to stop it."""
    known = {name for command in profile.commands() for name in (command.name, *command.aliases)}
    if not isinstance(profile, PsiuProfile):  # whose vocabulary is open
        for position, command in enumerate(robot.repeatable):
            if command not in known:
                text = f"there is no command {got(command)}; {suggestion(command, known)}"
                problems.add((*key, "repeatable", position), text)
    failsafe = robot.failsafe
    if failsafe is None:
        return
    try:
        request = profile.request(failsafe.command, failsafe.parameters)
    except CallError as error:
        problems.add((*key, "failsafe"), f"{error}; write what stops the robot")
        return
    if request.question or request.procedure is not None:
        problems.add((*key, "failsafe", "command"), f"{got(failsafe.command)} stops no robot; write what does")


def check_identities(
    broker: BrokerConfiguration | None,
    links: Iterable[LinkConfiguration],
    robots: Iterable[RobotConfiguration],
    problems: Problems,
) -> None:
    """No two robots, the broker among them, have one name, or one address in one domain."""
    holders: dict[Address, str] = {}
    for link in links:
        if isinstance(link.codec, PsiuHexa.Options):
            holders[Address.numbered(link.codec.local, link.codec.domain)] = "the broker itself"
    for robot in robots:
        if broker and robot.name == broker.name:
            problems.add(("robots", robot.name), "this is the broker's own name; rename one of them")
        if robot.address is not None and (first := holders.setdefault(robot.address, robot.name)) != robot.name:
            problems.add(
                ("robots", robot.name, "address"),
                f"{robot.address} is the address of {first} already;"
                " give it another address, or its link a domain of its own",
            )


def check_ends(
    links: Mapping[str, LinkConfiguration], robots: Mapping[str, RobotConfiguration], problems: Problems
) -> None:
    """Where packets name nobody, each far end is one robot; or a program, and then it is told of one that there is."""
    there: dict[tuple[str, Peer], str] = {}
    for robot in robots.values():
        link = links[robot.link]
        if _is_addressed(link):
            continue
        if link.options.plays is not None:
            text = f"programs are at the far end of {link.name}, which plays {link.options.plays}; choose another link"
            problems.add(("robots", robot.name, "link"), text)
        elif robot.address is None and (first := there.setdefault((link.name, robot.peer), robot.name)) != robot.name:
            where = "its peer" if link.adapter.many_peers else "a link of its own"
            text = f"{first} is there already, and {robot.protocol} names no robot; give {robot.name} {where}"
            problems.add(("robots", robot.name, "link"), text)
    for link in links.values():
        if link.options.plays is not None:
            _check_played(link, link.options.plays, robots, problems)


def check_policy(
    rules: Sequence[PolicyRule | None], links: Collection[str], broker: BrokerConfiguration | None, problems: Problems
) -> None:
    """A rule is about links that there are, and about robots."""
    for position, rule in enumerate(rules):
        for link in () if rule is None else rule.link:
            if LINK_NAME.fullmatch(link) and link not in links:
                known = suggestion(link, links) if links else "add one"
                problems.add(("policy", position, "link"), f"there is no link {got(link)}; {known}")
        if rule is not None and broker is not None and rule.destination == (broker.name,):
            text = f"{broker.name} is this broker: what is said to it moves nobody, and always passes; name a robot"
            problems.add(("policy", position, "destination"), text)


def _is_addressed(link: LinkConfiguration) -> bool:
    return PROTOCOLS[link.protocol].codec(link.codec, Directory()).addressed


def _check_played(
    link: LinkConfiguration, plays: str, robots: Mapping[str, RobotConfiguration], problems: Problems
) -> None:
    key = ("links", link.name, "plays")
    protocol = PROTOCOLS[link.protocol]
    if _is_addressed(link):
        problems.add(key, f"is not for {link.protocol}, whose programs name the robots themselves; remove it")
    elif plays not in robots:
        known = suggestion(plays, robots) if robots else "add [robots.NAME]"
        problems.add(key, f"there is no robot {got(plays)} in this file; {known}")
    elif robots[plays].protocol == link.protocol:
        if link.map is not None:
            problems.add(("links", link.name, "map"), f"{plays} speaks {link.protocol} itself; remove it")
    elif protocol.persona is None:
        choices = ", ".join(sorted(name for name, each in PROTOCOLS.items() if each.persona is not None))
        text = f"{plays} speaks {robots[plays].protocol}, and cannot be played in {link.protocol}; use one of {choices}"
        problems.add(key, text)


def check_bus(
    zenoh: ZenohConfiguration, mesh: MeshConfiguration, trunks: Iterable[TrunkConfiguration], problems: Problems
) -> None:
    """Nobody comes to the bus from another computer unseen, unless the user says so."""
    access, protected = zenoh.access, zenoh.tls is not None and zenoh.access is not None
    if access is not None and zenoh.tls is None:
        problems.add(("zenoh", "access"), f"the names are those of certificates, and there are none; {_ADD_TLS}")
    if access is not None:
        _check_roles(access, problems)
    for key, endpoint in _endpoints(zenoh, mesh):
        if endpoint.startswith("tls/"):
            if zenoh.tls is None:
                problems.add(key, f"{got(endpoint)} needs a key; {_ADD_TLS}")
                continue
        elif access is not None:
            text = f"expected tls/HOST:PORT, got {got(endpoint)}, where nobody shows the certificate that access asks"
            problems.add(key, f"{text}; write tls/ in place of {endpoint.partition('/')[0]}/")
            continue
        if not (_is_loopback(endpoint) or protected or zenoh.unprotected):
            problems.add(key, f"{endpoint} lets every computer that reaches it move the robots; {_PROTECT}")
    if mesh.discover and not (protected or zenoh.unprotected):
        text = "whoever answers on the local network may move the robots"
        problems.add(("mesh", "discover"), f"{text}; {_PROTECT}")
    for trunk in trunks:
        device = getattr(trunk.adapter, "device", "")
        if not (_is_near(device) or protected or zenoh.unprotected):
            text = f"{_open_trunk(device)}, or say unprotected = true in [zenoh]"
            problems.add(("trunks", trunk.name, "device"), text)


def _check_roles(access: AccessConfiguration, problems: Problems) -> None:
    roles: dict[str, str] = {}
    for role in type(access).model_fields:
        for position, name in enumerate(getattr(access, role)):
            if (first := roles.setdefault(name, role)) != role:
                text = f"{got(name)} is one of {first} already; name it once"
                problems.add(("zenoh", "access", role, position), text)


def _endpoints(zenoh: ZenohConfiguration, mesh: MeshConfiguration) -> Iterator[tuple[Key, str]]:
    for position, endpoint in enumerate(zenoh.listen):
        yield ("zenoh", "listen", position), endpoint
    for position, endpoint in enumerate(mesh.connect):
        yield ("mesh", "connect", position), endpoint


def check_keys(zenoh: ZenohConfiguration, problems: Problems) -> None:
    """The files of ``[zenoh.tls]`` are there, belong together, and are the broker's alone."""
    if zenoh.tls is not None and (found := problem(zenoh.tls, serves=True)) is not None:
        option, text = found
        problems.add(("zenoh", "tls", option), text)


def warnings_about(
    file: str,
    zenoh: ZenohConfiguration,
    mesh: MeshConfiguration,
    links: Iterable[LinkConfiguration],
    trunks: Iterable[TrunkConfiguration],
    now: datetime,
) -> tuple[str, ...]:
    warnings = Problems(file)
    for key, endpoint in _endpoints(zenoh, mesh):
        if not _is_loopback(endpoint) and zenoh.access is None:
            warnings.add(key, f"{endpoint} lets every computer that reaches it move the robots; {_PROTECT_RATHER}")
    if mesh.discover and zenoh.access is None:
        text = "whoever answers on the local network may move the robots"
        warnings.add(("mesh", "discover"), f"{text}; {_PROTECT_RATHER}")
    if zenoh.tls is not None:
        for option, text in validity(zenoh.tls, now, serves=True):
            warnings.add(("zenoh", "tls", option), text)
    for trunk in trunks:
        if zenoh.access is not None:
            text = "whoever is at its far end counts as a broker, and shows no certificate"
            warnings.add(("trunks", trunk.name), f"{text}; see that nobody else reaches it")
        elif not _is_near(device := getattr(trunk.adapter, "device", "")):
            warnings.add(("trunks", trunk.name, "device"), _open_trunk(device))
    for link in links:
        device = getattr(link.adapter, "device", None)
        if isinstance(device, str) and _NUMBERED_TTY.fullmatch(device):
            warnings.add(
                ("links", link.name, "device"),
                f"{device} may be another device after the next plug-in; use its name under /dev/serial/by-id/",
            )
    return tuple(warnings.lines)


def _open_trunk(device: str) -> str:
    threat = f"whoever answers at {device}, or is on the way there, may move the robots"
    return f"{threat}; go by a tunnel that ends on 127.0.0.1"


def _is_near(device: str) -> bool:
    """Whether a serial port, by path or by URL, is reached without a network."""
    try:
        return "://" not in device or _is_own(urlsplit(device).hostname or "")
    except ValueError:  # half an IPv6 address
        return False


def _is_loopback(endpoint: str) -> bool:
    match = ENDPOINT.fullmatch(endpoint)
    return match is None or match["host"] is None or _is_own(match["host"].strip("[]"))


def _is_own(host: str) -> bool:
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False

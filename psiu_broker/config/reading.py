"""How the file is read. A link is one flat table for its author; its keys belong to its adapter, to its
protocol's codec and to the link itself, and are split among those three here.
"""

import re
import tomllib
from collections.abc import Collection, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel

from psiu_broker.adapter import Adapter, Peer
from psiu_broker.codecs.psiu_hexa import PsiuHexa
from psiu_broker.codecs.soccer import Soccer
from psiu_broker.config.checks import (
    check_bus,
    check_devices,
    check_ends,
    check_far_end,
    check_identities,
    check_keys,
    check_nodes,
    check_paced,
    check_policy,
    check_promises,
    check_proxied,
    check_rate,
    check_trunk,
    warnings_about,
)
from psiu_broker.config.far_names import check_far_names
from psiu_broker.config.problems import Key, Problems, got, guess, suggestion
from psiu_broker.config.tables import (
    LINK_NAME,
    BrokerConfiguration,
    Configuration,
    LinkConfiguration,
    LinkOptions,
    MeshConfiguration,
    PolicyRule,
    RobotConfiguration,
    RobotTable,
    TrunkConfiguration,
    ZenohConfiguration,
    domain_of,
    robot_name,
)
from psiu_broker.errors import ConfigurationError
from psiu_broker.frame import Address
from psiu_broker.profiles.hexa import HexaOptions
from psiu_broker.profiles.persona import PersonaOptions
from psiu_broker.protocols import CODECS, PROTOCOLS
from psiu_broker.registry import UnknownAdapter, adapter_class, adapter_names

PLAYED_ROLE: Final = "board"
"""What the broker is on a link that plays a robot, in protocols that have two sides."""

_ROBOT_WORDS: Final = frozenset(RobotTable.model_fields).union(
    *(protocol.profile.Options.model_fields for protocol in PROTOCOLS.values())
)


def load(path: Path) -> Configuration:
    """Read the configuration in `path`.

    Raises:
        ConfigurationError: it cannot be read, or has mistakes: all of them, a line each.
    """
    problems = Problems(str(path))
    try:
        configuration = _configuration(_document(path), path, problems)
    except RecursionError as error:
        raise ConfigurationError([f"{path}: tables or lists nested too deeply; no option needs that"]) from error
    if configuration is None:
        raise ConfigurationError(problems.lines)
    return configuration


def _document(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    except OSError as error:
        reason = f"cannot be read: {error.strerror}; check the path, and that this user may read it"
        raise ConfigurationError([f"{path}: {reason}"]) from error
    except UnicodeDecodeError as error:
        raise ConfigurationError([f"{path}: byte {error.start} is not UTF-8; save the file as UTF-8 text"]) from error
    except ValueError as error:
        raise ConfigurationError([_syntax(path, str(error))]) from error


def _syntax(path: Path, message: str) -> str:
    """tomllib's complaint as FILE:LINE:COLUMN."""
    match = re.fullmatch(r"(?P<what>.*) \(at (?:line (?P<line>\d+), column (?P<column>\d+)|end of document)\)", message)
    if match is None:
        return f"{path}: not TOML: {message}"
    what = match["what"]
    hint = "; text is written in quotes" if what == "Invalid value" else ""
    place = f":{match['line']}:{match['column']}" if match["line"] else ": at the end"
    return f"{path}{place}: not TOML: {what}{hint}"


def _configuration(document: dict[str, Any], file: Path, problems: Problems) -> Configuration | None:
    """What the file says; None where it is wrong, with every mistake noted."""
    sections = ("broker", "zenoh", "mesh", "policy", "links", "trunks", "robots")
    for name in document:
        if name not in sections:
            problems.unknown((name,), sections)
    broker = problems.read(BrokerConfiguration, document.get("broker", {}), ("broker",))
    zenoh = problems.read(ZenohConfiguration, document.get("zenoh", {}), ("zenoh",))
    mesh = problems.read(MeshConfiguration, document.get("mesh", {}), ("mesh",))
    own_address = broker.address if broker else 0
    robots_written = problems.table(document.get("robots", {}), ("robots",)) or {}
    links_written = problems.table(document.get("links", {}), ("links",)) or {}
    links = {name: _link(name, value, robots_written, own_address, problems) for name, value in links_written.items()}
    trunks_written = problems.table(document.get("trunks", {}), ("trunks",)) or {}
    trunks = {name: trunk for name, value in trunks_written.items() if (trunk := _trunk(name, value, problems))}
    robots = {name: _robot(name, value, links, problems) for name, value in robots_written.items()}
    policy = _policy(document.get("policy", []), problems)
    check_policy(policy, links, broker, problems)
    whole_links = {name: link for name, link in links.items() if link}
    whole_robots = {name: robot for name, robot in robots.items() if robot}
    check_devices(whole_links.values(), trunks.values(), problems)
    check_proxied(whole_links.values(), problems)
    if None not in links.values():
        check_ends(whole_links, whole_robots, problems)
        check_far_names(broker, whole_links.values(), whole_robots, problems)
    check_identities(broker, whole_links.values(), whole_robots.values(), problems)
    if zenoh is not None and mesh is not None:
        zenoh = _with_files(zenoh, file.parent)
        check_bus(zenoh, mesh, trunks.values(), problems)
        check_keys(zenoh, problems)
    if broker is None or zenoh is None or mesh is None or problems.lines:
        return None
    warnings = warnings_about(str(file), zenoh, mesh, whole_links.values(), trunks.values(), datetime.now(UTC))
    rules = tuple(rule for rule in policy if rule is not None)
    return Configuration(broker, zenoh, whole_links, whole_robots, warnings, trunks, mesh, rules)


def _with_files(zenoh: ZenohConfiguration, folder: Path) -> ZenohConfiguration:
    """The same with paths that hold wherever the broker runs: relative ones are so to the file's `folder`."""
    if zenoh.tls is None:
        return zenoh
    files = {option: str(folder.absolute() / path) for option, path in zenoh.tls}
    return zenoh.model_copy(update={"tls": zenoh.tls.model_copy(update=files)})


def _policy(value: object, problems: Problems) -> list[PolicyRule | None]:
    """The rules, in their order; None for each that is wrong."""
    if not isinstance(value, list):
        problems.add(("policy",), f"expected rules, got {got(value)}; write [[policy]] above each")
        return []
    return [problems.read(PolicyRule, rule, ("policy", position)) for position, rule in enumerate(value)]


def _link(
    name: str, value: object, robots: Mapping[str, object], own_address: int, problems: Problems
) -> LinkConfiguration | None:
    key: Key = ("links", name)
    before = len(problems.lines)
    table = _named_table("link", name, value, key, problems)
    if table is None:
        return None
    adapter_name, adapter_model = _adapter(table, key, problems)
    protocol = _choice(table, key, "protocol", CODECS, problems)
    codec_model = CODECS[protocol].Options if protocol else None
    options = problems.read(LinkOptions, _share(table, LinkOptions), key)
    adapter = problems.read(adapter_model, _share(table, adapter_model), key) if adapter_model else None
    codec = None
    if protocol and codec_model:
        mine = _share(table, codec_model)
        if codec_model is PsiuHexa.Options:
            mine = _with_ends(name, mine, robots, own_address, problems)
        if "role" in codec_model.model_fields and "plays" in table:
            mine = {"role": PLAYED_ROLE} | mine
            if mine["role"] != PLAYED_ROLE:
                problems.add((*key, "role"), f"programs find a {PLAYED_ROLE} there, got {got(mine['role'])}; remove it")
        codec = problems.read(codec_model, mine, key)
        if adapter and isinstance(codec, PsiuHexa.Options):
            check_far_end(adapter, codec, table, key, problems)
        if adapter and isinstance(codec, Soccer.Options):
            check_rate(adapter, codec, key, problems)
        check_paced(CODECS[protocol], table, key, problems)
    persona = _persona(table, protocol, key, problems) if options and options.plays is not None else None
    if adapter_model and codec_model:
        models: tuple[type[BaseModel], ...] = (adapter_model, codec_model, LinkOptions)
        known = {"adapter", "protocol"}.union(*(model.model_fields for model in models))
        if "plays" in table:
            known.add("map")
        for word in table:
            if word not in known:
                problems.unknown((*key, word), known)
    if len(problems.lines) > before or not (adapter_name and adapter and protocol and codec and options):
        return None
    return LinkConfiguration(name, adapter_name, adapter, protocol, codec, options, persona)


def _trunk(name: str, value: object, problems: Problems) -> TrunkConfiguration | None:
    key: Key = ("trunks", name)
    before = len(problems.lines)
    table = _named_table("trunk", name, value, key, problems)
    if table is None:
        return None
    adapter_name, adapter_model = _adapter(table, key, problems)
    if adapter_model is None or adapter_name is None:
        return None
    options = {word: value for word, value in table.items() if word != "adapter"}
    adapter = problems.read(adapter_model, options, key)
    if adapter is None:
        return None
    trunk = TrunkConfiguration(name, adapter_name, adapter)
    check_trunk(trunk, key, problems)
    return trunk if len(problems.lines) == before else None


def _named_table(kind: str, name: str, value: object, key: Key, problems: Problems) -> dict[str, Any] | None:
    """`value` if it is a table; what is wrong with its name is noted too."""
    table = problems.table(value, key)
    if table is not None and not LINK_NAME.fullmatch(name):
        problems.add(key, f"expected a name of letters, digits, - and _; rename the {kind}")
    return table


def _adapter(table: dict[str, Any], key: Key, problems: Problems) -> tuple[str | None, type[Adapter] | None]:
    """The name that the table chooses, and its adapter; None where there is none."""
    name = _choice(table, key, "adapter", adapter_names(), problems)
    if name is None:
        return None, None
    try:
        return name, adapter_class(name)
    except UnknownAdapter as error:
        problems.add((*key, "adapter"), str(error))
        return name, None


def _choice(table: dict[str, Any], key: Key, word: str, known: Collection[str], problems: Problems) -> str | None:
    """The value of `word`, which must be one of `known`."""
    value = table.get(word)
    if isinstance(value, str) and value in known:
        return value
    choices = ", ".join(sorted(known))
    if word not in table:
        problems.add((*key, word), f"missing; write {word} = … with one of {choices}")
    else:
        question = guess(str(value), known)
        problems.add(
            (*key, word), f"expected one of {choices}, got {got(value)}" + (f"; {question}" if question else "")
        )
    return None


def _share(table: dict[str, Any], model: type[BaseModel]) -> dict[str, Any]:
    return {word: value for word, value in table.items() if word in model.model_fields}


def _with_ends(
    link: str, codec: dict[str, Any], robots: Mapping[str, object], own_address: int, problems: Problems
) -> dict[str, Any]:
    """The codec's keys, with the addresses that packets of its topology leave out taken from the rest of the file."""
    codec = {"local": own_address} | codec
    if codec.get("topology") != "point-to-point":
        if "remote" in codec:
            problems.add(("links", link, "remote"), 'is for topology = "point-to-point"; remove it')
        return codec
    tables = {name: robot for name, robot in robots.items() if isinstance(robot, dict)}
    here = {name: robot.get("address") for name, robot in tables.items() if robot.get("link") == link}
    addresses = {name: address for name, address in here.items() if type(address) is int}
    key: Key = ("links", link, "topology")
    if len(here) > 1:
        problems.add(key, f"one robot is at the far end of a point-to-point link, got {', '.join(here)}; keep one")
    for name, address in addresses.items():
        if codec.setdefault("remote", address) != address:
            problems.add(
                ("robots", name, "address"),
                f"expected {got(codec['remote'])}, the remote of link {link}, got {got(address)}; remove one of them",
            )
    if not here and "remote" not in codec:
        problems.add(key, f'point-to-point packets name no robot; add [robots.NAME] with address and link = "{link}"')
    return codec


def _robot(
    name: str, value: object, links: Mapping[str, LinkConfiguration | None], problems: Problems
) -> RobotConfiguration | None:
    key: Key = ("robots", name)
    table = problems.table(value, key)
    if table is None:
        return None
    try:
        robot_name(name)
    except ValueError as error:
        problems.add(key, str(error))
    at = table.get("link")
    if isinstance(at, str) and at not in links:
        problems.add((*key, "link"), f"there is no link {got(at)}; {suggestion(at, links) if links else 'add one'}")
    robot = problems.read(RobotTable, _share(table, RobotTable), key)
    for word in table:
        if word not in RobotTable.model_fields and not _owners(word):
            problems.unknown((*key, word), _ROBOT_WORDS)
    link = links.get(robot.link) if robot else None
    if robot is None or link is None:
        return None
    protocol = PROTOCOLS[link.protocol]
    model = protocol.profile.Options
    _refuse_of_others(table, link, key, problems)
    options = problems.read(model, _share(table, model), key)
    address = _address(robot, link, key, problems)
    if isinstance(options, HexaOptions):
        check_nodes(options.nodes, key, problems)
    peer: Peer = None
    if robot.peer is not None:
        try:
            peer = link.adapter.peer_named(robot.peer)
        except ValueError as error:
            problems.add((*key, "peer"), str(error))
    if options is None:
        return None
    try:
        profile = protocol.profile.make(link.codec, options, link.options.timeout_s, datagrams=link.adapter.datagrams)
    except ValueError as error:
        problems.add(key, str(error))
    else:
        check_promises(robot, profile, key, problems)
    repeatable = frozenset(robot.repeatable)
    return RobotConfiguration(name, robot.link, link.protocol, address, peer, options, repeatable, robot.failsafe)


def _address(robot: RobotTable, link: LinkConfiguration, key: Key, problems: Problems) -> Address | None:
    """The number of a robot whose protocol has numbers."""
    numbers = PROTOCOLS[link.protocol].numbers
    if numbers is None:
        if robot.address is not None:
            whose = " and ".join(name for name, each in PROTOCOLS.items() if each.numbers is not None)
            problems.add((*key, "address"), f"is for {whose}, and link {link.name} speaks {link.protocol}; remove it")
        return None
    known = numbers(link.codec)
    whose = f"link {link.name} speaks {link.protocol}, whose robots are numbers {known.start}–{known.stop - 1}"
    if robot.address is None:
        problems.add((*key, "address"), f"missing; {whose}")
    elif robot.address not in known:
        problems.add((*key, "address"), f"got {robot.address}; {whose}")
    else:
        return Address.numbered(robot.address, domain_of(link))
    return None


def _refuse_of_others(table: Mapping[str, Any], link: LinkConfiguration, key: Key, problems: Problems) -> None:
    """Note the words of `table` that are for robots of other protocols than the link's."""
    for word in table:
        owners = _owners(word)
        if owners and link.protocol not in owners:
            whose = " and ".join(owners)
            problems.add((*key, word), f"is for {whose}, and link {link.name} speaks {link.protocol}; remove it")


def _owners(word: str) -> list[str]:
    """The protocols whose robots may have the option `word`."""
    return [name for name, each in PROTOCOLS.items() if word in each.profile.Options.model_fields]


def _persona(table: dict[str, Any], protocol: str | None, key: Key, problems: Problems) -> PersonaOptions | None:
    """What the robot that is played looks like on a link; None where it is of the link's own protocol."""
    persona = PROTOCOLS[protocol].persona if protocol else None
    if "map" not in table or protocol is None:
        return None
    if persona is None:
        problems.add((*key, "map"), f"is not for {protocol}: a robot is played in it as it is; remove it")
        return None
    return problems.read(persona.Options, table["map"], (*key, "map"))

"""`psiu sim`: a simulated robot, to try the broker and one's own programs with."""

import asyncio
import re
import signal
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, Final, NamedTuple

import click
from pydantic import ValidationError

from psiu_broker.cli.commands import Failure, examples, number, parsed
from psiu_broker.cli.sim_journal import Journal
from psiu_broker.profiles.node import Node
from psiu_broker.protocols import CODECS
from psiu_broker.simulator import QUIRKS, AsciiRobot, Extra, Faults, HexaRobot, Port, PtyPort, Robot, UdpPort
from psiu_broker.simulator.port import Observer

FOR_EVER_S: Final = 1e9

_ASCII_ONLY: Final = ("name", "commands", "quirks", "per_unit_s", "wildcard_delay_s")
_HEXA_ONLY: Final = ("address", "topology", "size", "crc", "fragment", "nodes", "busy_s", "sensor_reply", "master")
_ONLY: Final[Mapping[str, tuple[str, ...]]] = {"psiu-ascii": _ASCII_ONLY, "psiu-hexa": _HEXA_ONLY}
_SPELLED: Final = {
    "commands": "--command", "quirks": "--quirk", "per_unit_s": "--per-unit", "wildcard_delay_s": "--wildcard-delay",
    "nodes": "--node", "busy_s": "--busy",
}  # fmt: skip
_CHANCE: Final = click.FloatRange(0, 1)
_SECONDS: Final = click.FloatRange(0)


class NamedNode(NamedTuple):
    """A node with its name and, for a sensor, the signal that it answers."""

    name: str
    node: Node
    signal: int

    @classmethod
    def parse(cls, text: str) -> "NamedNode":
        """Read ``garra=4:servo`` or ``sonar=7:distance=99``.

        Raises:
            ValueError: `text` is not of this form, or there is no such type.
        """
        match = re.fullmatch(r"(\w+)=(\w+):([\w-]+)(?:=(\w+))?", text)
        if match is None:
            raise ValueError(f"{text!r} is not NAME=NUMBER:TYPE[=SIGNAL], such as garra=4:servo")
        try:
            node = Node.model_validate({"node": number(match[2]), "type": match[3]})
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            raise ValueError(f"{text!r}: {first['loc'][0]}: {first['msg']}") from error
        return cls(match[1], node, number(match[4] or "42"))


def _silence(text: str) -> tuple[float, float]:
    start, colon, end = text.partition(":")
    try:
        return float(start), float(end if colon else "inf")
    except ValueError:
        raise ValueError(f"{text!r} is not FROM:UNTIL in seconds, such as 10:12.5") from None


def _list_quirks(ctx: click.Context, param: click.Parameter, wanted: bool) -> None:
    if wanted and not ctx.resilient_parsing:
        for name, text in QUIRKS.items():
            click.echo(f"{name:<15} {text}")
        ctx.exit()


@click.command(
    epilog=examples(
        "psiu sim --name MNERIM --pty /tmp/psiu-radio",
        "psiu sim --name BETA --udp 127.0.0.1:9001 --peer 127.0.0.1:9000",
        "psiu sim --name MNERIM --pty /tmp/psiu-radio --quirk crlf --quirk junk --loss 0.1",
        "psiu sim --name MNERIM --pty /tmp/psiu-radio --command distancia:0=42 --per-unit 0.01",
        "psiu sim --protocol psiu-hexa --address 0x12 --topology point-to-point \\",
        "         --pty /tmp/psiu-arm --node garra=4:servo --node sonar=7:distance=99",
        "psiu sim --protocol psiu-hexa --address 0x12 --rfcomm usb:0",
    )
)
@click.option("--protocol", type=click.Choice(list(CODECS)), default="psiu-ascii", show_default=True)
@click.option("--pty", type=click.Path(path_type=Path), help="Be a serial port of this name.")
@click.option("--udp", metavar="HOST:PORT", help="Be at this UDP port.")
@click.option("--peer", metavar="HOST:PORT", help="With --udp: greet the broker there, so that it knows the robot.")
@click.option("--rfcomm", metavar="HCI", help='Be a Bluetooth serial port on this controller, such as "usb:0".')
@click.option("--telemetry", "telemetry_s", metavar="SECONDS", type=_SECONDS, help="Speak unasked, so often.")
@click.option("--answer-after", "answer_s", metavar="SECONDS", type=_SECONDS, help="How long any answer takes.")
@click.option("--name", help="psiu-ascii: the robot's name.")
@click.option(
    "--command",
    "commands",
    metavar="NAME:INTS[,FLOATS[,CHARS]][=ANSWER]",
    callback=parsed(Extra.parse),
    multiple=True,
    help="psiu-ascii: one more command, its numbers of parameters, and what it answers.",
)
@click.option(
    "--quirk",
    "quirks",
    type=click.Choice(list(QUIRKS)),
    metavar="QUIRK",
    multiple=True,
    help="psiu-ascii: a fault of real firmware; see --list-quirks.",
)
@click.option(
    "--list-quirks",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_list_quirks,
    help="Say what each quirk does, and end.",
)
@click.option(
    "--per-unit",
    "per_unit_s",
    metavar="SECONDS",
    type=_SECONDS,
    help="psiu-ascii: how long a centimetre or a degree takes.",
)
@click.option(
    "--wildcard-delay",
    "wildcard_delay_s",
    metavar="SECONDS",
    type=_SECONDS,
    help="psiu-ascii: answer ?? after a random time up to this.",
)
@click.option("--address", metavar="NUMBER", callback=parsed(number), help="psiu-hexa: the robot's address, 0-255.")
@click.option(
    "--topology",
    type=click.Choice(["ad-hoc", "master-slave", "point-to-point"]),
    help="psiu-hexa: which addresses packets carry; usual: ad-hoc.",
)
@click.option(
    "--size", type=click.Choice(["nominal", "real"]), help="psiu-hexa: what the size byte counts; usual: nominal."
)
@click.option(
    "--crc",
    type=click.Choice(["smbus", "maxim-dow", "dvb-s2", "nrsc-5", "xor", "sum", "negsum", "none"]),
    help="psiu-hexa: how the check byte is made; usual: smbus.",
)
@click.option("--fragment", is_flag=True, default=None, help="psiu-hexa: break and rejoin long complex messages.")
@click.option(
    "--node",
    "nodes",
    metavar="NAME=NUMBER:TYPE[=SIGNAL]",
    callback=parsed(NamedNode.parse),
    multiple=True,
    help="psiu-hexa: a node; types as in the broker's configuration (servo, dc, on-off, distance, switch...)."
    " SIGNAL is what a sensor answers.",
)
@click.option("--busy", "busy_s", metavar="SECONDS", type=_SECONDS, help="psiu-hexa: be busy so long after a signal.")
@click.option(
    "--sensor-reply",
    type=click.Choice(["node-0", "bit7"]),
    help="psiu-hexa: how sensors mark an answer; usual: node-0.",
)
@click.option(
    "--master", metavar="NUMBER", callback=parsed(number), help="psiu-hexa: to whom it speaks unasked; usual: 0."
)
@click.option("--loss", metavar="CHANCE", type=_CHANCE, default=0.0, help="Lose messages, with this chance (0-1).")
@click.option("--corruption", metavar="CHANCE", type=_CHANCE, default=0.0, help="Flip a bit of a message.")
@click.option("--duplicate", metavar="CHANCE", type=_CHANCE, default=0.0, help="Double a message.")
@click.option("--delay", "delay_s", metavar="SECONDS", type=_SECONDS, default=0.0, help="Delay every message.")
@click.option("--jitter", "jitter_s", metavar="SECONDS", type=_SECONDS, default=0.0, help="... by up to so much more.")
@click.option(
    "--silence",
    "silences",
    metavar="FROM[:UNTIL]",
    callback=parsed(_silence),
    multiple=True,
    help="Nothing passes between these seconds since the start.",
)
@click.option("--byte-by-byte", "one_byte_at_a_time", is_flag=True, help="Send each byte by itself, 1 ms apart.")
@click.option("--seed", type=int, default=0, help="Another number, other luck.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON: an object a line.")
def sim(
    protocol: str,
    pty: Path | None,
    udp: str | None,
    peer: str | None,
    rfcomm: str | None,
    as_json: bool,
    seed: int,
    **options: Any,
) -> None:
    """Be a simulated robot of either protocol on a pseudo-terminal, on UDP or over Bluetooth, until Ctrl-C.

    Prints what the robot hears (<-), says (->) and does. Faults are those of the line, both ways; quirks are those of
    real firmware.
    """
    robot = _robot(protocol, options, seed)
    journal = Journal(robot, {each.node.node: (each.name, each.node) for each in options["nodes"]}, as_json)
    fault_names = ("loss", "corruption", "duplicate", "delay_s", "jitter_s", "silences", "one_byte_at_a_time")
    try:
        faults = Faults(**{name: options[name] for name in fault_names}, seed=seed)
        port, where = _port(robot, pty, udp, peer, rfcomm, faults, journal.observe)
    except ValueError as error:
        raise click.UsageError(str(error)) from error
    asyncio.run(_be(port, where, journal))


def _robot(protocol: str, options: dict[str, Any], seed: int) -> Robot:
    other = next(each for each in _ONLY if each != protocol)
    mine, others = _ONLY[protocol], _ONLY[other]
    for name in others:
        if options[name] not in (None, ()):
            raise click.UsageError(f"{_spelled(name)} is an option of {other}; add --protocol {other}")
    given = {name: options[name] for name in (*mine, "telemetry_s", "answer_s") if options[name] not in (None, ())}
    identity = mine[0]
    if identity not in given:
        raise click.UsageError(f"{_spelled(identity)} is missing: who is the robot?")
    try:
        return _hexa(given) if protocol == "psiu-hexa" else _ascii(given, seed)
    except ValueError as error:
        raise click.UsageError(str(error)) from error


def _ascii(given: dict[str, Any], seed: int) -> AsciiRobot:
    extras: Sequence[Extra] = given.pop("commands", ())
    return AsciiRobot(given.pop("name"), extras=extras, seed=seed, **given)


def _hexa(given: dict[str, Any]) -> HexaRobot:
    nodes: Sequence[NamedNode] = given.pop("nodes", ())
    if nodes:
        given["actuators"] = [each.node.node for each in nodes if each.node.is_actuator]
        given["sensors"] = {each.node.node: each.signal for each in nodes if not each.node.is_actuator}
    return HexaRobot(given.pop("address"), **given)


def _port(
    robot: Robot,
    pty: Path | None,
    udp: str | None,
    peer: str | None,
    rfcomm: str | None,
    faults: Faults,
    observer: Observer,
) -> tuple[Port, str]:
    """The robot's connection and where to find it, in words."""
    if [pty, udp, rfcomm].count(None) != 2:
        raise click.UsageError("where is the robot? Give one of --pty PATH, --udp HOST:PORT and --rfcomm HCI")
    if peer is not None and udp is None:
        raise click.UsageError("--peer is for --udp")
    if pty is not None:
        return PtyPort(robot, link=pty, faults=faults, observer=observer), str(pty)
    if udp is not None:
        return UdpPort(robot, listen=udp, peer=peer, faults=faults, observer=observer), f"UDP {udp}"
    try:
        bluetooth = import_module("psiu_broker.simulator.rfcomm")
    except ImportError as error:
        raise Failure(str(error)) from error
    port: Port = bluetooth.RfcommPort(robot, hci=rfcomm, faults=faults, observer=observer)
    return port, f"Bluetooth controller {rfcomm}"


async def _be(port: Port, where: str, journal: Journal) -> None:
    loop = asyncio.get_running_loop()
    for each in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(each, journal.ended.set)
    try:
        await port.open()
    except Exception as error:  # bumble raises anything for a controller that is not there
        reason = str(error) or type(error).__name__
        raise Failure(f"{where}: {reason}") from error
    journal.ready(port.address if isinstance(port, UdpPort) else where)
    telling = asyncio.create_task(port.until(journal.look, FOR_EVER_S))
    try:
        await journal.ended.wait()
    finally:
        telling.cancel()
        await port.close()


def _spelled(name: str) -> str:
    return _SPELLED.get(name, f"--{name.replace('_', '-')}")

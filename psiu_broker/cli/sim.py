"""`psiu sim`: a simulated robot, to try the broker and one's own programs with."""

import asyncio
import signal
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import click

from psiu_broker.cli.by_protocol import ByProtocol, offered
from psiu_broker.cli.commands import Failure, examples, parsed
from psiu_broker.cli.sim_journal import Journal
from psiu_broker.cli.simulated import OFFERS, SIMULATED, Cast, cast
from psiu_broker.simulator import Faults, Port, PtyPort, UdpPort
from psiu_broker.simulator.port import Observer

FOR_EVER_S: Final = 1e9
LOOK_S: Final = 0.05
"""How often what moves by itself is looked at."""

_CHANCE: Final = click.FloatRange(0, 1)
_SECONDS: Final = click.FloatRange(0)


def _silence(text: str) -> tuple[float, float]:
    start, colon, end = text.partition(":")
    try:
        return float(start), float(end if colon else "inf")
    except ValueError:
        raise ValueError(f"{text!r} is not FROM:UNTIL in seconds, such as 10:12.5") from None


@click.command(
    cls=ByProtocol,
    offers=OFFERS,
    epilog=examples(
        "psiu sim --name MNERIM --pty /tmp/psiu-radio",
        "psiu sim --name BETA --udp 127.0.0.1:9001 --peer 127.0.0.1:9000",
        "psiu sim --name MNERIM --pty /tmp/psiu-radio --quirk crlf --quirk junk --loss 0.1",
        "psiu sim --name MNERIM --pty /tmp/psiu-radio --command distancia:0=42 --per-unit 0.01",
        "psiu sim --protocol psiu-hexa --address 0x12 --topology point-to-point \\",
        "         --pty /tmp/psiu-arm --node garra=4:servo --node sonar=7:distance=99",
        "psiu sim --protocol psiu-hexa --address 0x12 --rfcomm usb:0",
        "psiu sim --protocol mitya --version 2013 --pty /tmp/corpo",
        "psiu sim --protocol mitya --udp 127.0.0.1:51974",
        "psiu sim --protocol soccer --preset mirosot --pty /tmp/campo",
        "psiu sim --protocol firmata --pty /tmp/uno --pin A0=100:900 --pin 7=1",
        "psiu sim --protocol amarino --pty /tmp/lampada --function b=",
    ),
)
@click.option("--protocol", type=click.Choice(list(SIMULATED)), default="psiu-ascii", show_default=True)
@click.option("--pty", type=click.Path(path_type=Path), help="Be a serial port of this name.")
@click.option("--udp", metavar="HOST:PORT", help="Be at this UDP port.")
@click.option("--peer", metavar="HOST:PORT", help="With --udp: greet the broker there, so that it knows the robot.")
@click.option("--rfcomm", metavar="HCI", help='Be a Bluetooth serial port on this controller, such as "usb:0".')
@offered(OFFERS)
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
    """Be a simulated robot on a pseudo-terminal, on UDP or over Bluetooth, until Ctrl-C.

    Prints what the robot hears (<-), says (->) and does. Faults are those of the line, both ways; quirks are those of
    real firmware. Robots of a soccer team and boards with Firmata are told the same again and again: what is the same
    as before is counted only, except with --json.
    """
    played = cast(protocol, options, seed=seed, datagrams=udp is not None)
    journal = Journal(played, as_json)
    fault_names = ("loss", "corruption", "duplicate", "delay_s", "jitter_s", "silences", "one_byte_at_a_time")
    try:
        faults = Faults(**{name: options[name] for name in fault_names}, seed=seed)
        port, where = _port(played, pty, udp, peer, rfcomm, faults, journal.observe)
    except ValueError as error:
        raise click.UsageError(str(error)) from error
    asyncio.run(_be(port, where, journal, played))


def _port(
    played: Cast,
    pty: Path | None,
    udp: str | None,
    peer: str | None,
    rfcomm: str | None,
    faults: Faults,
    observer: Observer,
) -> tuple[Port, str]:
    """The robots' connection and where to find it, in words."""
    if [pty, udp, rfcomm].count(None) != 2:
        raise click.UsageError("where is the robot? Give one of --pty PATH, --udp HOST:PORT and --rfcomm HCI")
    if peer is not None and udp is None:
        raise click.UsageError("--peer is for --udp")
    if pty is not None:
        return PtyPort(*played.robots, link=pty, faults=faults, observer=observer), str(pty)
    if udp is not None:
        return UdpPort(*played.robots, listen=udp, peer=peer, faults=faults, observer=observer), f"UDP {udp}"
    try:
        bluetooth = import_module("psiu_broker.simulator.rfcomm")
    except ImportError as error:
        raise Failure(str(error)) from error
    port: Port = bluetooth.RfcommPort(*played.robots, hci=rfcomm, faults=faults, observer=observer)
    return port, f"Bluetooth controller {rfcomm}"


async def _be(port: Port, where: str, journal: Journal, played: Cast) -> None:
    loop = asyncio.get_running_loop()
    for each in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(each, journal.ended.set)
    try:
        await port.open()
    except Exception as error:  # bumble raises anything for a controller that is not there
        reason = str(error) or type(error).__name__
        raise Failure(f"{where}: {reason}") from error
    journal.ready(port.address if isinstance(port, UdpPort) else where)
    telling = [asyncio.create_task(port.until(journal.look, FOR_EVER_S))]
    if played.moves:
        telling.append(asyncio.create_task(_move(played, journal)))
    try:
        await journal.ended.wait()
    finally:
        for task in telling:
            task.cancel()
        await port.close()


async def _move(played: Cast, journal: Journal) -> None:
    while True:
        await asyncio.sleep(LOOK_S)
        for robot in played.robots:
            robot.advance(asyncio.get_running_loop().time())
        journal.look()

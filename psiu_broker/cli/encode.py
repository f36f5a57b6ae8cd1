"""`psiu encode`: the bytes of a frame."""

import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import click

from psiu_broker.cli.commands import Failure, WordsCommand, examples
from psiu_broker.cli.output import print_json, printable
from psiu_broker.cli.protocol_options import codec_options, given, protocol_options
from psiu_broker.codecs import psiu_ascii, psiu_hexa
from psiu_broker.codecs.codec import Directory
from psiu_broker.errors import EncodeError
from psiu_broker.frame import Address, Frame
from psiu_broker.profiles import hexa
from psiu_broker.protocols import CODECS

_BYTES: Final[Mapping[str, int]] = {
    "ack": hexa.ACK, "nak": hexa.NAK, "busy": hexa.BUSY,
    "available": hexa.AVAILABLE, "free": hexa.FREE, "wtf": hexa.WTF,
}  # fmt: skip


@click.command(
    cls=WordsCommand,
    epilog=examples(
        "psiu encode MNERIM parafrente 100",
        "psiu encode '??' qualseunome --from PC --binary > /dev/ttyUSB0",
        "psiu encode --protocol psiu-hexa --from 1 --to 2 ping",
        "psiu encode --protocol psiu-hexa --to 0x12 node 4 63",
        "psiu encode --protocol psiu-hexa --topology point-to-point complex 0102 ff",
    ),
)
@click.argument("words", metavar="[DESTINATION] WORD...", nargs=-1, required=True)
@click.option("--protocol", type=click.Choice(list(CODECS)), default="psiu-ascii", show_default=True)
@click.option("--from", "source", help="Who sends it.  [default: PC, or 0]")
@click.option("--to", "destination", help="psiu-hexa: the address that it is for.")
@click.option("--binary", is_flag=True, help="Print the bytes themselves.")
@protocol_options
@click.option("--json", "as_json", is_flag=True, help="Print JSON: an object with the bytes in hexadecimal.")
def encode(
    words: tuple[str, ...],
    protocol: str,
    source: str | None,
    destination: str | None,
    binary: bool,
    as_json: bool,
    **options: Any,
) -> None:
    """Encode a frame.

    PSIU ASCII: the DESTINATION, a command and its parameters; printed as text. PSIU HEXA: ping, ack, nak, busy,
    available, free, wtf, command BYTE, node NODE SIGNAL, or complex HEX...; printed in hexadecimal.
    """
    chosen = given(options)
    codec = CODECS[protocol](codec_options(protocol, chosen), Directory())
    frame = _FRAMES[protocol](words, source, destination, chosen)
    try:
        wire = codec.encode(frame)
    except EncodeError as error:
        raise Failure(str(error)) from error
    if as_json:
        print_json({"protocol": protocol, "wire": wire.hex(), "size": len(wire)})
    elif binary:
        sys.stdout.buffer.write(wire)
        sys.stdout.flush()
    else:
        click.echo(printable(wire.decode("ascii").rstrip("\r\n")) if protocol == "psiu-ascii" else wire.hex(" "))


def _message(words: Sequence[str], source: str | None, destination: str | None, options: Mapping[str, Any]) -> Frame:
    if destination is not None:
        raise click.UsageError("--to is an option of psiu-hexa; write the destination before the command")
    if len(words) < 2:
        raise click.UsageError("write the destination and then the command, such as: MNERIM parafrente 100")
    return psiu_ascii.message(Address.named(source or "PC"), Address.named(words[0]), *words[1:])


def _packet(words: Sequence[str], source: str | None, destination: str | None, options: Mapping[str, Any]) -> Frame:
    domain = options.get("domain", "")
    if destination is None and options.get("topology") != "point-to-point":
        raise click.UsageError("--to is missing: the address of the robot, such as --to 0x12")
    whom = _address(destination or str(options.get("remote", 0)), domain)
    return psiu_hexa.packet(_address(source or "0", domain), whom, _payload(words))


_FRAMES: Final[Mapping[str, Callable[..., Frame]]] = {"psiu-ascii": _message, "psiu-hexa": _packet}


def _address(text: str, domain: str) -> Address:
    return Address.numbered(_number(text, 0, 255, "an address"), domain)


def _payload(words: Sequence[str]) -> bytes:
    match words:
        case ["ping"]:
            return b""
        case [name] if name in _BYTES:
            return bytes((_BYTES[name],))
        case ["command", byte]:
            return bytes((_number(byte, 0, 255, "a command"),))
        case ["node", node, signal]:
            return bytes((_number(node, 0, 255, "a node"), _number(signal, -128, 255, "a signal") & 0xFF))
        case ["complex", first, *rest]:
            try:
                return psiu_hexa.join_fields([bytes.fromhex(each.removeprefix("0x")) for each in (first, *rest)])
            except ValueError:
                raise click.UsageError(f"complex takes fields in hexadecimal, not {' '.join(words[1:])}") from None
            except EncodeError as error:
                raise Failure(str(error)) from error
        case _:
            forms = f"ping, {', '.join(_BYTES)}, command BYTE, node NODE SIGNAL or complex HEX..."
            raise click.UsageError(f"expected {forms}, not {' '.join(words)}")


def _number(text: str, least: int, most: int, what: str) -> int:
    try:
        number = int(text, 0)
    except ValueError:
        number = most + 1
    if not least <= number <= most:
        raise click.UsageError(f"{what} is a number {least}–{most}, such as {max(least, 1)} or 0x12, not {text}")
    return number

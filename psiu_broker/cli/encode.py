"""`psiu encode`: the bytes of a frame."""

import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple, cast

import click

from psiu_broker.cli.by_protocol import ByProtocol
from psiu_broker.cli.commands import Failure, WordsCommand, examples
from psiu_broker.cli.output import print_json, printable
from psiu_broker.cli.protocol_options import CODEC_OFFERS, codec_options, protocol_options
from psiu_broker.codecs import amarino, firmata, psiu_ascii, psiu_hexa
from psiu_broker.codecs.codec import Codec, Directory
from psiu_broker.codecs.soccer import BYTES, WHEELS, Soccer
from psiu_broker.errors import CallError, EncodeError
from psiu_broker.frame import NOBODY, Address, Frame
from psiu_broker.messages import Value
from psiu_broker.profiles import Request, hexa
from psiu_broker.profiles.psiu import typed
from psiu_broker.protocols import CODECS, PROTOCOLS

_BYTES: Final[Mapping[str, int]] = {
    "ack": hexa.ACK, "nak": hexa.NAK, "busy": hexa.BUSY,
    "available": hexa.AVAILABLE, "free": hexa.FREE, "wtf": hexa.WTF,
}  # fmt: skip
_TEXTS: Final = frozenset({"psiu-ascii", "mitya"})
"""Whose bytes a person reads and types as text."""
_WITH_SOURCE: Final = ("psiu-ascii", "psiu-hexa")
_WITH_DESTINATION: Final = ("psiu-hexa", "soccer")
_HEX: Final = "hex"


class Encode(ByProtocol, WordsCommand):
    """Its words may be negative numbers, and its options are told protocol by protocol."""


@click.command(
    cls=Encode,
    offers=CODEC_OFFERS,
    epilog=examples(
        "psiu encode MNERIM parafrente 100",
        "psiu encode '??' qualseunome --from PC --binary > /dev/ttyUSB0",
        "psiu encode --protocol psiu-hexa --from 1 --to 2 ping",
        "psiu encode --protocol psiu-hexa --to 0x12 node 4 63",
        "psiu encode --protocol psiu-hexa --topology point-to-point complex 0102 ff",
        "psiu encode --protocol mitya D -100",
        "psiu encode --protocol soccer --to 1 rodas 15 -31",
        "psiu encode --protocol soccer --preset mirosot 1:15,-31 2:0,0 3:31,31",
        "psiu encode --protocol firmata mode 13 output",
        "psiu encode --protocol amarino A 180 45",
    ),
)
@click.argument("words", metavar="[DESTINATION] WORD...", nargs=-1, required=True)
@click.option("--protocol", type=click.Choice(list(CODECS)), default="psiu-ascii", show_default=True)
@click.option("--from", "source", help="psiu-ascii, psiu-hexa: who sends it.  [default: PC, or 0]")
@click.option("--to", "destination", help="psiu-hexa, soccer: the robot that it is for, by its address.")
@click.option("--binary", is_flag=True, help="Print the bytes themselves.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON: an object with the bytes in hexadecimal.")
@protocol_options
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
    available, free, wtf, command BYTE, node NODE SIGNAL, or complex HEX...; printed in hexadecimal, as are the last
    three.

    Robot Mitya: a letter or command with its values, as in psiu call; printed as text. Soccer: the same for the robot
    --to whom it is, all others stopping, or ROBOT:VALUE,VALUE for each. Firmata: digital, analog, mode, state or text,
    as in psiu call, or hex HEX... Amarino: a FLAG and its values, the text of a board, or hex HEX...
    """
    if source is not None and protocol not in _WITH_SOURCE:
        raise click.UsageError(f"--from is an option of {' and '.join(_WITH_SOURCE)}: {protocol} tells no sender")
    if destination is not None and protocol not in _WITH_DESTINATION:
        spelled = "; write the destination before the command" if protocol == "psiu-ascii" else ""
        raise click.UsageError(f"--to is an option of {' and '.join(_WITH_DESTINATION)}{spelled}")
    chosen = codec_options(protocol, options)
    codec = CODECS[protocol](chosen, Directory())
    try:
        wire = _WIRES.get(protocol, _told)(_Wanted(protocol, words, source, destination, chosen, codec))
    except EncodeError as error:
        raise Failure(str(error)) from error
    except CallError as error:
        raise click.UsageError(str(error)) from error
    if as_json:
        print_json({"protocol": protocol, "wire": wire.hex(), "size": len(wire)})
    elif binary:
        sys.stdout.buffer.write(wire)
        sys.stdout.flush()
    else:
        click.echo(printable(wire.decode("ascii").rstrip("\r\n")) if protocol in _TEXTS else wire.hex(" "))


class _Wanted(NamedTuple):
    """What the user asked for."""

    protocol: str
    words: Sequence[str]
    source: str | None
    destination: str | None
    options: Any
    codec: Codec

    def request(self, command: str, parameters: Sequence[str]) -> Request:
        """The call as the protocol's own robots understand it.

        Raises:
            CallError: they would not.
        """
        profile = PROTOCOLS[self.protocol].profile
        robot = profile.Options.model_validate(_ROBOTS.get(self.protocol, {}))
        values: list[Value] = [typed(word) for word in parameters]
        return profile.make(self.options, robot, 1.0).request(command, values)

    def frame(self, subject: str, payload: bytes, destination: Address = NOBODY) -> Frame:
        return Frame(NOBODY, destination, subject, payload, self.protocol)


_ROBOTS: Final[Mapping[str, Mapping[str, Any]]] = {"firmata": {"confirm": False}}
"""What a robot is taken for of which nothing is known."""


def _told(wanted: _Wanted) -> bytes:
    """What a call is on the wire, all of it."""
    command, *parameters = wanted.words
    request = wanted.request(command, parameters)
    if request.procedure is not None:
        steps = request.procedure.steps
        return b"".join(wanted.codec.encode(wanted.frame(step.subject, step.payload)) for step in steps)
    return wanted.codec.encode(wanted.frame(request.subject, request.payload))


def _message(wanted: _Wanted) -> bytes:
    words = wanted.words
    if len(words) < 2:
        raise click.UsageError("write the destination and then the command, such as: MNERIM parafrente 100")
    source = Address.named(wanted.source or "PC")
    return wanted.codec.encode(psiu_ascii.message(source, Address.named(words[0]), *words[1:]))


def _packet(wanted: _Wanted) -> bytes:
    options = wanted.options
    if wanted.destination is None and options.topology != "point-to-point":
        raise click.UsageError("--to is missing: the address of the robot, such as --to 0x12")
    remote = options.remote or 0
    whom = _address(wanted.destination or str(remote), options.domain)
    return wanted.codec.encode(
        psiu_hexa.packet(_address(wanted.source or "0", options.domain), whom, _payload(wanted.words))
    )


def _team(wanted: _Wanted) -> bytes:
    """One robot's set-point and a stop for the others, or the set-points of several."""
    codec = cast(Soccer, wanted.codec)
    if wanted.destination is not None:
        number = _number(wanted.destination, 1, codec.robots, "a robot of this team")
        command, *parameters = wanted.words
        request = wanted.request(command, parameters)
        return codec.encode(wanted.frame(request.subject, request.payload, Address.numbered(number)))
    shares = [codec.rest.stop] * codec.robots
    words = wanted.words[1:] if wanted.words[0] in (WHEELS, BYTES) else wanted.words
    for word in words:
        robot, colon, values = word.partition(":")
        if not colon:
            hint = "--to 1 rodas 15 -31, or 1:15,-31 2:0,0 for several at once"
            raise click.UsageError(f"{word} is for no robot, which are counted from 1; write {hint}")
        number = _number(robot, 1, codec.robots, "a robot of this team")
        command = BYTES if values.startswith("0x") else WHEELS
        shares[number - 1] = wanted.request(command, values.split(",")).payload
    return codec.packet(shares)


def _firmata(wanted: _Wanted) -> bytes:
    options = wanted.options
    if wanted.words[0] == _HEX:
        return wanted.codec.encode(firmata.message(_hexadecimal(wanted.words[1:]), options.role))
    if options.role == "board":
        raise click.UsageError("what a board says is written in hexadecimal: hex e0 7f 07")
    return _told(wanted)


def _amarino(wanted: _Wanted) -> bytes:
    options, words = wanted.options, wanted.words
    payload: bytes | None = _hexadecimal(words[1:]) if words[0] == _HEX else None
    if options.role == "board":
        if payload is None:
            try:
                payload = amarino.values_text([typed(word) for word in words]).encode()
            except ValueError as error:
                raise click.UsageError(str(error)) from error
        return wanted.codec.encode(wanted.frame(amarino.TEXT, payload))
    if payload is None:
        return _told(wanted if words[0] == "send" else wanted._replace(words=("send", *words)))
    return wanted.codec.encode(wanted.frame(amarino.FLAG + _HEX, payload))


_WIRES: Final[Mapping[str, Callable[[_Wanted], bytes]]] = {
    "psiu-ascii": _message,
    "psiu-hexa": _packet,
    "soccer": _team,
    "firmata": _firmata,
    "amarino": _amarino,
}
"""Where the words are more, or other ones, than those of a call."""


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


def _hexadecimal(words: Sequence[str]) -> bytes:
    try:
        return bytes.fromhex("".join(word.removeprefix("0x") for word in words))
    except ValueError:
        raise click.UsageError(f"{' '.join(words)} is not hexadecimal, such as e0 7f 07") from None


def _number(text: str, least: int, most: int, what: str) -> int:
    try:
        number = int(text, 0)
    except ValueError:
        number = most + 1
    if not least <= number <= most:
        example = f", such as {max(least, 1)} or 0x12" if most > 0x12 else ""
        raise click.UsageError(f"{what} is a number {least}–{most}{example}, not {text}")
    return number

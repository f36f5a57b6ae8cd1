"""`psiu decode`: the frames in some bytes, and why the rest is none."""

import io
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple, cast, get_args

import click
from pydantic import BaseModel

from psiu_broker.cli.by_protocol import ByProtocol
from psiu_broker.cli.commands import examples
from psiu_broker.cli.lines import frame_words
from psiu_broker.cli.output import print_line, printable, styled
from psiu_broker.cli.protocol_options import CODEC_OFFERS, codec_options, protocol_options
from psiu_broker.codecs.codec import Directory, Event
from psiu_broker.frame import NOBODY, Frame, Malformed
from psiu_broker.profiles import Description, Profile
from psiu_broker.profiles.describe import describe
from psiu_broker.protocols import CODECS, PROTOCOLS

FOUND_WRONG: Final = 1
"""The exit code where something was no frame."""

_READ_BYTES: Final = 65536
_SEPARATORS: Final = re.compile(r"0x|[\s:,]+", re.IGNORECASE)
_CHECKED: Final = ("psiu-ascii", "psiu-hexa")
"""Whose frames are told from chance by a check."""


@click.command(
    cls=ByProtocol,
    offers=CODEC_OFFERS,
    epilog=examples(
        "psiu decode 4d4e4552494d 20303334 20706172616672656e74652031303020504320 3032313233",
        "printf 'MNERIM 034 parafrente 100 PC 02123' | psiu decode --binary",
        "psiu decode --protocol psiu-hexa --topology point-to-point 05 41 c0",
        "psiu decode --protocol psiu-ascii --binary - < /dev/ttyUSB0",
        "printf 'G0064#0000' | psiu decode --protocol mitya --version 2013 --binary",
        "psiu decode --protocol soccer aa 3e81 0303 fc7e 55",
        "psiu decode --protocol firmata --role board f4 0d 01 f5 0d 01",
    ),
)
@click.argument("text", metavar="[HEX|-]...", nargs=-1)
@click.option("--protocol", type=click.Choice(list(CODECS)), help="Left out: the one that fits best is told.")
@click.option("--binary", is_flag=True, help="Standard input is the bytes themselves, not hexadecimal text.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON: an object a line.")
@protocol_options
def decode(text: tuple[str, ...], protocol: str | None, binary: bool, as_json: bool, **options: Any) -> None:
    """Decode bytes into frames.

    The bytes are HEX (spaces, colons and 0x are skipped) or come from standard input. With --protocol they are
    decoded as they arrive. Any PSIU HEXA address is taken for a robot's.

    Without --protocol the one that leaves the fewest bytes over is told. PSIU is told where another fits as well: its
    frames carry a check. Without one, half of the bytes at least must be frames.

    The exit code is 0 if all of them were frames, else 1.
    """
    pieces = _pieces(text, binary)
    if protocol is None:
        told = _guessed(b"".join(pieces), options)
    else:
        reader = _Reader.of(protocol, codec_options(protocol, options))
        told = ((reader, event) for event in reader.events(pieces))
    frames = wrong = 0
    for spoken, event in told:
        if isinstance(event, Frame):
            frames += 1
        else:
            wrong += 1
        if as_json:
            print_line(spoken.described(event) if isinstance(event, Frame) else _malformed(event, spoken.protocol))
        else:
            click.echo(_line(event, spoken))
    if wrong or not frames:
        if not wrong and not as_json:
            click.echo("there are no bytes", err=True)
        click.get_current_context().exit(FOUND_WRONG)


class _Reader(NamedTuple):
    """One protocol, as bytes are read in it."""

    protocol: str
    options: BaseModel
    profile: Profile

    @classmethod
    def of(cls, protocol: str, options: BaseModel) -> "_Reader":
        profile = PROTOCOLS[protocol].profile
        return cls(protocol, options, profile.make(options, profile.Options(), 1.0))

    def events(self, pieces: Iterable[bytes]) -> Iterator[Event]:
        codec = CODECS[self.protocol](self.options, Directory(numbers=set(range(256))))
        for piece in pieces:
            yield from codec.decode(piece, 0.0)
        yield from codec.flush(0.0)

    def described(self, frame: Frame) -> dict[str, Any]:
        checked = self.protocol in _CHECKED
        said = describe(frame, lambda _: {}) if checked else {**_NOTHING, **self.profile.describe(frame)}
        return {
            "protocol": frame.protocol,
            "source": str(frame.source),
            "destination": str(frame.destination),
            **said,
            "wire": frame.wire.hex(),
        }


_NOTHING: Final = Description(
    kind="command", command=None, parameters=[], status=None, node=None, signal=None, value=None, unit=None,
    fields=None, readings={}, remark=None,
)  # fmt: skip
"""What a frame says that says nothing."""


def _pieces(text: Sequence[str], binary: bool) -> Iterable[bytes]:
    """The bytes that the user gave, in the pieces in which they come."""
    if list(text) not in ([], ["-"]):
        if binary:
            raise click.UsageError("--binary is for standard input")
        return [_bytes(" ".join(text))]
    if binary:
        stdin = cast(io.BufferedReader, sys.stdin.buffer)
        return iter(lambda: stdin.read1(_READ_BYTES), b"")
    return [_bytes(sys.stdin.buffer.read().decode("ascii", "replace"))]


def _bytes(text: str) -> bytes:
    try:
        return bytes.fromhex(_SEPARATORS.sub("", text))
    except ValueError:
        hint = "decode text with: printf 'TEXT' | psiu decode --binary"
        raise click.UsageError(f"{printable(text.strip())[:60]!r} is not hexadecimal; {hint}") from None


def _guessed(data: bytes, options: Mapping[str, Any]) -> Iterable[tuple[_Reader, Event]]:
    """The events of the protocols that leave the fewest bytes over; those of PSIU where none finds a frame."""
    tried = [(reader, list(reader.events([data]))) for reader in _readers(options)]
    if not tried:
        raise click.UsageError("no protocol has all these options; choose one with --protocol")
    fitting = [(reader, found) for reader, found in tried if _fits(reader.protocol, found, data)]
    least = min((_left(found) for _, found in fitting), default=0)
    best = [(reader, found) for reader, found in fitting if _left(found) == least]
    best = best or tried
    checked = [(reader, found) for reader, found in best if reader.protocol in _CHECKED]
    return [(reader, event) for reader, found in checked or best[:1] for event in found]


def _readers(options: Mapping[str, Any]) -> Iterator[_Reader]:
    """Each protocol that has the `options` that were given, in each role that one can have there."""
    for protocol, codec in CODECS.items():
        role = codec.Options.model_fields.get("role")
        roles = [] if role is None or options.get("role") is not None else get_args(role.annotation)
        for more in [{"role": each} for each in roles] or [{}]:
            try:
                yield _Reader.of(protocol, codec_options(protocol, {**options, **more}))
            except click.UsageError:
                continue  # the options are those of another


def _fits(protocol: str, events: Iterable[Event], data: bytes) -> bool:
    events = list(events)
    found = any(isinstance(event, Frame) for event in events)
    return found and (protocol in _CHECKED or 2 * _left(events) <= len(data))


def _left(events: Iterable[Event]) -> int:
    return sum(event.size for event in events if isinstance(event, Malformed))


def _malformed(malformed: Malformed, protocol: str) -> dict[str, Any]:
    return {
        "protocol": protocol,
        "malformed": malformed.reason,
        "size": malformed.size,
        "wire": malformed.wire.hex(),
    }


def _line(event: Event, reader: _Reader) -> str:
    if isinstance(event, Frame):
        named = event.source != NOBODY or event.destination != NOBODY
        pair = printable(f"{str(event.source) or '?'} → {str(event.destination) or '?'}") + "  " if named else ""
        return f"{reader.protocol}  {pair}{styled(frame_words(reader.described(event)), bold=True)}"
    more = "…" if event.size > len(event.wire) else ""
    said = f" {event.wire.decode('ascii')!r}" if event.wire.isascii() and event.wire.decode().isprintable() else ""
    reason = styled(f"no frame ({event.reason})", fg="red")
    return f"{reader.protocol}  {reason}  {event.size} bytes: {event.wire.hex()}{more}{said}"

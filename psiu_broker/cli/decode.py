"""`psiu decode`: the frames in some bytes, and why the rest is none."""

import io
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final, cast

import click

from psiu_broker.cli.commands import examples
from psiu_broker.cli.lines import frame_words
from psiu_broker.cli.output import print_line, printable, styled
from psiu_broker.cli.protocol_options import codec_options, given, protocol_options
from psiu_broker.codecs.codec import Codec, Directory, Event
from psiu_broker.frame import Frame, Malformed
from psiu_broker.profiles.describe import describe
from psiu_broker.protocols import CODECS

FOUND_WRONG: Final = 1
"""The exit code where something was no frame."""

_READ_BYTES: Final = 65536
_SEPARATORS: Final = re.compile(r"0x|[\s:,]+", re.IGNORECASE)


@click.command(
    epilog=examples(
        "psiu decode 4d4e4552494d 20303334 20706172616672656e74652031303020504320 3032313233",
        "printf 'MNERIM 034 parafrente 100 PC 02123' | psiu decode --binary",
        "psiu decode --protocol psiu-hexa --topology point-to-point 05 41 c0",
        "psiu decode --protocol psiu-ascii --binary - < /dev/ttyUSB0",
    )
)
@click.argument("text", metavar="[HEX|-]...", nargs=-1)
@click.option("--protocol", type=click.Choice(list(CODECS)), help="Left out: the one that fits best is told.")
@click.option("--binary", is_flag=True, help="Standard input is the bytes themselves, not hexadecimal text.")
@protocol_options
@click.option("--json", "as_json", is_flag=True, help="Print JSON: an object a line.")
def decode(text: tuple[str, ...], protocol: str | None, binary: bool, as_json: bool, **options: Any) -> None:
    """Decode bytes into frames.

    The bytes are HEX (spaces, colons and 0x are skipped) or come from standard input. With --protocol they are
    decoded as they arrive. Any PSIU HEXA address is taken for a robot's.

    The exit code is 0 if all of them were frames, else 1.
    """
    pieces = _pieces(text, binary)
    if protocol is None:
        told = _guessed(b"".join(pieces), given(options))
    else:
        told = ((protocol, event) for event in _events(_codec(protocol, given(options)), pieces))
    frames = wrong = 0
    for spoken, event in told:
        if isinstance(event, Frame):
            frames += 1
        else:
            wrong += 1
        if as_json:
            print_line(_frame(event) if isinstance(event, Frame) else _malformed(event, spoken))
        else:
            click.echo(_line(event, spoken))
    if wrong or not frames:
        if not wrong and not as_json:
            click.echo("there are no bytes", err=True)
        click.get_current_context().exit(FOUND_WRONG)


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


def _codec(protocol: str, options: Mapping[str, Any]) -> Codec:
    return CODECS[protocol](codec_options(protocol, options), Directory(numbers=set(range(256))))


def _events(codec: Codec, pieces: Iterable[bytes]) -> Iterator[Event]:
    for piece in pieces:
        yield from codec.decode(piece, 0.0)
    yield from codec.flush(0.0)


def _guessed(data: bytes, options: Mapping[str, Any]) -> Iterable[tuple[str, Event]]:
    """The events of the protocols that leave the fewest bytes over; all of them where none finds a frame."""
    tried: dict[str, list[Event]] = {}
    for protocol, codec in CODECS.items():
        if set(options) <= set(codec.Options.model_fields):
            tried[protocol] = list(_events(_codec(protocol, options), [data]))
    if not tried:
        raise click.UsageError("no protocol has all these options; choose one with --protocol")
    with_frames = {name: found for name, found in tried.items() if any(isinstance(event, Frame) for event in found)}
    left = {name: _left(found) for name, found in with_frames.items()}
    best = {name: found for name, found in with_frames.items() if left[name] == min(left.values())}
    return [(name, event) for name, found in (best or tried).items() for event in found]


def _left(events: Iterable[Event]) -> int:
    return sum(event.size for event in events if isinstance(event, Malformed))


def _frame(frame: Frame) -> dict[str, Any]:
    said = describe(frame, lambda _: {})
    return {
        "protocol": frame.protocol,
        "source": str(frame.source),
        "destination": str(frame.destination),
        **said,
        "wire": frame.wire.hex(),
    }


def _malformed(malformed: Malformed, protocol: str) -> dict[str, Any]:
    return {
        "protocol": protocol,
        "malformed": malformed.reason,
        "size": malformed.size,
        "wire": malformed.wire.hex(),
    }


def _line(event: Event, protocol: str) -> str:
    if isinstance(event, Frame):
        pair = printable(f"{event.source or '?'} → {event.destination or '?'}")
        return f"{protocol}  {pair}  {styled(frame_words(_frame(event)), bold=True)}"
    more = "…" if event.size > len(event.wire) else ""
    said = f" {event.wire.decode('ascii')!r}" if event.wire.isascii() and event.wire.decode().isprintable() else ""
    reason = styled(f"no frame ({event.reason})", fg="red")
    return f"{protocol}  {reason}  {event.size} bytes: {event.wire.hex()}{more}{said}"

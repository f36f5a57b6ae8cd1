"""Bytes made to be as dear as can be to each codec, for the bench of the costs and the test of how they grow."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle, islice
from typing import Any, Final

from psiu_broker.codecs.amarino import Amarino
from psiu_broker.codecs.checksums import CHECKS, byte_sum
from psiu_broker.codecs.codec import Codec, Directory
from psiu_broker.codecs.firmata import Firmata
from psiu_broker.codecs.mitya import Mitya
from psiu_broker.codecs.psiu_ascii import PsiuAscii
from psiu_broker.codecs.psiu_hexa import PsiuHexa
from psiu_broker.codecs.soccer import Soccer

NAMES: Final = {"MNERIM", "PC", "TEREZA"}
SPACED: Final = {"R2 D2", "a a", "x x x x"}


@dataclass(frozen=True)
class Craft:
    """A codec, and what is repeated to it."""

    name: str
    make: Callable[[], Codec]
    bait: bytes

    def of_size(self, size: int) -> bytes:
        """Exactly `size` bytes."""
        return bytes(islice(cycle(self.bait), size))


def ascii_frame(destination: bytes, words: bytes, source: bytes, *, size: int | None = None) -> bytes:
    """A frame of PSIU ASCII 1 whose checksum is right, and its size too unless given."""
    length = len(destination) + len(words) + len(source) + 12
    summed = b"%b %03d %b %b " % (destination, length if size is None else size, words, source)
    return b"%b%05d" % (summed, byte_sum(summed))


_ODD: Final = 40
"""So many fields of so many bytes each are more than any packet holds."""


def odd_finds(size: int) -> bytes:
    """A packet of PSIU HEXA begins with nearly each byte; many have a right check byte, and no fields that add up."""
    check = CHECKS["smbus"]
    assert check is not None
    made = bytearray(3)
    begins: dict[int, int] = {}
    sizes = cycle(range(_ODD, 60))
    while len(made) < size:
        begin = begins.pop(len(made), None)
        right = 0 if begin is None else check(bytes(made[begin:]))
        made.append(right if right >= _ODD else next(sizes))
        begin = len(made) - 3
        begins[begin + made[-1] - 1] = begin
    return bytes(made)


def _ascii(**options: Any) -> Callable[[], Codec]:
    return lambda: PsiuAscii(
        PsiuAscii.Options(**options), Directory(names=set(SPACED), all_names=NAMES | SPACED, numbers={1, 2})
    )


def _hexa(**options: Any) -> Callable[[], Codec]:
    return lambda: PsiuHexa(PsiuHexa.Options(**options), Directory(numbers=set(range(256))))


def _codec(kind: type[Any], **options: Any) -> Callable[[], Codec]:
    return lambda: kind(kind.Options(**options), Directory())


_FRAME: Final = ascii_frame(b"MNERIM", b"parafrente 100", b"PC")
_CLAIM: Final = b"A 999 "
_LONG: Final = ascii_frame(b"MNERIM", b"x " + b"a " * 480 + b"a", b"a")
_MANY_FITS: Final = _CLAIM + _FRAME * 23
_STARTS: Final = b"\xaa"

_ASCII_BAITS: Final[Mapping[str, bytes]] = {
    "frames": _FRAME,
    "lines": _FRAME + b"\r\n",
    "noise": b"x",
    "not printable": b"\xff",
    "in turns": b"x\xff",
    "line ends": b"\r\n",
    "spaces": b" ",
    "digits": b"0123456789",
    "zeros": b"0",
    "endings": b" 12345",
    "sizes": b" 999 ",
    "claims": b"A 999 B 998 ",
    "fits held back": _MANY_FITS,
    "loose frames": ascii_frame(b"MNERIM", b"p 1", b"PC", size=998),
    "long names": _LONG,
    "complaints": b"CHECKSUM NAO BATEU!",
    "half complaints": b"CHECKSUM NAO BATEU",
}

_HEXA_BAITS: Final[Mapping[str, bytes]] = {
    "packets": bytes((1, 2, 6, 4, 200, 0)),
    "pings": bytes((1, 2, 4, 0)),
    "noise": b"\xff",
    "zeros": b"\0",
    "longest everywhere": b"\xfe",
    "in turns": bytes((1, 255)),
    "shortest everywhere": b"\x04",
    "first pieces": bytes((1, 2, 255, 255, *([255] * 249), 0)),
    "long heads behind pings": bytes.fromhex("010204 5d 0102fe") + b"\xff" * 5,
}

CRAFTS: Final[Sequence[Craft]] = (
    *(Craft(f"psiu-ascii, {name}", _ascii(), bait) for name, bait in _ASCII_BAITS.items()),
    *(Craft(f"psiu-ascii 0.5, {name}", _ascii(version="0.5"), bait) for name, bait in _ASCII_BAITS.items()),
    *(
        Craft(f"psiu-ascii 0, {name}", _ascii(version="0"), _ASCII_BAITS[name])
        for name in ("frames", "digits", "endings")
    ),
    *(Craft(f"psiu-hexa, {name}", _hexa(fragment=True), bait) for name, bait in _HEXA_BAITS.items()),
    Craft("psiu-hexa, odd finds", _hexa(), odd_finds(16_000)),
    *(Craft(f"psiu-hexa none, {name}", _hexa(crc="none", size="real"), bait) for name, bait in _HEXA_BAITS.items()),
    Craft("psiu-hexa master-slave, longest everywhere", _hexa(topology="master-slave"), b"\xfe"),
    Craft("psiu-hexa point-to-point, noise", _hexa(topology="point-to-point"), b"\xfe"),
    Craft("mitya, messages", _codec(Mitya), b"D0064"),
    Craft("mitya, digits", _codec(Mitya), b"D"),
    Craft("mitya, cut messages", _codec(Mitya), b"L000"),
    Craft("mitya, noise", _codec(Mitya), b"!"),
    Craft("mitya, digits and noise", _codec(Mitya), b"DDDDDDDDDDDDDDDDDDDD!"),
    Craft("mitya, line ends", _codec(Mitya), b"\r\n"),
    Craft("mitya, shots", _codec(Mitya, version="2013"), b"f0001f0000"),
    Craft("soccer, packets", _codec(Soccer), bytes.fromhex("aa3e3efc7e030355")),
    Craft("soccer, start bytes", _codec(Soccer), _STARTS),
    Craft("soccer, noise", _codec(Soccer), b"\x00"),
    Craft(
        "soccer, start bytes of large packets",
        _codec(Soccer, robots=255, bytes_per_robot=64, byte_codec="raw"),
        _STARTS,
    ),
    Craft(
        "soccer, shares of one byte",
        _codec(Soccer, robots=255, bytes_per_robot=1, byte_codec="raw", trailer="none"),
        _STARTS,
    ),
    Craft("soccer, wrong shares", _codec(Soccer, robots=255, bytes_per_robot=1, trailer="none"), _STARTS),
    Craft("firmata, values", _codec(Firmata), bytes.fromhex("e07f07")),
    Craft("firmata, sysex", _codec(Firmata), bytes.fromhex("f0790201f7")),
    Craft("firmata, empty sysex", _codec(Firmata), bytes.fromhex("f0f7")),
    Craft("firmata, endless sysex", _codec(Firmata), b"\xf0" + b"\x01" * 5000),
    Craft("firmata, begun again", _codec(Firmata), b"\xf0"),
    Craft("firmata, noise", _codec(Firmata), b"\x01"),
    Craft("firmata, unknown", _codec(Firmata), b"\xff"),
    Craft("firmata, board", _codec(Firmata, role="board"), b"\xc0\x01\xff"),
    Craft("amarino, texts", _codec(Amarino), b"\x1221.50\x13"),
    Craft("amarino, begun again", _codec(Amarino), b"\x12"),
    Craft("amarino, ends", _codec(Amarino), b"\x13"),
    Craft("amarino, endless text", _codec(Amarino), b"\x12" + b"a" * 5000),
    Craft("amarino, noise", _codec(Amarino), b"a"),
    Craft("amarino, controls", _codec(Amarino), b"\x12\x1b"),
    Craft("amarino, messages of a phone", _codec(Amarino, role="board"), b"A180;45\x13"),
    Craft("amarino, alive", _codec(Amarino, role="board"), b"\x11\x13"),
    Craft("amarino, aborted", _codec(Amarino, role="board"), b"A\x1b"),
    Craft("amarino, marks of a phone", _codec(Amarino, role="board"), b"\x11"),
    Craft("amarino, flags too low", _codec(Amarino, role="board"), b"!\x13"),
)

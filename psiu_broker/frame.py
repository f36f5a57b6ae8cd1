"""The values that travel through the broker: addresses, frames, and bytes that were no frame."""

import re
from typing import Final, NamedTuple


class Address(NamedTuple):
    """Who a robot is: a name (PSIU ASCII) or a number 0–255 (PSIU HEXA) within a domain.

    Names are unique in the whole network; numbers only within their domain, so that two teams
    may both use 1–5. Make one with `named`, `numbered` or `parse`; `str()` is the inverse of
    `parse` (a *name* that looks like a number, such as ``0x12``, is the one exception).
    """

    name: str = ""
    number: int = -1
    domain: str = ""

    @classmethod
    def named(cls, name: str) -> "Address":
        return cls(name)

    @classmethod
    def numbered(cls, number: int, domain: str = "") -> "Address":
        return cls("", number, domain)

    @classmethod
    def parse(cls, text: str) -> "Address":
        """Read ``MNERIM``, ``0x12`` or ``red.0x03``."""
        match = _NUMBERED.fullmatch(text)
        if match is None:
            return cls(text)
        return cls("", int(match["number"], 16), match["domain"] or "")

    @property
    def is_numbered(self) -> bool:
        return self.number >= 0

    def __str__(self) -> str:
        if self.number < 0:
            return self.name
        return f"{self.domain}.0x{self.number:02x}" if self.domain else f"0x{self.number:02x}"


_NUMBERED: Final = re.compile(r"(?:(?P<domain>[A-Za-z0-9_-]+)\.)?0x(?P<number>[0-9A-Fa-f]{1,2})")

EVERYONE: Final = Address("??")
"""The destination of a question to every robot (PSIU, qualseunome)."""

NOBODY: Final = Address()
"""The source of a frame whose protocol names none."""


class Frame(NamedTuple):
    """One whole, checked packet, heard or to be sent.

    `payload` is what the protocol carries between the addresses: the words ``parafrente 100`` in
    PSIU ASCII, the carga in PSIU HEXA. `wire` and `dialect` are the bytes as they were heard and
    their exact form (``psiu-hexa/ad-hoc/nominal/smbus``); a frame of our own making has neither
    until a codec encodes it. `remark` says what a tolerant codec forgave.
    """

    source: Address
    destination: Address
    subject: str
    payload: bytes
    protocol: str
    wire: bytes = b""
    dialect: str = ""
    remark: str = ""


class Malformed(NamedTuple):
    """Bytes that were no frame, and why. `wire` is cut to `MALFORMED_KEPT` bytes; `size` is how many there were."""

    reason: str
    wire: bytes
    size: int


MALFORMED_KEPT: Final = 64

COMPLAINT: Final = "complaint"
"""The reason of a `Malformed` that is a robot's plain-text ``CHECKSUM NAO BATEU!``: its NAK."""


class Way(NamedTuple):
    """Where a frame came from or goes to: a link, and who on it (None where a link has one far end)."""

    link: str
    peer: object = None

    def __str__(self) -> str:
        return self.link if self.peer is None else f"{self.link}/{peer_text(self.peer)}"


MESH: Final = "@mesh"
"""The link, in ways and accounts, whose far ends are the other brokers, by name."""


def peer_text(peer: object) -> str | None:
    """A far end in words, as ``host:port`` over UDP; None where a link has only one."""
    match peer:
        case None:
            return None
        case (str(host), int(port), *_):
            return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        case _:
            return str(peer)

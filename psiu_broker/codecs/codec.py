"""What every codec is: bytes in, frames and malformed bytes out, and back; no I/O and no clock of its own."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from pydantic import BaseModel

from psiu_broker.frame import Frame, Malformed

Event = Frame | Malformed


@dataclass(slots=True)
class Directory:
    """The robots that the broker knows of now. Codecs only read it; it changes under them.

    `names` are those with spaces in them, to settle where such a name begins; `all_names` are all of them, our own
    too, to settle where the drafts of PSIU ASCII end one; `numbers` (of one domain) tells a found PSIU HEXA packet
    from noise whose CRC fits by luck.
    """

    names: set[str] = field(default_factory=set)
    all_names: set[str] = field(default_factory=set)
    numbers: set[int] = field(default_factory=set)


class Codec(ABC):
    """One stream's worth of one protocol. `now` is in seconds on any steady clock."""

    protocol: ClassVar[str]
    Options: ClassVar[type[BaseModel]]
    """What the user may write for this protocol in ``[links.NAME]``."""
    dialect: str
    """The exact form on the wire; a frame heard in the same dialect is forwarded as it came."""
    pending: bool = False
    """True while bytes wait for more."""
    silence_s: float
    """A silence this long ends whatever was begun: the link then calls `flush`."""
    paced: ClassVar[bool] = False
    """True where robots are told what to do at a fixed rate, all in one packet: see `paced.PacedCodec`."""
    addressed: bool = True
    """False: its packets name nobody, or only a number within the packet; the link knows who is at its ends."""
    remembers: ClassVar[bool] = False
    """True: what a datagram means depends on those before it, so that each far end needs a codec of its own."""

    @abstractmethod
    def __init__(self, options: Any, directory: Directory, *, datagrams: bool = False) -> None:
        """`options` is an instance of this class's `Options`; `datagrams`: each frame travels in one of its own."""

    def whole(self, data: bytes) -> Frame | None:
        """The frame, if `data` is exactly one, of a kind that this codec can tell at a glance; None: `decode` it.

        Only for when nothing is `pending`. What it tells is what `decode` would; it changes nothing.
        """
        return None

    @abstractmethod
    def decode(self, data: bytes, now: float) -> Sequence[Event]:
        """Take the next bytes of the stream; return what they complete, in order. Never raises."""

    @abstractmethod
    def flush(self, now: float) -> Sequence[Event]:
        """A boundary (silence, end of a datagram): give up or accept what is begun. Never raises."""

    @abstractmethod
    def encode(self, frame: Frame) -> bytes:
        """The bytes of `frame` in this dialect; `frame.wire` itself where it came in the same one.

        Raises:
            EncodeError: this protocol or dialect cannot say it.
        """

    def pieces(self, wire: bytes) -> Sequence[bytes]:
        """The datagrams that the bytes of one frame leave in, where they leave in datagrams."""
        return (wire,)

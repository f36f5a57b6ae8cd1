"""The lamp of a lab: 1 switches it on, 0 off, ? asks; to each, and when its button is pressed, it says 1 or 0.

How it is read. Each byte is a message; others are noise, in one piece until a message or a silence.
"""

import re
from collections.abc import Sequence
from typing import ClassVar, Final

from pydantic import BaseModel, ConfigDict, Field

from psiu_broker.codecs.codec import Codec, Directory, Event
from psiu_broker.codecs.noise import NOISE, Noise
from psiu_broker.errors import EncodeError
from psiu_broker.frame import NOBODY, Frame

PROTOCOL: Final = "lamp"

SAID: Final = "light"
"""The subject of what the lamp says."""
SWITCH: Final = "switch"
ASK: Final = "ask"
"""The subjects of what it is told."""

_PIECE: Final = re.compile(rb"[01]|[^01]+")


class Lamp(Codec):
    """One stream of a lamp's messages."""

    protocol: ClassVar[str] = PROTOCOL
    addressed = False

    class Options(BaseModel):
        """What the user may write for a lamp's link."""

        model_config = ConfigDict(extra="forbid", frozen=True)

        silence_ms: int = Field(100, ge=20, description="noise ends with such a silence")

    def __init__(self, options: Options, directory: Directory, *, datagrams: bool = False) -> None:
        self.dialect = PROTOCOL
        self.silence_s = options.silence_ms / 1000
        self._noise = Noise()

    def decode(self, data: bytes, now: float) -> Sequence[Event]:
        events: list[Event] = []
        for piece in _PIECE.findall(data):
            if piece in (b"0", b"1"):
                self._noise.end(NOISE, events)
                events.append(Frame(NOBODY, NOBODY, SAID, piece, PROTOCOL, piece, self.dialect))
            else:
                self._noise.add(piece, events)
        self.pending = self._noise.size > 0
        return events

    def flush(self, now: float) -> Sequence[Event]:
        events: list[Event] = []
        self._noise.end(NOISE, events)
        self.pending = False
        return events

    def encode(self, frame: Frame) -> bytes:
        if frame.protocol != PROTOCOL or frame.payload not in (b"0", b"1", b"?"):
            raise EncodeError(f"{frame.payload!r} of {frame.protocol or 'no protocol'} is nothing that a lamp knows")
        return frame.payload

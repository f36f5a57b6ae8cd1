"""What two brokers say on a trunk's stream: a line each with who they are, then chunks.

A chunk is two bytes of length, the higher first, and so many bytes of a Zenoh connection. The
chunk of length 0 ends that connection. Each end says it once for each connection, also in answer
to the other's, and nothing of the next connection before both have been said: so no byte of one
connection is taken for one of another.
"""

from typing import Final, NamedTuple

from psiu_broker.errors import LinkAbsent, LinkBusy, LinkLost

CHUNK_MAX: Final = 8192
"""Longer ones are refused, so that a greeting in the middle of chunks (``PS`` would be 20,563) is noticed."""

END: Final = b"\x00\x00"
"""The chunk of length 0."""

ENDED: Final = b""
"""What `Reader` makes of `END`."""

LINE_MAX: Final = 512
SHOWN_MAX: Final = 40
MANY: Final = "many"
ONE: Final = "one"


class Greeting(NamedTuple):
    """Who is at one end of a trunk."""

    broker: str
    """Its name: printable and without spaces."""
    epoch: str
    """Another one each time the broker starts: ours come back means that the stream leads to ourselves."""
    many: bool
    """Whether it takes callers, and so may have several far ends."""

    @property
    def line(self) -> bytes:
        return f"PSIU TRUNK 1 {self.broker} {self.epoch} {MANY if self.many else ONE}\n".encode()

    def dials(self, far: "Greeting") -> bool:
        """Whether it is the Zenoh session at this end that connects, and the one of `far` that listens.

        Raises:
            LinkBusy: these two cannot be joined; the text is for this end.
        """
        if far.broker == self.broker:
            same = far.epoch == self.epoch
            raise LinkBusy(
                "the stream leads back to this broker itself"
                if same
                else f"the broker at the far end is called {far.broker} too; rename one of them"
            )
        if self.many or far.many:
            return not self.many
        return self.broker < far.broker


class Reader:
    """Makes of the far end's bytes, however they are cut, its greeting and then what is in its chunks."""

    def __init__(self) -> None:
        self._line: bytearray | None = bytearray()
        self._rest = 0
        """Bytes of the chunk that are still to come."""
        self._high: int | None = None
        """The higher byte of a length whose lower one is still to come."""

    def feed(self, data: bytes) -> list[Greeting | bytes]:
        """What `data` completes or continues: the contents of one chunk may come in several pieces.

        Raises:
            LinkAbsent: the far end is no trunk, or none of this version.
            LinkLost: it has lost the thread.
        """
        found: list[Greeting | bytes] = []
        at = 0
        if self._line is not None:
            line, newline, data = data.partition(b"\n")
            self._line += line
            if not newline or len(self._line) > LINE_MAX:
                _check_beginning(self._line)
                return found
            found.append(_greeting(bytes(self._line)))
            self._line = None
        while at < len(data):
            if self._rest:
                piece = data[at : at + self._rest]
                found.append(piece)
                self._rest -= len(piece)
                at += len(piece)
            elif self._high is None:
                self._high = data[at]
                at += 1
            else:
                self._rest = self._high << 8 | data[at]
                self._high = None
                at += 1
                if self._rest > CHUNK_MAX:
                    raise LinkLost("the far end has begun anew in the middle of the stream")
                if not self._rest:
                    found.append(ENDED)
        return found


def chunk(data: bytes) -> bytes:
    """`data`, at most `CHUNK_MAX` bytes and not none, as the far end's `Reader` takes it."""
    return len(data).to_bytes(2, "big") + data


def _check_beginning(line: bytearray) -> None:
    """Refuse what cannot become a greeting, without waiting for its end."""
    expected = b"PSIU TRUNK "
    if not line.startswith(expected[: len(line)]) or len(line) > LINE_MAX:
        raise _stranger(bytes(line))


def _greeting(line: bytes) -> Greeting:
    words = line.decode("ascii", "replace").split(" ")
    if words[:2] != ["PSIU", "TRUNK"] or len(words) < 3 or not line.isascii():
        raise _stranger(line)
    if words[2] != "1":
        raise LinkAbsent(f"the far end speaks version {words[2][:SHOWN_MAX]} of trunks and we version 1; update one")
    if len(words) < 6 or not all(words) or words[5] not in (ONE, MANY):
        raise _stranger(line)
    return Greeting(words[3], words[4], words[5] == MANY)


def _stranger(line: bytes) -> LinkAbsent:
    said = line[:SHOWN_MAX].decode("ascii", "backslashreplace")
    said = said if said.isprintable() else repr(said)[1:-1]
    return LinkAbsent(f'the far end is no psiu-broker with a trunk: it says "{said}"')

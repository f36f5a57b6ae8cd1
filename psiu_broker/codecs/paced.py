"""Protocols in which robots only listen: one packet tells all of them, at a fixed rate, what to do now."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

from psiu_broker.codecs.codec import Codec
from psiu_broker.frame import Frame


class Share(NamedTuple):
    """One robot's part of a packet; robots are counted from 1."""

    robot: int
    payload: bytes


class Rest(NamedTuple):
    """What a robot is told when nobody told it anything for `hold_s`: `stop`, as many bytes as its share has."""

    stop: bytes
    hold_s: float


class PacedCodec(Codec):
    """A codec whose packets leave at `rate_hz`, each with a share for every one of `robots`.

    A frame is a set-point of one robot: it holds until a newer one takes its place or it grows too old.
    """

    paced: ClassVar[bool] = True
    robots: int
    rate_hz: float
    steady: bool
    """Whether packets leave from the moment the link opens on, or only from the first set-point on."""
    rest: Rest
    """Of a robot for which nothing else was configured."""

    @abstractmethod
    def share(self, frame: Frame) -> Share:
        """What `frame` puts into the packets.

        Raises:
            EncodeError: this protocol or dialect cannot say it, or no packet has such a robot.
        """

    @abstractmethod
    def packet(self, shares: Sequence[bytes]) -> bytes:
        """The packet with the payloads of all robots, that of robot 1 first.

        Raises:
            EncodeError: there are too few or too many of them, or one is too short, too long or impossible.
        """

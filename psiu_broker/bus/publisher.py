"""What robots say, told to the programs that listen; nothing is decoded for nobody."""

import logging
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from functools import lru_cache
from types import MappingProxyType
from typing import Any, Final

import zenoh
from pydantic_core import to_json

from psiu_broker.bus.keys import Keys
from psiu_broker.bus.session import Session, aside, json_of
from psiu_broker.errors import BusError
from psiu_broker.frame import Address, Frame, Way
from psiu_broker.messages import Card, Conflict, Decoded, RawFrame

Describe = Callable[[Frame], Mapping[str, Any]]
"""The fields of `Decoded` that depend on the protocol: kind, command, parameters, status, …"""

logger = logging.getLogger(__name__)

KEYS_MAX: Final = 1024
"""How many keys stay declared; declaring one anew costs about ten puts."""

PRIORITY: Final = zenoh.Priority.DATA_LOW
"""Not that of replies: a put waits while a reply of its own priority waits for room to the same program."""

_DECODED: Final = json_of("Decoded")
_RAW: Final = json_of("RawFrame")
_CARD: Final = json_of("Card")
_CONFLICTS: Final = json_of("Conflict[]")


class Publisher:
    """Puts frames, raw frames and cards on the bus; never waits, never raises.

    Read `listened` (somebody subscribes to decoded frames) before `publish`, and `raw_listened`
    then `tapped(link)` before building a `RawFrame`: both are plain attributes that follow the
    subscribers. `puts` and `failures` count. `names` are what robots known by a number are called.
    """

    def __init__(
        self, session: Session, keys: Keys, broker: str, describe: Describe, names: Mapping[Address, Address]
    ) -> None:
        self.listened = False
        self.raw_listened = False
        self.puts = 0
        self.failures = 0
        self._session = session
        self._keys = keys
        self._broker = broker
        self._describe = describe
        self._names = names
        self._cards: dict[Address, bytes] = {}
        self._frames = lru_cache(KEYS_MAX)(self._declare_frames)
        self._taps = lru_cache(KEYS_MAX)(self._declare_tap)

    @classmethod
    async def open(
        cls,
        session: Session,
        keys: Keys,
        broker: str,
        describe: Describe,
        names: Mapping[Address, Address] = MappingProxyType({}),
    ) -> "Publisher":
        """Begin to watch who listens.

        Raises:
            BusError: the session is closed or lost.
        """
        publisher = cls(session, keys, broker, describe, names)
        await publisher._watch(keys.every_frame, "listened")
        await publisher._watch(keys.every_raw(broker), "raw_listened")
        return publisher

    def publish(self, frame: Frame, way: Way, received: float) -> None:
        """Put `frame`, heard on `way` at `received` (seconds since the epoch), if its own key is listened to."""
        try:
            publisher = self._frames(frame.source, frame.destination, frame.subject)
            if matching(publisher):
                publisher.put(self._decoded(frame, way, received))
                self.puts += 1
        except BaseException as error:
            self._failed(error)

    def tapped(self, link: str) -> bool:
        """Whether somebody subscribes to the raw frames of `link`."""
        if not self.raw_listened:
            return False
        try:
            return matching(self._taps(link))
        except BaseException as error:
            self._failed(error)
            return False

    def publish_raw(self, raw: RawFrame) -> None:
        """Put one frame of a link with its verdict."""
        try:
            self._taps(raw.link).put(raw.model_dump_json())
            self.puts += 1
        except BaseException as error:
            self._failed(error)

    def publish_card(self, robot: Address, card: Card) -> None:
        """Put the card of `robot` if it differs from the last one put."""
        try:
            payload = card.model_dump_json().encode()
            if self._cards.get(robot) == payload:
                return
            self._session.zenoh.put(
                self._keys.card(robot),
                payload,
                encoding=_CARD,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=PRIORITY,
            )
            self._cards[robot] = payload
            self.puts += 1
        except BaseException as error:
            self._failed(error)

    def publish_conflicts(self, conflicts: Sequence[Conflict]) -> None:
        """Put the names that are not one robot's, all that there are now."""
        try:
            self._session.zenoh.put(
                self._keys.broker(self._broker, "conflicts"),
                to_json(conflicts),
                encoding=_CONFLICTS,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=PRIORITY,
            )
            self.puts += 1
        except BaseException as error:
            self._failed(error)

    def forget_card(self, robot: Address) -> None:
        """The card is another broker's from now on."""
        self._cards.pop(robot, None)

    def forget_cards(self) -> None:
        """Put every card again when it is published next, whether it has changed or not."""
        self._cards = dict.fromkeys(self._cards, b"")

    def withdraw_card(self, robot: Address) -> None:
        """Delete the card of a robot that is gone, if it was put by us."""
        if self._cards.pop(robot, None) is not None:
            self.delete_card(robot)

    def withdraw_cards(self) -> None:
        """The broker leaves, and its robots with it."""
        for robot in tuple(self._cards):
            self.withdraw_card(robot)

    def delete_card(self, robot: Address) -> None:
        """Delete the card of a robot that is gone."""
        try:
            self._session.zenoh.delete(
                self._keys.card(robot), congestion_control=zenoh.CongestionControl.DROP, priority=PRIORITY
            )
            self.puts += 1
        except BaseException as error:
            self._failed(error)

    def _decoded(self, frame: Frame, way: Way, received: float) -> str:
        return Decoded(
            source=str(self._names.get(frame.source, frame.source)),
            destination=str(self._names.get(frame.destination, frame.destination)),
            protocol=frame.protocol,
            broker=self._broker,
            link=way.link,
            received=datetime.fromtimestamp(received, UTC),
            wire=frame.wire.hex(),
            **self._describe(frame),
        ).model_dump_json()

    async def _watch(self, key: str, flag: str) -> None:
        """Keep the attribute `flag` at whether anything that `key` covers has a subscriber."""

        def declare() -> tuple[zenoh.Publisher, zenoh.MatchingListener[zenoh.Handler[zenoh.MatchingStatus]]]:
            gate = self._declare(key, _DECODED)
            return gate, gate.declare_matching_listener(zenoh.handlers.RingChannel(16))

        def look(_: object) -> None:
            # What is so now: changes of two clients may overtake one another on their way here.
            try:
                setattr(self, flag, not self._session.is_lost and matching(gate))
            except zenoh.ZError:  # closed meanwhile
                setattr(self, flag, False)

        try:
            gate, listener = await aside(declare)
            look(None)
        except zenoh.ZError as error:
            raise BusError(f"zenoh: {error}") from error
        self._session.declared(gate)
        self._session.declared(listener)
        self._session.bridge(listener, lambda status: status, look, name=f"bus-{flag}")

    def _declare_frames(self, source: Address, destination: Address, subject: str) -> zenoh.Publisher:
        names = self._names
        key = self._keys.decoded(names.get(source, source), names.get(destination, destination), subject)
        return self._declare(key, _DECODED)

    def _declare_tap(self, link: str) -> zenoh.Publisher:
        return self._declare(self._keys.raw(self._broker, link), _RAW)

    def _declare(self, key: str, encoding: zenoh.Encoding) -> zenoh.Publisher:
        return self._session.zenoh.declare_publisher(
            key,
            encoding=encoding,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=PRIORITY,
            allowed_destination=zenoh.Locality.REMOTE,
        )

    def _failed(self, error: BaseException) -> None:
        self.failures += 1
        if self._session.panicked(error):
            self.listened = self.raw_listened = False
        elif not isinstance(error, Exception):
            raise error
        elif self.failures & (self.failures - 1) == 0:  # the 1st, 2nd, 4th, 8th, …: a flood of them is one story
            logger.error("%d messages could not be published", self.failures, exc_info=error)


def matching(publisher: zenoh.Publisher) -> bool:
    """Whether `publisher` has a subscriber now."""
    status: Any = publisher.matching_status  # declared as bool; it is an object, and always true
    return bool(status.matching)

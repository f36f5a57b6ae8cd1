"""The mesh over Zenoh: tokens for what is announced, puts for what is said.

    psiu/@mesh/broker/{name}/{epoch}/{zenoh id}/{edition}
        token: a broker is there
    psiu/@mesh/robot/{owner}/{epoch}/{robot}/{number}/{protocol}/{link}/{term}/{quality}/{age}/{edition}
        token: a claim
    psiu/@mesh/frame/{to}/{from}/{lane}      put: a frame for a robot of `to`
    psiu/@mesh/beat/{from}                   put: JSON, `mesh.beat.Beat`
    psiu/@mesh/notice/{to}                   put: JSON, `mesh.beat.Notice`

Tokens vanish with their session: at once when it is closed or killed, within its lease (2 s) when
the way to it is cut. The edition is new each time everything is declared anew, so that the new
tokens are there before the old ones go.
"""

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import Executor
from typing import Any, Final

import zenoh

from psiu_broker.bus.hang_up import hang_up
from psiu_broker.bus.keys import Keys, chunk, robot, robot_chunk, text
from psiu_broker.bus.session import JSON, Declared, Session, aside, plain
from psiu_broker.frame import EVERYONE, Address
from psiu_broker.mesh.beat import Beat, Notice
from psiu_broker.mesh.mesh import Mesh
from psiu_broker.routing.claims import BEST, TERM_MAX, Claim
from psiu_broker.routing.outbox import COMMAND_LANE, QUESTION_LANE, STOP_LANE

logger = logging.getLogger(__name__)

RING: Final = 65_536
TALK_RING: Final = 4096
NONE: Final = "-"

PRIORITIES: Final[Mapping[int, Any]] = {
    STOP_LANE: zenoh.Priority.REAL_TIME,
    COMMAND_LANE: zenoh.Priority.INTERACTIVE_HIGH,
    QUESTION_LANE: zenoh.Priority.INTERACTIVE_LOW,
}
"""Of frames between brokers; what is published for programs has DATA_LOW."""


class ZenohMesh:
    """Implements `mesh.MeshBus`; declarations are made in a thread of their own, in their order."""

    def __init__(self, session: Session, keys: Keys, own: str, mesh: Mesh) -> None:
        self.zenoh_id = session.zenoh_id
        self.linked: Collection[str] = ()
        """The Zenoh ids of those whom a link of ours leads to."""
        self.failures = 0
        """Puts that Zenoh refused."""
        self._unreadable: dict[str, int] = {}
        """By what it should have been; each is counted by one thread."""
        self._session = session
        self._own = own
        self._mesh = mesh
        self._root = f"{keys.prefix}/@mesh"
        self._presence = ""
        self._edition = 0
        self._tokens: dict[str, Declared | None] = {}
        """By key without its edition, None where Zenoh would not declare it; touched by the worker only."""
        self._worker: Executor = session.worker("mesh")
        self._twice: set[str] = set()
        """Whom two links lead to, as was told once: Zenoh may keep half of one (its issue 2806)."""
        self._closed = False
        self._anew: asyncio.Task[None] | None = None

    @classmethod
    async def open(cls, session: Session, keys: Keys, own: str, mesh: Mesh) -> "ZenohMesh":
        """Hear other brokers from now on, and attach `mesh`.

        Raises:
            BusError: the session is closed or lost.
        """
        mesh.detach(time.monotonic())
        bus = cls(session, keys, own, mesh)
        root, me, zenoh_session = bus._root, chunk(own), session.zenoh
        ring = zenoh.handlers.RingChannel

        def subscribe(what: str, size: int) -> Callable[[], Any]:
            return lambda: zenoh_session.declare_subscriber(
                f"{root}/{what}", ring(size), allowed_origin=zenoh.Locality.REMOTE
            )

        def watch(what: str) -> Callable[[], Any]:
            return lambda: zenoh_session.liveliness().declare_subscriber(f"{root}/{what}", ring(RING), history=True)

        def told(hear: Callable[[Any, float], None]) -> Callable[[Any], None]:
            """For the loop: what an earlier session still brings is nothing any more."""
            return lambda it: None if bus._closed else hear(it, time.monotonic())

        def readable(what: str, sift: Callable[[zenoh.Sample], Any]) -> Callable[[zenoh.Sample], Any]:
            bus._unreadable[what] = 0

            def read(sample: zenoh.Sample) -> Any:
                try:
                    kept = sift(sample)
                except ValueError as error:
                    logger.debug("%s: %s", what, error)
                    kept = None
                bus._unreadable[what] += kept is None
                return kept

            return read

        await session.serve(
            subscribe(f"frame/{me}/*/*", RING),
            bus._frame,
            # Not `told`: what an earlier session still brings is for a former life of ours, and counted as that.
            lambda it: mesh.frame_came(*it, time.monotonic()),
            name="mesh-frames",
        )
        await session.serve(
            subscribe(f"notice/{me}", TALK_RING),
            readable("notices", _notice),
            told(mesh.notice_came),
            name="mesh-notices",
        )
        await session.serve(
            subscribe("beat/*", TALK_RING), readable("beats", _beat), told(mesh.beat_came), name="mesh-beats"
        )
        await session.serve(
            watch("broker/**"),
            readable("brokers", bus._broker_token),
            told(lambda it, now: it(now)),
            name="mesh-brokers",
        )
        await session.serve(
            watch("robot/**"), readable("robots", bus._robot_token), told(lambda it, now: it(now)), name="mesh-robots"
        )
        mesh.attach(bus, time.monotonic(), time.time_ns())
        return bus

    @property
    def unreadable(self) -> int:
        """How much came from other brokers that is no beat, notice or announcement; frames are in the ledger."""
        return sum(self._unreadable.values())

    # mesh.MeshBus

    def put_frame(self, to: str, lane: int, data: bytes) -> bool:
        key = f"{self._root}/frame/{chunk(to)}/{chunk(self._own)}/{lane}"
        return self._put(key, data, priority=PRIORITIES[lane], express=lane != QUESTION_LANE)

    def put_beat(self, beat: Beat) -> None:
        self._put(f"{self._root}/beat/{chunk(self._own)}", beat.model_dump_json(), priority=zenoh.Priority.DATA_HIGH)

    def put_notice(self, to: str, notice: Notice) -> None:
        self._put(f"{self._root}/notice/{chunk(to)}", notice.model_dump_json(), priority=zenoh.Priority.DATA_HIGH)

    def announce(self, epoch: int) -> None:
        self._presence = f"{self._root}/broker/{chunk(self._own)}/{epoch}/{self.zenoh_id}"
        self._later(self._declare, self._presence)

    def claim(self, claim: Claim) -> None:
        self._later(self._declare, self._key(claim))

    def withdraw(self, claim: Claim) -> None:
        self._later(self._undeclare, self._key(claim))

    def declare_anew(self) -> None:
        if self._anew is None or self._anew.done():
            self._later(self._declare_tokens_anew)
            self._anew = asyncio.get_running_loop().create_task(self._session.declare_anew())

    def hang_up(self, zenoh_id: str | None) -> None:
        self._later(self._end_links, zenoh_id)

    async def look(self) -> None:
        """Renew `linked`."""

        def ids() -> Counter[str]:
            return Counter(str(link.zid) for link in self._session.zenoh.info.links())

        try:
            links = await aside(ids)
        except BaseException as error:
            if isinstance(error, asyncio.CancelledError) or not (
                isinstance(error, Exception) or self._session.panicked(error)
            ):
                raise
            logger.debug("the session cannot tell its links: %s", plain(error))
            return
        self.linked = frozenset(links)
        for neighbour in self._mesh.neighbours:
            if links[neighbour.zenoh_id] > 1 and neighbour.zenoh_id not in self._twice:
                self._twice.add(neighbour.zenoh_id)
                logger.warning(
                    "mesh: two links lead to %s; if you name each other in mesh.connect, leave one out", neighbour.name
                )

    async def close(self) -> None:
        """Nothing more is declared or heard; before `Session.close`."""
        self._closed = True
        self._mesh.detach(time.monotonic())
        if self._anew is not None:
            self._anew.cancel()
            await asyncio.gather(self._anew, return_exceptions=True)

    # Tokens, in the worker.

    def _later(self, work: Callable[..., None], *arguments: object) -> None:
        try:
            self._worker.submit(self._guarded, work, *arguments)
        except RuntimeError:  # the session is closed
            logger.debug("the bus is closed: nothing more is announced")

    def _guarded(self, work: Callable[..., None], *arguments: object) -> None:
        try:
            work(*arguments)
        except BaseException as error:
            if not self._session.panicked(error):
                logger.warning("announcing: %s", plain(error))

    def _declare(self, key: str) -> None:
        if self._tokens.setdefault(key, None) is None:
            self._tokens[key] = self._session.zenoh.liveliness().declare_token(f"{key}/{self._edition}")

    def _undeclare(self, key: str) -> None:
        token = self._tokens.pop(key, None)
        if token is not None:
            token.undeclare()

    def _declare_tokens_anew(self) -> None:
        """One that cannot be declared now stays as it is until the next time."""
        self._edition += 1
        former = dict(self._tokens)
        for key, token in former.items():
            self._tokens[key] = None
            self._guarded(self._declare, key)
            if self._tokens[key] is None:
                self._tokens[key], former[key] = token, None
        for token in former.values():
            if token is not None:
                self._guarded(token.undeclare)

    def _end_links(self, zenoh_id: str | None) -> None:
        links = [
            (str(link.src), str(link.dst))
            for link in self._session.zenoh.info.links()
            if zenoh_id in (None, str(link.zid))
        ]
        logger.info("mesh: %d connections ended", hang_up(links))

    def _key(self, claim: Claim) -> str:
        number = NONE if claim.number is None else robot_chunk(claim.number)
        age = NONE if claim.age_s is None else str(claim.age_s)
        return (
            f"{self._root}/robot/{chunk(self._own)}/{self._mesh.epoch}/{robot_chunk(claim.robot)}/{number}"
            f"/{chunk(claim.protocol)}/{chunk(claim.link)}/{claim.term}/{claim.quality}/{age}"
        )

    # What arrives, in the readers' threads: None, or a ValueError, for what is not as it should be.

    def _chunks(self, key: str, count: int) -> list[str] | None:
        """The chunks behind ``psiu/@mesh/{word}/``, if there are so many."""
        chunks = key[len(self._root) + 1 :].split("/")[1:]
        return chunks if len(chunks) == count and "*" not in key else None

    def _frame(self, sample: zenoh.Sample) -> tuple[str, int, bytes]:
        """What is none is handed on as a frame that nobody can read: each that comes is in the ledger."""
        chunks = self._chunks(str(sample.key_expr), 3)
        if chunks is None or sample.kind != zenoh.SampleKind.PUT or chunks[2] not in _LANES:
            return _UNREADABLE
        try:
            return text(chunks[1]), int(chunks[2]), sample.payload.to_bytes()
        except ValueError:
            return _UNREADABLE

    def _broker_token(self, sample: zenoh.Sample) -> Callable[[float], None] | None:
        chunks = self._chunks(str(sample.key_expr), 4)
        if chunks is None:
            return None
        name, epoch, zenoh_id = _broker_name(chunks[0]), _number_below(chunks[1], 2**64), chunks[2]
        edition = chunks[3]
        if sample.kind == zenoh.SampleKind.PUT:
            return lambda now: self._mesh.broker_came(name, epoch, zenoh_id, edition, now)
        return lambda now: self._mesh.broker_went(name, epoch, edition, now)

    def _robot_token(self, sample: zenoh.Sample) -> Callable[[float], None] | None:
        chunks = self._chunks(str(sample.key_expr), 10)
        if chunks is None:
            return None
        owner, epoch, name, number, protocol, link, term, quality, age = chunks[:9]
        claim = Claim(
            robot(name),
            None if number == NONE else _number(number),
            text(protocol),
            text(link),
            _number_below(term, TERM_MAX),
            _number_below(quality, BEST + 1),
            None if age == NONE else _number_below(age, TERM_MAX),
        )
        broker, life = _broker_name(owner), _number_below(epoch, 2**64)
        if sample.kind == zenoh.SampleKind.PUT:
            return lambda now: self._mesh.claimed(broker, life, claim, now)
        return lambda now: self._mesh.unclaimed(broker, life, claim, now)

    def _put(self, key: str, payload: bytes | str, *, priority: Any, express: bool = False) -> bool:
        """False: Zenoh refused it."""
        try:
            self._session.zenoh.put(
                key,
                payload,
                encoding=JSON if isinstance(payload, str) else None,
                priority=priority,
                congestion_control=zenoh.CongestionControl.DROP,
                express=express,
                allowed_destination=zenoh.Locality.REMOTE,
            )
        except BaseException as error:
            self.failures += 1
            if not self._session.panicked(error):
                logger.debug("to other brokers: %s", plain(error))
            return False
        return True


_LANES: Final = frozenset(str(lane) for lane in PRIORITIES)
_UNREADABLE: Final = ("", QUESTION_LANE, b"")


def _number_below(chunk: str, end: int) -> int:
    """A number as a key's chunk; raises ValueError for any other text, or one that is too great."""
    if len(chunk) > 20 or not (chunk.isascii() and chunk.isdigit()) or int(chunk) >= end:
        raise ValueError(f"{chunk[:30]} is not a number below {end}")
    return int(chunk)


def _broker_name(chunk: str) -> str:
    name = text(chunk)
    if not name or len(name) > 255 or name == str(EVERYONE):
        raise ValueError("a broker has a name")
    return name


def _number(chunk: str) -> Address:
    address = robot(chunk)
    if not address.is_numbered:
        raise ValueError(f"{chunk} is no PSIU HEXA address")
    return address


def _beat(sample: zenoh.Sample) -> Beat:
    return Beat.model_validate_json(sample.payload.to_bytes())


def _notice(sample: zenoh.Sample) -> Notice:
    return Notice.model_validate_json(sample.payload.to_bytes())

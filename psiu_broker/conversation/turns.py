"""Whose turn it is at each robot: one request at a time, first come, first served."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Final

from psiu_broker.errors import CallError
from psiu_broker.frame import Address

WAITING_KEPT: Final = 64
"""How many may wait for one robot."""


@dataclass(slots=True)
class _Lane:
    """The queue in front of one robot."""

    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    users: int = 0
    alone: str | None = None
    """The command whose turn it is, where the robot must hear nothing else meanwhile."""
    replaceable: dict[str, asyncio.Timeout] = field(default_factory=dict)
    motions: set[asyncio.Timeout] = field(default_factory=set)
    """Those that wait and would move the robot; of them, those before which a stop came."""
    overtaken: set[asyncio.Timeout] = field(default_factory=set)


class Turns:
    """The queues in front of all robots; a queue is there only while somebody is in it."""

    def __init__(self) -> None:
        self._lanes: dict[Address, _Lane] = {}

    def __bool__(self) -> bool:
        return bool(self._lanes)

    @asynccontextmanager
    async def turn(
        self,
        robot: Address,
        *,
        name: str,
        command: str,
        until: float,
        replaceable: bool = False,
        alone: bool = False,
        motion: bool = False,
    ) -> AsyncIterator[None]:
        """Wait until `until` (the loop's clock) for the turn at `robot`, called `name`; it ends with the body.

        A `replaceable` one that waits is ended by a later one with the same `command`: the newest is what counts;
        a `motion` that waits, by `overtake`.

        Raises:
            CallError: busy, too many wait or one that is `alone` goes on; expired, no turn came, or a newer one or a
                stop did.
        """
        lane = self._lanes.setdefault(robot, _Lane())
        replaces = replaceable and command in lane.replaceable
        if lane.users > WAITING_KEPT and not replaces:
            raise CallError("busy", f"{WAITING_KEPT} calls to {name} wait already")
        lane.users += 1
        try:
            await _acquire(lane, name, command, until, replaceable, motion)
            try:
                lane.alone = command if alone else None
                yield
            finally:
                lane.alone = None
                lane.lock.release()
        finally:
            lane.users -= 1
            if lane.users == 0:
                del self._lanes[robot]

    def overtake(self, robot: Address) -> None:
        """A stop goes first: end every motion that waits."""
        lane = self._lanes.get(robot)
        if lane is None:
            return
        now = asyncio.get_running_loop().time()
        for limit in lane.motions:
            if not limit.expired():
                lane.overtaken.add(limit)
                limit.reschedule(now)


async def _acquire(lane: _Lane, name: str, command: str, until: float, replaceable: bool, motion: bool) -> None:
    loop = asyncio.get_running_loop()
    begun = loop.time()
    limit = asyncio.timeout_at(until)
    try:
        async with limit:
            if motion:
                lane.motions.add(limit)
            if replaceable:
                older = lane.replaceable.get(command)
                lane.replaceable[command] = limit
                if older is not None and not older.expired():
                    older.reschedule(begun)
            await lane.lock.acquire()
    except TimeoutError:
        if limit in lane.overtaken:
            raise CallError("expired", f"a stop came while {name} was at other calls; {command} was not sent") from None
        if limit.when() != until:
            raise CallError("expired", f"a newer {command} came while {name} was at other calls") from None
        if lane.alone is not None:
            raise CallError(
                "busy", f"{name} is at {lane.alone} and hears nothing else; {command} was not sent"
            ) from None
        waited = f"{max(until - begun, 0):.3g} s"
        raise CallError("expired", f"{name} was at other calls for {waited}; {command} was not sent") from None
    finally:
        lane.motions.discard(limit)
        lane.overtaken.discard(limit)
        if lane.replaceable.get(command) is limit:
            del lane.replaceable[command]

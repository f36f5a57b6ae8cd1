"""Programs that want to be missed: a token ``psiu/@program/{id}``, and ``"program": id`` in each of their calls.

The token vanishes with its session: at once where the program ends or is killed; where it hangs or is cut off, within
the lease that its session announces (10 s unless it chose another; `Client` has a broker's). One who goes in good
order declares ``psiu/@program/{id}/done`` first.

Zenoh 1.10 tells nothing of who made a query or a put unless that adds it, and of sessions only where they are direct:
a token is seen through routers too, and any program can declare one.
"""

import asyncio
from typing import Any, Protocol

import zenoh

from psiu_broker.bus.keys import Keys
from psiu_broker.bus.session import Session

RING = 65_536


class Programs(Protocol):
    """Who is told. On the loop."""

    def program_came(self, program: str) -> None: ...
    def program_done(self, program: str) -> None: ...
    def program_gone(self, program: str) -> None: ...

    def programs_unsure(self) -> None:
        """Some may have gone unseen; those that are there are told again."""


async def watch(session: Session, keys: Keys, programs: Programs) -> None:
    """Tell `programs` who comes and goes, from now on.

    Raises:
        BusError: the session is closed or lost.
    """
    loop = asyncio.get_running_loop()

    def declare() -> Any:
        loop.call_soon_threadsafe(programs.programs_unsure)
        return session.zenoh.liveliness().declare_subscriber(
            keys.every_program, zenoh.handlers.RingChannel(RING), history=True
        )

    def sift(sample: zenoh.Sample) -> tuple[str, bool, bool] | None:
        try:
            program, done = keys.read_program(str(sample.key_expr))
        except ValueError:  # somebody else's key
            return None
        return program, done, sample.kind == zenoh.SampleKind.PUT

    def handle(seen: tuple[str, bool, bool]) -> None:
        program, done, there = seen
        if done and there:
            programs.program_done(program)
        elif there:
            programs.program_came(program)
        elif not done:
            programs.program_gone(program)

    await session.serve(declare, sift, handle, name="bus-programs")

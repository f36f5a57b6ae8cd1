"""`psiu trace`: asks a robot something harmless, here or at the broker that has it, and tells where it was when."""

import time
from collections.abc import Awaitable, Callable, Sequence
from typing import Final

from psiu_broker.codecs import psiu_ascii
from psiu_broker.errors import BusError, CallError
from psiu_broker.exchange import Exchange
from psiu_broker.frame import MESH, Address
from psiu_broker.mesh.probe import Probed, Stamp, journey
from psiu_broker.messages import NOTHING, Answer, CallRequest, Trace, TraceHop
from psiu_broker.protocols import PROTOCOLS
from psiu_broker.routing.router import SELF

ASK_S: Final = 5.0
"""How long the robot may take."""
PROBE_S: Final = ASK_S + 2.0
"""How long another broker may take to tell of it."""

Call = Callable[[Address, str, CallRequest], Awaitable[Answer]]
"""Ask a robot of this broker; raises CallError."""
Probe = Callable[[str, Address, float], Awaitable[tuple[Probed, Sequence[Stamp]]]]
"""Have another broker ask a robot, within so many seconds; raises BusError."""


class Tracing:
    """Asks in the name of broker `own`.

    Args:
        broker_of: the name of the broker with a Zenoh id.
    """

    def __init__(
        self,
        own: str,
        exchange: Exchange,
        call: Call,
        broker_of: Callable[[str], str],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._own = own
        self._exchange = exchange
        self._call = call
        self._broker_of = broker_of
        self._clock = clock

    async def trace(self, a: Address, b: Address, probe: Probe) -> Trace:
        """Ask `b` from here, where `a` is; by `probe` where another broker has `b`."""
        begun = self._clock()
        route = self._exchange.router.find(b)
        if route is None or route.way.link != MESH:
            probed = await self.probed(b)
            hops = [TraceHop(at=self._own, event="sent", elapsed_ms=0), *probed.hops]
        else:
            owner = str(route.way.peer)
            try:
                probed, stamps = await probe(owner, b, PROBE_S)
            except BusError as error:
                took_ms = self._ms_since(begun)
                question = _harmless(route.protocol) or NOTHING
                probed = Probed(question=question, answered=False, reason=str(error), took_ms=took_ms)
                hops = [TraceHop(at=self._own, event="sent", elapsed_ms=0)]
            else:
                hops = journey(self._own, owner, probed, stamps, self._ms_since(begun), self._broker_of)
        return Trace(
            a=str(a),
            b=str(b),
            question=probed.question,
            answered=probed.answered,
            reason=probed.reason,
            hops=hops,
            total_ms=self._ms_since(begun),
        )

    async def probed(self, robot: Address) -> Probed:
        """Ask a robot of this broker, or the broker itself."""
        begun = self._clock()
        route = self._exchange.router.find(robot)
        harmless = _harmless(route.protocol if route is not None and route.way != SELF else psiu_ascii.PROTOCOL)
        question = harmless or NOTHING
        hops, reason = [], None
        if harmless is None:
            reason = f"{robot} speaks {route and route.protocol}, in which nothing can be asked without harm"
        elif route is not None and route.way.link == MESH:
            reason = f"{robot} has just gone to broker {route.way.peer}"
        elif route is None or route.way != SELF:
            try:
                await self._call(robot, question, CallRequest(timeout_s=ASK_S))
            except CallError as error:
                reason = str(error)
        took_ms = self._ms_since(begun)
        link = None if route is None else self._exchange.links.get(route.way.link)
        if link is not None and link.last_sent >= begun:
            written_ms = min((link.last_sent - begun) * 1000, took_ms)
            hops.append(TraceHop(at=f"{self._own}/{link.name}", event="written", elapsed_ms=round(written_ms, 3)))
        if reason is None:
            hops.append(TraceHop(at=str(robot), event="answered", elapsed_ms=took_ms))
        return Probed(question=question, answered=reason is None, reason=reason, hops=hops, took_ms=took_ms)

    def _ms_since(self, begun: float) -> float:
        return round((self._clock() - begun) * 1000, 3)


def _harmless(protocol: str) -> str | None:
    known = PROTOCOLS.get(protocol)
    return None if known is None else known.profile.harmless

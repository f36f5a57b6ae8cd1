"""Everything that one broker has on the bus: what is served there, and by whom it is answered."""

import time
from collections.abc import Callable, Sequence
from typing import Protocol

from psiu_broker.bus.access import access_control
from psiu_broker.bus.calls import Calls
from psiu_broker.bus.keys import Keys
from psiu_broker.bus.mesh import ZenohMesh
from psiu_broker.bus.programs import Programs, watch
from psiu_broker.bus.publisher import Publisher
from psiu_broker.bus.queries import Queries, Source
from psiu_broker.bus.round_trip import RoundTrip
from psiu_broker.bus.routers import refuse_routers
from psiu_broker.bus.session import Session, plain
from psiu_broker.bus.traces import Traces
from psiu_broker.config import Configuration
from psiu_broker.config.who import names
from psiu_broker.errors import BusError
from psiu_broker.frame import Address, Frame
from psiu_broker.mesh.mesh import Mesh
from psiu_broker.mesh.probe import Probed
from psiu_broker.messages import Answer, CallRequest, Trace
from psiu_broker.profiles import Description


class Served(Source, Protocol):
    """The broker as the bus sees it."""

    @property
    def mesh(self) -> Mesh: ...

    @property
    def programs(self) -> Programs: ...

    def describe(self, frame: Frame) -> Description:
        """As `publisher.Describe`."""

    async def call(self, robot: Address, command: str, request: CallRequest) -> Answer | None:
        """As `calls.Call`."""

    async def send(self, robot: Address, command: str, request: CallRequest) -> None:
        """As `calls.Send`."""

    async def trace(self, a: Address, b: Address) -> Trace | None:
        """As `traces.Make`."""

    async def probed(self, robot: Address) -> Probed:
        """As `traces.Look`."""


class Bus:
    """One session with everything that is declared on it."""

    def __init__(
        self,
        session: Session,
        publisher: Publisher,
        mesh: ZenohMesh,
        calls: Calls,
        queries: Queries,
        traces: Traces,
        round_trip: RoundTrip,
    ) -> None:
        self.session = session
        self.publisher = publisher
        self.mesh = mesh
        self.calls = calls
        self.queries = queries
        self.traces = traces
        self.round_trip = round_trip

    @classmethod
    async def open(
        cls,
        configuration: Configuration,
        broker: Served,
        lost: Callable[[], None],
        listen: Sequence[str] = (),
        connect: Sequence[str] = (),
    ) -> "Bus":
        """Serve `broker` from now on; `lost` is called once if Zenoh breaks.

        Args:
            listen: endpoints beside those of the configuration; so are `connect`.

        Raises:
            BusError: the session cannot open.
        """
        name, zenoh, mesh = configuration.broker.name, configuration.zenoh, configuration.mesh
        keys = Keys(zenoh.prefix)
        session = await Session.open(
            [*zenoh.listen, *listen],
            connect=[*mesh.connect, *connect],
            mode=mesh.mode,
            discover=mesh.discover,
            tls=zenoh.tls,
            access=access_control(zenoh, trunks=bool(configuration.trunks)),
            lost=lambda _: lost(),
        )
        try:
            if zenoh.access is not None:
                brokers = zenoh.access.brokers
                await refuse_routers(session, brokers, trunks=bool(configuration.trunks))
            if any(robot.failsafe is not None for robot in configuration.robots.values()):
                await watch(session, keys, broker.programs)
            return cls(
                session,
                await Publisher.open(session, keys, name, broker.describe, names(configuration)),
                await ZenohMesh.open(session, keys, name, broker.mesh),
                await Calls.open(session, keys, broker.call, broker.send, relayed=mesh.mode == "router"),
                await Queries.open(session, keys, name, broker),
                await Traces.open(session, keys, name, broker.trace, broker.probed),
                await RoundTrip.open(session, keys, name),
            )
        except BaseException as error:
            broker.mesh.detach(time.monotonic())
            await session.close()
            if session.panicked(error):
                raise BusError(f"zenoh: {plain(error)}") from error
            raise

    async def retire(self) -> None:
        """Answer the calls under way, refuse those that come, leave the mesh; the session stays open."""
        await self.calls.close()
        await self.traces.close()
        await self.mesh.close()

    async def close(self) -> None:
        """Answer the calls under way and close the session, also when cancelled meanwhile."""
        try:
            await self.retire()
        finally:
            await self.session.close()

"""The broker's Zenoh session: opened, watched, and closed whatever happens."""

import asyncio
import atexit
import json
import logging
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import suppress
from typing import Any, Final, Literal, Protocol, TypeVar

import zenoh

from psiu_broker.bus.bridge import TURN_MAX, Bridge
from psiu_broker.config import TlsConfiguration
from psiu_broker.errors import BusError

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)
Kept = TypeVar("Kept")
Result = TypeVar("Result")

Mode = Literal["peer", "router"]

logger = logging.getLogger(__name__)

_SOURCE_PLACE: Final = re.compile(r"\s*at /[^\s\]]+\.rs:\d+\.?")
_BUSY: Final = re.compile(r"bound to (?P<endpoint>\S+): .*(?:already in use|os error 98)", re.DOTALL)
_THREAD_END_S: Final = 5.0

LEASE_S: Final = 2.0
"""How long others wait for a sign of life of ours before they give us up: Zenoh goes by what each side announces."""

LEASE: Final = {"lease": int(LEASE_S * 1000), "keep_alive": 4}

STUCK_S: Final = 1.0
"""How long a reply waits for a program that does not read; then Zenoh closes the link to it."""

JSON: Final = zenoh.Encoding.APPLICATION_JSON


def json_of(name: str) -> zenoh.Encoding:
    """The encoding of a message: ``application/json;psiu/Decoded``."""
    return JSON.with_schema(f"psiu/{name}")


def plain(error: BaseException) -> str:
    """Zenoh's words without the places in its source code."""
    return _SOURCE_PLACE.sub("", str(error)).strip()


async def aside(work: Callable[..., Result], *arguments: object) -> Result:
    """Run `work` in a thread of its own: asyncio's may all be waiting, for a name server or a serial port."""
    thread = ThreadPoolExecutor(1, "psiu-bus")
    try:
        return await asyncio.get_running_loop().run_in_executor(thread, work, *arguments)
    finally:
        thread.shutdown(wait=False)


class Declared(Protocol):
    """What `Session` undeclares when it closes."""

    def undeclare(self) -> None: ...


class Source(Declared, Protocol[T_co]):
    """A declared subscriber or queryable: what arrives, until it is undeclared."""

    def __iter__(self) -> Iterator[T_co]: ...


class _Service:
    """One subscriber or queryable and how to declare it."""

    def __init__(self, declare: Callable[[], Source[T]], read: Callable[[Source[T]], None]) -> None:
        self._declare = declare
        self._read = read
        self._source: Any = None

    def begin(self) -> None:
        """Declare it, once more if it was declared before. Waits for Zenoh."""
        self.end()
        self._source = self._declare()

    def read(self) -> None:
        """Hand on what arrives. On the loop."""
        self._read(self._source)

    def end(self) -> None:
        source, self._source = self._source, None
        if source is not None:
            source.undeclare()


class Session:
    """One open Zenoh session, its threads and its declarations.

    `zenoh` is for this folder. After a panic inside Zenoh the session is dead: `lost` is told once,
    on the loop, and another must be opened.
    """

    def __init__(self, session: zenoh.Session, listen: Sequence[str], lost: Callable[[BusError], None]) -> None:
        self.zenoh = session
        self.zenoh_id: Final = str(session.zid())
        self.listen: Final = tuple(listen)
        self.is_lost = False
        self._lost = lost
        self._loop = asyncio.get_running_loop()
        self._workers: list[Executor] = []
        self._declared: list[Declared] = []
        self._services: list[_Service] = []
        self._bridges: list[Bridge[Any, Any]] = []
        # Our reader threads must be out of Zenoh before the interpreter goes, also after an error.
        atexit.register(self._close)

    @classmethod
    async def open(
        cls,
        listen: Sequence[str],
        *,
        connect: Sequence[str] = (),
        mode: Mode = "peer",
        discover: bool = False,
        tls: TlsConfiguration | None = None,
        access: Mapping[str, object] | None = None,
        lost: Callable[[BusError], None] = lambda error: None,
    ) -> "Session":
        """Listen at `listen`, and connect to each of `connect`, whenever somebody is there.

        Args:
            mode: "peer": who connects to one another talks, and nobody relays; "router": Zenoh relays.
            discover: find others on the local network by multicast.
            tls: keys; each side shows its certificate. Then nothing but what `listen` and `connect` speak is spoken.
            access: who may do what, as `access.access_control` makes it.

        Raises:
            BusError: an endpoint is taken, impossible or misspelt.
        """
        try:
            written = _configuration(listen, connect, mode, discover)
            if tls is not None:
                written["transport"]["link"] |= tls_links(tls, [*listen, *connect])
            if access is not None:
                written["access_control"] = access
            config = zenoh.Config.from_json5(json.dumps(written))
            session = await aside(zenoh.open, config)
        except Exception as error:
            raise BusError(_open_problem(error)) from error
        except BaseException as error:
            if not _is_panic(error):
                raise
            raise BusError(f"zenoh: {plain(error)}") from error
        return cls(session, listen, lost)

    def declared(self, what: Declared) -> None:
        """Keep `what` alive until `close`, which undeclares it."""
        self._declared.append(what)

    def bridge(
        self,
        source: Iterable[T],
        sift: Callable[[T], Kept | None],
        handle: Callable[[Kept], None],
        *,
        name: str,
        turn_max: int = TURN_MAX,
    ) -> None:
        """A `Bridge` whose thread `close` waits for."""
        failed = self._reader_failed
        self._bridges.append(Bridge(source, sift, handle, name=name, failed=failed, turn_max=turn_max))

    async def serve(
        self,
        declare: Callable[[], "Source[T]"],
        sift: Callable[[T], Kept | None],
        handle: Callable[[Kept], None],
        *,
        name: str,
        turn_max: int = TURN_MAX,
    ) -> None:
        """Declare a subscriber or queryable and bridge it to the loop, also after `declare_anew`.

        Raises:
            BusError: the session is closed or lost.
        """
        service = _Service(declare, lambda source: self.bridge(source, sift, handle, name=name, turn_max=turn_max))
        try:
            await aside(service.begin)
        except zenoh.ZError as error:
            raise BusError(f"zenoh: {plain(error)}") from error
        service.read()
        self._services.append(service)

    async def declare_anew(self) -> None:
        """Declare once more what is served, for those who have lost sight of it; never raises.

        For an instant in between, what arrives finds nobody.
        """
        self._bridges = [bridge for bridge in self._bridges if bridge.alive]
        for service in tuple(self._services):
            try:
                await aside(service.begin)
                service.read()
            except Exception as error:
                logger.warning("declaring anew: %s", plain(error))
            except BaseException as error:
                if not self.panicked(error):
                    raise
                return

    def worker(self, name: str) -> Executor:
        """A thread, begun when needed, for what may wait for a program; `close` ends it."""
        worker = ThreadPoolExecutor(1, f"psiu-{name}")
        self._workers.append(worker)
        return worker

    def panicked(self, error: BaseException) -> bool:
        """True if `error` is a panic inside Zenoh: the session is given up and `lost` is told. Any thread."""
        if not _is_panic(error):
            return False
        if not self.is_lost:
            self.is_lost = True
            logger.error("the Zenoh session is lost: %s", plain(error))
            with suppress(RuntimeError):  # the loop is closed: nobody is left to tell
                self._loop.call_soon_threadsafe(self._lost, BusError(f"the Zenoh session was lost: {plain(error)}"))
        return True

    async def close(self) -> None:
        """Undeclare and close everything and wait for the threads; harmless twice, never raises."""
        await aside(self._close)

    def _close(self) -> None:
        atexit.unregister(self._close)
        close: Callable[[], None] = self.zenoh.close
        served = [service.end for service in self._services]
        for end in (*(what.undeclare for what in reversed(self._declared)), *served, close):
            try:
                end()
            except Exception as error:
                logger.debug("closing the bus: %s", plain(error))
            except BaseException as error:
                if not _is_panic(error):
                    raise
                logger.debug("closing the bus: %s", plain(error))
        self._declared.clear()
        self._services.clear()
        for bridge in self._bridges:
            bridge.join(_THREAD_END_S)
        self._bridges.clear()
        for worker in self._workers:
            worker.shutdown(wait=True)

    def _reader_failed(self, error: BaseException) -> None:
        if not self.panicked(error):
            logger.debug("a reader of the bus ended: %s", plain(error))


def _is_panic(error: BaseException) -> bool:
    # Its class cannot be imported; a BaseException, so that `except Exception` passes it by.
    return type(error).__name__ == "PanicException"


def tls_links(tls: TlsConfiguration, endpoints: Iterable[str]) -> dict[str, object]:
    """Zenoh's ``transport.link`` for one that shows its certificate at `endpoints`, and wants to see the other's."""
    return {
        # Zenoh would otherwise follow whoever answers its multicast to an endpoint without a certificate.
        "protocols": sorted({"tls", *(endpoint.partition("/")[0] for endpoint in endpoints)}),
        "tls": {
            "root_ca_certificate": tls.ca,
            "enable_mtls": True,
            "listen_certificate": tls.certificate,
            "listen_private_key": tls.key,
            "connect_certificate": tls.certificate,
            "connect_private_key": tls.key,
            # Addresses change. Only the certificates of brokers are for being called at all.
            "verify_name_on_connect": False,
        },
    }


def _configuration(listen: Sequence[str], connect: Sequence[str], mode: Mode, discover: bool) -> dict[str, Any]:
    return {
        "mode": mode,
        "listen": {"endpoints": list(listen), "exit_on_failure": True},
        "connect": {
            "endpoints": list(connect),
            "timeout_ms": -1,  # 0 would mean: never again, where nobody was there at first
            "exit_on_failure": False,
            "retry": {"period_init_ms": 250, "period_max_ms": 1000, "period_increase_factor": 2},
        },
        "scouting": {
            "delay": 0,
            "multicast": {
                "enabled": discover,
                "autoconnect": {mode: [mode]},
                "autoconnect_strategy": {mode: {f"to_{mode}": "greater-zid"}},  # one of two connects, not both
            },
            "gossip": {"enabled": False},  # it connects brokers once more that are connected already
        },
        "transport": {
            "shared_memory": {"enabled": False},
            "link": {
                "tx": {
                    **LEASE,
                    "queue": {"congestion_control": {"block": {"wait_before_close": int(STUCK_S * 1e6)}}},
                },
            },
        },
    }


def _open_problem(error: Exception) -> str:
    busy = _BUSY.search(str(error))
    if busy:
        return f"zenoh.listen: {busy['endpoint']} is in use (another broker?)"
    return f"zenoh: {plain(error)}"

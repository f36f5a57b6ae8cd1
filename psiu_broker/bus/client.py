"""A program on the bus: what the `psiu` tool uses. Everything here waits; nothing needs an event loop."""

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, Final, Literal
from uuid import uuid4

import zenoh
from pydantic import ValidationError
from pydantic_core import from_json

from psiu_broker.bus.keys import KEY_LENGTH_MAX, Keys
from psiu_broker.bus.session import JSON, LEASE, plain, tls_links
from psiu_broker.config import TlsConfiguration
from psiu_broker.config.certificates import read_certificate
from psiu_broker.errors import BusError, CallError, PsiuError
from psiu_broker.frame import Address
from psiu_broker.messages import Answer, CallRequest, Card, Refusal, Status

OPEN_TIMEOUT_S: Final = 2.5
"""Opening cannot be interrupted by Ctrl-C, so it may not take long."""

CALL_TIMEOUT_S: Final = 60.0
"""How long an answer is awaited where the request sets no deadline: more than any broker's own."""

DEADLINE_MARGIN_S: Final = 1.0
"""What the broker may take, beyond the request's deadline, to say that it passed."""


class Client:
    """One connection to the first of some brokers that answers; a context manager.

    Methods raise BusError where the connection or the key is at fault.
    """

    def __init__(self, connect: Sequence[str], prefix: str = "psiu", tls: TlsConfiguration | None = None) -> None:
        """Connect to one of the endpoints `connect`, which begin with ``tls/`` where there are keys `tls`.

        Raises:
            BusError: nobody answers there within `OPEN_TIMEOUT_S`.
        """
        self.keys: Final = Keys(prefix)
        self.program: Final = uuid4().hex
        """What it is called where it is missed when it ends without `close`."""
        self._token: zenoh.LivelinessToken | None = None
        self._tls = tls
        self._denial: CallError | None = None
        self._asked_rights = False
        self._session = _first_that_answers(list(connect), tls)

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        self.close(done=error is None)

    def close(self, *, done: bool = True) -> None:
        """Leave the bus; harmless twice. Robots that this program moved may go on where its work is `done`."""
        with suppress(zenoh.ZError):
            if self._token is not None and done and not self._session.is_closed():
                # Declarations arrive in their order, so that this one is known before the token goes.
                self._session.liveliness().declare_token(f"{self.keys.program(self.program)}/done")
            self._session.close()  # type: ignore[no-untyped-call]

    def get_json(self, key: str, timeout_s: float = 3.0) -> dict[str, Any]:
        """The JSON values that `key` (wildcards allowed) finds, by their own keys; empty if nobody answers.

        Raises:
            CallError: the only answer was a refusal.
            BusError: an answer is no JSON.
        """
        return {found: _json(found, payload) for found, payload in self._get(key, timeout_s)}

    def ask(self, *what: str, broker: str | None = None, timeout_s: float = 3.0) -> dict[str, Any]:
        """``ask("links")`` or ``ask("why", "A", "B")`` of one broker or all: the JSON values by broker.

        Raises:
            CallError: the only answer was a refusal.
        """
        key = self.keys.every_broker(*what) if broker is None else self.keys.broker(broker, *what)
        return {self.keys.read_broker(found)[0]: value for found, value in self.get_json(key, timeout_s).items()}

    def brokers(self, timeout_s: float = 3.0) -> list[Status]:
        """The status of every broker on the bus, by name.

        Raises:
            ValidationError: pydantic's: an answer is none that this version knows.
        """
        key = self.keys.every_broker("status")
        found = [Status.model_validate_json(payload) for _, payload in self._get(key, timeout_s)]
        return sorted(found, key=lambda status: status.broker)

    def cards(self, timeout_s: float = 3.0) -> list[Card]:
        """The robots that the brokers know, by name.

        Raises:
            ValidationError: as `brokers`.
        """
        found = [Card.model_validate_json(payload) for _, payload in self._get(self.keys.every_card, timeout_s)]
        return sorted(found, key=lambda card: card.robot)

    def call(self, robot: Address | str, command: str, request: CallRequest | None = None) -> Answer:
        """Send a command and wait for the robot's answer.

        Raises:
            CallError: there was none, and why.
        """
        request = request or CallRequest()
        wait_s = CALL_TIMEOUT_S if request.timeout_s is None else request.timeout_s + DEADLINE_MARGIN_S
        found = self._get(self._call_key(robot, command), wait_s, self._signed(request))
        if not found:
            self.refuse_where_denied()
            if self.brokers():
                raise CallError(
                    "outcome_unknown", "the broker that has the robot went away; it may have been done or not"
                )
            raise CallError("no_answer", "no broker on the bus takes calls")
        try:
            return Answer.model_validate_json(found[0][1])
        except ValidationError as error:
            raise CallError("outcome_unknown", "the broker answered in a form that this program cannot read") from error

    def put_call(self, robot: Address | str, command: str, request: CallRequest | None = None) -> None:
        """Send a command and go on; whether it arrived is not told.

        Raises:
            CallError: the broker would not take it from us.
        """
        request = request or CallRequest()
        self.refuse_where_denied()
        try:
            self._session.put(
                self._call_key(robot, command),
                self._signed(request),
                encoding=JSON,
                attachment=uuid4().bytes,
                congestion_control=zenoh.CongestionControl.BLOCK,
            )
        except zenoh.ZError as error:
            raise BusError(f"zenoh: {plain(error)}") from error

    def refuse_where_denied(self) -> None:
        """To be asked where a command has no answer: of what a broker's rules deny Zenoh tells nothing.

        Raises:
            CallError: they let us only listen.
        """
        if self._tls is None:
            return
        if not self._asked_rights:
            name = read_certificate(self._tls.certificate).name
            ours = {str(each.zid) for each in self._session.info.transports()}
            for broker in self.brokers():
                if broker.zenoh_id not in ours:
                    continue  # it takes what ours lets through
                config = self.ask("config", broker=broker.broker).get(broker.broker)
                if name not in _commanders(config, name):
                    text = f"broker {broker.broker} lets {name} only listen; nothing was sent"
                    self._denial = CallError("refused", f"{text} (zenoh.access in its configuration)")
            self._asked_rights = True
        if self._denial is not None:
            raise self._denial

    def monitor(self, key: str) -> Iterator[tuple[str, Literal["put", "delete"], bytes]]:
        """Every put and delete under `key` (wildcards allowed) as key, kind and payload, until interrupted."""
        try:
            with self._session.declare_subscriber(_checked(key), zenoh.handlers.RingChannel(65_536)) as subscriber:
                for sample in subscriber:
                    kind: Literal["put", "delete"] = "delete" if sample.kind == zenoh.SampleKind.DELETE else "put"
                    yield str(sample.key_expr), kind, sample.payload.to_bytes()
        except zenoh.ZError as error:
            raise BusError(f"zenoh: {plain(error)}") from error

    @contextmanager
    def listening(self, key: str, take: Callable[[bytes], None]) -> Iterator[None]:
        """Hand every payload put under `key` to `take`, on a thread of Zenoh's, for as long as the block lasts.

        `take` may neither wait nor raise.
        """
        try:
            subscriber = self._session.declare_subscriber(_checked(key), lambda sample: take(sample.payload.to_bytes()))
        except zenoh.ZError as error:
            raise BusError(f"zenoh: {plain(error)}") from error
        try:
            yield
        finally:
            with suppress(zenoh.ZError):
                subscriber.undeclare()  # type: ignore[no-untyped-call]

    def _signed(self, request: CallRequest) -> str:
        """`request` as one of this program, whose token is there from now on."""
        if self._token is None:
            try:
                self._token = self._session.liveliness().declare_token(self.keys.program(self.program))
            except zenoh.ZError as error:
                raise BusError(f"zenoh: {plain(error)}") from error
        request = request.model_copy(update={"program": request.program or self.program})
        return request.model_dump_json(exclude_none=True)

    def _call_key(self, robot: Address | str, command: str) -> str:
        return _checked(self.keys.call(Address.parse(robot) if isinstance(robot, str) else robot, command))

    def _get(self, key: str, timeout_s: float, payload: str | None = None) -> list[tuple[str, bytes]]:
        """The answers to a get; a refusal counts only where it is the only answer."""
        found: list[tuple[str, bytes]] = []
        refusals: list[PsiuError] = []
        try:
            replies = self._session.get(
                _checked(key),
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=timeout_s,
                payload=payload,
                encoding=JSON if payload is not None else None,
                attachment=uuid4().bytes if payload is not None else None,
            )
            for reply in replies:
                if reply.ok is not None:
                    found.append((str(reply.ok.key_expr), reply.ok.payload.to_bytes()))
                elif reply.err is not None:
                    refusals.append(_refusal(reply.err.payload.to_bytes(), timeout_s))
        except zenoh.ZError as error:
            raise BusError(f"zenoh: {plain(error)}") from error
        if not found and refusals:
            # Of several brokers, the one that knows the robot has the more to say.
            raise min(refusals, key=lambda error: isinstance(error, CallError) and error.code == "unknown_robot")
        return found


def _first_that_answers(connect: list[str], tls: TlsConfiguration | None) -> zenoh.Session:
    """Raises BusError."""
    for turn in range(len(connect)):
        # A Zenoh client tries the first endpoint again and again, and the others only if that connection is lost later.
        endpoints = connect[turn:] + connect[:turn]
        config = json.dumps(_configuration(endpoints, OPEN_TIMEOUT_S / len(connect), tls))
        try:
            return zenoh.open(zenoh.Config.from_json5(config))
        except zenoh.ZError as error:
            if "Unable to connect" not in str(error):
                raise BusError(f"zenoh: {plain(error)}") from error
    why = "is psiu-broker running?" if tls is None else f"is it running, and has it keys by {tls.ca}?"
    raise BusError(f"no broker answers at {' or '.join(connect)}; {why}")


def _configuration(endpoints: list[str], timeout_s: float, tls: TlsConfiguration | None) -> dict[str, object]:
    return {
        "mode": "client",
        "connect": {
            "endpoints": endpoints,
            "timeout_ms": int(timeout_s * 1000),
            "exit_on_failure": True,
            "retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2},
        },
        "scouting": {"multicast": {"enabled": False}},
        "transport": {
            "shared_memory": {"enabled": False},
            # As brokers: a program that is cut off or hangs is missed as soon.
            "link": {"tx": LEASE} | ({} if tls is None else tls_links(tls, endpoints)),
        },
    }


def _checked(key: str) -> str:
    """`key`, if Zenoh can carry it; a key that is too long would break the connection."""
    if len(key.encode(errors="replace")) > KEY_LENGTH_MAX:
        raise BusError(f"a key of {len(key)} characters is too long")
    try:
        zenoh.KeyExpr(key)
    except (zenoh.ZError, UnicodeEncodeError) as error:
        raise BusError(f"not a key: {plain(error)}") from error
    return key


def _json(key: str, payload: bytes) -> Any:
    try:
        return from_json(payload)
    except ValueError as error:
        raise BusError(f"the broker's answer cannot be read: {key} is no JSON: {error}") from error


def _commanders(config: Any, default: str) -> Sequence[str]:
    """Whom a broker with that configuration lets command; `default` where it does not say."""
    try:
        access = config["zenoh"]["access"]
        return (*access["brokers"], *access["commanders"])
    except (KeyError, TypeError):  # no rules; or told in words that this program does not know
        return (default,)


def _refusal(payload: bytes, timeout_s: float) -> PsiuError:
    try:
        refusal = Refusal.model_validate_json(payload)
    except ValidationError:
        if payload == b"Timeout":
            return CallError("outcome_unknown", f"the broker did not answer within {timeout_s:g} s")
        return CallError("outcome_unknown", f"the broker answered: {payload[:200].decode(errors='replace')}")
    return CallError(refusal.error, refusal.message)

"""Whatever a program asks of whichever key, it hears what the schema of the answer says, or why not."""

import asyncio
import json
import logging
from collections.abc import AsyncIterator
from functools import cache
from typing import Any, Final

import pytest
import zenoh
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from jsonschema import Draft202012Validator
from quiet import NOW, Quiet
from schema_values import values_of

from psiu_broker.bus.calls import Calls
from psiu_broker.bus.keys import Keys
from psiu_broker.bus.queries import Queries
from psiu_broker.bus.session import Session
from psiu_broker.bus.traces import Traces
from psiu_broker.frame import Address
from psiu_broker.mesh.probe import Probed
from psiu_broker.messages import PUBLISHED, Answer, CallRequest, Card, Link, Refusal, Trace, Why

MODELS: Final = {model.__name__: model for model in (*PUBLISHED, Probed)}


class Broker(Quiet):
    """One that knows whoever it is asked for."""

    def links(self) -> list[Link]:
        return [Link(name="radio", adapter="serial", protocol="psiu-ascii", state="open", since=NOW)]

    def why(self, a: Address, b: Address) -> Why:
        return Why(a=str(a), b=str(b), delivered=True, verdict="delivered", steps=[])

    def robots(self) -> list[Address]:
        return [Address.named("MNERIM"), Address.numbered(0x12)]

    def card(self, robot: Address) -> Card | None:
        return Card(robot=str(robot), protocol="psiu-ascii", broker="base", link="radio", link_state="open")

    def release(self, robot: Address, link: str) -> bool:
        return True

    async def trace(self, a: Address, b: Address) -> Trace | None:
        return Trace(a=str(a), b=str(b), question="ping", answered=True, total_ms=1)

    async def probed(self, robot: Address) -> Probed:
        return Probed(question="ping", answered=True, took_ms=3)

    async def call(self, robot: Address, command: str, request: CallRequest) -> Answer:
        return Answer(status="sucesso", values=request.parameters, elapsed_ms=1)

    async def send(self, robot: Address, command: str, request: CallRequest) -> None: ...


@pytest.fixture
async def serving(session: Session, keys: Keys) -> AsyncIterator[None]:
    broker = Broker()
    await Queries.open(session, keys, "base", broker)
    calls = await Calls.open(session, keys, broker.call, broker.send)
    traces = await Traces.open(session, keys, "base", broker.trace, broker.probed)
    yield
    await calls.close()
    await traces.close()


def is_key(text: str) -> bool:
    try:
        zenoh.KeyExpr(text)
    except zenoh.ZError:
        return False
    return True


chunks = st.sampled_from(["MNERIM", "0x12", "red.0x03", "%", "%ED%A0%80", "base", "João", "*", "**"]) | st.text(
    max_size=8
).filter(is_key)
tables = st.sampled_from(
    ["status", "links", "trunks", "routes", "ledger", "ledger-of-robots", "health", "mesh", "conflicts", "config", "*"]
)
asked = st.one_of(
    st.tuples(chunks),
    st.tuples(st.just("@broker"), chunks, tables),
    st.tuples(
        st.just("@broker"), st.just("base"), st.sampled_from(["why", "trace", "release"]) | chunks, chunks, chunks
    ),
    st.tuples(st.just("@mesh/probe/base"), chunks),
    st.tuples(st.just("@call"), chunks, chunks),
).map(lambda parts: "/".join(("psiu", *parts)))
payloads = st.one_of(
    st.none(),
    st.binary(max_size=20),
    values_of(CallRequest.model_json_schema()).map(lambda each: json.dumps(each).encode()),
)


@cache
def validator(name: str) -> Draft202012Validator:
    return Draft202012Validator(MODELS[name].model_json_schema(mode="serialization"))


def check(reply: zenoh.Reply, key: str) -> None:
    if reply.ok is None:
        refusal = Refusal.model_validate_json(reply.err.payload.to_bytes())
        assert refusal.error == "bad_request", refusal.message
        return
    assert zenoh.KeyExpr(key).intersects(reply.ok.key_expr)
    told: Any = json.loads(reply.ok.payload.to_bytes())
    media, _, schema = str(reply.ok.encoding).partition(";psiu/")
    assert media == "application/json"
    if schema.endswith("[]"):
        assert isinstance(told, list)
    elif not schema:
        assert str(reply.ok.key_expr).endswith("/config")  # it has the user's own form
        return
    for each in told if schema.endswith("[]") else [told]:
        validator(schema.removesuffix("[]")).validate(each)


async def test_whatever_is_asked_the_answer_fits_its_schema_or_is_a_refusal_in_words(
    serving: None, program: zenoh.Session, caplog: pytest.LogCaptureFixture
) -> None:
    answered: set[str] = set()

    @given(key=asked.filter(is_key), payload=payloads)
    @example(key="psiu/%ED%A0%80", payload=None)
    @settings(
        max_examples=300, deadline=None, suppress_health_check=[HealthCheck.filter_too_much, HealthCheck.too_slow]
    )
    def ask(key: str, payload: bytes | None) -> None:
        for reply in program.get(key, payload=payload, timeout=5):
            check(reply, key)
            chunk = key.split("/")[1]
            answered.add(chunk if chunk.startswith("@") else "card")

    with caplog.at_level(logging.WARNING):
        await asyncio.to_thread(ask)
    assert caplog.text == ""
    assert answered == {"@broker", "@call", "@mesh", "card"}

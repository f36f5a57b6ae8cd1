"""What comes from the bus as JSON, made from the schemas that programs are told: taken, or refused as declared."""

import contextlib
import json
import re
from functools import partial
from pathlib import Path
from typing import Any, Final

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from jsonschema import Draft202012Validator
from mesh.simulated import Simulation
from pydantic import BaseModel, ValidationError
from schema_values import values_of

import psiu_broker
from psiu_broker.bus.calls import read_request
from psiu_broker.errors import CallError
from psiu_broker.mesh.beat import Beat, Notice
from psiu_broker.mesh.probe import Probed
from psiu_broker.messages import PUBLISHED, CallRequest
from psiu_broker.protocols import PROTOCOLS

MODELS: Final[tuple[type[BaseModel], ...]] = (*PUBLISHED, Beat, Notice, Probed)

anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=10), inner, max_size=4),
    max_leaves=12,
)
fits = partial(settings, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much])


def schema_of(model: type[BaseModel]) -> dict[str, Any]:
    return model.model_json_schema()


def fitting(model: type[BaseModel]) -> st.SearchStrategy[dict[str, Any]]:
    """What fits its schema."""
    return values_of(schema_of(model)).map(_with_lanes) if model is Beat else values_of(schema_of(model))


def _with_lanes(beat: dict[str, Any]) -> dict[str, Any]:
    """JSON schema does not tell that the lanes, which are keys, are numbers."""
    sent = {name: (epoch, dict(enumerate(counts.values()))) for name, (epoch, counts) in beat.get("sent", {}).items()}
    return beat | {"sent": sent}


@given(request=fitting(CallRequest))
@fits(max_examples=100)
def test_a_request_that_fits_the_schema_is_taken(request: dict[str, Any]) -> None:
    taken = read_request(json.dumps(request).encode())
    assert taken.parameters == request.get("parameters", [])


@given(request=fitting(CallRequest), name=st.sampled_from(["parameters", "timeout_s", "x"]), value=anything)
@fits(max_examples=200)
def test_a_request_that_does_not_fit_is_refused_in_words(request: dict[str, Any], name: str, value: object) -> None:
    payload = json.dumps(request | {name: value}).encode()
    try:
        read_request(payload)
    except CallError as error:
        assert error.code == "bad_request"
    else:
        assert not list(Draft202012Validator(schema_of(CallRequest)).iter_errors(json.loads(payload)))


@pytest.mark.parametrize(
    "payload", [b'{"timeout_s": true}', b'{"timeout_s": "5"}', b'{"retries": true}', b'{"retries": "2"}']
)
def test_what_only_looks_like_a_number_is_none(payload: bytes) -> None:
    with pytest.raises(CallError, match="expected"):
        read_request(payload)


@given(
    payload=st.one_of(
        st.binary(max_size=60), st.text(max_size=60).map(str.encode), anything.map(json.dumps).map(str.encode)
    )
)
@fits(max_examples=200)
def test_no_payload_raises_what_is_not_declared(payload: bytes) -> None:
    try:
        read_request(payload)
    except CallError as error:
        assert error.code == "bad_request"


@pytest.mark.parametrize(
    "payload", [b"[" * 60_000, b'{"parameters":' * 4000, b'{"parameters":[' + b"9" * 60_000 + b"]}"]
)
def test_nested_and_endless_payloads_are_refused(payload: bytes) -> None:
    with pytest.raises(CallError):
        read_request(payload)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_no_profile_raises_at_what_fits_the_schema_but_a_call_error(protocol: str) -> None:
    entry = PROTOCOLS[protocol]
    profile = entry.profile.make(entry.codec.Options(), entry.profile.Options(), 1.0)
    commands = st.sampled_from([command.name for command in profile.commands()]) | st.text(max_size=12)

    @given(request=fitting(CallRequest), command=commands)
    @fits(max_examples=60)
    def called(request: dict[str, Any], command: str) -> None:
        try:
            asked = profile.request(command, read_request(json.dumps(request).encode()).parameters)
        except CallError:
            return
        profile.answers_to(asked)

    called()


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.__name__)
def test_of_each_message_whatever_fits_its_schema_is_read(model: type[BaseModel]) -> None:
    @given(value=fitting(model))
    @fits(max_examples=50)
    def came(value: object) -> None:
        model.model_validate_json(json.dumps(value))

    came()


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.__name__)
def test_of_each_message_whatever_does_not_fit_raises_nothing_but_what_is_declared(model: type[BaseModel]) -> None:
    names = st.sampled_from(sorted(model.model_fields))

    @given(value=fitting(model), name=names, other=anything)
    @fits(max_examples=50)
    def came(value: dict[str, Any], name: str, other: object) -> None:
        for spoilt in (value | {name: other}, {each: value[each] for each in value if each != name}, other):
            with contextlib.suppress(ValidationError):
                model.model_validate_json(json.dumps(spoilt))

    came()


def test_every_message_that_the_bus_brings_is_among_them() -> None:
    package = Path(psiu_broker.__file__).parent
    read = {
        name
        for part in ("bus", "mesh")
        for file in (package / part).glob("*.py")
        for name in re.findall(r"(\w+)\.model_validate_json\(", file.read_text())
    }
    assert read
    assert read <= {model.__name__ for model in MODELS}


@given(
    beats=st.lists(fitting(Beat), max_size=3),
    notices=st.lists(fitting(Notice), max_size=3),
    broker=st.sampled_from(["A", "B", "C"]),
)
@fits(max_examples=25)
def test_whatever_beats_and_notices_come_the_mesh_goes_on(
    beats: list[dict[str, Any]], notices: list[dict[str, Any]], broker: str
) -> None:
    simulation = Simulation(("A", "B"))
    simulation.run(1)
    mesh = simulation.stations["A"].mesh
    for told in beats:
        try:
            mesh.beat_came(Beat.model_validate_json(json.dumps(told | {"broker": broker})), simulation.now)
        except ValidationError:
            continue
    for told in notices:
        try:
            mesh.notice_came(Notice.model_validate_json(json.dumps(told | {"broker": broker})), simulation.now)
        except ValidationError:
            continue
    simulation.run(1)

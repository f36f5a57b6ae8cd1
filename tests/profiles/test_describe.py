"""A frame in the words of a decoded message."""

from collections.abc import Mapping
from datetime import UTC, datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.codecs import psiu_hexa
from psiu_broker.frame import EVERYONE, Address, Frame
from psiu_broker.messages import Decoded
from psiu_broker.profiles import Node, describe

ARM = Address.numbered(0x12)
BASE = Address.numbered(1)
NODES: Mapping[int, tuple[str, Node]] = {
    4: ("garra", Node(node=4, type="servo")),
    7: ("sonar", Node(node=7, type="distance", unit="cm")),
}


def nodes(address: Address) -> Mapping[int, tuple[str, Node]]:
    return NODES if address == ARM else {}


def described(frame: Frame) -> dict[str, object]:
    """Only what differs from an empty description."""
    return {key: value for key, value in describe(frame, nodes).items() if value not in (None, [])}


def words(message: str, destination: str = "PC") -> dict[str, object]:
    return described(Frame(Address.named("MNERIM"), Address.named(destination), "", message.encode(), "psiu-ascii"))


def packet(*payload: int, source: Address = BASE, destination: Address = ARM) -> dict[str, object]:
    return described(psiu_hexa.packet(source, destination, bytes(payload)))


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        ("parafrente 100", {"kind": "command", "command": "parafrente", "parameters": [100]}),
        ("fale oi 1.25", {"kind": "command", "command": "fale", "parameters": ["oi", 1.25]}),
        ("parafrente sucesso", {"kind": "response", "command": "parafrente", "status": "sucesso"}),
        ("parafrente OK", {"kind": "response", "command": "parafrente", "status": "sucesso"}),
        ("parafrente RespFALHA", {"kind": "response", "command": "parafrente", "status": "falha"}),
        ("meca sucesso 12", {"kind": "response", "command": "meca", "status": "sucesso", "parameters": [12]}),
        ("quantoscomandos", {"kind": "command", "command": "quantoscomandos"}),
        ("quantoscomandos 6", {"kind": "response", "command": "quantoscomandos", "parameters": [6]}),
        ("exibecomando 1", {"kind": "command", "command": "exibecomando", "parameters": [1]}),
        (
            "exibecomando parafrente 1 0 0",
            {"kind": "response", "command": "exibecomando", "parameters": ["parafrente", 1, 0, 0]},
        ),
        ("qualseunome", {"kind": "response", "command": "qualseunome"}),
    ],
)
def test_words_are_commands_or_responses(message: str, expected: dict[str, object]) -> None:
    assert words(message) == expected


def test_qualseunome_to_everyone_is_a_question() -> None:
    assert words("qualseunome", str(EVERYONE)) == {"kind": "command", "command": "qualseunome"}


@pytest.mark.parametrize(
    ("payload", "kind"),
    [
        ((), "ping"),
        ((65,), "ack"),
        ((78,), "nak"),
        ((66,), "busy"),
        ((63,), "available"),
        ((70,), "free"),
        ((87,), "wtf"),
    ],
)
def test_the_commands_of_the_table_are_kinds(payload: tuple[int, ...], kind: str) -> None:
    assert packet(*payload) == {"kind": kind}


def test_another_command_byte_is_named_by_its_number() -> None:
    assert packet(200) == {"kind": "command", "command": "command/200"}


def test_a_named_actuator_shows_its_value() -> None:
    expected = {"kind": "node", "command": "garra", "node": 4, "signal": 0x80, "value": -90.0, "unit": "deg"}
    assert packet(4, 0x80) == expected


def test_a_question_to_a_sensor_has_no_value() -> None:
    assert packet(7, 0) == {"kind": "node", "command": "sonar", "node": 7, "signal": 0}


def test_a_node_that_nobody_named_is_its_number() -> None:
    assert packet(9, 1) == {"kind": "node", "node": 9, "signal": 1}
    assert packet(4, 1, source=ARM, destination=BASE) == {"kind": "node", "node": 4, "signal": 1}
    assert packet(0, 42, source=ARM, destination=BASE) == {"kind": "node", "node": 0, "signal": 42}


def test_a_complex_packet_shows_its_fields() -> None:
    assert packet(2, 1, 2, 0xAA, 0xBB, 0xCC) == {"kind": "complex", "fields": ["aa", "bbcc"]}
    assert packet(9, 1, 2) == {"kind": "complex", "remark": "the field sizes do not add up"}


def test_what_the_codec_forgave_is_passed_on() -> None:
    frame = Frame(BASE, ARM, "x", b"x", "psiu-ascii", remark="wrong size")
    assert described(frame)["remark"] == "wrong size"


@given(st.sampled_from(["psiu-ascii", "psiu-hexa", "mitya"]), st.binary(max_size=300), st.text(max_size=5))
def test_any_payload_makes_a_valid_message(protocol: str, payload: bytes, subject: str) -> None:
    description = describe(Frame(BASE, ARM, subject, payload, protocol), nodes)
    message = Decoded(
        source="a", destination="b", protocol=protocol, broker="base", link="radio",
        received=datetime.now(UTC), wire="", **description,
    )  # fmt: skip
    assert Decoded.model_validate_json(message.model_dump_json()).kind == description["kind"]

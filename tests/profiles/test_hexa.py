"""PSIU HEXA robots: calls by node name, and what the robot's packets say about them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.codecs import psiu_hexa
from psiu_broker.errors import CallError
from psiu_broker.frame import Address, Frame
from psiu_broker.messages import Value
from psiu_broker.profiles import HexaProfile, Node, Notice, Reply
from psiu_broker.profiles.hexa import RESERVED

ARM = Address.numbered(0x12)
BASE = Address.numbered(1)
PROFILE = HexaProfile(
    {
        "garra": Node(node=4, type="servo"),
        "luz": Node(node=5, type="on-off"),
        "sonar": Node(node=7, type="distance", unit="cm"),
        "fim": Node(node=8, type="switch"),
    }
)


def heard(*payload: int) -> Frame:
    return psiu_hexa.packet(ARM, BASE, bytes(payload))


def error(command: str, *parameters: Value) -> CallError:
    with pytest.raises(CallError) as caught:
        PROFILE.request(command, parameters)
    return caught.value


@pytest.mark.parametrize(
    ("command", "parameters", "payload", "question"),
    [
        ("ping", [], "", True),
        ("garra", [-90], "0480", False),
        ("garra", [90], "047f", False),
        ("garra", ["45.5"], "0440", False),
        ("luz", ["on"], "05ff", False),
        ("luz", [0], "0500", False),
        ("sonar", [], "0700", True),
        ("node", [9, 200], "09c8", False),
        ("node", ["9", "-1"], "09ff", False),
        ("complex", ["aa", "bbcc"], "020102aabbcc", False),
        ("complex", ["0xaa", "0xBBCC"], "020102aabbcc", False),
        ("complex", ["", "aa"], "020001aa", False),
    ],
)
def test_a_call_becomes_a_packet(command: str, parameters: list[Value], payload: str, question: bool) -> None:
    request = PROFILE.request(command, parameters)
    assert (request.payload.hex(), request.question) == (payload, question)
    assert request.subject == psiu_hexa.packet(BASE, ARM, request.payload).subject


@pytest.mark.parametrize(
    ("command", "parameters", "message"),
    [
        ("ping", [1], "ping takes no parameters, got 1"),
        ("garra", [91], "garra takes -90 to 90 deg, got 91"),
        ("garra", [], "garra takes one value, got nothing"),
        ("garra", [1, 2], "garra takes one value, got 1 2"),
        ("luz", ["talvez"], "luz takes on or off, got talvez"),
        ("sonar", [1], "sonar is a sensor and takes no parameters, got 1"),
        ("node", [0, 1], "node takes a node 1–255 and a signal -128 to 255, got 0 1"),
        ("node", [1], "node takes a node 1–255 and a signal -128 to 255, got 1"),
        ("node", [1, 256], "node takes a node 1–255 and a signal -128 to 255, got 1 256"),
        ("node", ["a", 1], "node takes a node 1–255 and a signal -128 to 255, got a 1"),
    ],
)
def test_what_no_node_can_do_is_refused_and_says_why(command: str, parameters: list[Value], message: str) -> None:
    caught = error(command, *parameters)
    assert (caught.code, str(caught)) == ("refused", message)


@pytest.mark.parametrize("parameters", [[], ["xy"], [55], ["a"], [""], ["00" * 256], ["00"] * 256])
def test_a_complex_packet_that_cannot_be_one_is_refused(parameters: list[Value]) -> None:
    assert error("complex", *parameters).code == "refused"


def test_an_unknown_command_names_its_neighbour_and_all_there_are() -> None:
    caught = error("gara", 10)
    assert caught.code == "unknown_command"
    assert str(caught) == "no command gara: did you mean garra? It has ping, garra, luz, sonar, fim, node, complex"


@pytest.mark.parametrize(
    ("payload", "notice"),
    [(78, Notice.AGAIN), (66, Notice.BUSY), (70, Notice.FREE), (87, Notice.IMPOSSIBLE)],
)
@pytest.mark.parametrize(("command", "parameters"), [("ping", []), ("garra", [1]), ("sonar", []), ("complex", ["aa"])])
def test_the_commands_of_the_table_are_notices_whatever_was_asked(
    payload: int, notice: Notice, command: str, parameters: list[Value]
) -> None:
    assert PROFILE.read(PROFILE.request(command, parameters), heard(payload)) is notice


@pytest.mark.parametrize(("command", "parameters"), [("garra", [1]), ("node", [9, 1]), ("complex", ["aa"])])
def test_ack_is_success(command: str, parameters: list[Value]) -> None:
    assert PROFILE.read(PROFILE.request(command, parameters), heard(65)) == Reply("sucesso")


def test_a_ping_is_answered_by_a_ping_alone() -> None:
    request = PROFILE.request("ping", [])
    assert PROFILE.read(request, heard()) == Reply("sucesso")
    assert PROFILE.read(request, heard(65)) is None
    assert PROFILE.read(request, heard(0, 42)) is None
    assert PROFILE.read(PROFILE.request("garra", [1]), heard()) is None


def test_a_sensor_answers_as_node_0_in_its_unit() -> None:
    assert PROFILE.read(PROFILE.request("sonar", []), heard(0, 42)) == Reply(None, (42,), "cm")
    assert PROFILE.read(PROFILE.request("fim", []), heard(0, 255)) == Reply(None, (1,))
    assert PROFILE.read(PROFILE.request("sonar", []), heard(7, 42)) is None
    assert PROFILE.read(PROFILE.request("sonar", []), heard(65)) is None


def test_a_raw_node_that_nobody_named_tells_its_signal() -> None:
    assert PROFILE.read(PROFILE.request("node", [9, 0]), heard(0, 42)) == Reply(None, (42,))


def test_an_actuator_does_not_answer_as_a_sensor() -> None:
    assert PROFILE.read(PROFILE.request("garra", [1]), heard(0, 42)) is None


def test_a_robot_that_marks_answers_with_bit_7_is_read_so() -> None:
    profile = HexaProfile({"sonar": Node(node=7, type="distance")}, sensor_reply="bit7")
    request = profile.request("sonar", [])
    assert profile.read(request, heard(0x87, 42)) == Reply(None, (42,))
    assert profile.read(request, heard(0, 42)) is None


def test_a_complex_answer_is_its_fields() -> None:
    request = PROFILE.request("complex", ["aa"])
    assert PROFILE.read(request, heard(2, 1, 2, 0xAA, 0xBB, 0xCC)) == Reply(None, ("aa", "bbcc"))
    assert PROFILE.read(request, heard(2, 9, 9, 0xAA)) is None
    assert PROFILE.read(PROFILE.request("garra", [1]), heard(1, 1, 0xAA)) is None


def test_commands_are_the_ping_the_nodes_and_the_raw_packets() -> None:
    commands = {command.name: command for command in PROFILE.commands()}
    assert list(commands) == ["ping", "garra", "luz", "sonar", "fim", "node", "complex"]
    garra = commands["garra"]
    assert (garra.ints, garra.floats, garra.minimum, garra.maximum, garra.unit) == (0, 1, -90, 90, "deg")
    assert (commands["luz"].ints, commands["luz"].maximum) == (1, 1)
    assert (commands["sonar"].ints, commands["sonar"].floats, commands["sonar"].unit) == (0, 0, "cm")


def test_no_node_can_take_the_name_of_a_command_that_is_not_its_own() -> None:
    raw = {command.name for command in HexaProfile({}).commands()}
    assert raw | {"qualseunome", "quantoscomandos", "exibecomando", "exibecomandos"} == RESERVED


def test_a_busy_robot_is_asked_with_avail() -> None:
    assert PROFILE.poll is not None
    assert (PROFILE.poll.subject, PROFILE.poll.payload) == ("available", b"?")


@given(st.binary(max_size=40), st.sampled_from(["ping", "garra", "sonar", "complex"]))
def test_reading_never_raises(payload: bytes, command: str) -> None:
    parameters: dict[str, list[Value]] = {"garra": [1], "complex": ["aa"]}
    PROFILE.read(PROFILE.request(command, parameters.get(command, [])), psiu_hexa.packet(ARM, BASE, payload))

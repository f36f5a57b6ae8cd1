"""What a signal byte means in the unit of a node's type, both ways."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from psiu_broker.messages import Value
from psiu_broker.profiles import Node

SERVO = Node(node=4, type="servo")


@pytest.mark.parametrize(
    ("degrees", "signal"), [(0, 0), (-90, 0x80), (90, 0x7F), (45, 64), (-45, 0xC0), (89.9, 0x7F), ("30", 42), (-0.1, 0)]
)
def test_a_servo_takes_degrees_piecewise(degrees: Value, signal: int) -> None:
    assert SERVO.signal(degrees) == signal


@pytest.mark.parametrize(("signal", "degrees"), [(0, 0), (0x80, -90), (0x7F, 90), (0xC0, -45), (1, 0.71), (0xFF, -0.7)])
def test_a_servo_tells_degrees(signal: int, degrees: float) -> None:
    assert SERVO.value(signal) == degrees


@given(st.floats(-90, 90))
def test_degrees_come_back_within_one_step(degrees: float) -> None:
    assert abs(SERVO.value(SERVO.signal(degrees)) - degrees) <= 90 / 127 / 2 + 0.01


@given(st.integers(0, 255))
def test_every_servo_signal_comes_back_as_itself(signal: int) -> None:
    assert SERVO.signal(SERVO.value(signal)) == signal


@pytest.mark.parametrize("kind", ["dc-open", "dc", "stepper", "linear"])
@given(value=st.integers(0, 255))
def test_unsigned_actuators_take_the_byte_itself(kind: str, value: int) -> None:
    node = Node.model_validate({"node": 1, "type": kind})
    assert node.signal(value) == value
    assert node.value(value) == value


@pytest.mark.parametrize("kind", ["dc-open", "dc", "stepper"])
@given(value=st.integers(-127, 127))
def test_signed_actuators_take_both_directions(kind: str, value: int) -> None:
    node = Node.model_validate({"node": 1, "type": kind, "signed": True})
    assert node.signal(value) == value % 256
    assert node.value(node.signal(value)) == value


@pytest.mark.parametrize(
    ("value", "signal"), [(0, 0), (1, 255), ("on", 255), ("off", 0), ("ON", 255), ("1", 255), ("0", 0), (1.0, 255)]
)
def test_on_off_takes_on_and_off(value: Value, signal: int) -> None:
    node = Node(node=1, type="on-off")
    assert node.signal(value) == signal
    assert node.value(signal) == (1 if signal else 0)


@pytest.mark.parametrize(
    ("node", "value", "message"),
    [
        (SERVO, 91, "takes -90 to 90 deg, got 91"),
        (SERVO, -90.1, "takes -90 to 90 deg, got -90.1"),
        (SERVO, "alto", "takes -90 to 90 deg, got alto"),
        (SERVO, float("nan"), "takes -90 to 90 deg, got nan"),
        (Node(node=1, type="on-off"), 255, "takes on or off, got 255"),
        (Node(node=1, type="on-off"), "sim", "takes on or off, got sim"),
        (Node(node=1, type="on-off"), 0.5, "takes on or off, got 0.5"),
        (Node(node=1, type="dc-open"), -1, "takes 0–255, got -1"),
        (Node(node=1, type="dc", signed=True), -128, "takes -127 to 127, got -128"),
        (Node(node=1, type="stepper"), 10.5, "takes 0–255 steps, got 10.5"),
        (Node(node=1, type="linear", unit="%"), 256, "takes 0–255 %, got 256"),
        (Node(node=1, type="linear"), float("inf"), "takes 0–255, got inf"),
    ],
)
def test_a_value_out_of_range_is_refused_with_what_the_node_takes(node: Node, value: Value, message: str) -> None:
    with pytest.raises(ValueError, match=r"^takes ") as caught:
        node.signal(value)
    assert str(caught.value) == message


def test_sensors_tell_the_byte_and_switches_on_or_off() -> None:
    assert Node(node=1, type="distance").value(200) == 200
    assert Node(node=1, type="acceleration", signed=True).value(200) == -56
    assert [Node(node=1, type="switch").value(signal) for signal in (0, 1, 255)] == [0, 1, 1]


def test_units_are_the_users_or_the_types() -> None:
    assert SERVO.shown_unit == "deg"
    assert Node(node=1, type="distance").shown_unit is None
    assert Node(node=1, type="distance", unit="cm").shown_unit == "cm"


@pytest.mark.parametrize(
    "fields",
    [
        {"node": 0, "type": "servo"},
        {"node": 256, "type": "servo"},
        {"node": 1, "type": "garra"},
        {"node": 1, "type": "servo", "signed": True},
        {"node": 1, "type": "on-off", "signed": True},
        {"node": 1, "type": "servo", "units": "deg"},
    ],
)
def test_a_node_that_makes_no_sense_is_refused(fields: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        Node.model_validate(fields)

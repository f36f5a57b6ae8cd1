"""What a person sees of each simulated robot: where it is, its motors, wheels, head and pins."""

from collections.abc import Iterator, Mapping
from typing import Any, Final, NamedTuple

from psiu_broker.profiles.mitya import MOODS
from psiu_broker.profiles.node import Node
from psiu_broker.simulator import AmarinoBoard, AsciiRobot, FirmataBoard, HexaRobot, MityaBody, SoccerRobot
from psiu_broker.simulator import firmata as uno

Nodes = Mapping[int, tuple[str, Node]]
"""The named nodes of a robot of bytes."""


class Seen(NamedTuple):
    """One thing about a robot: what it is called in JSON, how it is now in words, and the same as fields."""

    event: str
    text: str
    fields: Mapping[str, Any]


def position(robot: AsciiRobot) -> Iterator[Seen]:
    x, y, heading = robot.position
    text = f"is at x {x:.0f} cm, y {y:.0f} cm, heading {heading:.0f} deg"
    yield Seen("position", text, {"x_cm": x, "y_cm": y, "heading_deg": heading})


def signals(robot: HexaRobot, nodes: Nodes) -> Iterator[Seen]:
    """The signal of every node, in the unit of its type where it has a name."""
    for number, signal in robot.signals.items():
        name, node = nodes.get(number, (f"node {number}", None))
        value = None if node is None else node.value(signal)
        shown = f"signal {signal}" if node is None else f"{value:g} {node.shown_unit or ''} (signal {signal})"
        fields = {"node": number, "name": name, "signal": signal, "value": value}
        yield Seen("signal", f"{name} is at {shown}", fields)


def body(robot: MityaBody) -> Iterator[Seen]:
    """The motors, the servos, the lights and the mood; what it did and how often; the script it is busy with."""
    now = robot.body
    yield Seen("motors", f"motors at {now.left} left, {now.right} right", {"left": now.left, "right": now.right})
    across, up = now.head_horizontal, now.head_vertical
    yield Seen("head", f"head at {across} deg across, {up} deg up", {"horizontal_deg": across, "vertical_deg": up})
    yield Seen("tail", f"tail at {now.tail} deg", {"tail_deg": now.tail})
    yield Seen("headlights", f"headlights {'on' if now.headlights else 'off'}", {"on": now.headlights})
    mood = _MOODS.get(now.mood, f"{now.mood:04X}")
    yield Seen("mood", f"looks {mood}", {"mood": mood})
    yield Seen("fired", f"fires, shot {now.shots}", {"shots": now.shots})
    gestures = now.gestures
    last = gestures[-1] if gestures else None
    yield Seen("gesture", f"does {last}, gesture {len(gestures)}", {"gesture": last, "count": len(gestures)})
    slot = robot.recording
    yield Seen(
        "recording",
        "records no more" if slot is None else f"records script {slot}, and is silent meanwhile",
        {"slot": slot},
    )
    for number in range(10):
        actions = len(robot.scripts.get(number, ()))
        yield Seen("script", f"script {number} has {actions} actions", {"slot": number, "actions": actions})


def wheels(robot: SoccerRobot) -> Iterator[Seen]:
    values = list(robot.wheels)
    words = " ".join(map(str, values))
    yield Seen("wheels", f"robot {robot.address}: {words}", {"robot": robot.address, "wheels": values})
    dropped = robot.dropped
    yield Seen("dropped", f"robot {robot.address} dropped {dropped}", {"robot": robot.address, "dropped": dropped})


def pins(robot: FirmataBoard) -> Iterator[Seen]:
    """Every pin that is not the serial line, and what the board was told in strings."""
    yield Seen("reset", "forgets everything and begins anew", {"resets": robot.resets})
    for pin in range(2, uno.PINS):
        mode, state = _MODES.get(robot.modes[pin], str(robot.modes[pin])), robot.states[pin]
        name = f"A{pin - uno.FIRST_ANALOG}" if pin >= uno.FIRST_ANALOG else f"D{pin}"
        fields = {"pin": pin, "name": name, "mode": mode, "state": state}
        yield Seen("pin", f"{name} is {mode}" + (f", at {state}" if mode in _DRIVEN else ""), fields)
    last = robot.texts[-1] if robot.texts else None
    yield Seen("text", f"is told {last!r}", {"text": last})


def board(robot: AmarinoBoard) -> Iterator[Seen]:
    text = "crashes: it is dead until Ctrl-C" if robot.crashed else "is alive"
    yield Seen("crashed", text, {"crashed": robot.crashed})


_MOODS: Final = {value: name for name, value in MOODS.items()}
_MODES: Final = {
    uno.INPUT: "input", uno.OUTPUT: "output", uno.ANALOG: "analog", uno.PWM: "pwm", uno.SERVO: "servo",
    uno.I2C: "i2c", uno.PULLUP: "pullup",
}  # fmt: skip
_DRIVEN: Final = frozenset({"output", "pwm", "servo"})

"""PSIU HEXA robots: pings, nodes by name in their own units, raw nodes and complex packets."""

import difflib
from collections.abc import Mapping, Sequence
from typing import Any, Final, Literal, Self

from pydantic import Field

from psiu_broker.codecs import psiu_hexa
from psiu_broker.errors import CallError
from psiu_broker.frame import Frame
from psiu_broker.messages import Command, Value
from psiu_broker.profiles.node import Node
from psiu_broker.profiles.profile import Notice, Profile, Reading, Reply, Request, RobotOptions
from psiu_broker.profiles.psiu import COUNT, NAME, SHOW, SHOW_PRINTED, typed

__all__ = ["ACK", "AVAILABLE", "BUSY", "FREE", "NAK", "RESERVED", "WTF", "HexaProfile", "Node"]

ACK: Final = 65
NAK: Final = 78
BUSY: Final = 66
AVAILABLE: Final = 63
FREE: Final = 70
WTF: Final = 87
RESERVED: Final = frozenset({"ping", "node", "complex", NAME, COUNT, SHOW, SHOW_PRINTED})
"""What no node can be called: commands that every robot has, and those that the broker answers for it."""
SensorReply = Literal["node-0", "bit7"]
_NOTICES: Final = {NAK: Notice.AGAIN, BUSY: Notice.BUSY, FREE: Notice.FREE, WTF: Notice.IMPOSSIBLE}
_ANSWER_BIT: Final = 0x80
_SHORTEST_COMPLEX: Final = 3
_PING: Final = Command(name="ping")
_RAW: Final = (Command(name="node", ints=2), Command(name="complex", chars=1))


class HexaOptions(RobotOptions):
    """What ``[robots.NAME]`` may hold for a PSIU HEXA robot, beside its address."""

    nodes: dict[str, Node] = Field({}, description="names for its nodes")
    sensor_reply: SensorReply = Field(
        "node-0", description="how its sensors answer, as node 0, or as themselves with bit 7 set"
    )


class HexaProfile(Profile):
    """A PSIU HEXA robot whose nodes the configuration names.

    `sensor_reply` is how its sensors mark an answer: node 0 (PSIU HEXA 1.2.1), or bit 7 of their own number (1.3.2).
    """

    protocol = "psiu-hexa"
    harmless = "ping"
    Options = HexaOptions

    def __init__(
        self,
        nodes: Mapping[str, Node],
        timeout_s: float = 2.0,
        sensor_reply: SensorReply = "node-0",
    ) -> None:
        self._nodes = dict(nodes)
        self._by_number = {node.node: node for node in nodes.values()}
        self._timeout_s = timeout_s
        self._sensor_reply = sensor_reply
        self.poll = Request("available", bytes((AVAILABLE,)), True, timeout_s)

    @classmethod
    def make(cls, codec: Any, robot: HexaOptions, timeout_s: float, *, datagrams: bool = False) -> Self:
        return cls(robot.nodes, timeout_s, robot.sensor_reply)

    def commands(self) -> Sequence[Command]:
        return (_PING, *(_command(name, node) for name, node in self._nodes.items()), *_RAW)

    def request(self, command: str, parameters: Sequence[Value]) -> Request:
        if command == "ping":
            if parameters:
                raise CallError("refused", f"ping takes no parameters, got {_shown(parameters)}")
            return Request("ping", b"", True, self._timeout_s)
        if command == "node":
            return self._raw_node(parameters)
        if command == "complex":
            return Request("complex", _complex(parameters), False, self._timeout_s)
        node = self._nodes.get(command)
        if node is None:
            raise CallError("unknown_command", self._unknown(command))
        if node.is_actuator:
            return self._actuate(command, node, parameters)
        if parameters:
            raise CallError("refused", f"{command} is a sensor and takes no parameters, got {_shown(parameters)}")
        return Request(f"node/{node.node}", bytes((node.node, 0)), True, self._timeout_s)

    def _actuate(self, command: str, node: Node, parameters: Sequence[Value]) -> Request:
        if len(parameters) != 1:
            raise CallError("refused", f"{command} takes one value, got {_shown(parameters)}")
        try:
            signal = node.signal(parameters[0])
        except ValueError as error:
            raise CallError("refused", f"{command} {error}") from None
        return Request(f"node/{node.node}", bytes((node.node, signal)), False, self._timeout_s)

    def _raw_node(self, parameters: Sequence[Value]) -> Request:
        match [typed(value) if isinstance(value, str) else value for value in parameters]:
            case [int(number), int(signal)] if 1 <= number <= 255 and -128 <= signal <= 255:
                return Request(f"node/{number}", bytes((number, signal & 0xFF)), False, self._timeout_s)
            case _:
                raise CallError(
                    "refused", f"node takes a node 1–255 and a signal -128 to 255, got {_shown(parameters)}"
                )

    def _unknown(self, command: str) -> str:
        names = [each.name for each in self.commands()]
        close = difflib.get_close_matches(command, names, 1)
        return f"no command {command}: {f'did you mean {close[0]}? ' if close else ''}It has {', '.join(names)}"

    def read(self, request: Request, frame: Frame) -> Reading | None:
        payload = frame.payload
        if len(payload) == 0:
            return Reply("sucesso") if request.subject == "ping" else None
        if len(payload) == 1:
            if payload[0] == ACK:
                return None if request.question else Reply("sucesso")
            return _NOTICES.get(payload[0])
        if len(payload) == 2:
            return self._signal(request, payload)
        fields = psiu_hexa.fields(payload) if request.subject == "complex" else None
        return None if fields is None else Reply(None, tuple(field.hex() for field in fields))

    def answers_to(self, request: Request) -> str:
        """All alike: ACK and NAK name no request, and a sensor's answer no sensor."""
        return ""

    def moves(self, frame: Frame) -> bool:
        """What commands a node that is no sensor, and what has fields, whatever they mean."""
        node = self._by_number.get(frame.payload[0]) if len(frame.payload) == 2 else None
        return len(frame.payload) > 1 and frame.payload[0] != 0 and (node is None or node.is_actuator)

    def _signal(self, request: Request, payload: bytes) -> Reply | None:
        if not request.subject.startswith("node/"):
            return None
        number = request.payload[0]
        node = self._by_number.get(number)
        if payload[0] != (0 if self._sensor_reply == "node-0" else number | _ANSWER_BIT):
            return None
        if node is None:
            return Reply(None, (payload[1],))
        return None if node.is_actuator else Reply(None, (node.value(payload[1]),), node.shown_unit)


def _command(name: str, node: Node) -> Command:
    if not node.is_actuator:
        return Command(name=name, unit=node.shown_unit)
    low, high = node.limits
    whole = node.type != "servo"
    return Command(name=name, ints=int(whole), floats=int(not whole), minimum=low, maximum=high, unit=node.shown_unit)


def _complex(parameters: Sequence[Value]) -> bytes:
    try:
        fields = [bytes.fromhex(_hexadecimal(value)) for value in parameters]
        payload = bytes((len(fields), *(len(field) for field in fields))) + b"".join(fields)
    except ValueError:
        raise CallError(
            "refused",
            f"complex takes fields in hexadecimal such as 0xa1b2, at most 255 bytes each, got {_shown(parameters)}",
        ) from None
    if len(payload) < _SHORTEST_COMPLEX:
        raise CallError("refused", "complex takes at least one byte in its fields: less would read as a node")
    return payload


def _hexadecimal(value: Value) -> str:
    # A number has lost its leading zeros on the way here: 0102 would arrive as 102.
    if not isinstance(value, str):
        raise ValueError("not hexadecimal text")  # noqa: TRY004 - refused like any other bad field
    return value.removeprefix("0x")


def _shown(parameters: Sequence[Value]) -> str:
    return " ".join(str(value) for value in parameters) or "nothing"

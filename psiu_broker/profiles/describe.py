"""A frame in the words of `messages.Decoded`."""

from collections.abc import Callable, Mapping
from typing import Final

from psiu_broker.codecs import psiu_hexa
from psiu_broker.frame import Address, Frame
from psiu_broker.messages import Kind
from psiu_broker.profiles.hexa import ACK, AVAILABLE, BUSY, FREE, NAK, WTF
from psiu_broker.profiles.node import Node
from psiu_broker.profiles.profile import Description
from psiu_broker.profiles.psiu import said

NodesOf = Callable[[Address], Mapping[int, tuple[str, Node]]]
"""The named nodes of a robot by number; empty where nobody named any."""

_KINDS: Final[Mapping[int, Kind]] = {
    ACK: "ack", NAK: "nak", BUSY: "busy", AVAILABLE: "available", FREE: "free", WTF: "wtf",
}  # fmt: skip


def describe(frame: Frame, nodes: NodesOf) -> Description:
    """What `frame` says; never raises. The status word of an answer is in `status` and not among the parameters."""
    description = Description(
        kind="command", command=frame.subject, parameters=[], status=None, node=None, signal=None,
        value=None, unit=None, fields=None, remark=frame.remark or None,
    )  # fmt: skip
    if frame.protocol == "psiu-ascii":
        words = said(frame)
        description["kind"] = "response" if words.answer else "command"
        description["command"] = words.command
        description["parameters"] = list(words.values)
        description["status"] = words.status
    elif frame.protocol == "psiu-hexa":
        _hexa(frame, nodes, description)
    return description


def _hexa(frame: Frame, nodes: NodesOf, description: Description) -> None:
    payload = frame.payload
    if len(payload) == 1 and payload[0] not in _KINDS:
        description["command"] = f"command/{payload[0]}"
        return
    description["command"] = None
    if len(payload) == 0:
        description["kind"] = "ping"
    elif len(payload) == 1:
        description["kind"] = _KINDS[payload[0]]
    elif len(payload) == 2:
        description["kind"] = "node"
        description["node"], description["signal"] = payload[0], payload[1]
        named = nodes(frame.destination).get(payload[0])
        if named is not None:
            description["command"], node = named
            if node.is_actuator:
                description["value"], description["unit"] = node.value(payload[1]), node.shown_unit
    else:
        description["kind"] = "complex"
        fields = psiu_hexa.fields(payload)
        if fields is None:
            description["remark"] = description["remark"] or "the field sizes do not add up"
        else:
            description["fields"] = [field.hex() for field in fields]

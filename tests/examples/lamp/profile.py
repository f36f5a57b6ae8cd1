"""A lamp as callers see it: psiu call LUZ light 1, psiu call LUZ state."""

from collections.abc import Sequence
from typing import Any, ClassVar, Self

from examples.lamp import codec

from psiu_broker.errors import CallError
from psiu_broker.frame import Frame
from psiu_broker.messages import Command, Value
from psiu_broker.profiles.profile import Description, Profile, Reply, Request


class LampProfile(Profile):
    """A lamp. Its answer to an order, and what it says when its button is pressed, look alike."""

    protocol: ClassVar[str] = codec.PROTOCOL
    harmless = "state"

    def __init__(self, timeout_s: float) -> None:
        self._timeout_s = timeout_s

    @classmethod
    def make(cls, codec: Any, robot: Any, timeout_s: float, *, datagrams: bool = False) -> Self:
        return cls(timeout_s)

    def commands(self) -> Sequence[Command]:
        return (
            Command(name="light", ints=1, minimum=0, maximum=1, description="switch it on, 1, or off, 0"),
            Command(name="state", description="whether it is on"),
        )

    def request(self, command: str, parameters: Sequence[Value]) -> Request:
        match command, *map(str, parameters):
            case ("light", "0" | "1" as wanted):
                return Request(codec.SWITCH, wanted.encode(), False, self._timeout_s)
            case ("state",):
                return Request(codec.ASK, b"?", True, self._timeout_s)
            case ("light" | "state", *_):
                takes = "0 or 1" if command == "light" else "no parameters"
                raise CallError("refused", f"{command} takes {takes}, got {parameters or 'nothing'}")
        raise CallError("unknown_command", f"no command {command}: it has light, state")

    def read(self, request: Request, frame: Frame) -> Reply | None:
        if request.subject == codec.ASK:
            return Reply(None, (int(frame.payload),))
        return Reply("sucesso" if frame.payload == request.payload else "falha")

    def answers_to(self, request: Request) -> str:
        return codec.SAID

    def describe(self, frame: Frame) -> Description:
        if frame.subject != codec.SAID:
            return {"kind": "command", "command": frame.subject}
        return {"kind": "event", "command": frame.subject, "readings": {"light": int(frame.payload)}}

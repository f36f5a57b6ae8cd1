"""What a simulated robot hears, says and does, told as it happens."""

import asyncio
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any, Literal

import click
from pydantic_core import to_json

from psiu_broker.cli.output import printable, styled
from psiu_broker.profiles.node import Node
from psiu_broker.simulator import AsciiRobot, Heard, HexaRobot, Robot


class Journal:
    """Tells of one robot, in lines or in JSON; `nodes` are names for those of a robot of bytes."""

    def __init__(self, robot: Robot, nodes: Mapping[int, tuple[str, Node]], as_json: bool) -> None:
        self.ended = asyncio.Event()
        """Set when nobody reads any more."""
        self._robot = robot
        self._nodes = nodes
        self._as_json = as_json
        self._last: Heard | None = None
        self._state: Any = self._now_is()

    def ready(self, where: str) -> None:
        text = f"{self._robot.name} ({self._robot.protocol}) is at {where}; Ctrl-C ends."
        self._tell("ready", text, robot=self._robot.name, protocol=self._robot.protocol, where=where)

    def observe(self, direction: Literal["in", "out"], data: bytes) -> None:
        """Bytes on the line."""
        self._heard()
        text = data.hex(" ") if isinstance(self._robot, HexaRobot) else printable(data.decode("latin-1"))
        arrow = styled("<-", fg="cyan") if direction == "in" else styled("->", fg="green")
        self._tell(direction, f"{arrow} {text}", wire=data.hex())

    def look(self) -> Literal[False]:
        """See what is new; something happened."""
        self._heard()
        state = self._now_is()
        if state != self._state:
            before, self._state = self._state, state
            self._moved(before)
        return False

    def _heard(self) -> None:
        heard = self._robot.heard
        fresh: list[Heard] = []
        for each in reversed(heard):
            if each is self._last:
                break
            fresh.append(each)
        if heard:
            self._last = heard[-1]
        for each in reversed(fresh):
            words = printable(" ".join((each.subject, *each.parameters)))
            source = f"{printable(each.source)}: " if each.source else ""
            parameters = list(each.parameters)
            self._tell("heard", f"   {source}{words}", source=each.source, subject=each.subject, parameters=parameters)

    def _now_is(self) -> Any:
        if isinstance(self._robot, AsciiRobot):
            return self._robot.position
        return dict(self._robot.signals) if isinstance(self._robot, HexaRobot) else None

    def _moved(self, before: Any) -> None:
        if isinstance(self._robot, AsciiRobot):
            x, y, heading = self._robot.position
            text = f"   is at x {x:.0f} cm, y {y:.0f} cm, heading {heading:.0f} deg"
            self._tell("position", styled(text, bold=True), x_cm=x, y_cm=y, heading_deg=heading)
            return
        for number, signal in self._state.items():
            if before.get(number) == signal:
                continue
            name, node = self._nodes.get(number, (f"node {number}", None))
            value = None if node is None else node.value(signal)
            shown = f"signal {signal}" if node is None else f"{value:g} {node.shown_unit or ''} (signal {signal})"
            text = styled(f"   {name} is at {shown}", bold=True)
            self._tell("signal", text, node=number, name=name, signal=signal, value=value)

    def _tell(self, event: str, text: str, **facts: Any) -> None:
        now = datetime.now(UTC)
        if self._as_json:
            moment = now.strftime("%Y-%m-%dT%H:%M:%S.%fZ")
            line = to_json({"time": moment, "event": event, **facts}).decode()
        else:
            local = now.astimezone()
            line = f"{local:%H:%M:%S}.{local.microsecond // 1000:03d}  {text}"
        try:
            click.echo(line)
        except BrokenPipeError:
            self.ended.set()

"""What simulated robots hear, say and do, told as it happens."""

import asyncio
from datetime import UTC, datetime
from typing import Any, Literal

import click
from pydantic_core import to_json

from psiu_broker.cli.output import printable, styled
from psiu_broker.cli.sim_views import Seen
from psiu_broker.cli.simulated import Cast
from psiu_broker.simulator import Heard, Robot


class Journal:
    """Tells of the robots of one line, in lines or in JSON."""

    def __init__(self, cast: Cast, as_json: bool) -> None:
        self.ended = asyncio.Event()
        """Set when nobody reads any more."""
        self._cast = cast
        self._as_json = as_json
        self._last: list[Heard | None] = [None] * len(cast.robots)
        self._seen = [self._view(robot) for robot in cast.robots]
        self._same: dict[str, tuple[bytes, int]] = {}
        """For each direction of a steady line what was told last, and how often it came again since."""

    def ready(self, where: str) -> None:
        first = self._cast.robots[0]
        names = ", ".join(robot.name for robot in self._cast.robots)
        be = "is" if len(self._cast.robots) == 1 else "are"
        text = f"{names} ({first.protocol}) {be} at {where}; Ctrl-C ends."
        self._tell("ready", text, robot=names, protocol=first.protocol, where=where)

    def observe(self, direction: Literal["in", "out"], data: bytes) -> None:
        """Bytes on the line."""
        self.look()
        if self._cast.steady and not self._as_json and not (data := self._news(direction, data)):
            return
        text = printable(data.decode("latin-1")) if self._cast.text else data.hex(" ")
        arrow = styled("<-", fg="cyan") if direction == "in" else styled("->", fg="green")
        self._tell(direction, f"{arrow} {text}", wire=data.hex())

    def look(self) -> Literal[False]:
        """See what is new; something happened."""
        for index, robot in enumerate(self._cast.robots):
            self._heard(index, robot)
            before, self._seen[index] = self._seen[index], self._view(robot)
            for old, new in zip(before, self._seen[index], strict=True):
                if old != new:
                    self._tell(new.event, styled(f"   {new.text}", bold=True), **new.fields)
        return False

    def _view(self, robot: Robot) -> list[Seen]:
        return list(self._cast.view(robot))

    def _heard(self, index: int, robot: Robot) -> None:
        heard = robot.heard
        fresh: list[Heard] = []
        for each in reversed(heard):
            if each is self._last[index]:
                break
            fresh.append(each)
        if heard:
            self._last[index] = heard[-1]
        for each in reversed(fresh) if self._cast.words else ():
            words = printable(" ".join((each.subject, *each.parameters)))
            source = f"{printable(each.source)}: " if each.source else ""
            parameters = list(each.parameters)
            self._tell("heard", f"   {source}{words}", source=each.source, subject=each.subject, parameters=parameters)

    def _news(self, direction: str, data: bytes) -> bytes:
        """What of `data` was not told last; how often that came again is told when something else comes."""
        last, again = self._same.get(direction, (b"", 0))
        # One read may hold several packets.
        unit = data[: (data + data).find(data, 1)]
        times = len(data) // len(unit)
        if unit == last:
            self._same[direction] = last, again + times
            return b""
        self._same[direction] = unit, times - 1
        if again:
            self._tell("again", styled(f"   ... and {again} times more", dim=True))
        return unit

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

"""`psiu-broker demo`: a broker, simulated robots of every protocol on real transports, and a program on the bus."""

import asyncio
import logging
import socket
import tempfile
import threading
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, Final

import click

from psiu_broker.broker import Broker
from psiu_broker.bus.client import Client
from psiu_broker.cli.call import answer_line
from psiu_broker.cli.commands import Failure, examples
from psiu_broker.cli.ledger import show_ledger
from psiu_broker.cli.logs import log_to_stderr
from psiu_broker.cli.monitor import message_line, read_message
from psiu_broker.cli.output import styled
from psiu_broker.cli.tables import show_links, show_robots
from psiu_broker.config import load
from psiu_broker.errors import PsiuError
from psiu_broker.messages import Answer, CallRequest, Ledger, Link
from psiu_broker.resident import DISCOVER
from psiu_broker.simulator import (
    AmarinoBoard,
    AsciiRobot,
    FirmataBoard,
    HexaRobot,
    MityaBody,
    PtyPort,
    Robot,
    Simulation,
    SoccerRobot,
    UdpPort,
)

WHOLE_S: Final = 18.0
STEP_S: Final = 5.0
GARRA: Final = 4
ARM: Final = 0x12
LED: Final = 13

CONFIGURATION: Final = """\
[broker]
name = "base"
[zenoh]
listen = ["tcp/127.0.0.1:{bus}"]
[links.radio]
adapter = "serial"
device = "{radio}"
baudrate = 115200
protocol = "psiu-ascii"
[links.wifi]
adapter = "udp"
listen = "127.0.0.1:{wifi}"
peers = ["127.0.0.1:{beta}"]
protocol = "psiu-ascii"
[links.arm]
adapter = "serial"
device = "{arm}"
baudrate = 115200
protocol = "psiu-hexa"
topology = "point-to-point"
[robots.BRACO]
address = 0x12
link = "arm"
nodes.garra = {{ node = 4, type = "servo" }}
[links.body]
adapter = "serial"
device = "{body}"
baudrate = 9600
protocol = "mitya"
version = "2012"
[robots.MITYA]
link = "body"
[links.field]
adapter = "serial"
device = "{field}"
baudrate = 19200
protocol = "soccer"
preset = "mirosot"
[robots.GOLEIRO]
link = "field"
address = 1
[links.board]
adapter = "serial"
device = "{board}"
baudrate = 57600
protocol = "firmata"
[robots.UNO]
link = "board"
pins.led = {{ pin = 13, mode = "output" }}
[links.lamp]
adapter = "serial"
device = "{lamp}"
baudrate = 57600
protocol = "amarino"
[robots.LAMPADA]
link = "lamp"
commands.brilho = {{ flag = "b", parameters = ["int"], minimum = 0, maximum = 255, answer = true }}
"""


class NotAsItShould(Exception):
    """Something that the demo shows did not happen."""


@click.command(epilog=examples("psiu-broker demo", "psiu-broker demo | cat"))
def demo() -> None:
    """See a broker and simulated robots of every protocol at work: no hardware needed, some seconds long.

    Pseudo-terminals stand for serial ports, one robot is on UDP, and a program listens on the bus. The exit code is 0
    if all went as told, else 1.
    """
    log_to_stderr(logging.WARNING)
    try:
        asyncio.run(_show())
    except NotAsItShould as error:
        raise Failure(f"the demo failed: {error}") from error
    except TimeoutError as error:
        raise Failure(f"the demo failed: it was not through within {WHOLE_S:.0f} s") from error
    except BrokenPipeError:
        raise  # nobody looks any more
    except (PsiuError, OSError) as error:
        raise Failure(f"the demo failed: {error}") from error


async def _show() -> None:
    begun = asyncio.get_running_loop().time()
    with tempfile.TemporaryDirectory(prefix="psiu-demo-") as folder:
        async with asyncio.timeout(WHOLE_S), Stage.ready(Path(folder)) as stage:
            await stage.discover()
            await stage.call()
            await stage.relay()
            await stage.translate()
            await stage.call_the_others()
            await stage.close_the_books()
    click.echo("")
    took_s = asyncio.get_running_loop().time() - begun
    click.echo(styled(f"All as it should be, in {took_s:.1f} s.", fg="green", bold=True))
    click.echo("Now with robots of your own: psiu-broker run --help, psiu sim --help.")


class Stage:
    """The broker, its robots, and the program that listens."""

    def __init__(self, folder: Path) -> None:
        self.mnerim = AsciiRobot("MNERIM", per_unit_s=0.002)
        self.beta = AsciiRobot("BETA")
        self.braco = HexaRobot(ARM, topology="point-to-point", actuators=(GARRA,), sensors={})
        self.mitya = MityaBody()
        self.team = SoccerRobot.team("mirosot")
        self.uno = FirmataBoard()
        self.lampada = AmarinoBoard(functions={"b": ""})
        bus = _free_port(socket.SOCK_STREAM)
        wifi, beta = _free_port(socket.SOCK_DGRAM), _free_port(socket.SOCK_DGRAM)
        self.wifi = UdpPort(self.beta, listen=f"127.0.0.1:{beta}")
        serial: dict[str, list[Robot]] = {
            "radio": [self.mnerim], "arm": [self.braco], "body": [self.mitya], "field": [*self.team],
            "board": [self.uno], "lamp": [self.lampada],
        }  # fmt: skip
        self.serial = {link: PtyPort(*robots, link=folder / link) for link, robots in serial.items()}
        self.beta_at = f"127.0.0.1:{beta}"
        self.endpoint = f"tcp/127.0.0.1:{bus}"
        file = folder / "demo.toml"
        paths = {link: port.path for link, port in self.serial.items()}
        file.write_text(CONFIGURATION.format(bus=bus, wifi=wifi, beta=beta, **paths))
        self.broker = Broker(load(file))
        self.client: Client
        self.listener: Listener

    @classmethod
    @asynccontextmanager
    async def ready(cls, folder: Path) -> AsyncIterator["Stage"]:
        """The stage, with all that is on it running."""
        stage = cls(folder)
        paths = {link: port.path for link, port in stage.serial.items()}
        click.echo(styled("One broker, and simulated robots of six protocols on two kinds of link", bold=True))
        for name, text in (
            ("MNERIM", f"speaks PSIU ASCII on a pseudo-terminal, as on a serial port: {paths['radio']}"),
            ("BETA", f"speaks PSIU ASCII on UDP: {stage.beta_at}"),
            ("BRACO", f"speaks PSIU HEXA on a second pseudo-terminal: {paths['arm']}"),
            ("MITYA", f"is a Robot Mitya, told one letter and a number, which hardly ever answers: {paths['body']}"),
            ("GOLEIRO", f"is one of a soccer team, which is told its wheels 30 times a second: {paths['field']}"),
            ("UNO", f"is an Arduino with Firmata, whose pins have names: {paths['board']}"),
            ("LAMPADA", f"is an Arduino with Amarino, as Android phones command it: {paths['lamp']}"),
            ("base", f"the broker; programs connect to {stage.endpoint}"),
        ):
            click.echo(f"  {name:<8} {text}")
        async with Simulation(stage.wifi, *stage.serial.values()):
            await stage.broker.start()
            try:
                async with stage._program():
                    await stage._until("all links open", stage._links_open)
                    yield stage
            finally:
                await stage.broker.stop()

    @asynccontextmanager
    async def _program(self) -> AsyncIterator[None]:
        """A second Zenoh session, a client of the broker like any program, which listens to everything."""
        self.client = await asyncio.to_thread(Client, [self.endpoint])
        self.listener = Listener(self.client)
        try:
            await self._until("the broker sees that somebody listens", lambda: self.broker.exchange.bus.listened)
            yield
        finally:
            await asyncio.to_thread(self.client.close)
            await asyncio.to_thread(self.listener.join)

    async def discover(self) -> None:
        _step(1, "Who is there, and what can they do?", "psiu discover")
        await self._until("BETA is heard on UDP", lambda: "BETA" in self._heard())
        answer = await self._call("base", DISCOVER)
        for robot in ("MNERIM", "BETA", "BRACO"):
            if robot not in answer.values:
                raise NotAsItShould(f"{robot} was not found, only {answer.values}")
        cards = await asyncio.to_thread(self.client.cards)
        show_robots(cards, drawn=True)

    async def call(self) -> None:
        _step(2, "A program tells a robot to move", "psiu call MNERIM parafrente 100")
        answer = await self._call("MNERIM", "parafrente", 100)
        if answer.status != "sucesso":
            raise NotAsItShould(f"MNERIM answered {answer.status} to parafrente 100")
        await self._seen("MNERIM", "base", "parafrente", status="sucesso")
        if self.mnerim.position.x != 100:
            raise NotAsItShould(f"MNERIM is at {self.mnerim.position}, not at x = 100 cm")
        click.echo(f"  {answer_line('MNERIM', answer)}: it is at x = 100 cm now")

    async def relay(self) -> None:
        order = self.beta.command("MNERIM", "giradireita", 90)
        _step(3, "BETA, on UDP, orders MNERIM, on the serial port", f"BETA sends: {order.decode()}")
        self.wifi.send(order)
        await self._hears(self.beta, "MNERIM", "giradireita", "sucesso")
        await self._seen("BETA", "MNERIM", "giradireita", parameters=[90])
        await self._seen("MNERIM", "BETA", "giradireita", status="sucesso")
        if self.mnerim.position.heading != 270:
            raise NotAsItShould(f"MNERIM is at {self.mnerim.position}, not turned to the right")
        click.echo("  BETA heard sucesso; MNERIM looks to the right")

    async def translate(self) -> None:
        order = self.beta.command("BRACO", "garra", 45)
        _step(4, "BETA speaks words, BRACO only bytes: the broker translates", f"BETA sends: {order.decode()}")
        self.wifi.send(order)
        await self._hears(self.beta, "BRACO", "garra", "sucesso")
        await self._seen("BETA", "BRACO", "garra", parameters=[45])
        await self._seen("BRACO", "BETA", "garra", status="sucesso")
        signal = self.braco.signals[GARRA]
        if signal != round(45 * 127 / 90):
            raise NotAsItShould(f"the signal of garra is {signal}")
        click.echo(f"  BETA heard sucesso; garra is at 45 degrees, which BRACO knows as signal {signal}")

    async def call_the_others(self) -> None:
        _step(5, "Robots of other protocols are called in the same way", "psiu call ROBOT COMMAND ...")
        body, goleiro = self.mitya.body, self.team[0]
        calls: tuple[tuple[str, str, Callable[[], bool]], ...] = (
            ("MITYA D -100", "both motors run backwards", lambda: body.left == body.right == -100),
            ("GOLEIRO rodas 15 -31", "it turns on the spot", lambda: _was_told(goleiro, "rodas", "15", "-31")),
            ("UNO led 1", f"pin {LED} is on", lambda: self.uno.states[LED] == 1),
            ("LAMPADA brilho 200", "it shines as it was told", lambda: _was_told(self.lampada, "flag/b", "200")),
        )
        for line, told, done in calls:
            robot, command, *parameters = line.split()
            answer = await self._call(robot, command, *map(int, parameters))
            if answer.status == "falha" or not done():
                raise NotAsItShould(f"{robot} was told {command} and did not do it")
            click.echo(f"  {f'psiu call {line}':<31} {answer_line(robot, answer)}: {told}")

    async def close_the_books(self) -> None:
        _step(6, "Where every frame went", "psiu links, psiu ledger")
        links = (await asyncio.to_thread(self.client.ask, "links"))["base"]
        told = (await asyncio.to_thread(self.client.ask, "ledger"))["base"]
        ledger = Ledger.model_validate(told)
        show_links([("base", Link.model_validate(link)) for link in links], drawn=True)
        click.echo("")
        show_ledger([("base", ledger)], drawn=True)
        if not ledger.balances:
            raise NotAsItShould("the ledger does not balance")

    async def _call(self, robot: str, command: str, *parameters: int) -> Answer:
        request = CallRequest(parameters=list(parameters), timeout_s=STEP_S)
        return await asyncio.to_thread(self.client.call, robot, command, request)

    async def _hears(self, robot: AsciiRobot, source: str, subject: str, word: str) -> None:
        """Wait until `robot` has its answer."""
        try:
            await self.wifi.until(
                lambda: any(
                    (each.source, each.subject, each.parameters) == (source, subject, (word,)) for each in robot.heard
                ),
                STEP_S,
            )
        except TimeoutError:
            raise NotAsItShould(f"{robot.name} did not hear {subject} {word} from {source}") from None

    async def _seen(self, source: str, destination: str, command: str, **fields: Any) -> None:
        """Wait until the program on the bus has seen a frame."""
        wanted = {"source": source, "destination": destination, "command": command, **fields}
        what = f"{source} → {destination}: {command} is seen on the bus"
        await self._until(what, lambda: self.listener.saw(wanted))

    async def _until(self, what: str, true: Callable[[], bool]) -> None:
        """Wait for what tells no event."""
        end = asyncio.get_running_loop().time() + STEP_S
        while not true():
            if asyncio.get_running_loop().time() > end:
                raise NotAsItShould(f"waited in vain until {what}")
            await asyncio.sleep(0.01)

    def _links_open(self) -> bool:
        return all(link.state == "open" for link in self.broker.links())

    def _heard(self) -> set[str]:
        return {card.robot for card in self.broker.cards().values() if card.last_heard is not None}


class Listener:
    """Prints the decoded frames of the bus as they happen, in a thread of its own, and remembers them."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._seen: list[Mapping[str, Any]] = []
        self._thread = threading.Thread(target=self._listen, name="demo-listener", daemon=True)
        self._thread.start()

    def saw(self, wanted: Mapping[str, Any]) -> bool:
        return any(all(message.get(name) == value for name, value in wanted.items()) for message in tuple(self._seen))

    def join(self) -> None:
        """Wait until the thread has ended; its client must be closed."""
        self._thread.join(STEP_S)

    def _listen(self) -> None:
        try:
            for key, kind, payload in self._client.monitor(self._client.keys.every_frame):
                message = read_message(payload)
                if kind == "put":
                    self._seen.append(message)
                    click.echo(f"    {message_line(key, message)}")
        except (PsiuError, BrokenPipeError):
            return  # the client was closed, or nobody reads


def _step(number: int, text: str, how: str) -> None:
    click.echo("")
    click.echo(f"{styled(f'{number}. {text}', bold=True)}   [{how}]")


def _was_told(robot: Robot, subject: str, *parameters: str) -> bool:
    return any((heard.subject, heard.parameters) == (subject, parameters) for heard in robot.heard)


def _free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])

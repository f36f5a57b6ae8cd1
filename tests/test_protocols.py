"""A whole broker and robots of every protocol: called, listed, published, commanding each other."""

import asyncio
import json
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
import zenoh
from ports import free_port

from psiu_broker.broker import Broker
from psiu_broker.codecs import psiu_ascii
from psiu_broker.codecs.codec import Directory
from psiu_broker.codecs.psiu_ascii import PsiuAscii
from psiu_broker.config import load
from psiu_broker.errors import CallError
from psiu_broker.frame import Address
from psiu_broker.messages import Answer, CallRequest, Card
from psiu_broker.simulator import AsciiRobot, PtyPort
from psiu_broker.simulator.amarino import AmarinoBoard
from psiu_broker.simulator.firmata import FirmataBoard
from psiu_broker.simulator.mitya import MityaBody
from psiu_broker.simulator.soccer import SoccerRobot

CODEC = PsiuAscii(PsiuAscii.Options(), Directory())


async def until(true: Callable[[], object], timeout_s: float = 30.0) -> None:
    """The broker's state is values, not events: look until it is so."""
    async with asyncio.timeout(timeout_s):
        while not true():  # noqa: ASYNC110
            await asyncio.sleep(0.005)


class Lab:
    """A broker with the configuration `text`, which has no head: that is the same for all."""

    def __init__(self, folder: Path, text: str, name: str = "base") -> None:
        self.bus = free_port()
        file = folder / "lab.toml"
        file.write_text(f'[broker]\nname = "{name}"\n[zenoh]\nlisten = ["tcp/127.0.0.1:{self.bus}"]\n{text}')
        self.broker = Broker(load(file))

    async def call(self, robot: str, command: str, *parameters: int | float | str) -> Answer | None:
        return await self.broker.call(Address.parse(robot), command, CallRequest(parameters=list(parameters)))

    def card(self, robot: str) -> Card:
        card = self.broker.card(Address.parse(robot))
        assert card is not None
        return card

    @asynccontextmanager
    async def listening(self, key: str) -> AsyncIterator[list[dict[str, object]]]:
        """What is put under `key` from now on."""
        heard: list[dict[str, object]] = []
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{self.bus}"]')
        session = await asyncio.to_thread(zenoh.open, config)
        loop = asyncio.get_running_loop()

        def take(sample: zenoh.Sample) -> None:
            loop.call_soon_threadsafe(
                heard.append, json.loads(sample.payload.to_bytes()) | {"key": str(sample.key_expr)}
            )

        subscriber = await asyncio.to_thread(session.declare_subscriber, key, take)
        try:
            await until(lambda: self.broker.exchange.bus.listened)
            yield heard
        finally:
            await asyncio.to_thread(subscriber.undeclare)
            await asyncio.to_thread(session.close)


@asynccontextmanager
async def lab(folder: Path, text: str, *ports: PtyPort, name: str = "base") -> AsyncIterator[Lab]:
    made = Lab(folder, text, name)
    for port in ports:
        await port.open()
    await made.broker.start()
    try:
        await until(lambda: all(link.state == "open" for link in made.broker.links()))
        yield made
        ledger = made.broker.ledger()
        assert ledger.balances, ledger
    finally:
        await made.broker.stop()
        for port in ports:
            await port.close()


def message(destination: str, words: str, source: str) -> bytes:
    return CODEC.encode(psiu_ascii.message(Address.named(source), Address.named(destination), *words.split()))


def link(name: str, device: Path | str, protocol: str, more: str = "") -> str:
    return f"""
[links.{name}]
adapter = "serial"
device = "{device}"
baudrate = 115200
protocol = "{protocol}"
{more}
"""


async def test_a_mitya_is_called_by_letter_or_by_name_and_lists_its_commands(tmp_path: Path) -> None:
    body = MityaBody("MITYA", version="2013")
    port = PtyPort(body, link=tmp_path / "corpo")
    text = link("corpo", port.path, "mitya", 'version = "2013"') + '[robots.MITYA]\nlink = "corpo"\n'
    async with lab(tmp_path, text, port) as made, made.listening("psiu/MITYA/*/**") as heard:
        answer = await made.call("MITYA", "G", 100)
        assert answer is not None
        assert answer.status == "sucesso"
        assert body.body.left == body.body.right == 100
        await made.call("MITYA", "drive", -100)
        assert body.body.left == -100
        with pytest.raises(CallError, match="-255"):
            await made.call("MITYA", "drive", 99999)
        names = [command.name for command in made.card("MITYA").commands]
        assert "drive" in names
        counted = await made.call("MITYA", "quantoscomandos")
        assert counted is not None
        assert counted.values == [len(names)]
        shown = await made.call("MITYA", "exibecomando", 1)
        assert shown is not None
        assert shown.values[0] == names[0]
        await until(lambda: heard)
        assert heard[0]["protocol"] == "mitya"


async def test_a_program_in_words_moves_a_mitya(tmp_path: Path) -> None:
    body, pc = MityaBody("MITYA", version="2013"), AsciiRobot("PC")
    said: list[bytes] = []
    corpo = PtyPort(body, link=tmp_path / "corpo")
    radio = PtyPort(pc, link=tmp_path / "radio", observer=lambda way, data: said.append(data) if way == "in" else None)
    text = (
        link("corpo", corpo.path, "mitya", 'version = "2013"')
        + link("radio", radio.path, "psiu-ascii")
        + '[robots.MITYA]\nlink = "corpo"\n'
    )
    async with lab(tmp_path, text, corpo, radio) as made:
        radio.send(message("MITYA", "drive 100", "PC"))
        await until(lambda: body.body.left == 100)
        await until(lambda: any(b"drive sucesso MITYA" in each for each in said))
        radio.send(message("MITYA", "quantoscomandos", "PC"))
        count = len(made.card("MITYA").commands)
        await until(lambda: any(b"quantoscomandos %d MITYA" % count in each for each in said))
        radio.send(message("MITYA", "drive 99999", "PC"))
        await until(lambda: any(b"drive falha MITYA" in each for each in said))


async def test_a_mitya_program_over_udp_drives_a_robot_of_words(tmp_path: Path) -> None:
    robot = AsciiRobot("MNERIM", per_unit_s=0.0)
    radio, port = PtyPort(robot, link=tmp_path / "radio"), free_port(socket.SOCK_DGRAM)
    text = (
        link("radio", radio.path, "psiu-ascii")
        + f"""
[links.painel]
adapter = "udp"
listen = "127.0.0.1:{port}"
protocol = "mitya"
plays = "MNERIM"
map.D = {{ command = "parafrente", below_zero = "paratras", scale = 1 }}
map.R = {{ command = "giradireita", scale = 1 }}
[robots.MNERIM]
link = "radio"
"""
    )
    async with lab(tmp_path, text, radio) as made:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as program:
            program.connect(("127.0.0.1", port))
            program.setblocking(False)
            program.send(b"D0064\r\n")
            await until(lambda: robot.position.x == 100)
            program.send(b"DFFCE")
            await until(lambda: robot.position.x == 50)
            program.send(b"R005A")
            await until(lambda: robot.position.heading != 0)
            program.send(b"Q0001")
            complaint = await asyncio.wait_for(asyncio.get_running_loop().sock_recv(program, 100), 2.0)
            assert complaint == b"E0102"
        account = next(each for each in made.broker.ledger().accounts if each.link == "painel")
        assert (account.arrived, account.answered) == (4, 4)


async def test_robots_of_a_team_are_told_their_wheels_in_packets_that_all_of_them_hear(tmp_path: Path) -> None:
    team = [SoccerRobot(number) for number in (1, 2, 3)]
    port = PtyPort(*team, link=tmp_path / "campo")
    text = (
        link("campo", port.path, "soccer", 'preset = "mirosot"\nrate_hz = 30\nbaud = 115200')
        + '[robots.GOLEIRO]\nlink = "campo"\naddress = 1\n'
        + '[robots.ATACANTE]\nlink = "campo"\naddress = 3\nhold_s = 0.2\n'
    )
    async with lab(tmp_path, text, port) as made, made.listening("psiu/*/*/rodas") as heard:
        answer = await made.call("GOLEIRO", "rodas", 15, -31)
        assert answer is not None
        assert answer.remark == "sent; this robot does not answer"
        await until(lambda: team[0].wheels == (15, -31))
        assert team[1].wheels == (0, 0)
        await made.call("ATACANTE", "rodas", 31, 31)
        await until(lambda: team[2].wheels == (31, 31))
        await until(lambda: team[2].wheels == (0, 0))  # hold_s is over
        with pytest.raises(CallError, match="-31"):
            await made.call("GOLEIRO", "rodas", 32, 0)
        await until(lambda: len(heard) == 2)
        assert [each["destination"] for each in heard] == ["GOLEIRO", "ATACANTE"]
        assert made.card("GOLEIRO").address == "campo.0x01"
        details = made.broker.links()[0].details
        assert details["rate_hz"] == 30


async def test_a_board_that_speaks_firmata_is_a_robot_with_named_pins(tmp_path: Path) -> None:
    board = FirmataBoard("PLACA")
    port = PtyPort(board, link=tmp_path / "placa")
    text = (
        link("placa", port.path, "firmata")
        + '[robots.PLACA]\nlink = "placa"\npins.farol = { pin = 13, mode = "output" }\n'
        + 'pins.luz = { pin = "A0", mode = "analog" }\n'
    )
    async with lab(tmp_path, text, port) as made, made.listening("psiu/PLACA/*/**") as heard:
        await until(lambda: made.card("PLACA").last_heard is not None)
        answer = await made.call("PLACA", "farol", "on")
        assert answer is not None
        assert answer.status == "sucesso"
        assert board.states[13] == 1
        board.set_pin(14, 512)
        await until(lambda: any(each.get("readings") == {"luz": 512} for each in heard))
        answer = await made.call("PLACA", "luz")
        assert answer is not None
        assert answer.values == [512]


async def test_an_amarino_board_is_a_robot_whose_functions_have_names(tmp_path: Path) -> None:
    board = AmarinoBoard("LUZES", functions={"A": None, "C": "42"}, readings=(21.5, 3.0), telemetry_s=0.1)
    port = PtyPort(board, link=tmp_path / "luzes")
    text = (
        link("luzes", port.path, "amarino")
        + '[robots.LUZES]\nlink = "luzes"\n'
        + 'commands.brilho = { flag = "A", parameters = ["int"], minimum = 0, maximum = 255 }\n'
        + 'commands.conta = { flag = "C", answer = true }\n'
    )
    async with lab(tmp_path, text, port) as made, made.listening("psiu/LUZES/*/**") as heard:
        answer = await made.call("LUZES", "brilho", 200)
        assert answer is not None
        assert answer.remark == "sent; this robot does not answer"
        await until(lambda: board.heard and board.heard[-1].parameters == ("200",))
        with pytest.raises(CallError, match="255"):
            await made.call("LUZES", "brilho", 256)
        await until(lambda: heard)
        assert heard[0]["kind"] == "event"
        assert not board.crashed


async def test_a_robot_is_found_where_the_link_is_its_only_name(tmp_path: Path) -> None:
    port = PtyPort(MityaBody("M", version="2013", telemetry_s=0.05), link=tmp_path / "corpo")
    async with lab(tmp_path, link("corpo", port.path, "mitya", 'version = "2013"'), port) as made:
        await until(lambda: made.broker.card(Address.parse("corpo")) is not None)
        answer = await made.call("corpo", "drive", 10)
        assert answer is not None
        assert answer.status == "sucesso"


@pytest.mark.parametrize("answers_to", ["base", "PC"])
async def test_a_robot_of_the_first_draft_is_called_whomever_it_answers(tmp_path: Path, answers_to: str) -> None:
    robot = AsciiRobot("VELHO", version="0", telemetry_to=answers_to, per_unit_s=0.0)
    port = PtyPort(robot, link=tmp_path / "radio")
    text = link("radio", port.path, "psiu-ascii", 'version = "0"') + '[robots.VELHO]\nlink = "radio"\n'
    async with lab(tmp_path, text, port) as made:
        answer = await made.call("VELHO", "parafrente", 100)
        assert answer is not None
        assert answer.status == "sucesso"
        assert robot.position.x == 100


async def test_a_robot_of_the_second_draft_is_called(tmp_path: Path) -> None:
    robot = AsciiRobot("MEIO", version="0.5", per_unit_s=0.0)
    port = PtyPort(robot, link=tmp_path / "radio")
    async with lab(tmp_path, link("radio", port.path, "psiu-ascii", 'version = "0.5"'), port) as made:
        answer = await made.call("MEIO", "giradireita", 90)
        assert answer is not None
        assert answer.status == "sucesso"


async def test_a_trace_never_moves_a_robot_that_cannot_be_asked(tmp_path: Path) -> None:
    heard: list[bytes] = []
    port = PtyPort(
        MityaBody("MITYA", version="2013"),
        link=tmp_path / "corpo",
        observer=lambda way, data: heard.append(data) if way == "in" else None,
    )
    text = link("corpo", port.path, "mitya", 'version = "2013"') + '[robots.MITYA]\nlink = "corpo"\n'
    async with lab(tmp_path, text, port) as made:
        trace = await made.broker.trace(Address.parse("base"), Address.parse("MITYA"))
        assert trace is not None
        assert (trace.answered, trace.question) == (False, "nothing")
        assert trace.reason == "MITYA speaks mitya, in which nothing can be asked without harm"
        await made.call("MITYA", "headlights", 1)
        assert b"".join(heard) == b"I0001", "what is heard is what was called, and nothing before it"


async def test_a_program_in_words_hears_nothing_of_a_mitya_that_does_not_answer_but_its_errors(tmp_path: Path) -> None:
    body, pc = MityaBody("MITYA", version="2012"), AsciiRobot("PC")
    said: list[bytes] = []
    corpo = PtyPort(body, link=tmp_path / "corpo")
    radio = PtyPort(pc, link=tmp_path / "radio", observer=lambda way, data: said.append(data) if way == "in" else None)
    text = (
        link("corpo", corpo.path, "mitya", 'version = "2012"')
        + link("radio", radio.path, "psiu-ascii", "greet = false")
        + '[robots.MITYA]\nlink = "corpo"\nerror_ms = 50\n'
    )
    async with lab(tmp_path, text, corpo, radio) as made:
        radio.send(message("MITYA", "drive 100", "PC"))
        await until(lambda: body.body.left == 100)
        radio.send(message("MITYA", "drive 99999", "PC"))
        await until(lambda: any(b"drive falha MITYA" in each for each in said))
        await made.call("MITYA", "drive", 0)  # one after another: the first is over
        assert [each.split()[2:-1] for each in said] == [[b"drive", b"falha", b"MITYA"]]


async def test_a_program_in_words_at_one_broker_moves_a_mitya_at_another(tmp_path: Path) -> None:
    body, pc = MityaBody("MITYA", version="2013"), AsciiRobot("PC")
    (tmp_path / "b").mkdir()
    corpo = PtyPort(body, link=tmp_path / "corpo")
    said: list[bytes] = []
    radio = PtyPort(pc, link=tmp_path / "radio", observer=lambda way, data: said.append(data) if way == "in" else None)
    text = link("corpo", corpo.path, "mitya", 'version = "2013"') + '[robots.MITYA]\nlink = "corpo"\n'
    async with lab(tmp_path, text, corpo) as there:
        mesh = f'[mesh]\nconnect = ["tcp/127.0.0.1:{there.bus}"]\n'
        async with lab(tmp_path / "b", link("radio", radio.path, "psiu-ascii") + mesh, radio, name="other") as here:
            await until(lambda: here.broker.exchange.router.is_elsewhere(Address.parse("MITYA")))
            radio.send(message("MITYA", "drive 77", "PC"))
            await until(lambda: body.body.left == 77)
            await until(lambda: any(b"drive sucesso MITYA" in each for each in said))

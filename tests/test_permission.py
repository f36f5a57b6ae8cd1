"""Who may command whom, in a whole broker: real ptys and UDP sockets, at loopback and at an address beyond it."""

import asyncio
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from lab_file import lab_text
from ports import free_port

from psiu_broker.broker import Broker
from psiu_broker.config import load
from psiu_broker.errors import CallError
from psiu_broker.frame import Address
from psiu_broker.messages import CallRequest, Why
from psiu_broker.simulator import AsciiRobot, HexaRobot, PtyPort


def own_address() -> str:
    """An address of this computer that is no loopback one; "" where it has none."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))
        except OSError:
            return ""
        return str(probe.getsockname()[0])


OUTSIDE = own_address()
FROM_OUTSIDE = pytest.mark.skipif(not OUTSIDE, reason="this computer has no address that others reach")
PAINEL = """
[links.painel]
adapter = "udp"
listen = "0.0.0.0:{port}"
protocol = "mitya"
plays = "MNERIM"
map.D = {{ command = "parafrente", scale = 0.5 }}
[robots.MNERIM]
link = "radio"
"""


async def until(true: Callable[[], object], timeout_s: float = 30.0) -> None:
    """The broker's state is values, not events: look until it is so."""
    async with asyncio.timeout(timeout_s):
        while not true():  # noqa: ASYNC110
            await asyncio.sleep(0.005)


class Program:
    """A UDP socket at an address of this computer, and the PSIU ASCII robot that it says to be."""

    def __init__(self, name: str, host: str) -> None:
        self.robot = AsciiRobot(name)
        self.host = host
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        self.socket.bind((host, 0))
        self.address = f"{host}:{self.socket.getsockname()[1]}"

    def say(self, port: int, data: bytes) -> None:
        self.socket.sendto(data, (self.host, port))

    def hears(self) -> list[bytes]:
        heard = []
        while True:
            try:
                heard.append(self.socket.recv(2048))
            except BlockingIOError:
                return heard


class Lab:
    """MNERIM on a pty, an arm on another, and a UDP port that all addresses of this computer reach."""

    def __init__(self, folder: Path) -> None:
        self.wifi = free_port(socket.SOCK_DGRAM)
        self.painel = free_port(socket.SOCK_DGRAM)
        self.mnerim = AsciiRobot("MNERIM")
        self.braco = HexaRobot(0x12, topology="point-to-point", actuators=(4, 5), sensors={7: 99})
        self.radio = PtyPort(self.mnerim, link=folder / "radio")
        self.arm = PtyPort(self.braco, link=folder / "arm")
        self.file = folder / "lab.toml"
        self.programs: list[Program] = []
        self.broker: Broker

    def program(self, name: str, host: str) -> Program:
        self.programs.append(Program(name, host))
        return self.programs[-1]

    async def open(self, more: str, options: str) -> None:
        text = lab_text(bus=free_port(), radio=self.radio.path, wifi=self.wifi, arm=self.arm.path, timeout_s=0.5)
        open_to_all = f'"0.0.0.0:{self.wifi}"\n{options}'
        self.file.write_text(text.replace(f'"127.0.0.1:{self.wifi}"', open_to_all) + more)
        await self.radio.open()
        await self.arm.open()
        self.broker = Broker(load(self.file))
        await self.broker.start()
        await until(lambda: all(link.state == "open" for link in self.broker.links()))
        await until(lambda: any(card.robot == "MNERIM" and card.last_heard for card in self.broker.cards().values()))

    async def close(self) -> None:
        assert self.broker.ledger().balances
        await self.broker.stop()
        for port in (self.radio, self.arm):
            await port.close()
        for program in self.programs:
            program.socket.close()

    async def call(self, robot: str, command: str, *parameters: int | str) -> object:
        return await self.broker.call(Address.parse(robot), command, CallRequest(parameters=list(parameters)))

    def dropped(self, link: str = "wifi") -> dict[str, int]:
        return next(account.dropped for account in self.broker.ledger().accounts if account.link == link)

    def why(self, a: str, b: str) -> Why:
        return self.broker.why(Address.parse(a), Address.parse(b))


@asynccontextmanager
async def opened(lab: Lab, more: str = "", options: str = "") -> AsyncIterator[Lab]:
    await lab.open(more, options)
    try:
        yield lab
    finally:
        await lab.close()


@pytest.fixture
def lab(tmp_path: Path) -> Lab:
    return Lab(tmp_path)


@FROM_OUTSIDE
async def test_a_stranger_from_beyond_this_computer_asks_and_is_asked_and_commands_nobody(lab: Lab) -> None:
    async with opened(lab):
        stranger = lab.program("RUIM", OUTSIDE)
        stranger.say(lab.wifi, stranger.robot.command("MNERIM", "parafrente", 50))
        await until(lambda: lab.dropped() == {"denied": 1})
        why = lab.why("RUIM", "MNERIM")
        assert (why.verdict, why.delivered) == ("denied", False)
        assert "beyond this computer" in str(why.filter)
        assert f"wifi/{stranger.address}" in why.steps[-1]
        stranger.say(lab.wifi, stranger.robot.command("MNERIM", "quantoscomandos"))
        await until(lambda: any(b"quantoscomandos" in data for data in stranger.hears()))
        assert [heard.subject for heard in lab.mnerim.heard if heard.source == "RUIM"] == ["quantoscomandos"]
        call = asyncio.create_task(lab.call("RUIM", "parafrente", 7))
        await until(lambda: any(b"parafrente 7" in data for data in stranger.hears()))
        stranger.say(lab.wifi, stranger.robot.command("base", "parafrente", "sucesso"))
        assert getattr(await call, "status", None) == "sucesso"


@FROM_OUTSIDE
@pytest.mark.parametrize("named", ["by nobody", "as a robot", "as a peer", "in a rule", "in the list of the link"])
async def test_whoever_the_configuration_names_commands_from_anywhere(lab: Lab, named: str) -> None:
    program = lab.program("AMIGO", OUTSIDE)
    more, options = {
        "by nobody": ("", ""),
        "as a robot": ('[robots.AMIGO]\nlink = "wifi"', ""),
        "as a peer": ("", f'peers = ["{program.address}"]'),
        "in a rule": ('[[policy]]\naction = "allow"\nsource = "AM*"\nlink = "wifi"', ""),
        "in the list of the link": ("", 'allow = ["AMIGO"]'),
    }[named]
    async with opened(lab, more, options):
        program.say(lab.wifi, program.robot.command("MNERIM", "parafrente", 50))
        if named == "by nobody":
            await until(lambda: lab.dropped() == {"denied": 1})
            assert lab.mnerim.position.x == 0
        else:
            await until(lambda: lab.mnerim.position.x == 50)


async def test_programs_on_this_computer_command_as_ever(lab: Lab) -> None:
    async with opened(lab):
        program = lab.program("PC", "127.0.0.1")
        program.say(lab.wifi, program.robot.command("MNERIM", "parafrente", 50))
        await until(lambda: lab.mnerim.position.x == 50)


NO_BACKWARDS = '[[policy]]\naction = "deny"\nsource = "base"\ndestination = "MNERIM"\ncommand = "paratras"\n'


async def test_a_rule_for_the_broker_holds_for_calls_from_the_bus(lab: Lab) -> None:
    async with opened(lab, NO_BACKWARDS):
        with pytest.raises(CallError, match=r"base may not tell MNERIM paratras: policy\[0\] denies") as refused:
            await lab.call("MNERIM", "paratras", 50)
        assert refused.value.code == "refused"
        with pytest.raises(CallError, match="may not"):
            await lab.broker.send(Address.named("MNERIM"), "PARATRAS", CallRequest(parameters=[50]))
        assert getattr(await lab.call("MNERIM", "parafrente", 50), "status", None) == "sucesso"
        assert all(heard.subject.lower() != "paratras" for heard in lab.mnerim.heard)


NO_CLAW = '[[policy]]\naction = "deny"\nsource = {source}\ncommand = "garra"\n'


async def test_a_command_is_denied_by_each_of_its_names(lab: Lab) -> None:
    async with opened(lab, NO_CLAW.format(source='"base"')):
        for command, *parameters in (("garra", 45), ("node", 4, 10)):
            with pytest.raises(CallError, match="may not"):
                await lab.call("BRACO", command, *parameters)
        assert getattr(await lab.call("BRACO", "node", 5, 10), "status", None) == "sucesso"
        assert getattr(await lab.call("BRACO", "sonar"), "values", None) == [99]
        assert lab.braco.signals[4] == 0


async def test_words_that_would_become_a_denied_command_are_answered_with_falha(lab: Lab) -> None:
    async with opened(lab, NO_CLAW.format(source='"PC"')):
        program = lab.program("PC", "127.0.0.1")
        program.say(lab.wifi, program.robot.command("BRACO", "garra", 45))
        await until(lambda: lab.dropped() == {"denied": 1})
        program.say(lab.wifi, program.robot.command("BRACO", "node", 4, 10))
        await until(lambda: any(b"node falha BRACO" in data for data in program.hears()))
        program.say(lab.wifi, program.robot.command("BRACO", "node", 5, 10))
        await until(lambda: lab.braco.signals[5] == 10)
        assert lab.braco.signals[4] == 0
        assert getattr(await lab.call("BRACO", "garra", 45), "status", None) == "sucesso", "the rule is for PC"


@FROM_OUTSIDE
@pytest.mark.parametrize("allowed", [False, True])
async def test_a_program_beyond_this_computer_drives_a_robot_it_is_played_only_if_it_may(
    lab: Lab, allowed: bool
) -> None:
    painel = PAINEL.format(port=lab.painel).replace('plays = "MNERIM"', 'plays = "MNERIM"\nallow = ["painel@*"]')
    async with opened(lab, painel if allowed else PAINEL.format(port=lab.painel)):
        near, far = lab.program("PC", "127.0.0.1"), lab.program("PC", OUTSIDE)
        far.say(lab.painel, b"D0064")
        if allowed:
            await until(lambda: lab.mnerim.position.x == 50)
            return
        await until(lambda: b"".join(far.hears()))
        assert lab.mnerim.position.x == 0
        near.say(lab.painel, b"D0064")
        await until(lambda: lab.mnerim.position.x == 50)


async def test_a_rule_for_a_program_is_for_the_command_that_it_means(lab: Lab) -> None:
    rule = '[[policy]]\naction = "deny"\nsource = "painel*"\ncommand = "parafrente"\n'
    async with opened(lab, PAINEL.format(port=lab.painel) + rule):
        near = lab.program("PC", "127.0.0.1")
        near.say(lab.painel, b"D0064")
        await until(near.hears)
        assert all(heard.subject != "parafrente" for heard in lab.mnerim.heard)


async def test_a_link_brings_so_many_new_names_a_minute(lab: Lab) -> None:
    async with opened(lab, options="new_names_per_minute = 5"):
        crowd = lab.program("PC", "127.0.0.1")
        for number in range(20):
            crowd.say(lab.wifi, AsciiRobot(f"R{number}").command("base", "qualseunome"))
        await until(lambda: sum(lab.dropped().values()) == 15)
        assert lab.dropped() == {"too_many_names": 15}
        assert {card.robot for card in lab.broker.cards().values()} == {"MNERIM", "BRACO", *(f"R{n}" for n in range(5))}

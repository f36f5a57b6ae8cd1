"""Fifty simulated robots of every protocol on pseudo-terminals and UDP, and the configuration of their broker."""

import random
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from psiu_broker.simulator import (
    AmarinoBoard,
    AsciiRobot,
    Faults,
    FirmataBoard,
    HexaRobot,
    MityaBody,
    Port,
    PtyPort,
    Robot,
    SoccerRobot,
    UdpPort,
)

SERIAL: Final = """
[links.{link}]
adapter = "serial"
device = "{device}"
baudrate = {baudrate}
protocol = "{protocol}"
"""
UDP: Final = """
[links.{link}]
adapter = "udp"
listen = "127.0.0.1:{port}"
protocol = "{protocol}"
"""
BAUDRATES: Final = {"soccer": 19200, "mitya": 9600, "firmata": 57600, "amarino": 57600}
TELEMETRY_S: Final = 0.5


class Call(NamedTuple):
    """Something that a robot can be told."""

    robot: str
    command: str
    parameters: tuple[int, ...] = ()


class Lab:
    """The robots on their ports, `calls` that they understand, and the broker's configuration, `text`."""

    def __init__(self, folder: Path, bus: int, udp_ports: Iterator[int], seed: int) -> None:
        self.ports: list[Port] = []
        self.calls: list[Call] = []
        self.speakers: list[tuple[Port, AsciiRobot]] = []
        """Robots that order others about."""
        self.text = f'[broker]\nname = "base"\n[zenoh]\nlisten = ["tcp/127.0.0.1:{bus}"]\n'
        self._folder = folder
        self._udp_ports = udp_ports
        self._random = random.Random(seed)
        self._names = [f"R{number:02}" for number in range(1, 33)]
        self._words()
        self._bytes()
        self._others()

    @property
    def robots(self) -> int:
        return sum(len(port.robots) for port in self.ports)

    @property
    def links(self) -> int:
        return self.text.count("[links.")

    def _words(self) -> None:
        names = iter(self._names)
        for number, crowd in enumerate([1] * 14 + [3] * 2):
            robots = [self._ascii(next(names)) for _ in range(crowd)]
            port = self._pty(f"radio{number}", "psiu-ascii", *robots)
            self.speakers += [(port, robot) for robot in robots]
        home = self._listen("wifi", "psiu-ascii")
        for name in names:
            robot = self._ascii(name)
            self.speakers.append((self._udp(home, robot), robot))
        self.calls += [Call(name, "parafrente", (1,)) for name in self._names]

    def _bytes(self) -> None:
        for number in range(4):
            name, address = f"ARM{number}", 0x10 + number
            self._pty(f"arm{number}", "psiu-hexa", HexaRobot(address, topology="point-to-point", telemetry_s=1.0))
            self.text += f'topology = "point-to-point"\n[robots.{name}]\naddress = {address}\nlink = "arm{number}"\n'
            self._node(name)
        home = self._listen("field", "psiu-hexa")
        self.text += 'topology = "ad-hoc"\n'
        for number in range(4):
            name, address = f"CAR{number}", 0x20 + number
            self._udp(home, HexaRobot(address, topology="ad-hoc", telemetry_s=1.0))
            self.text += f'[robots.{name}]\naddress = {address}\nlink = "field"\n'
            self._node(name)

    def _node(self, robot: str) -> None:
        self.text += 'nodes.garra = { node = 4, type = "servo" }\n'
        self.calls.append(Call(robot, "garra", (45,)))

    def _others(self) -> None:
        for number in range(2):
            self._pty(f"body{number}", "mitya", MityaBody(telemetry_s=1.0))
            self._is_there(f"BODY{number}", f"body{number}", Call(f"BODY{number}", "D", (10,)))
        home = self._listen("phone", "mitya")
        self._udp(home, MityaBody(phone=True, telemetry_s=1.0))
        self._is_there("PHONE", "phone", Call("PHONE", "D", (10,)))
        for number in range(2):
            self._pty(f"board{number}", "firmata", FirmataBoard())
            self._is_there(f"BOARD{number}", f"board{number}", Call(f"BOARD{number}", "led", (1,)))
            self.text += 'pins.led = { pin = 13, mode = "output" }\n'
            self._pty(f"lamp{number}", "amarino", AmarinoBoard(functions={"b": ""}, telemetry_s=1.0))
            self._is_there(f"LAMP{number}", f"lamp{number}", Call(f"LAMP{number}", "brilho", (200,)))
            self.text += 'commands.brilho = { flag = "b", parameters = ["int"], answer = true }\n'
        self._pty("team", "soccer", *SoccerRobot.team("mirosot"))
        self.text += 'preset = "mirosot"\n'
        for number in (1, 2, 3):
            self._is_there(f"KICK{number}", "team", Call(f"KICK{number}", "rodas", (3, 3)))
            self.text += f"address = {number}\n"

    def _is_there(self, robot: str, link: str, call: Call) -> None:
        self.text += f'[robots.{robot}]\nlink = "{link}"\n'
        self.calls.append(call)

    def _ascii(self, name: str) -> AsciiRobot:
        towards = self._random.choice([other for other in self._names if other != name])
        return AsciiRobot(name, telemetry_s=TELEMETRY_S, telemetry_to=towards, wildcard_delay_s=0.2)

    def _faults(self) -> Faults:
        seed = self._random.randrange(1 << 30)
        return Faults(loss=0.02, corruption=0.02, duplicate=0.01, jitter_s=0.01, seed=seed)

    def _pty(self, link: str, protocol: str, *robots: Robot) -> Port:
        device = self._folder / link
        baudrate = BAUDRATES.get(protocol, 115200)
        self.text += SERIAL.format(link=link, device=device, protocol=protocol, baudrate=baudrate)
        self.ports.append(PtyPort(*robots, link=device, faults=self._faults()))
        return self.ports[-1]

    def _listen(self, link: str, protocol: str) -> str:
        port = next(self._udp_ports)
        self.text += UDP.format(link=link, port=port, protocol=protocol)
        return f"127.0.0.1:{port}"

    def _udp(self, home: str, robot: Robot) -> Port:
        self.ports.append(UdpPort(robot, peer=home, faults=self._faults()))
        return self.ports[-1]

"""Simulated robots and faulty links, to test tools with: the broker's own and other people's.

    robot = AsciiRobot("MNERIM", quirks={"crlf", "junk"}, extras=[Extra.parse("distancia:0=42")])
    async with PtyPort(robot, link=Path("/tmp/psiu-radio"), faults=Faults(loss=0.05)) as port:
        await port.until(lambda: robot.position.x == 100)

`psiu_broker.simulator.rfcomm` needs the extra ``bluetooth-simulator`` and is imported only on request.
"""

from psiu_broker.simulator.amarino import AmarinoBoard
from psiu_broker.simulator.ascii import QUIRKS, AsciiRobot, Extra, Position, Quirk
from psiu_broker.simulator.faults import Faults
from psiu_broker.simulator.firmata import Drift, FirmataBoard
from psiu_broker.simulator.hexa import HexaRobot
from psiu_broker.simulator.mitya import Action, Body, MityaBody, MityaVersion
from psiu_broker.simulator.robot import Heard, Reply, Robot
from psiu_broker.simulator.soccer import TEAMS, SoccerRobot
from psiu_broker.simulator.transports import Port, PtyPort, Simulation, UdpPort

__all__ = [
    "QUIRKS",
    "TEAMS",
    "Action",
    "AmarinoBoard",
    "AsciiRobot",
    "Body",
    "Drift",
    "Extra",
    "Faults",
    "FirmataBoard",
    "Heard",
    "HexaRobot",
    "MityaBody",
    "MityaVersion",
    "Port",
    "Position",
    "PtyPort",
    "Quirk",
    "Reply",
    "Robot",
    "Simulation",
    "SoccerRobot",
    "UdpPort",
]

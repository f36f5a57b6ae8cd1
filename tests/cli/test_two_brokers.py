"""The commands for the mesh, asked of two brokers in processes of their own with a robot each."""

import json
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from click.testing import CliRunner, Result

from psiu_broker.cli.tool import psiu
from psiu_broker.messages import Mesh, Trace, Why

CONFIGURATION = """
[broker]
name = "{name}"
[zenoh]
listen = ["tcp/127.0.0.1:{bus}"]
[mesh]
connect = {connect}
[links.wifi]
adapter = "udp"
listen = "127.0.0.1:{wifi}"
peers = ["127.0.0.1:{robot}"]
protocol = "psiu-ascii"
"""


class Brokers:
    """base has MNERIM, north has BETA; asked through base."""

    def __init__(self, process: Callable[..., Any], port: Callable[[socket.SocketKind], int], folder: Path) -> None:
        buses = [port(socket.SOCK_STREAM) for _ in range(2)]
        self.env = {"PSIU_CONNECT": f"tcp/127.0.0.1:{buses[0]}"}
        self.processes = []
        for index, (name, robot) in enumerate((("base", "MNERIM"), ("north", "BETA"))):
            wifi, far = (port(socket.SOCK_DGRAM) for _ in range(2))
            connect = json.dumps([f"tcp/127.0.0.1:{buses[0]}"] if index else [])
            file = folder / f"{name}.toml"
            file.write_text(CONFIGURATION.format(name=name, bus=buses[index], connect=connect, wifi=wifi, robot=far))
            self.processes.append(process("psiu", "sim", "--json", "--name", robot, "--udp", f"127.0.0.1:{far}"))
            self.processes[-1].until('"ready"')
            self.processes.append(process("psiu-broker", "run", "--config", file))
            self.processes[-1].until("is ready")

    def run(self, *words: str | Path) -> Result:
        return CliRunner().invoke(psiu, [str(word) for word in words], env=self.env, prog_name="psiu")

    def json(self, *words: str) -> Any:
        result = self.run(*words, "--json")
        assert result.exit_code == 0, result.output
        return json.loads(result.stdout)

    def agree(self) -> bool:
        """Whether both see each other, far and near, and both robots."""
        seen = [Mesh.model_validate(each) for each in self.json("mesh")]
        return len(seen) == 2 and all(
            len(each.robots) == 2 and each.brokers and each.brokers[0].linked and each.brokers[0].rtt_ms is not None
            for each in seen
        )


@pytest.fixture(scope="module")
def brokers(process: Callable[..., Any], port: Callable[..., int], tmp_path_factory: Any) -> Iterator[Brokers]:
    brokers = Brokers(process, port, tmp_path_factory.mktemp("mesh"))
    try:
        end = time.monotonic() + 20
        while not brokers.agree():
            assert time.monotonic() < end, brokers.run("mesh").output
            time.sleep(0.05)
        yield brokers
    finally:
        for each in reversed(brokers.processes):
            each.close()


def test_the_mesh_is_both_brokers_the_link_and_who_owns_whom(brokers: Brokers) -> None:
    rows = [line.split("\t") for line in brokers.run("mesh").stdout.splitlines()]
    assert [row[:2] for row in rows if row[0] == "broker"] == [["broker", "base"], ["broker", "north"]]
    (link,) = (row for row in rows if row[0] == "link")
    assert (link[1], link[2], link[7]) == ("base", "north", "direct")
    owners = {row[1]: (row[4], row[5], row[8]) for row in rows if row[0] == "robot"}
    assert owners == {"BETA": ("north", "wifi", "base north"), "MNERIM": ("base", "wifi", "base north")}


def test_the_drawing_shows_it(brokers: Brokers, tmp_path: Path) -> None:
    assert brokers.run("mesh", "--graph", tmp_path / "mesh.svg").exit_code == 0
    texts = {each.text for each in ElementTree.parse(tmp_path / "mesh.svg").iter("{http://www.w3.org/2000/svg}text")}
    assert {"base", "north", "MNERIM", "BETA"} <= texts


def test_why_goes_from_broker_to_broker(brokers: Brokers) -> None:
    first, last = (Why.model_validate(each) for each in brokers.json("why", "MNERIM", "BETA"))
    assert (first.broker, first.entry, first.via, first.link) == ("base", "wifi", "north", None)
    assert (last.broker, last.entry, last.via, last.link, last.delivered) == ("north", "@mesh", None, "wifi", True)
    assert brokers.run("why", "MNERIM", "BETA").stdout.startswith("MNERIM → BETA would arrive\n  base → north\n")
    assert brokers.json("why", "BETA", "MNERIM")[0]["broker"] == "north"


def test_a_trace_shows_the_way_there_and_back(brokers: Brokers) -> None:
    (told,) = brokers.json("trace", "MNERIM", "BETA")
    trace = Trace.model_validate(told)
    assert (trace.question, trace.answered) == ("quantoscomandos", True)
    assert [(hop.at, hop.event) for hop in trace.hops] == [
        ("base", "sent"),
        ("north", "received"),
        ("north/wifi", "written"),
        ("BETA", "answered"),
        ("base", "received"),
    ]
    times = [hop.elapsed_ms for hop in trace.hops]
    assert times == sorted(times)
    assert trace.total_ms >= times[-1] > 0


def test_a_trace_from_the_other_broker_s_robot_begins_there(brokers: Brokers) -> None:
    (told,) = brokers.json("trace", "BETA", "BETA")
    assert [hop["at"] for hop in told["hops"]] == ["north", "north/wifi", "BETA"]
    assert brokers.run("trace", "NINGUEM", "BETA").exit_code == 3

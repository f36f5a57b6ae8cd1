"""Real pseudo-terminals and real sockets: the far end here is pyserial or a plain socket."""

import asyncio
import os
import socket
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest
import serial

from psiu_broker.simulator import AsciiRobot, Extra, Faults, HexaRobot, Port, PtyPort, Robot, Simulation, UdpPort

FORWARD = b"MNERIM 034 parafrente 100 PC 02123"
DONE = b"PC 038 parafrente sucesso MNERIM 02755"
DISCOVERY = b"?? 027 qualseunome PC 01753"
NAMED = b"PC 031 qualseunome MNERIM 02078"


class FarEnd:
    """Somebody at the other side of a descriptor: everything that came, and waiting for it."""

    def __init__(self, fd: int) -> None:
        self.fd = fd
        self.received = b""
        self.ended = False
        self._news = asyncio.Event()
        os.set_blocking(fd, False)
        asyncio.get_running_loop().add_reader(fd, self._read)

    def _read(self) -> None:
        try:
            data = os.read(self.fd, 65536)
        except OSError:
            data = b""
        self.received += data
        if not data:
            self.ended = True
            self.close()
        self._news.set()

    def close(self) -> None:
        asyncio.get_running_loop().remove_reader(self.fd)

    async def until(self, condition: Callable[[], bool]) -> None:
        async with asyncio.timeout(5):
            while not condition():
                self._news.clear()
                await self._news.wait()

    async def answer(self, data: bytes, size: int) -> bytes:
        """Send `data` and wait for `size` bytes."""
        self.received = b""
        os.write(self.fd, data)
        await self.until(lambda: len(self.received) >= size)
        return self.received


@pytest.fixture
async def opened() -> AsyncIterator[Callable[[str], FarEnd]]:
    """Opens a serial port as anyone would, with pyserial."""
    ends: list[tuple[serial.Serial, FarEnd]] = []

    def open_port(path: str) -> FarEnd:
        port = serial.Serial(path, 9600, exclusive=True)
        ends.append((port, FarEnd(port.fileno())))
        return ends[-1][1]

    yield open_port
    for port, end in ends:
        end.close()
        port.close()


@pytest.fixture
async def caller() -> AsyncIterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as plain:
        plain.setblocking(False)
        plain.bind(("127.0.0.1", 0))
        yield plain


async def hears(plain: socket.socket) -> bytes:
    async with asyncio.timeout(5):
        return await asyncio.get_running_loop().sock_recv(plain, 65536)


def place(plain: socket.socket) -> str:
    host, port = plain.getsockname()
    return f"{host}:{port}"


def target(port: UdpPort) -> tuple[str, int]:
    host, _, number = port.address.rpartition(":")
    return host, int(number)


async def test_a_robot_on_a_pty_answers_whoever_opens_it(opened: Callable[[str], FarEnd]) -> None:
    robot = AsciiRobot("MNERIM")
    async with PtyPort(robot) as port:
        assert await opened(port.path).answer(FORWARD, len(DONE)) == DONE
        await port.until(lambda: robot.position.x == 100)


async def test_every_byte_passes_a_pty_unchanged_even_if_nobody_sets_the_terminal() -> None:
    robot = HexaRobot(2, topology="point-to-point")
    payload = bytes([1, 249]) + bytes(range(249))
    async with PtyPort(robot) as port:
        end = FarEnd(os.open(port.path, os.O_RDWR | os.O_NOCTTY))
        wire = HexaRobot(1, topology="point-to-point").packet(0, payload)
        assert await end.answer(wire, len(wire)) == wire
        end.close()
        os.close(end.fd)


async def test_unplugging_hangs_up_and_plugging_brings_the_name_back(
    tmp_path: Path, opened: Callable[[str], FarEnd]
) -> None:
    link = tmp_path / "psiu-radio"
    async with PtyPort(AsciiRobot("MNERIM"), link=link) as port:
        assert port.path == str(link)
        first = opened(port.path)
        port.send(b"PC 038 parafre")
        await first.until(lambda: first.received == b"PC 038 parafre")
        port.unplug()
        port.unplug()
        await first.until(lambda: first.ended)
        assert not link.is_symlink()
        port.send(b"nobody hears this")
        port.plug()
        second = opened(str(link))
        assert await second.answer(FORWARD, len(DONE)) == DONE
    assert not link.is_symlink()


async def test_a_frame_cut_by_an_unplug_does_not_spoil_the_next(opened: Callable[[str], FarEnd]) -> None:
    robot = AsciiRobot("MNERIM")
    seen: list[bytes] = []
    async with PtyPort(robot, observer=lambda way, data: seen.append(data)) as port:
        os.write(opened(port.path).fd, FORWARD[:20])
        await port.until(lambda: seen == [FORWARD[:20]])
        port.unplug()
        port.plug()
        assert await opened(port.path).answer(FORWARD, len(DONE)) == DONE


async def test_what_is_on_the_way_is_lost_when_the_cable_is_pulled(opened: Callable[[str], FarEnd]) -> None:
    async with PtyPort(AsciiRobot("MNERIM"), faults=Faults(delay_s=0.05)) as port:
        port.send(b"lost")
        port.unplug()
        port.plug()
        end = opened(port.path)
        port.send(b"kept")
        await end.until(lambda: end.received != b"")
        assert end.received == b"kept"


async def test_a_stale_link_is_replaced_and_anything_else_is_left_alone(tmp_path: Path) -> None:
    link = tmp_path / "psiu-radio"
    link.symlink_to("/dev/pts/999999")
    async with PtyPort(AsciiRobot("MNERIM"), link=link):
        assert link.exists()
    link.write_text("precious")
    before = len(os.listdir("/proc/self/fd"))  # noqa: PTH208 - a count of descriptors
    with pytest.raises(FileExistsError, match="choose another name"):
        await PtyPort(AsciiRobot("MNERIM"), link=link).open()
    assert link.read_text() == "precious"
    assert len(os.listdir("/proc/self/fd")) == before  # noqa: PTH208


async def test_a_pty_that_nobody_reads_loses_bytes_instead_of_waiting() -> None:
    async with PtyPort(AsciiRobot("MNERIM")) as port:
        for _ in range(1000):
            port.send(bytes(1000))


async def test_robots_on_one_line_hear_each_other_and_answer_everyone_in_turn(
    opened: Callable[[str], FarEnd],
) -> None:
    alfa, beta = (AsciiRobot(name, wildcard_delay_s=0.05) for name in ("ALFA", "BETA"))
    async with PtyPort(alfa, beta) as port:
        end = opened(port.path)
        both = {b"PC 029 qualseunome ALFA 01905", b"PC 029 qualseunome BETA 01913"}
        answer = await end.answer(DISCOVERY, 58)
        assert {answer[:29], answer[29:]} == both
        end.received = b""
        port.send(alfa.command("BETA", "parafrente", 50))
        await port.until(lambda: beta.position.x == 50)
        assert alfa.heard[-1][1:] == ("BETA", "parafrente", ("sucesso",))
        await end.until(lambda: end.received.count(b"parafrente") == 2)


async def test_slaves_on_one_line_do_not_take_their_own_answers_for_orders(opened: Callable[[str], FarEnd]) -> None:
    slaves = [HexaRobot(number, topology="master-slave") for number in (5, 6)]
    async with PtyPort(*slaves) as port:
        end = opened(port.path)
        assert await end.answer(bytes.fromhex("05045d"), 3) == bytes.fromhex("05045d")
        assert (await end.answer(bytes.fromhex("050603ffff"), 4))[:3] == bytes.fromhex("050541")
    assert [heard.subject for heard in slaves[0].heard] == ["ping", "node/3"]
    assert slaves[1].heard == []


async def test_faults_act_in_both_directions(opened: Callable[[str], FarEnd]) -> None:
    seen: list[tuple[str, bytes]] = []
    faults = Faults(one_byte_at_a_time=True)
    robot = AsciiRobot("MNERIM")
    async with PtyPort(robot, faults=faults, observer=lambda way, data: seen.append((way, data))) as port:
        assert await opened(port.path).answer(FORWARD, len(DONE)) == DONE
    assert [data for way, data in seen if way == "in"] == [bytes([byte]) for byte in FORWARD]
    assert [data for way, data in seen if way == "out"] == [bytes([byte]) for byte in DONE]


async def test_a_line_that_loses_everything_is_silent(opened: Callable[[str], FarEnd]) -> None:
    robot = AsciiRobot("MNERIM")
    async with PtyPort(robot, faults=Faults(loss=1.0)) as port:
        os.write(opened(port.path).fd, FORWARD)
        with pytest.raises(TimeoutError):
            await port.until(lambda: robot.heard != [], timeout_s=0.05)


async def test_jitter_keeps_the_order_of_a_stream(opened: Callable[[str], FarEnd]) -> None:
    async with PtyPort(AsciiRobot("MNERIM"), faults=Faults(jitter_s=0.02)) as port:
        end = opened(port.path)
        sent = [b"%04d" % n for n in range(200)]
        for piece in sent:
            port.send(piece)
        await end.until(lambda: len(end.received) == 800)
        assert end.received == b"".join(sent)


async def test_a_busy_event_loop_keeps_the_order_of_a_stream(opened: Callable[[str], FarEnd]) -> None:
    async with PtyPort(AsciiRobot("MNERIM"), faults=Faults(one_byte_at_a_time=True)) as port:
        end = opened(port.path)
        port.send(b"ab")
        time.sleep(0.01)  # noqa: ASYNC251 - the loop is to be late
        port.send(b"c")
        await end.until(lambda: len(end.received) == 3)
        assert end.received == b"abc"


async def test_a_robot_on_udp_answers_each_sender(caller: socket.socket) -> None:
    robot = AsciiRobot("MNERIM", extras=[Extra("devagar")], answer_s=0.05)
    async with UdpPort(robot) as port:
        caller.sendto(b"MNERIM 027 devagar PC 01614", target(port))
        await port.until(lambda: len(robot.heard) == 1)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            other.setblocking(False)
            other.sendto(DISCOVERY, target(port))
            assert await hears(other) == NAMED
        assert await hears(caller) == b"PC 035 devagar sucesso MNERIM 02418"


async def test_a_robot_on_udp_greets_its_peer_and_speaks_to_it_unasked(caller: socket.socket) -> None:
    robot = AsciiRobot("MNERIM")
    async with UdpPort(robot, peer=place(caller)) as port:
        assert await hears(caller) == b"?? 031 qualseunome MNERIM 02057"
        port.send(b"unasked")
        assert await hears(caller) == b"unasked"


async def test_half_a_datagram_does_not_spoil_the_next(caller: socket.socket) -> None:
    async with UdpPort(AsciiRobot("MNERIM")) as port:
        caller.sendto(FORWARD[:20], target(port))
        caller.sendto(FORWARD, target(port))
        assert await hears(caller) == DONE


async def test_a_robot_on_udp_returns_to_the_same_address(caller: socket.socket) -> None:
    async with UdpPort(AsciiRobot("MNERIM")) as port:
        before = port.address
        port.unplug()
        port.plug()
        assert port.address == before
        caller.sendto(DISCOVERY, target(port))
        assert await hears(caller) == NAMED


async def test_udp_duplicates_come_twice(caller: socket.socket) -> None:
    async with UdpPort(AsciiRobot("MNERIM"), peer=place(caller), faults=Faults(duplicate=1.0)):
        assert await hears(caller) == await hears(caller)


@pytest.mark.parametrize("address", ["9000", "host:", ":9000", "h:99999", "h:x"])
def test_a_wrong_udp_address_is_refused(address: str) -> None:
    with pytest.raises(ValueError, match="is not HOST:PORT"):
        UdpPort(AsciiRobot("MNERIM"), listen=address)


def test_faults_of_a_stream_are_refused_on_udp() -> None:
    with pytest.raises(ValueError, match="arrives whole"):
        UdpPort(AsciiRobot("MNERIM"), faults=Faults(one_byte_at_a_time=True))


@pytest.mark.parametrize("robot", [AsciiRobot("MNERIM", telemetry_s=0.02), HexaRobot(2, telemetry_s=0.02)])
async def test_telemetry_comes_again_and_again(robot: Robot, caller: socket.socket) -> None:
    async with UdpPort(robot, peer=place(caller)):
        assert await hears(caller) == robot.hello()
        for _ in range(3):
            assert await hears(caller) == robot.telemetry()


async def test_a_simulation_waits_for_all_its_ports_and_closes_them(caller: socket.socket) -> None:
    alfa, beta = AsciiRobot("ALFA"), AsciiRobot("BETA")
    ports = UdpPort(alfa), UdpPort(beta)
    async with Simulation(*ports) as simulation:
        caller.sendto(b"BETA 031 parafrente 50 PC 01904", target(ports[1]))
        await simulation.until(lambda: beta.position.x == 50)
    assert not any(port.plugged for port in ports)


async def test_a_simulation_that_cannot_open_one_port_opens_none(tmp_path: Path) -> None:
    taken = tmp_path / "taken"
    taken.write_text("")
    good: Port = PtyPort(AsciiRobot("ALFA"))
    with pytest.raises(FileExistsError):
        async with Simulation(good, PtyPort(AsciiRobot("BETA"), link=taken)):
            pass
    assert not good.plugged


async def test_a_mistake_in_a_condition_reaches_whoever_waits() -> None:
    async with PtyPort(AsciiRobot("MNERIM")) as port:
        with pytest.raises(ZeroDivisionError):
            await port.until(lambda: 1 / 0 > 0)


async def test_a_port_without_robots_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one"):
        PtyPort()


class Chatterbox(AsciiRobot):
    spoken = 0

    def telemetry(self) -> bytes:
        self.spoken += 1
        return super().telemetry()


async def test_nothing_happens_after_closing() -> None:
    robot = Chatterbox("MNERIM", telemetry_s=0.01)
    port = PtyPort(robot)
    async with port:
        await port.until(lambda: robot.spoken >= 2)
    count = robot.spoken
    await port.close()
    await asyncio.sleep(0.05)  # That nothing comes can only be seen by waiting.
    assert robot.spoken == count

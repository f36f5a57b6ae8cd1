"""Programs that are played a robot: what reaches the robot, what does not, and what they hear; no bus, no sockets."""

import asyncio
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
from memory_adapter import MemoryAdapter, MemoryDatagrams, MemoryTransport, codec_of, configuration

from psiu_broker.calling import Caller
from psiu_broker.codecs import psiu_ascii
from psiu_broker.codecs.codec import Directory
from psiu_broker.codecs.identity import identity
from psiu_broker.config.tables import (
    BrokerConfiguration,
    Configuration,
    LinkConfiguration,
    RobotConfiguration,
    ZenohConfiguration,
)
from psiu_broker.config.who import bindings, ends
from psiu_broker.exchange import Exchange
from psiu_broker.frame import MESH, NOBODY, Address, Frame, Way
from psiu_broker.link import Link
from psiu_broker.messages import Answer, CallRequest
from psiu_broker.playing import CALLS_KEPT, STOPS_KEPT, Program
from psiu_broker.profiles.firmata import FirmataProfile
from psiu_broker.profiles.mitya_persona import MityaPersona
from psiu_broker.profiles.persona import Call, Persona, Say
from psiu_broker.profiles.profile import Description
from psiu_broker.profiles.psiu import PsiuOptions
from psiu_broker.protocols import PROTOCOLS
from psiu_broker.report import Report
from psiu_broker.resident import Resident
from psiu_broker.routing.router import ANY, Port, Router
from psiu_broker.routing.table import Route

MNERIM, BASE = Address.named("MNERIM"), Address.named("base")
MAP = {
    "D": {"command": "parafrente", "below_zero": "paratras", "at_zero": "pare", "scale": 1},
    "y": {"command": "acena"},
    "n": {"command": "nega"},
}
ONE, OTHER = ("10.0.0.1", 9001), ("10.0.0.2", 9001)


async def until(true: Callable[[], object], timeout_s: float = 30.0) -> None:
    async with asyncio.timeout(timeout_s):
        while not true():  # noqa: ASYNC110
            await asyncio.sleep(0.002)


def panel(name: str = "painel", adapter: MemoryAdapter | None = None) -> LinkConfiguration:
    made = configuration(name, "mitya", adapter, {"version": "2013"}, plays="MNERIM")
    return replace(made, map=MityaPersona.Options.model_validate({"G": MAP["D"], "y": MAP["y"], "n": MAP["n"]}))


def radio(**options: object) -> LinkConfiguration:
    return configuration("radio", "psiu-ascii", None, None, **{"greet": False, **options})


def words(*said: str) -> bytes:
    """What MNERIM tells the broker."""
    return codec_of(configuration()).encode(psiu_ascii.message(MNERIM, BASE, *said))


class Lab:
    """MNERIM is on `radio`, where there is one; programs are at the other links."""

    def __init__(self, *links: LinkConfiguration, robots: Sequence[RobotConfiguration] = ()) -> None:
        there = {robot.name: robot for robot in robots}
        if any(link.name == "radio" for link in links):
            there["MNERIM"] = RobotConfiguration("MNERIM", "radio", "psiu-ascii", None, None, PsiuOptions())
        made = Configuration(
            BrokerConfiguration(name="base"), ZenohConfiguration(), {link.name: link for link in links}, there
        )
        plays = [link.name for link in links if link.options.plays]
        self.router = Router(
            {BASE: "psiu-ascii"},
            bindings(made),
            identity,
            self._heard,
            self._gone,
            plays=plays,
        )
        self.exchange = Exchange(BASE, self.router)
        self.resident = self.exchange.resident = Resident(made, self.exchange)
        self.links: dict[str, Link] = {}
        self.far: dict[str, MemoryTransport] = {}
        directory = Directory({"base"}, {"base", "MNERIM"})
        for link in links:
            codec = partial(PROTOCOLS[link.protocol].codec, link.codec, directory, datagrams=link.adapter.datagrams)
            opened = self.links[link.name] = Link(link, codec, self.exchange, ends=ends(made, link))
            self.exchange.add(opened)
            assert isinstance(link.adapter, MemoryAdapter)
            self.far[link.name] = MemoryTransport(link.adapter.ends)
            opened.connected(self.far[link.name])

    def _heard(self, route: Route) -> None:
        self.resident.robot_heard(route)

    def _gone(self, route: Route) -> None:
        self.resident.robot_gone(route)

    def hears(self, link: str, data: bytes, peer: object = None) -> None:
        self.links[link].received(data, peer)

    @property
    def told(self) -> list[str]:
        """What MNERIM was told."""
        return [" ".join(data.decode().split()[2:-2]) for data in self.far["radio"].wires]

    def balances(self) -> bool:
        return Report("base", self.exchange, self.resident.commands).ledger().balances


@asynccontextmanager
async def lab(*links: LinkConfiguration, robots: Sequence[RobotConfiguration] = ()) -> AsyncIterator[Lab]:
    made = Lab(*links, robots=robots)
    yield made
    assert made.balances()
    await made.resident.close()
    assert made.balances()


async def test_a_set_point_that_waited_for_its_turn_is_not_sent_after_a_stop() -> None:
    async with lab(radio(), panel()) as made:
        request = CallRequest(parameters=[50])
        call = asyncio.create_task(made.resident.call(MNERIM, "paratras", request))
        await until(lambda: made.told == ["paratras 50"])
        made.hears("painel", b"G0064")
        await asyncio.sleep(0.02)
        made.hears("painel", b"G0000")
        await until(lambda: made.told == ["paratras 50", "pare"])
        made.hears("radio", words("paratras", "sucesso"))
        await call
        await asyncio.sleep(0.05)
        assert made.told == ["paratras 50", "pare"]
        made.hears("radio", words("pare", "sucesso"))
        made.hears("painel", b"G0064")  # the same again is news after a stop
        await until(lambda: made.told == ["paratras 50", "pare", "parafrente 100"])


async def test_of_one_letter_only_the_newest_value_counts_whichever_way_it_moves_the_robot() -> None:
    async with lab(radio(), panel()) as made:
        call = asyncio.create_task(made.resident.call(MNERIM, "giradireita", CallRequest(parameters=[90])))
        await until(lambda: made.told == ["giradireita 90"])
        made.hears("painel", b"y0001")
        await asyncio.sleep(0.02)
        for value in (b"G0032", b"GFFCE", b"G0014"):
            made.hears("painel", value)
        made.hears("radio", words("giradireita", "sucesso"))
        await call
        await until(lambda: made.told[1:2] == ["acena"])
        made.hears("radio", words("acena", "sucesso"))
        await until(lambda: made.told[2:] == ["parafrente 20"])
        await asyncio.sleep(0.02)
        assert made.told[2:] == ["parafrente 20"]


async def test_a_broker_that_is_stopping_does_nothing_for_programs_any_more() -> None:
    async with lab(radio(), panel()) as made:
        await made.resident.close()
        made.hears("painel", b"y0001")
        await asyncio.sleep(0)
        assert made.exchange.accounts["painel"].fates["refused"] == 1
        assert len(asyncio.all_tasks()) == 1


async def test_what_waited_too_long_behind_other_calls_of_its_program_is_not_sent() -> None:
    async with lab(radio(max_age_s=0.1, timeout_s=0.3, retries=0), panel()) as made:
        made.hears("painel", b"y0001")
        await until(lambda: made.told == ["acena"])
        made.hears("painel", b"n0001")
        made.hears("painel", b"G0064")
        await until(lambda: made.far["painel"].wires.count(b"#0001") == 3 or len(made.told) > 1)
        assert made.told == ["acena"]


async def test_programs_that_send_the_same_at_once_are_no_doubles_of_each_other() -> None:
    async with lab(radio(), panel("um"), panel("dois"), panel("udp", MemoryDatagrams(ends=(ONE, OTHER)))) as made:
        made.hears("um", b"G0064")
        made.hears("dois", b"G0064")
        made.hears("udp", b"G0064", ONE)
        made.hears("udp", b"G0064", OTHER)
        await until(lambda: all(b"#0000" in made.far[each].wires for each in ("um", "dois", "udp")))
        assert [account.fates["answered"] for name, account in made.exchange.accounts.items() if name != "@self"][
            1:
        ] == [1, 1, 2]


async def test_of_a_robot_that_went_to_another_broker_its_program_hears_that_it_cannot() -> None:
    async with lab(radio(), panel()) as made:
        away = Way(MESH, "other")
        made.router.link_up(Port(MESH, ANY, lambda: (away,)))
        made.router.announced((MNERIM,), away, "psiu-ascii", 0.0)
        made.hears("painel", b"y0001")
        await until(lambda: made.far["painel"].wires == [b"#0001"])


async def test_programs_are_not_greeted_as_robots_are() -> None:
    board = configuration("placa", "firmata", MemoryDatagrams(ends=(ONE,)), {"role": "board"}, plays="MNERIM")
    async with lab(radio(), board) as made:
        made.hears("placa", b"\x90\x00\x00", ONE)
        assert made.exchange.accounts["@self"].arrived == 0


async def test_a_robot_of_words_is_heard_by_those_who_are_played_it() -> None:
    phone = configuration("celular", "amarino", None, {"role": "board"}, plays="MNERIM")
    async with lab(radio(), phone) as made:
        made.hears("radio", words("sonar", "12"))
        assert [b"12" in wire for wire in made.far["celular"].wires] == [True]


def board(adapter: MemoryAdapter | None = None) -> LinkConfiguration:
    return configuration("placa", "firmata", adapter, {"role": "host"})


BOOT = bytes.fromhex("f90205 f079020550004c004100430041 00f7")


async def test_a_board_that_boots_without_end_is_not_greeted_as_often_and_at_last_once_more() -> None:
    async with lab(board()) as made:
        transport = made.far["placa"]
        before = len(transport.written)
        for _ in range(200):
            made.hears("placa", BOOT)
        greeted = len(transport.written) - before
        assert 0 < greeted <= 40
        await until(lambda: len(transport.written) - before > greeted)


async def test_a_robot_that_hops_between_far_ends_is_not_greeted_at_each_hop() -> None:
    robot = RobotConfiguration("PLACA", "placa", "firmata", None, None, FirmataProfile.Options())
    async with lab(board(MemoryDatagrams(ends=(ONE, OTHER))), robots=[robot]) as made:
        for _ in range(100):
            made.hears("placa", b"\xe0\x00\x00", ONE)
            made.hears("placa", b"\xe0\x01\x00", OTHER)
        assert len(made.far["placa"].written) <= 40


@pytest.mark.parametrize("method", ["learn", "describe", "greeting"])
async def test_a_mistake_of_a_profile_neither_breaks_a_link_nor_the_books(
    method: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def mistaken(*_: object) -> object:
        raise RuntimeError("a mistake of its own")

    monkeypatch.setattr(FirmataProfile, method, mistaken)
    watched = configuration("celular", "amarino", None, {"role": "board"}, plays="PLACA")
    robot = RobotConfiguration("PLACA", "placa", "firmata", None, None, FirmataProfile.Options())
    async with lab(board(), watched, board_over_udp(), robots=[robot]) as made:
        made.hears("celular", b"A\x13")
        made.hears("placa", b"\xe0\x00\x00")
        made.hears("udp", b"\xe0\x00\x00", ONE)
        assert made.links["placa"].frames_in == 1
        assert made.balances()
        assert "a mistake of its own" in caplog.text


def board_over_udp() -> LinkConfiguration:
    return configuration("udp", "firmata", MemoryDatagrams(ends=(ONE,)), {"role": "host"})


# One program.


class Listener(Persona):
    """Does as it is told: its frames' payloads are commands; `newest` those that begin with a *."""

    def __init__(self, name: str = "", codec: Any = None, options: Any = None) -> None:
        self.answers: list[tuple[str, str]] = []

    def heard(self, frame: Frame, now: float) -> Sequence[Say | Call]:
        command = frame.payload.decode()
        if command == "raise":
            raise RuntimeError("a mistake of its own")
        return (Call(command.removeprefix("*"), newest=command.startswith("*")),)

    def answered(self, call: Call, answer: Answer | None, error: str, now: float) -> Sequence[Say]:
        self.answers.append((call.command, error))
        return ()

    def told(self, description: Description, now: float) -> Sequence[Say]:
        raise RuntimeError("a mistake of its own")


class Silent:
    """Robots that never answer."""

    def __init__(self) -> None:
        self.called: list[str] = []
        self.was_told: list[str] = []

    async def call(
        self, robot: Address, command: str, request: CallRequest, asked_at: float | None, by: Caller
    ) -> Answer:
        self.called.append(command)
        await asyncio.Event().wait()
        raise AssertionError

    async def tell(
        self, robot: Address, command: str, request: CallRequest, asked_at: float | None, by: Caller
    ) -> None:
        self.was_told.append(command)


def program(robots: Silent) -> tuple[Program, Listener]:
    listener = Listener()
    return Program(listener, MNERIM, NOBODY, "mitya", Way("painel"), lambda frame: None, robots, lambda: 0.0), listener


def hears(made: Program, command: str) -> bool:
    return made.hear(Frame(NOBODY, MNERIM, "", command.encode(), "mitya"), 0.0)


async def end(made: Program) -> None:
    made.end()
    for task in made.tasks:
        task.cancel()
    await asyncio.gather(*made.tasks, return_exceptions=True)


async def test_a_program_learns_of_what_a_stop_swept_away() -> None:
    made, listener = program(Silent())
    hears(made, "a")
    await asyncio.sleep(0)
    for command in ("b", "*c", "pare"):
        hears(made, command)
    assert {command for command, error in listener.answers if error} == {"a", "b", "c"}
    await end(made)


class Poller(Listener):
    """Asks once a second, unless it waits for the answer."""

    def __init__(self) -> None:
        super().__init__()
        self.asks = False

    def heard(self, frame: Frame, now: float) -> Sequence[Say | Call]:
        self.asks = self.asks or frame.payload == b"sonar"
        return super().heard(frame, now)

    def answered(self, call: Call, answer: Answer | None, error: str, now: float) -> Sequence[Say]:
        self.asks = False
        return super().answered(call, answer, error, now)

    def waits_until(self) -> float | None:
        return None if self.asks else 1.0


async def test_after_a_stop_that_swept_its_question_away_a_persona_has_its_turn_when_it_wants_it() -> None:
    persona = Poller()
    made = Program(persona, MNERIM, NOBODY, "mitya", Way("painel"), lambda frame: None, Silent(), lambda: 0.0)
    hears(made, "sonar")
    await asyncio.sleep(0)
    assert made._timer is None
    hears(made, "pare")
    assert persona.answers[0][0] == "sonar"
    assert made._timer is not None
    await end(made)


async def test_no_flood_of_stops_piles_up_and_none_is_lost() -> None:
    robots = Silent()
    made, _ = program(robots)
    for _ in range(500):
        hears(made, "pare")
        await asyncio.sleep(0)
    assert len(made.tasks) <= 2 * STOPS_KEPT
    await until(lambda: len(robots.called) + len(robots.was_told) == 500)
    await end(made)


async def test_no_flood_of_commands_piles_up() -> None:
    made, listener = program(Silent())
    done = [hears(made, "a") for _ in range(500)]
    assert done == [True] * CALLS_KEPT + [False] * (500 - CALLS_KEPT)
    assert len(made.tasks) == 1
    assert len(listener.answers) == 500 - CALLS_KEPT
    await end(made)


async def test_a_mistake_of_a_persona_is_that_program_s_trouble_alone(caplog: pytest.LogCaptureFixture) -> None:
    made, _ = program(Silent())
    assert not hears(made, "raise")
    made.tell({}, 0.0)
    assert "a mistake of its own" in caplog.text
    made.end()

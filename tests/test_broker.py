"""A whole broker in this process: real ptys, UDP sockets and a real Zenoh session; simulated robots at the far ends."""

import asyncio
import json
import re
import socket
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest
import zenoh
from lab_file import lab_text
from ports import free_port

from psiu_broker import broker as broker_module
from psiu_broker import calling, pulse
from psiu_broker.broker import Broker
from psiu_broker.bus.client import Client
from psiu_broker.bus.round_trip import RoundTrip
from psiu_broker.bus.session import Session
from psiu_broker.config import load
from psiu_broker.errors import BusError, CallError
from psiu_broker.frame import MESH, Address, Way
from psiu_broker.messages import Answer, CallRequest, Card
from psiu_broker.routing.table import Route
from psiu_broker.simulator import AsciiRobot, Extra, HexaRobot, PtyPort, UdpPort


async def until(true: Callable[[], object], timeout_s: float = 30.0) -> None:
    """The broker's state is values, not events: look until it is so."""
    async with asyncio.timeout(timeout_s):
        while not true():  # noqa: ASYNC110
            await asyncio.sleep(0.005)


class Lab:
    """A broker between three robots: MNERIM on a pty, BETA on UDP, an arm on a second pty."""

    def __init__(self, folder: Path) -> None:
        self.wifi = free_port(socket.SOCK_DGRAM)
        self.mnerim = AsciiRobot("MNERIM", extras=[Extra.parse("distancia:0=42")])
        self.beta = AsciiRobot("BETA")
        self.braco = HexaRobot(0x12, topology="point-to-point", actuators=(4,), sensors={7: 99})
        self.radio = PtyPort(self.mnerim, link=folder / "radio")
        self.phone = UdpPort(self.beta, peer=f"127.0.0.1:{self.wifi}")
        self.arm = PtyPort(self.braco, link=folder / "arm")
        self.file = folder / "lab.toml"
        self.file.write_text(
            lab_text(bus=free_port(), radio=self.radio.path, wifi=self.wifi, arm=self.arm.path, timeout_s=0.2)
        )
        self.broker = Broker(load(self.file))

    async def __aenter__(self) -> "Lab":
        await self.radio.open()
        await self.arm.open()
        await self.broker.start()
        await until(lambda: all(link.state == "open" for link in self.broker.links()))
        await self.phone.open()
        await until(lambda: {"MNERIM", "BETA"} <= self.heard())
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.broker.stop()
        for port in (self.radio, self.phone, self.arm):
            await port.close()

    def heard(self) -> set[str]:
        return {card.robot for card in self.broker.cards().values() if card.last_heard is not None}

    def mnerim_stopped(self) -> bool:
        return any(heard.subject == "pare" for heard in self.mnerim.heard)

    async def call(self, robot: str, command: str, *parameters: int | float | str, timeout_s: float = 30.0) -> Answer:
        request = CallRequest(parameters=list(parameters), timeout_s=timeout_s)
        return await self.broker.call(Address.parse(robot), command, request)


def watched(folder: Path) -> Lab:
    """One where MNERIM is stopped when nobody is left who could."""
    lab = Lab(folder)
    with lab.file.open("a") as file:
        file.write('[robots.MNERIM]\nlink = "radio"\nfailsafe = { command = "pare" }\n')
    lab.broker = Broker(load(lab.file))
    return lab


@pytest.fixture(autouse=True)
def a_busy_machine_is_no_standstill(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pulse, "STOOD_STILL_S", 60.0)


@pytest.fixture
async def lab(tmp_path: Path) -> AsyncIterator[Lab]:
    async with Lab(tmp_path) as lab:
        yield lab
        assert lab.broker.ledger().balances


async def test_robots_are_greeted_and_known_before_anybody_needs_them(lab: Lab) -> None:
    await until(lambda: {"MNERIM", "BETA", "BRACO"} <= lab.heard())
    cards = {card.robot: card for card in lab.broker.cards().values()}
    assert (cards["MNERIM"].link, cards["MNERIM"].protocol) == ("radio", "psiu-ascii")
    assert cards["BETA"].peer == lab.phone.address
    assert cards["BRACO"].address == "0x12"
    assert await lab.broker.healthy()


async def test_a_call_moves_the_robot_and_returns_its_answer(lab: Lab) -> None:
    answer = await lab.call("MNERIM", "parafrente", 100)
    assert (answer.status, answer.values) == ("sucesso", [])
    assert lab.mnerim.position.x == 100


async def test_a_value_comes_back_with_its_type(lab: Lab) -> None:
    assert (await lab.call("MNERIM", "distancia")).values == [42]


async def test_a_robot_of_bytes_is_called_by_the_names_and_units_of_its_nodes(lab: Lab) -> None:
    assert (await lab.call("BRACO", "garra", -90)).status == "sucesso"
    assert lab.braco.signals[4] == 0x80
    sonar = await lab.call("BRACO", "sonar")
    assert (sonar.values, sonar.unit) == ([99], "cm")
    assert (await lab.call("0x12", "ping")).status == "sucesso"


async def test_a_value_out_of_range_is_refused_before_it_is_sent(lab: Lab) -> None:
    with pytest.raises(CallError, match="parafrente takes 0–999 cm, got 1200") as refused:
        await lab.call("MNERIM", "parafrente", 1200)
    assert refused.value.code == "refused"
    assert all(heard.subject != "parafrente" for heard in lab.mnerim.heard)


async def test_an_absent_robot_is_said_to_be_unknown_within_the_deadline(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(calling, "SOUGHT_S", 60.0)
    async with asyncio.timeout(10):
        with pytest.raises(CallError, match="no robot NINGUEM") as unknown:
            await lab.call("NINGUEM", "parafrente", 1, timeout_s=0.3)
    assert unknown.value.code == "unknown_robot"


async def test_one_robot_orders_another_across_links_and_hears_its_answer(lab: Lab) -> None:
    lab.phone.send(lab.beta.command("MNERIM", "parafrente", 50))
    await lab.radio.until(lambda: lab.mnerim.position.x == 50)
    await lab.phone.until(lambda: any(heard.parameters == ("sucesso",) for heard in lab.beta.heard))


async def test_words_move_an_arm_of_bytes_and_the_answer_comes_in_its_name(lab: Lab) -> None:
    lab.phone.send(lab.beta.command("BRACO", "garra", 45))
    await lab.phone.until(
        lambda: any((heard.source, heard.parameters) == ("BRACO", ("sucesso",)) for heard in lab.beta.heard)
    )
    assert lab.braco.signals[4] == round(45 * 127 / 90)
    lab.phone.send(lab.beta.command("BRACO", "garra", 500))
    await lab.phone.until(lambda: any(heard.parameters == ("falha",) for heard in lab.beta.heard))
    lab.phone.send(lab.beta.command("BRACO", "quantoscomandos"))
    await lab.phone.until(lambda: any(heard.subject == "quantoscomandos" for heard in lab.beta.heard))


async def test_the_broker_is_a_robot_that_answers_within_forty_milliseconds(lab: Lab) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as program:
        program.setblocking(False)
        loop = asyncio.get_running_loop()

        async def ask(wire: bytes) -> tuple[bytes, float]:
            begun = time.monotonic()
            await loop.sock_sendto(program, wire, ("127.0.0.1", lab.wifi))
            async with asyncio.timeout(2):
                while not (answer := await loop.sock_recv(program, 1024)).endswith(b"base 0", -11, -4):
                    pass
            return answer, time.monotonic() - begun

        answers = [
            await ask(b"?? 027 qualseunome PC 01753"),
            await ask(_wire("base", "qualseunome")),
            await ask(_wire("base", "quantoscomandos")),
            await ask(_wire("base", "exibecomando", "3")),
            await ask(_wire("base", "exibecomando", "99")),
        ]
    assert [answer.split()[2:-2] for answer, _ in answers] == [
        [b"qualseunome"],
        [b"qualseunome"],
        [b"quantoscomandos", b"3"],
        [b"exibecomando", b"exibecomando", b"1", b"0", b"0"],
        [b"exibecomando", b"falha"],
    ]
    assert min(took for _, took in answers) < 0.04


def _wire(destination: str, *words: str) -> bytes:
    length = len(f"{destination} 000 {' '.join(words)} PC 00000")
    body = f"{destination} {length:03d} {' '.join(words)} PC ".encode()
    return body + b"%05d" % (sum(body) % 65536)


async def test_a_name_that_answers_our_question_is_not_answered_in_turn(lab: Lab) -> None:
    talk: list[bytes] = []
    lab.mnerim.receive = lambda data, now: talk.append(data) or []  # type: ignore[func-returns-value, method-assign]
    link = lab.broker.exchange.links["radio"]
    lab.broker.exchange.ask_names(link, time.monotonic())
    lab.radio.send(lab.mnerim.say("base", "qualseunome"))
    lab.radio.send(lab.mnerim.say("base", "quantoscomandos"))
    await lab.radio.until(lambda: b"quantoscomandos 3" in b"".join(talk))
    assert not re.search(rb"MNERIM \d{3} qualseunome", b"".join(talk))


async def test_discovery_learns_what_each_robot_can_do(lab: Lab) -> None:
    names = (await lab.call("base", "discover")).values
    assert {"MNERIM", "BETA", "BRACO"} <= set(names)
    cards = {card.robot: card for card in lab.broker.cards().values()}
    assert "distancia" in {command.name for command in cards["MNERIM"].commands}
    assert {"ping", "garra", "sonar"} <= {command.name for command in cards["BRACO"].commands}


async def test_an_unplugged_radio_says_so_harms_no_other_link_and_comes_back(lab: Lab) -> None:
    lab.radio.unplug()
    await until(lambda: lab.broker.links()[0].state == "waiting")
    with pytest.raises(CallError, match="radio") as down:
        await lab.call("MNERIM", "parafrente", 1, timeout_s=0.3)
    assert down.value.code == "link_down"
    assert (await lab.call("BETA", "parafrente", 1)).status == "sucesso"
    lab.radio.plug()
    await until(lambda: "MNERIM" in lab.heard())
    assert (await lab.call("MNERIM", "parafrente", 1)).status == "sucesso"
    assert lab.broker.links()[0].reopened >= 1


async def test_a_cable_pulled_in_the_middle_of_a_frame_leaves_nothing_behind(lab: Lab) -> None:
    answer = lab.mnerim.say("BETA", "parafrente", "sucesso")
    heard = lab.broker.links()[0].frames_in
    lab.radio.send(answer[:15])
    lab.radio.unplug()
    await until(lambda: lab.broker.links()[0].state == "waiting")
    lab.radio.plug()
    await until(lambda: lab.broker.links()[0].state == "open")
    lab.radio.send(answer[15:])
    lab.radio.send(lab.mnerim.say("BETA", "paratras", "sucesso"))
    await lab.phone.until(lambda: any(heard.subject == "paratras" for heard in lab.beta.heard))
    assert all(heard.subject != "parafrente" for heard in lab.beta.heard)
    assert lab.broker.links()[0].frames_in > heard


async def test_a_motion_is_never_repeated_on_silence(lab: Lab) -> None:
    arrived: list[bytes] = []
    lab.mnerim.receive = lambda data, now: arrived.append(data) or []  # type: ignore[func-returns-value, method-assign]
    with pytest.raises(CallError) as unknown:
        await lab.call("MNERIM", "parafrente", 1, timeout_s=0.6)
    assert unknown.value.code == "outcome_unknown"
    with pytest.raises(CallError) as silent:
        await lab.call("MNERIM", "quantoscomandos", timeout_s=0.6)
    assert silent.value.code == "no_answer"
    await until(lambda: b"".join(arrived).count(b"quantoscomandos") > 1)
    assert b"".join(arrived).count(b"parafrente") == 1


async def test_a_robot_that_went_with_its_broker_is_unknown(lab: Lab) -> None:
    north, router = Way(MESH, "north"), lab.broker.exchange.router
    router.announced((Address.named("FAR"),), north, "psiu-ascii", time.monotonic())
    router.peer_lost(north, time.monotonic())
    with pytest.raises(CallError, match="FAR was with another broker") as unknown:
        await lab.call("FAR", "qualseunome", timeout_s=0.2)
    assert unknown.value.code == "unknown_robot"


async def test_why_tells_the_decision_and_its_reasons(lab: Lab) -> None:
    there = lab.broker.why(Address.named("BETA"), Address.named("MNERIM"))
    assert (there.delivered, there.verdict) == (True, "delivered")
    assert any("radio" in step and "learned" in step for step in there.steps)
    nowhere = lab.broker.why(Address.named("BETA"), Address.numbered(0x77))
    assert not nowhere.delivered
    assert nowhere.verdict == "no_route"
    unheard = lab.broker.why(Address.named("BETA"), Address.named("NINGUEM"))
    assert (unheard.delivered, unheard.verdict) == (False, "no_route")
    assert any("asked for" in step for step in unheard.steps)


async def test_a_robot_of_bytes_stands_on_the_bus_under_its_name(lab: Lab) -> None:
    keys: list[str] = []
    config = zenoh.Config.from_json5(
        json.dumps({"mode": "client", "connect": {"endpoints": list(lab.broker.configuration.zenoh.listen)}})
    )
    session = await asyncio.to_thread(zenoh.open, config)
    try:
        subscriber = session.declare_subscriber("psiu/**", lambda sample: keys.append(str(sample.key_expr)))
        await until(lambda: lab.broker.exchange.bus.listened)
        assert (await lab.call("BRACO", "garra", 45)).status == "sucesso"
        await until(lambda: {"psiu/base/BRACO/node/4", "psiu/BRACO/base/ack"} <= set(keys))
        subscriber.undeclare()
    finally:
        await asyncio.to_thread(session.close)


async def test_a_port_that_is_taken_is_one_clear_line(lab: Lab) -> None:
    with pytest.raises(BusError, match="in use"):
        await Broker(load(lab.file)).start()


async def test_a_card_that_cannot_be_told_is_in_nobodys_way(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []

    def card(route: Route) -> Card:
        told.append(str(route.robot))
        raise ValueError(f"the card of {route.robot}")

    await until(lambda: not lab.broker._changed)
    monkeypatch.setattr(lab.broker.report, "card", card)
    lab.broker._note(lab.broker.exchange.router.robots())
    await until(lambda: not lab.broker._changed)
    assert sorted(told) == ["BETA", "BRACO", "MNERIM"]


class PanicException(BaseException):
    """As Zenoh raises it; only its name tells."""


@pytest.mark.parametrize("trouble", [BusError("no"), RuntimeError("no thread"), PanicException("in Rust")])
async def test_a_lost_bus_is_opened_again_whatever_goes_wrong_at_first(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, trouble: BaseException
) -> None:
    monkeypatch.setattr(broker_module, "REOPEN_S", 0.01)
    bus, open_round_trip = lab.broker._bus, RoundTrip.open
    assert bus is not None

    async def fail(*_: object) -> RoundTrip:
        monkeypatch.setattr(RoundTrip, "open", open_round_trip)
        raise trouble

    monkeypatch.setattr(RoundTrip, "open", fail)
    bus.session.panicked(PanicException("in Rust"))
    await until(lambda: lab.broker._bus not in (None, bus))
    assert RoundTrip.open == open_round_trip
    assert await lab.broker.healthy()
    assert lab.broker.exchange.bus is not bus.publisher
    assert bus.session.zenoh.is_closed()


async def test_a_broker_that_stops_while_it_gives_up_a_lost_bus_leaves_the_port_free(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    bus = lab.broker._bus
    assert bus is not None
    closing = asyncio.Event()

    async def never() -> None:
        closing.set()
        await asyncio.Event().wait()

    monkeypatch.setattr(bus.calls, "close", never)
    bus.session.panicked(PanicException("in Rust"))
    await closing.wait()
    await lab.broker.stop()
    await (await Session.open(lab.broker.configuration.zenoh.listen)).close()


async def test_the_configuration_is_told_without_secrets(tmp_path: Path) -> None:
    file = tmp_path / "secret.toml"
    file.write_text(
        '[broker]\nname = "base"\n[links.r]\nadapter = "rfcomm"\naddress = "98:D3:31:00:00:01"\npin = "8877"\n'
        'protocol = "psiu-ascii"\n'
    )
    broker = Broker(load(file))
    assert broker.config()["links"]["r"]["address"] == "98:D3:31:00:00:01"
    assert "8877" not in str(broker.config())
    assert "8877" not in repr(broker.configuration)


async def test_a_card_is_found_by_any_address_of_its_robot(lab: Lab) -> None:
    await until(lambda: "BRACO" in lab.heard())
    by_name, by_number = lab.broker.card(Address.named("BRACO")), lab.broker.card(Address.numbered(0x12))
    assert by_name is not None
    assert by_number is not None
    assert by_name.robot == by_number.robot == "BRACO"
    assert set(lab.broker.robots()) == set(lab.broker.cards())
    assert lab.broker.card(Address.named("NOBODY")) is None
    assert lab.broker.card(Address.named("base")) is None


async def test_the_status_counts_what_the_bus_did(lab: Lab) -> None:
    await until(lambda: lab.broker.status().published > 0)
    assert (lab.broker.status().unpublished, lab.broker.status().refused_puts) == (0, 0)


async def test_a_call_that_came_while_the_broker_stood_still_moves_nothing(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pulse, "STOOD_STILL_S", 1.0)
    time.sleep(pulse.STOOD_STILL_S + 0.1)  # noqa: ASYNC251 - the loop stands still, as under SIGSTOP
    for _ in range(2):  # before the clock's next tick, and after it
        with pytest.raises(CallError) as raised:
            await lab.call("MNERIM", "parafrente", 1)
        assert raised.value.code == "expired"
        await lab.broker.call(Address.named("MNERIM"), "pare", CallRequest(timeout_s=5.0))  # a stop is never late
        await asyncio.sleep(0)
    await until(lambda: not lab.broker._pulse.stale(time.monotonic()))
    assert (await lab.call("MNERIM", "parafrente", 1)).status == "sucesso"


async def test_programs_that_do_not_read_their_replies_do_not_hold_up_what_stops_robots(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with watched(tmp_path) as lab:
        await lab.call("MNERIM", "parafrente", 100)
        assert lab.broker._bus is not None
        monkeypatch.setattr(lab.broker._bus, "retire", lambda: until(lab.mnerim_stopped))
        await lab.broker.stop()


async def test_a_bus_that_cannot_take_leave_does_not_keep_the_links_from_being_closed(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    bus = lab.broker._bus
    assert bus is not None

    async def fails() -> None:
        raise RuntimeError("no leave taken")

    monkeypatch.setattr(bus, "retire", fails)
    await lab.broker.stop()
    assert all(link.state != "open" for link in lab.broker.links())
    assert "no leave taken" in caplog.text


async def test_robots_of_programs_are_stopped_where_the_bus_is_lost_and_does_not_come_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def fail() -> None:
        raise BusError("the port is taken")

    async with watched(tmp_path) as lab:
        with Client(lab.broker.configuration.zenoh.listen) as program:
            await asyncio.to_thread(program.call, "MNERIM", "parafrente", CallRequest(parameters=[100]))
            assert lab.broker._bus is not None
            monkeypatch.setattr(lab.broker, "_open_bus", fail)
            lab.broker._bus.session.panicked(PanicException("in Rust"))
            await until(lab.mnerim_stopped)


async def test_a_broker_that_stops_opens_no_bus_again(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[object] = []
    keeper = next(task for task in lab.broker._tasks if task.get_name() == "bus")
    closed = lab.broker.resident.close

    async def close() -> None:
        await closed()
        await until(lambda: opened or keeper.done())

    async def open_bus(*_: object) -> None:
        opened.append(True)

    monkeypatch.setattr(lab.broker.resident, "close", close)
    monkeypatch.setattr(lab.broker, "_open_bus", open_bus)
    lab.broker._bus_lost.set()
    await lab.broker.stop()
    assert opened == []

"""The broker as a robot, and as the voice of others: the whole way from a link's bytes and back; no bus, no sockets."""

import asyncio
import logging
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable
from typing import Any

import pytest
from memory_adapter import MemoryAdapter, MemoryDatagrams, MemoryTransport, codec_of, configuration

from psiu_broker import calling
from psiu_broker.codecs import psiu_ascii, psiu_hexa
from psiu_broker.codecs.codec import Directory
from psiu_broker.codecs.identity import identity
from psiu_broker.config.tables import (
    BrokerConfiguration,
    Configuration,
    LinkConfiguration,
    RobotConfiguration,
    ZenohConfiguration,
)
from psiu_broker.config.who import ends
from psiu_broker.errors import CallError, LinkLost
from psiu_broker.exchange import Exchange
from psiu_broker.frame import Address, Way
from psiu_broker.link import Link
from psiu_broker.messages import Answer, CallRequest
from psiu_broker.profiles import Node
from psiu_broker.profiles.hexa import HexaOptions
from psiu_broker.profiles.rarely import REMEMBERED
from psiu_broker.profiles.responder import NAMES_AT_ONCE
from psiu_broker.protocols import PROTOCOLS
from psiu_broker.resident import STOPS_KEPT, TASKS_KEPT, Resident
from psiu_broker.routing.router import Router
from psiu_broker.routing.table import Binding, Route

MNERIM = Address.named("MNERIM")
NODES = {"garra": Node(node=4, type="servo"), "sonar": Node(node=7, type="distance")}


def words(name: str = "radio", adapter: MemoryAdapter | None = None, **options: object) -> LinkConfiguration:
    return configuration(name, "psiu-ascii", adapter, None, **{"greet": False, **options})


def arm(**options: object) -> LinkConfiguration:
    codec: dict[str, object] = {"topology": "point-to-point", "remote": 0x12}
    return configuration("arm", "psiu-hexa", None, codec, **{"greet": False, **options})


def wire(source: str, destination: str, *said: str) -> bytes:
    frame = psiu_ascii.message(Address.named(source), Address.named(destination), *said)
    return codec_of(configuration()).encode(frame)


def arm_says(payload: bytes) -> bytes:
    far_end = configuration("arm", "psiu-hexa", codec={"topology": "point-to-point", "remote": 0, "local": 0x12})
    return codec_of(far_end).encode(psiu_hexa.packet(Address.numbered(0x12), Address.numbered(0), payload))


def field_says(number: int, payload: bytes) -> bytes:
    """What an ad-hoc robot tells the broker."""
    ours = psiu_hexa.packet(Address.numbered(number), Address.numbered(0), payload)
    return codec_of(configuration(protocol="psiu-hexa")).encode(ours)


def said(transport: MemoryTransport) -> list[str]:
    """Destination, message and sender of each frame written."""
    return [" ".join((part := data.decode().split())[:1] + part[2:-1]) for data in transport.wires]


class Lab:
    """A resident between links of lists; `BRACO` is at the end of a link `arm` if there is one.

    The numbers of `robots_of_bytes` are on a link `field`, `MITYA` is on a link `corpo`, `UNO` on `placa`.
    """

    def __init__(
        self,
        *links: LinkConfiguration,
        name: str = "base",
        braco: str = "BRACO",
        robots_of_bytes: Iterable[int] = (),
    ) -> None:
        own = {Address.named(name): "psiu-ascii"}
        robots: dict[str, RobotConfiguration] = {}
        bindings: tuple[Binding, ...] = ()
        if any(link.name == "arm" for link in links):
            number = Address.numbered(0x12)
            own[Address.numbered(0)] = "psiu-hexa"
            robots[braco] = RobotConfiguration(braco, "arm", "psiu-hexa", number, None, HexaOptions(nodes=NODES))
            bindings = (Binding(Address.named(braco), number, Way("arm"), "psiu-hexa"),)
        if any(link.name == "field" for link in links):
            own[Address.numbered(0)] = "psiu-hexa"
        for robot, place, protocol in (("MITYA", "corpo", "mitya"), ("UNO", "placa", "firmata")):
            if any(link.name == place for link in links):
                options = PROTOCOLS[protocol].profile.Options()
                robots[robot] = RobotConfiguration(robot, place, protocol, None, None, options)
                bindings += (Binding(Address.named(robot), None, Way(place), protocol),)
        for each in robots_of_bytes:
            bindings += (Binding(Address.named(f"R{each}"), Address.numbered(each), Way("field"), "psiu-hexa"),)
        self.router = Router(own, bindings, identity, self._heard, self._gone)
        self.exchange = Exchange(Address.named(name), self.router)
        made = Configuration(
            BrokerConfiguration(name=name), ZenohConfiguration(), {link.name: link for link in links}, robots
        )
        self.resident = self.exchange.resident = Resident(made, self.exchange)
        directory = Directory({name}, {0})
        self.links: dict[str, Link] = {}
        self.far: dict[str, MemoryTransport] = {}
        for link in links:
            unaddressed = link.name == "arm"
            self.links[link.name] = Link(
                link,
                lambda link=link: codec_of(link, directory),
                self.exchange,
                unaddressed=unaddressed,
                ends=ends(made, link),
            )
            self.exchange.add(self.links[link.name])
            self.connect(link.name, MemoryTransport(link.adapter.ends))

    def _heard(self, route: Route) -> None:
        self.resident.robot_heard(route)
        for address in route.addresses:
            self.exchange.release(address, time.monotonic())

    def _gone(self, route: Route) -> None:
        self.resident.robot_gone(route)

    def connect(self, link: str, transport: MemoryTransport) -> None:
        self.far[link] = transport
        self.links[link].connected(transport)

    def hears(self, link: str, data: bytes, peer: object = None) -> None:
        self.links[link].received(data, peer)

    async def call(self, robot: str, command: str, *parameters: int, timeout_s: float | None = None) -> Answer:
        request = CallRequest(parameters=list(parameters), timeout_s=timeout_s)
        return await self.resident.call(Address.parse(robot), command, request)

    async def tell(self, robot: str, command: str, *parameters: int) -> None:
        await self.resident.tell(Address.parse(robot), command, CallRequest(parameters=list(parameters)))

    def know(self, robot: Address = MNERIM, link: str = "radio") -> None:
        self.hears(link, wire(str(robot), "base", "parafrente", "sucesso"))


class Labs:
    def __init__(self) -> None:
        self.all: list[Lab] = []

    def __call__(self, *links: LinkConfiguration, **names: Any) -> Lab:
        self.all.append(Lab(*links, **names))
        return self.all[-1]


@pytest.fixture
async def labs() -> AsyncIterator[Labs]:
    labs = Labs()
    yield labs
    for lab in labs.all:
        await lab.resident.close()


async def until(true: Callable[[], object]) -> None:
    async with asyncio.timeout(5):
        while not true():  # noqa: ASYNC110 - what is written is a list, not an event
            await asyncio.sleep(0.001)


async def refused(call: Awaitable[Any]) -> str:
    with pytest.raises(CallError) as caught:
        await call
    return caught.value.code


class Cable(MemoryTransport):
    """The other broker's end hears what is written, soon."""

    far: Link

    def write(self, data: bytes, peer: object) -> bool:
        asyncio.get_running_loop().call_soon(self.far.received, data, None)
        return super().write(data, peer)


def join(one: Lab, other: Lab) -> tuple[Cable, Cable]:
    cables = Cable(), Cable()
    cables[0].far, cables[1].far = other.links["radio"], one.links["radio"]
    one.connect("radio", cables[0])
    other.connect("radio", cables[1])
    return cables


async def settled() -> None:
    """Everything that goes on by itself has ended, or goes on for ever."""
    for _ in range(200):
        await asyncio.sleep(0)


# Another robot's voice.


async def test_of_commands_to_a_silent_arm_none_arrives_late(labs: Labs) -> None:
    lab = labs(words(), arm(timeout_s=0.2, max_age_s=0.15))
    for degrees in ("10", "20", "30"):
        lab.hears("radio", wire("PC", "BRACO", "garra", degrees))
    await until(lambda: not lab.resident._tasks)
    assert len(lab.far["arm"].wires) == 1
    assert said(lab.far["radio"]) == ["PC garra falha BRACO"]


async def test_the_newest_command_to_a_busy_arm_is_the_one_that_arrives(labs: Labs) -> None:
    lab = labs(words(), arm())
    for degrees in ("10", "20", "90"):
        lab.hears("radio", wire("PC", "BRACO", "garra", degrees))
    await settled()
    for _ in range(2):
        lab.hears("arm", arm_says(b"A"))
        await settled()
    assert [data[1:-1] for data in lab.far["arm"].wires] == [b"\x04\x0e", b"\x04\x7f"]
    assert said(lab.far["radio"]) == ["PC garra falha BRACO", *["PC garra sucesso BRACO"] * 2]


async def test_two_brokers_with_an_arm_each_soon_fall_silent(labs: Labs) -> None:
    one, other = labs(words(), arm(), name="A", braco="BRACO1"), labs(words(), arm(), name="B", braco="BRACO2")
    for message in (
        "xyz",
        "xyz falha",
        "qualseunome",
        "quantoscomandos",
        "exibecomando 9",
        "sonar 42",
        "garra sucesso",
    ):
        cables = join(one, other)
        one.hears("radio", wire("BRACO2", "BRACO1", *message.split()))
        await settled()
        assert sum(len(cable.wires) for cable in cables) <= 2 * NAMES_AT_ONCE, message


async def test_an_answer_to_a_robot_spoken_for_is_not_answered(labs: Labs) -> None:
    lab = labs(words(), arm())
    for message in ("garra sucesso", "garra falha", "quantoscomandos 4"):
        lab.hears("radio", wire("PC", "BRACO", *message.split()))
    await settled()
    assert lab.far["radio"].wires == lab.far["arm"].wires == []
    assert lab.exchange.accounts["radio"].fates["answered"] == 3


async def test_one_refusal_is_said_once_in_a_while(labs: Labs) -> None:
    lab = labs(words(), arm())
    for degrees in ("500", "600", "700"):
        lab.hears("radio", wire("PC", "BRACO", "garra", degrees))
    lab.hears("radio", wire("PC", "BRACO", "perna"))
    await settled()
    assert said(lab.far["radio"]) == ["PC garra falha BRACO", "PC perna falha BRACO"]


async def test_words_for_a_robot_of_bytes_whose_link_is_down_are_answered_with_falha(labs: Labs) -> None:
    lab = labs(words(), arm())
    lab.links["arm"].lost(LinkLost("unplugged"))
    for message in ("garra 45", "quantoscomandos", "qualseunome", "garra sucesso"):
        lab.hears("radio", wire("PC", "BRACO", *message.split()))
    await settled()
    assert said(lab.far["radio"]) == ["PC garra falha BRACO", "PC quantoscomandos falha BRACO"]
    assert lab.exchange.accounts["radio"].fates["link_down"] == 4


async def test_what_waits_for_a_silent_arm_is_bounded(labs: Labs) -> None:
    lab = labs(words(), arm())
    for _ in range(TASKS_KEPT + 2):
        lab.hears("radio", wire("PC", "BRACO", "sonar"))
    assert lab.exchange.accounts["radio"].fates["refused"] == 2


async def test_a_stop_in_words_has_room_whatever_waits_and_a_flood_of_stops_is_bounded(labs: Labs) -> None:
    lab = labs(words(), arm())
    for _ in range(TASKS_KEPT + 2):
        lab.hears("radio", wire("PC", "BRACO", "sonar"))
    account = lab.exchange.accounts["radio"]
    for _ in range(2 * STOPS_KEPT + 3):
        lab.hears("radio", wire("PC", "BRACO", "pare"))
    assert account.fates["refused"] == 2 + 3
    assert len(lab.resident._tasks) == TASKS_KEPT + 2 * STOPS_KEPT


async def test_a_robot_that_answers_no_stop_is_stopped_again_when_it_moves_again(labs: Labs) -> None:
    lab = labs(words(), configuration("corpo", "mitya", None, {"version": "2013"}, greet=False))
    for _ in range(STOPS_KEPT):
        lab.hears("radio", wire("EVIL", "MITYA", "pare"))
    await settled()
    lab.hears("radio", wire("EVIL", "MITYA", "drive", "255"))
    await settled()
    for _ in range(3 * STOPS_KEPT):
        lab.hears("radio", wire("PC", "MITYA", "pare"))
        await settled()
    assert lab.far["corpo"].wires[STOPS_KEPT:] == [b"G00FF", *[b"G0000"] * 3 * STOPS_KEPT]
    assert len(lab.resident._tasks) == STOPS_KEPT + 1, "the drive waits for its answer"


async def test_what_is_said_for_others_is_not_logged_frame_by_frame(
    labs: Labs, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    lab = labs(words(), arm())
    lab.hears("radio", wire("PC", "BRACO", "garra", "500"))
    await settled()
    assert said(lab.far["radio"])
    assert not [record for record in caplog.records if record.name.startswith("psiu_broker.resident")]


async def test_a_robot_of_bytes_is_asked_its_name_by_words_and_tells_it(labs: Labs) -> None:
    lab = labs(words(), arm())
    lab.hears("radio", wire("PC", "BRACO", "qualseunome"))
    assert said(lab.far["radio"]) == ["PC qualseunome BRACO"]
    for _ in range(20):
        lab.hears("radio", wire("PC", "BRACO", "qualseunome"))
    assert len(said(lab.far["radio"])) < 10
    assert lab.far["arm"].wires == []


@pytest.mark.parametrize(
    ("payload", "answer"),
    [(bytes((2, 0, 1, 7)), "PC complex 0x 07 BRACO"), (bytes((1, 1, 7)), "PC complex 07 BRACO")],
)
async def test_an_arms_complex_answer_reaches_a_sender_of_words(labs: Labs, payload: bytes, answer: str) -> None:
    lab = labs(words(), arm())
    lab.hears("radio", wire("PC", "BRACO", "complex", "0xa1b2"))
    await settled()
    lab.hears("arm", arm_says(payload))
    await settled()
    assert said(lab.far["radio"]) == [answer]


async def test_an_answer_too_long_for_words_is_a_falha(labs: Labs) -> None:
    fragments = {"topology": "point-to-point", "fragment": True}
    link = configuration("arm", "psiu-hexa", None, {**fragments, "remote": 0x12}, greet=False)
    far_end = configuration("arm", "psiu-hexa", None, {**fragments, "remote": 0, "local": 0x12})
    lab = labs(words(), link)
    lab.hears("radio", wire("PC", "BRACO", "complex", "0xa1b2"))
    await settled()
    fields = psiu_hexa.packet(Address.numbered(0x12), Address.numbered(0), bytes((2, 255, 255)) + bytes(510))
    lab.hears("arm", codec_of(far_end).encode(fields))
    await settled()
    assert said(lab.far["radio"]) == ["PC complex falha BRACO"]


# Its own voice.


async def test_the_robots_of_a_group_answer_our_question_from_their_own_addresses(labs: Labs) -> None:
    lab = labs(words("wifi", MemoryDatagrams(ends=("255.255.255.255:9000",))))
    lab.exchange.ask_names(lab.links["wifi"], time.monotonic())
    for number, robot in enumerate(("MNERIM", "BETA")):
        peer = f"10.0.0.{number}:9000"
        lab.far["wifi"].ends.append(peer)
        lab.hears("wifi", wire(robot, "base", "qualseunome"), peer)
    assert said(lab.far["wifi"]) == ["?? qualseunome base"]
    lab.hears("wifi", wire("BETA", "base", "qualseunome"), peer)
    assert said(lab.far["wifi"])[1:] == ["BETA qualseunome base"]


class SlowLine(MemoryAdapter):
    @property
    def bits_per_second(self) -> int:
        return 2400


async def test_a_line_that_comes_and_goes_is_greeted_in_moderation(labs: Labs) -> None:
    lab = labs(words("radio", SlowLine(), greet=True))
    greetings = said(lab.far["radio"])
    assert greetings == ["?? qualseunome base"]
    for _ in range(50):
        lab.links["radio"].lost(LinkLost("unplugged"))
        lab.connect("radio", MemoryTransport())
        greetings += said(lab.far["radio"])
    assert 1 < len(greetings) < 5
    assert lab.exchange.allowances["radio"].refused == 51 - len(greetings)


async def test_the_robots_of_bytes_on_a_line_are_greeted_as_far_as_its_rate_allows(labs: Labs) -> None:
    link = configuration("field", "psiu-hexa", SlowLine(), None, greet=True)
    lab = labs(link, robots_of_bytes=range(1, 100))
    await settled()
    assert 1 < len(lab.far["field"].wires) < 20


async def test_a_number_that_nobody_heard_is_pinged_and_then_told(labs: Labs) -> None:
    lab = labs(configuration("field", "psiu-hexa", None, None, greet=False))
    call = asyncio.ensure_future(lab.call("0x09", "ping"))
    await settled()
    ping = bytes.fromhex("000904")
    assert [data[:3] for data in lab.far["field"].wires] == [ping]
    lab.hears("field", field_says(9, b""))
    await settled()
    assert [data[:3] for data in lab.far["field"].wires] == [ping] * 2, "the call's own; its answer was not answered"
    lab.hears("field", field_says(9, b""))
    assert (await call).status == "sucesso"


async def test_a_number_is_unknown_at_once_where_nobody_can_be_pinged(
    labs: Labs, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(calling, "SOUGHT_S", 60.0)
    lab = labs(words())
    async with asyncio.timeout(5):
        assert await refused(lab.call("0x09", "ping")) == "unknown_robot"


async def test_naks_to_many_peers_are_remembered_in_bounds(labs: Labs) -> None:
    lab = labs(configuration("field", "psiu-hexa", MemoryDatagrams(), None, greet=False, nak=True))
    for number in range(2 * REMEMBERED):
        peer = ("10.0.0.1", number)
        lab.far["field"].ends.append(peer)
        for _ in range(2):
            lab.hears("field", bytes((3, 0, 4, 99)), peer)
        lab.links["field"].peer_lost(peer)
    assert len(lab.resident._naks) == REMEMBERED


# Calls.


async def test_a_call_to_stop_passes_the_call_under_way(labs: Labs) -> None:
    lab = labs(words())
    lab.know()
    motion = asyncio.ensure_future(lab.call("MNERIM", "parafrente", 500))
    stop = asyncio.ensure_future(lab.call("MNERIM", "pare"))
    await settled()
    assert said(lab.far["radio"]) == ["MNERIM parafrente 500 base", "MNERIM pare base"]
    lab.hears("radio", wire("MNERIM", "base", "pare", "sucesso"))
    assert (await stop).status == "sucesso"
    motion.cancel()


@pytest.mark.parametrize("foreign", ["relayed", "heard", None])
async def test_a_motion_is_sent_again_only_on_a_complaint_of_its_own(labs: Labs, foreign: str | None) -> None:
    lab = labs(words(), words("wifi", MemoryDatagrams(ends=(1,))))
    lab.know()
    lab.links["radio"].last_heard = None  # long ago
    motion = asyncio.ensure_future(lab.call("MNERIM", "parafrente", 50, timeout_s=0.3 if foreign else 30.0))
    await settled()
    if foreign == "relayed":
        lab.hears("wifi", wire("PC", "MNERIM", "distancia"), 1)
    elif foreign == "heard":
        lab.hears("radio", wire("BETA", "GAMA", "giradireita", "90"))
    lab.hears("radio", b"CHECKSUM NAO BATEU!\r\n")
    if foreign:
        assert await refused(motion) == "outcome_unknown"
        assert said(lab.far["radio"]).count("MNERIM parafrente 50 base") == 1
    else:
        await until(lambda: said(lab.far["radio"]).count("MNERIM parafrente 50 base") == 2)
        motion.cancel()


async def test_the_answer_to_a_command_that_left_late_is_not_the_next_ones(labs: Labs) -> None:
    lab = labs(arm(timeout_s=5.0))
    lab.far["arm"].full = True
    first = asyncio.ensure_future(lab.call("BRACO", "garra", 45, timeout_s=0.5))
    await settled()
    lab.hears("arm", arm_says(b"A"))
    await settled()
    assert not first.done()
    lab.far["arm"].full = False
    lab.links["arm"].writable()
    assert await refused(first) == "outcome_unknown"
    second = asyncio.ensure_future(lab.call("BRACO", "garra", -90))
    await settled()
    assert len(lab.far["arm"].wires) == 1
    lab.hears("arm", arm_says(b"A"))
    await settled()
    assert len(lab.far["arm"].wires) == 2
    assert not second.done()
    lab.hears("arm", arm_says(b"A"))
    assert (await second).status == "sucesso"


async def test_a_command_that_never_left_is_said_to_have_expired(labs: Labs) -> None:
    lab = labs(words())
    lab.know()
    lab.far["radio"].full = True
    assert await refused(lab.call("MNERIM", "parafrente", 5, timeout_s=0.1)) == "expired"
    assert lab.links["radio"].outbox.size == 0


@pytest.mark.parametrize("why", ["its link was stuck", "its link was down"])
async def test_an_order_that_never_left_is_not_sent_along_with_the_next(labs: Labs, why: str) -> None:
    """To a board that knows no single pins, and is told of a whole port at once."""
    lab = labs(configuration("placa", "firmata", None, None, greet=False))
    lab.hears("placa", bytes.fromhex("f90203"))
    await lab.tell("UNO", "digital", 8, 1)
    if why == "its link was stuck":
        lab.far["placa"].full = True
        await lab.tell("UNO", "digital", 9, 1)
        lab.links["placa"].expire(time.monotonic() + 1000)
        lab.far["placa"].full = False
    else:
        lab.links["placa"].lost(LinkLost("unplugged"))
        assert await refused(lab.tell("UNO", "digital", 9, 1)) == "link_down"
        lab.connect("placa", MemoryTransport())
    await lab.tell("UNO", "digital", 10, 1)
    assert lab.far["placa"].wires[-1].hex() == "910500f06d0af7"


async def test_an_outbox_that_reads_its_clock_a_moment_later_still_tells_what_never_left(labs: Labs) -> None:
    lab = labs(words())
    lab.know()
    lab.far["radio"].full = True
    calling = lab.resident._calling
    moment = 1000.0
    calling._clock = lambda: moment
    frame = psiu_ascii.message(Address.named("base"), MNERIM, "parafrente", "5")
    assert calling.send(frame, 0.1) is None
    moment += 0.0999
    calling.expire("radio")
    assert lab.links["radio"].outbox.size == 0


async def test_a_link_or_a_far_end_that_goes_away_ends_the_calls_there_at_once(labs: Labs) -> None:
    lab = labs(words(), words("wifi", MemoryDatagrams(ends=(("127.0.0.1", 9001), ("127.0.0.1", 9002)))))
    beta = Address.named("BETA")
    lab.know()
    lab.hears("wifi", wire("BETA", "base", "parafrente", "sucesso"), ("127.0.0.1", 9001))
    for end, robot in (
        (lambda: lab.links["radio"].lost(LinkLost("unplugged")), MNERIM),
        (lambda: lab.links["wifi"].peer_lost(("127.0.0.1", 9001)), beta),
    ):
        call = asyncio.ensure_future(lab.call(str(robot), "parafrente", 50))
        await settled()
        end()
        await settled()
        assert call.done()
        assert await refused(call) == "link_down"


async def test_a_command_that_waits_when_its_link_goes_down_is_told_why(labs: Labs) -> None:
    lab = labs(words())
    lab.know()
    lab.far["radio"].full = True
    call = asyncio.ensure_future(lab.call("MNERIM", "parafrente", 1))
    await settled()
    lab.links["radio"].lost(LinkLost("/dev/radio: unplugged"))
    with pytest.raises(CallError, match=r"its link is down \(/dev/radio: unplugged\)"):
        await call


async def test_what_a_robot_told_of_itself_is_forgotten_with_it(labs: Labs) -> None:
    lab = labs(words())
    lab.know()

    def commands() -> set[str]:
        route = lab.router.find(MNERIM)
        assert route is not None
        return {command.name for command in lab.resident.commands(route)}

    discovery = asyncio.ensure_future(lab.call("base", "discover", timeout_s=2))
    await until(lambda: any("quantoscomandos" in line for line in said(lab.far["radio"])))
    lab.hears("radio", wire("MNERIM", "base", "quantoscomandos", "1"))
    await until(lambda: any("exibecomando" in line for line in said(lab.far["radio"])))
    lab.hears("radio", wire("MNERIM", "base", "exibecomando", "dance", "0", "0", "0"))
    await discovery
    assert "dance" in commands()
    lab.links["radio"].lost(LinkLost("unplugged"))
    lab.connect("radio", MemoryTransport())
    lab.know()
    assert "dance" not in commands()


async def test_a_put_does_not_end_a_call_and_its_answer_is_not_refused(labs: Labs) -> None:
    lab = labs(words())
    lab.know()
    call = asyncio.ensure_future(lab.call("MNERIM", "parafrente", 500))
    await settled()
    put = asyncio.ensure_future(lab.tell("MNERIM", "distancia"))
    await settled()
    assert said(lab.far["radio"]) == ["MNERIM parafrente 500 base"]
    lab.hears("radio", wire("MNERIM", "base", "parafrente", "sucesso"))
    await call
    await put
    lab.hears("radio", wire("MNERIM", "base", "distancia", "42"))
    assert said(lab.far["radio"]) == ["MNERIM parafrente 500 base", "MNERIM distancia base"]


async def test_a_put_too_old_for_its_link_is_not_sent(labs: Labs) -> None:
    lab = labs(words(max_age_s=0.05))
    lab.know()
    call = asyncio.ensure_future(lab.call("MNERIM", "parafrente", 500))
    await settled()
    assert await refused(lab.tell("MNERIM", "luz", 1)) == "expired"
    call.cancel()
    assert said(lab.far["radio"]) == ["MNERIM parafrente 500 base"]


@pytest.mark.parametrize("listening_s", [0.0, 60.0])
async def test_a_discovery_keeps_its_deadline_and_tells_who_is_known_by_then(
    labs: Labs, monkeypatch: pytest.MonkeyPatch, listening_s: float
) -> None:
    monkeypatch.setattr(calling, "LISTENING_S", listening_s)
    lab = labs(words(timeout_s=60.0))
    lab.know()
    async with asyncio.timeout(5):
        assert (await lab.call("base", "discover", timeout_s=0.1)).values == ["MNERIM"]


async def test_a_discovery_without_a_deadline_has_one(labs: Labs, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calling, "DISCOVERY_S", 0.1)
    monkeypatch.setattr(calling, "LISTENING_S", 60.0)
    lab = labs(words())
    lab.know()
    async with asyncio.timeout(5):
        assert (await lab.call("base", "discover")).values == ["MNERIM"]


async def test_a_discovery_asks_nobody_where_everyone_may_not_be_asked(labs: Labs) -> None:
    lab = labs(words(), words("quiet", wildcard=False))
    await lab.call("base", "discover", timeout_s=0.05)
    assert said(lab.far["radio"]) == ["?? qualseunome base"]
    assert lab.far["quiet"].wires == []


# Senders whose robots are out of reach.


async def test_a_sender_hears_falha_in_place_of_a_robot_out_of_reach_only_where_it_is_to(labs: Labs) -> None:
    told, untold = labs(words(proxy_errors=True), words("other")), labs(words(), words("other"))
    for lab in (told, untold):
        lab.know(MNERIM, "other")
        lab.know(Address.named("PC"))
        lab.far["radio"].written.clear()
        lab.links["other"].lost(LinkLost("gone"))
        lab.hears("radio", wire("PC", "MNERIM", "parafrente", "10"))
        lab.hears("radio", wire("PC", "MNERIM", "parafrente", "sucesso"))
        lab.hears("radio", wire("PC", "MNERIM", "qualseunome"))
        lab.exchange.expire(time.monotonic() + 60)
    assert [each for each in said(told.far["radio"]) if "falha" in each] == ["PC parafrente falha MNERIM"]
    assert not [each for each in said(untold.far["radio"]) if "falha" in each]


async def test_a_sender_hears_falha_of_what_waited_too_long_once_in_a_while(labs: Labs) -> None:
    lab = labs(words(proxy_errors=True), words("other"))
    lab.know(MNERIM, "other")
    lab.know(Address.named("PC"))
    lab.far["radio"].written.clear()
    lab.far["other"].full = True
    for _ in range(3):
        lab.hears("radio", wire("PC", "MNERIM", "parafrente", "10"))
    assert said(lab.far["radio"]) == []
    lab.exchange.expire(time.monotonic() + 60)
    assert said(lab.far["radio"]) == ["PC parafrente falha MNERIM"]

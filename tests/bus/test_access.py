"""Nobody is on the bus who does not belong, and nobody does there what is not his to do: tried with real sessions."""

import asyncio
import json
import re
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import zenoh
from click.testing import CliRunner
from ports import free_port
from secure_keys import files, make_keys
from secure_lab import FORGED, REMOTE, SecureLab, Spy, program, until, zenoh_config

from psiu_broker.broker import Broker
from psiu_broker.bus.access import EVERYTHING, access_control
from psiu_broker.bus.client import Client
from psiu_broker.cli import tool
from psiu_broker.config import ZenohConfiguration, load
from psiu_broker.errors import CallError
from psiu_broker.messages import CallRequest
from psiu_broker.routing.quarantine import TURNS
from psiu_broker.simulator import AsciiRobot

BUS = Path(__file__).parents[2] / "psiu_broker/bus"
SEVERAL = pytest.mark.parametrize("mode", ["peer", "router"])
CALL = "psiu/@call/MNERIM/parafrente"
ONE_CM = json.dumps({"parameters": [1], "timeout_s": 2})


@pytest.fixture
async def lab(tmp_path: Path) -> AsyncIterator[SecureLab]:
    async with SecureLab(tmp_path) as lab:
        yield lab


async def got(session: zenoh.Session, key: str, payload: str | None = None) -> dict[str, Any]:
    """The answers to a get, by key; refusals are nothing."""

    def get() -> dict[str, Any]:
        replies = session.get(key, payload=payload, timeout=3, target=zenoh.QueryTarget.ALL)
        return {str(reply.ok.key_expr): json.loads(reply.ok.payload.to_bytes()) for reply in replies if reply.ok}

    return await asyncio.to_thread(get)


async def forge(lab: SecureLab, session: zenoh.Session, spy: Spy, attempts: Callable[[], object]) -> None:
    """Make `attempts` with `session`, and wait until all that is let pass has come by the spy."""
    with lab.program("hill") as marker:
        await got(marker, "psiu/@broker/base/status")
        attempts()
        await got(session, "psiu/@broker/base/status")  # behind the attempts
        # Behind what the broker let pass. Said again: on a busy machine Zenoh may end a link, and begin anew.
        while "psiu/mark/mark/mark" not in spy.seen:
            marker.put("psiu/mark/mark/mark", b"", congestion_control=zenoh.CongestionControl.BLOCK)
            with suppress(TimeoutError):
                await until(lambda: "psiu/mark/mark/mark" in spy.seen, 3)


async def test_a_commander_calls_listens_and_asks(lab: SecureLab) -> None:
    with lab.program("operator") as session:
        heard: list[str] = []
        raw: list[str] = []
        subscribed = [
            session.declare_subscriber("psiu/**", lambda sample: heard.append(str(sample.key_expr))),
            session.declare_subscriber("psiu/@raw/**", lambda sample: raw.append(str(sample.key_expr))),
        ]
        assert (await got(session, CALL, ONE_CM))[CALL]["status"] == "sucesso"
        assert lab.robot.position.x == 1
        session.put(CALL, ONE_CM)
        await until(lambda: lab.robot.position.x == 2)
        await until(lambda: "psiu/MNERIM/base/parafrente" in heard and "psiu/@raw/base/wifi" in raw)
        assert set(await got(session, "psiu/*")) >= {"psiu/MNERIM"}
        assert await got(session, "psiu/@broker/base/trace/base/MNERIM")
        del subscribed


async def test_a_listener_listens_and_asks(lab: SecureLab) -> None:
    with lab.program("screen") as session:
        heard: list[str] = []
        raw: list[str] = []
        subscribed = [
            session.declare_subscriber("psiu/**", lambda sample: heard.append(str(sample.key_expr))),
            session.declare_subscriber("psiu/@raw/**", lambda sample: raw.append(str(sample.key_expr))),
        ]
        await got(session, "psiu/@broker/base/status")
        with lab.client("operator") as client:
            await asyncio.to_thread(client.call, "MNERIM", "quantoscomandos")
        await until(lambda: "psiu/MNERIM/base/quantoscomandos" in heard and "psiu/@raw/base/wifi" in raw)
        assert set(await got(session, "psiu/*")) >= {"psiu/MNERIM"}
        for word in ("status", "links", "trunks", "routes", "ledger", "health", "mesh", "config", "why/base/MNERIM"):
            assert await got(session, f"psiu/@broker/*/{word}"), word
        del subscribed


@pytest.mark.parametrize(
    "key",
    [CALL, "psiu/@call/*/parafrente", "psiu/@call/MNERIM/*", "psiu/@call/**", "psiu/@broker/base/trace/base/MNERIM",
     "psiu/@broker/*/*/base/MNERIM", "psiu/@broker/**", "psiu/**/@call/**", "psiu/@mesh/probe/base/MNERIM"],
)  # fmt: skip
async def test_a_listener_s_call_is_not_made(lab: SecureLab, key: str) -> None:
    with lab.program("screen") as session:
        said = lab.brokers[0].ledger()
        assert await got(session, key, ONE_CM) == {}
        assert await got(session, "psiu/@broker/base/status")
        assert lab.brokers[0].ledger() == said
        assert lab.robot.position.x == 0


FORBIDDEN_PUTS = (
    "psiu/MNERIM/base/parafrente",
    "psiu/MNERIM",
    "psiu/**",
    "psiu/*/*/**",
    "psiu/*",
    "**",
    "psiu/**/@mesh/**",
    "psiu/@mesh/frame/base/hill/0",
    "psiu/@mesh/beat/hill",
    "psiu/@mesh/notice/base",
    "psiu/@mesh/**",
    "psiu/@mesh/*/*",
    "psiu/@call/**",
    "psiu/@raw/base/wifi",
    "psiu/@broker/base/status",
)


@pytest.mark.parametrize("name", ["operator", "screen"])
@pytest.mark.parametrize("mode", ["client", "peer", "router"])
async def test_nothing_is_put_or_deleted_that_only_a_broker_may(lab: SecureLab, name: str, mode: str) -> None:
    with lab.program("spy") as spying, lab.program(name, mode) as session:
        spy = Spy(spying)

        def attempts() -> None:
            for key in FORBIDDEN_PUTS:
                session.put(key, b"{}", attachment=FORGED)
                session.delete(key, attachment=FORGED)

        await forge(lab, session, spy, attempts)
        assert spy.forged == []


async def test_the_spy_would_have_seen_it(lab: SecureLab) -> None:
    with lab.program("spy") as spying, lab.program("valley") as session:
        spy = Spy(spying)

        def attempts() -> None:
            for key in FORBIDDEN_PUTS:
                session.put(key, b"{}", attachment=FORGED)

        await forge(lab, session, spy, attempts)
        assert {key for key in FORBIDDEN_PUTS if key not in ("**", "psiu/**/@mesh/**")} == set(spy.forged)


async def test_a_listener_s_put_of_a_call_is_gone(lab: SecureLab) -> None:
    with lab.program("spy") as spying, lab.program("screen") as session:
        spy = Spy(spying)

        def attempts() -> None:
            for key in (CALL, "psiu/@call/*/*", "psiu/@call/MNERIM/*"):
                session.put(key, ONE_CM, attachment=FORGED)

        await forge(lab, session, spy, attempts)
        assert spy.forged == []
        assert lab.robot.position.x == 0


async def test_a_commander_cannot_delete_a_call_or_call_everybody(lab: SecureLab) -> None:
    with lab.program("spy") as spying, lab.program("operator") as session:
        spy = Spy(spying)

        def attempts() -> None:
            session.delete(CALL, attachment=FORGED)
            session.put("psiu/@call/**", ONE_CM, attachment=FORGED)

        await forge(lab, session, spy, attempts)
        assert spy.forged == []
        session.put("psiu/@call/*/parafrente", ONE_CM)  # passes, as one of its calls; and the broker takes none such
        assert await got(session, "psiu/@call/*/parafrente", ONE_CM) == {}
        assert lab.robot.position.x == 0


@pytest.mark.parametrize("name", ["operator", "screen"])
async def test_nobody_but_a_broker_declares_that_it_is_there_or_has_a_robot(lab: SecureLab, name: str) -> None:
    epoch = 2**63
    with lab.program("spy") as spying, lab.program(name) as session:
        spy = Spy(spying)
        tokens = []

        def attempts() -> None:
            for key in (
                f"psiu/@mesh/broker/hill/{epoch}/abc/0",
                f"psiu/@mesh/robot/hill/{epoch}/MNERIM/-/psiu-ascii/wifi/9/9/1/0",
                "psiu/@mesh/**",
                "psiu/MNERIM",
            ):
                tokens.append(session.liveliness().declare_token(key))

        await forge(lab, session, spy, attempts)
        assert {key for key in spy.tokens if "/base/" not in key} == set()
        assert lab.brokers[0].mesh_seen().brokers == []


@pytest.mark.parametrize("name", ["operator", "screen"])
async def test_nobody_but_a_broker_answers(lab: SecureLab, name: str) -> None:
    asked: list[str] = []
    with lab.program(name) as session, lab.program("spy") as asker:
        taken = [
            session.declare_queryable(key, lambda query: asked.append(str(query.key_expr)), allowed_origin=REMOTE)
            for key in ("psiu/@call/**", "psiu/@broker/**", "psiu/*", "psiu/@mesh/**")
        ]
        await got(session, "psiu/@broker/base/status")
        assert (await got(asker, CALL, ONE_CM))[CALL]["status"] == "sucesso"
        assert list(await got(asker, "psiu/@broker/*/status")) == ["psiu/@broker/base/status"]
        assert list(await got(asker, "psiu/MNERIM")) == ["psiu/MNERIM"]
        assert await got(asker, "psiu/@mesh/probe/hill/MNERIM") == {}
        assert asked == []
        del taken


@pytest.mark.parametrize("name", ["operator", "screen"])
async def test_nobody_but_a_broker_overhears_the_mesh_or_the_calls_of_others(lab: SecureLab, name: str) -> None:
    with lab.program(name) as session, lab.program("spy") as speaker:
        spy = Spy(session)
        await got(session, "psiu/@broker/base/status")
        speaker.put("psiu/@mesh/frame/valley/spy/0", b"secret")
        speaker.put(CALL, ONE_CM)
        token = speaker.liveliness().declare_token("psiu/@mesh/broker/spy/1/abc/0")
        await got(speaker, "psiu/@broker/base/status")
        speaker.put("psiu/mark/mark/mark", b"")
        await until(lambda: "psiu/mark/mark/mark" in spy.seen)
        assert not any("@mesh" in key or "@call" in key for key in spy.seen)
        assert list(session.liveliness().get("psiu/@mesh/**", timeout=1)) == []
        token.undeclare()


async def test_a_name_that_the_configuration_does_not_know_may_do_nothing(lab: SecureLab) -> None:
    with lab.program("spy") as spying, lab.program("stranger") as session, lab.program("hill") as marker:
        spy, overheard = Spy(spying), Spy(session)
        for key in (CALL, *FORBIDDEN_PUTS):
            session.put(key, ONE_CM, attachment=FORGED)
        for key in ("psiu/@broker/base/status", "psiu/*", CALL):
            assert await got(session, key, ONE_CM) == {}
        await got(marker, "psiu/@broker/base/status")
        marker.put("psiu/mark/mark/mark", b"")
        await until(lambda: "psiu/mark/mark/mark" in spy.seen)
        assert spy.forged == []
        assert overheard.seen == []
        assert overheard.tokens == []
        assert lab.robot.position.x == 0


async def test_without_a_certificate_of_the_same_authority_nobody_is_let_in(lab: SecureLab, tmp_path: Path) -> None:
    others = make_keys(tmp_path / "others")
    ours = files(lab.keys, "operator")
    mixed = ours.model_copy(update={"certificate": f"{others}/operator.pem", "key": f"{others}/operator.key"})
    [endpoint] = lab.endpoints
    plain = endpoint.replace("tls/", "tcp/")
    anonymous = zenoh_config(endpoint, None)
    anonymous.insert_json5("transport/link/tls/root_ca_certificate", json.dumps(ours.ca))
    for config in (
        zenoh_config(endpoint, mixed),
        zenoh_config(endpoint, files(others, "operator")),
        zenoh_config(plain, ours),
        zenoh_config(plain, None),
        anonymous,
    ):
        # With TLS 1.3 who calls may believe that it is connected before it hears that it is not.
        try:
            session = await asyncio.to_thread(zenoh.open, config)
        except zenoh.ZError:
            continue
        assert await got(session, "psiu/@broker/base/status") == {}
        session.close()
    assert lab.brokers[0]._bus is not None
    with lab.program("operator") as session:
        assert await got(session, "psiu/@broker/base/status")


async def test_a_program_cannot_pass_for_a_broker_that_is_called(tmp_path: Path) -> None:
    keys = make_keys(tmp_path / "keys")
    endpoint = f"tls/127.0.0.1:{free_port()}"
    impostor = zenoh.open(zenoh_config(endpoint, files(keys, "screen"), listen=True, mode="peer"))
    try:
        with pytest.raises(zenoh.ZError, match="Unable to connect"), program(endpoint, files(keys, "operator")):
            pass
    finally:
        impostor.close()


@SEVERAL
async def test_brokers_with_keys_are_one_network(tmp_path: Path, mode: str) -> None:
    async with SecureLab(tmp_path, ("base", "hill", "valley"), mode) as lab:
        await until(lambda: all(len(broker.mesh_seen().brokers) == 2 for broker in lab.brokers))
        await until(lambda: [each.owner for each in lab.brokers[0].mesh_seen().robots] == ["valley"])
        with lab.program("operator") as session, lab.program("screen") as screen:
            spy = Spy(screen)
            assert set(await got(screen, "psiu/@broker/*/status")) == {
                f"psiu/@broker/{name}/status" for name in ("base", "hill", "valley")
            }
            assert (await got(session, CALL, ONE_CM))[CALL]["status"] == "sucesso"
            assert await got(session, "psiu/@broker/base/trace/base/MNERIM")
            await until(lambda: "psiu/MNERIM/valley/parafrente" in spy.seen)
            # From the far broker's side a listener is behind a broker, so the near one must have asked who it is.
            assert await got(screen, CALL, ONE_CM) == {}
            screen.put(CALL, ONE_CM)
            await got(screen, "psiu/@broker/valley/status")
            assert lab.robot.position.x == 1


@SEVERAL
async def test_a_program_that_comes_as_a_router_takes_no_broker_out_of_another_s_sight(
    tmp_path: Path, mode: str, caplog: pytest.LogCaptureFixture
) -> None:
    async with SecureLab(tmp_path, ("base", "hill", "valley", "spy"), mode) as lab:
        await until(lambda: all(len(broker.mesh_seen().brokers) == 3 for broker in lab.brokers))
        await until(lambda: [each.owner for each in lab.brokers[0].mesh_seen().robots] == ["spy"])
        # Where brokers relay, it would be the shortest way from the first to the last.
        config = zenoh_config(lab.endpoints[0], files(lab.keys, "screen"), mode="router")
        config.insert_json5("connect/endpoints", json.dumps([lab.endpoints[0], lab.endpoints[3]]))
        rogue = await asyncio.to_thread(zenoh.open, config)
        try:
            await until(lambda: len([each for each in caplog.messages if "screen comes as a router" in each]) == 2)
            # It comes again and again, and a call may meet it; with it in the way for good, none would arrive.
            arrived = 0
            with lab.client("operator") as client:
                for _ in range(20):
                    with suppress(CallError):
                        await asyncio.to_thread(client.call, "MNERIM", "quantoscomandos", CallRequest(timeout_s=1))
                        arrived += 1
                    await asyncio.sleep(0.1)
            assert arrived >= 5
            await until(lambda: [len(broker.mesh_seen().brokers) for broker in lab.brokers] == [3, 3, 3, 3])
        finally:
            await asyncio.to_thread(rogue.close)


async def test_a_broker_that_is_named_among_no_brokers_is_met_by_none(tmp_path: Path) -> None:
    lab = SecureLab(tmp_path, ("base", "hill", "valley"))
    file = tmp_path / "base.toml"
    file.write_text(file.read_text().replace('"hill", ', "").replace('"screen"', '"screen", "hill"'))
    lab.brokers[0] = Broker(load(file))
    async with lab:
        base, hill, valley = lab.brokers
        await until(lambda: [each.name for each in base.mesh_seen().brokers] == ["valley"])
        await until(lambda: {each.name for each in valley.mesh_seen().brokers} == {"base", "hill"})
        # It hears what base would tell it, if it were to.
        assert [each.name for each in hill.mesh_seen().brokers] == ["valley"]


async def test_the_tool_is_told_why_its_call_goes_nowhere(lab: SecureLab) -> None:
    with lab.client("operator") as client:
        answer = await asyncio.to_thread(client.call, "MNERIM", "quantoscomandos")
        assert answer.values == [7]
        await asyncio.to_thread(client.put_call, "MNERIM", "quantoscomandos")
    with lab.client("screen") as client:
        for tell in (client.call, client.put_call):
            with pytest.raises(CallError, match="broker base lets screen only listen; nothing was sent") as caught:
                await asyncio.to_thread(tell, "MNERIM", "quantoscomandos")
            assert caught.value.code == "refused"


async def test_the_tool_goes_by_the_rules_of_the_broker_that_it_is_at(tmp_path: Path) -> None:
    lab = SecureLab(tmp_path, ("base", "hill"))
    file = tmp_path / "hill.toml"
    file.write_text(file.read_text().replace('["operator"]', "[]").replace('"screen"', '"screen", "operator"'))
    lab.brokers[1] = Broker(load(file))
    async with lab:
        await until(lambda: [each.owner for each in lab.brokers[0].mesh_seen().robots] == ["hill"])
        with lab.client("operator") as client:
            await asyncio.to_thread(client.put_call, "MNERIM", "parafrente", CallRequest(parameters=[1]))
            await until(lambda: lab.robot.position.x == 1)
        refused = pytest.raises(CallError, match="broker hill lets operator only listen")
        with Client(lab.endpoints[1:], tls=files(lab.keys, "operator")) as client, refused:
            await asyncio.to_thread(client.put_call, "MNERIM", "parafrente", CallRequest(parameters=[1]))
        assert lab.robot.position.x == 1


async def twins(lab: SecureLab, cable: int) -> None:
    """MNERIM speaks on the Wi-Fi, and another MNERIM by the cable, by turns, until the latter is held back."""
    [base] = lab.brokers
    other = AsciiRobot("MNERIM")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for turn in range(2 * TURNS):
            link = base.exchange.links["cable" if turn % 2 else "wifi"]
            before = link.frames_in
            if turn % 2:
                sender.sendto(other.say("base", "distancia", turn), ("127.0.0.1", cable))
            else:
                lab.say(lab.robot.say("base", "distancia", turn))
            await until(lambda link=link, before=before: link.frames_in > before)  # type: ignore[misc]
    assert [each.held_back for each in base.conflicts()] == [["cable"]]


async def test_a_conflict_is_told_to_who_listens_and_is_a_commander_s_to_end(tmp_path: Path) -> None:
    cable = free_port(socket.SOCK_DGRAM)
    links = f'[links.cable]\nadapter = "udp"\nlisten = "127.0.0.1:{cable}"\nprotocol = "psiu-ascii"\n'
    async with SecureLab(tmp_path, extra=links) as lab:
        [base] = lab.brokers
        release = "psiu/@broker/base/release/MNERIM/cable"
        with lab.program("screen") as screen, lab.program("operator") as operator:
            told: list[Any] = []
            subscribed = [
                each.declare_subscriber(key, lambda sample: told.append(json.loads(sample.payload.to_bytes())))
                for each, key in ((screen, "psiu/@broker/*/conflicts"), (operator, "psiu/@broker/base/conflicts"))
            ]
            await got(screen, "psiu/@broker/base/status")
            await got(operator, "psiu/@broker/base/status")
            await twins(lab, cable)
            await until(lambda: len(told) == 2)
            assert [each["held_back"] for conflicts in told for each in conflicts] == [["cable"], ["cable"]]
            assert [each["robot"] for each in (await got(screen, "psiu/@broker/*/conflicts")).popitem()[1]] == [
                "MNERIM"
            ]
            for key in (release, release.replace("base", "*"), "psiu/@broker/**", "psiu/@broker/base/release/*/*"):
                assert await got(screen, key) == {}
            assert await psiu(lab, "screen", "conflicts", "--release", "MNERIM", "cable") == (
                3,
                "psiu: broker base lets screen only listen; nothing was sent (zenoh.access in its configuration)\n",
            )
            assert len(base.conflicts()) == 1
            assert await got(operator, release) == {release: []}
            assert base.conflicts() == []
            await until(lambda: told[2:] == [[], []])
            del subscribed


async def test_a_listener_s_trace_is_not_taken_for_one_of_a_robot_that_nobody_has(lab: SecureLab) -> None:
    code, text = await psiu(lab, "screen", "trace", "base", "MNERIM")
    assert (code, "lets screen only listen" in text) == (3, True)
    code, text = await psiu(lab, "operator", "trace", "GHOST", "MNERIM")
    assert (code, "GHOST is on no broker" in text) == (3, True)


async def psiu(lab: SecureLab, name: str, *words: str) -> tuple[int, str]:
    """How `psiu` with these words ends for one with that certificate, and what it says on stderr."""
    own = ("--connect", lab.endpoints[0], "--keys", str(lab.keys / name))
    result = await asyncio.to_thread(CliRunner().invoke, tool.psiu, (*words, *own), prog_name="psiu")
    return result.exit_code, result.stderr


def test_every_word_of_the_bus_is_known_to_the_rules() -> None:
    words = {word for file in BUS.glob("*.py") for word in re.findall(r"[/\"](@[a-z]+)\b", file.read_text())}
    assert words == {key.partition("/")[0] for key in EVERYTHING if key.startswith("@")}


def test_without_rules_nothing_is_asked_of_zenoh() -> None:
    assert access_control(ZenohConfiguration(), trunks=True) is None

"""The broker as a robot: what it answers, and the loops that it never starts."""

from collections.abc import Iterator

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from psiu_broker.codecs import psiu_ascii, psiu_hexa
from psiu_broker.frame import EVERYONE, Address, Frame
from psiu_broker.messages import Answer, Command
from psiu_broker.profiles import HexaProfile, Node, Responder
from psiu_broker.profiles.psiu import said
from psiu_broker.profiles.responder import (
    NAME_EVERY_S,
    NAMES_AT_ONCE,
    PINGS_AT_ONCE,
    PINGS_EVERY_S,
    listing,
    outcome,
    refusal,
)

BASE = Address.named("base")
PC = Address.named("PC")
ARM = Address.numbered(0x12)
OURS = Address.numbered(1)


def ask(message: str, destination: Address = BASE, source: Address = PC) -> Frame:
    return psiu_ascii.message(source, destination, *message.split())


def answered(message: str, destination: Address = BASE, now: float = 0.0) -> str | None:
    answer = Responder("base").answer(ask(message, destination), now)
    if answer is None:
        return None
    assert (answer.source, answer.destination) == (BASE, PC)
    return answer.payload.decode()


@pytest.mark.parametrize(
    ("message", "answer"),
    [
        ("quantoscomandos", "quantoscomandos 3"),
        ("exibecomando 1", "exibecomando qualseunome 0 0 0"),
        ("exibecomandos 3", "exibecomando exibecomando 1 0 0"),
        ("exibecomando 0", "exibecomando falha"),
        ("exibecomando 4", "exibecomando falha"),
        ("exibecomando", "exibecomando falha"),
        ("parafrente 100", "parafrente falha"),
    ],
)
def test_the_broker_is_a_robot_with_three_commands(message: str, answer: str) -> None:
    assert answered(message) == answer


def test_the_broker_tells_its_name_to_everyone_who_asks() -> None:
    assert answered("qualseunome", EVERYONE) == "qualseunome"


def test_the_broker_tells_its_name_to_who_asks_it_but_not_to_a_robot_that_asks_back_for_ever() -> None:
    responder = Responder("base")
    told = [responder.answer(ask("qualseunome"), tenth / 10) is not None for tenth in range(10)]
    assert told == [True] * NAMES_AT_ONCE + [False] * (10 - NAMES_AT_ONCE)
    assert responder.answer(ask("qualseunome"), 20.0) is None
    assert responder.answer(ask("qualseunome", EVERYONE), 20.0) is not None
    assert responder.answer(ask("qualseunome"), 30.1) is not None


def test_a_command_to_everyone_is_not_refused() -> None:
    assert answered("parafrente 100", EVERYONE) is None


@pytest.mark.parametrize(
    "message",
    [
        "parafrente sucesso",
        "parafrente falha",
        "parafrente OK",
        "quantoscomandos 6",
        "exibecomando parafrente 1 0 0",
    ],
)
def test_an_answer_is_never_answered(message: str) -> None:
    assert answered(message) is None


def test_a_late_value_of_a_robot_that_takes_falha_for_a_command_ends_the_talk() -> None:
    responder = Responder("base")
    frame = ask("distancia 42")
    assert responder.answer(frame, 0.0) is not None
    assert responder.answer(frame, 0.5) is None
    assert responder.answer(frame, 1.9) is None
    assert responder.answer(ask("luz 3"), 1.9) is not None
    assert responder.answer(frame, 2.1) is not None


def test_a_ping_soon_after_our_answer_to_one_may_be_the_answer_to_that() -> None:
    responder = Responder("base")
    ping = psiu_hexa.packet(ARM, OURS, b"")
    answer = responder.answer(ping, 0.0)
    assert answer is not None
    assert (answer.source, answer.destination, answer.payload) == (OURS, ARM, b"")
    assert responder.answer(ping, 0.05) is None
    assert responder.answer(psiu_hexa.packet(Address.numbered(0x13), OURS, b""), 0.05) is not None
    assert all(responder.answer(ping, float(second)) is not None for second in range(1, 60)), "a watch at 1 Hz"


def test_a_ping_that_answers_ours_is_not_answered() -> None:
    responder = Responder("base")
    assert responder.answer(psiu_hexa.packet(ARM, OURS, b""), 0.0, pinging=True) is None


@pytest.mark.parametrize(
    ("payload", "answer"),
    [
        (b"?", b"F"),
        (bytes((0, 42)), b"W"),
        (bytes((4, 42)), b"W"),
        (bytes((1, 1, 0x55)), b"W"),
        (bytes((9, 9, 0x55)), b"W"),
        (b"A", None),
        (b"N", None),
        (b"B", None),
        (b"F", None),
        (b"W", None),
        (b"\xc8", None),
    ],
)
def test_packets_to_the_broker(payload: bytes, answer: bytes | None) -> None:
    told = Responder("base").answer(psiu_hexa.packet(ARM, OURS, payload), 0.0)
    assert (None if told is None else told.payload) == answer
    assert told is None or (told.source, told.destination) == (OURS, ARM)


def test_a_frame_of_another_protocol_is_left_alone() -> None:
    assert Responder("base").answer(Frame(PC, BASE, "x", b"x", "mitya"), 0.0) is None


def packets() -> Iterator[bytes]:
    yield b""
    yield from (bytes((byte,)) for byte in range(256))
    yield bytes((0, 1))
    yield bytes((1, 1, 1))


def exchange(first: Frame, gaps_s: list[float]) -> int:
    """How many frames two brokers exchange from `first` on, each one under way for the next of `gaps_s`."""
    brokers = Responder("base"), Responder("PC")
    frame: Frame | None = first
    now = 0.0
    for step, gap_s in enumerate(gaps_s):
        now += gap_s
        frame = brokers[step % 2].answer(frame, now)
        if frame is None:
            return step
    return len(gaps_s)


@given(st.sampled_from([*packets()]), st.lists(st.floats(0, 0.99), min_size=100, max_size=100))
@example(b"", [0.06] * 100)
def test_two_brokers_soon_slow_down_to_a_ping_a_second_and_fall_silent_after_any_other_packet(
    first: bytes, gaps_s: list[float]
) -> None:
    frames = exchange(psiu_hexa.packet(ARM, OURS, first), gaps_s)
    assert frames <= (2 * (PINGS_AT_ONCE + sum(gaps_s) / PINGS_EVERY_S) + 1 if first == b"" else 3)


words = st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=60)
questions = st.sampled_from(["qualseunome", "QUALSEUNOME", "quantoscomandos", "exibecomando 1", "parafrente 1"])


@given(words | questions, st.booleans(), st.lists(st.floats(0, 5), min_size=30, max_size=30))
@example("qualseunome", False, [2.5] * 30)
@example("qualseunome", True, [5.0] * 30)
def test_two_brokers_fall_silent_after_any_words_and_never_raise(
    message: str, everyone: bool, gaps_s: list[float]
) -> None:
    frames = exchange(Frame(PC, EVERYONE if everyone else BASE, "", message.encode(), "psiu-ascii"), gaps_s)
    names = message.lower().split()[:1] == ["qualseunome"]
    assert frames <= (2 * (NAMES_AT_ONCE + sum(gaps_s) / NAME_EVERY_S) + 3 if names else 3)


def test_the_responder_remembers_a_bounded_number_of_robots() -> None:
    responder = Responder("base")
    for number in range(5000):
        responder.answer(ask("x", source=Address.named(f"R{number}")), 0.0)
    assert len(responder._rarely) <= 256


def test_a_hexa_robots_nodes_are_listed_for_an_ascii_asker() -> None:
    commands = HexaProfile({"garra": Node(node=4, type="servo")}).commands()

    def told(message: str) -> str | None:
        answer = listing(ask(message, Address.named("BRACO")), "BRACO", commands)
        return None if answer is None else f"{answer.source} {answer.payload.decode()}"

    assert told("quantoscomandos") == "BRACO quantoscomandos 4"
    assert told("exibecomando 2") == "BRACO exibecomando garra 0 1 0"
    assert told("exibecomando 5") == "BRACO exibecomando falha"
    assert told("garra 45") is None
    assert told("quantoscomandos 4") is None
    assert told("qualseunome") == "BRACO qualseunome"
    assert told("qualseunome sucesso") is None


def told(frame: Frame, name: str, answer: Answer) -> bytes | None:
    said = outcome(frame, name, answer)
    return None if said is None else said.payload


def test_a_call_made_for_an_ascii_robot_is_answered_in_its_words() -> None:
    frame = ask("garra 45", Address.named("BRACO"))
    assert told(frame, "BRACO", Answer(status="sucesso", elapsed_ms=1)) == b"garra sucesso"
    assert told(frame, "BRACO", Answer(values=[42, 1.5], elapsed_ms=1)) == b"garra 42 1.5"
    refused = refusal(frame, "BRACO")
    assert (refused.source, refused.destination, refused.payload) == (Address.named("BRACO"), PC, b"garra falha")


def test_an_answer_with_an_empty_field_or_without_words_is_still_an_answer() -> None:
    frame = ask("complex 0xa1b2", Address.named("BRACO"))
    assert told(frame, "BRACO", Answer(values=["", "07"], elapsed_ms=1)) == b"complex 0x 07"
    assert told(frame, "BRACO", Answer(values=[float("inf")], elapsed_ms=1)) == b"complex falha"


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (["bom dia"], b"fala bom dia"),
        (["StandardFirmata 2.ino", "2.5"], b"fala StandardFirmata 2.ino 2.5"),
        (["ol\u00e1\tmundo\x07", 3], b"fala ol? mundo? 3"),
        ([" "], b"fala 0x"),
    ],
)
def test_a_text_is_told_word_by_word_and_is_no_refusal(values: list[str | int | float], said: bytes) -> None:
    assert told(ask("fala", Address.named("PLACA")), "PLACA", Answer(values=values, elapsed_ms=1)) == said


def test_of_a_robot_that_does_not_answer_nothing_is_said_that_would_read_as_a_command() -> None:
    frame = ask("drive 100", Address.named("MITYA"))
    assert outcome(frame, "MITYA", Answer(remark="sent; this robot does not answer", elapsed_ms=1)) is None


def test_a_robot_spoken_for_tells_its_name_to_one_asker_once_in_a_while_and_what_it_can_do_at_any_time() -> None:
    responder = Responder("base")
    braco, commands = Address.named("BRACO"), HexaProfile({}).commands()

    def told(message: str, now: float, name: str = "BRACO") -> bool:
        return responder.listed(ask(message, braco), name, commands, now) is not None

    assert [told("qualseunome", 0.0) for _ in range(6)] == [True] * NAMES_AT_ONCE + [False] * (6 - NAMES_AT_ONCE)
    assert not told("qualseunome", 29.0)
    assert told("qualseunome", 31.0)
    assert told("qualseunome", 31.0, "OUTRO")
    assert told("quantoscomandos", 0.0)
    assert told("quantoscomandos", 0.1)


def test_a_refusal_for_a_robot_spoken_for_is_said_once_in_two_seconds_to_each_for_each_command() -> None:
    responder = Responder("base")

    def refused(message: str, now: float, name: str = "BRACO", source: Address = PC) -> bool:
        return responder.refused(ask(message, Address.named(name), source), name, now) is not None

    assert [refused("garra 500", now) for now in (0.0, 1.9, 2.1)] == [True, False, True]
    assert refused("luz", 2.1)
    assert refused("garra 500", 2.1, "OUTRO")
    assert refused("garra 500", 2.1, source=BASE)


def test_a_robot_whose_values_come_late_hears_one_wtf_in_two_seconds() -> None:
    responder = Responder("base")

    def told(now: float, source: Address = ARM) -> bool:
        return responder.answer(psiu_hexa.packet(source, OURS, bytes((0, 42))), now) is not None

    assert sum(told(number / 100) for number in range(100)) == 1
    assert told(1.0, Address.numbered(0x13))
    assert told(2.1)


def test_a_broker_with_more_commands_lists_them() -> None:
    responder = Responder("base", [Command(name="acorde")])
    answer = responder.answer(ask("exibecomando 1"), 0.0)
    assert answer is not None
    assert said(answer).values == ("acorde", 0, 0, 0)

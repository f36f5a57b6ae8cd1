"""PSIU ASCII robots: what is refused before sending, what goes on the wire, what counts as an answer."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.errors import CallError
from psiu_broker.frame import EVERYONE, Address, Frame
from psiu_broker.messages import Command, Value
from psiu_broker.profiles import PsiuProfile, Reply
from psiu_broker.profiles.psiu import LEARNED_KEPT, listed, text, typed

MNERIM = Address.named("MNERIM")
PC = Address.named("PC")


def said_by(source: Address, message: str, destination: Address = PC) -> Frame:
    payload = message.encode()
    return Frame(source, destination, message.partition(" ")[0], payload, "psiu-ascii")


def refusal(command: str, *parameters: Value, profile: PsiuProfile | None = None) -> str:
    with pytest.raises(CallError) as caught:
        (profile or PsiuProfile()).request(command, parameters)
    assert caught.value.code == "refused"
    return str(caught.value)


@pytest.mark.parametrize(
    ("command", "parameters", "payload"),
    [
        ("parafrente", [100], b"parafrente 100"),
        ("parafrente", [0], b"parafrente 0"),
        ("paratras", [999], b"paratras 999"),
        ("giradireita", [360], b"giradireita 360"),
        ("giraesquerda", ["90"], b"giraesquerda 90"),
        ("qualseunome", [], b"qualseunome"),
        ("quantoscomandos", [], b"quantoscomandos"),
        ("exibecomando", [1], b"exibecomando 1"),
        ("exibecomandos", [1], b"exibecomando 1"),
        ("acenda", [], b"acenda"),
        ("fale", ["oi", 1.5, -3], b"fale oi 1.5 -3"),
        ("fale", [1e-7], b"fale 0.0000001"),
    ],
)
def test_a_call_becomes_the_words_of_the_document(command: str, parameters: list[Value], payload: bytes) -> None:
    request = PsiuProfile().request(command, parameters)
    assert (request.subject, request.payload) == (payload.split()[0].decode(), payload)


@pytest.mark.parametrize(
    ("command", "parameters", "message"),
    [
        ("parafrente", [1200], "parafrente takes 0–999 cm, got 1200"),
        ("parafrente", [1000], "parafrente takes 0–999 cm, got 1000"),
        ("paratras", [-1], "paratras takes 0–999 cm, got -1"),
        ("giradireita", [361], "giradireita takes 0–360 deg, got 361"),
        ("giraesquerda", [361], "giraesquerda takes 0–360 deg, got 361"),
        ("parafrente", [], "parafrente takes 0–999 cm, got nothing"),
        ("parafrente", [1, 2], "parafrente takes 0–999 cm, got 1 2"),
        ("parafrente", [1.25], "parafrente takes 0–999 cm, got 1.25"),
        ("parafrente", ["sucesso"], "parafrente takes 0–999 cm, got sucesso"),
        ("qualseunome", [1], "qualseunome takes no parameters, got 1"),
        ("quantoscomandos", ["x"], "quantoscomandos takes no parameters, got x"),
        ("exibecomando", [0], "exibecomando takes a number from 1, got 0"),
        ("exibecomando", [], "exibecomando takes a number from 1, got nothing"),
    ],
)
def test_a_known_command_is_refused_before_sending_and_says_why(
    command: str, parameters: list[Value], message: str
) -> None:
    assert refusal(command, *parameters) == message


@pytest.mark.parametrize("parameter", ["dois passos", "", "linha\n", "ção", "\x7f", "\t", math.nan, math.inf])
def test_a_parameter_that_is_not_one_printable_word_is_refused(parameter: Value) -> None:
    assert "cannot be sent" in refusal("fale", parameter)


@pytest.mark.parametrize("command", ["", "dois passos", "ação", "a\r"])
def test_a_command_that_is_not_one_printable_word_is_refused(command: str) -> None:
    assert "cannot be sent" in refusal(command)


@pytest.mark.parametrize("command", ["qualseunome", "quantoscomandos"])
def test_questions_may_be_asked_again(command: str) -> None:
    assert PsiuProfile().request(command, []).question


@pytest.mark.parametrize(("command", "parameters"), [("parafrente", [1]), ("giradireita", [1]), ("acenda", [])])
def test_anything_else_may_have_moved_the_robot_and_is_never_asked_again(command: str, parameters: list[Value]) -> None:
    assert not PsiuProfile().request(command, parameters).question


def test_a_long_way_is_given_more_time() -> None:
    profile = PsiuProfile()
    assert profile.request("parafrente", [0]).timeout_s == 2.0
    assert profile.request("parafrente", [500]).timeout_s == pytest.approx(8.0)
    assert profile.request("fale", ["oi", -100]).timeout_s == pytest.approx(3.2)


def test_a_number_that_is_no_distance_does_not_make_the_caller_wait_for_days() -> None:
    assert PsiuProfile().request("acerte", [20120309]).timeout_s == pytest.approx(2 + 0.012 * 999)


def test_what_the_robot_lists_is_checked_by_count_and_type() -> None:
    profile = PsiuProfile()
    profile.learn_command(Command(name="mova", ints=2, floats=1))
    profile.learn_command(Command(name="toque", chars=1))
    assert refusal("mova", 1, profile=profile) == "mova takes 2 ints and 1 float, got 1"
    assert refusal("mova", 1, 2, "x", profile=profile) == "mova takes 2 ints and 1 float, got 1 2 x"
    assert refusal("mova", 1, 0.5, 2.5, profile=profile) == "mova takes 2 ints and 1 float, got 1 0.5 2.5"
    assert refusal("toque", profile=profile) == "toque takes 1 char, got nothing"
    assert profile.request("mova", [1, 2, 0.5]).payload == b"mova 1 2 0.5"
    assert profile.request("mova", [1, 2, 3]).payload == b"mova 1 2 3"
    assert profile.request("toque", ["x"]).payload == b"toque x"
    assert profile.request("toque", [7]).payload == b"toque 7"


def test_a_learned_motion_keeps_the_range_of_the_document_where_its_count_fits() -> None:
    profile = PsiuProfile()
    profile.learn_command(Command(name="parafrente", floats=1))
    assert refusal("parafrente", 1200, profile=profile) == "parafrente takes 0–999 cm, got 1200"
    assert profile.request("parafrente", [1.25]).payload == b"parafrente 1.25"
    profile.learn_command(Command(name="parafrente", ints=2))
    assert profile.request("parafrente", [5000, 3]).payload == b"parafrente 5000 3"


def test_a_robot_cannot_change_the_questions_of_the_document() -> None:
    profile = PsiuProfile()
    profile.learn_command(Command(name="quantoscomandos", ints=3))
    assert profile.request("quantoscomandos", []).question
    assert [command.name for command in profile.commands()].count("quantoscomandos") == 1


def test_commands_are_the_documents_until_the_robot_has_listed_its_own() -> None:
    profile = PsiuProfile()
    names = [command.name for command in profile.commands()]
    assert names[:3] == ["qualseunome", "quantoscomandos", "exibecomando"]
    assert names[3:] == ["parafrente", "paratras", "giradireita", "giraesquerda"]
    profile.learn_command(Command(name="parafrente", ints=1))
    listed_now = profile.commands()
    assert [command.name for command in listed_now[3:]] == ["parafrente"]
    assert listed_now[3].maximum == 999


def test_a_robot_that_lists_without_end_teaches_a_bounded_number_of_commands() -> None:
    profile = PsiuProfile()
    for number in range(LEARNED_KEPT * 2):
        profile.learn_command(Command(name=f"c{number}"))
    assert len(profile.commands()) == LEARNED_KEPT + 3


@pytest.mark.parametrize(
    ("values", "command"),
    [
        (["parafrente", 1, 0, 0], Command(name="parafrente", ints=1)),
        (["mova", 1, 2, 3], Command(name="mova", ints=1, floats=2, chars=3)),
        (["parafrente"], None),
        ([1, 0, 0, 0], None),
        (["x", 1, 0, 0.5], None),
        (["x", -1, 0, 0], None),
        (["x", 99999999, 0, 0], None),
        ([], None),
    ],
)
def test_an_exibecomando_answer_is_a_command_and_garbage_is_none(values: list[Value], command: Command | None) -> None:
    assert listed(values) == command


@pytest.mark.parametrize(
    ("message", "status"),
    [
        ("parafrente sucesso", "sucesso"),
        ("parafrente SUCESSO", "sucesso"),
        ("parafrente OK", "sucesso"),
        ("parafrente RespOK", "sucesso"),
        ("parafrente falha", "falha"),
        ("parafrente FALHA", "falha"),
        ("parafrente RespFALHA", "falha"),
    ],
)
def test_every_spelling_of_success_and_failure_is_understood(message: str, status: str) -> None:
    profile = PsiuProfile()
    reading = profile.read(profile.request("parafrente", [1]), said_by(MNERIM, message))
    assert isinstance(reading, Reply)
    assert (reading.status, reading.values) == (status, ())


@pytest.mark.parametrize(
    ("command", "parameters", "message", "values"),
    [
        ("quantoscomandos", [], "quantoscomandos 6", (6,)),
        ("exibecomando", [1], "exibecomando parafrente 1 0 0", ("parafrente", 1, 0, 0)),
        ("exibecomando", [1], "exibecomandos parafrente 1 0 0", ("parafrente", 1, 0, 0)),
        ("qualseunome", [], "qualseunome", ("MNERIM",)),
        ("qualseunome", [], "qualseunome MNERIM", ("MNERIM",)),
        ("distancia", [], "distancia 42", (42,)),
        ("distancia", [], "distancia 1.25 perto", (1.25, "perto")),
    ],
)
def test_values_come_typed(command: str, parameters: list[Value], message: str, values: tuple[Value, ...]) -> None:
    profile = PsiuProfile()
    reading = profile.read(profile.request(command, parameters), said_by(MNERIM, message))
    assert reading == Reply(None, values)
    assert [type(value) for value in values] == [type(value) for value in reading.values]


def test_a_status_may_be_followed_by_values() -> None:
    profile = PsiuProfile()
    reading = profile.read(profile.request("meca", []), said_by(MNERIM, "meca sucesso 12"))
    assert reading == Reply("sucesso", (12,))


@pytest.mark.parametrize(
    ("command", "parameters", "message"),
    [
        ("parafrente", [1], "paratras sucesso"),
        ("parafrente", [1], "parafrente 100"),
        ("parafrente", [1], ""),
        ("quantoscomandos", [], "quantoscomandos"),
        ("exibecomando", [1], "exibecomando 1"),
    ],
)
def test_a_robot_that_commands_or_asks_us_has_not_answered(command: str, parameters: list[Value], message: str) -> None:
    profile = PsiuProfile()
    assert profile.read(profile.request(command, parameters), said_by(MNERIM, message)) is None


@given(
    st.one_of(st.integers(-(10**17), 10**17), st.floats(-1e9, 1e9, allow_subnormal=False).map(lambda x: round(x, 6)))
)
def test_a_number_survives_the_wire(value: int | float) -> None:
    back = typed(text(value))
    assert back == value
    assert type(back) is type(value)


@given(st.text(max_size=40))
def test_typing_a_word_never_raises_and_never_makes_infinity(word: str) -> None:
    value = typed(word)
    assert isinstance(value, str) or math.isfinite(value)


@given(st.binary(max_size=60), st.sampled_from(["parafrente", "quantoscomandos", "exibecomando", "qualseunome", "x"]))
def test_reading_never_raises(payload: bytes, command: str) -> None:
    profile = PsiuProfile()
    request = profile.request(command, [1] if command in ("parafrente", "exibecomando") else [])
    profile.read(request, Frame(MNERIM, EVERYONE, command, payload, "psiu-ascii"))

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from psiu_broker.codecs.amarino import Amarino
from psiu_broker.frame import NOBODY, Frame
from psiu_broker.messages import Answer
from psiu_broker.profiles.amarino_persona import COMPLAIN_EVERY_S, AmarinoPersona
from psiu_broker.profiles.persona import Call, Say
from psiu_broker.profiles.profile import Description

MAP = {
    "A": {"command": "parafrente", "scale": 100, "maximum": 300, "minimum": 0},
    "d": {"command": "garra", "scale": 0.5, "offset": -90, "stream": True},
    "f": {"command": "fala", "as_it_is": True},
    "m": {"command": "rodas", "scale": 1.5, "decimals": 2},
    "p": {"command": "pare"},
}


def persona(**options: Any) -> AmarinoPersona:
    read = AmarinoPersona.Options.model_validate({**MAP, **options})
    return AmarinoPersona("MNERIM", Amarino.Options(role="board"), read)


def phone(wire: bytes) -> Frame:
    (frame,) = Amarino(Amarino.Options(role="board")).decode(wire, 0.0)
    assert isinstance(frame, Frame)
    return frame


def heard(wire: bytes, now: float = 0.0) -> list[Say | Call]:
    return list(persona().heard(phone(wire), now))


def texts(said: Any) -> list[bytes]:
    assert all(isinstance(each, Say) and each.subject == "text" for each in said)
    return [each.payload for each in said]


@pytest.mark.parametrize(
    ("wire", "command", "parameters"),
    [
        (b"A2\x13", "parafrente", (200,)),
        (b"A0.5\x13", "parafrente", (50,)),
        (b"A1;2\x13", "parafrente", (100, 200)),
        (b"d45\x13", "garra", (-68,)),
        (b"fola;3;2.5\x13", "fala", ("ola", 3, 2.5)),
        (b"m1;-1\x13", "rodas", (1.5, -1.5)),
        (b"p\x13", "pare", ()),
        (b"p99\x13", "pare", ()),
    ],
)
def test_a_flag_is_a_command_of_the_played_robot(wire: bytes, command: str, parameters: tuple[Any, ...]) -> None:
    (call,) = heard(wire)
    assert isinstance(call, Call)
    assert (call.command, call.parameters, call.newest) == (command, parameters, wire[:1] == b"d")
    assert call.asked == phone(wire)


def test_a_flag_that_nobody_mapped_is_answered_as_a_board_does() -> None:
    assert texts(heard(b"Z1\x13")) == [b"Flag not registered: ", b"90"]
    assert texts(heard(b"~\x13")) == [b"Flag out of bounds: ", b"126"]
    assert heard(b"\x11\x13") == []


@pytest.mark.parametrize(
    ("wire", "text"),
    [
        (b"A4\x13", b"falha;400 is above 300"),
        (b"A-1\x13", b"falha;-100 is below 0"),
        (b"Aalto\x13", b"falha;alto is not a number"),
        (b"A" + b"9" * 18 + b"\x13", b"falha;1e+20 is above 300"),
    ],
)
def test_a_value_out_of_range_moves_nothing(wire: bytes, text: bytes) -> None:
    assert texts(heard(wire)) == [text]


def test_a_phone_that_streams_hears_of_one_trouble_once_in_a_while() -> None:
    played = persona()
    frame = phone(b"A4\x13")
    assert len(played.heard(frame, 0.0)) == 1
    assert played.heard(frame, 1.0) == ()
    assert len(played.heard(frame, 1.0 + COMPLAIN_EVERY_S)) == 1


def test_a_stream_of_other_and_other_wrong_values_is_one_trouble() -> None:
    played = AmarinoPersona(
        "MNERIM", None, AmarinoPersona.Options.model_validate({"A": {"command": "brilho", "scale": 1, "maximum": 10}})
    )
    assert sum(len(played.heard(phone(b"A%d\x13" % value), 0.0)) for value in range(100, 1100)) == 1


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (Answer(status="sucesso", elapsed_ms=1), [b"sucesso"]),
        (Answer(status="falha", values=["tarde"], elapsed_ms=1), [b"falha;tarde"]),
        (Answer(values=[21.456, 3, "a;b\x13"], elapsed_ms=1), [b"21.46;3;a,b,"]),
        (Answer(remark="sent; this robot does not answer", elapsed_ms=1), []),
    ],
)
def test_what_the_robot_answers_goes_back(answer: Answer, text: list[bytes]) -> None:
    assert texts(persona().answered(Call("parafrente", (1,)), answer, "", 0.0)) == text


def test_what_kept_it_from_an_answer_goes_back() -> None:
    played = persona()
    call = Call("parafrente", (1,), asked=phone(b"A1\x13"))
    assert texts(played.answered(call, None, "no answer; is it on?", 0.0)) == [b"falha;no answer, is it on?"]
    streamed = call._replace(newest=True)
    assert texts(played.answered(streamed, None, "no answer", 0.0)) == [b"falha;no answer"]
    assert played.answered(streamed, None, "no answer", 1.0) == ()


def test_what_the_robot_tells_goes_back() -> None:
    posicao = Description(kind="event", command="posicao", parameters=[10, 20, 90])
    sensors = Description(kind="event", command=None, readings={"x": 0.5, "y": -1.0}, parameters=[0.5, -1.0])
    switch = Description(kind="event", command="luz", value=7.0)
    done = Description(kind="response", command="parafrente", parameters=[], status="sucesso")
    error = Description(kind="error", remark="no room")
    told = [posicao, sensors, switch, done, error, Description(kind="ping", command=None)]
    values = [texts(persona().told(each, 0.0)) for each in told]
    assert values == [[b"10;20;90"], [b"0.50;-1.00"], [b"7.00"], [b"sucesso"], [b"falha;no room"], []]
    named = [texts(persona(tell="named").told(each, 0.0)) for each in told[:4]]
    assert named == [[b"posicao;10;20;90"], [b"x;0.50;y;-1.00"], [b"luz;7.00"], [b"parafrente;sucesso"]]
    assert [persona(tell="nothing").told(each, 0.0) for each in told] == [()] * 6


def test_a_persona_without_a_map_knows_no_flag() -> None:
    played = AmarinoPersona("MNERIM", None, None)
    assert texts(played.heard(phone(b"A\x13"), 0.0)) == [b"Flag not registered: ", b"65"]
    assert played.opened(0.0) == ()


@pytest.mark.parametrize(
    "wrong",
    [
        {"/": {"command": "a"}},
        {"AB": {"command": "a"}},
        {"{": {"command": "a"}},
        {"A": {"command": ""}},
        {"A": {"command": "a", "scale": 0}},
        {"A": {"command": "a", "offset": 1}},
        {"A": {"command": "a", "scale": 1, "as_it_is": True}},
        {"A": {"command": "a", "scale": 1, "minimum": 2, "maximum": 1}},
        {"A": {"command": "a", "scale": float("nan")}},
        {"tell": "loudly"},
    ],
)
def test_what_cannot_be_is_refused_in_the_configuration(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        AmarinoPersona.Options.model_validate(wrong)


value = st.one_of(st.integers(), st.floats(), st.text(max_size=1200))


@given(payload=st.binary(min_size=1, max_size=70), now=st.floats(0, 1e6))
def test_whatever_a_phone_sends_is_answered_with_what_can_be_said(payload: bytes, now: float) -> None:
    played, codec = persona(), Amarino(Amarino.Options(role="board"))
    for frame in codec.decode(payload + b"\x13", 0.0):
        if isinstance(frame, Frame):
            for each in played.heard(frame, now):
                assert isinstance(each, Call) or said(codec, each)


@given(values=st.lists(value, max_size=5), error=st.text(), remark=st.text())
def test_whatever_a_robot_says_can_be_said(values: list[Any], error: str, remark: str) -> None:
    played, codec = persona(tell="named"), Amarino(Amarino.Options(role="board"))
    told = Description(kind="error", command=error, parameters=values, remark=remark)
    answer = Answer(values=values, elapsed_ms=1.0)
    call = Call("parafrente")
    for each in (
        *played.answered(call, answer, "", 0.0),
        *played.answered(call, None, error, 0.0),
        *played.told(told, 0.0),
    ):
        assert said(codec, each)


def said(codec: Amarino, say: Say) -> bytes:
    return codec.encode(Frame(NOBODY, NOBODY, say.subject, say.payload, "amarino"))

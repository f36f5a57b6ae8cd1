import pytest
import zenoh
from hypothesis import example, given
from hypothesis import strategies as st

from psiu_broker.bus.keys import KEY_LENGTH_MAX, Keys, chunk, robot, robot_chunk, text
from psiu_broker.frame import EVERYONE, NOBODY, Address

KEYS = Keys()
domains = st.from_regex(r"[A-Za-z0-9_-]{0,8}", fullmatch=True)
robots = st.one_of(
    st.builds(Address.named, st.text(max_size=60)),
    st.builds(Address.numbered, st.integers(0, 255), domains),
    st.builds(Address.named, st.from_regex(r"([a-z]{0,3}\.)?0x[0-9a-fA-F]{1,2}", fullmatch=True)),
)


@given(robots, robots, st.text(max_size=60))
@example(Address.named("@call"), Address.named("*"), "**")
@example(Address.named("a/b"), Address.named("$*#?"), "/")
@example(NOBODY, EVERYONE, "")
@example(Address.named("~"), Address.named("%"), "node/4")
@example(Address.named("."), Address.named(".."), "a/b/c")
def test_any_names_make_a_key_that_zenoh_takes_and_that_reads_back(a: Address, b: Address, subject: str) -> None:
    key = KEYS.decoded(a, b, subject)
    assert str(zenoh.KeyExpr(key)) == key
    assert zenoh.KeyExpr("psiu/**").includes(zenoh.KeyExpr(key))
    assert zenoh.KeyExpr(KEYS.every_frame).includes(zenoh.KeyExpr(key))
    assert KEYS.read_decoded(key) == (a, b, subject)


@given(robots, st.text(max_size=60))
def test_any_call_makes_a_key_that_zenoh_takes_and_that_reads_back(to: Address, command: str) -> None:
    key = KEYS.call(to, command)
    assert zenoh.KeyExpr(KEYS.every_call).includes(zenoh.KeyExpr(key))
    assert not zenoh.KeyExpr("psiu/**").intersects(zenoh.KeyExpr(key))
    assert KEYS.read_call(key) == (to, command)


@given(st.text())
def test_a_chunk_is_plain_ascii_and_never_empty(name: str) -> None:
    made = chunk(name)
    assert made
    assert set(made) <= set("ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789_.-%")
    assert text(made) == name


def test_names_that_programs_meet_most_look_like_themselves() -> None:
    assert KEYS.decoded(Address.named("PC"), Address.named("MNERIM"), "parafrente") == "psiu/PC/MNERIM/parafrente"
    assert KEYS.decoded(Address.numbered(1), Address.numbered(18, "red"), "node/4") == "psiu/0x01/red.0x12/node/4"
    assert KEYS.card(Address.named("MNERIM")) == "psiu/MNERIM"
    assert KEYS.call(Address.named("João"), "liga") == "psiu/@call/Jo%C3%A3o/liga"
    assert KEYS.raw("base", "radio") == "psiu/@raw/base/radio"
    assert KEYS.broker("base", "why", "A", "0x2") == "psiu/@broker/base/why/A/0x02"
    assert KEYS.decoded(Address.named("PC"), EVERYONE, "qualseunome") == "psiu/PC/%3F%3F/qualseunome"


def test_a_robot_named_like_an_address_is_not_that_address() -> None:
    assert robot_chunk(Address.named("0x12")) == "%30x12"
    assert robot_chunk(Address.named("red.0x12")) == "%72ed.0x12"
    assert robot("0x12") == Address.numbered(0x12)
    assert robot("%30x12") == Address.named("0x12")


def test_a_name_written_by_hand_is_understood() -> None:
    assert KEYS.read_call("psiu/@call/João/qual é") == (Address.named("João"), "qual é")


@pytest.mark.parametrize(
    "key",
    ["psiu/@call/*/x", "psiu/@call/A/*", "psiu/@call/**", "psiu/@call/A", "psiu/@call/A/b/c", "other/@call/A/b"],
)
def test_only_one_robot_and_one_command_make_a_call(key: str) -> None:
    with pytest.raises(ValueError, match=r".+"):
        KEYS.read_call(key)


@pytest.mark.parametrize("key", ["psiu/@call/A/b", "psiu/A/b", "psiu/A", "psiu/A/b/c/d/e", "lab/A/b/c"])
def test_only_a_frame_reads_as_a_frame(key: str) -> None:
    with pytest.raises(ValueError, match=r".+"):
        KEYS.read_decoded(key)


def test_a_name_that_is_not_utf_8_is_refused() -> None:
    with pytest.raises(ValueError, match="utf-8"):
        KEYS.read_call("psiu/@call/%ED%A0%80/x")


def test_a_key_that_would_break_the_session_is_refused() -> None:
    with pytest.raises(ValueError, match="longer than"):
        KEYS.call(Address.named("é" * (KEY_LENGTH_MAX // 6)), "x")
    KEYS.decoded(Address.named("é" * 499), Address.named("é" * 499), "é" * 499)


def test_a_prefix_is_plain_chunks() -> None:
    assert Keys("lab/psiu").card(Address.named("A")) == "lab/psiu/A"
    assert Keys("lab/psiu").read_call("lab/psiu/@call/A/b") == (Address.named("A"), "b")
    for wrong in ("", "/psiu", "psiu/", "a//b", "psiu/*", "@psiu", "a b"):
        with pytest.raises(ValueError, match="prefix"):
            Keys(wrong)

"""The policy that a file asks for: its rules in their order, whom it names, and what passes for a command."""

from pathlib import Path
from textwrap import dedent

import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.codecs import psiu_ascii, psiu_hexa
from psiu_broker.config import load
from psiu_broker.config.policies import policy_of
from psiu_broker.errors import ConfigurationError
from psiu_broker.frame import EVERYONE, Address, Frame, Way
from psiu_broker.routing.policy import UNNAMED, Policy

FILE = """
    [broker]
    name = "base"
    [links.radio]
    adapter = "serial"
    device = "/dev/radio"
    protocol = "psiu-ascii"
    [links.wifi]
    adapter = "udp"
    listen = "0.0.0.0:9000"
    protocol = "psiu-ascii"
    [links.lab]
    adapter = "udp"
    listen = "127.0.0.1:9001"
    protocol = "psiu-ascii"
    [links.arm]
    adapter = "serial"
    device = "/dev/arm"
    protocol = "psiu-hexa"
    [links.painel]
    adapter = "udp"
    listen = "0.0.0.0:51974"
    protocol = "mitya"
    plays = "BRACO"
    [robots.BETA]
    link = "wifi"
    [robots.BRACO]
    link = "arm"
    address = 0x12
    sensor_reply = "bit7"
    nodes.garra = { node = 4, type = "servo" }
    nodes.luz = { node = 5, type = "luminosity" }
"""
BASE, PC, BETA, MNERIM, BRACO = (Address.named(name) for name in ("base", "PC", "BETA", "MNERIM", "BRACO"))
ARM, OTHER, OURS = Address.numbered(0x12), Address.numbered(0x13), Address.numbered(0)
RADIO, LAB, FIELD = Way("radio"), Way("lab", ("127.0.0.1", 5)), Way("arm")
STRANGER, FRIEND = Way("wifi", ("192.168.1.66", 9001)), Way("wifi", ("192.168.1.20", 9001))


@pytest.fixture
def read(tmp_path: Path) -> "Read":
    return Read(tmp_path)


class Read:
    def __init__(self, folder: Path) -> None:
        self._file = folder / "broker.toml"

    def __call__(self, more: str = "", options: str = "") -> Policy:
        """`options` are of the link wifi."""
        text = FILE.replace('listen = "0.0.0.0:9000"', f'listen = "0.0.0.0:9000"\n    {options}')
        self._file.write_text(dedent(more) + "\n" + dedent(text))
        return policy_of(load(self._file), lambda way: way != STRANGER)


def order(source: Address, destination: Address = MNERIM, *words: str) -> Frame:
    return psiu_ascii.message(source, destination, *(words or ("parafrente", "100")))


def test_by_default_only_strangers_beyond_this_computer_are_kept_from_commanding(read: Read) -> None:
    policy = read()
    assert policy.denial(order(PC), STRANGER) is UNNAMED
    for way in (FRIEND, RADIO, LAB, Way("@mesh", "north")):
        assert policy.denial(order(PC), way) is None
    assert policy.denial(order(BETA), STRANGER) is None, "the configuration names it, and puts it there"
    for words in (("qualseunome",), ("parafrente", "sucesso"), ("quantoscomandos", "7"), ("exibecomando", "1")):
        assert policy.denial(order(PC, MNERIM, *words), STRANGER) is None


@pytest.mark.parametrize("everyone", [EVERYONE, MNERIM])
def test_a_stranger_asks_everyone_for_a_name_and_moves_nobody(read: Read, everyone: Address) -> None:
    policy = read()
    assert policy.denial(order(PC, everyone, "qualseunome"), STRANGER) is None
    assert policy.denial(order(PC, everyone, "pare"), STRANGER) is UNNAMED


def test_loopback_alone_and_cables_need_no_policy(tmp_path: Path) -> None:
    file = tmp_path / "broker.toml"
    file.write_text(dedent(FILE).replace("0.0.0.0", "127.0.0.1"))
    assert policy_of(load(file), lambda _: False).idle


def test_rules_go_before_the_lists_of_a_link_and_these_before_the_default(read: Read) -> None:
    policy = read(
        """
        [[policy]]
        action = "allow"
        source = "CHEFE"
        [[policy]]
        action = "deny"
        destination = ["MNERIM", "B*"]
        command = "paratras"
        """,
        'allow = ["PC", "R*"]\n    deny = ["RUIM", "CHEFE"]',
    )
    chief, bad = Address.named("CHEFE"), Address.named("RUIM")
    assert policy.denial(order(chief, MNERIM, "paratras", "1"), STRANGER) is None
    assert str(policy.denial(order(PC, MNERIM, "paratras", "1"), RADIO)) == (
        "policy[1] denies destination MNERIM or B*, command paratras"
    )
    assert policy.denial(order(PC), STRANGER) is None, "the link's list lets it in"
    assert policy.denial(order(Address.named("R2")), STRANGER) is None
    assert str(policy.denial(order(bad), STRANGER)) == "links.wifi.deny denies source RUIM or CHEFE, link wifi"
    assert str(policy.denial(order(BETA), FRIEND)) == "links.wifi.allow denies link wifi"
    assert policy.denial(order(bad), RADIO) is None


def test_an_empty_list_lets_nobody_command(read: Read) -> None:
    policy = read(options="allow = []")
    assert policy.denial(order(BETA), FRIEND) is not None
    assert policy.denial(order(BETA, MNERIM, "parafrente", "sucesso"), FRIEND) is None


def packet(payload: bytes, source: Address = OTHER, destination: Address = ARM) -> Frame:
    return psiu_hexa.packet(source, destination, payload)


@pytest.mark.parametrize(
    ("payload", "judged"),
    [
        (b"", False),
        (b"A", False),
        (b"N", False),
        (b"?", False),
        (b"F", False),
        (b"\x01", True),
        (b"\x00\x10", False),
        (b"\x04\x10", True),
        (b"\x05\x00", False),
        (b"\x06\x00", True),
        (b"\x84\x10", True),
        (b"\x01\x01\xff", True),
    ],
)
def test_of_bytes_what_moves_nobody_is_no_command(read: Read, payload: bytes, judged: bool) -> None:
    policy = read('[[policy]]\naction = "deny"')
    assert (policy.denial(packet(payload), FIELD) is not None) is judged


def test_a_sensor_that_marks_its_answers_with_a_bit_answers(read: Read) -> None:
    policy = read('[[policy]]\naction = "deny"')
    assert policy.denial(packet(b"\x85\x10", ARM, OTHER), FIELD) is None
    assert policy.denial(packet(b"\x85\x10", OTHER, Address.numbered(0x14)), FIELD) is not None


def test_a_node_is_known_by_its_name_and_by_its_number(read: Read) -> None:
    for name in ("garra", "node/4", "GAR*"):
        policy = read(f'[[policy]]\naction = "deny"\ncommand = "{name}"')
        assert policy.denial(packet(b"\x04\x10"), FIELD) is not None
        assert policy.denial(packet(b"\x06\x10"), FIELD) is None


def test_what_is_said_to_the_broker_passes_by_its_name_and_by_its_number(read: Read) -> None:
    policy = read('[[policy]]\naction = "deny"')
    assert policy.denial(order(PC, BASE), STRANGER) is None
    assert policy.denial(packet(b"\x04\x10", ARM, OURS), FIELD) is None


def test_all_that_a_program_sends_on_a_link_that_plays_a_robot_is_a_command(read: Read) -> None:
    policy = read('[[policy]]\naction = "deny"')
    drive = Frame(Address.named("painel"), BRACO, "drive", b"D0064", "mitya")
    assert policy.denial(drive, Way("painel", ("127.0.0.1", 7))) is not None
    assert policy.denial(drive, Way("corpo")) is None, "a body only tells"


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ('policy = "deny"', 'policy: expected rules, got "deny"; write [[policy]] above each'),
        ("[policy]", "policy: expected rules, got a table; write [[policy]] above each"),
        ("[[policy]]", "policy[0].action: missing"),
        ('[[policy]]\naction = "forbid"', "policy[0].action: expected"),
        ('[[policy]]\naction = "deny"\nfrom = "PC"', "policy[0].from: unknown key"),
        ('[[policy]]\naction = "deny"\nsource = []', "policy[0].source: expected at least one name, got none"),
        ('[[policy]]\naction = "deny"\nsource = ""', "policy[0].source: expected a name"),
        ('[[policy]]\naction = "deny"\nlink = "wify"', 'policy[0].link: there is no link "wify"; did you mean wifi?'),
        ('[[policy]]\naction = "deny"\ndestination = "base"', "policy[0].destination: base is this broker"),
    ],
)
def test_a_wrong_rule_is_refused_in_words(tmp_path: Path, text: str, problem: str) -> None:
    file = tmp_path / "broker.toml"
    file.write_text(text + "\n" + dedent(FILE))
    with pytest.raises(ConfigurationError) as refused:
        load(file)
    [line] = refused.value.problems
    assert f": {problem}" in line


@pytest.mark.parametrize("link", ["@self", "@mesh", "w*", "radio"])
def test_a_rule_may_be_for_programs_for_brokers_and_for_links(read: Read, link: str) -> None:
    assert not read(f'[[policy]]\naction = "deny"\nlink = "{link}"').idle


ADDRESSES = st.builds(Address, st.text(max_size=8), st.integers(-1, 255), st.text(max_size=4))
PROTOCOLS = st.sampled_from(["psiu-ascii", "psiu-hexa", "mitya", "soccer", ""])


@given(frame=st.builds(Frame, ADDRESSES, ADDRESSES, st.text(max_size=8), st.binary(max_size=24), PROTOCOLS))
def test_no_frame_makes_it_raise(tmp_path_factory: pytest.TempPathFactory, frame: Frame) -> None:
    global _deny_all  # noqa: PLW0603
    if _deny_all is None:
        _deny_all = Read(tmp_path_factory.mktemp("policy"))('[[policy]]\naction = "deny"\ncommand = "x*"')
    _deny_all.denial(frame, STRANGER)
    _deny_all.about(frame.source, frame.destination, STRANGER)


_deny_all: Policy | None = None

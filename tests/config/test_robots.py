"""What may be in [robots.NAME], and what is said of the rest."""

import pytest
from config.texts import ARM, BROKER, CAMPO, CORPO, HEXA, PHONES, RADIO, WIFI

from psiu_broker.frame import Address


def test_a_robot_s_address_is_in_the_domain_of_its_link(read):
    robot = read(BROKER + HEXA + 'domain = "red"\n[robots.UM]\nlink = "hexa"\naddress = 3\n').robots["UM"]
    assert robot.address == Address.numbered(3, "red")


def test_a_udp_robot_s_peer_is_what_the_adapter_calls_it(read):
    for peer, address in (("127.0.0.1:9001", ("127.0.0.1", 9001)), ("[::1]:9001", ("::1", 9001))):
        wifi = WIFI.replace("127.0.0.1:9000", peer.replace("9001", "9000"))
        text = f'{BROKER}{wifi}peers = ["{peer}"]\n[robots.MNERIM]\nlink = "wifi"\npeer = "{peer}"\n'
        assert read(text).robots["MNERIM"].peer == address


def test_a_phone_s_peer_is_its_address_in_upper_case(read):
    text = BROKER + PHONES + '[robots.A]\nlink = "phones"\npeer = "98:d3:31:00:00:0a"\n'
    assert read(text).robots["A"].peer == "98:D3:31:00:00:0A"


def test_a_robot_s_name_may_have_spaces(read):
    assert "MEU ROBO" in read(BROKER + RADIO + '[robots."MEU ROBO"]\nlink = "radio"').robots


def test_a_robot_s_name_is_not_an_address(problems):
    (line,) = problems(BROKER + HEXA + '[robots.0x12]\nlink = "hexa"\naddress = 0x12')
    assert line.startswith('robots.0x12: expected a name, got "0x12", which reads as a PSIU HEXA address')


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        pytest.param(
            BROKER + HEXA + '[robots.A]\nlink="hexa"\naddress=1\nnodes.g={node=1,type="dc",sgned=true}',
            "robots.A.nodes.g.sgned: unknown key; did you mean signed?",
            id="node",
        ),
    ],
)
def test_an_unknown_key_is_refused_with_the_one_that_was_meant(problems, text, expected):
    (line,) = problems(text)
    assert line.startswith(expected)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            HEXA + '[robots.A]\nlink="hexa"\naddress=256',
            "robots.A.address: expected a number less than or equal to 255",
        ),
        (
            HEXA + '[robots.A]\nlink="hexa"\naddress="0x12"',
            'robots.A.address: expected a whole number, got "0x12"; write it without quotes: 0x12',
        ),
    ],
)
def test_a_wrong_value_is_refused_with_what_was_expected_and_what_was_got(problems, text, expected):
    (line,) = problems(BROKER + text)
    assert line.startswith(expected)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        pytest.param(
            ARM + 'remote=2\n[robots.A]\nlink="arm"\naddress=1',
            "robots.A.address: expected 2, the remote of link arm, got 1",
            id="point-to-point with two addresses",
        ),
        pytest.param(
            HEXA + '[robots.A]\nlink="hexa"\naddress=1\n[robots.B]\nlink="hexa"\naddress=1',
            "robots.B.address: 0x01 is the address of A already",
            id="one address twice",
        ),
        pytest.param(
            HEXA + '[robots.A]\nlink="hexa"\naddress=0',
            "robots.A.address: 0x00 is the address of the broker itself already",
            id="the broker's address",
        ),
        pytest.param(
            RADIO + '[robots.base]\nlink="radio"', "robots.base: this is the broker's own name", id="our name"
        ),
        pytest.param(
            RADIO + '[robots.A]\nlink="radoi"',
            'robots.A.link: there is no link "radoi"; did you mean radio?',
            id="no such link",
        ),
        pytest.param(
            RADIO + '[robots.A]\nlink="radio"\nnodes.g={node=1,type="dc"}',
            "robots.A.nodes: is for psiu-hexa, and link radio speaks psiu-ascii; remove it",
            id="nodes in PSIU ASCII",
        ),
        pytest.param(
            RADIO + '[robots.A]\nlink="radio"\naddress=1',
            "robots.A.address: is for psiu-hexa and soccer, and link radio speaks psiu-ascii; remove it",
            id="an address in PSIU ASCII",
        ),
        pytest.param(
            HEXA + '[robots.A]\nlink="hexa"',
            "robots.A.address: missing; link hexa speaks psiu-hexa",
            id="no address in PSIU HEXA",
        ),
        pytest.param(
            HEXA + '[robots.A]\nlink="hexa"\naddress=1\nnodes.a={node=1,type="dc"}\nnodes.b={node=1,type="dc"}',
            "robots.A.nodes.b.node: node 1 is a already; give it one name",
            id="one node twice",
        ),
        pytest.param(
            HEXA + '[robots.A]\nlink="hexa"\naddress=1\nnodes.ping={node=1,type="dc"}',
            "robots.A.nodes.ping: expected one word, none of",
            id="a node called ping",
        ),
        pytest.param(
            WIFI + '[robots.A]\nlink="wifi"\npeer="127.0.0.1"',
            'robots.A.peer: expected "ADDRESS:PORT", got "127.0.0.1"',
            id="a peer without a port",
        ),
        pytest.param(
            WIFI + '[robots.A]\nlink="wifi"\npeer="127.0.0.1:9001"',
            "robots.A.peer: 127.0.0.1:9001 is not among the peers of its link; add it there",
            id="a peer that the link does not have",
        ),
        pytest.param(
            CORPO + '[robots.A]\nlink="corpo"\n[robots.B]\nlink="corpo"',
            "robots.B.link: A is there already, and mitya names no robot; give B a link of its own",
            id="two robots where packets name nobody",
        ),
        pytest.param(
            CORPO + 'plays = "A"\n[robots.A]\nlink="corpo"',
            "robots.A.link: programs are at the far end of corpo, which plays A; choose another link",
            id="a robot where a program is",
        ),
        pytest.param(
            CAMPO + '[robots.A]\nlink="campo"\naddress=4',
            "robots.A.address: got 4; link campo speaks soccer, whose robots are numbers 1–3",
            id="a robot that no packet has",
        ),
        pytest.param(
            CAMPO + '[robots.A]\nlink="campo"\naddress=1\nstop="0x03"',
            "robots.A: stop",
            id="a stop that does not fit the packet",
        ),
        pytest.param(
            RADIO + '[robots.A]\nlink="radio"\npeer="anything"',
            "robots.A.peer: is for links with several far ends, and this one has a single one; remove it",
            id="a peer on a serial link",
        ),
        pytest.param(
            PHONES.replace("accept = true", 'address = "98:D3:31:00:00:01"')
            + '[robots.A]\nlink="phones"\npeer="98:D3:31:00:00:01"',
            "robots.A.peer: is for links with several far ends, and this one has a single one; remove it",
            id="a peer on a link that calls one robot",
        ),
        pytest.param(
            PHONES + '[robots.A]\nlink="phones"\npeer="my phone"',
            "robots.A.peer: not a Bluetooth address",
            id="a phone without an address",
        ),
        pytest.param(
            ARM + '[robots.A]\nlink="arm"\naddress=0',
            "robots.A.address: 0x00 is the address of the broker itself already",
            id="a far end with our address",
        ),
        pytest.param(
            HEXA
            + "local = 5\n"
            + HEXA.replace("hexa", "more").replace("psiu-more", "psiu-hexa")
            + '[robots.A]\nlink="more"\naddress=5',
            "robots.A.address: 0x05 is the address of the broker itself already",
            id="our address on another link of the domain",
        ),
    ],
)
def test_what_cannot_work_together_is_refused(problems, text, expected):
    (line,) = problems(BROKER + text)
    assert line.startswith(expected)


LEFT_ALONE = """
    [robots.MNERIM]
    link = "radio"
    repeatable = ["buzina"]
    failsafe = { command = "pare", on = ["program_gone", "link_silent"], silent_s = 2 }
"""


def test_a_robot_may_say_what_stops_it_and_what_may_be_told_again(read):
    robot = read(BROKER + RADIO + LEFT_ALONE).robots["MNERIM"]
    assert robot.repeatable == {"buzina"}
    assert robot.failsafe.on == ("program_gone", "link_silent")
    assert (robot.failsafe.command, robot.failsafe.parameters, robot.failsafe.silent_s) == ("pare", (), 2)
    assert read(BROKER + RADIO + '[robots.MNERIM]\nlink = "radio"').robots["MNERIM"].failsafe is None


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (RADIO + LEFT_ALONE.replace('"pare"', '"qualseunome"'), "robots.MNERIM.failsafe.command: "),
        (RADIO + LEFT_ALONE.replace('"pare"', '"parafrente"'), "robots.MNERIM.failsafe: parafrente takes"),
        (RADIO + LEFT_ALONE.replace('"program_gone", "link_silent"', ""), "robots.MNERIM.failsafe.on: expected at"),
        (RADIO + LEFT_ALONE.replace('"link_silent"', '"gone"'), "robots.MNERIM.failsafe.on"),
        (HEXA + LEFT_ALONE.replace("radio", "hexa").replace("failsafe", "address = 3\n    failsafe"), "robots.MNERIM."),
        (HEXA + "proxy_errors = true", "links.hexa.proxy_errors: is for psiu-ascii"),
    ],
)
def test_a_stop_that_stops_nothing_is_refused(problems, text, expected):
    assert any(line.startswith(expected) for line in problems(BROKER + text)), problems(BROKER + text)

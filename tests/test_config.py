import json
import tomllib
from pathlib import Path
from textwrap import dedent

import jsonschema
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from psiu_broker.config import Configuration, json_schema, load, reading
from psiu_broker.errors import ConfigurationError
from psiu_broker.frame import Address
from psiu_broker.registry import UnknownAdapter

EXAMPLE = Path(__file__).parents[1] / "deploy/examples/psiu-broker.toml"

AS_IN_THE_README = """
    [broker]
    name = "base"
    [zenoh]
    listen = ["tcp/127.0.0.1:7447"]
    [links.radio]
    adapter = "serial"
    device = "/dev/serial/by-id/usb-FTDI_FT232R-if00-port0"
    baudrate = 9600
    protocol = "psiu-ascii"
    [links.wifi]
    adapter = "udp"
    listen = "127.0.0.1:9000"
    peers = ["127.0.0.1:9001"]
    protocol = "psiu-ascii"
    [links.arm]
    adapter = "rfcomm"
    address = "98:D3:31:00:00:01"
    protocol = "psiu-hexa"
    topology = "point-to-point"
    [robots.BRACO]
    address = 0x12
    link = "arm"
    nodes.garra = { node = 4, type = "servo" }
"""

BROKER = """
    [broker]
    name = "base"
"""
RADIO = """
    [links.radio]
    adapter = "serial"
    device = "/dev/serial/by-id/radio"
    protocol = "psiu-ascii"
"""
HEXA = """
    [links.hexa]
    adapter = "serial"
    device = "/dev/serial/by-id/hexa"
    protocol = "psiu-hexa"
"""
CORPO = """
    [links.corpo]
    adapter = "serial"
    device = "/dev/serial/by-id/corpo"
    protocol = "mitya"
"""
CAMPO = """
    [links.campo]
    adapter = "serial"
    device = "/dev/serial/by-id/campo"
    baudrate = 19200
    protocol = "soccer"
"""
ARM = HEXA.replace("links.hexa", "links.arm").replace("by-id/hexa", "by-id/arm") + 'topology = "point-to-point"\n'
WIFI = """
    [links.wifi]
    adapter = "udp"
    listen = "127.0.0.1:9000"
    protocol = "psiu-ascii"
"""
PHONES = """
    [links.phones]
    adapter = "rfcomm"
    accept = true
    protocol = "psiu-ascii"
"""
HILL = """
    [trunks.hill]
    adapter = "rfcomm"
    address = "98:D3:31:00:00:01"
"""
VALLEY = """
    [trunks.valley]
    adapter = "serial"
    device = "socket://127.0.0.1:4000"
"""
ROBOT_WIFI = WIFI.replace("psiu-ascii", "psiu-hexa") + 'topology = "point-to-point"\nremote = 3\n'


@pytest.fixture
def read(tmp_path, monkeypatch):
    """Loads text as radio.toml, which lies in the current folder."""
    monkeypatch.chdir(tmp_path)

    def read(text: str) -> Configuration:
        Path("radio.toml").write_text(dedent(text), encoding="utf-8")
        return load(Path("radio.toml"))

    return read


@pytest.fixture
def problems(read):
    """What is said about text, a line each, without the file's name that begins every line."""

    def problems(text: str) -> list[str]:
        with pytest.raises(ConfigurationError) as caught:
            read(text)
        assert all(line.startswith("radio.toml:") for line in caught.value.problems)
        return [line.removeprefix("radio.toml: ") for line in caught.value.problems]

    return problems


def test_the_configuration_of_the_readme_loads_as_written(read):
    configuration = read(AS_IN_THE_README)
    assert configuration.broker.name == "base"
    assert configuration.broker.address == 0
    assert configuration.zenoh.listen == ("tcp/127.0.0.1:7447",)
    assert configuration.zenoh.prefix == "psiu"
    assert configuration.warnings == ()
    radio, wifi, arm = configuration.links.values()
    assert (radio.name, radio.adapter_name, radio.protocol) == ("radio", "serial", "psiu-ascii")
    assert radio.adapter.model_dump()["baudrate"] == 9600
    assert wifi.adapter.model_dump()["peers"] == ("127.0.0.1:9001",)
    assert arm.adapter.model_dump()["address"] == "98:D3:31:00:00:01"
    assert (arm.options.queue_frames, arm.options.max_age_s, arm.options.nak) == (64, 2.0, None)
    robot = configuration.robots["BRACO"]
    assert (robot.name, robot.link, robot.protocol) == ("BRACO", "arm", "psiu-hexa")
    assert robot.address == Address.numbered(0x12)
    assert (robot.options.nodes["garra"].node, robot.options.nodes["garra"].type) == (4, "servo")


def test_a_point_to_point_link_takes_its_ends_from_its_robot_and_the_broker(read):
    codec = read(AS_IN_THE_README.replace('name = "base"', 'name = "base"\naddress = 7')).links["arm"].codec
    assert codec.model_dump()["remote"] == 0x12
    assert codec.model_dump()["local"] == 7


def test_the_keys_of_a_link_are_split_among_adapter_codec_and_link(read):
    link = read(BROKER + HEXA + 'baudrate = 115200\ncrc = "xor"\ndomain = "red"\nmax_age_s = 1\nlocal = 9\n').links[
        "hexa"
    ]
    assert link.adapter.model_dump()["baudrate"] == 115200
    assert link.codec.model_dump() | {"crc": "xor", "domain": "red", "local": 9} == link.codec.model_dump()
    assert link.options.max_age_s == 1.0


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


def test_a_broker_without_links_is_allowed(read):
    assert read(BROKER).links == {}


def test_a_trunk_is_an_adapter_and_its_options(read):
    hill, valley = read(BROKER + HILL + VALLEY).trunks.values()
    assert (hill.name, hill.adapter_name, valley.name, valley.adapter_name) == ("hill", "rfcomm", "valley", "serial")
    assert hill.adapter.model_dump()["address"] == "98:D3:31:00:00:01"
    assert read(BROKER).trunks == {}


def test_a_raw_serial_line_is_no_trunk_and_the_author_learns_why_and_what_to_do(problems):
    (line,) = problems(BROKER + VALLEY.replace("socket://127.0.0.1:4000", "/dev/ttyUSB0"))
    assert line == (
        'trunks.valley.device: expected a stream that loses nothing, got "/dev/ttyUSB0":'
        " a raw serial line loses and corrupts bytes unnoticed;"
        ' use adapter = "rfcomm" or device = "socket://HOST:PORT",'
        " or write [links.valley] with a protocol, and PSIU relays"
    )


def test_a_configuration_cannot_be_changed(read):
    configuration = read(AS_IN_THE_README)
    for thing, field in [
        (configuration, "broker"),
        (configuration.broker, "name"),
        (configuration.links["radio"], "name"),
        (configuration.links["radio"].options, "retries"),
        (configuration.robots["BRACO"], "link"),
    ]:
        with pytest.raises((AttributeError, ValueError)):
            setattr(thing, field, "other")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        pytest.param(
            BROKER + RADIO + "baudrat = 9600", "links.radio.baudrat: unknown key; did you mean baudrate?", id="link"
        ),
        pytest.param(
            BROKER + RADIO + "strct = true", "links.radio.strct: unknown key; did you mean strict?", id="codec"
        ),
        pytest.param(
            BROKER + RADIO + "retrys = 1", "links.radio.retrys: unknown key; did you mean retries?", id="option"
        ),
        pytest.param(BROKER + "nme = 1", "broker.nme: unknown key; did you mean name?", id="broker"),
        pytest.param(BROKER + "[link.a]", "link: unknown key; did you mean links?", id="table"),
        pytest.param(
            BROKER + HEXA + '[robots.A]\nlink="hexa"\naddress=1\nnodes.g={node=1,type="dc",sgned=true}',
            "robots.A.nodes.g.sgned: unknown key; did you mean signed?",
            id="node",
        ),
        pytest.param(BROKER + "[zenoh]\nxyz = 1", "zenoh.xyz: unknown key; known: access, listen,", id="nothing near"),
        pytest.param(
            BROKER + RADIO + "topology = 1", "links.radio.topology: unknown key; known: adapter,", id="other protocol"
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
            RADIO + 'baudrate = "9600"',
            'links.radio.baudrate: expected a whole number, got "9600"; write it without quotes: 9600',
        ),
        (RADIO + "baudrate = 9600.0", "links.radio.baudrate: expected a whole number, got 9600.0"),
        (RADIO + "baudrate = true", "links.radio.baudrate: expected a whole number, got true"),
        (
            RADIO + "strict = 'true'",
            'links.radio.strict: expected true or false, got "true"; write it without quotes: true',
        ),
        (RADIO + "version = 1", "links.radio.version: expected '1', '0.5' or '0', got 1; write it in quotes: \"1\""),
        (RADIO + "nak = 1", "links.radio.nak: expected true or false, got 1"),
        (RADIO + "max_age_s = 0", "links.radio.max_age_s: expected a number greater than 0, got 0"),
        (RADIO + "max_age_s = inf", "links.radio.max_age_s: expected a finite number, got inf"),
        (RADIO + "question_max_age_s = 0", "links.radio.question_max_age_s: expected a number greater than 0, got 0"),
        (RADIO + "max_frames_s = 0", "links.radio.max_frames_s: expected a number greater than 0, got 0"),
        (RADIO + 'max_bytes_s = "960"', 'links.radio.max_bytes_s: expected a number, got "960"; write it without'),
        (RADIO + 'newest_wins = "node/4"', 'links.radio.newest_wins: expected a list, got "node/4"; write it in'),
        (RADIO + 'newest_wins = ["a b"]', "links.radio.newest_wins[0]: expected one word, * for any letters, got"),
        (RADIO + "limits.parafrente = 5", "links.radio.limits.parafrente: expected a table, got 5"),
        (RADIO + "limits.parafrente = {}", "links.radio.limits.parafrente: expected frames_s or bytes_s, got neither"),
        (
            RADIO + 'limits."node/*" = {frame_s = 5}',
            'links.radio.limits."node/*".frame_s: unknown key; did you mean frames_s?',
        ),
        (RADIO + 'limits."a b" = {frames_s = 5}', 'links.radio.limits."a b": expected one word, * for any letters'),
        (CAMPO + "max_frames_s = 5", "links.campo.max_frames_s: soccer sends packets at rate_hz, each with the newest"),
        (RADIO + "timeout_s = nan", "links.radio.timeout_s: expected a finite number, got nan"),
        (
            RADIO + 'parity = "evne"',
            "links.radio.parity: expected 'none', 'even', 'odd', 'mark' or 'space', got \"evne\"; did you mean even?",
        ),
        (
            RADIO.replace('"/dev/serial/by-id/radio"', "1979-05-27"),
            'links.radio.device: expected text, got 1979-05-27; write it in quotes: "1979-05-27"',
        ),
        (
            WIFI + 'peers = "127.0.0.1:1"',
            'links.wifi.peers: expected a list, got "127.0.0.1:1"; write it in brackets: ["127.0.0.1:1"]',
        ),
        (WIFI + "peers = [9001]", 'links.wifi.peers[0]: expected text, got 9001; write it in quotes: "9001"'),
        ('[links.radio]\nadapter="serial"\nprotocol="psiu-ascii"', "links.radio.device: missing; write device = … ("),
        (
            RADIO.replace('"serial"', '"seral"'),
            'links.radio.adapter: expected one of pty, rfcomm, serial, udp, got "seral"; did you mean serial?',
        ),
        (
            RADIO.replace('adapter = "serial"', ""),
            "links.radio.adapter: missing; write adapter = … with one of pty, rfcomm, serial, udp",
        ),
        (
            RADIO.replace('"psiu-ascii"', '"psiu-asci"'),
            "links.radio.protocol: expected one of amarino, firmata, mitya, psiu-ascii, psiu-hexa, soccer, got",
        ),
        ("[links]\nradio = 3", "links.radio: expected a table, got 3; write [links.radio] above its keys"),
        (
            '[zenoh]\nlisten = ["10.0.0.1:7447"]',
            "zenoh.listen[0]: expected tcp/HOST:PORT (or tls/, udp/, ws/, unixsock-stream/PATH),"
            ' got "10.0.0.1:7447"; write it like tcp/127.0.0.1:7447',
        ),
        ('[zenoh]\nlisten = ["serial/dev/ttyUSB0:1"]', "zenoh.listen[0]: expected tcp/HOST:PORT"),
        ('[zenoh]\nlisten = ["tcp/[::1]:99999"]', "zenoh.listen[0]: expected tcp/HOST:PORT"),
        (
            '[zenoh]\nlisten = ["tcp/127.0.0.1:0"]',
            'zenoh.listen[0]: got "tcp/127.0.0.1:0": port 0 is another one at each start; name one',
        ),
        ("[zenoh]\nlisten = []", "zenoh.listen: expected at least one place, got none; leave listen out"),
        (
            '[zenoh]\nlisten = ["tcp/127.0.0.1:1", "tcp/127.0.0.1:2", "tcp/127.0.0.1:1"]',
            'zenoh.listen: "tcp/127.0.0.1:1" is there twice; remove one',
        ),
        (WIFI.replace("127.0.0.1", "a..b"), "links.wifi.listen: got 'a..b:9000': no host can be called 'a..b'"),
        (WIFI + f'peers = ["{"a" * 64}.lan:9001"]', "links.wifi.peers: got 'aaaaaaaaaaaaaaaaaaaa"),
        (WIFI + "peer_ttl_s = 0.9", "links.wifi.peer_ttl_s: expected a number greater than or equal to 1, got 0.9"),
        ('[zenoh]\nprefix = "psiu/**"', "zenoh.prefix: expected words of"),
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


@pytest.mark.parametrize("name", ["", "a??b", "0x12", "red.0x03", "José", " base", "a\\nb"])
def test_the_broker_s_name_is_one_that_a_robot_can_have(problems, name):
    (line,) = problems(f'[broker]\nname = "{name}"')
    assert line.startswith("broker.name: expected a name")


def test_the_broker_s_name_is_one_that_robots_cannot_misread(problems):
    (line,) = problems('[broker]\nname = "my base"')
    expected = 'broker.name: expected a name without spaces, got "my base": a robot that has not met it misreads it'
    assert line.startswith(expected)


def test_a_robot_s_name_may_have_spaces(read):
    assert "MEU ROBO" in read(BROKER + RADIO + '[robots."MEU ROBO"]\nlink = "radio"').robots


def test_a_robot_s_name_is_not_an_address(problems):
    (line,) = problems(BROKER + HEXA + '[robots.0x12]\nlink = "hexa"\naddress = 0x12')
    assert line.startswith('robots.0x12: expected a name, got "0x12", which reads as a PSIU HEXA address')


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        pytest.param(
            ARM,
            "links.arm.topology: point-to-point packets name no robot; add [robots.NAME] with address and link",
            id="point-to-point without a robot",
        ),
        pytest.param(
            ARM + '[robots.A]\nlink="arm"\naddress=1\n[robots.B]\nlink="arm"\naddress=1',
            "links.arm.topology: one robot is at the far end of a point-to-point link, got A, B; keep one",
            id="point-to-point with two robots",
        ),
        pytest.param(
            ARM + 'remote=2\n[robots.A]\nlink="arm"\naddress=1',
            "robots.A.address: expected 2, the remote of link arm, got 1",
            id="point-to-point with two addresses",
        ),
        pytest.param(HEXA + "remote = 2", "links.hexa.remote: is for topology", id="remote without point-to-point"),
        pytest.param(
            RADIO + RADIO.replace("links.radio", "links.other"),
            'links.other.device: "/dev/serial/by-id/radio" is taken by link radio already',
            id="two links on one device",
        ),
        pytest.param(
            WIFI + WIFI.replace("links.wifi", "links.lan").replace("127.0.0.1", "0.0.0.0"),
            'links.lan.listen: "0.0.0.0:9000" is taken by link wifi already',
            id="a UDP port twice",
        ),
        pytest.param(
            VALLEY.replace("socket://127.0.0.1:4000", "0403:6001"),
            'trunks.valley.device: expected a stream that loses nothing, got "0403:6001"',
            id="a trunk on a raw serial line",
        ),
        pytest.param(
            '[trunks.wifi]\nadapter = "udp"\nlisten = "127.0.0.1:9000"',
            'trunks.wifi.adapter: expected a stream that loses nothing, got "udp", whose datagrams may be lost;',
            id="a trunk of datagrams",
        ),
        pytest.param(
            VALLEY.replace("trunks", "links") + 'protocol = "psiu-ascii"' + VALLEY,
            'trunks.valley.device: "socket://127.0.0.1:4000" is taken by link valley already; give each its own',
            id="a trunk on the device of a link",
        ),
        pytest.param(
            PHONES + HILL.replace('address = "98:D3:31:00:00:01"', "accept = true"),
            "trunks.hill.accept: link phones takes all who call hci0 already; keep one of them",
            id="a trunk and a link that accept",
        ),
        pytest.param(
            HILL + HILL.replace("hill", "dale"),
            'trunks.dale.address: "98:D3:31:00:00:01" is taken by trunk hill already; give each its own',
            id="two trunks to one broker",
        ),
        pytest.param(
            HILL.replace("trunks.hill", 'trunks."the hill"'),
            'trunks."the hill": expected a name of letters, digits, - and _; rename the trunk',
            id="a trunk with a space in its name",
        ),
        pytest.param(HILL + 'protocol = "psiu-ascii"', "trunks.hill.protocol: unknown key; known: ", id="a protocol"),
        pytest.param("[trunks]\nhill = 3", "trunks.hill: expected a table, got 3", id="a trunk that is no table"),
        pytest.param(
            HILL.replace("rfcomm", "rfcom"),
            'trunks.hill.adapter: expected one of pty, rfcomm, serial, udp, got "rfcom"; did you mean rfcomm?',
            id="an unknown adapter of a trunk",
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
            CORPO + 'plays = "MNERIM"\n' + RADIO + '[robots.MNERIMM]\nlink="radio"',
            'links.corpo.plays: there is no robot "MNERIM" in this file; did you mean MNERIMM?',
            id="a robot that is not there is played",
        ),
        pytest.param(
            CORPO.replace("corpo", "base"),
            "links.base: who is there is known by the name of the link, which is the broker's own name;",
            id="a robot named after its link as the broker is",
        ),
        pytest.param(
            CORPO.replace("corpo", "A") + 'plays = "A"\n' + RADIO + '[robots.A]\nlink="radio"',
            "links.A: who is there is known by the name of the link, which is the name of a robot;",
            id="a program named after its link as a robot is",
        ),
        pytest.param(
            CORPO.replace("corpo", "0x12"),
            "links.0x12: who is there is known by the name of the link, which is a PSIU HEXA address;",
            id="a robot named after its link like a number",
        ),
        pytest.param(
            RADIO + 'plays = "A"\n[robots.A]\nlink="radio"',
            "links.radio.plays: is not for psiu-ascii, whose programs name the robots themselves; remove it",
            id="a robot is played where all of them are found by name",
        ),
        pytest.param(
            CORPO + 'map.Q = { command = "parafrente" }\nplays = "A"\n' + RADIO + '[robots.A]\nlink="radio"',
            "links.corpo.map: Q is no letter of a Robot Mitya",
            id="a map of letters that there are not",
        ),
        pytest.param(
            CORPO.replace("mitya", "firmata") + 'role = "host"\nplays = "A"\n' + RADIO + '[robots.A]\nlink="radio"',
            'links.corpo.role: programs find a board there, got "host"; remove it',
            id="a program is told of a robot by another program",
        ),
        pytest.param(
            WIFI + 'peers = ["127.0.0.1:9000"]',
            "links.wifi.peers[0]: link wifi of this broker listens there, and would hear itself; give where the robot",
            id="a broker that is its own peer",
        ),
        pytest.param(
            CAMPO + "rate_hz = 300",
            "links.campo.rate_hz: 300 packets/s × 8 bytes × 10 bits = 24000 bit/s, the line carries 19200;",
            id="a rate that the line cannot carry",
        ),
        pytest.param(
            CAMPO.replace("19200", "9600"),
            "links.campo.baudrate: the robots of mirosot listen at 19200; write baudrate = 19200, or baud = 9600",
            id="a line that is slower than its robots",
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
            PHONES + PHONES.replace("links.phones", "links.more"),
            "links.more.accept: link phones takes all who call hci0 already; keep one of them",
            id="two links that accept",
        ),
        pytest.param(
            PHONES.replace("psiu-ascii", "psiu-hexa") + 'topology = "point-to-point"\nremote = 3',
            "links.phones.topology: point-to-point packets name no robot, and this link may reach several",
            id="point-to-point with phones",
        ),
        pytest.param(
            ROBOT_WIFI + 'peers = ["127.0.0.1:9001"]',
            "links.wifi.topology: point-to-point packets name no robot, and this link may reach several",
            id="point-to-point with learned robots",
        ),
        pytest.param(
            ROBOT_WIFI + 'learn = false\npeers = ["127.0.0.1:9001", "127.0.0.1:9002"]',
            "links.wifi.topology: point-to-point packets name no robot, and this link may reach several",
            id="point-to-point with two peers",
        ),
        pytest.param(
            ARM + "local = 7\nremote = 7",
            "links.arm.remote: 7 is the broker's own address there; give the robot's",
            id="both ends with one address",
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
        pytest.param(
            RADIO.replace("links.radio", 'links."my radio"'),
            'links."my radio": expected a name of letters, digits, - and _',
            id="a link's name",
        ),
    ],
)
def test_what_cannot_work_together_is_refused(problems, text, expected):
    (line,) = problems(BROKER + text)
    assert line.startswith(expected)


@pytest.mark.parametrize(
    "text",
    [
        WIFI + WIFI.replace("links.wifi", "links.lan").replace("9000", "9001"),
        WIFI + WIFI.replace("links.wifi", "links.lan").replace("127.0.0.1", "127.0.0.2"),
        WIFI.replace("127.0.0.1", "[::]") + WIFI.replace("links.wifi", "links.lan").replace("127.0.0.1", "0.0.0.0"),
        WIFI.replace("127.0.0.1", "[::]") + WIFI.replace("links.wifi", "links.lan"),
        PHONES + PHONES.replace("links.phones", "links.more") + 'controller = "hci1"',
        RADIO + ROBOT_WIFI + 'learn = false\npeers = ["127.0.0.1:9001"]',
        RADIO.replace("psiu-ascii", "psiu-hexa").replace("radio", "hexa")
        + "local = 5\n"
        + WIFI
        + '[robots.A]\nlink="hexa"\naddress=0',
        (WIFI + WIFI.replace("links.wifi", "links.lan")).replace(":9000", ":0"),
        HEXA + HEXA.replace("hexa]", "blue]").replace("by-id/hexa", "by-id/blue") + 'domain="blue"\n'
        '[robots.A]\nlink="hexa"\naddress=1\n[robots.B]\nlink="blue"\naddress=1',
    ],
)
def test_what_only_looks_alike_is_allowed(read, text):
    assert len(read(BROKER + text).links) == 2


def test_two_names_of_one_device_are_noticed(problems, tmp_path):
    (tmp_path / "ttyUSB9").touch()
    (tmp_path / "by-id").symlink_to("ttyUSB9")
    one = RADIO.replace("/dev/serial/by-id/radio", str(tmp_path / "ttyUSB9"))
    two = RADIO.replace("/dev/serial/by-id/radio", str(tmp_path / "by-id")).replace("links.radio", "links.two")
    (line,) = problems(BROKER + one + two)
    assert line.startswith("links.two.device: ")


def test_a_link_that_plays_a_robot_is_the_board_s_side(read):
    text = BROKER + CORPO.replace("mitya", "firmata") + 'plays = "A"\n' + RADIO + '[robots.A]\nlink="radio"'
    assert read(text).links["corpo"].codec.role == "board"


def test_every_mistake_is_told_at_once(problems):
    lines = problems(
        """
        [brokr]
        [broker]
        name = "??"
        [zenoh]
        listen = [1]
        [links.radio]
        adapter = "serial"
        baudrate = "9600"
        baudrat = 1
        protocol = "psiu-asci"
        retries = -1
        [links.wifi]
        adapter = "udp"
        listen = "127.0.0.1:9000"
        protocol = "psiu-ascii"
        strictt = true
        [robots.A]
        link = "wifii"
        adress = 1
        """
    )
    assert [line.partition(": ")[0] for line in lines] == [
        "brokr",
        "broker.name",
        "zenoh.listen[0]",
        "links.radio.protocol",
        "links.radio.retries",
        "links.radio.device",
        "links.radio.baudrate",
        "links.wifi.strictt",
        "robots.A.link",
        "robots.A.adress",
    ]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[links.a]\ndevice = /dev/ttyUSB0", "radio.toml:2:10: not TOML: Invalid value; text is written in quotes"),
        ("[broker]\nname = 'a'\nname = 'b'\n", "radio.toml:3:11: not TOML: Cannot overwrite a value"),
        ("name = ", "radio.toml: at the end: not TOML: Invalid value"),
        ("a = " + "9" * 5000, "radio.toml: not TOML: "),
        ("a = " + "[" * 5000 + "]" * 5000, "radio.toml: "),
        ("[broker" + ".a" * 5000 + "]", "radio.toml: "),
    ],
)
def test_what_is_not_toml_is_told_with_line_and_column(read, text, expected):
    with pytest.raises(ConfigurationError) as caught:
        read(text)
    (line,) = caught.value.problems
    assert line.startswith(expected)


def test_a_file_that_cannot_be_read_is_told_in_one_line(tmp_path):
    (tmp_path / "latin1.toml").write_bytes("name = 'José'".encode("latin-1"))
    for name, expected in {
        "missing.toml": "cannot be read: No such file or directory",
        ".": "cannot be read: Is a directory",
        "latin1.toml": "byte 11 is not UTF-8",
    }.items():
        with pytest.raises(ConfigurationError) as caught:
            load(tmp_path / name)
        (line,) = caught.value.problems
        assert line.startswith(f"{tmp_path / name}: {expected}")


def test_a_byte_order_mark_and_windows_line_ends_do_no_harm(tmp_path):
    path = tmp_path / "windows.toml"
    path.write_bytes(b"\xef\xbb\xbf" + dedent(AS_IN_THE_README).replace("\n", "\r\n").encode())
    assert load(path).broker.name == "base"


def test_an_adapter_that_cannot_be_loaded_is_told_in_one_line(problems, monkeypatch):
    def broken(name: str) -> None:
        raise UnknownAdapter(f"the adapter {name!r} cannot be loaded: no module")

    monkeypatch.setattr(reading, "adapter_class", broken)
    assert problems(BROKER + RADIO) == ["links.radio.adapter: the adapter 'serial' cannot be loaded: no module"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            '[zenoh]\nunprotected = true\nlisten = ["tcp/127.0.0.1:1", "tcp/0.0.0.0:7447"]',
            "radio.toml: zenoh.listen[1]: tcp/0.0.0.0:7447 lets",
        ),
        ('[zenoh]\nunprotected = true\nlisten = ["tcp/[::]:7447"]', "radio.toml: zenoh.listen[0]: "),
        ('[zenoh]\nunprotected = true\nlisten = ["tcp/robot.lan:7447"]', "radio.toml: zenoh.listen[0]: "),
        (
            RADIO.replace("/dev/serial/by-id/radio", "/dev/ttyUSB0"),
            "radio.toml: links.radio.device: /dev/ttyUSB0 may be",
        ),
        (
            RADIO.replace("/dev/serial/by-id/radio", "/dev/ttyACM12"),
            "radio.toml: links.radio.device: /dev/ttyACM12 may",
        ),
    ],
)
def test_what_is_allowed_but_risky_is_warned_of(read, text, expected):
    (warning,) = read(BROKER + text).warnings
    assert warning.startswith(expected)


def test_loopback_is_not_warned_of(read):
    listen = '["tcp/127.0.0.2:7448", "tcp/localhost:7447", "tcp/[::1]:7447", "unixsock-stream//run/psiu"]'
    assert read(BROKER + f"[zenoh]\nlisten = {listen}").warnings == ()


def test_the_schema_accepts_the_readme_s_configuration_and_refuses_what_loading_refuses():
    schema = json_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    check = jsonschema.Draft202012Validator(json.loads(json.dumps(schema)))
    good = tomllib.loads(dedent(AS_IN_THE_README + HILL + VALLEY))
    check.validate(good)
    check.validate(tomllib.loads(EXAMPLE.read_text()))
    for path, value in {
        ("links", "radio", "baudrat"): 9600,
        ("links", "radio", "topology"): "ad-hoc",
        ("links", "radio", "adapter"): "seral",
        ("links", "wifi", "baudrate"): 9600,
        ("robots", "BRACO", "nodes", "garra", "type"): "srvo",
        ("trunks", "hill", "adapter"): "udp",
        ("trunks", "hill", "protocol"): "psiu-ascii",
        ("broker", "address"): 256,
        ("other",): 1,
        ("zenoh", "listen"): [],
    }.items():
        bad = json.loads(json.dumps(good))
        table = bad
        for part in path[:-1]:
            table = table[part]
        table[path[-1]] = value
        assert not check.is_valid(bad), path


values = st.recursive(
    st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=20)
    | st.sampled_from(["serial", "psiu-hexa", "radio"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=5,
)
KEYS = [
    "adapter",
    "protocol",
    "device",
    "baudrate",
    "peers",
    "listen",
    "address",
    "link",
    "nodes",
    "topology",
    "remote",
]


def toml(value: object) -> str:
    match value:
        case bool():
            return str(value).lower()
        case str():
            return json.dumps(value).replace("\\u007f", "\\u007F").replace("\x7f", "\\u007F")
        case list():
            return "[" + ", ".join(map(toml, value)) + "]"
        case dict():
            return "{" + ", ".join(f"{toml(key)} = {toml(inner)}" for key, inner in value.items()) + "}"
        case _:
            return repr(value)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.dictionaries(
        st.sampled_from(["broker", "zenoh", "links", "trunks", "robots"]),
        values
        | st.dictionaries(st.sampled_from(["radio", "name", "A"]), st.dictionaries(st.sampled_from(KEYS), values)),
    )
)
def test_whatever_the_file_says_the_author_gets_whole_lines_and_never_a_traceback(tmp_path, tables):
    path = tmp_path / "radio.toml"
    path.write_text("\n".join(f"{name} = {toml(value)}" for name, value in tables.items()), encoding="utf-8")
    try:
        load(path)
    except ConfigurationError as error:
        assert error.problems
        for line in error.problems:
            assert line.startswith(str(path))
            assert line.splitlines() == [line]


def test_what_may_leave_on_a_link_is_limited_in_all_and_by_subject(read):
    more = 'max_frames_s = 20\nmax_bytes_s = 480.5\nnewest_wins = ["node/*", "motor"]\n'
    options = read(BROKER + RADIO + more + 'limits."node/*" = {frames_s = 9, bytes_s = 90}\n').links["radio"].options
    assert (options.max_frames_s, options.max_bytes_s, options.newest_wins) == (20, 480.5, ("node/*", "motor"))
    assert [(name, each.frames_s, each.bytes_s) for name, each in options.limits.items()] == [("node/*", 9, 90)]
    assert (options.longest_wait_s("parafrente"), options.longest_wait_s("ExibeComandos")) == (2.0, 4.0)


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

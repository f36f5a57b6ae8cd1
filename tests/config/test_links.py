"""What may be in [links.NAME], and what is said of the rest."""

import pytest
from config.texts import ARM, AS_IN_THE_README, BROKER, CAMPO, CORPO, HEXA, PHONES, RADIO, ROBOT_WIFI, WIFI

from psiu_broker.config import reading
from psiu_broker.registry import UnknownAdapter


def test_a_broker_without_links_is_allowed(read):
    assert read(BROKER).links == {}


def test_the_keys_of_a_link_are_split_among_adapter_codec_and_link(read):
    link = read(BROKER + HEXA + 'baudrate = 115200\ncrc = "xor"\ndomain = "red"\nmax_age_s = 1\nlocal = 9\n').links[
        "hexa"
    ]
    assert link.adapter.model_dump()["baudrate"] == 115200
    assert link.codec.model_dump() | {"crc": "xor", "domain": "red", "local": 9} == link.codec.model_dump()
    assert link.options.max_age_s == 1.0


def test_a_point_to_point_link_takes_its_ends_from_its_robot_and_the_broker(read):
    codec = read(AS_IN_THE_README.replace('name = "base"', 'name = "base"\naddress = 7')).links["arm"].codec
    assert codec.model_dump()["remote"] == 0x12
    assert codec.model_dump()["local"] == 7


def test_a_link_that_plays_a_robot_is_the_board_s_side(read):
    text = BROKER + CORPO.replace("mitya", "firmata") + 'plays = "A"\n' + RADIO + '[robots.A]\nlink="radio"'
    assert read(text).links["corpo"].codec.role == "board"


def test_what_may_leave_on_a_link_is_limited_in_all_and_by_subject(read):
    more = 'max_frames_s = 20\nmax_bytes_s = 480.5\nnewest_wins = ["node/*", "motor"]\n'
    options = read(BROKER + RADIO + more + 'limits."node/*" = {frames_s = 9, bytes_s = 90}\n').links["radio"].options
    assert (options.max_frames_s, options.max_bytes_s, options.newest_wins) == (20, 480.5, ("node/*", "motor"))
    assert [(name, each.frames_s, each.bytes_s) for name, each in options.limits.items()] == [("node/*", 9, 90)]
    assert (options.longest_wait_s("parafrente"), options.longest_wait_s("ExibeComandos")) == (2.0, 4.0)


def test_an_adapter_that_cannot_be_loaded_is_told_in_one_line(problems, monkeypatch):
    def broken(name: str) -> None:
        raise UnknownAdapter(f"the adapter {name!r} cannot be loaded: no module")

    monkeypatch.setattr(reading, "adapter_class", broken)
    assert problems(BROKER + RADIO) == ["links.radio.adapter: the adapter 'serial' cannot be loaded: no module"]


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
        (WIFI.replace("127.0.0.1", "a..b"), "links.wifi.listen: got 'a..b:9000': no host can be called 'a..b'"),
        (WIFI + f'peers = ["{"a" * 64}.lan:9001"]', "links.wifi.peers: got 'aaaaaaaaaaaaaaaaaaaa"),
        (WIFI + "peer_ttl_s = 0.9", "links.wifi.peer_ttl_s: expected a number greater than or equal to 1, got 0.9"),
    ],
)
def test_a_wrong_value_is_refused_with_what_was_expected_and_what_was_got(problems, text, expected):
    (line,) = problems(BROKER + text)
    assert line.startswith(expected)


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


@pytest.mark.parametrize(
    ("text", "expected"),
    [
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

"""What may be in [broker] and [zenoh], and what is said of the rest."""

import pytest
from config.texts import BROKER

from psiu_broker.mesh.beat import Beat


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        pytest.param(BROKER + "nme = 1", "broker.nme: unknown key; did you mean name?", id="broker"),
        pytest.param(BROKER + "[link.a]", "link: unknown key; did you mean links?", id="table"),
        pytest.param(BROKER + "[zenoh]\nxyz = 1", "zenoh.xyz: unknown key; known: access, listen,", id="nothing near"),
    ],
)
def test_an_unknown_key_is_refused_with_the_one_that_was_meant(problems, text, expected):
    (line,) = problems(text)
    assert line.startswith(expected)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
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
        ('[zenoh]\nprefix = "psiu/**"', "zenoh.prefix: expected words of"),
    ],
)
def test_a_wrong_value_is_refused_with_what_was_expected_and_what_was_got(problems, text, expected):
    (line,) = problems(BROKER + text)
    assert line.startswith(expected)


@pytest.mark.parametrize("name", ["", "a??b", "0x12", "red.0x03", "José", " base", "a\\nb"])
def test_the_broker_s_name_is_one_that_a_robot_can_have(problems, name):
    (line,) = problems(f'[broker]\nname = "{name}"')
    assert line.startswith("broker.name: expected a name")


def test_the_broker_s_name_is_one_that_other_brokers_can_read(read, problems):
    longest = "x" * 255
    assert read(f'[broker]\nname = "{longest}"').broker.name == Beat(broker=longest, epoch=1, sent_us=1).broker
    (line,) = problems(f'[broker]\nname = "{longest}x"')
    assert line == "broker.name: expected a name of at most 255 letters, got 256; choose a shorter word"


def test_the_broker_s_name_is_one_that_robots_cannot_misread(problems):
    (line,) = problems('[broker]\nname = "my base"')
    expected = 'broker.name: expected a name without spaces, got "my base": a robot that has not met it misreads it'
    assert line.startswith(expected)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            '[zenoh]\nunprotected = true\nlisten = ["tcp/127.0.0.1:1", "tcp/0.0.0.0:7447"]',
            "radio.toml: zenoh.listen[1]: tcp/0.0.0.0:7447 lets",
        ),
        ('[zenoh]\nunprotected = true\nlisten = ["tcp/[::]:7447"]', "radio.toml: zenoh.listen[0]: "),
        ('[zenoh]\nunprotected = true\nlisten = ["tcp/robot.lan:7447"]', "radio.toml: zenoh.listen[0]: "),
    ],
)
def test_what_is_allowed_but_risky_is_warned_of(read, text, expected):
    (warning,) = read(BROKER + text).warnings
    assert warning.startswith(expected)


def test_loopback_is_not_warned_of(read):
    listen = '["tcp/127.0.0.2:7448", "tcp/localhost:7447", "tcp/[::1]:7447", "unixsock-stream//run/psiu"]'
    assert read(BROKER + f"[zenoh]\nlisten = {listen}").warnings == ()

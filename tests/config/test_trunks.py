"""What may be in [trunks.NAME], and what is said of the rest."""

import pytest
from config.texts import BROKER, HILL, PHONES, VALLEY


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


@pytest.mark.parametrize(
    ("text", "expected"),
    [
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
    ],
)
def test_what_cannot_work_together_is_refused(problems, text, expected):
    (line,) = problems(BROKER + text)
    assert line.startswith(expected)

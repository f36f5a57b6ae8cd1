"""Bytes into frames and back, by hand, in the protocols beside PSIU."""

import json
from collections.abc import Callable
from typing import Any

import pytest
from click.testing import Result

from psiu_broker.cli.protocol_options import CODEC_OFFERS
from psiu_broker.protocols import CODECS

Run = Callable[..., Result]


def shown(tool: Run, *words: str) -> str:
    encoded = tool("encode", *words)
    assert encoded.exit_code == 0, encoded.output
    return str(encoded.stdout.strip())


def decoded(tool: Run, *words: str, **more: Any) -> list[str]:
    return [line.rstrip() for line in tool("decode", *words, **more).output.splitlines()]


@pytest.mark.parametrize(
    ("words", "wire"),
    [
        (("mitya", "D", "100"), "D0064"),
        (("mitya", "D", "-100"), "DFF9C"),
        (("mitya", "left", "-1"), "LFFFF"),
        (("mitya", "pare"), "D0000"),
        (("mitya", "mood", "happy"), "F0002"),
        (("mitya", "t"), "t0001t0000"),
        (("mitya", "--repeat", "2", "t", "2"), "t0002t0002t0000t0000"),
        (("mitya", "--version", "2013", "drive", "100"), "G0064"),
        (("soccer", "--to", "1", "rodas", "15", "-31"), "aa 3e fc 03 03 03 03 55"),
        (("soccer", "--to", "3", "pare"), "aa 03 03 03 03 03 03 55"),
        (("soccer", "--preset", "mirosot", "rodas", "1:15,-31", "3:31,31"), "aa 3e fc 03 03 7e 7e 55"),
        (("soccer", "2:-31,-31"), "aa 03 03 fc fc 03 03 55"),
        (("soccer", "2:0xfcfc"), "aa 03 03 fc fc 03 03 55"),
        (("soccer", "--preset", "guarana", "--to", "2", "bytes", "0x7f"), "aa 00 7f 00 00"),
        (("soccer", "--preset", "guarana", "--trailer", "none", "--start", "0xFE", "3:9"), "fe 00 00 09"),
        (("firmata", "mode", "13", "output"), "f4 0d 01"),
        (("firmata", "digital", "13", "1"), "f5 0d 01"),
        (("firmata", "analog", "9", "255"), "e9 7f 01"),
        (("firmata", "hex", "0xF9"), "f9"),
        (("firmata", "--role", "board", "hex", "e0", "7f07"), "e0 7f 07"),
        (("amarino", "A", "180", "45"), "41 31 38 30 3b 34 35 13"),
        (("amarino", "send", "A", "1.5"), "41 31 2e 35 30 13"),
        (("amarino", "hex", "41", "31"), "41 31 13"),
        (("amarino", "--role", "board", "21.5", "3"), "12 32 31 2e 35 30 3b 33 13"),
        (("amarino", "--role", "board", "hex", ""), "12 13"),
    ],
)
def test_a_command_is_encoded_in_the_words_of_a_call(tool: Run, words: tuple[str, ...], wire: str) -> None:
    assert shown(tool, "--protocol", *words) == wire


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (("mitya", "D", "300"), 2, "D takes -255 to 255, got 300"),
        (("mitya", "--version", "2013", "D", "1"), 2, "what 2012 calls so is G in 2013"),
        (("mitya", "--version", "1", "D", "1"), 2, "--version of mitya is 2012 or 2013 or 2014, not 1"),
        (("mitya", "--to", "2", "D", "1"), 2, "--to is an option of psiu-hexa and soccer"),
        (("mitya", "--from", "2", "D", "1"), 2, "--from is an option of psiu-ascii and psiu-hexa"),
        (("soccer", "rodas", "15", "-31"), 2, "15 is for no robot, which are counted from 1; write --to 1 rodas"),
        (("soccer", "--to", "4", "pare"), 2, "a robot of this team is a number 1–3, not 4"),
        (("soccer", "4:1,1"), 2, "a robot of this team is a number 1–3, not 4"),
        (("soccer", "1:15"), 2, "rodas takes 2 whole numbers, -31 to 31"),
        (("soccer", "--start", "0x3e", "1:1,1"), 2, "--start: 0x3E is also the mirosot byte of a wheel"),
        (("soccer", "--robots", "0", "1:1,1"), 2, "--robots: Input should be greater than or equal to 1, not 0"),
        (("firmata", "analog", "9", "-5"), 2, "analog takes a pin and a number 0–16383"),
        (("firmata", "hex", "e0"), 1, "no message that a Firmata host sends"),
        (("firmata", "hex", "xy"), 2, "xy is not hexadecimal"),
        (("firmata", "--role", "board", "version"), 2, "hex e0 7f 07"),
        (("amarino", "ab"), 2, "a flag, one character from 0 to z"),
        (("amarino", "hex", "2f"), 1, "flags begin at 0"),
        (("amarino", "--role", "board", "a;b"), 2, "a board would read two"),
        (("amarino", "--role", "host", "A"), 2, "--role of amarino is phone or board, not host"),
    ],
)
def test_what_cannot_be_meant_is_refused_with_the_reason(
    tool: Run, words: tuple[str, ...], code: int, said: str
) -> None:
    refused = tool("encode", "--protocol", *words)
    assert refused.exit_code == code, refused.output
    assert said in " ".join(refused.output.split())


@pytest.mark.parametrize("command", ["encode", "decode"])
@pytest.mark.parametrize("protocol", [name for name in CODECS if CODEC_OFFERS[name]])
def test_the_help_tells_the_options_of_each_protocol_by_themselves(tool: Run, protocol: str, command: str) -> None:
    _, found, told = tool(command, "--help").output.partition(f"\nOptions of {protocol}:\n")
    assert found
    own = told.partition("\n\n")[0]
    for offer in CODEC_OFFERS[protocol]:
        assert offer.spelled.partition("/")[0] in own


@pytest.mark.parametrize(
    ("wire", "lines"),
    [
        (b"D0064", ["mitya  drive 100"]),
        (b"H005A\r\n", ["mitya  head-horizontal 90 deg"]),
        (b"E0102", ["mitya  error falha E0102 [the head: unknown command]"]),
        (b"\xaa\x3e\xfc\x03\x03", []),
        (
            b"\xaa\x3e\xfc\x7e\x7e\x03\x03\x55",
            ["soccer  ? → 0x01  rodas 15 -31", "soccer  ? → 0x02  rodas 31 31", "soccer  ? → 0x03  rodas 0 0"],
        ),
        (b"\xe0\x7f\x07", ["firmata  A0=1023"]),
        (b"\xf4\x0d\x01\xf5\x0d\x01", ["firmata  pin-mode/13 output", "firmata  write-pin/13 1"]),
        (b"\x1221.50;3\x13", ["amarino  event 21.5 3"]),
        (b"A180;45\x13", ["amarino  flag/A 180 45"]),
    ],
)
def test_the_protocol_that_fits_is_told_in_the_words_of_its_robots(tool: Run, wire: bytes, lines: list[str]) -> None:
    found = decoded(tool, "--binary", input=wire)
    assert found == lines if lines else all("no frame" in line for line in found)


def test_versions_and_roles_are_options(tool: Run) -> None:
    words = ("--protocol", "mitya", "--version", "2013", "--binary")
    assert decoded(tool, *words, input=b"~01F6#0000") == ["mitya  telemetry battery=5.02 V", "mitya  response sucesso"]
    assert decoded(tool, "--version", "2013", "--binary", input=b"G0064") == ["mitya  drive 100"]
    assert decoded(tool, "--role", "board", "f9") == ["firmata  ask/version"]
    assert decoded(tool, "--protocol", "firmata", "f9")[0].startswith("firmata  no frame")
    packets = ("--protocol", "soccer", "--preset", "guarana", "--robots", "2", "--byte-codec", "int8")
    assert decoded(tool, *packets, "aa", "ff", "05", "00") == [
        "soccer  ? → 0x01  bytes 0xff",
        "soccer  ? → 0x02  bytes 0x05",
    ]


def test_what_psiu_explains_as_well_is_told_as_psiu(tool: Run) -> None:
    draft = shown(tool, "--version", "0.5", "A", "D0064")
    assert decoded(tool, "--version", "0.5", "--binary", input=draft.encode()) == ["psiu-ascii  PC → A  D0064"]
    assert decoded(tool, "0012", "06043fdf") == ["psiu-hexa  0x00 → 0x12  node 4 signal 63"]


def test_a_few_bytes_that_fit_by_chance_are_no_guess(tool: Run) -> None:
    found = tool("decode", "--binary", input=b"nothing that D0064 robots would ever say")
    assert found.exit_code == 1
    assert {line.split()[0] for line in found.output.splitlines()} == {"psiu-ascii", "psiu-hexa"}


def test_in_json_a_frame_has_the_fields_of_the_bus(tool: Run) -> None:
    (battery,) = map(json.loads, decoded(tool, "--protocol", "mitya", "--version", "2013", "--json", b"~01F6".hex()))
    assert (battery["kind"], battery["value"], battery["unit"]) == ("event", 5.02, "V")
    assert battery["readings"] == {"battery": 5.02}
    assert (battery["source"], battery["destination"], battery["status"]) == ("", "", None)
    (channel,) = map(json.loads, decoded(tool, "--json", "e17f07"))
    assert (channel["command"], channel["readings"], channel["wire"]) == ("A1", {"A1": 1023}, "e17f07")


@pytest.mark.parametrize(
    ("options", "words", "reading"),
    [
        ("--protocol mitya", "drive -7", ""),
        ("--protocol mitya --version 2014", "tail 100", "--version 2014"),
        ("--protocol soccer", "1:1,2 2:-3,-4 3:0,31", ""),
        ("--protocol soccer --preset f180", "5:1,2,3,4", "--preset f180"),
        ("--protocol firmata", "mode 9 pwm", "--role board"),
        ("--protocol amarino", "z 9", "--role board"),
        ("--protocol amarino --role board", "9 oi", "--role phone"),
    ],
)
def test_what_is_encoded_is_decoded_without_a_byte_over(tool: Run, options: str, words: str, reading: str) -> None:
    wire = json.loads(tool("encode", "--json", *options.split(), *words.split()).stdout)["wire"]
    read = tool("decode", *options.split()[:2], *reading.split(), wire)
    assert (read.exit_code, "no frame" in read.output) == (0, False)

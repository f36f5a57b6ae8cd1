"""Bytes into frames and back, by hand."""

import json
from collections.abc import Callable
from typing import Any

import pytest
from click.testing import Result
from crccheck.crc import Crc8Smbus

Run = Callable[..., Result]

FORWARD = b"MNERIM 034 parafrente 100 PC 02123"


@pytest.mark.parametrize(
    "spelling",
    [
        (FORWARD.hex(),),
        (FORWARD.hex(" "),),
        tuple(FORWARD.hex(" ").split()),
        (FORWARD.hex(":"),),
        tuple(f"0x{byte:02X}" for byte in FORWARD),
    ],
)
def test_hexadecimal_is_read_however_it_is_spelled(tool: Run, spelling: tuple[str, ...]) -> None:
    decoded = tool("decode", *spelling)
    assert decoded.exit_code == 0
    assert decoded.output == "psiu-ascii  PC → MNERIM  parafrente 100\n"


@pytest.mark.parametrize(
    ("words", "given"),
    [
        (("-",), FORWARD.hex().encode()),
        ((), FORWARD.hex(" ", 4).encode() + b"\n"),
        (("--binary", "-"), FORWARD),
        (("--binary",), FORWARD + b"\r\n"),
    ],
)
def test_bytes_come_from_standard_input_as_text_or_as_they_are(tool: Run, words: tuple[str, ...], given: bytes) -> None:
    decoded = tool("decode", *words, input=given)
    assert (decoded.exit_code, decoded.output) == (0, "psiu-ascii  PC → MNERIM  parafrente 100\n")


def test_what_is_no_frame_is_shown_with_the_reason_and_fails(tool: Run) -> None:
    decoded = tool("decode", "--protocol", "psiu-ascii", "--binary", input=b"\x01\x02" + FORWARD[:-1] + b"9\r\n")
    assert decoded.exit_code == 1
    assert "no frame (checksum)" in decoded.output
    assert "0102" in decoded.output


def test_frames_between_noise_are_all_found(tool: Run) -> None:
    decoded = tool("decode", "--json", "--binary", input=b"\xff\xff" + FORWARD + b"\xfe" + FORWARD)
    assert decoded.exit_code == 1
    events = [json.loads(line) for line in decoded.stdout.splitlines()]
    assert [event.get("malformed", event.get("command")) for event in events] == [
        "noise",
        "parafrente",
        "noise",
        "parafrente",
    ]
    assert events[1]["parameters"] == [100]
    assert bytes.fromhex(events[1]["wire"]) == FORWARD


def test_a_packet_of_bytes_is_found_behind_noise(tool: Run) -> None:
    decoded = tool("decode", "--protocol", "psiu-hexa", "ff", "010206043f", check(0x3F))
    assert decoded.output.splitlines()[1:] == ["psiu-hexa  0x01 → 0x02  node 4 signal 63"]


def check(signal: int) -> str:
    """The check byte of 01 02 06 04 and the signal, from an implementation of its own."""
    return f"{Crc8Smbus.calc(bytes((1, 2, 6, 4, signal))):02x}"


def test_of_two_protocols_the_one_that_leaves_less_over_is_told(tool: Run) -> None:
    packet = f"010206043f{check(0x3F)}"
    told = tool("decode", packet + FORWARD.hex()).output.splitlines()
    assert [line.split()[0] for line in told] == ["psiu-ascii", "psiu-ascii"]
    assert [line.split()[0] for line in tool("decode", packet).output.splitlines()] == ["psiu-hexa"]


def test_nothing_at_all_is_no_frame(tool: Run) -> None:
    decoded = tool("decode", input=b"")
    assert decoded.exit_code == 1


def test_text_in_the_place_of_hexadecimal_is_refused_with_the_way_to_decode_it(tool: Run) -> None:
    refused = tool("decode", *FORWARD.decode().split())
    assert refused.exit_code == 2
    assert "not hexadecimal" in refused.output
    assert "--binary" in refused.output


@pytest.mark.parametrize("words", [("ping",), ("ack",), ("node", "4", "63"), ("complex", "0102", "ff")])
@pytest.mark.parametrize("topology", ["ad-hoc", "master-slave", "point-to-point"])
def test_packets_of_bytes_survive_encoding_and_decoding(tool: Run, topology: str, words: tuple[str, ...]) -> None:
    options = ("--protocol", "psiu-hexa", "--topology", topology, "--crc", "maxim-dow", "--size", "real")
    encoded = tool("encode", *options, "--to", "2", *words)
    assert encoded.exit_code == 0, encoded.output
    (event,) = [json.loads(tool("decode", *options, encoded.stdout.strip(), "--json").stdout)]
    assert event["kind"] == words[0]
    assert [event["node"], event["signal"]] == ([4, 63] if words[0] == "node" else [None, None])
    assert event["fields"] == (["0102", "ff"] if words[0] == "complex" else None)


def test_a_packet_of_bytes_has_the_addresses_that_were_asked_for(tool: Run) -> None:
    encoded = tool("encode", "--protocol", "psiu-hexa", "--from", "1", "--to", "0x12", "node", "4", "-3")
    assert bytes.fromhex(encoded.stdout)[:5] == bytes((1, 0x12, 6, 4, 0xFD))
    decoded = tool("decode", encoded.stdout.strip())
    assert decoded.output == "psiu-hexa  0x01 → 0x12  node 4 signal 253\n"


def test_words_are_encoded_as_the_document_has_them(tool: Run) -> None:
    assert tool("encode", "MNERIM", "parafrente", "100").output == FORWARD.decode() + "\n"
    assert tool("encode", "MNERIM", "parafrente", "100", "--binary").stdout_bytes == FORWARD
    crlf = tool("encode", "MNERIM", "parafrente", "100", "--binary", "--line-end", "crlf")
    assert crlf.stdout_bytes == FORWARD + b"\r\n"
    encoded: Any = json.loads(tool("encode", "??", "qualseunome", "--json").stdout)
    assert bytes.fromhex(encoded["wire"]) == b"?? 027 qualseunome PC 01753"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("MNERIM",), "destination and then the command"),
        (("MNERIM", "parafrente", "--to", "2"), "--to is an option of psiu-hexa and soccer; write the destination"),
        (("MNERIM", "parafrente", "--crc", "xor"), "--crc is an option of psiu-hexa"),
        (("--protocol", "psiu-hexa", "ping"), "--to is missing"),
        (("--protocol", "psiu-hexa", "--to", "2", "node", "4"), "expected ping, ack"),
        (("--protocol", "psiu-hexa", "--to", "2", "node", "4", "300"), "a signal is a number -128–255"),
        (("--protocol", "psiu-hexa", "--to", "300", "ping"), "an address is a number 0–255"),
        (("--protocol", "psiu-hexa", "--to", "2", "--local", "x", "ping"), "not a number such as 18"),
        (("--protocol", "psiu-hexa", "--to", "2", "--local", "999", "ping"), "--local"),
        (("--protocol", "psiu-hexa", "--to", "2", "complex", "xy"), "fields in hexadecimal"),
    ],
)
def test_what_cannot_be_meant_is_refused_with_what_was_expected(tool: Run, words: tuple[str, ...], said: str) -> None:
    refused = tool("encode", *words)
    assert refused.exit_code == 2
    assert said in " ".join(refused.output.split())


def test_a_frame_that_cannot_be_written_is_one_line(tool: Run) -> None:
    refused = tool("encode", "JOÃO", "parafrente", "1")
    assert refused.exit_code == 1
    assert refused.stderr.startswith("psiu: ")
    assert len(refused.stderr.splitlines()) == 1


def test_the_options_of_the_protocol_decide_what_fits(tool: Run) -> None:
    wrong_size = b"MNERIM 033 parafrente 100 PC 02122"
    tolerant = tool("decode", "--protocol", "psiu-ascii", "--binary", input=wrong_size)
    assert (tolerant.exit_code, "size 033, not 034" in tolerant.output) == (0, True)
    assert tool("decode", "--strict", "--binary", input=wrong_size).exit_code == 1


def test_frames_are_printed_while_more_are_still_coming(start: Callable[..., Any]) -> None:
    decoding = start("psiu", "decode", "--protocol", "psiu-ascii", "--binary", "-")
    decoding.popen.stdin.write(FORWARD.decode())
    decoding.popen.stdin.flush()
    decoding.until("PC → MNERIM")
    assert decoding.popen.poll() is None
    decoding.popen.stdin.close()
    assert decoding.ended() == 0

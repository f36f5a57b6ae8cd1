import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from psiu_broker.codecs.checksums import CHECKS
from psiu_broker.codecs.codec import Directory, Event
from psiu_broker.codecs.fragments import LONGEST_PAYLOAD, REASSEMBLY_S
from psiu_broker.codecs.psiu_hexa import PsiuHexa, fields, join_fields, packet
from psiu_broker.errors import EncodeError
from psiu_broker.frame import NOBODY, Address, Frame, Malformed
from psiu_broker.protocols import CODECS

VECTORS = json.loads((Path(__file__).parents[1] / "vectors" / "psiu-hexa.json").read_text())["packets"]
SUBJECTS = {
    "ping": "ping", "ACK": "ack", "NAK": "nak", "BUSY": "busy",
    "FREE": "free", "WTF": "wtf", "AVAIL?": "available", "complex": "complex",
}  # fmt: skip
CASES = [(vector, crc) for vector in VECTORS for crc in [*vector["crc"], "none"]]
NODE = bytes.fromhex("010206038085")
ONE, TWO = Address.numbered(1), Address.numbered(2)


def hexa_codec(*numbers: int, **options: Any) -> PsiuHexa:
    return PsiuHexa(PsiuHexa.Options(**options), Directory(numbers=set(numbers)))


def read(codec: PsiuHexa, *pieces: bytes, now: float = 0.0) -> list[Event]:
    events: list[Event] = []
    for piece in pieces:
        events += codec.decode(piece, now)
    events += codec.flush(now)
    assert not codec.pending
    return events


def frames(events: Sequence[Event]) -> list[Frame]:
    return [event for event in events if isinstance(event, Frame)]


def cut(data: bytes) -> list[bytes]:
    return [bytes((byte,)) for byte in data]


def with_check(body: bytes, crc: str = "smbus") -> bytes:
    check = CHECKS[crc]  # type: ignore[index]
    return body if check is None else body + bytes((check(body),))


def of_vector(vector: dict[str, Any], crc: str) -> tuple[PsiuHexa, bytes]:
    size = vector["size"]
    body = bytes.fromhex(vector["body"])
    if crc == "none" and size == "real":
        at = 1 if vector["topology"] == "master-slave" else 0
        body = body[:at] + bytes((body[at] - 1,)) + body[at + 1 :]
    wire = body if crc == "none" else body + bytes.fromhex(vector["crc"][crc])
    options = {"topology": vector["topology"], "size": size, "crc": crc, "local": 9, "remote": 7}
    return hexa_codec(1, 2, 5, **options), wire


def check(vector: dict[str, Any], frame: Frame, wire: bytes) -> None:
    far = {"ad-hoc": vector.get("source"), "master-slave": vector.get("slave"), "point-to-point": 7}[vector["topology"]]
    assert frame.source == Address.numbered(far)
    assert frame.destination == Address.numbered(vector.get("destination", 9))
    assert frame.wire == wire
    assert frame.protocol == "psiu-hexa"
    kind = vector["kind"]
    if kind == "node":
        assert frame.subject == f"node/{vector['node']}"
        assert frame.payload == bytes((vector["node"], vector["signal"]))
    else:
        assert frame.subject == SUBJECTS[kind]
    if "value" in vector:
        assert frame.payload == bytes((vector["value"],))
    if kind == "ping":
        assert frame.payload == b""
    if kind == "complex":
        assert fields(frame.payload) == [bytes.fromhex(field) for field in vector["fields"]]


@pytest.mark.parametrize(
    ("vector", "crc"),
    CASES,
    ids=[f"{v['topology']}-{v['size']}-{v['kind']}-{v['body'][:10]}-{crc}" for v, crc in CASES],
)
class TestEachGoldenPacket:
    def test_whole(self, vector: dict[str, Any], crc: str) -> None:
        codec, wire = of_vector(vector, crc)
        (frame,) = codec.decode(wire, 0.0)
        assert not codec.pending
        assert isinstance(frame, Frame)
        check(vector, frame, wire)

    def test_byte_by_byte(self, vector: dict[str, Any], crc: str) -> None:
        codec, wire = of_vector(vector, crc)
        assert read(codec, *cut(wire)) == list(codec.decode(wire, 0.0))

    def test_with_trailing_bytes(self, vector: dict[str, Any], crc: str) -> None:
        codec, wire = of_vector(vector, crc)
        events = read(codec, wire + b"\x00")
        assert [frame.wire for frame in frames(events)] == [wire]
        assert [event.size for event in events if isinstance(event, Malformed)] == [1]
        assert [frame.wire for frame in frames(read(codec, wire * 3))] == [wire] * 3

    def test_with_noise_around(self, vector: dict[str, Any], crc: str) -> None:
        codec, wire = of_vector(vector, crc)
        noise = b"\x00\x00\x00"  # no packet has the size 0
        heard = frames(read(codec, noise + wire + noise))
        if vector["topology"] == "point-to-point":
            assert heard == []  # it names nobody, so that only a silence restores the step
            heard = frames([*read(codec, noise), *read(codec, wire + noise)])
        assert len(heard) == 1
        check(vector, heard[0], wire)

    def test_encoded_again(self, vector: dict[str, Any], crc: str) -> None:
        codec, wire = of_vector(vector, crc)
        (heard,) = frames(codec.decode(wire, 0.0))
        there = heard._replace(wire=b"", dialect="", destination=heard.destination)
        if vector["topology"] == "master-slave":
            there = there._replace(source=heard.destination, destination=heard.source)
        if vector["topology"] == "point-to-point":
            there = there._replace(destination=Address.numbered(7))
        assert codec.encode(there) == wire


@pytest.mark.parametrize("topology", ["ad-hoc", "master-slave", "point-to-point"])
@pytest.mark.parametrize("size", ["nominal", "real"])
@pytest.mark.parametrize("crc", CHECKS)
def test_sizes_that_no_packet_has_are_malformed(topology: str, size: str, crc: str) -> None:
    carried = {"ad-hoc": 2, "master-slave": 1, "point-to-point": 0}[topology]
    least = 4 if size == "nominal" else carried + 1 + (crc != "none")
    for said in range(256):
        codec = hexa_codec(topology=topology, size=size, crc=crc, resync=False)
        head = b"\x01\x02"[:carried] + bytes((said,))
        possible = least <= said <= min(255, least + LONGEST_PAYLOAD)
        length = said if size == "real" else said - 4 + carried + 1 + (crc != "none")
        body = head + bytes(max(0, length - len(head) - (crc != "none")))
        events = read(codec, with_check(body, crc))
        if possible:
            assert [len(frame.payload) for frame in frames(events)] == [said - least]
        else:
            assert [event.reason for event in events if isinstance(event, Malformed)] == ["size"]
            assert frames(events) == []


@pytest.mark.parametrize("command", [0, 1, 64, 200, 255])
def test_a_command_outside_the_table_keeps_its_number(command: int) -> None:
    (frame,) = frames(read(hexa_codec(), with_check(bytes((1, 2, 5, command)))))
    assert frame.subject == f"command/{command}"


def test_a_point_to_point_packet_comes_from_nobody_where_nobody_is_configured() -> None:
    (frame,) = frames(read(hexa_codec(topology="point-to-point"), with_check(b"\x04")))
    assert (frame.source, frame.destination) == (NOBODY, Address.numbered(0))


def test_a_corrupt_packet_is_one_malformed_and_the_next_one_is_found() -> None:
    spoiled = NODE[:-1] + b"\x00"
    good = with_check(bytes((2, 1, 5, 65)))
    for pieces in ([spoiled + good], cut(spoiled + good)):
        events = read(hexa_codec(1, 2), *pieces)
        assert events[0] == Malformed("crc", spoiled, 6)
        assert [frame.wire for frame in frames(events)] == [good]


def test_a_byte_too_much_costs_no_packet_behind_it() -> None:
    good = with_check(bytes((2, 1, 5, 65)))
    events = read(hexa_codec(1, 2), b"\x07" + NODE + good)
    assert [frame.wire for frame in frames(events)] == [NODE, good]


def test_a_find_is_trusted_only_if_it_is_for_a_known_robot_or_for_us() -> None:
    noise = b"\xff\xff\x00"
    assert frames(read(hexa_codec(), noise + NODE)) == []
    assert frames(read(hexa_codec(1), noise + NODE)) == []  # its source alone says nothing
    assert len(frames(read(hexa_codec(2), noise + NODE))) == 1
    assert len(frames(read(hexa_codec(local=2), noise + NODE))) == 1


def test_a_slaves_find_is_trusted_only_if_the_slave_is_known() -> None:
    noise = b"\xff\x00"
    wire = with_check(bytes((5, 6, 3, 255)))
    assert frames(read(hexa_codec(topology="master-slave", local=5), noise + wire)) == []
    assert len(frames(read(hexa_codec(5, topology="master-slave"), noise + wire))) == 1


def test_a_robot_learned_meanwhile_is_known() -> None:
    directory = Directory()
    codec = PsiuHexa(PsiuHexa.Options(), directory)
    assert frames(read(codec, b"\xff\xff\x00" + NODE)) == []
    directory.numbers = {2}
    assert len(frames(read(codec, b"\xff\xff\x00" + NODE))) == 1


def test_a_find_whose_fields_do_not_add_up_is_not_trusted_but_in_step_it_is_a_packet() -> None:
    odd = with_check(bytes((1, 2, 8, 9, 9, 9, 9)))
    assert len(frames(read(hexa_codec(2), odd))) == 1
    assert frames(read(hexa_codec(2), b"\xff\xff\x00" + odd)) == []


def test_a_found_packet_restores_the_step() -> None:
    stranger = with_check(bytes((77, 78, 5, 65)))
    events = read(hexa_codec(2), b"\xff\xff\x00" + NODE + stranger)
    assert [frame.wire for frame in frames(events)] == [NODE, stranger]


def test_without_resync_only_a_silence_restores_the_step() -> None:
    codec = hexa_codec(1, 2, resync=False)
    spoiled = NODE[:-1] + b"\x00"
    assert read(codec, spoiled + NODE + NODE) == [Malformed("crc", spoiled + NODE + NODE, 18)]
    assert [frame.wire for frame in frames(read(codec, NODE))] == [NODE]


def test_half_a_packet_is_given_up_by_silence() -> None:
    codec = hexa_codec()
    assert codec.decode(NODE[:4], 0.0) == []
    assert codec.pending
    assert codec.flush(0.0) == [Malformed("unfinished", NODE[:4], 4)]
    assert [frame.wire for frame in frames(read(codec, NODE))] == [NODE]


def test_a_size_too_large_does_not_swallow_the_packets_behind_it() -> None:
    claims = bytes((1, 2, 250, 3))
    for pieces in ([claims + NODE * 3], cut(claims + NODE * 3)):
        assert [frame.wire for frame in frames(read(hexa_codec(2), *pieces))] == [NODE] * 3
    assert [frame.wire for frame in frames(hexa_codec(2).decode(claims + NODE * 50, 0.0))] == [NODE] * 50


def test_packets_of_a_domain_have_its_addresses() -> None:
    codec = hexa_codec(domain="red")
    (frame,) = frames(read(codec, NODE))
    assert (frame.source, frame.destination) == (Address.numbered(1, "red"), Address.numbered(2, "red"))
    assert codec.dialect != hexa_codec().dialect
    assert codec.encode(frame._replace(wire=b"", dialect="")) == NODE
    with pytest.raises(EncodeError, match="red"):
        codec.encode(packet(ONE, Address.numbered(2, "red"), b""))
    with pytest.raises(EncodeError, match="blue"):
        codec.encode(packet(Address.numbered(1, "red"), Address.numbered(2, "blue"), b""))


def test_only_an_ad_hoc_packet_can_be_forwarded_as_it_came() -> None:
    codec = hexa_codec()
    (heard,) = frames(read(codec, NODE))
    assert heard.dialect == codec.dialect == "psiu-hexa/ad-hoc/nominal/smbus"
    assert codec.encode(heard) is heard.wire
    for topology in ("master-slave", "point-to-point"):
        other = hexa_codec(topology=topology)
        (heard,) = frames(other.decode(with_check(b"\x05\x04" if topology == "master-slave" else b"\x04"), 0.0))
        assert heard.dialect != other.dialect


def test_a_packet_of_our_own_is_named_after_its_payload() -> None:
    payloads = [b"", b"A", b"\x07\x00", join_fields([b"abc"])]
    assert [packet(ONE, TWO, payload).subject for payload in payloads] == ["ping", "ack", "node/7", "complex"]
    assert packet(ONE, TWO, b"A") == Frame(ONE, TWO, "ack", b"A", "psiu-hexa")


@pytest.mark.parametrize(
    ("frame", "options"),
    [
        (packet(ONE, Address.named("PC"), b""), {}),
        (packet(Address.named("PC"), TWO, b""), {}),
        (packet(NOBODY, TWO, b""), {}),
        (packet(ONE, Address.numbered(256), b""), {}),
        (packet(ONE, Address.named("PC"), b""), {"topology": "master-slave"}),
        (packet(ONE, TWO, b""), {"topology": "point-to-point", "remote": 7}),
        (packet(ONE, TWO, bytes(252)), {}),
        (packet(ONE, TWO, bytes(252)), {"fragment": True}),
        (packet(ONE, TWO, b"")._replace(protocol="psiu-ascii"), {}),
    ],
)
def test_what_no_packet_can_say_is_refused(frame: Frame, options: dict[str, Any]) -> None:
    with pytest.raises(EncodeError):
        hexa_codec(**options).encode(frame)


def test_a_named_sender_is_no_obstacle_where_the_sender_is_not_said() -> None:
    frame = packet(Address.named("PC"), Address.numbered(5), b"")
    assert hexa_codec(topology="master-slave").encode(frame) == with_check(b"\x05\x04")
    assert hexa_codec(topology="point-to-point", remote=5).encode(frame) == with_check(b"\x04")


def test_a_long_message_is_broken_and_whole_again() -> None:
    codec = hexa_codec(fragment=True)
    payload = join_fields([bytes(200), b"abc" * 60, b"", bytes(250)])
    wire = codec.encode(packet(ONE, TWO, payload))
    assert wire[2] == 255
    for pieces in ([wire], cut(wire)):
        (frame,) = read(codec, *pieces)
        assert isinstance(frame, Frame)
        assert (frame.source, frame.destination, frame.subject) == (ONE, TWO, "complex")
        assert (frame.payload, frame.wire) == (payload, wire)
    with pytest.raises(EncodeError):
        hexa_codec().encode(frame)  # a link that does not break messages cannot forward it


def test_a_long_message_may_pause_for_a_silence_but_not_beyond_its_deadline() -> None:
    codec = hexa_codec(fragment=True)
    wire = codec.encode(packet(ONE, TWO, join_fields([bytes(200), bytes(200)])))
    assert read(codec, wire[:255]) == []
    assert len(frames(read(codec, wire[255:], now=REASSEMBLY_S / 2))) == 1
    assert read(codec, wire[:255], now=2.0) == []
    assert codec.flush(2.0 + REASSEMBLY_S) == [Malformed("fragments", wire[:64], 255)]


def test_a_full_packet_goes_by_itself_where_messages_are_broken() -> None:
    codec = hexa_codec(fragment=True)
    full = join_fields([bytes(249)])
    wire = codec.encode(packet(ONE, TWO, full))
    assert [frame.payload for frame in frames(codec.decode(wire, 0.0))] == [full]


def test_the_codec_is_found_by_its_protocol() -> None:
    assert CODECS["psiu-hexa"] is PsiuHexa

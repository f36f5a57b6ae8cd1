import json
import time
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from psiu_broker.codecs.codec import Directory, Event
from psiu_broker.codecs.soccer import LIMITS, PRESETS, Soccer, byte_of, first_byte, rate_trouble, value_of
from psiu_broker.errors import EncodeError
from psiu_broker.frame import MALFORMED_KEPT, NOBODY, Address, Frame, Malformed

VECTORS: dict[str, Any] = json.loads((Path(__file__).parents[1] / "vectors" / "soccer.json").read_text())
PACKETS: list[dict[str, Any]] = VECTORS["packets"]
MIROSOT = bytes.fromhex("aa3e3efc7e030355")
DAMAGED = bytes.fromhex("aa363efc7e030355")


def soccer(**options: Any) -> Soccer:
    return Soccer(Soccer.Options(**options), Directory())


def read(codec: Soccer, *pieces: bytes) -> list[Event]:
    events: list[Event] = []
    for piece in pieces:
        events += codec.decode(piece, 0.0)
    events += codec.flush(0.0)
    assert not codec.pending
    return events


def shares(events: Sequence[Event]) -> list[tuple[int, str]]:
    return [(event.destination.number, event.payload.hex()) for event in events if isinstance(event, Frame)]


def reasons(events: Sequence[Event]) -> list[tuple[str, int]]:
    return [(event.reason, event.size) for event in events if isinstance(event, Malformed)]


def values(codec: Soccer, event: Event) -> list[int | None] | None:
    if isinstance(event, Malformed):
        return None
    return [value_of(byte, codec.options.byte_codec) for byte in event.payload]


def set_point(robot: int, payload: bytes, **fields: Any) -> Frame:
    return Frame(NOBODY, Address.numbered(robot), "rodas", payload, "soccer", **fields)


@pytest.mark.parametrize("vector", VECTORS["wheel_bytes"], ids=lambda v: v["byte"])
def test_each_wheel_byte_says_a_direction_and_a_speed(vector: dict[str, Any]) -> None:
    speed = -vector["speed"] if vector["reverse"] else vector["speed"]
    byte = int(vector["byte"], 16)
    assert value_of(byte, "mirosot") == speed
    if speed or not vector["reverse"]:
        assert byte_of(speed, "mirosot") == byte


def test_the_paper_s_example_is_62() -> None:
    example = VECTORS["paper_example"]
    assert byte_of(example["speed"], "mirosot") == int(example["byte"], 16) == 62


def test_three_quarters_of_all_bytes_have_wrong_check_bits() -> None:
    right = {int(vector["byte"], 16) for vector in VECTORS["wheel_bytes"]}
    assert {byte for byte in range(256) if value_of(byte, "mirosot") is not None} == right
    assert len(right) == 64


@pytest.mark.parametrize("vector", VECTORS["index"])
def test_a_robot_s_first_byte_is_where_the_paper_s_formula_says(vector: dict[str, Any]) -> None:
    assert first_byte(vector["address"], vector["num_bytes"]) == vector["first_byte"]


@pytest.mark.parametrize("vector", PACKETS, ids=lambda v: f"{v['preset']}-{v['hex'][:8]}")
class TestEachGoldenPacket:
    def test_whole(self, vector: dict[str, Any]) -> None:
        codec = soccer(preset=vector["preset"])
        wire = bytes.fromhex(vector["hex"])
        events = codec.decode(wire, 0.0)
        assert not codec.pending
        assert [values(codec, event) for event in events] == vector["robots"]
        for number, event in enumerate(events, 1):
            if isinstance(event, Frame):
                assert event.destination == Address.numbered(number)
                assert event.source == NOBODY
                assert event.subject == ("rodas" if vector["preset"] == "mirosot" else "bytes")
                assert (event.protocol, event.wire, event.dialect) == ("soccer", wire, codec.dialect)
            else:
                assert event.reason == "check"

    def test_byte_by_byte(self, vector: dict[str, Any]) -> None:
        wire = bytes.fromhex(vector["hex"])
        codec = soccer(preset=vector["preset"])
        assert read(codec, *(bytes((byte,)) for byte in wire)) == list(codec.decode(wire, 0.0))

    def test_with_noise_around(self, vector: dict[str, Any]) -> None:
        wire = bytes.fromhex(vector["hex"])
        codec = soccer(preset=vector["preset"])
        events = read(codec, b"\x00\x55\x01" + wire + wire + b"\x00\x55")
        inside = list(codec.decode(wire, 0.0))
        assert events == [
            Malformed("noise", b"\x00\x55\x01", 3), *inside, *inside, Malformed("noise", b"\x00\x55", 2)
        ]  # fmt: skip

    def test_encoded_again(self, vector: dict[str, Any]) -> None:
        codec = soccer(preset=vector["preset"])
        wire = bytes.fromhex(vector["hex"])
        heard = [event for event in codec.decode(wire, 0.0) if isinstance(event, Frame)]
        assert {codec.encode(frame) for frame in heard} == {wire}
        if None not in vector["robots"]:
            assert codec.packet([frame.payload for frame in heard]) == wire
        for frame in heard:
            alone = codec.encode(frame._replace(wire=b"", dialect=""))
            others = [s for s in shares(codec.decode(alone, 0.0)) if s[0] != frame.destination.number]
            assert (frame.destination.number, frame.payload.hex()) in shares(codec.decode(alone, 0.0))
            assert {payload for _, payload in others} <= {codec.rest.stop.hex()}


@pytest.mark.parametrize("name", PRESETS)
def test_each_preset_is_what_the_paper_says_of_the_team(name: str) -> None:
    expected = VECTORS["presets"][name]
    options = soccer(preset=name).options
    trailer, _, byte = expected["trailer"].partition(":")
    assert options.start == int(expected["start"], 16)
    assert (options.robots, options.bytes_per_robot) == (expected["robots"], expected["bytes_per_robot"])
    assert (options.trailer, getattr(options, trailer)) == (trailer, int(byte, 16))
    assert (options.byte_codec, options.baud) == (expected["byte_codec"], expected["baud"])
    assert options.packet_bytes == expected["bytes"]
    assert options.packet_bytes * 8 * 1000 / options.baud == pytest.approx(expected["ms_8bit"], abs=0.01)
    assert rate_trouble(options, options.baud) is None, "a preset works as it is"


def test_there_is_a_preset_for_each_team() -> None:
    assert set(PRESETS) == set(VECTORS["presets"])


def test_nothing_declared_is_the_mirosot_team() -> None:
    assert Soccer().options == Soccer.Options(preset="mirosot")


def test_any_field_of_a_preset_may_be_overridden() -> None:
    codec = soccer(preset="f180", robots=6, start=0x7E, trailer="none", byte_codec="int8")
    (first, *_, last) = codec.decode(b"\x7e" + bytes(range(24)), 0.0)
    assert values(codec, first) == [0, 1, 2, 3]
    assert isinstance(last, Frame)
    assert last.destination == Address.numbered(6)


def test_a_packet_of_one_s_own_is_declared_whole() -> None:
    codec = soccer(
        robots=2, bytes_per_robot=1, byte_codec="int8", start=1, trailer="end", end=2, baud=115200, rate_hz=50
    )
    assert shares(read(codec, b"\x01\xff\x7f\x02")) == [(1, "ff"), (2, "7f")]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"start": 0x3E}, "0x3E is also the mirosot byte of a wheel at speed 15"),
        ({"end": 0xFC}, "0xFC is also the mirosot byte of a wheel at speed -31"),
        ({"start": 0x81}, "choose a byte that is none, 0xAA is usual"),
        ({"preset": "f180", "byte_codec": "mirosot", "end": 0x03}, "0x55 is usual"),
        ({"preset": "nobody"}, "'mirosot', 'f180'"),
        ({"preset": ["mirosot"]}, "'mirosot', 'f180'"),
        ({"robots": 0}, "greater than or equal to 1"),
        ({"rate_hz": 1, "hold_s": 0.5}, "hold_s = 0.5 is shorter than two packets take at rate_hz = 1, 2 s; raise one"),
        ({"colour": "red"}, "Extra inputs"),
    ],
)
def test_a_packet_that_cannot_work_is_refused_and_says_why(options: dict[str, Any], says: str) -> None:
    with pytest.raises(ValidationError) as caught:
        Soccer.Options.model_validate_json(json.dumps(options), strict=True)
    assert says in str(caught.value)


def test_a_start_byte_that_is_data_is_told_at_its_own_option() -> None:
    with pytest.raises(ValidationError) as caught:
        soccer(start=0x3E)
    assert caught.value.errors()[0]["loc"] == ("start",)


def test_bytes_without_check_bits_may_look_like_the_start_byte() -> None:
    assert soccer(preset="f180", start=0x3E, end=0x3E).options.start == 0x3E
    assert soccer(trailer="fill", end=0x3E).options.end == 0x3E


def test_noise_before_the_start_byte_is_ignored() -> None:
    events = read(soccer(), b"\x00\x01\x02" + MIROSOT)
    assert reasons(events) == [("noise", 3)]
    assert len(shares(events)) == 3


def test_a_failed_check_bit_drops_that_robot_s_share_alone() -> None:
    events = read(soccer(), DAMAGED)
    assert events[0] == Malformed("check", b"\x36\x3e", 2)
    assert shares(events) == [(2, "fc7e"), (3, "0303")]


def test_a_packet_with_no_right_share_is_one_malformed() -> None:
    assert read(soccer(), b"\xaa" + bytes(6) + b"\x55") == [Malformed("check", b"\xaa" + bytes(6) + b"\x55", 8)]


def test_after_a_bad_end_byte_the_search_goes_on_from_the_next_start_byte() -> None:
    events = read(soccer(), MIROSOT[:5] + MIROSOT)
    assert reasons(events) == [("end", 5)]
    assert len(shares(events)) == 3
    assert [frame.wire for frame in events if isinstance(frame, Frame)] == [MIROSOT] * 3


def test_a_lost_byte_costs_one_packet() -> None:
    events = read(soccer(), MIROSOT[:4] + MIROSOT[5:] + MIROSOT * 2)
    assert reasons(events) == [("end", 7)]
    assert len(shares(events)) == 6


def test_a_fill_byte_may_have_any_value() -> None:
    assert shares(read(soccer(preset="guarana"), bytes.fromhex("aa0a0b0cff"))) == [(1, "0a"), (2, "0b"), (3, "0c")]


def test_a_silence_drops_half_a_packet() -> None:
    codec = soccer()
    codec.decode(MIROSOT[:4], 0.0)
    assert codec.pending
    assert codec.flush(0.1) == [Malformed("unfinished", MIROSOT[:4], 4)]
    assert not codec.pending
    assert len(shares(codec.decode(MIROSOT, 0.2))) == 3


@pytest.mark.parametrize(
    ("options", "silence_s"),
    [({}, 0.005), ({"preset": "guarana"}, 50 / 1200), ({"preset": "cendori"}, 0.025), ({"silence_ms": 20}, 0.02)],
)
def test_the_silence_is_five_characters_and_at_least_5_ms(options: dict[str, Any], silence_s: float) -> None:
    assert soccer(**options).silence_s == pytest.approx(silence_s)


@pytest.mark.parametrize(
    ("frame", "says"),
    [
        (set_point(4, b"\x3e\x3e"), "0x04 is not in this team, whose robots are 1–3"),
        (set_point(0, b"\x3e\x3e"), "0x00 is not in this team"),
        (set_point(1, b"\x3e\x3e")._replace(destination=NOBODY), "nobody is not in this team"),
        (set_point(1, b"\x3e"), "a robot's share has 2 bytes, not 1"),
        (set_point(1, b"\x3e\x36"), "0x3e36: its check bits are wrong"),
        (set_point(1, b"\x3e\x3e")._replace(protocol="psiu-hexa"), "a frame of psiu-hexa cannot be sent as soccer"),
        (set_point(1, b"\x3e\x3e", dialect="soccer/aa-3x2-end55/raw"), "do not mean the same as mirosot ones"),
    ],
)
def test_what_is_no_set_point_of_the_team_cannot_be_sent(frame: Frame, says: str) -> None:
    with pytest.raises(EncodeError) as caught:
        soccer().encode(frame)
    assert says in str(caught.value)


def test_a_set_point_of_another_team_with_such_bytes_can_be_sent() -> None:
    wide = soccer(robots=5)
    (first, *_) = wide.decode(wide.packet([b"\x3e\x3e"] * 5), 0.0)
    assert isinstance(first, Frame)
    assert soccer().encode(first) == bytes.fromhex("aa3e3e0303030355")


def test_a_robot_is_found_by_its_number_in_whatever_domain() -> None:
    frame = set_point(2, b"\x3e\x3e")._replace(destination=Address.numbered(2, "time"))
    assert soccer().encode(frame) == bytes.fromhex("aa03033e3e030355")


@pytest.mark.parametrize("given_shares", [[], [b"\x03\x03"] * 2, [b"\x03\x03"] * 4, [b"\x03"] * 3, [b"\x00\x00"] * 3])
def test_a_packet_is_made_of_one_right_share_for_each_robot(given_shares: list[bytes]) -> None:
    with pytest.raises(EncodeError):
        soccer().packet(given_shares)


def test_a_rate_that_the_line_cannot_carry_is_told_with_the_arithmetic() -> None:
    assert rate_trouble(soccer(preset="f180").options, 4800) == (
        "30 packets/s × 22 bytes × 10 bits = 6600 bit/s, the line carries 4800;"
        " lower rate_hz to 21 or use a line of at least 6600 bit/s"
    )


@pytest.mark.parametrize(
    ("preset", "rate_hz", "bits_per_second", "fits"),
    [
        ("mirosot", 30, 2400, True),
        ("mirosot", 30, 2399, False),
        ("mirosot", 30, None, True),
        ("cendori", 30, 2000, False),
        ("cendori", 11, 2000, True),
        ("guarana", 30, 1200, False),
        ("guarana", 24, 1200, True),
    ],
)
def test_a_character_takes_ten_bits(preset: str, rate_hz: float, bits_per_second: int | None, fits: bool) -> None:
    assert (rate_trouble(soccer(preset=preset, rate_hz=rate_hz).options, bits_per_second) is None) == fits


@given(
    robots=st.integers(1, 255),
    size=st.integers(1, 64),
    rate_hz=st.floats(0.01, 1000),
    bits_per_second=st.integers(1, 4_000_000),
)
def test_the_advice_about_a_rate_can_be_followed(robots: int, size: int, rate_hz: float, bits_per_second: int) -> None:
    options = soccer(robots=robots, bytes_per_robot=size, rate_hz=rate_hz, hold_s=3600).options
    trouble = rate_trouble(options, bits_per_second)
    if trouble is None:
        return
    _, lower, advice = trouble.partition("lower rate_hz to ")
    if lower:
        slower = options.model_copy(update={"rate_hz": float(advice.split()[0])})
        assert rate_trouble(slower, bits_per_second) is None
    faster = int(trouble.rpartition("at least ")[2].split()[0])
    assert rate_trouble(options, faster) is None


teams = st.fixed_dictionaries(
    {
        "preset": st.sampled_from(sorted(PRESETS)),
        "robots": st.integers(1, 6),
        "bytes_per_robot": st.integers(1, 4),
        "byte_codec": st.sampled_from(sorted(LIMITS)),
        "trailer": st.sampled_from(["end", "fill", "none"]),
    }
)


@st.composite
def packets(draw: st.DrawFn, codec: Soccer) -> bytes:
    low, high = LIMITS[codec.options.byte_codec]
    value = st.integers(low, high).map(lambda each: byte_of(each, codec.options.byte_codec))
    size = codec.options.bytes_per_robot
    share = st.lists(value, min_size=size, max_size=size).map(bytes)
    return codec.packet(draw(st.lists(share, min_size=codec.robots, max_size=codec.robots)))


@st.composite
def streams(draw: st.DrawFn) -> tuple[dict[str, Any], bytes]:
    options = draw(teams)
    junk = st.one_of(st.binary(max_size=8), st.lists(st.sampled_from([0xAA, 0x55, 0x03]), max_size=8).map(bytes))
    data = bytearray(b"".join(draw(st.lists(st.one_of(packets(soccer(**options)), junk), max_size=8))))
    for place in draw(st.lists(st.integers(0, 200), max_size=2)):
        if place < len(data):
            data[place] ^= 1 << draw(st.integers(0, 7))
    return options, bytes(data)


@given(data=st.data(), options=teams)
def test_what_is_encoded_is_decoded_as_it_was(data: st.DataObject, options: dict[str, Any]) -> None:
    codec = soccer(**options)
    wire = data.draw(packets(codec))
    events = read(codec, wire)
    assert [event.destination.number for event in events if isinstance(event, Frame)] == [*range(1, codec.robots + 1)]
    assert codec.packet([event.payload for event in events if isinstance(event, Frame)]) == wire


@given(stream=streams(), cuts=st.lists(st.integers(0, 200), max_size=10))
def test_any_cut_of_the_bytes_gives_the_same_events(stream: tuple[dict[str, Any], bytes], cuts: list[int]) -> None:
    options, data = stream
    places = [0, *sorted(place for place in cuts if place < len(data)), len(data)]
    pieces = [data[start:end] for start, end in pairwise(places)]
    assert read(soccer(**options), *pieces) == read(soccer(**options), data)
    assert read(soccer(**options), *(bytes((byte,)) for byte in data)) == read(soccer(**options), data)


@given(options=teams, pieces=st.lists(st.binary(max_size=300), max_size=8))
def test_nothing_is_raised_and_every_byte_is_accounted_for(options: dict[str, Any], pieces: list[bytes]) -> None:
    codec = soccer(**options)
    length = codec.options.packet_bytes
    counted = 0
    robot = 0
    for event in read(codec, *pieces):
        if isinstance(event, Frame):
            assert len(event.wire) == length
            robot = event.destination.number
        elif event.reason == "check" and event.size < length:
            robot += 1
        else:
            assert event.reason in {"noise", "end", "unfinished", "check"}
            assert 0 < len(event.wire) == min(event.size, MALFORMED_KEPT)
            counted += event.size
            continue
        if robot == codec.robots:
            counted += length
            robot = 0
    assert counted == len(b"".join(pieces))


def test_endless_noise_is_reported_in_pieces_and_held_in_none() -> None:
    codec = soccer()
    events = [event for _ in range(20) for event in codec.decode(bytes(1000), 0.0)]
    assert sum(size for _, size in reasons(events)) >= 16_000
    assert len(codec._buffer) == 0


@pytest.mark.parametrize("byte", [0xAA, 0x00, 0x55])
def test_reading_takes_time_in_proportion_to_the_bytes(byte: int) -> None:
    codec = soccer(robots=255, bytes_per_robot=64)
    data = bytes((byte,)) * 300_000
    began = time.perf_counter()
    for at in range(0, len(data), 10):
        codec.decode(data[at : at + 10], 0.0)
    assert time.perf_counter() - began < 5
    assert len(codec._buffer) <= codec.options.packet_bytes

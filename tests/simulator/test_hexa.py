import random

import pytest

from psiu_broker.simulator import HexaRobot
from psiu_broker.simulator.hexa import complex_fields, complex_payload

ACK, NAK, BUSY, AVAILABLE, FREE, WTF = 65, 78, 66, 63, 70, 87


def answers(robot: HexaRobot, text: str, now: float = 0.0) -> str:
    return " ".join(reply.hex() for _, reply in robot.receive(bytes.fromhex(text), now))


def ask(robot: HexaRobot, *payload: int, now: float = 0.0, source: int = 1) -> list[bytes]:
    """The payloads that an ad-hoc SMBUS `robot` answers to `source`."""
    asker = HexaRobot(source)
    wire = asker.packet(robot.address, bytes(payload))
    return [reply[3:-1] for _, reply in robot.receive(wire, now)]


@pytest.mark.parametrize(
    ("heard", "answer"),
    [
        ("0102045d", "020104df"),  # ping
        ("0102060480ee", "02010541c6"),  # actuator
        ("010206070058", "020106002a79"),  # sensor
        ("0102053f3c", "02010546d3"),  # AVAIL?
        ("0102070101555d", "02010701015580"),  # complex echo
        ("0102060480ef", "0201054eeb"),  # bad CRC
    ],
)
def test_the_robot_answers_the_exact_bytes(heard: str, answer: str) -> None:
    assert answers(HexaRobot(2), heard) == answer
    one = HexaRobot(2)
    assert "".join(answers(one, heard[i : i + 2]) for i in range(0, len(heard), 2)) == answer


@pytest.mark.parametrize(
    ("crc", "check"),
    [
        ("smbus", "85"),
        ("maxim-dow", "c2"),
        ("dvb-s2", "6e"),
        ("nrsc-5", "b5"),
        ("xor", "86"),
        ("sum", "8c"),
        ("negsum", "74"),
        ("none", ""),
    ],
)
def test_every_crc_is_read_and_written(crc: str, check: str) -> None:
    robot = HexaRobot(2, crc=crc)  # type: ignore[arg-type]
    assert HexaRobot(1, crc=crc).node(2, 3, 128).hex() == "0102060380" + check  # type: ignore[arg-type]
    (reply,) = robot.receive(bytes.fromhex("0102060380" + check), 0.0)
    assert reply[1].hex().startswith("02010541")
    assert robot.signals[3] == 128


@pytest.mark.parametrize(
    ("topology", "size", "heard", "answer"),
    [
        ("master-slave", "nominal", "05045d", "05045d"),
        ("master-slave", "nominal", "050603ffff", "050541"),
        ("master-slave", "real", "050503ff42", "050441"),
        ("point-to-point", "nominal", "041c", "041c"),
        ("point-to-point", "nominal", "06010a5e", "054181"),
        ("point-to-point", "real", "04010a88", "0341"),
    ],
)
def test_every_topology_and_size_is_spoken(topology: str, size: str, heard: str, answer: str) -> None:
    robot = HexaRobot(5, topology=topology, size=size)  # type: ignore[arg-type]
    assert answers(robot, heard).startswith(answer)
    assert len(robot.heard) == 1


@pytest.mark.parametrize(
    ("topology", "damaged", "complains"),
    [
        ("ad-hoc", "0102060480ef", True),
        ("ad-hoc", "0103060480ef", False),
        ("ad-hoc", "010205414f", False),
        ("master-slave", "020603ff00", True),
        ("point-to-point", "06010a5f", True),
        ("point-to-point", "054e00", False),
        ("point-to-point", "055700", False),
    ],
)
def test_a_bad_crc_is_answered_nak_where_the_topology_tells_that_we_are_meant(
    topology: str, damaged: str, complains: bool
) -> None:
    robot = HexaRobot(2, topology=topology)  # type: ignore[arg-type]
    replies = robot.receive(bytes.fromhex(damaged), 0.0)
    assert [reply[-2] for _, reply in replies] == ([NAK] if complains else [])
    assert robot.signals[4] == 0


def test_a_packet_for_another_robot_is_ignored() -> None:
    robot = HexaRobot(2)
    assert answers(robot, HexaRobot(1).ping(3).hex()) == ""
    assert answers(robot, "0102045d") == "020104df"


@pytest.mark.parametrize("size", ["00", "01", "02", "03"])
def test_a_size_below_four_is_no_packet(size: str) -> None:
    robot = HexaRobot(2)
    assert answers(robot, f"0102{size}") == ""
    assert answers(robot, "0102045d") == "020104df"


def test_a_half_packet_is_forgotten_after_a_silence() -> None:
    robot = HexaRobot(2)
    assert answers(robot, "010206", 0.0) == ""
    assert answers(robot, "0102045d", 0.2) == "020104df"


def test_what_is_impossible_is_answered_wtf() -> None:
    robot = HexaRobot(2, commands=[200])
    assert ask(robot, 99, 0) == [bytes([WTF])]
    assert ask(robot, 0, 5) == [bytes([WTF])]
    assert ask(robot, 201) == [bytes([WTF])]
    assert ask(robot, 200) == [bytes([ACK])]
    assert ask(robot, 1, 2, 0) == [bytes([WTF])]
    assert ask(robot, 0, 2, 0) == [bytes([WTF])]


@pytest.mark.parametrize("command", [ACK, BUSY, FREE, WTF])
def test_an_answer_is_never_answered(command: int) -> None:
    assert ask(HexaRobot(2), command) == []


def test_busy_robots_say_busy_until_they_are_free_and_still_answer_pings() -> None:
    robot = HexaRobot(2, busy_s=1.0)
    assert ask(robot, 4, 10, now=0.0) == [bytes([ACK])]
    assert ask(robot, 4, 20, now=0.5) == [bytes([BUSY])]
    assert ask(robot, AVAILABLE, now=0.6) == [bytes([BUSY])]
    assert ask(robot, 1, 1, 85, now=0.7) == [bytes([BUSY])]
    assert ask(robot, now=0.8) == [b""]
    assert ask(robot, AVAILABLE, now=1.0) == [bytes([FREE])]
    assert robot.signals[4] == 10
    assert ask(robot, 4, 20, now=1.1) == [bytes([ACK])]


def test_a_nak_makes_the_robot_repeat_its_last_packet_three_times_at_most() -> None:
    robot = HexaRobot(2)
    assert ask(robot, NAK) == []
    assert ask(robot, 7, 0) == [bytes([0, 42])]
    assert [ask(robot, NAK) for _ in range(4)] == [[bytes([0, 42])]] * 3 + [[]]
    assert ask(robot, 7, 0) == [bytes([0, 42])]
    assert ask(robot, NAK, source=9) == []
    assert ask(robot, NAK) == [bytes([0, 42])]


def test_a_sensor_may_mark_its_answer_in_bit_seven() -> None:
    assert ask(HexaRobot(2, sensor_reply="bit7"), 7, 0) == [bytes([0x87, 42])]


def test_robots_ask_each_other_without_answering_answers() -> None:
    one, two = HexaRobot(1), HexaRobot(2)
    for wire, subject in [
        (one.ping(2), "ping"),
        (one.node(2, 7), "node/0"),
        (one.node(2, 4, 9), "ack"),
        (one.packet(2, complex_payload([b"abc"])), "complex"),
    ]:
        ((_, reply),) = two.receive(wire, 0.0)
        assert one.receive(reply, 0.0) == []
        assert (one.heard[-1].source, one.heard[-1].subject) == ("0x02", subject)
    assert ask(one, 0, 5, source=2) == [bytes([WTF])]


def test_an_answer_is_expected_only_once() -> None:
    sensor, actuator, echo = (HexaRobot(1) for _ in range(3))
    sensor.node(2, 7)
    assert ask(sensor, 0, 5, source=2) == []
    assert ask(sensor, 0, 5, source=2) == [bytes([WTF])]
    actuator.node(2, 4, 9)
    assert ask(actuator, ACK, source=2) == []
    assert ask(actuator, 0, 5, source=2) == [bytes([WTF])]
    message = complex_payload([b"abc"])
    echo.packet(2, message)
    assert ask(echo, *message, source=2) == []
    assert ask(echo, *message, source=2) == [message]


def test_what_it_heard_is_kept_in_words() -> None:
    robot = HexaRobot(2)
    for payload in [(), (AVAILABLE,), (200,), (4, 9), (2, 1, 2, 0xAA, 0xBB, 0xCC)]:
        ask(robot, *payload)
    assert [(h.subject, h.parameters) for h in robot.heard] == [
        ("ping", ()),
        ("available", ()),
        ("command/200", ()),
        ("node/4", ("9",)),
        ("complex", ("aa", "bbcc")),
    ]


@pytest.mark.parametrize("length", [252, 502, 503, 1000])
def test_a_long_message_travels_in_pieces_and_comes_back_whole(length: int) -> None:
    one, two = HexaRobot(1, fragment=True), HexaRobot(2, fragment=True)
    fields = [bytes(100)] * ((length - 255) // 101 if length > 500 else 1)
    rest = length - 1 - len(fields) * 101 - 1
    while rest > 255:
        fields, rest = [*fields, bytes(100)], rest - 101
    payload = complex_payload([*fields, bytes(rest)])
    assert len(payload) == length
    ((_, reply),) = two.receive(one.packet(2, payload), 0.0)
    assert reply[2] == 255
    assert one.receive(reply, 0.0) == []
    assert one.heard[-1].parameters == tuple(field.hex() for field in complex_fields(payload) or ())


def test_a_complete_packet_of_the_longest_payload_is_no_piece() -> None:
    payload = complex_payload([bytes(249)])
    assert ask(HexaRobot(2, fragment=True), *payload) == [payload]


def test_without_fragments_a_long_message_is_refused() -> None:
    with pytest.raises(ValueError, match="252 bytes"):
        HexaRobot(1).packet(2, bytes(252))


def test_pieces_that_stop_are_forgotten() -> None:
    one, two = HexaRobot(1, fragment=True), HexaRobot(2, fragment=True)
    wire = one.packet(2, complex_payload([bytes(200), bytes(200)]))
    assert two.receive(wire[:255], 0.0) == []
    ((_, reply),) = two.receive(wire[255:], 2.0)
    assert reply[3:-1] == bytes([WTF])


@pytest.mark.parametrize(
    "options",
    [{"address": 256}, {"actuators": [0]}, {"sensors": {1: 256}}, {"topology": "ring"}, {"crc": "md5"}, {"size": "x"}],
)
def test_a_robot_that_cannot_be_is_refused(options: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"256|0|no topology|no crc|no size"):
        HexaRobot(**({"address": 2} | options))  # type: ignore[arg-type]


def test_telemetry_lists_every_node() -> None:
    robot = HexaRobot(2, actuators=[4], sensors={7: 42}, master=1)
    assert robot.telemetry()[:3].hex() == "02010b"
    assert complex_fields(robot.telemetry()[3:-1]) == [b"\x04\x00", b"\x07\x2a"]


@pytest.mark.parametrize("topology", ["ad-hoc", "master-slave", "point-to-point"])
@pytest.mark.parametrize("crc", ["smbus", "none"])
def test_no_bytes_make_the_robot_raise(topology: str, crc: str) -> None:
    luck = random.Random(1)
    robot = HexaRobot(2, topology=topology, crc=crc, fragment=True)  # type: ignore[arg-type]
    for n in range(300):
        robot.receive(luck.randbytes(luck.randrange(1, 300)), n * 0.05)

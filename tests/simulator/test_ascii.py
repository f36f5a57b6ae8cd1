import random

import pytest

from psiu_broker.simulator import QUIRKS, AsciiRobot, Extra, Position

FORWARD = b"MNERIM 034 parafrente 100 PC 02123"
DISCOVERY = b"?? 027 qualseunome PC 01753"
COUNT = b"MNERIM 035 quantoscomandos PC 02514"
COMPLAINT = b"CHECKSUM NAO BATEU!\r\n"


def frame(destination: str, *words: object, source: str = "PC") -> bytes:
    rest = f" {' '.join(map(str, words))} {source} "
    body = f"{destination} {len(destination) + len(rest) + 9:03d}{rest}".encode("latin-1")
    return body + f"{sum(body) % 65536:05d}".encode()


def answers(robot: AsciiRobot, data: bytes, now: float = 0.0) -> list[bytes]:
    return [reply for _, reply in robot.receive(data, now)]


def test_the_frames_of_these_tests_are_those_of_the_document() -> None:
    assert frame("MNERIM", "parafrente", 100) == FORWARD
    assert frame("??", "qualseunome") == DISCOVERY


@pytest.mark.parametrize(
    ("heard", "answer"),
    [
        (FORWARD, b"PC 038 parafrente sucesso MNERIM 02755"),
        (b"MNERIM 032 paratras 100 PC 01919", b"PC 036 paratras sucesso MNERIM 02551"),
        (b"MNERIM 035 giradireita 100 PC 02217", b"PC 039 giradireita sucesso MNERIM 02849"),
        (b"MNERIM 036 giraesquerda 100 PC 02338", b"PC 040 giraesquerda sucesso MNERIM 02961"),
        (COUNT, b"PC 037 quantoscomandos 7 MNERIM 02603"),
        (b"MNERIM 034 exibecomando 1 PC 02225", b"PC 049 exibecomando parafrente 1 0 0 MNERIM 03487"),
        (frame("MNERIM", "exibecomando", 5), b"PC 054 exibecomando quantoscomandos 0 0 0 MNERIM 04049"),
        (DISCOVERY, b"PC 031 qualseunome MNERIM 02078"),
        (frame("MNERIM", "qualseunome"), b"PC 031 qualseunome MNERIM 02078"),
        (frame("MNERIM", "parafrente", 1000), b"PC 036 parafrente falha MNERIM 02488"),
        (frame("MNERIM", "paratras", -1), b"PC 034 paratras falha MNERIM 02284"),
        (frame("MNERIM", "giradireita", 361), b"PC 037 giradireita falha MNERIM 02582"),
        (frame("MNERIM", "giraesquerda"), b"PC 038 giraesquerda falha MNERIM 02703"),
        (frame("MNERIM", "parafrente", 1, 2), b"PC 036 parafrente falha MNERIM 02488"),
        (frame("MNERIM", "parafrente", "x"), b"PC 036 parafrente falha MNERIM 02488"),
        (frame("MNERIM", "exibecomando", 0), frame("PC", "exibecomando", "falha", source="MNERIM")),
        (frame("MNERIM", "exibecomando", 8), frame("PC", "exibecomando", "falha", source="MNERIM")),
        (frame("MNERIM", "dance"), frame("PC", "dance", "falha", source="MNERIM")),
    ],
)
def test_the_robot_answers_the_exact_bytes_of_the_document(heard: bytes, answer: bytes) -> None:
    assert answers(AsciiRobot("MNERIM"), heard) == [answer]
    one = AsciiRobot("MNERIM")
    assert [reply for byte in heard for reply in answers(one, bytes([byte]))] == [answer]


@pytest.mark.parametrize(
    "heard", [b"?? 029 qualseunome PC 01755", b"?? 024 qualseunome PC 01750", b"\r\n " + DISCOVERY]
)
def test_the_sum_alone_is_the_judge(heard: bytes) -> None:
    assert answers(AsciiRobot("MNERIM"), heard) == [b"PC 031 qualseunome MNERIM 02078"]


@pytest.mark.parametrize(
    "heard",
    [
        b"MNERIM 034 parafrente 200 PC 02123",
        b"MNERIM 034 parafrente 100 PC 02124",
        b"MNERIM 034 parafrente 100 PC 02x23",
        frame("OUTRO", "parafrente", 100),
        frame("??", "parafrente", 100),
        frame("MNERIM", "parafrente", 100, source="MNERIM"),
    ],
)
def test_a_bad_or_foreign_frame_is_ignored_and_the_next_one_is_read(heard: bytes) -> None:
    robot = AsciiRobot("MNERIM")
    assert answers(robot, heard) == []
    assert robot.position == Position()
    assert answers(robot, FORWARD) == [b"PC 038 parafrente sucesso MNERIM 02755"]


def test_a_half_frame_is_forgotten_after_a_silence() -> None:
    robot = AsciiRobot("MNERIM")
    assert answers(robot, FORWARD[:20], 0.0) == []
    assert answers(robot, FORWARD, 1.0) == [b"PC 038 parafrente sucesso MNERIM 02755"]


def test_a_frame_of_a_thousand_bytes_is_given_up() -> None:
    robot = AsciiRobot("MNERIM")
    assert answers(robot, b"x" * 5000) == []
    robot.boundary()
    assert len(answers(robot, FORWARD)) == 1


def test_an_answer_that_would_not_fit_is_not_sent() -> None:
    robot = AsciiRobot("MNERIM")
    assert answers(robot, frame("MNERIM", "z" * 970)) == []


def test_names_may_have_spaces() -> None:
    robot = AsciiRobot("ROBO UM")
    assert answers(robot, b"ROBO UM 033 parafrente 7 PC 02076") == [b"PC 039 parafrente sucesso ROBO UM 02800"]


def test_a_motion_takes_its_time_and_the_next_one_waits_for_it() -> None:
    robot = AsciiRobot("MNERIM", per_unit_s=0.01, answer_s=0.0)
    (first,) = robot.receive(FORWARD, 10.0)
    (second,) = robot.receive(frame("MNERIM", "giraesquerda", 90), 10.2)
    assert (first[0], second[0]) == (pytest.approx(1.0), pytest.approx(0.8 + 0.9))
    robot.advance(10.5)
    assert robot.position.x == pytest.approx(50)
    robot.advance(11.45)
    assert robot.position.heading == pytest.approx(45)
    robot.advance(10.2 + second[0])
    assert robot.position == (100, 0, 90)


def test_the_position_follows_turns_and_both_directions() -> None:
    robot = AsciiRobot("MNERIM")
    for command, amount in [("parafrente", 100), ("giradireita", 90), ("paratras", 30), ("giraesquerda", 180)]:
        assert answers(robot, frame("MNERIM", command, amount))
    robot.advance(60.0)
    assert robot.position == (100, 30, 90)


@pytest.mark.parametrize(
    ("command", "greatest"), [("parafrente", 999), ("paratras", 999), ("giradireita", 360), ("giraesquerda", 360)]
)
def test_every_motion_has_the_range_of_the_document(command: str, greatest: int) -> None:
    robot = AsciiRobot("MNERIM")
    for amount, word in [(0, "sucesso"), (greatest, "sucesso"), (greatest + 1, "falha")]:
        assert answers(robot, frame("MNERIM", command, amount)) == [frame("PC", command, word, source="MNERIM")]


def test_a_robot_answers_everyone_at_a_random_time_but_its_own_name_at_once() -> None:
    robot = AsciiRobot("MNERIM", wildcard_delay_s=0.05)
    delays = [robot.receive(DISCOVERY, float(n))[0][0] for n in range(100)]
    assert len(set(delays)) == 100
    assert 0 <= min(delays) < 0.01
    assert 0.04 < max(delays) <= 0.05
    assert robot.receive(frame("MNERIM", "qualseunome"), 200.0)[0][0] == 0
    again = AsciiRobot("MNERIM", wildcard_delay_s=0.05)
    assert [again.receive(DISCOVERY, float(n))[0][0] for n in range(100)] == delays


def test_extra_commands_are_listed_checked_and_answered() -> None:
    extras = [Extra.parse("distancia:0=42"), Extra.parse("braco:1,1,1"), Extra.parse("pare")]
    robot = AsciiRobot("MNERIM", extras=extras)
    assert answers(robot, COUNT) == [frame("PC", "quantoscomandos", 10, source="MNERIM")]
    shown = frame("PC", "exibecomando", "braco", 1, 1, 1, source="MNERIM")
    assert answers(robot, frame("MNERIM", "exibecomando", 9)) == [shown]
    assert answers(robot, frame("MNERIM", "distancia")) == [frame("PC", "distancia", 42, source="MNERIM")]
    assert answers(robot, frame("MNERIM", "pare")) == [frame("PC", "pare", "sucesso", source="MNERIM")]
    done = [frame("PC", "braco", "sucesso", source="MNERIM")]
    refused = [frame("PC", "braco", "falha", source="MNERIM")]
    assert answers(robot, frame("MNERIM", "braco", -3, 1.25, "x")) == done
    assert answers(robot, frame("MNERIM", "braco", 1.5, 1.25, "x")) == refused
    assert answers(robot, frame("MNERIM", "braco", 12345, 67890, "x")) == done


@pytest.mark.parametrize("text", ["", ":1", "a b", "a:x", "a:1,2,3,4", "a:-1", "a:0=é"])
def test_an_extra_command_that_cannot_be_read_says_what_it_should_be(text: str) -> None:
    with pytest.raises(ValueError, match="is not NAME:INTS"):
        Extra.parse(text)


def test_a_robot_that_cannot_be_is_refused() -> None:
    with pytest.raises(ValueError, match="robot's name"):
        AsciiRobot("two  spaces")
    with pytest.raises(ValueError, match="no quirk 'clrf'"):
        AsciiRobot("MNERIM", quirks=["clrf"])  # type: ignore[list-item]


def test_what_it_heard_is_kept_in_words_and_bounded() -> None:
    robot = AsciiRobot("MNERIM")
    robot.receive(FORWARD, 3.0)
    assert robot.heard == [(3.0, "PC", "parafrente", ("100",))]
    for _ in range(2500):
        robot.receive(DISCOVERY, 4.0)
    assert len(robot.heard) <= 2000


def test_robots_order_each_other_without_answering_answers() -> None:
    alfa, beta = AsciiRobot("ALFA"), AsciiRobot("BETA", extras=[Extra.parse("distancia:0=42")])
    for words in [("parafrente", 50), ("distancia",), ("qualseunome",), ("quantoscomandos",)]:
        (reply,) = answers(beta, alfa.command("BETA", *words))
        assert answers(alfa, reply) == []
        assert alfa.heard[-1].source == "BETA"
        assert alfa.heard[-1].subject == words[0]
    (reply,) = answers(beta, alfa.command("??", "qualseunome"))
    assert answers(alfa, reply) == []
    assert answers(alfa, beta.command("ALFA", "qualseunome")) == [frame("BETA", "qualseunome", source="ALFA")]


def test_telemetry_tells_where_the_robot_is() -> None:
    robot = AsciiRobot("MNERIM", telemetry_s=1.0)
    robot.receive(FORWARD, 0.0)
    robot.advance(1.0)
    assert robot.telemetry() == frame("PC", "posicao", 100, 0, 0, source="MNERIM")


def test_every_quirk_is_explained() -> None:
    assert all(QUIRKS.values())
    AsciiRobot("MNERIM", quirks=QUIRKS)


def test_quirk_crlf_ends_every_frame_in_crlf() -> None:
    robot = AsciiRobot("MNERIM", quirks={"crlf"})
    assert answers(robot, FORWARD) == [b"PC 038 parafrente sucesso MNERIM 02755\r\n"]


def test_quirk_junk_begins_after_the_first_count() -> None:
    robot = AsciiRobot("MNERIM", quirks={"junk", "crlf"})
    assert answers(robot, COUNT) == [b"PC 037 quantoscomandos 7 MNERIM 02603\r\n"]
    shown = answers(robot, b"MNERIM 034 exibecomando 1 PC 02225")
    assert shown == [b"7 PC 049 exibecomando parafrente 1 0 0 MNERIM 03487\r\n"]


def test_quirk_wrong_size_keeps_the_checksum_right() -> None:
    (reply,) = answers(AsciiRobot("MNERIM", quirks={"wrong_size"}), FORWARD)
    assert reply == b"PC 036 parafrente sucesso MNERIM 02753"
    assert sum(reply[:-5]) == 2753


def test_quirk_unpadded_has_no_leading_zeros() -> None:
    (reply,) = answers(AsciiRobot("MNERIM", quirks={"unpadded"}), FORWARD)
    assert reply == b"PC 038 parafrente sucesso MNERIM 2755"


def test_quirk_complains_says_so_and_reads_the_next_frame() -> None:
    robot = AsciiRobot("MNERIM", quirks={"complains"})
    assert answers(robot, b"MNERIM 034 parafrente 100 PC 02124") == [COMPLAINT]
    assert answers(robot, b"OUTRO 034 parafrente 100 PC 02124") == []
    assert len(answers(robot, FORWARD)) == 1


def test_quirk_loses_next_loses_exactly_one_frame_after_a_wrong_checksum() -> None:
    robot = AsciiRobot("MNERIM", quirks={"complains", "loses_next"})
    assert answers(robot, b"MNERIM 034 parafrente 100 PC 02124") == [COMPLAINT]
    assert answers(robot, FORWARD) == []
    assert len(answers(robot, FORWARD)) == 1


@pytest.mark.parametrize("words", [("parafrente",), ("dance",), ("parafrente", 1, 2)])
def test_quirk_silent_errors_says_nothing_and_loses_the_next_frame(words: tuple[object, ...]) -> None:
    robot = AsciiRobot("MNERIM", quirks={"silent_errors"})
    assert answers(robot, frame("MNERIM", *words)) == []
    assert answers(robot, FORWARD) == []
    assert len(answers(robot, FORWARD)) == 1


@pytest.mark.parametrize("end", [b"\r", b"\n", b"\r\n"])
def test_quirk_ruined_by_crlf_loses_the_frame_after_a_line_end(end: bytes) -> None:
    robot = AsciiRobot("MNERIM", quirks={"ruined_by_crlf", "complains"})
    assert len(answers(robot, FORWARD + end)) == 1
    assert answers(robot, FORWARD) == [COMPLAINT]
    assert len(answers(robot, FORWARD)) == 1
    assert len(answers(AsciiRobot("MNERIM"), FORWARD + end + FORWARD)) == 2


def test_quirk_avr_has_no_room_for_long_words_and_large_sums() -> None:
    robot = AsciiRobot("MNERIM", quirks={"avr", "complains"})
    whole = AsciiRobot("MNERIM")
    for heard, answer in [
        (frame("MNERIM", "z" * 20), []),
        (frame("MNERIM", "z" * 19), [frame("PC", "z" * 19, "falha", source="MNERIM")]),
        (frame("MNERIM", *["zzzzzzzzz"] * 30), [COMPLAINT]),
    ]:
        assert answers(robot, heard) == answer
        assert len(answers(whole, heard)) == 1
    assert sum(frame("MNERIM", *["zzzzzzzzz"] * 30)[:-5]) > 32767


def test_quirk_answers_any_obeys_whoever_is_meant() -> None:
    robot = AsciiRobot("MNERIM", quirks={"answers_any"})
    assert answers(robot, frame("OUTRO", "parafrente", 100)) == [b"PC 038 parafrente sucesso MNERIM 02755"]


@pytest.mark.parametrize("index", [0, 8, 999])
def test_quirk_odd_index_answers_garbage_with_a_right_checksum(index: int) -> None:
    (reply,) = answers(AsciiRobot("MNERIM", quirks={"odd_index"}), frame("MNERIM", "exibecomando", index))
    assert b"\x03\xb2(" in reply
    assert int(reply[-5:]) == sum(reply[:-5]) % 65536


def test_no_bytes_make_the_robot_raise() -> None:
    luck = random.Random(1)
    alphabet = b"MNERIM?? 0123456789 parafrente PC\r\n\xff\xb2\x00"
    for quirks in ([], list(QUIRKS)):
        robot = AsciiRobot("MNERIM", quirks=quirks)
        for n in range(300):
            robot.receive(bytes(luck.choices(alphabet, k=60)), n * 0.1)
            damaged = bytearray(FORWARD)
            damaged[luck.randrange(len(damaged))] = luck.randrange(256)
            robot.receive(bytes(damaged), n * 0.1)


def test_two_robots_that_ask_each_others_name_do_not_answer_for_ever() -> None:
    one, other = AsciiRobot("MNERIM"), AsciiRobot("GAMA")
    other.receive(one.command("GAMA", "qualseunome"), 0.0)
    said = [other.say("MNERIM", "qualseunome")] * 2  # twice the same answer, as where two ways lead there
    for turn in range(20):
        said = [reply for data in said for _, reply in (one, other)[turn % 2].receive(data, turn * 0.001)]
    assert not said

"""Robot Mitya as callers see it: calls by letter or name, answers, errors in words, and how a body finds its step."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from psiu_broker.codecs import mitya
from psiu_broker.codecs.mitya import BY_WORD, VERSIONS, Mitya, Version
from psiu_broker.errors import CallError
from psiu_broker.frame import NOBODY, Frame
from psiu_broker.messages import Value
from psiu_broker.profiles.mitya import ERRORS, FILLERS, MOODS, MityaCommand, MityaProfile, Realigner, meaning
from psiu_broker.profiles.profile import SENT, Reply, Request
from psiu_broker.simulator.mitya import MityaBody

VECTORS = json.loads((Path(__file__).parents[1] / "vectors" / "mitya.json").read_text())["messages"]
NO_VALUE = ("nod", "shake", "fire", "stop")


def profile(
    version: Version = "2012", *, datagrams: bool = False, commands: Mapping[str, Any] | None = None, **codec: Any
) -> MityaProfile:
    options = MityaProfile.Options.model_validate({"commands": commands or {}})
    return MityaProfile.make(Mitya.Options(version=version, **codec), options, 2.0, datagrams=datagrams)


def heard(text: str, version: Version = "2012") -> Frame:
    (frame,) = Mitya(Mitya.Options(version=version)).decode(text.encode(), 0.0)
    assert isinstance(frame, Frame)
    return frame


def error(robot: MityaProfile, command: str, *parameters: Value) -> CallError:
    with pytest.raises(CallError) as caught:
        robot.request(command, parameters)
    return caught.value


@pytest.mark.parametrize(
    ("version", "command", "parameters", "payload"),
    [
        ("2012", "D", [100], "D0064"),
        ("2012", "D", ["-100"], "DFF9C"),
        ("2012", "drive", ["100"], "D0064"),
        ("2013", "drive", [100], "G0064"),
        ("2013", "G", [100], "G0064"),
        ("2014", "G", [255.0], "G00FF"),
        ("2012", "L", [255], "L00FF"),
        ("2012", "R", [-127], "RFF81"),
        ("2012", "H", [90], "H005A"),
        ("2012", "head-vertical", [60], "V003C"),
        ("2012", "T", [16], "T0010"),
        ("2012", "mood", ["playful"], "F0102"),
        ("2012", "F", [258], "F0102"),
        ("2012", "F", ["0x0102"], "F0102"),
        ("2013", "M", ["very-happy"], "M0101"),
        ("2012", "I", ["on"], "I0001"),
        ("2012", "headlights", ["OFF"], "I0000"),
        ("2012", "t", [], "t0001"),
        ("2012", "wag", [2], "t0002"),
        ("2012", "y", [], "y0001"),
        ("2012", "y", [1], "y0001"),
        ("2012", "n", [], "n0001"),
        ("2012", "f", [], "f0001"),
        ("2013", "fire", [], "s0001"),
        ("2013", "h", [-200], "hFF38"),
        ("2013", "battery", [], "=0000"),
        ("2014", "=", ["0x1100"], "=1100"),
        ("2012", "play", [9], "r0009"),
        ("2013", "r", [0], "r0000"),
        ("2012", "stop", [], "D0000"),
        ("2013", "pare", [], "G0000"),
        ("2012", "STOP", [], "D0000"),
    ],
)
def test_a_call_becomes_a_message(version: Version, command: str, parameters: list[Value], payload: str) -> None:
    request = profile(version).request(command, parameters)
    assert request.payload.decode() == payload
    assert request.procedure is None
    wire = Mitya(Mitya.Options(version=version)).encode(
        Frame(NOBODY, NOBODY, request.subject, request.payload, "mitya")
    )
    assert wire[:5].decode() == payload


@pytest.mark.parametrize(
    ("command", "parameters", "text"),
    [
        ("D", [256], "D takes -255 to 255, got 256"),
        ("drive", [], "drive takes -255 to 255, got nothing"),
        ("drive", [1, 2], "drive takes -255 to 255, got 1 2"),
        ("drive", ["fast"], "drive takes -255 to 255, got fast"),
        ("drive", [1.5], "drive takes -255 to 255, got 1.5"),
        ("drive", ["0xZZ"], "drive takes -255 to 255, got 0xZZ"),
        ("drive", [float("nan")], "drive takes -255 to 255, got nan"),
        ("drive", [10**400], f"drive takes -255 to 255, got {10**400}"),
        ("drive", [float("inf")], "drive takes -255 to 255, got inf"),
        ("H", [181], "H takes 0 to 180 deg, got 181"),
        ("V", [-1], "V takes 0 to 90 deg, got -1"),
        ("tail", [5], "tail takes 10 to 170 deg, got 5"),
        ("headlights", [2], "headlights takes 0 to 1, off or on, got 2"),
        ("wag", [3], "wag takes 1 to 2, or nothing, got 3"),
        ("nod", [0], "nod takes 1, or nothing, got 0"),
        ("stop", [0], "stop takes no parameters, got 0"),
        ("play", [10], "play takes 0 to 9, got 10"),
        ("r", [256], "r takes 0 to 9, got 256"),
        (
            "mood",
            ["bored"],
            "mood takes normal (1), happy (2), sad (3), angry (4), ill (5), playful (258), very-sad (259), got bored",
        ),
        ("W", [0], "W is part of a script: it is sent only while one is uploaded"),
        ("room", [3], "room is part of a script: it is sent only while one is uploaded"),
        ("E", [1], "E is for the robot to say"),
        ("h", [1], "h is for the robot to say"),
    ],
)
def test_what_does_not_fit_is_refused_with_the_range(command: str, parameters: list[Value], text: str) -> None:
    caught = error(profile(), command, *parameters)
    assert (caught.code, str(caught)) == ("refused", text)


def test_an_unknown_command_is_told_from_a_letter_of_another_version() -> None:
    caught = error(profile("2013"), "D", 100)
    assert (caught.code, str(caught)) == ("unknown_command", "no command D: what 2012 calls so is G in 2013")
    assert str(error(profile(), "drvie", 1)).startswith("no command drvie: did you mean drive? It has drive, left")
    assert error(profile(), "battery").code == "unknown_command"
    assert error(profile("2014"), "play", 1).code == "unknown_command"


@pytest.mark.parametrize("version", VERSIONS)
def test_every_command_is_listed_with_its_letter_range_and_meaning(version: Version) -> None:
    robot = profile(version)
    for command in robot.commands():
        assert command.description
        assert command.aliases
        if command.name not in NO_VALUE:
            assert command.minimum is not None
            assert command.maximum is not None
            for value in (command.minimum, command.maximum):
                for name in (command.name, *command.aliases):
                    assert robot.request(name, [value]).subject in {*BY_WORD[version], "stop"}
    aliases = {command.name: command.aliases for command in robot.commands()}
    assert aliases["drive"] == [BY_WORD[version]["drive"]]
    assert ("play" in aliases) == (version != "2014")


def test_a_2012_body_answers_only_what_it_cannot_do() -> None:
    robot = profile()
    request = robot.request("mood", ["happy"])
    assert (request.silence, request.timeout_s, request.question) == (SENT, 0.3, False)
    reply = robot.read(request, heard("E0002"))
    assert reply == Reply("falha", ("E0002",), remark="E0002, the body: unknown command")
    assert robot.read(request, heard("E0105")) == Reply(
        "falha", ("E0105",), remark="E0105, the head: no memory for so long a script"
    )
    assert robot.read(request, heard("D0064")) is None
    assert robot.read(request, heard("h0001")) is None


def test_how_long_an_error_may_take_can_be_told() -> None:
    robot = MityaProfile(Mitya.Options(), MityaProfile.Options(error_ms=1000), 2.0)
    assert robot.request("D", [1]).timeout_s == 1.0


@pytest.mark.parametrize("version", ["2013", "2014"])
def test_later_bodies_answer_each_command(version: Version) -> None:
    robot = profile(version)
    request = robot.request("drive", [100])
    assert (request.silence, request.timeout_s) == (None, 2.0)
    assert robot.read(request, heard("#0000", version)) == Reply("sucesso")
    assert robot.read(request, heard("#0002", version)) == Reply(
        "falha", ("#0002",), remark="#0002, the body: unknown command"
    )
    assert robot.read(request, heard("M0001", version)) is None
    assert robot.read(request, heard("~01F6", version)) is None


def test_of_a_one_shot_both_messages_are_answered_and_the_call_waits_for_both() -> None:
    robot = profile("2013")
    request = robot.request("fire", [])
    assert robot.read(request, heard("#0000", "2013")) is None
    assert robot.read(request, heard("#0000", "2013")) == Reply("sucesso")
    again = robot.request("fire", [])
    refused = heard("#0002", "2013")
    assert robot.read(again, refused) is None
    assert robot.read(again, refused) is None  # the same frame, looked at twice
    reply = robot.read(again, heard("#0000", "2013"))
    assert isinstance(reply, Reply)
    assert (reply.status, reply.values) == ("falha", ("#0002",))


def test_where_a_one_shot_is_sent_more_often_more_answers_are_awaited() -> None:
    robot = profile("2013", repeat=2)
    request = robot.request("fire", [])
    replies = [robot.read(request, heard("#0000", "2013")) for _ in range(4)]
    assert replies == [None, None, None, Reply("sucesso")]


def test_many_that_are_under_way_at_once_are_each_answered_and_what_was_answered_long_ago_is_forgotten() -> None:
    robot = profile("2013")
    requests = [robot.request("fire", []) for _ in range(32)]
    for reply in (None, Reply("sucesso")):
        done = heard("#0000", "2013")
        assert [robot.read(request, done) for request in requests] == [reply] * 32
    for _ in range(1000):
        robot.read(robot.request("fire", []), heard("#0000", "2013"))
    assert len(robot._bursts) < 100


@pytest.mark.parametrize("version", VERSIONS)
def test_a_phone_tells_only_errors(version: Version) -> None:
    robot = profile(version, datagrams=True)
    assert robot.request("drive", [1]).silence == SENT
    assert robot.request("nod", []).silence == SENT
    text = "E0002" if version == "2012" else "#0002"
    reply = robot.read(robot.request("nod", []), heard(text, version))
    assert isinstance(reply, Reply)
    assert reply.status == "falha"
    assert list(robot.greeting()) == []


def test_the_battery_answers_with_its_voltage() -> None:
    robot = profile("2013")
    request = robot.request("battery", [])
    assert request.question
    assert robot.read(request, heard("~01F6", "2013")) is None
    assert robot.read(request, heard("#0000", "2013")) == Reply("sucesso", (5.02,), "V")
    assert robot.read(robot.request("drive", [1]), heard("#0000", "2013")) == Reply("sucesso")
    phone = profile("2014", datagrams=True)
    request = phone.request("battery", ["0x1000"])
    assert phone.read(request, heard("~01F6", "2014")) is None
    assert phone.read(request, heard("~11F6", "2014")) == Reply(None, (5.02,), "V")


def test_no_two_requests_can_be_told_apart_by_their_answers() -> None:
    robot = profile()
    assert robot.answers_to(robot.request("D", [1])) == robot.answers_to(robot.request("nod", []))


@pytest.mark.parametrize(
    ("version", "text", "fields"),
    [
        ("2012", "D0064", {"kind": "command", "command": "drive", "parameters": [100], "value": 100.0, "unit": None}),
        ("2012", "DFF9C", {"kind": "command", "parameters": [-100], "value": -100.0}),
        ("2012", "H005A", {"kind": "command", "command": "head-horizontal", "value": 90.0, "unit": "deg"}),
        ("2012", "F0102", {"kind": "command", "command": "mood", "parameters": ["playful"]}),
        ("2012", "F0999", {"kind": "command", "command": "mood", "parameters": [0x999]}),
        ("2012", "y0001", {"kind": "command", "command": "nod", "parameters": [1]}),
        ("2012", "h0001", {"kind": "event", "command": "hit", "parameters": [1]}),
        ("2012", "E0002", {"kind": "error", "status": "falha", "remark": "the body: unknown command"}),
        ("2012", "E0105", {"kind": "error", "parameters": ["E0105"]}),
        ("2012", "r0003", {"kind": "command", "command": "play", "parameters": [3]}),
        ("2012", "r0103", {"kind": "command", "command": "record", "parameters": [3]}),
        ("2012", "r0200", {"kind": "event", "command": "recorded"}),
        ("2012", "W03E8", {"kind": "command", "command": "wait", "parameters": [1000], "unit": "ms"}),
        ("2012", "Q0007", {"kind": "command", "command": "letter/Q", "parameters": [7]}),
        ("2013", "#0000", {"kind": "response", "status": "sucesso"}),
        ("2013", "#0009", {"kind": "error", "remark": "the body: there is no such voltage divider"}),
        ("2013", "~01F6", {"kind": "event", "value": 5.02, "unit": "V", "readings": {"battery": 5.02}}),
        ("2014", "~11F6", {"kind": "event", "value": 5.02, "readings": {"divider 1": 5.02}}),
        ("2013", "*0001", {"kind": "event", "command": "hit"}),
    ],
)
def test_a_message_is_told_in_words(version: Version, text: str, fields: dict[str, Any]) -> None:
    told = profile(version).describe(heard(text, version))
    assert told | fields == told


def test_a_message_of_a_script_is_told_as_one() -> None:
    codec = Mitya()
    frames = [frame for frame in codec.decode(b"r0100Z0001D0064W0001Z0000", 0.0) if isinstance(frame, Frame)]
    assert [profile().describe(frame)["command"] for frame in frames] == [
        "record",
        "script/room",
        "script/drive",
        "script/wait",
        "script/room",
    ]


@pytest.mark.parametrize("code", [*ERRORS, 0x10, 0xFF])
def test_every_error_has_words(code: int) -> None:
    assert meaning(code).startswith("the body: ")
    assert meaning(0x0100 | code) == meaning(code).replace("body", "head", 1)


def test_moods_are_those_of_the_document_and_the_firmware() -> None:
    assert {vector["value"] for vector in VECTORS if vector["ident"] in "FM"} <= set(MOODS.values())
    assert error(profile(), "mood", "musical").code == "refused"


class TestCommandsOfTheUser:
    def test_a_scale_is_declared(self) -> None:
        robot = profile(
            commands={"marcha": {"letter": "D", "minimum": -100, "maximum": 100, "unit": "%", "scale": 2.55}}
        )
        assert robot.request("marcha", [-100]).payload == b"DFF01"
        assert robot.request("marcha", [50.5]).payload == b"D0081"
        assert str(error(robot, "marcha", 101)) == "marcha takes -100 to 100 %, got 101"
        assert robot.request("D", [255]).payload == b"D00FF"
        (command,) = [each for each in robot.commands() if each.name == "marcha"]
        assert (command.floats, command.minimum, command.maximum, command.unit) == (1, -100, 100, "%")

    def test_an_offset_too(self) -> None:
        robot = profile(commands={"olha": {"letter": "H", "minimum": -90, "maximum": 90, "offset": 90, "unit": "deg"}})
        assert robot.request("olha", [-90]).payload == b"H0000"
        assert robot.request("olha", ["45"]).payload == b"H0087"

    def test_a_fixed_value_takes_no_parameters(self) -> None:
        robot = profile(commands={"recua": {"letter": "D", "fixed": -100}})
        assert robot.request("recua", []).payload == b"DFF9C"
        assert str(error(robot, "recua", 1)) == "recua takes no parameters, got 1"

    def test_a_letter_of_an_extension_of_ones_own(self) -> None:
        robot = profile(commands={"laser": {"letter": "Q", "minimum": 0, "maximum": 1}})
        request = robot.request("Q", [1])
        assert (request.subject, request.payload) == ("letter/Q", b"Q0001")
        assert Mitya().encode(Frame(NOBODY, NOBODY, request.subject, request.payload, "mitya")) == b"Q0001"

    def test_a_built_in_command_can_be_given_another_range(self) -> None:
        robot = profile(commands={"head-vertical": {"letter": "V", "minimum": 30, "maximum": 120}})
        assert robot.request("V", [120]).payload == b"V0078"
        assert error(robot, "head-vertical", 20).code == "refused"
        assert len([each for each in robot.commands() if each.name == "head-vertical"]) == 1

    @pytest.mark.parametrize(
        "fields",
        [
            {"letter": "DD"}, {"letter": "1"}, {"letter": "D", "scale": 0}, {"letter": "D", "minimum": 2, "maximum": 1},
            {"letter": "D", "scale": 1000}, {"letter": "D", "fixed": 70000}, {"letter": "D", "minimum": float("nan")},
        ],
    )  # fmt: skip
    def test_what_makes_no_sense_is_refused_where_it_is_written(self, fields: dict[str, Any]) -> None:
        with pytest.raises(ValidationError):
            MityaCommand.model_validate(fields)

    @pytest.mark.parametrize(
        ("version", "name", "letter", "text"),
        [
            ("2012", "qualseunome", "D", "expected one word"),
            ("2012", "two words", "D", "expected one word"),
            ("2012", "stop", "Q", "expected one word"),
            ("2012", "Pare", "D", "expected one word"),
            ("2012", "espera", "W", "is for scripts"),
            ("2012", "grava", "r", "is for scripts"),
            ("2013", "marcha", "D", "is a digit to a robot of 2013"),
        ],
    )
    def test_what_does_not_suit_the_robot_is_refused(self, version: Version, name: str, letter: str, text: str) -> None:
        with pytest.raises(ValueError, match=text):
            profile(version, commands={name: {"letter": letter}})


LOST_AT_MOST = 3
"""Commands that a body may take for something else before it says that it is out of step, or was recording."""


def frames_of(codec: Mitya, data: bytes) -> list[Frame]:
    return [event for event in codec.decode(data, 0.0) if isinstance(event, Frame)]


class Line:
    """A broker's end, and a body that may have lost step."""

    def __init__(self, pending: bytes = b"", **options: Any) -> None:
        self.robot = profile(**options)
        self.body = MityaBody()
        self.codec = Mitya()
        self.sent: list[bytes] = []
        self.body.receive(pending, 0.0)

    def greet(self) -> None:
        for request in self.robot.greeting():
            self.send(request)

    def send(self, request: Request) -> list[Frame]:
        wire = self.codec.encode(Frame(NOBODY, NOBODY, request.subject, request.payload, "mitya"))
        self.sent.append(wire)
        answers: list[Frame] = []
        for _, data in self.body.receive(wire, 0.0):
            for frame in self.codec.decode(data, 0.0):
                assert isinstance(frame, Frame)
                answers.append(frame)
                if self.robot.learn(frame):
                    self.greet()
        return answers


class TestRealignment:
    @pytest.mark.parametrize("lost", ["", "0", "\r\n", "D00", "0064", "D006"])
    def test_a_body_that_lost_step_finds_it_when_the_link_opens(self, lost: str) -> None:
        line = Line(lost.encode())
        line.greet()
        assert line.sent == [b"W0000"] * 2 + [b"0W0000"] * ((5 - len(lost)) % 5)
        line.send(line.robot.request("D", [100]))
        assert line.body.body.left == line.body.body.right == 100

    @pytest.mark.parametrize("stray", ["0", "!", "\n", "00", "L0064\n"])
    def test_a_body_that_loses_step_later_finds_it_after_the_error(self, stray: str) -> None:
        line = Line()
        line.greet()
        line.body.receive(stray.encode(), 0.0)
        request = line.robot.request("D", [100])
        answers = line.send(request)
        replies = [line.robot.read(request, frame) for frame in answers[:1]]
        assert [reply.status for reply in replies if isinstance(reply, Reply)] == ["falha"]
        line.send(line.robot.request("L", [7]))
        assert line.body.body.left == 7

    @given(st.binary(max_size=30), st.lists(st.binary(max_size=3), max_size=4))
    def test_whatever_was_lost_it_is_found_in_the_end(self, pending: bytes, strays: list[bytes]) -> None:
        line = Line(pending)
        line.greet()
        for stray in strays:
            line.body.receive(stray, 0.0)
            line.send(line.robot.request("D", [1]))
        for _ in range(LOST_AT_MOST):
            line.send(line.robot.request("D", [1]))
        line.send(line.robot.request("L", [7]))
        assert line.body.body.left == 7
        assert line.body.recording is None

    @pytest.mark.parametrize("left", ["r0100", "r0100Z0002", "r0100Z0002D0064", "r0100Z0002D0064W0001", "r0100Z0002D0"])
    def test_a_recording_that_a_killed_broker_left_open_is_ended_when_the_link_opens(self, left: str) -> None:
        line = Line(left.encode())
        line.greet()
        assert (line.body.recording, line.body.scripts) == (None, {})
        line.send(line.robot.request("D", [7]))
        assert line.body.body.left == 7

    def test_a_recording_that_noise_began_is_found_out_and_ended(self) -> None:
        line = Line()
        line.greet()
        line.body.receive(b"r", 0.0)
        said: list[bytes] = []
        for _ in range(3):  # rD000 begins it, 1D000 is an action and another one no delay
            said += [frame.payload for frame in line.send(line.robot.request("D", [1]))]
        assert said[:2] == [b"E0004", b"r0200"]
        line.send(line.robot.request("L", [7]))
        assert (line.body.recording, line.body.body.left) == (None, 7)

    @pytest.mark.parametrize("lost", ["0", "00", "000", "0000"])
    def test_all_that_it_says_while_it_is_sought_answers_no_call(self, lost: str) -> None:
        line = Line(lost.encode())
        request = line.robot.request("D", [100])
        said = [frame.payload for frame in self._sought(line) if line.robot.read(request, frame) is None]
        assert len(said) == 8 - len(lost)
        assert said[-2:] == [b"E0002", b"E0007"]

    @staticmethod
    def _sought(line: "Line") -> Iterator[Frame]:
        """What the body says, one by one, until it has found its step."""
        waiting = list(line.robot.greeting())
        while waiting:
            asked = waiting.pop(0)
            wire = line.codec.encode(Frame(NOBODY, NOBODY, asked.subject, asked.payload, "mitya"))
            for _, data in line.body.receive(wire, 0.0):
                for frame in frames_of(line.codec, data):
                    if line.robot.learn(frame):
                        waiting += line.robot.greeting()
                    yield frame

    def test_an_answer_that_comes_after_the_next_call_is_not_its(self) -> None:
        robot = profile()
        robot.greeting()
        request = robot.request("D", [1])
        late = heard("E0007")
        assert not robot.learn(late)
        assert robot.read(request, late) is None

    def test_what_answers_a_question_of_ours_answers_no_call(self) -> None:
        robot = profile()
        assert [asked.subject for asked in robot.greeting()] == [mitya.REALIGN] * 2
        for last in (False, True):  # nothing is done before both are answered
            lost = heard("E0001")
            assert robot.learn(lost) == last
            assert robot.read(robot.request("D", [1]), lost) is None
        (asked,) = robot.greeting()
        assert asked.payload == b"0W0000"
        aligned = heard("E0007")
        assert not robot.learn(aligned)
        assert robot.read(robot.request("D", [1]), aligned) is None
        later = heard("E0002")
        assert robot.learn(later)
        assert isinstance(robot.read(robot.request("D", [1]), later), Reply)

    def test_an_error_after_a_silent_greeting_is_that_of_the_call(self) -> None:
        robot = profile()
        robot.greeting()
        request = robot.request("D", [1])
        lost = heard("E0001")
        assert robot.learn(lost)
        assert isinstance(robot.read(request, lost), Reply)
        assert [asked.payload for asked in robot.greeting()] == [b"W0000"] * 2

    def test_a_command_that_a_body_cuts_into_another_is_found_out_by_the_next(self) -> None:
        line = Line()
        line.greet()
        line.body.receive(b"D0", 0.0)
        assert line.send(line.robot.request("D", [100])) == []  # D0D00 and the beginning of something
        line.send(line.robot.request("L", [7]))
        line.send(line.robot.request("L", [7]))
        assert line.body.body.left == 7

    def test_a_body_that_never_finds_it_is_left_alone_after_five_bytes(self) -> None:
        one = Realigner()
        sent = list(one.next())
        assert not one.heard(heard("E0001"))
        while one.heard(heard("E0001")):
            sent += one.next()
        assert sent == [b"W0000"] * 2 + [b"0W0000"] * FILLERS
        assert (one.in_step, one.asking) == (False, False)

    @pytest.mark.parametrize("text", ["E0007", "E0004", "E0006"])
    def test_an_error_that_read_the_letter_says_that_it_is_in_step(self, text: str) -> None:
        one = Realigner()
        one.next()
        assert not one.heard(heard(text))
        assert one.in_step
        assert not one.asking

    def test_an_older_error_behind_it_moves_a_body_in_step_no_further(self) -> None:
        one = Realigner()
        one.next()
        assert [one.heard(heard("E0001")) for _ in range(2)] == [False, True]
        assert list(one.next()) == [b"0W0000"]
        assert one.heard(heard("E0001"))  # to a command that was sent before; what it asks for is put off
        assert not one.heard(heard("E0007"))
        assert list(one.next()) == [b"W0000"] * 2

    def test_where_an_answer_was_lost_a_second_unknown_command_is_one_and_it_is_asked_anew(self) -> None:
        robot = profile()
        robot.greeting()
        lost = [robot.learn(heard("E0001")) for _ in range(2)]
        assert lost == [False, True]
        robot.greeting()  # of which the answer is lost
        request = robot.request("D", [1])
        zeros, unknown = heard("E0002"), heard("E0002")
        assert not robot.learn(zeros)
        assert robot.read(request, zeros) is None
        assert robot.learn(unknown)
        assert robot.read(request, unknown) is not None
        assert [asked.payload for asked in robot.greeting()] == [b"W0000"] * 2

    def test_what_is_no_error_says_nothing(self) -> None:
        one = Realigner()
        one.next()
        assert not one.heard(heard("h0001"))
        assert one.asking
        assert one.in_step is None

    def test_nothing_is_asked_of_a_body_that_records_for_the_error_ends_the_recording(self) -> None:
        line = Line()
        line.greet()
        for step in (b"r0100", b"Z0002", b"D0064"):
            assert line.body.receive(step, 0.0) == []
        assert line.sent == [b"W0000"] * 2
        line.body.receive(b"W", 0.0)
        line.send(line.robot.request("L", [7]))  # WL000
        assert line.body.recording is None
        line.send(line.robot.request("L", [7]))
        assert line.body.body.left == 7

    def test_only_a_2012_body_on_a_line_that_wants_it(self) -> None:
        for robot in (profile(realign=False), profile("2013"), profile("2014"), profile(datagrams=True)):
            assert list(robot.greeting()) == []
            assert not robot.learn(heard("E0001"))


@given(st.text(max_size=12), st.lists(st.integers() | st.floats() | st.text(max_size=8), max_size=3))
def test_a_call_is_a_message_or_refused(command: str, parameters: list[Value]) -> None:
    for version in VERSIONS:
        robot = profile(version)
        try:
            request = robot.request(command, parameters)
        except CallError as refused:
            assert refused.code in ("refused", "unknown_command")
        else:
            assert len(request.payload) == 5


KINDS = st.sampled_from(["error", "telemetry", "done", "hit", "script", "script/wait", "drive", "mood"])


@given(KINDS | st.text(max_size=8), st.binary(max_size=6) | st.from_regex("[A-Za-z#~*=][0-9A-F]{4}").map(str.encode))
def test_no_frame_is_too_odd_to_be_told(subject: str, payload: bytes) -> None:
    frame = Frame(NOBODY, NOBODY, subject, payload, "mitya")
    for version in VERSIONS:
        robot = profile(version)
        robot.describe(frame)
        robot.learn(frame)
        robot.read(robot.request("drive", [1]), frame)

"""What a robot with scripts is asked, and what its messages say of a recording."""

import pytest

from psiu_broker.codecs.mitya import Mitya, Version, word_of
from psiu_broker.errors import CallError
from psiu_broker.frame import NOBODY, Frame
from psiu_broker.profiles.profile import Reply
from psiu_broker.profiles.roboscript import ScriptedMitya

SCRIPT = "# dance\ndrive 100\nwait 500\nnod\n"


def robot(version: Version = "2012", **more: bool) -> ScriptedMitya:
    return ScriptedMitya(Mitya.Options(version=version), **more)


def said(version: Version, wire: bytes) -> Frame:
    return Frame(NOBODY, NOBODY, word_of(version, wire), wire, "mitya", wire)


def test_an_upload_is_a_procedure_with_a_name_and_a_line_for_each_message() -> None:
    request = robot().request("roboscript-upload", [3, SCRIPT])
    assert request.procedure is not None
    assert [(step.subject, step.payload, step.name, step.place) for step in request.procedure.steps] == [
        ("script", b"r0103", "r0103", 0),
        ("script/room", b"Z0002", "Z0002", 0),
        ("script/drive", b"D0064", "line 2: drive (D0064)", 2),
        ("script/wait", b"W01F4", "line 3: wait (W01F4)", 3),
        ("script/nod", b"y0001", "line 4: nod (y0001)", 4),
        ("script/wait", b"W0000", "line 4: wait (W0000)", 4),
        ("script/room", b"Z0000", "Z0000", 0),
    ]
    assert request.procedure.takes_s == pytest.approx(2 * 0.25 + 4 * 0.05 + 2.0)
    assert request.silence is None


def test_its_messages_leave_exactly_once_each() -> None:
    codec = Mitya(Mitya.Options(repeat=3), datagrams=True)
    request = robot().request("roboscript-upload", [3, SCRIPT])
    assert request.procedure is not None
    for step in (*request.procedure.steps, *request.procedure.ending):
        frame = Frame(NOBODY, NOBODY, step.subject, step.payload, "mitya")
        assert codec.pieces(codec.encode(frame)) == [step.payload]


def test_behind_a_phone_it_is_slower_and_silence_is_no_fault() -> None:
    near, far = (robot(datagrams=datagrams).request("roboscript-upload", [3, SCRIPT]) for datagrams in (False, True))
    assert near.procedure is not None
    assert far.procedure is not None
    assert far.procedure.takes_s > near.procedure.takes_s
    assert far.silence is not None


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ([10, SCRIPT], "a slot is 0 to 9, got 10"),
        ([-1, SCRIPT], "a slot is 0 to 9, got -1"),
        (["x", SCRIPT], "a slot is 0 to 9, got x"),
        ([3], "roboscript-upload takes a slot and the text of a script, got 1 values"),
        ([3, 4], "roboscript-upload takes a slot and the text of a script, got 2 values"),
        ([3, "drive 300\nr0200"], "line 1: 300 is no value of drive"),
        ([3, ""], "it has no action"),
    ],
)
def test_what_cannot_be_recorded_is_refused_before_anything_is_sent(parameters: list[int | str], message: str) -> None:
    with pytest.raises(CallError) as refused:
        robot().request("roboscript-upload", parameters)
    assert refused.value.code == "refused"
    assert str(refused.value).startswith(message)


def test_all_mistakes_of_a_script_are_told_a_line_each() -> None:
    with pytest.raises(CallError) as refused:
        robot().request("roboscript-upload", [3, "drive 300\ndrive 1\nr0200"])
    assert [line.partition(": ")[0] for line in str(refused.value).split("\n")] == ["line 1", "line 3"]


@pytest.mark.parametrize("version", ["2012", "2013", "2014"])
def test_it_lists_the_commands_that_it_has(version: Version) -> None:
    names = [command.name for command in robot(version).commands()]
    assert ("roboscript-upload" in names) == ("roboscript-abort" in names) == (version != "2014")
    assert "drive" in names


@pytest.mark.parametrize("command", ["roboscript-upload", "roboscript-abort"])
def test_2014_is_refused_with_the_reason(command: str) -> None:
    with pytest.raises(CallError, match="2014 has no RoboScript"):
        robot("2014").request(command, [3, SCRIPT])


def test_an_abort_takes_nothing_and_has_no_steps() -> None:
    request = robot().request("roboscript-abort", [])
    assert request.procedure is not None
    assert request.procedure.steps == ()
    with pytest.raises(CallError, match="takes no parameters"):
        robot().request("roboscript-abort", [1])


def test_a_command_of_the_configuration_is_an_action_too() -> None:
    options = ScriptedMitya.Options.model_validate(
        {"commands": {"marcha": {"letter": "D", "minimum": -100, "maximum": 100, "unit": "%", "scale": 2.55}}}
    )
    request = ScriptedMitya(Mitya.Options(), options).request("roboscript-upload", [0, "marcha 100"])
    assert request.procedure is not None
    assert request.procedure.steps[2].payload == b"D00FF"


@pytest.mark.parametrize(
    ("version", "wire", "status"),
    [
        ("2012", b"r0200", "sucesso"),
        ("2012", b"E0004", "falha"),
        ("2012", b"E0007", "falha"),
        ("2013", b"#0005", "falha"),
        ("2013", b"#0000", None),
        ("2012", b"E0101", None),
        ("2012", b"h0001", None),
        ("2012", b"r0003", None),
        ("2013", b"~01F6", None),
    ],
)
def test_what_a_message_says_of_a_recording(version: Version, wire: bytes, status: str | None) -> None:
    mitya = robot(version)
    reply = mitya.read(mitya.request("roboscript-upload", [3, "drive 1"]), said(version, wire))
    assert (None if reply is None else reply.status if isinstance(reply, Reply) else reply) == status
    if status == "falha":
        assert isinstance(reply, Reply)
        assert reply.values == (wire.decode(),)


@pytest.mark.parametrize("payload", [b"", b"E", b"E000", b"Ezzzz", b"r02000", b"\xff\xff\xff\xff\xff"])
@pytest.mark.parametrize("subject", ["error", "script"])
def test_what_is_no_message_says_nothing_of_a_recording(subject: str, payload: bytes) -> None:
    from_a_broker = Frame(NOBODY, NOBODY, subject, payload, "mitya")
    assert robot().read(robot().request("roboscript-abort", []), from_a_broker) is None


def test_the_answer_to_a_question_of_the_greeting_is_no_objection() -> None:
    mitya = robot()
    assert [question.payload for question in mitya.greeting()] == [b"W0000"] * 2
    request = mitya.request("roboscript-upload", [3, "drive 1"])
    list(mitya.greeting())
    for answer in (said("2012", b"E0007"), said("2012", b"E0007")):
        mitya.learn(answer)
        assert mitya.read(request, answer) is None
    objection = said("2012", b"E0007")
    mitya.learn(objection)
    assert mitya.read(mitya.request("roboscript-upload", [3, "drive 1"]), objection) is not None


def test_another_error_to_that_question_is_one_for_it_ends_the_recording() -> None:
    mitya = robot()
    request = mitya.request("roboscript-upload", [3, "drive 1"])
    list(mitya.greeting())
    out_of_step = said("2012", b"E0001")
    mitya.learn(out_of_step)
    assert mitya.read(request, out_of_step) is not None


def test_other_commands_are_those_of_any_robot_mitya() -> None:
    mitya = robot()
    assert mitya.request("play", [3]).payload == b"r0003"
    assert mitya.read(mitya.request("drive", [1]), said("2012", b"E0002")) is not None

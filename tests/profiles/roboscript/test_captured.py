"""Compiling and its way back."""

from functools import cache

import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.codecs.codec import Directory
from psiu_broker.codecs.mitya import Mitya, Version
from psiu_broker.frame import Frame
from psiu_broker.profiles.roboscript import Action, compiled, decompiled, read, vocabulary
from psiu_broker.profiles.roboscript.script import ACTIONS_MAX, TOTAL_MS

VERSIONS: list[Version] = ["2012", "2013"]
WORDS = {version: vocabulary(version) for version in VERSIONS}
UPLOAD = b"r0103Z0002D0064W01F4D0000W0000Z0000"
SCRIPT = "# Robot Mitya 2012, slot 3: 2 actions, 500 ms\ndrive 100\nwait 500\ndrive 0\n"


@cache
def values(version: Version, name: str) -> st.SearchStrategy[int]:
    """The 16 bits of any value that the action takes."""
    form = WORDS[version].forms[name]

    def taken(value: int) -> bool:
        try:
            form.value([value])
        except ValueError:
            return False
        return True

    return st.sampled_from([value & 0xFFFF for value in range(-300, 0x200) if taken(value)])


@st.composite
def scripts(draw: st.DrawFn) -> tuple[Version, list[Action]]:
    version = draw(st.sampled_from(VERSIONS))
    words = WORDS[version]
    names = [name for name, form in words.forms.items() if not form.fixed]
    actions: list[Action] = []
    left_ms = TOTAL_MS - 1
    for name in draw(st.lists(st.sampled_from(names), min_size=1, max_size=12)):
        delay_ms = draw(st.integers(0, left_ms))
        left_ms -= delay_ms
        actions.append(Action(words.forms[name].letter, draw(values(version, name)), delay_ms))
    return version, actions


def bare(actions: tuple[Action, ...] | list[Action]) -> list[Action]:
    return [action._replace(line=0, wait_line=0) for action in actions]


@given(scripts(), st.integers(0, 9))
def test_what_is_compiled_can_be_read_back_as_it_was(script: tuple[Version, list[Action]], slot: int) -> None:
    version, actions = script
    capture = b"".join(each.wire for each in compiled(actions, slot, version))
    text, problems = decompiled(capture, WORDS[version])
    assert problems == ()
    assert f"slot {slot}" in text
    again = read(text, WORDS[version])
    assert again.problems == ()
    assert bare(again.actions) == actions
    assert [each.wire for each in compiled(again.actions, slot, version)] == [
        capture[at : at + 5] for at in range(0, len(capture), 5)
    ]


@given(scripts())
def test_the_codec_hears_each_message_as_part_of_a_script(script: tuple[Version, list[Action]]) -> None:
    version, actions = script
    messages = compiled(actions, 0, version)
    codec = Mitya(Mitya.Options(version=version), Directory())
    events = codec.decode(b"".join(each.wire for each in messages), 0.0)
    frames = [event for event in events if isinstance(event, Frame)]
    assert [frame.wire for frame in frames] == [each.wire for each in messages]
    assert [frame.subject for frame in frames[1:]] == [f"script/{each.word}" for each in messages[1:]]


def test_each_message_knows_its_line() -> None:
    script = read("# dance\ndrive 100\n\nwait 500\ndrive 0", WORDS["2012"])
    assert [(each.wire, each.line) for each in compiled(script.actions, 3, "2012")] == [
        (b"r0103", 0), (b"Z0002", 0), (b"D0064", 2), (b"W01F4", 4), (b"D0000", 5), (b"W0000", 5), (b"Z0000", 0),
    ]  # fmt: skip
    assert b"".join(each.wire for each in compiled(script.actions, 3, "2012")) == UPLOAD
    assert compiled([Action("D", 0)] * ACTIONS_MAX, 9, "2012")[1].wire == b"Z0082"


@pytest.mark.parametrize(
    "capture",
    [
        UPLOAD,
        UPLOAD.lower().replace(b"w", b"W").replace(b"z", b"Z").replace(b"d", b"D"),
        b"r0103\r\nZ0002\r\nD0064\r\nW01F4\r\nD0000\r\nW0000\r\nZ0000\r\n",
        b"L0000" + UPLOAD + b"r0003D0064",
        b"\x00?" + UPLOAD + b"\xff",
        UPLOAD.hex().encode(),
        UPLOAD.hex(" ").upper().encode() + b"\n",
        UPLOAD.hex(":").encode(),
        b" ".join(b"0x%02x" % byte for byte in UPLOAD),
    ],
)
def test_a_capture_may_be_text_or_hexadecimal_with_other_things_around(capture: bytes) -> None:
    assert decompiled(capture, WORDS["2012"]) == (SCRIPT, ())


def test_actions_alone_will_do() -> None:
    assert decompiled(b"D0064W01F4D0000W0000", WORDS["2012"]) == (SCRIPT.replace(", slot 3", ""), ())
    assert decompiled(b"D0064D0000", WORDS["2012"])[0].splitlines()[1:] == ["drive 100", "drive 0"]


@pytest.mark.parametrize(
    ("capture", "said"),
    [
        (b"", "there is no message in it"),
        (b"hello", "there is no message in it"),
        (b"r0103Z0001D0064W01F4", "its end, Z0000, is missing"),
        (b"r0103Z0005D0064W01F4Z0000", "it makes room for 5 actions and has 1"),
        (b"r0103Z0001W0000D0064W01F4Z0000", "message 2: a delay without a command before it, left out"),
        (b"r0103Z0001D0064Z0000", "message 3: the command before it has no delay, which a body refuses"),
        (b"r0103Z0001E0001D0064W0000Z0000", "message 2: E0001 cannot be in a script, left out"),
        (b"r0103Z0001D0200W0000Z0000", "message 2: drive 512 is outside of what it takes, -255 to 255"),
        (b"r0103Z0001F0999W0000Z0000", "message 2: mood 2457 is outside of what it takes, normal (1), happy (2)"),
        (b"r0103Z0001r0000D0064W0000Z0000", "message 2: r0000 cannot be in a script, left out"),
    ],
)
def test_what_is_wrong_with_a_capture_is_told(capture: bytes, said: str) -> None:
    _, problems = decompiled(capture, WORDS["2012"])
    assert len(problems) == 1
    assert said in problems[0]


def test_2014_has_none() -> None:
    text, (problem,) = decompiled(UPLOAD, vocabulary("2014"))
    assert (text, "has no RoboScript" in problem) == ("", True)


@given(st.binary() | st.lists(st.sampled_from([b"r0100", b"Z0001", b"D0064", b"W0001", b"x", b"\n"])).map(b"".join))
def test_it_never_raises(capture: bytes) -> None:
    text, _ = decompiled(capture, WORDS["2012"])
    assert text.endswith("\n")

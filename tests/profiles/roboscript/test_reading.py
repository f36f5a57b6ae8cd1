"""Script files: what they say, and every mistake with its line."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.codecs.mitya import Version
from psiu_broker.profiles.roboscript import Action, problem_lines, read, vocabulary
from psiu_broker.profiles.roboscript.script import ACTIONS_MAX, PROBLEMS_SHOWN, TEXT_MAX

OLD, NEW, NEWEST = (vocabulary(version) for version in ("2012", "2013", "2014"))

DANCE = """\
# a dance; its first line is a comment
drive 100      # forwards
wait 500

\tL -50\t; the left motor alone
mood happy
  wait 20 ms
wait 30
f 1
nod
headlights on
stop
"""


def test_an_action_is_a_name_or_a_letter_with_its_value_and_the_wait_behind_it() -> None:
    script = read(DANCE, OLD)
    assert script.problems == ()
    assert script.actions == (
        Action("D", 100, 500, 2, 3),
        Action("L", 0xFFCE, 0, 5, 0),
        Action("F", 2, 50, 6, 8),
        Action("f", 1, 0, 9, 0),
        Action("y", 1, 0, 10, 0),
        Action("I", 1, 0, 11, 0),
        Action("D", 0, 0, 12, 0),
    )
    assert script.total_ms == 550


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_any_line_end_counts_lines_and_a_byte_order_mark_is_none(end: str) -> None:
    assert read("\ufeff" + DANCE.replace("\n", end), OLD) == read(DANCE, OLD)


def test_names_are_read_in_any_case_and_letters_in_theirs() -> None:
    assert read("DRIVE 1\nt 1\nT 20", OLD).actions == (
        Action("D", 1, 0, 1), Action("t", 1, 0, 2), Action("T", 20, 0, 3),
    )  # fmt: skip


@pytest.mark.parametrize("word", ["stop", "STOP", "pare", "Pare"])
def test_a_stop_may_be_written_as_in_a_call(word: str) -> None:
    assert read(word, OLD).actions == (Action("D", 0, 0, 1),)


def test_each_version_has_its_letters() -> None:
    assert read("G 5\ns\nM 0x0101\n= 0\nh 100", NEW).actions == (
        Action("G", 5, 0, 1), Action("s", 1, 0, 2), Action("M", 0x101, 0, 3), Action("=", 0, 0, 4),
        Action("h", 100, 0, 5),
    )  # fmt: skip
    assert [action.letter for action in read("drive 1\nfire\nmood sad", NEW).actions] == ["G", "s", "M"]


def test_comments_collide_with_no_letter_that_an_action_can_have() -> None:
    for words in (OLD, NEW):
        assert not {form.letter for form in words.forms.values()} & {"#", ";"}
    assert read("# 0000\n; drive 1\n#drive 1\ndrive 1", NEW).actions == (Action("G", 1, 0, 4),)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("drive 300", "300 is no value of drive; it takes -255 to 255: write drive 100"),
        ("drive", "drive has no value; it takes -255 to 255"),
        ("drive 1 2", "1 2 is no value of drive"),
        ("drive 1.5", "1.5 is no value of drive"),
        ("drive fast", "fast is no value of drive"),
        ("stop 1", "1 is no value of stop; it takes no parameters: write stop"),
        ("head-vertical 91", "it takes 0 to 90 deg: write head-vertical 90"),
        ("mood silly", "silly is no value of mood; it takes normal (1), happy (2)"),
        ("tail 5", "it takes 10 to 170 deg: write tail 100"),
        ("headlights 2", "it takes 0 to 1, off or on: write headlights 1"),
        ("drve 100", "did you mean drive?"),
        ("xyzzy 1", "there is no action xyzzy; there are drive, left, right"),
        ("G 100", "G is a letter of 2013; in 2012 it is D: write drive"),
        ("D0064", "D0064 is a message on the wire; an action is a name and a value: write drive 100"),
        ("r 3", "r cannot be in a script; it is part of uploading or playing one: take it out"),
        ("Z 3", "Z cannot be in a script"),
        ("r0200", "r0200 is a message on the wire"),
        ("play 3", "play cannot be in a script"),
        ("E 1", "E cannot be in a script; only the robot says it: take it out"),
        ("hit 1", "hit cannot be in a script; only the robot says it"),
        ("wait", "wait is no delay; wait takes milliseconds, 0 to 65499: wait 500 is half a second"),
        ("wait 1 s", "wait 1 s is no delay"),
        ("wait 0.5", "wait 0.5 is no delay"),
        ("wait -1", "-1 is out of range; wait takes 0 to 65499 ms"),
        ("wait 65500", "65500 is out of range"),
        ("wait 999999999999", "is no delay"),
        ("\x1b[31m 1", "\\x1b[31m"),
    ],
)
def test_what_is_wrong_is_told_with_what_is_right_and_what_to_do(line: str, said: str) -> None:
    script = read(f"drive 1\n{line}\n", OLD)
    assert [problem.line for problem in script.problems] == [2]
    (text,) = problem_lines(script.problems, "dance.txt")
    assert text.startswith("dance.txt:2: ")
    assert said in text
    assert text.isprintable()


def test_every_line_that_is_written_as_a_remedy_is_right() -> None:
    for words in (OLD, NEW):
        for name in words.forms:
            for wrong in ("nonsense", "1 2 3"):
                (problem,) = read(f"{name} {wrong}", words).problems
                remedy = re.fullmatch(r".*: write (.*)", problem.text)
                assert remedy, problem
                assert read(remedy[1], words).problems == ()


def test_a_wait_needs_an_action_but_not_a_right_one() -> None:
    (problem,) = read("wait 5\ndrive 1", OLD).problems
    assert (problem.line, "there is no action before this wait" in problem.text) == (1, True)
    assert [problem.line for problem in read("drive 999\nwait 5", OLD).problems] == [1]


def test_the_delays_together_are_bounded() -> None:
    assert read("drive 1\nwait 65000\ndrive 0\nwait 499", OLD).problems == ()
    (problem,) = read("drive 1\nwait 65000\ndrive 0\nwait 500\ndrive 1", OLD).problems
    assert problem.line == 4
    assert problem.text.startswith("the delays are 65500 ms together; less than 65500 ms")
    assert problem.text.endswith("shorten them by 1")


def test_the_actions_are_bounded() -> None:
    assert read("drive 1\n" * ACTIONS_MAX, OLD).problems == ()
    (problem,) = read("drive 1\n" * (ACTIONS_MAX + 2), OLD).problems
    assert (problem.line, problem.text) == (
        131, "132 actions; a body has room for about 130: take out 2 from here on",
    )  # fmt: skip


@pytest.mark.parametrize("text", ["", "\n\n", "# nothing\n; at all"])
def test_an_empty_script_is_none(text: str) -> None:
    (problem,) = read(text, OLD).problems
    assert problem_lines([problem], "x") == [
        "x: it has no action; a script has 1 to 130: write a line such as drive 100"
    ]


def test_a_robot_of_2014_has_no_roboscript() -> None:
    (problem,) = read(DANCE, NEWEST).problems
    assert problem_lines([problem], "x") == [
        "x: the Robot Mitya of 2014 has no RoboScript, those of 2012 and 2013 have: command it by psiu call instead"
    ]


def test_all_mistakes_are_told_at_once_in_their_order_and_only_so_many() -> None:
    assert [problem.line for problem in read("wait 1\ndrive\nwait\nx\ndrive 1\nnod 5", OLD).problems] == [1, 2, 3, 4, 6]
    problems = read("x\n" * 1000, OLD).problems
    assert len(problems) == PROBLEMS_SHOWN + 1
    assert problems[-1].text == "here and later, 950 more problems"


def test_a_long_text_is_refused() -> None:
    assert read("drive 1 #" + "x" * (TEXT_MAX - 9), OLD).problems == ()
    (problem,) = read("drive 1 #" + "x" * (TEXT_MAX - 8), OLD).problems
    assert "more than 30000 bytes" in problem.text


@given(st.text(), st.sampled_from(["2012", "2013", "2014"]))
def test_it_never_raises_and_what_it_says_is_printable(text: str, version: Version) -> None:
    script = read(text, vocabulary(version))
    assert script.actions or script.problems
    lines = len(text.replace("\r\n", "\n").replace("\r", "\n").split("\n"))
    assert all(0 <= problem.line <= lines and problem.text.isprintable() for problem in script.problems)


_WORDS = st.sampled_from([*OLD.forms, "D", "wait", "W", "r", "#", ";", "0x10", "100", "-5", "9" * 30, "happy", "E0001"])


@given(st.lists(st.lists(_WORDS, max_size=4).map(" ".join)).map("\n".join))
def test_nor_does_it_on_nearly_right_ones(text: str) -> None:
    script = read(text, OLD)
    assert all(-0x8000 <= action.value <= 0xFFFF and action.delay_ms >= 0 for action in script.actions)

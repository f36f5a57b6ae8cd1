"""Who may command whom: the first rule that fits decides, and only commands are judged."""

from collections.abc import Collection, Sequence
from itertools import permutations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.frame import EVERYONE, Address, Frame, Way
from psiu_broker.routing import policy as policy_module
from psiu_broker.routing.policy import KEPT, UNNAMED, Policy, Rule

BASE, PC, MNERIM, BRACO = (Address.named(name) for name in ("base", "PC", "MNERIM", "BRACO"))
ARM = Address.numbered(0x12)
RADIO, WIFI = Way("radio"), Way("wifi", ("192.168.1.20", 9001))


def text(source: Address, destination: Address, *words: str) -> Frame:
    return Frame(source, destination, words[0], " ".join(words).encode(), "psiu-ascii")


def is_command(frame: Frame, _: Way) -> bool:
    return b"sucesso" not in frame.payload and frame.subject != "qualseunome"


def policy(*rules: Rule, exposed: Collection[str] = (), named: Collection[Address] = ()) -> Policy:
    made = dict.fromkeys(exposed, named)
    return Policy(rules, {BASE}, is_command, exposed=made, strange=lambda way: way.peer is not None)


def deny(**what: str | tuple[str, ...]) -> Rule:
    return Rule(False, **{name: (globs,) if isinstance(globs, str) else globs for name, globs in what.items()})


def allow(**what: str | tuple[str, ...]) -> Rule:
    return Rule(True, **{name: (globs,) if isinstance(globs, str) else globs for name, globs in what.items()})


def test_without_rules_and_without_exposed_links_there_is_nothing_to_judge() -> None:
    assert policy().idle
    assert not policy(allow()).idle
    assert not policy(exposed=["wifi"]).idle


@pytest.mark.parametrize(
    ("rule", "denied"),
    [
        (deny(), True),
        (deny(source="PC"), True),
        (deny(source="P*"), True),
        (deny(source=("X", "?C")), True),
        (deny(source="pc"), False),
        (deny(source="MNERIM"), False),
        (deny(destination="MNERIM"), True),
        (deny(destination="BRACO"), False),
        (deny(command="parafrente"), True),
        (deny(command="PARA*"), True),
        (deny(command="paratras"), False),
        (deny(link="radio"), True),
        (deny(link="wifi"), False),
        (deny(source="PC", destination="MNERIM", command="para*", link="r?dio"), True),
        (deny(source="PC", destination="MNERIM", command="para*", link="wifi"), False),
    ],
)
def test_a_rule_fits_where_all_of_it_does(rule: Rule, denied: bool) -> None:
    assert (policy(rule).denial(text(PC, MNERIM, "parafrente", "100"), RADIO) is rule) is denied


def test_a_word_is_no_other_word_in_capitals() -> None:
    assert policy(deny(command="parafrente")).denial(text(PC, MNERIM, "ParaFrente", "100"), RADIO) is not None


def test_the_first_rule_that_fits_decides() -> None:
    inner, outer = allow(source="PC", command="pare"), deny(source="PC")
    made = policy(inner, outer)
    assert made.denial(text(PC, MNERIM, "pare"), RADIO) is None
    assert made.denial(text(PC, MNERIM, "parafrente", "1"), RADIO) is outer
    assert policy(outer, inner).denial(text(PC, MNERIM, "pare"), RADIO) is outer


@pytest.mark.parametrize("words", [("parafrente", "sucesso"), ("qualseunome",)])
def test_answers_and_questions_always_pass(words: tuple[str, ...]) -> None:
    assert policy(deny(), exposed=["wifi"]).denial(text(PC, MNERIM, *words), WIFI) is None


def test_an_answer_that_passed_does_not_let_the_command_of_that_name_pass_nor_the_other_way_round() -> None:
    made = policy(deny())
    for _ in range(3):
        assert made.denial(text(PC, MNERIM, "parafrente", "sucesso"), RADIO) is None
        assert made.denial(text(PC, MNERIM, "parafrente", "1"), RADIO) is not None


def test_what_is_said_to_the_broker_moves_nobody_and_passes() -> None:
    assert policy(deny(), exposed=["wifi"]).denial(text(PC, BASE, "parafrente", "1"), WIFI) is None


def test_a_stranger_beyond_this_computer_commands_nobody_unless_a_rule_lets_him() -> None:
    command = text(PC, MNERIM, "parafrente", "1")
    assert policy(exposed=["wifi"]).denial(command, WIFI) is UNNAMED
    assert policy(exposed=["wifi"]).denial(command, Way("wifi")) is None, "who is there is named"
    assert policy(exposed=["wifi"]).denial(command, RADIO) is None
    assert policy(exposed=["wifi"], named=[PC]).denial(command, WIFI) is None
    assert policy(exposed=["wifi"], named=[MNERIM]).denial(command, WIFI) is UNNAMED
    assert policy(allow(source="PC"), exposed=["wifi"]).denial(command, WIFI) is None
    assert policy(allow(source="BRACO"), exposed=["wifi"]).denial(command, WIFI) is UNNAMED


def test_a_stranger_that_somebody_names_later_is_let_in_at_once() -> None:
    strangers = {WIFI}
    made = Policy((), {BASE}, is_command, exposed={"wifi": ()}, strange=strangers.__contains__)
    command = text(PC, MNERIM, "parafrente", "1")
    assert made.denial(command, WIFI) is UNNAMED
    strangers.clear()
    assert made.denial(command, WIFI) is None
    strangers.add(WIFI)
    assert made.denial(command, WIFI) is UNNAMED


@pytest.mark.parametrize(
    ("rules", "denied"),
    [
        ((deny(destination="MNERIM"),), True),
        ((deny(destination="X?"),), True),
        ((deny(destination="MNERIM", command="paratras"),), False),
        ((allow(destination="M*"), deny()), True),
        ((allow(destination="??"), deny()), False),
        ((allow(), deny()), False),
    ],
)
def test_a_command_to_everyone_reaches_those_whom_a_rule_keeps_it_from(rules: tuple[Rule, ...], denied: bool) -> None:
    assert (policy(*rules).denial(text(PC, EVERYONE, "parafrente", "1"), RADIO) is not None) is denied


def test_two_question_marks_are_everyone_and_no_glob_for_two_letters() -> None:
    assert policy(deny(destination="??")).denial(text(MNERIM, PC, "parafrente", "1"), RADIO) is None


def test_a_robot_is_known_by_each_of_its_addresses() -> None:
    made = policy(deny(destination="BRACO"))
    node = Frame(PC, ARM, "node/4", b"\x04\x10", "psiu-hexa")
    assert made.denial(node, RADIO) is None
    made.addresses_of = lambda address: (BRACO, ARM) if address in (BRACO, ARM) else (address,)
    made.forget()
    assert made.denial(node, RADIO) is not None


def test_a_call_is_judged_by_all_its_names() -> None:
    rule = deny(command="garra")
    assert policy(rule).denial_of(BASE, BRACO, {"node", "node/4", "garra"}, Way("@self")) is rule
    assert policy(rule).denial_of(BASE, BRACO, {"node", "node/5"}, Way("@self")) is None


def test_what_is_kept_in_mind_has_an_end_and_decides_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    rule = deny(command="x7*")
    made = policy(rule)
    for number in range(3 * KEPT):
        frame = text(Address.named(f"R{number}"), MNERIM, f"x{number}")
        assert (made.denial(frame, RADIO) is rule) is str(number).startswith("7")
    made.denial(text(PC, MNERIM, "y" * 500), RADIO)
    kept = [*made._new, *made._old]
    assert len(kept) <= 2 * KEPT
    assert max(len(subject) for _, _, subject, _ in kept) <= policy_module.LONGEST_KEPT


def test_a_frame_seen_before_costs_no_more_judging(monkeypatch: pytest.MonkeyPatch) -> None:
    made = policy(deny(source="X"))
    frame = text(PC, MNERIM, "parafrente", "1")
    assert made.denial(frame, RADIO) is None
    monkeypatch.setattr(Rule, "fits", lambda *_: pytest.fail("judged again"))
    assert made.denial(frame, RADIO) is None


def test_no_first_word_is_every_word() -> None:
    """A robot may skip the spaces that a message begins with."""
    made = Policy((deny(command="parafrente"),), words=lambda frame: (frame.payload.decode().split()[0],))
    spaced = [Frame(PC, MNERIM, "", payload, "psiu-ascii") for payload in (b" oi", b" parafrente 100", b" oi")]
    assert [made.denial(frame, RADIO) is not None for frame in spaced] == [False, True, False]


def test_what_is_told_about_two_robots_says_which_rules_are_about_some_commands_and_what_denies_the_rest() -> None:
    some, rest = deny(command="paratras"), deny(source="PC")
    assert policy(some, rest).about(PC, MNERIM, RADIO) == ([some], rest)
    assert policy(some, allow(), rest).about(PC, MNERIM, RADIO) == ([some], None)
    assert policy(some, exposed=["wifi"]).about(PC, MNERIM, WIFI) == ([some], UNNAMED)
    assert policy(rest).about(PC, BASE, RADIO) == ([], None)


def test_a_rule_tells_where_it_is_written_and_what_it_says() -> None:
    rule = Rule(False, ("PC*",), ("BRACO", "MNERIM"), where="policy[1]")
    assert str(rule) == "policy[1] denies source PC*, destination BRACO or MNERIM"
    assert str(Rule(True, where="policy[0]")) == "policy[0] allows everything"


@pytest.mark.parametrize(
    ("glob", "address", "meant"),
    [
        ("0x5", Address.numbered(5), True),
        ("0x05", Address.numbered(5), True),
        ("0xAB", Address.numbered(0xAB), True),
        ("0xA*", Address.numbered(0xAB), True),
        ("red.0xB", Address.numbered(0xB, "red"), True),
        ("red.0xB", Address.numbered(0xB), False),
        ("0x5", Address.numbered(0x50), False),
        ("0x5", Address.named("0x5"), True),
        ("R[1]", Address.named("R[1]"), True),
        ("R[1]", Address.named("R1"), True),
        ("R[1]", Address.named("R2"), False),
        ("Rx0xAB", Address.named("Rx0xab"), False),
    ],
)
def test_whoever_is_written_in_a_rule_is_meant_however_a_number_is_written(
    glob: str, address: Address, meant: bool
) -> None:
    for rule, frame in (
        (deny(destination=glob), text(PC, address, "parafrente", "1")),
        (deny(source=glob), text(address, PC, "parafrente", "1")),
    ):
        assert (policy(rule).denial(frame, RADIO) is not None) is meant


NAMES = st.sampled_from(["PC", "MNERIM", "BRACO", "P*", "*", "M?ERIM", "??", "[PB]*"])
GLOBS = st.lists(NAMES, min_size=1, max_size=2).map(tuple)
WORDS = st.sampled_from(["parafrente", "para*", "*", "PARE", "node/*"])
LINKS = st.sampled_from(["radio", "wifi", "*", "@self"])
RULES = st.builds(
    Rule,
    st.booleans(),
    GLOBS,
    GLOBS,
    st.lists(WORDS, min_size=1, max_size=2).map(tuple),
    st.lists(LINKS, min_size=1, max_size=2).map(tuple),
)
ADDRESSES = st.sampled_from([PC, MNERIM, BRACO, ARM, EVERYONE, Address.named("pc")])
FRAMES = st.builds(text, ADDRESSES, ADDRESSES, st.sampled_from(["parafrente", "pare", "node/4", "oi"]))
WAYS = st.sampled_from([RADIO, WIFI, Way("wifi", ("10.0.0.1", 2))])


def fits(rule: Rule, frame: Frame, arrived: Way) -> bool:
    return rule.fits((str(frame.source),), (str(frame.destination),), (frame.subject,), arrived.link)


@given(st.lists(RULES, max_size=6), st.lists(st.tuples(FRAMES, WAYS), min_size=1, max_size=12))
def test_the_first_that_fits_decides_whatever_was_judged_before(
    rules: Sequence[Rule], heard: Sequence[tuple[Frame, Way]]
) -> None:
    made = policy(*rules)
    for frame, arrived in heard:
        first = next((rule for rule in rules if fits(rule, frame, arrived)), None)
        assert made.denial(frame, arrived) is (first if first is not None and not first.allow else None)


@given(st.lists(RULES, min_size=2, max_size=4), FRAMES, WAYS)
def test_the_order_of_rules_that_do_not_meet_in_a_frame_does_not_matter(
    rules: Sequence[Rule], frame: Frame, arrived: Way
) -> None:
    unrelated = [rule for rule in rules if not fits(rule, frame, arrived)]
    related = [rule for rule in rules if fits(rule, frame, arrived)][:1]
    denials = {policy(*order).denial(frame, arrived) for order in permutations(unrelated + related)}
    assert len(denials) == 1


ANY_TEXT = st.text(max_size=20)
ANY_ADDRESS = st.builds(Address, ANY_TEXT, st.integers(-1, 255), ANY_TEXT)
ANY_FRAME = st.builds(Frame, ANY_ADDRESS, ANY_ADDRESS, ANY_TEXT, st.binary(max_size=20), ANY_TEXT)
ANY_GLOBS = st.lists(ANY_TEXT.filter(bool), min_size=1, max_size=3).map(tuple)


@given(
    st.lists(st.builds(Rule, st.booleans(), ANY_GLOBS, ANY_GLOBS, ANY_GLOBS, ANY_GLOBS), max_size=3),
    ANY_FRAME,
    st.builds(Way, ANY_TEXT, st.none() | ANY_TEXT),
)
def test_no_frame_and_no_glob_makes_it_raise(rules: Sequence[Rule], frame: Frame, arrived: Way) -> None:
    made = policy(*rules, exposed=["wifi"])
    assert made.denial(frame, arrived) in (None, UNNAMED, *rules)
    made.about(frame.source, frame.destination, arrived)
    assert all(str(rule) for rule in rules)

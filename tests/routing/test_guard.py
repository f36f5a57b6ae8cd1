"""What is not listened to: sources that are elsewhere, denied commands, one name too many, storms; and what stays."""

from itertools import accumulate

import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.frame import EVERYONE, MESH, Address, Frame, Way
from psiu_broker.routing.guard import (
    REFUSALS_KEPT,
    STOP_EVERYONE_AT_ONCE,
    STOP_EVERYONE_EVERY_S,
    STOPPING_KEPT,
    TO_EVERYONE_AT_ONCE,
    TO_EVERYONE_EVERY_S,
    Guard,
)
from psiu_broker.routing.policy import Policy, Rule
from psiu_broker.routing.quarantine import TURNS
from psiu_broker.routing.router import ANY, SELF, Port, Router
from psiu_broker.routing.table import Binding

BASE, PC, MNERIM, BETA, GAMA = (Address.named(name) for name in ("base", "PC", "MNERIM", "BETA", "GAMA"))
RADIO, CABLE = Way("radio"), Way("cable")
HERS, HIS = Way("wifi", ("192.168.1.20", 9001)), Way("wifi", ("192.168.1.66", 9001))


def text(source: Address, destination: Address, said: str = "parafrente", serial: int = 0) -> Frame:
    wire = f"{destination} {said} {source} {serial}".encode()
    return Frame(source, destination, said.partition(" ")[0], said.encode(), "psiu-ascii", wire, "psiu-ascii/1")


def made(per_minute: int | None = None) -> Router:
    """MNERIM belongs on the radio, BETA at her address on the Wi-Fi, GAMA anywhere there."""
    bindings = (
        Binding(MNERIM, None, RADIO, "psiu-ascii"),
        Binding(BETA, None, HERS, "psiu-ascii"),
        Binding(GAMA, None, Way("wifi"), "psiu-ascii"),
    )
    router = Router({BASE: "psiu-ascii"}, bindings, lambda frame: frame.wire)
    router.link_up(Port("radio", "psiu-ascii", lambda: (RADIO,), new_names_per_minute=per_minute))
    router.link_up(Port("cable", "psiu-ascii", lambda: (CABLE,), new_names_per_minute=per_minute))
    router.link_up(Port("wifi", "psiu-ascii", lambda: (HERS, HIS), new_names_per_minute=per_minute))
    router.link_up(Port(MESH, ANY, lambda: (Way(MESH, "north"),)))
    return router


@pytest.fixture
def router() -> Router:
    return made()


# A source bound to a link.


@pytest.mark.parametrize(
    ("source", "way"), [(MNERIM, CABLE), (MNERIM, HERS), (BETA, HIS), (BETA, RADIO), (GAMA, RADIO), (BASE, RADIO)]
)
def test_a_robot_of_the_configuration_is_believed_only_where_that_puts_it(
    router: Router, source: Address, way: Way
) -> None:
    decision = router.route(text(source, PC), way, 0.0)
    assert (decision.action, decision.verdict, decision.void) == ("drop", "spoofed", True)
    refusal = router.guard.last_refusal(source)
    assert refusal is not None
    assert (refusal.verdict, refusal.way, refusal.count) == ("spoofed", way, 1)


@pytest.mark.parametrize(("source", "way"), [(MNERIM, RADIO), (BETA, HERS), (GAMA, HERS), (GAMA, HIS), (PC, CABLE)])
def test_where_the_configuration_puts_a_robot_it_is_believed_and_so_is_whoever_it_puts_nowhere(
    router: Router, source: Address, way: Way
) -> None:
    assert router.route(text(source, BASE), way, 0.0).action == "answer"
    assert router.guard.last_refusal(source) is None


def test_what_another_broker_heard_is_that_broker_s_to_judge(router: Router) -> None:
    assert router.route(text(MNERIM, BASE), Way(MESH, "north"), 0.0).action == "answer"


def test_nobody_passes_for_this_broker_by_way_of_another(router: Router) -> None:
    assert router.route(text(BASE, MNERIM), Way(MESH, "north"), 0.0).verdict == "spoofed"


def test_the_broker_may_speak_for_any_robot(router: Router) -> None:
    router.route(text(PC, BASE), CABLE, 0.0)
    assert router.route(text(MNERIM, PC), SELF, 0.0).action == "forward"


def test_an_imitation_does_not_make_the_true_frame_a_double(router: Router) -> None:
    assert router.route(text(MNERIM, BASE), CABLE, 0.0).verdict == "spoofed"
    assert router.route(text(MNERIM, BASE), RADIO, 0.1).action == "answer"


def test_what_a_second_radio_overhears_of_a_robot_is_a_double_and_no_lie(router: Router) -> None:
    assert router.route(text(MNERIM, BASE), RADIO, 0.0).action == "answer"
    assert router.route(text(MNERIM, BASE), CABLE, 0.1).verdict == "duplicate"
    assert router.guard.last_refusal(MNERIM) is None


# A policy.


def test_a_denied_command_goes_nowhere_and_teaches_nothing(router: Router) -> None:
    rule = Rule(False, source=("PC",))
    router.obey(Policy((rule,), {BASE}))
    decision = router.route(text(PC, MNERIM), CABLE, 0.0)
    assert (decision.verdict, decision.void) == ("denied", True)
    assert router.find(PC) is None
    refusal = router.guard.last_refusal(PC)
    assert refusal is not None
    assert (refusal.rule, refusal.destination, refusal.subject) == (rule, MNERIM, "parafrente")


def test_a_denied_command_moves_no_route(router: Router) -> None:
    router.obey(Policy((Rule(False, link=("wifi",)),), {BASE}))
    router.route(text(PC, MNERIM), CABLE, 0.0)
    router.route(text(PC, MNERIM, "paratras"), HIS, 0.1)
    route = router.find(PC)
    assert route is not None
    assert route.way == CABLE


def test_a_denied_command_does_not_make_the_same_one_from_elsewhere_a_double(router: Router) -> None:
    router.obey(Policy((Rule(False, link=("wifi",)),), {BASE}))
    assert router.route(text(PC, MNERIM), HIS, 0.0).verdict == "denied"
    assert router.route(text(PC, MNERIM), CABLE, 0.1).action == "forward"


def test_nobody_is_asked_for_a_robot_that_may_not_be_commanded(router: Router) -> None:
    router.obey(Policy((Rule(False, destination=("NOVO",)),), {BASE}))
    assert router.route(text(PC, Address.named("NOVO")), CABLE, 0.0).verdict == "denied"


def test_the_broker_s_own_frames_are_judged_where_they_are_calls(router: Router) -> None:
    router.obey(Policy((Rule(False),), {BASE}))
    assert router.route(text(BASE, MNERIM), SELF, 0.0).action == "forward"


def test_a_robot_that_another_broker_announces_is_known_by_its_name_from_then_on(router: Router) -> None:
    number = Address.numbered(9)
    router.obey(Policy((Rule(False, destination=("FAR",)),), {BASE}))
    packet = Frame(Address.numbered(3), number, "node/1", b"\x01\x02", "psiu-hexa", b"1", "h")
    assert router.route(packet, CABLE, 0.0).verdict != "denied"
    router.announced((Address.named("FAR"), number), Way(MESH, "north"), "psiu-hexa", 1.0)
    assert router.route(packet._replace(wire=b"2"), CABLE, 2.0).verdict == "denied"
    router.unannounced(Address.named("FAR"), 3.0)
    assert router.route(packet._replace(wire=b"3"), CABLE, 4.0).verdict != "denied"


def test_a_policy_that_denies_nothing_is_not_asked(router: Router) -> None:
    router.obey(Policy())
    assert router.policy is None


# New names.


def names(router: Router, way: Way, first: int, count: int, now: float) -> list[str | None]:
    frames = [text(Address.named(f"R{number}"), BASE) for number in range(first, first + count)]
    return [router.route(frame, way, now).verdict for frame in frames]


def test_no_more_new_names_a_minute_than_the_link_may_bring() -> None:
    router = made(per_minute=6)
    assert names(router, CABLE, 0, 10, 100.0) == [None] * 6 + ["too_many_names"] * 4
    assert len(router.robots()) == 3 + 6
    assert names(router, RADIO, 10, 1, 100.0) == [None], "another link has its own"
    assert names(router, CABLE, 20, 2, 110.0) == [None, "too_many_names"]
    assert names(router, CABLE, 30, 10, 170.0) == [None] * 6 + ["too_many_names"] * 4


def test_who_is_known_is_heard_however_many_are_not() -> None:
    router = made(per_minute=6)
    names(router, CABLE, 0, 100, 0.0)
    for number in range(6):
        assert router.route(text(Address.named(f"R{number}"), BASE, serial=1), CABLE, 1.0).action == "answer"
    assert router.route(text(MNERIM, BASE), RADIO, 1.0).action == "answer", "the configuration knows it"


def test_robots_that_come_back_with_their_link_are_not_new() -> None:
    router = made(per_minute=6)
    names(router, CABLE, 0, 6, 0.0)
    router.link_down("cable", 1.0)
    router.link_up(Port("cable", "psiu-ascii", lambda: (CABLE,), new_names_per_minute=6))
    assert names(router, CABLE, 0, 6, 2.0) == [None] * 6
    assert names(router, CABLE, 6, 1, 2.0) == ["too_many_names"], "and nothing new is free by that"


@pytest.mark.parametrize(("destination", "action"), [(BETA, "forward"), (EVERYONE, "flood"), (BASE, "answer")])
def test_the_stop_of_one_name_too_many_passes_and_teaches_nothing(destination: Address, action: str) -> None:
    router = made(per_minute=6)
    names(router, CABLE, 0, 7, 0.0)
    remote = Address.named("REMOTE")
    assert router.route(text(remote, destination, "anda"), CABLE, 1.0).verdict == "too_many_names"
    assert router.route(text(remote, destination, "pare sucesso"), CABLE, 1.0).verdict == "too_many_names"
    assert router.route(text(remote, destination, "pare"), CABLE, 1.0).action == action
    assert router.find(remote) is None
    assert names(router, CABLE, 7, 1, 1.0) == ["too_many_names"]


def test_stops_use_up_no_turns_of_new_names() -> None:
    router = made(per_minute=6)
    names(router, CABLE, 0, 6, 0.0)
    for number in range(100):
        router.route(text(Address.named(f"S{number}"), BETA, "pare", number), CABLE, 1.0)
    assert names(router, CABLE, 6, 1, 10.0) == [None], "what ten seconds bring is there for a newcomer"


def test_a_stop_passes_even_where_it_shows_that_a_name_is_taken(router: Router) -> None:
    for turn in range(TURNS - 1):
        assert router.route(text(PC, BASE, serial=turn), CABLE, 4.0 * turn).verdict is None
        assert router.route(text(PC, BASE, serial=-turn - 1), RADIO, 4.0 * turn + 2).verdict is None
    router.route(text(PC, BASE, serial=90), CABLE, 50.0)
    assert router.route(text(PC, BETA, "pare"), RADIO, 52.0).action == "forward"
    assert router.quarantine.holds(PC, "radio")
    route = router.find(PC)
    assert route is not None
    assert route.way == CABLE


# Storms.


def question(number: int, word: str = "qualseunome") -> Frame:
    return text(PC, EVERYONE, word, number)


def test_frames_to_everyone_are_damped_to_a_steady_rate_on_the_link_they_come_from(router: Router) -> None:
    at_once = [router.route(question(number), CABLE, 10.0).verdict for number in range(3 * TO_EVERYONE_AT_ONCE)]
    assert at_once == [None] * TO_EVERYONE_AT_ONCE + ["storm"] * 2 * TO_EVERYONE_AT_ONCE
    assert router.route(text(MNERIM, EVERYONE, "qualseunome"), RADIO, 10.0).verdict is None
    passed = [
        router.route(question(1000 + tick), CABLE, 20.0 + tick / 100).verdict is None for tick in range(1000)
    ]  # a hundred a second, for ten seconds
    assert sum(passed[500:]) == pytest.approx(5.0 / TO_EVERYONE_EVERY_S, abs=1)


def test_other_frames_to_everyone_leave_a_stop_for_everyone_its_turn(router: Router) -> None:
    for number in range(3 * TO_EVERYONE_AT_ONCE):
        router.route(question(number), CABLE, 10.0)
    assert router.route(question(1, "pare"), CABLE, 10.0).action == "flood"


def passes(router: Router, said: str, way: Way, now: float, serial: int) -> bool:
    """Whether a stop to everyone, which nobody else has said in just these bytes, is let through."""
    decision = router.route(text(PC, EVERYONE, said, serial), way, now)
    assert decision.action == "flood" or (decision.verdict, decision.void) == ("storm", True)
    return decision.action == "flood"


@pytest.mark.parametrize("said", ["pare", "stop", "pare {}", "PARE", "parar agora"])
def test_stops_for_everyone_are_damped_to_a_steady_rate(router: Router, said: str) -> None:
    at_once = [passes(router, said.format(each), CABLE, 10.0, each) for each in range(3 * STOP_EVERYONE_AT_ONCE)]
    assert sum(at_once) == STOP_EVERYONE_AT_ONCE
    assert all(at_once[:STOP_EVERYONE_AT_ONCE])
    a_thousand_a_second = [
        passes(router, said.format(each), CABLE, 20.0 + each / 1000, 1000 + each) for each in range(5000)
    ]
    assert sum(a_thousand_a_second[2500:]) == pytest.approx(2.5 / STOP_EVERYONE_EVERY_S, abs=1)


def test_stops_that_are_more_than_a_word_share_the_turns_of_one_and_leave_the_words_theirs(router: Router) -> None:
    for number in range(STOP_EVERYONE_AT_ONCE):
        assert passes(router, f"pare {number}", CABLE, 10.0, number)
    assert not passes(router, "stop 1", CABLE, 10.0, 1)
    assert not passes(router, "PARE", CABLE, 10.0, 1)
    assert passes(router, "pare", CABLE, 10.0, 1)
    assert passes(router, "stop 1", HIS, 10.0, 2), "another far end has its own"


def test_the_answer_to_a_stop_is_damped_as_any_frame_to_everyone_is(router: Router) -> None:
    passed = [
        router.route(text(PC, EVERYONE, f"pare sucesso {number}", number), CABLE, 10.0).action == "flood"
        for number in range(3 * TO_EVERYONE_AT_ONCE)
    ]
    assert sum(passed) == TO_EVERYONE_AT_ONCE


stops_to_everyone = st.lists(
    st.tuples(
        st.sampled_from(["pare", "pare", "pare", "para", "stop", "pare 1", "pare 2", "PARE"]),
        st.sampled_from([CABLE, CABLE, RADIO, HIS, HERS]),
        st.sampled_from([0.0, 0.0, 0.0, 0.001, 0.02, 0.6]),
        st.integers(1, 2 * STOP_EVERYONE_AT_ONCE),
    ),
    max_size=20,
)


@given(stops_to_everyone)
def test_a_stop_is_damped_only_right_behind_its_equal_that_the_same_robots_heard(
    steps: list[tuple[str, Way, float, int]],
) -> None:
    router = made()
    heard: dict[tuple[str, Way], float] = {}
    moments = accumulate((pause for _, _, pause, _ in steps), initial=100.0)
    for (said, way, _, times), now in zip(steps, moments, strict=False):
        for serial in range(times):
            decision = router.route(text(PC, EVERYONE, said, serial), way, now)
            if decision.verdict == "duplicate":
                continue
            if decision.action == "flood":
                heard[said, way] = now
            elif said in ("pare", "para", "stop"):
                assert now - heard[said, way] < STOP_EVERYONE_EVERY_S


def test_what_is_remembered_of_those_who_stop_everyone_has_an_end() -> None:
    guard = Guard()
    for port in range(2 * STOPPING_KEPT):
        assert guard.may_stop_everyone(b"pare", Way("wifi", port), 0.0)
    assert len(guard._stopping) == STOPPING_KEPT


def test_whoever_imitates_a_stop_where_it_goes_nowhere_does_not_make_a_double_of_the_true_one(router: Router) -> None:
    router.route(text(GAMA, BASE), HERS, 0.0)
    assert router.route(text(PC, MNERIM, "pare"), RADIO, 1.0).verdict == "same_way"
    assert router.route(text(PC, MNERIM, "pare"), CABLE, 1.5).action == "forward"
    assert router.route(text(PC, MNERIM, "pare"), HERS, 1.6).verdict == "duplicate"


def test_a_frame_that_two_radios_heard_goes_out_once_where_its_robot_heard_it_itself(router: Router) -> None:
    assert router.route(text(PC, MNERIM, "parafrente"), RADIO, 1.0).verdict == "same_way"
    assert router.route(text(PC, MNERIM, "parafrente"), CABLE, 1.5).verdict == "duplicate"


def test_what_was_one_too_many_makes_no_double_of_what_comes_by_another_link() -> None:
    router = made(per_minute=1)
    router.route(text(Address.named("EVIL"), BASE), CABLE, 9.0)
    assert router.route(text(PC, MNERIM), CABLE, 10.0).verdict == "too_many_names"
    assert router.route(text(PC, MNERIM), HERS, 10.1).action == "forward"
    for number in range(TO_EVERYONE_AT_ONCE):
        router.route(question(number), HERS, 11.0)
    assert router.route(question(1000), HERS, 11.0).verdict == "storm"
    assert router.route(question(1000), CABLE, 11.1).action == "flood"


def test_a_storm_keeps_no_frame_for_one_robot_back(router: Router) -> None:
    for number in range(3 * TO_EVERYONE_AT_ONCE):
        router.route(question(number), CABLE, 10.0)
    assert router.route(text(PC, MNERIM), CABLE, 10.0).action == "forward"
    assert router.route(question(5000), SELF, 10.0).action == "flood"


def test_what_is_remembered_of_those_turned_away_has_an_end() -> None:
    guard = Guard()
    for number in range(2 * REFUSALS_KEPT):
        guard.refused(text(Address.named(f"R{number}"), MNERIM), "spoofed", CABLE, float(number))
    assert guard.last_refusal(Address.named("R0")) is None
    last = guard.last_refusal(Address.named(f"R{2 * REFUSALS_KEPT - 1}"))
    assert last is not None
    guard.refused(text(Address.named(f"R{2 * REFUSALS_KEPT - 1}"), MNERIM), "denied", RADIO, 1e6)
    again = guard.last_refusal(Address.named(f"R{2 * REFUSALS_KEPT - 1}"))
    assert again is not None
    assert (again.count, again.verdict, again.at) == (2, "denied", 1e6)

"""Which frame a robot speaks of: stops beside calls, late replies, commands without waiting, and complaints."""

import asyncio
from collections.abc import Callable, Sequence

import pytest
from scripted_robots import MNERIM, Robots, jumping, now, refused

from psiu_broker.conversation.late_replies import OWED_KEPT
from psiu_broker.conversation.turns import WAITING_KEPT
from psiu_broker.errors import CallError
from psiu_broker.frame import Address, Frame


def slow_once(
    first_s: float, then_s: float, answer: Callable[[Frame], bytes]
) -> Callable[[Frame], Sequence[tuple[float, bytes]]]:
    """A script: the first frame is answered after `first_s`, every other after `then_s`."""
    delays = [first_s]
    return lambda frame: [(delays.pop() if delays else then_s, answer(frame))]


# Stops.


@jumping
async def test_a_stop_goes_at_once_beside_the_call_under_way_and_each_has_its_own_answer() -> None:
    robots = Robots()
    robots.script = lambda frame: [(5.0, b"parafrente falha")] if b"500" in frame.payload else [(0.2, b"pare sucesso")]
    motion = asyncio.ensure_future(robots.ascii("parafrente", 500))
    await asyncio.sleep(1)
    assert (await robots.ascii("pare", timeout_s=1)).status == "sucesso"
    assert robots.sent == [(0.0, b"parafrente 500"), (1.0, b"pare")]
    assert not motion.done()
    assert (await motion).status == "falha"
    assert robots.idle


@jumping
async def test_a_stop_waits_neither_for_other_stops_nor_for_late_answers() -> None:
    robots = Robots()
    first = asyncio.ensure_future(robots.ascii("pare", timeout_s=1))
    await asyncio.sleep(0.1)
    second = asyncio.ensure_future(robots.ascii("pare", timeout_s=3))
    await refused(first)
    third = asyncio.ensure_future(robots.ascii("pare", timeout_s=3))
    await asyncio.sleep(0.1)
    assert [at for at, _ in robots.sent] == pytest.approx([0, 0.1, 1.0])
    done = []
    for _ in range(3):
        assert robots.says(b"pare sucesso", MNERIM)
        await asyncio.sleep(0.01)
        done.append((second.done(), third.done()))
    assert done == [(True, False), (True, True), (True, True)]
    assert {(await second).status, (await third).status} == {"sucesso"}


@jumping
async def test_two_stops_answered_in_one_breath_are_both_answered() -> None:
    robots = Robots()
    calls = [asyncio.ensure_future(robots.ascii("pare")) for _ in range(2)]
    await asyncio.sleep(0.1)
    assert robots.says(b"pare sucesso", MNERIM)
    assert robots.says(b"pare falha", MNERIM)
    assert [(await call).status for call in calls] == ["sucesso", "falha"]


@jumping
async def test_a_stop_that_the_robot_confirms_is_confirmed_whatever_became_of_those_before() -> None:
    robots = Robots()
    await robots.conversations.tell(robots.of_words(), "pare", [], fresh_s=2)  # the robot does not hear it
    robots.script = lambda _: [(0.1, b"pare sucesso")]
    assert (await robots.ascii("pare")).status == "sucesso"


# Late replies.


@jumping
async def test_the_late_answer_to_a_question_asked_again_is_not_the_next_answer() -> None:
    robots = Robots()
    robots.script = slow_once(2.1, 0.3, lambda frame: b"exibecomando c%s 1 0 0" % frame.payload.split()[1])
    assert [(await robots.ascii("exibecomando", n)).values[0] for n in (1, 2, 3)] == ["c1", "c2", "c3"]
    assert [at for at, _ in robots.sent] == pytest.approx([0, 2.012, 2.312, 2.612])


@jumping
async def test_the_late_value_of_one_sensor_is_not_the_value_of_another() -> None:
    robots = Robots()
    robots.script = slow_once(2.1, 0.3, lambda frame: bytes((0, frame.payload[0] * 11)))
    assert (await robots.hexa("sonar")).values == [77]
    assert (await robots.hexa("luz")).values == [88]


@jumping
async def test_a_late_sucesso_does_not_end_the_next_motion() -> None:
    robots = Robots()
    assert (await refused(robots.ascii("parafrente", 100, timeout_s=0.5))).code == "outcome_unknown"
    second = asyncio.ensure_future(robots.ascii("parafrente", 5))
    await asyncio.sleep(0.5)
    assert robots.says(b"parafrente sucesso", MNERIM)
    await asyncio.sleep(0.1)
    assert not second.done()
    assert robots.sent == [(0.0, b"parafrente 100"), (1.0, b"parafrente 5")]
    assert robots.says(b"parafrente falha", MNERIM)
    assert (await second).status == "falha"


@jumping
async def test_a_late_answer_holds_up_nothing_that_it_cannot_be_mistaken_for() -> None:
    robots = Robots()
    await refused(robots.ascii("parafrente", 100, timeout_s=0.5))
    turning = asyncio.ensure_future(robots.ascii("giradireita", 90))
    await asyncio.sleep(0.1)
    assert robots.sent[1] == (0.5, b"giradireita 90")
    assert robots.says(b"parafrente sucesso", MNERIM)
    await asyncio.sleep(0.1)
    assert not turning.done()
    assert robots.says(b"giradireita sucesso", MNERIM)
    await turning


@jumping
async def test_a_robot_that_never_answers_is_waited_for_only_as_long_as_an_answer_may_take() -> None:
    robots = Robots()
    await refused(robots.ascii("parafrente", 100, timeout_s=0.5))
    await refused(robots.ascii("parafrente", 5))
    assert [at for at, _ in robots.sent] == pytest.approx([0, 3.2])


@jumping
async def test_a_caller_without_the_time_to_wait_for_a_late_answer_is_told_that_nothing_was_sent() -> None:
    robots = Robots()
    await refused(robots.ascii("parafrente", 100, timeout_s=0.5))
    error = await refused(robots.ascii("parafrente", 5, timeout_s=1))
    assert error.code == "expired"
    assert "owes an answer" in str(error)
    assert now() - robots.begun == pytest.approx(1.5)
    assert robots.payloads == [b"parafrente 100"]


@jumping
async def test_who_waits_for_a_late_answer_hears_that_the_link_went_down_or_the_broker_stops() -> None:
    robots = Robots()
    for end, code in (
        (lambda: robots.conversations.link_down("radio", "unplugged"), "link_down"),
        (robots.conversations.close, "shutting_down"),
    ):
        await refused(robots.ascii("parafrente", 100, timeout_s=0.1))
        waiting = asyncio.ensure_future(robots.ascii("parafrente", 5))
        await asyncio.sleep(0.1)
        end()
        error = await refused(waiting)
        assert error.code == code
        assert "unknown" not in str(error)
    assert set(robots.payloads) == {b"parafrente 100"}


@jumping
async def test_an_answer_that_comes_before_the_command_has_left_is_not_its_answer() -> None:
    robots = Robots()
    await refused(robots.ascii("parafrente", 100, timeout_s=0.5))
    second = asyncio.ensure_future(robots.ascii("parafrente", 5))
    await asyncio.sleep(0)
    assert robots.says(b"parafrente sucesso", MNERIM)
    assert not robots.says(b"parafrente falha", MNERIM)
    robots.script = lambda _: [(0.1, b"parafrente sucesso")]
    assert (await second).status == "sucesso"


@jumping
async def test_a_caller_that_gave_up_leaves_no_answer_to_the_next() -> None:
    robots = Robots()
    first = asyncio.ensure_future(robots.hexa("garra", 10))
    await asyncio.sleep(0.1)
    first.cancel()
    await asyncio.wait([first])
    robots.script = lambda _: [(0.1, b"W")]
    second = asyncio.ensure_future(robots.hexa("garra", 20))
    await asyncio.sleep(0.5)
    assert robots.says(b"A")
    assert (await refused(second)).code == "impossible"


@jumping
async def test_a_busy_robots_late_word_about_itself_does_not_move_it_twice() -> None:
    robots = Robots(busy_poll_s=0.5)
    robots.script = lambda frame: [(0.6, b"B")] if frame.payload == b"?" else [(0.1, b"B"), (0.8, b"A")]
    assert (await robots.hexa("garra", 10)).status == "sucesso"
    robots.script = lambda _: [(0.6, b"A")]
    assert (await robots.hexa("garra", 20)).status == "sucesso"
    assert [payload for payload in robots.payloads if payload != b"?"] == [b"\x04\x0e", b"\x04\x1c"]


@jumping
async def test_what_waits_in_an_outbox_is_answered_by_nothing_that_is_heard() -> None:
    robots = Robots()
    robots.stuck = True
    call = asyncio.ensure_future(robots.hexa("garra", 10))
    await asyncio.sleep(0.1)
    assert not robots.says(b"A")
    robots.flows()
    await asyncio.sleep(0.1)
    assert not call.done()
    assert robots.says(b"A")
    assert (await call).status == "sucesso"


@jumping
async def test_the_answer_to_a_command_that_left_late_is_not_the_next_ones() -> None:
    robots = Robots()
    robots.stuck = True
    first = asyncio.ensure_future(robots.hexa("garra", 10, timeout_s=2))
    await asyncio.sleep(1.9)
    robots.flows()
    assert (await refused(first)).code == "outcome_unknown"
    second = asyncio.ensure_future(robots.hexa("garra", 20))
    await asyncio.sleep(1)
    assert robots.says(b"A")
    await asyncio.sleep(0.1)
    assert not second.done()
    assert robots.sent[1:] == [(3.0, b"\x04\x1c")]
    assert robots.says(b"A")
    await second


@jumping
async def test_the_answer_to_a_put_that_left_late_is_not_the_next_calls() -> None:
    robots = Robots()
    robots.stuck = True
    await robots.conversations.tell(robots.of_bytes(), "garra", [10], fresh_s=2)
    await asyncio.sleep(1)
    assert not robots.says(b"A")  # whatever it is about
    call = asyncio.ensure_future(robots.hexa("garra", 20, timeout_s=10))
    await asyncio.sleep(0.9)
    robots.flows()
    await asyncio.sleep(0.3)
    assert robots.says(b"A")
    await asyncio.sleep(0.1)
    assert robots.sent == [(1.9, b"\x04\x0e"), (2.2, b"\x04\x1c")]
    assert not call.done()
    assert robots.says(b"A")
    await call


@jumping
async def test_a_put_that_left_late_and_is_never_answered_is_waited_for_from_then_on() -> None:
    robots = Robots()
    robots.stuck = True
    await robots.conversations.tell(robots.of_bytes(), "garra", [10], fresh_s=2)
    call = asyncio.ensure_future(robots.hexa("garra", 20, timeout_s=10))
    await asyncio.sleep(0.5)
    robots.flows()
    robots.script = lambda _: [(0.1, b"A")]
    await call
    assert robots.sent[1:] == [(2.5, b"\x04\x1c")]


@jumping
async def test_of_two_puts_alike_it_is_the_dropped_one_that_is_not_owed_for() -> None:
    robots = Robots()
    await robots.conversations.tell(robots.of_bytes(), "garra", [10], fresh_s=2)
    robots.stuck = True
    await robots.conversations.tell(robots.of_bytes(), "garra", [10], fresh_s=2)
    robots.conversations.undelivered(robots._kept.pop()[1], CallError("expired", "too late"))
    assert robots.says(b"A")
    assert not robots.says(b"A")


@jumping
async def test_of_two_puts_alike_only_the_one_that_left_is_owed_for() -> None:
    robots = Robots()
    robots.stuck = True
    for _ in range(2):
        await robots.conversations.tell(robots.of_bytes(), "garra", [10], fresh_s=2)
    robots.conversations.delivered(robots._kept[0][1], now())
    assert robots.says(b"A")
    assert not robots.says(b"A")


@jumping
async def test_polls_that_never_left_are_not_owed_for() -> None:
    robots = Robots(busy_poll_s=0.1)
    robots.script = lambda frame: [(0.01, b"F" if frame.payload == b"?" else b"BA"[len(robots.sent) > 1 :][:1])]
    call = asyncio.ensure_future(robots.hexa("garra", 10, timeout_s=8))
    await asyncio.sleep(0.05)
    robots.stuck = True
    for _ in range(5):  # the clock of the links
        await asyncio.sleep(0.1)
        robots.expire("arm")
    robots.stuck = False
    assert (await call).status == "sucesso"
    robots.expire("arm")
    begun = now()
    await robots.hexa("garra", 20)
    assert robots.sent[-1][0] == pytest.approx(begun - robots.begun)


@jumping
async def test_a_word_too_many_from_the_robot_pays_for_nothing_that_it_owes() -> None:
    robots = Robots(busy_poll_s=0.5)
    robots.script = lambda frame: [] if frame.payload == b"?" else [(0.1, b"B"), (0.2, b"F")]
    assert (await refused(robots.hexa("garra", 10, timeout_s=0.8))).code == "busy"
    robots.script = lambda _: [(0.1, b"A")]
    second = asyncio.ensure_future(robots.hexa("garra", 20))
    await asyncio.sleep(0.5)
    assert robots.says(b"F")
    await second
    assert robots.sent[-1] == (1.3, b"\x04\x1c")


# Commands without waiting.


@jumping
async def test_a_put_waits_its_turn_and_its_answer_ends_no_call() -> None:
    robots = Robots()
    robots.script = lambda frame: [(1, b"parafrente sucesso" if b"500" in frame.payload else b"parafrente falha")]
    call = asyncio.ensure_future(robots.ascii("parafrente", 500))
    await asyncio.sleep(0.1)
    await robots.conversations.tell(robots.of_words(), "parafrente", [1], fresh_s=2)
    assert robots.sent == [(0.0, b"parafrente 500"), (1.0, b"parafrente 1")]
    assert (await call).status == "sucesso"
    robots.script = lambda _: [(1, b"parafrente sucesso")]
    assert (await robots.ascii("parafrente", 2)).status == "sucesso"
    assert robots.sent[2] == (2.0, b"parafrente 2")


@jumping
async def test_a_put_too_old_for_its_turn_is_not_sent() -> None:
    robots = Robots()
    call = asyncio.ensure_future(robots.ascii("parafrente", 500))
    await asyncio.sleep(0)
    assert (await refused(robots.conversations.tell(robots.of_words(), "luz", [1], fresh_s=2))).code == "expired"
    assert now() - robots.begun == pytest.approx(2)
    assert (await refused(robots.conversations.tell(robots.of_words(), "pare", [], fresh_s=-1))).code == "expired"
    call.cancel()
    assert robots.payloads == [b"parafrente 500"]


@jumping
async def test_a_stop_by_put_goes_at_once() -> None:
    robots = Robots()
    call = asyncio.ensure_future(robots.ascii("parafrente", 500))
    await asyncio.sleep(0.1)
    await robots.conversations.tell(robots.of_words(), "pare", [], fresh_s=2)
    assert robots.sent[1] == (0.1, b"pare")
    call.cancel()


@pytest.mark.parametrize("answers", [True, False])
@jumping
async def test_a_stream_of_set_points_is_not_held_up_by_its_answers(answers: bool) -> None:
    robots = Robots()
    robots.script = lambda _: [(0.05, b"A")] if answers else ()
    for number in range(60):
        await robots.conversations.tell(robots.of_bytes(), "garra", [number], fresh_s=2)
        await asyncio.sleep(0.033)
    assert len(robots.sent) == 60
    assert now() - robots.begun == pytest.approx(60 * 0.033)


@jumping
async def test_a_call_among_set_points_waits_for_their_answers_and_then_has_its_own() -> None:
    robots = Robots()
    robots.script = slow_once(0.2, 0.2, lambda frame: bytes((0, 77)) if frame.payload[0] == 7 else b"A")
    for number in range(3):
        await robots.conversations.tell(robots.of_bytes(), "garra", [number], fresh_s=2)
        await asyncio.sleep(0.03)
    assert (await robots.hexa("sonar")).values == [77]
    assert robots.sent[-1][0] == pytest.approx(0.26)


@jumping
async def test_of_the_set_points_that_a_call_holds_up_the_newest_is_sent() -> None:
    robots = Robots()
    robots.script = lambda _: [(1, b"A")]
    call = asyncio.ensure_future(robots.hexa("garra", 0))
    await asyncio.sleep(0.1)
    puts = [
        asyncio.ensure_future(robots.conversations.tell(robots.of_bytes(), "garra", [n], fresh_s=2))
        for n in (10, 20, 45)
    ]
    await asyncio.wait([call, *puts])
    assert robots.payloads == [b"\x04\x00", b"\x04\x40"]
    assert [str(put.exception()) for put in puts[:2]] == ["a newer garra came while BRACO was at other calls"] * 2
    assert robots.idle


@jumping
async def test_of_a_burst_of_set_points_the_newest_is_sent() -> None:
    robots = Robots()
    robots.script = lambda _: [(1, b"A")]
    call = asyncio.ensure_future(robots.hexa("garra", 0))
    await asyncio.sleep(0.1)
    puts = [
        asyncio.ensure_future(robots.conversations.tell(robots.of_bytes(), "garra", [n - 90], fresh_s=2))
        for n in range(2 * WAITING_KEPT)
    ]
    outcomes = await asyncio.gather(*puts, return_exceptions=True)
    assert [outcome for outcome in outcomes[:-1] if outcome is None] == []
    assert outcomes[-1] is None
    await call
    assert len(robots.sent) == 2
    assert robots.idle


@jumping
async def test_a_put_that_never_left_leaves_no_debt() -> None:
    robots = Robots()
    robots.stuck = True
    await robots.conversations.tell(robots.of_bytes(), "garra", [1], fresh_s=2)
    dropped = robots._kept[0][1]
    waiting = asyncio.ensure_future(robots.hexa("garra", 2))
    await asyncio.sleep(0.1)
    robots.stuck = False
    robots.script = lambda _: [(0.1, b"A")]
    robots.conversations.undelivered(dropped, CallError("expired", "too late"))
    await waiting
    assert robots.sent == [(0.1, b"\x04\x03")]


@jumping
async def test_what_robots_owe_is_bounded_and_forgotten_in_time() -> None:
    robots = Robots()
    late = robots.conversations._late
    for number in range(500):
        await robots.conversations.tell(robots.of_words(), f"w{number}", [], fresh_s=2)
    assert len(late._owed[MNERIM]) == OWED_KEPT
    await asyncio.sleep(2.1)
    await robots.conversations.tell(robots.of_words(Address.named("OUTRO")), "luz", [], fresh_s=2)
    assert list(late._owed) == [Address.named("OUTRO")]


# Too late to leave.


@jumping
async def test_a_command_whose_deadline_is_past_is_not_sent() -> None:
    robots = Robots()
    for late in (0.0, -0.5):
        assert (await refused(robots.ascii("parafrente", 1, timeout_s=late))).code == "expired"
        assert (await refused(robots.ascii("pare", timeout_s=late))).code == "expired"
    assert robots.sent == []
    assert robots.idle


@jumping
async def test_a_command_that_is_to_be_fresh_leaves_fresh_or_not_at_all() -> None:
    robots = Robots()
    calls = [asyncio.ensure_future(robots.hexa("garra", n, fresh_s=1.5)) for n in (10, 20, 30)]
    calls += [asyncio.ensure_future(robots.hexa("sonar", fresh_s=1.5)) for _ in range(2)]
    errors = [await refused(call) for call in calls]
    assert [error.code for error in errors] == ["outcome_unknown", *["expired"] * 4]
    assert ["newer" in str(error) for error in errors] == [False, True, False, False, False]
    assert robots.sent == [(0.0, b"\x04\x0e")]
    assert robots.ages == [1.5]


@jumping
async def test_a_motion_that_is_to_be_fresh_is_not_sent_again_when_a_busy_robot_is_free_too_late() -> None:
    robots = Robots(busy_poll_s=0.5)
    robots.script = lambda frame: [(0.1, b"F" if frame.payload == b"?" and now() - robots.begun > 3 else b"B")]
    assert (await refused(robots.hexa("garra", 10, fresh_s=2))).code == "expired"
    assert robots.payloads.count(b"\x04\x0e") == 1


@jumping
async def test_a_motion_that_was_not_understood_too_long_ago_is_not_sent_again_and_a_question_is() -> None:
    robots = Robots()
    robots.script = lambda frame: [(0.6, b"N" if len(robots.sent) != 3 else bytes((0, 7)))]
    assert (await refused(robots.hexa("garra", 10, fresh_s=0.5))).code == "expired"
    assert (await robots.hexa("sonar", fresh_s=0.5)).values == [7]
    assert robots.payloads == [b"\x04\x0e", *[b"\x07\x00"] * 2]


@jumping
async def test_a_newer_command_that_comes_just_as_the_older_gives_up_is_heard() -> None:
    robots = Robots()
    call = asyncio.ensure_future(robots.hexa("garra", 1))
    await asyncio.sleep(0)

    async def newer() -> None:
        await asyncio.sleep(0.5)
        await robots.conversations.tell(robots.of_bytes(), "garra", [3], fresh_s=2)

    later = asyncio.ensure_future(newer())
    await asyncio.sleep(0)
    assert (await refused(robots.conversations.tell(robots.of_bytes(), "garra", [2], fresh_s=0.5))).code == "expired"
    robots.says(b"A")
    await call
    await later
    assert robots.payloads == [b"\x04\x01", b"\x04\x04"]


# Complaints.


@jumping
async def test_a_complaint_has_motion_sent_again_once_the_robot_is_quiet() -> None:
    robots = Robots()
    robots.script = lambda _: [(0.3, b"parafrente sucesso")] if len(robots.sent) == 2 else ()
    task = asyncio.ensure_future(robots.ascii("parafrente", 100))
    for _ in range(3):
        await asyncio.sleep(0.01)
        robots.conversations.complained("radio")
    assert (await task).status == "sucesso"
    assert [at for at, _ in robots.sent] == pytest.approx([0, 0.06])


@jumping
async def test_a_complaint_elsewhere_repeats_nothing() -> None:
    robots = Robots()
    task = asyncio.ensure_future(robots.ascii("parafrente", 100, link="wifi", peer=("127.0.0.1", 9001)))
    await asyncio.sleep(0.01)
    robots.conversations.complained("radio")
    robots.conversations.complained("wifi", ("127.0.0.1", 9002))
    assert (await refused(task)).code == "outcome_unknown"
    assert len(robots.sent) == 1


@jumping
async def test_a_complaint_that_may_be_of_either_robot_moves_neither_twice() -> None:
    robots = Robots()
    other = Address.named("OUTRO")
    third = Address.named("TERCEIRO")
    tasks = [
        asyncio.ensure_future(robots.ascii("parafrente", 100)),
        asyncio.ensure_future(robots.ascii("parafrente", 50, address=other)),
        asyncio.ensure_future(robots.ascii("quantoscomandos", address=third, timeout_s=1)),
    ]
    await asyncio.sleep(0.01)
    robots.conversations.complained("radio")
    await asyncio.gather(*tasks, return_exceptions=True)
    payloads = [payload for _, payload in robots.sent]
    assert payloads.count(b"parafrente 100") == payloads.count(b"parafrente 50") == 1
    assert payloads.count(b"quantoscomandos") == 2


@pytest.mark.parametrize("after_s", [-0.3, 0.01])
@jumping
async def test_a_complaint_that_may_be_of_anothers_frame_does_not_move_the_robot_twice(after_s: float) -> None:
    robots = Robots()
    if after_s < 0:
        robots.another_leaves("radio")
        await asyncio.sleep(-after_s)
    task = asyncio.ensure_future(robots.ascii("parafrente", 50))
    await asyncio.sleep(0.02)
    if after_s > 0:
        robots.another_leaves("radio")
    robots.conversations.complained("radio")
    assert (await refused(task)).code == "outcome_unknown"
    assert robots.payloads == [b"parafrente 50"]


@jumping
async def test_a_complaint_long_after_ours_is_not_of_ours() -> None:
    robots = Robots()
    task = asyncio.ensure_future(robots.ascii("parafrente", 50))
    await asyncio.sleep(0.6)
    robots.conversations.complained("radio")
    assert (await refused(task)).code == "outcome_unknown"
    assert robots.payloads == [b"parafrente 50"]


@pytest.mark.parametrize("after_s", [-0.3, 0.01])
@jumping
async def test_a_complaint_that_may_be_of_a_frame_that_was_heard_does_not_move_the_robot_twice(after_s: float) -> None:
    robots = Robots()
    if after_s < 0:
        robots.another_is_heard("radio")
        await asyncio.sleep(-after_s)
    task = asyncio.ensure_future(robots.ascii("parafrente", 50))
    await asyncio.sleep(0.02)
    if after_s > 0:
        robots.another_is_heard("radio")
    robots.conversations.complained("radio")
    assert (await refused(task)).code == "outcome_unknown"
    assert robots.payloads == [b"parafrente 50"]


@jumping
async def test_a_question_that_waits_to_leave_is_not_sent_twice_on_a_complaint() -> None:
    robots = Robots()
    robots.stuck = True
    task = asyncio.ensure_future(robots.ascii("exibecomando", 1))
    await asyncio.sleep(0.1)
    robots.conversations.complained("radio")
    await asyncio.sleep(0.1)
    assert len(robots._kept) == 1
    task.cancel()


@jumping
async def test_a_complaint_long_after_anothers_frame_is_of_ours() -> None:
    robots = Robots()
    robots.another_leaves("radio")
    await asyncio.sleep(0.6)
    robots.script = lambda _: [(0.3, b"parafrente sucesso")] if len(robots.sent) == 2 else ()
    task = asyncio.ensure_future(robots.ascii("parafrente", 50))
    await asyncio.sleep(0.02)
    robots.conversations.complained("radio")
    assert (await task).status == "sucesso"


@jumping
async def test_a_frame_that_was_answered_is_not_the_one_complained_of() -> None:
    robots = Robots()
    robots.script = lambda _: [(0.1, b"parafrente sucesso")] if len(robots.sent) != 2 else ()
    await robots.ascii("parafrente", 50)
    task = asyncio.ensure_future(robots.ascii("parafrente", 60))
    for _ in range(2):
        await asyncio.sleep(0.02)
        robots.conversations.complained("radio")
    assert (await task).status == "sucesso"
    assert robots.payloads == [b"parafrente 50", b"parafrente 60", b"parafrente 60"]


@jumping
async def test_a_motion_that_had_to_wait_to_leave_is_not_repeated_on_a_complaint() -> None:
    robots = Robots()
    robots.stuck = True
    task = asyncio.ensure_future(robots.ascii("parafrente", 50))
    await asyncio.sleep(0.02)
    robots.conversations.complained("radio")
    await asyncio.sleep(0.1)
    assert len(robots._kept) == 1
    assert not task.done()
    task.cancel()


@jumping
async def test_a_stop_is_sent_again_on_anybodys_complaint() -> None:
    robots = Robots()
    motion = asyncio.ensure_future(robots.ascii("parafrente", 500))
    await asyncio.sleep(0.1)
    stop = asyncio.ensure_future(robots.ascii("pare"))
    await asyncio.sleep(0.1)
    robots.conversations.complained("radio")
    await asyncio.sleep(0.1)
    assert robots.payloads == [b"parafrente 500", b"pare", b"pare"]
    assert robots.says(b"pare sucesso", MNERIM)
    await stop
    motion.cancel()


@jumping
async def test_a_complaint_that_was_anothers_does_not_count_as_the_answer_to_a_question() -> None:
    robots = Robots()
    robots.script = lambda frame: [(0.3, b"exibecomando c%s 1 0 0" % frame.payload.split()[1])]
    first = asyncio.ensure_future(robots.ascii("exibecomando", 1))
    await asyncio.sleep(0.1)
    robots.another_leaves("radio")
    robots.conversations.complained("radio")
    assert (await first).values[0] == "c1"
    assert (await robots.ascii("exibecomando", 2)).values[0] == "c2"

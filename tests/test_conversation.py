"""Calls to robots: tries, turns and deadlines, on a clock that jumps instead of waiting."""

import asyncio
from collections.abc import Sequence

import pytest
from scripted_robots import ARM, BASE, MNERIM, OURS, Robots, jumping, now, refused

from psiu_broker.codecs import psiu_ascii, psiu_hexa
from psiu_broker.conversation import Robot
from psiu_broker.conversation.turns import WAITING_KEPT
from psiu_broker.errors import CallError, EncodeError
from psiu_broker.frame import Address, Frame
from psiu_broker.profiles import PsiuProfile, Request


@jumping
async def test_a_call_returns_the_robots_answer_and_how_long_it_took() -> None:
    robots = Robots()
    robots.script = lambda _: [(0.25, b"parafrente sucesso")]
    answer = await robots.ascii("parafrente", 100)
    assert (answer.status, answer.values, answer.elapsed_ms) == ("sucesso", [], pytest.approx(250))
    assert robots.sent == [(0.0, b"parafrente 100")]
    assert robots.idle


@jumping
async def test_a_falha_is_an_answer() -> None:
    robots = Robots()
    robots.script = lambda _: [(0.1, b"parafrente FALHA")]
    assert (await robots.ascii("parafrente", 100)).status == "falha"


@jumping
async def test_a_value_comes_typed_and_with_its_unit() -> None:
    robots = Robots()
    robots.script = lambda _: [(0.1, bytes((0, 42)))]
    answer = await robots.hexa("sonar")
    assert (answer.status, answer.values, answer.unit) == (None, [42], "cm")


@jumping
async def test_a_robot_that_answers_before_send_returns_is_heard() -> None:
    robots = Robots()

    def at_once(frame: Frame) -> Sequence[tuple[float, bytes]]:
        robots.say(Frame(MNERIM, BASE, "quantoscomandos", b"quantoscomandos 6", "psiu-ascii"))
        return ()

    robots.script = at_once
    assert (await robots.ascii("quantoscomandos")).values == [6]


@jumping
async def test_a_question_is_asked_again_on_silence_and_then_given_up() -> None:
    robots = Robots()
    error = await refused(robots.ascii("quantoscomandos"))
    assert (error.code, str(error)) == ("no_answer", "no answer from MNERIM after 3 tries")
    assert [at for at, _ in robots.sent] == pytest.approx([0, 2, 4])
    assert now() - robots.begun == pytest.approx(6)
    assert robots.idle


@jumping
async def test_a_late_answer_to_the_second_try_is_an_answer() -> None:
    robots = Robots()
    robots.script = lambda _: [(0.5, b"quantoscomandos 6")] if len(robots.sent) == 2 else ()
    answer = await robots.ascii("quantoscomandos")
    assert (answer.values, answer.elapsed_ms) == ([6], pytest.approx(2500))


@jumping
async def test_motion_is_never_repeated_on_silence() -> None:
    robots = Robots()
    error = await refused(robots.ascii("parafrente", 100))
    assert error.code == "outcome_unknown"
    assert "MNERIM did not answer parafrente in 3.2 s" in str(error)
    assert robots.sent == [(0.0, b"parafrente 100")]
    assert now() - robots.begun == pytest.approx(3.2)
    assert robots.idle


@jumping
async def test_the_callers_deadline_is_kept_and_a_longer_one_waits_longer() -> None:
    robots = Robots()
    assert (await refused(robots.ascii("parafrente", 100, timeout_s=0.5))).code == "outcome_unknown"
    assert now() - robots.begun == pytest.approx(0.5)
    error = await refused(robots.ascii("quantoscomandos", timeout_s=0.5))
    assert (error.code, str(error)) == ("no_answer", "no answer from MNERIM after 1 try")
    assert now() - robots.begun == pytest.approx(1.0)
    robots.script = lambda _: [(25, b"parafrente sucesso")]
    assert (await robots.ascii("parafrente", 100, timeout_s=30)).status == "sucesso"


@jumping
async def test_a_frame_may_wait_in_its_outbox_no_longer_than_its_try() -> None:
    robots = Robots()
    await refused(robots.ascii("quantoscomandos", timeout_s=5))
    assert robots.ages == pytest.approx([2, 2, 1])


@jumping
async def test_what_cannot_be_asked_is_refused_before_sending() -> None:
    robots = Robots()
    error = await refused(robots.ascii("parafrente", 1200))
    assert (error.code, str(error)) == ("refused", "parafrente takes 0–999 cm, got 1200")
    assert (await refused(robots.hexa("gara"))).code == "unknown_command"
    assert robots.sent == []
    assert robots.idle


@jumping
async def test_a_frame_that_cannot_go_fails_at_once_with_the_reason() -> None:
    robots = Robots()
    robots.refuse = CallError("link_down", "link radio is down since 03:04")
    assert await refused(robots.ascii("parafrente", 100)) is robots.refuse
    assert now() == robots.begun
    assert robots.idle


@jumping
async def test_a_frame_that_the_protocol_cannot_say_is_refused() -> None:
    robots = Robots()

    def build(request: Request) -> Frame:
        raise EncodeError("the frame would be 1003 bytes")

    robot = Robot("MNERIM", BASE, MNERIM, PsiuProfile(), build, "radio")
    error = await refused(robots.conversations.call(robot, "x", []))
    assert (error.code, str(error)) == ("refused", "x cannot be sent to MNERIM: the frame would be 1003 bytes")
    assert robots.idle


@jumping
async def test_a_frame_dropped_from_its_outbox_ends_the_call_and_leaves_no_debt() -> None:
    robots = Robots()
    robots.stuck = True
    begun = now()
    task = asyncio.ensure_future(robots.ascii("parafrente", 100))
    await asyncio.sleep(0.1)
    dropped = robots._kept[0][1]
    expired = CallError("expired", "it waited too long")
    robots.conversations.undelivered(psiu_ascii.message(BASE, MNERIM, "parafrente", "100"), expired)
    await asyncio.sleep(0.1)
    assert not task.done()
    robots.conversations.undelivered(dropped, expired)
    assert await refused(task) is expired
    robots.stuck = False
    robots.script = lambda _: [(0.1, b"parafrente sucesso")]
    await robots.ascii("parafrente", 100)
    assert now() - begun == pytest.approx(0.3)


@jumping
async def test_a_frame_that_never_left_its_outbox_is_not_an_unknown_outcome() -> None:
    robots = Robots()
    robots.stuck = True
    error = await refused(robots.ascii("parafrente", 100, timeout_s=0.55))
    assert (error.code, str(error)) == ("expired", "nothing was sent")
    assert now() - robots.begun == pytest.approx(0.55)


@jumping
async def test_a_robot_has_its_time_from_when_the_command_leaves() -> None:
    robots = Robots()
    robots.stuck = True
    robots.script = lambda _: [(1.5, b"A")]
    call = asyncio.ensure_future(robots.hexa("garra", 45))
    await asyncio.sleep(1.9)
    robots.flows()
    assert (await call).elapsed_ms == pytest.approx(3400)
    assert robots.payloads == [b"\x04\x40"]


@jumping
async def test_a_robot_has_its_time_within_the_deadline_only() -> None:
    robots = Robots()
    robots.stuck = True
    call = asyncio.ensure_future(robots.hexa("garra", 45, timeout_s=2))
    await asyncio.sleep(1.5)
    robots.flows()
    assert (await refused(call)).code == "outcome_unknown"
    assert now() - robots.begun == pytest.approx(2)


@jumping
async def test_a_link_that_goes_down_with_the_command_in_its_outbox_leaves_no_doubt() -> None:
    robots = Robots()
    robots.stuck = True
    call = asyncio.ensure_future(robots.ascii("parafrente", 100))
    await asyncio.sleep(0.1)
    robots.conversations.link_down("radio", "unplugged")
    assert "unknown" not in str(await refused(call))


@jumping
async def test_complaints_are_bounded() -> None:
    robots = Robots()
    robots.script = lambda _: [(0.1, b"N")]
    error = await refused(robots.hexa("garra", 45))
    assert (error.code, str(error)) == ("no_answer", "BRACO did not understand garra after 3 tries")
    assert len(robots.sent) == 3


@jumping
async def test_silence_after_a_complaint_is_still_an_unknown_outcome() -> None:
    robots = Robots()
    robots.script = lambda _: [(0.1, b"N")] if len(robots.sent) == 1 else ()
    assert (await refused(robots.hexa("garra", 45))).code == "outcome_unknown"
    assert len(robots.sent) == 2


@jumping
async def test_a_busy_robot_is_polled_until_free_and_then_told_again() -> None:
    robots = Robots(busy_poll_s=0.5)
    answers = iter([b"B", b"B", b"F", b"A"])
    robots.script = lambda _: [(0.1, next(answers))]
    assert (await robots.hexa("garra", 90)).status == "sucesso"
    assert [payload for _, payload in robots.sent] == [b"\x04\x7f", b"?", b"?", b"\x04\x7f"]
    assert [at for at, _ in robots.sent] == pytest.approx([0, 0.6, 1.1, 1.2])


@jumping
async def test_a_robot_that_says_busy_for_ever_is_reported_busy_at_the_deadline() -> None:
    robots = Robots(busy_poll_s=0.5)

    def trickle() -> None:
        robots.say(psiu_hexa.packet(ARM, OURS, b"B"))
        asyncio.get_running_loop().call_later(0.013, trickle)

    trickle()
    error = await refused(robots.hexa("garra", 90))
    assert (error.code, str(error)) == ("busy", "BRACO is busy and did not do garra")
    assert now() - robots.begun == pytest.approx(6, abs=0.02)
    payloads = [payload for _, payload in robots.sent]
    assert payloads.count(b"\x04\x7f") == 1
    assert 10 <= payloads.count(b"?") <= 12
    assert robots.idle


@jumping
async def test_a_robot_that_says_free_for_ever_cannot_hold_a_call() -> None:
    robots = Robots()

    def trickle() -> None:
        robots.say(psiu_hexa.packet(ARM, OURS, b"F"))
        asyncio.get_running_loop().call_later(0.013, trickle)

    trickle()
    assert (await refused(robots.hexa("garra", 90))).code == "outcome_unknown"
    assert now() - robots.begun == pytest.approx(2, abs=0.02)


@jumping
async def test_a_robot_between_busy_and_free_for_ever_ends_at_the_deadline_without_a_storm() -> None:
    robots = Robots(busy_poll_s=0.5)
    robots.script = lambda frame: [(0.0, b"F" if frame.payload == b"?" else b"B")]
    assert (await refused(robots.hexa("garra", 90))).code == "busy"
    assert now() - robots.begun == pytest.approx(6)
    assert len(robots.sent) <= 26


@jumping
async def test_a_busy_robot_that_says_free_unasked_is_asked_before_it_is_told_again() -> None:
    robots = Robots(busy_poll_s=0.5)
    scripts = iter([[(0.1, b"B"), (0.2, b"F")], [(0.1, b"F")], [(0.1, b"A")]])
    robots.script = lambda _: next(scripts)
    assert (await robots.hexa("garra", 90)).status == "sucesso"
    assert [payload for _, payload in robots.sent] == [b"\x04\x7f", b"?", b"\x04\x7f"]


@jumping
async def test_a_busy_robot_is_no_less_busy_where_the_poll_cannot_leave() -> None:
    robots = Robots(busy_poll_s=0.5)
    robots.script = lambda _: [(0.1, b"B")]
    call = asyncio.ensure_future(robots.hexa("garra", 10, timeout_s=2))
    await asyncio.sleep(0.05)
    robots.stuck = True
    for _ in range(4):
        await asyncio.sleep(0.5)
        robots.expire("arm")
    assert (await refused(call)).code == "busy"


@jumping
async def test_a_robot_that_says_free_while_the_poll_waits_is_asked_all_the_same() -> None:
    robots = Robots(busy_poll_s=0.5)
    scripts = iter([[(0.1, b"B")], [(0.1, b"F")], [(0.1, b"A")]])
    robots.script = lambda _: next(scripts)
    call = asyncio.ensure_future(robots.hexa("garra", 90))
    await asyncio.sleep(0.2)
    robots.stuck = True
    await asyncio.sleep(0.6)
    robots.says(b"F")
    await asyncio.sleep(0.1)
    robots.flows()
    assert (await call).status == "sucesso"
    assert robots.payloads == [b"\x04\x7f", b"?", b"\x04\x7f"]


@jumping
async def test_a_busy_robot_that_does_not_know_avail_is_busy() -> None:
    robots = Robots(busy_poll_s=0.5)
    robots.script = lambda frame: [(0.1, b"W" if frame.payload == b"?" else b"B")]
    assert (await refused(robots.hexa("garra", 90))).code == "busy"
    assert now() - robots.begun == pytest.approx(0.7)


@jumping
async def test_what_a_robot_cannot_do_is_reported_impossible() -> None:
    robots = Robots()
    robots.script = lambda _: [(0.1, b"W")]
    error = await refused(robots.hexa("garra", 90))
    assert (error.code, str(error)) == ("impossible", "BRACO says that garra is impossible")


@jumping
async def test_a_link_that_goes_down_ends_its_calls_and_no_others() -> None:
    robots = Robots()
    lost = asyncio.ensure_future(robots.ascii("parafrente", 100))
    kept = asyncio.ensure_future(robots.hexa("garra", 1))
    await asyncio.sleep(0.1)
    robots.conversations.link_down("radio", "unplugged")
    error = await refused(lost)
    assert error.code == "link_down"
    assert str(error).startswith("link radio is down since ")
    assert "(unplugged), before MNERIM answered; whether it was done is unknown" in str(error)
    assert not kept.done()
    robots.say(psiu_hexa.packet(ARM, OURS, b"A"))
    assert (await kept).status == "sucesso"


@jumping
async def test_a_far_end_that_goes_away_ends_its_calls_and_no_others() -> None:
    robots = Robots()
    beta, here, there = Address.named("BETA"), ("127.0.0.1", 9001), ("127.0.0.1", 9002)
    lost = asyncio.ensure_future(robots.ascii("parafrente", 100, link="wifi", peer=here))
    kept = asyncio.ensure_future(robots.ascii("parafrente", 100, address=beta, link="wifi", peer=there))
    other = asyncio.ensure_future(robots.hexa("garra", 1))
    await asyncio.sleep(0.1)
    robots.conversations.link_down("wifi", "gone", here)
    error = await refused(lost)
    assert error.code == "link_down"
    assert str(error).startswith("link wifi to 127.0.0.1:9001 is down since ")
    assert robots.says(b"parafrente sucesso", beta)
    assert robots.says(b"A")
    assert {(await kept).status, (await other).status} == {"sucesso"}


@jumping
async def test_closing_ends_every_call_and_refuses_new_ones() -> None:
    robots = Robots()
    calls = [asyncio.ensure_future(robots.ascii("parafrente", number)) for number in range(3)]
    await asyncio.sleep(0.1)
    robots.conversations.close()
    closed_at = now()
    assert {(await refused(call)).code for call in calls} == {"shutting_down"}
    assert (await refused(robots.ascii("qualseunome"))).code == "shutting_down"
    assert now() == closed_at
    assert len(robots.sent) == 1
    assert robots.idle


@jumping
async def test_one_request_is_under_way_per_robot_and_turns_come_in_order() -> None:
    robots = Robots()
    robots.script = lambda _: [(0.5, b"parafrente sucesso")]
    await asyncio.gather(*(robots.ascii("parafrente", number) for number in range(4)))
    assert [payload for _, payload in robots.sent] == [b"parafrente %d" % number for number in range(4)]
    assert [at for at, _ in robots.sent] == pytest.approx([0, 0.5, 1.0, 1.5])
    assert robots.idle


@jumping
async def test_a_newcomer_does_not_overtake_who_waits() -> None:
    robots = Robots()
    robots.script = lambda _: [(0.5, b"parafrente sucesso")]
    order: list[int] = []

    async def one(number: int) -> None:
        await robots.ascii("parafrente", number)
        order.append(number)
        if number == 0:
            await one(9)

    await asyncio.gather(one(0), one(1), one(2))
    assert order == [0, 1, 2, 9]


@jumping
async def test_robots_do_not_wait_for_each_other() -> None:
    robots = Robots()
    robots.script = lambda frame: [(0.5, b"parafrente sucesso")]
    await asyncio.gather(*(robots.ascii("parafrente", 1, address=Address.named(f"R{n}")) for n in range(20)))
    assert now() - robots.begun == pytest.approx(0.5)


@jumping
async def test_a_caller_whose_turn_does_not_come_is_told_that_nothing_was_sent() -> None:
    robots = Robots()
    first = asyncio.ensure_future(robots.ascii("parafrente", 100))
    await asyncio.sleep(0)
    error = await refused(robots.ascii("paratras", 5, timeout_s=1))
    assert (error.code, str(error)) == ("expired", "MNERIM was at other calls for 1 s; paratras was not sent")
    assert now() - robots.begun == pytest.approx(1)
    await refused(first)
    assert robots.sent == [(0.0, b"parafrente 100")]
    assert robots.idle


@jumping
async def test_waiting_counts_against_the_deadline() -> None:
    robots = Robots()
    robots.script = lambda frame: [(1.5, b"parafrente sucesso")] if frame.payload == b"parafrente 1" else ()
    first = asyncio.ensure_future(robots.ascii("parafrente", 1))
    await asyncio.sleep(0)
    assert (await refused(robots.ascii("quantoscomandos", timeout_s=2))).code == "no_answer"
    assert now() - robots.begun == pytest.approx(2)
    await first


@jumping
async def test_a_caller_that_gives_up_leaves_the_queue() -> None:
    robots = Robots()
    robots.script = lambda _: [(0.5, b"parafrente sucesso")]
    calls = [asyncio.ensure_future(robots.ascii("parafrente", number)) for number in range(3)]
    await asyncio.sleep(0.1)
    calls[1].cancel()
    await asyncio.wait(calls)
    assert [payload for _, payload in robots.sent] == [b"parafrente 0", b"parafrente 2"]
    assert robots.idle


@jumping
async def test_a_caller_that_gives_up_in_the_middle_makes_room() -> None:
    robots = Robots()
    first = asyncio.ensure_future(robots.ascii("parafrente", 1))
    second = asyncio.ensure_future(robots.ascii("parafrente", 2))
    await asyncio.sleep(0.1)
    first.cancel()
    await asyncio.sleep(0)
    robots.script = lambda _: [(0.1, b"parafrente sucesso")]
    assert (await second).status == "sucesso"
    assert first.cancelled()
    assert robots.idle


@jumping
async def test_a_queue_in_front_of_a_robot_is_bounded() -> None:
    robots = Robots()
    calls = [asyncio.ensure_future(robots.ascii("parafrente", 1, timeout_s=3)) for _ in range(WAITING_KEPT + 3)]
    outcomes = await asyncio.gather(*calls, return_exceptions=True)
    codes = [error.code for error in outcomes if isinstance(error, CallError)]
    assert codes.count("busy") == 2
    assert codes.count("expired") == WAITING_KEPT
    assert robots.idle


@jumping
async def test_every_call_returns_within_its_deadline_under_contention() -> None:
    robots = Robots()

    async def timed(number: int) -> float:
        await refused(robots.ascii("parafrente", number, timeout_s=0.1 * (1 + number % 5)))
        return now() - robots.begun - 0.1 * (1 + number % 5)

    late = await asyncio.gather(*(timed(number) for number in range(40)))
    assert max(late) < 0.001
    assert robots.idle


@jumping
async def test_only_the_robot_asked_can_answer_and_only_to_us() -> None:
    robots = Robots()
    task = asyncio.ensure_future(robots.ascii("parafrente", 100))
    await asyncio.sleep(0.1)
    good = Frame(MNERIM, BASE, "parafrente", b"parafrente sucesso", "psiu-ascii")
    assert not robots.say(good._replace(source=Address.named("OUTRO")))
    assert not robots.say(good._replace(destination=Address.named("PC")))
    assert not robots.say(good._replace(payload=b"paratras sucesso"))
    assert robots.say(good)
    await task
    assert not robots.say(good)


@jumping
async def test_a_talkative_robot_cannot_push_out_its_own_answer_or_fill_memory() -> None:
    robots = Robots()
    task = asyncio.ensure_future(robots.hexa("garra", 1))
    await asyncio.sleep(0.1)
    robots.say(psiu_hexa.packet(ARM, OURS, b"A"))
    for _ in range(1000):
        robots.say(psiu_hexa.packet(ARM, OURS, b"B"))
    assert len(robots.conversations._under_way[ARM][0].heard) < 10
    assert (await task).status == "sucesso"


@jumping
async def test_a_ping_of_ours_is_known_while_it_waits_and_its_late_answers_are_no_questions() -> None:
    robots = Robots()
    assert not robots.conversations.pinging(ARM)
    task = asyncio.ensure_future(robots.hexa("ping"))
    await asyncio.sleep(0.1)
    assert robots.conversations.pinging(ARM)
    assert (await refused(task)).code == "no_answer"
    assert not robots.conversations.pinging(ARM)
    assert not robots.says(b"")
    task = asyncio.ensure_future(robots.hexa("ping", timeout_s=0.3))
    assert (await refused(task)).code == "no_answer"
    assert robots.says(b"")
    assert not robots.says(b"")
    robots.script = lambda _: [(0.1, b"")]
    assert (await robots.hexa("ping")).status == "sucesso"
    assert not robots.says(b"")


@jumping
async def test_hearing_costs_one_look_when_no_call_is_under_way() -> None:
    assert not Robots().conversations.heard(None, 0.0)  # type: ignore[arg-type]


@jumping
async def test_a_motion_that_waited_for_its_turn_is_not_sent_after_a_stop() -> None:
    robots = Robots()
    first = asyncio.ensure_future(robots.ascii("parafrente", 100))
    await asyncio.sleep(0.1)
    late = [asyncio.ensure_future(robots.ascii(*each)) for each in (("giradireita", 90), ("quantoscomandos",))]
    await asyncio.sleep(0.1)
    robots.script = lambda frame: [(0.05, b"pare sucesso")] if frame.payload == b"pare" else ()
    assert (await robots.ascii("pare")).status == "sucesso"
    error = await refused(late[0])
    assert (error.code, str(error)) == (
        "expired",
        "a stop came while MNERIM was at other calls; giradireita was not sent",
    )
    robots.script = lambda _: [(0.05, b"quantoscomandos 6")]
    robots.says(b"parafrente sucesso", MNERIM)
    await first
    assert (await late[1]).values == [6], "a question moves nobody"
    assert robots.payloads == [b"parafrente 100", b"pare", b"quantoscomandos"]
    assert robots.idle


@jumping
async def test_a_motion_that_was_not_understood_is_not_sent_again_after_a_stop() -> None:
    robots = Robots()
    call = asyncio.ensure_future(robots.ascii("parafrente", 100))
    await asyncio.sleep(0.1)
    robots.conversations.complained("radio")
    robots.script = lambda _: [(0.01, b"pare sucesso")]
    await robots.ascii("pare")
    assert (await refused(call)).code == "expired"
    assert robots.payloads == [b"parafrente 100", b"pare"]


@jumping
async def test_a_motion_that_waited_for_a_late_answer_is_not_sent_after_a_stop() -> None:
    robots = Robots()
    await robots.conversations.tell(robots.of_words(), "parafrente", [1], fresh_s=1.0)
    call = asyncio.ensure_future(robots.ascii("parafrente", 100, timeout_s=9))
    await asyncio.sleep(0.1)
    robots.script = lambda _: [(0.01, b"pare sucesso")]
    await robots.ascii("pare")
    assert (await refused(call)).code == "expired"
    assert robots.payloads == [b"parafrente 1", b"pare"]


@jumping
async def test_what_may_be_repeated_is_told_again_on_silence_and_then_given_up() -> None:
    robots = Robots()
    error = await refused(robots.ascii("buzina", repeatable=True))
    assert error.code == "outcome_unknown"
    assert "it was sent 3 times" in str(error)
    assert [at for at, _ in robots.sent] == pytest.approx([0, 2, 4])
    assert robots.idle


@jumping
async def test_what_may_be_repeated_is_not_told_again_once_it_is_too_late() -> None:
    robots = Robots()
    error = await refused(robots.ascii("buzina", repeatable=True, fresh_s=1.5))
    assert error.code == "outcome_unknown"
    assert len(robots.sent) == 1


@jumping
async def test_a_stop_of_any_word_waits_for_nobody_is_told_again_and_goes_also_when_calls_are_closed() -> None:
    robots = Robots()
    moving = asyncio.create_task(refused(robots.ascii("parafrente", 100)))
    await asyncio.sleep(0.1)
    robots.conversations.close()
    stop = robots.conversations.stop(robots.of_words(), "descansa", [], timeout_s=1.5, retries=2)
    assert (await refused(stop)).code == "outcome_unknown"
    assert (await moving).code == "shutting_down"
    assert [(at, payload) for at, payload in robots.sent[1:]] == [
        (pytest.approx(at), b"descansa") for at in (0.1, 0.6, 1.1)
    ]

"""Procedures, by the example of a Robot Mitya that records a script: whole, or ended before anything else is sent."""

import asyncio
import dataclasses

import pytest
from recording_body import MITYA, Body
from scripted_robots import Robots, jumping, now, refused

from psiu_broker.codecs.mitya import Version
from psiu_broker.conversation.procedures import CUT_KEPT
from psiu_broker.conversation.under_way import UnderWay
from psiu_broker.errors import CallError
from psiu_broker.frame import Address
from psiu_broker.messages import Answer

SCRIPT = """# two actions
drive 100
wait 500
drive 0
"""
UPLOAD = ["r0103", "Z0002", "D0064", "W01F4", "D0000", "W0000", "Z0000"]
ENDING = ["W0000", "W0000", "Z0000", "D0000"]
MESSAGES = range(1, len(UPLOAD) + 1)


async def uploading(body: Body, messages: int) -> "asyncio.Task[Answer]":
    """An upload of which so many messages have left."""
    task = asyncio.ensure_future(body.call("roboscript-upload", 3, SCRIPT))
    while len(body.heard) < messages:  # noqa: ASYNC110 - its clock jumps
        await asyncio.sleep(0.01)
    return task


@pytest.mark.parametrize("version", ["2012", "2013"])
@jumping
async def test_a_script_is_recorded_message_by_message(version: Version) -> None:
    body = Body(Robots(), version)
    answer = await body.call("roboscript-upload", 3, SCRIPT)
    assert answer.status == "sucesso"
    letter = "D" if version == "2012" else "G"
    assert body.slots[3] == [(f"{letter}0064", "01F4"), (f"{letter}0000", "0000")]
    assert (body.recording, body.done) == (None, [])
    assert [text.replace("G", "D") for text in body.heard] == UPLOAD
    pauses = [later - earlier for (earlier, _), (later, _) in zip(body.robots.sent, body.robots.sent[1:], strict=False)]
    assert min(pauses) >= 0.049
    assert body.robots.idle


@pytest.mark.parametrize("version", ["2012", "2013"])
@pytest.mark.parametrize("number", MESSAGES)
@jumping
async def test_an_objection_is_told_with_the_line_that_met_it(version: Version, number: int) -> None:
    body = Body(Robots(), version)
    body.object_at = number
    answer = await body.call("roboscript-upload", 3, SCRIPT)
    line = [0, 0, 2, 3, 4, 4, 0][number - 1]
    assert (answer.status, answer.values) == ("falha", ["E0001" if version == "2012" else "#0001", line])
    assert answer.remark is not None
    assert answer.remark.startswith(f"line {line}: " if line else UPLOAD[number - 1])
    assert "it records no longer" in answer.remark
    assert body.recording is None
    assert len(body.heard) == number + len(ENDING)
    assert not body.slots.get(3)
    assert body.done == [ENDING[-1] if version == "2012" else "G0000"]


@jumping
async def test_too_little_memory_is_told_at_once() -> None:
    body = Body(Robots(), room=1)
    answer = await body.call("roboscript-upload", 3, SCRIPT)
    assert answer.values == ["E0005", 0]
    assert body.heard == [*UPLOAD[:2], *ENDING]


@pytest.mark.parametrize("number", MESSAGES)
@jumping
async def test_whatever_message_is_lost_no_half_script_is_left_and_no_motor_runs(number: int) -> None:
    body = Body(Robots())
    body.deaf = {number}
    try:
        answer = await body.call("roboscript-upload", 3, SCRIPT)
        assert answer.status == "falha"
    except CallError as error:
        assert (number, error.code) == (len(UPLOAD), "outcome_unknown")
        assert "it records no longer" in str(error)
    assert body.recording is None
    assert not body.slots.get(3)
    assert not body.done or body.done[-1] == "D0000"


@pytest.mark.parametrize("number", MESSAGES)
@jumping
async def test_a_cancelled_upload_is_ended_at_once(number: int) -> None:
    body = Body(Robots())
    task = await uploading(body, number)
    task.cancel()
    before = now()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert now() == before
    assert body.recording is None
    assert body.heard[number:] == ENDING
    assert body.robots.idle
    assert MITYA not in body.robots.conversations.alone


@pytest.mark.parametrize("number", MESSAGES)
@jumping
async def test_a_broker_that_stops_ends_it_too(number: int) -> None:
    body = Body(Robots())
    task = await uploading(body, number)
    body.robots.conversations.close()
    assert (await refused(task)).code == "shutting_down"
    assert (body.recording, body.heard[number:]) == (None, ENDING)


@pytest.mark.parametrize("number", MESSAGES)
@jumping
async def test_after_a_lost_link_the_ending_comes_before_anything_else(number: int) -> None:
    body = Body(Robots())
    task = await uploading(body, number)
    body.robots.refuse = CallError("link_down", "link corpo is down")
    body.robots.conversations.link_down("corpo", "unplugged")
    error = await refused(task)
    assert error.code == "link_down"
    assert "will be told to end it when its link is open again" in str(error)
    assert MITYA in body.robots.conversations.alone
    assert (await refused(body.call("drive", 100))).code == "link_down"
    body.robots.refuse = None
    assert (await body.call("drive", 100)).remark == "sent; this robot does not answer"
    assert body.heard[number:] == [*ENDING, "D0064"]
    assert body.recording is None
    assert body.done[-1] == "D0064"
    assert MITYA not in body.robots.conversations.alone


@jumping
async def test_a_robot_can_be_mended_as_soon_as_its_link_opens() -> None:
    body = Body(Robots())
    task = await uploading(body, 4)
    body.robots.refuse = CallError("link_down", "link corpo is down")
    body.robots.conversations.link_down("corpo", "unplugged")
    await refused(task)
    body.robots.refuse = None
    await body.robots.conversations.mend(body.robot)
    assert (body.recording, body.heard[4:]) == (None, ENDING)
    assert MITYA not in body.robots.conversations.alone
    await body.robots.conversations.mend(body.robot)
    assert body.heard[4:] == ENDING


@jumping
async def test_an_ending_that_was_dropped_is_sent_again() -> None:
    body = Body(Robots())
    task = await uploading(body, 4)
    body.robots.stuck = True
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    assert MITYA in body.robots.conversations.alone
    body.robots._kept.clear()
    body.robots.stuck = False
    await body.call("drive", 1)
    assert body.heard[4:] == [*ENDING, "D0001"]


@jumping
async def test_an_ending_that_is_lost_is_sent_again() -> None:
    body = Body(Robots())
    body.object_at = 3
    body.deaf = {4, 5, 6, 7}
    answer = await body.call("roboscript-upload", 3, SCRIPT)
    assert body.heard[3:] == [*ENDING, *ENDING]
    assert answer.remark is not None
    assert "it records no longer" in answer.remark


@jumping
async def test_before_a_stop_too_a_robot_that_was_cut_off_is_brought_out_of_it() -> None:
    body = Body(Robots())
    task = await uploading(body, 4)
    body.robots.refuse = CallError("link_down", "link corpo is down")
    body.robots.conversations.link_down("corpo", "unplugged")
    await refused(task)
    body.robots.refuse = None
    await body.call("stop")
    assert body.heard[4:] == [*ENDING, "D0000"]
    assert (body.recording, body.done) == (None, ["D0000", "D0000"])


@jumping
async def test_an_upload_that_had_to_wait_is_not_begun_where_it_could_not_end() -> None:
    body = Body(Robots())
    takes_s = 2 * 0.25 + 4 * 0.05 + 2
    first = asyncio.ensure_future(body.call("drive", 1))
    await asyncio.sleep(0)
    error = await refused(body.call("roboscript-upload", 3, SCRIPT, timeout_s=takes_s + 0.1))
    assert error.code in ("busy", "expired")
    await first
    assert body.heard == ["D0001"]
    assert MITYA not in body.robots.conversations.alone


@jumping
async def test_no_more_robots_than_so_many_are_remembered_as_cut_off() -> None:
    body = Body(Robots())
    procedures = body.robots.conversations._procedures
    body.robots.refuse = CallError("link_down", "link corpo is down")
    request = body.profile.request("roboscript-abort", [])
    assert request.procedure is not None
    for number in range(CUT_KEPT + 1):
        robot = dataclasses.replace(body.robot, address=Address.named(f"M{number}"))
        call = UnderWay(robot, "roboscript-abort", request, now(), now() + 1, now() + 1)
        with pytest.raises(CallError, match="may be out of reach"):
            await procedures.perform(call, request.procedure)
    assert len(procedures._cut) == len(procedures.alone) == CUT_KEPT
    assert Address.named("M0") not in procedures.alone


@pytest.mark.parametrize("number", MESSAGES)
@jumping
async def test_a_stop_ends_the_recording_first(number: int) -> None:
    body = Body(Robots())
    task = await uploading(body, number)
    begun = now()
    await body.call("stop")
    error = await refused(task)
    assert (error.code, "stop came meanwhile" in str(error)) == ("expired", True)
    assert body.heard[number:] == [*ENDING, "D0000"]
    assert (body.recording, body.done[-1]) == (None, "D0000")
    assert now() - begun < 1


@jumping
async def test_a_stop_is_not_too_late_for_what_had_to_be_ended_before_it() -> None:
    body = Body(Robots())
    task = await uploading(body, 4)
    await body.call("stop", timeout_s=0.05)
    await refused(task)
    assert body.heard[4:] == [*ENDING, "D0000"]


@jumping
async def test_two_stops_end_it_once() -> None:
    body = Body(Robots())
    task = await uploading(body, 4)
    await asyncio.gather(body.call("stop"), body.call("pare"))
    await refused(task)
    assert body.heard[4:] == [*ENDING, "D0000", "D0000"]


@jumping
async def test_calls_and_commands_wait_until_it_is_over() -> None:
    body = Body(Robots())
    task = await uploading(body, 3)
    assert body.robots.conversations.alone == {MITYA}
    tell = asyncio.ensure_future(body.robots.conversations.tell(body.robot, "left", [50], fresh_s=5))
    call = asyncio.ensure_future(body.call("drive", 7, timeout_s=5))
    await asyncio.gather(tell, call)
    assert (await task).status == "sucesso"
    assert body.heard == [*UPLOAD, "L0032", "D0007"]


@jumping
async def test_who_cannot_wait_hears_what_the_robot_is_at() -> None:
    body = Body(Robots())
    task = await uploading(body, 1)
    error = await refused(body.call("drive", 7, timeout_s=0.1))
    assert (error.code, "MITYA is at roboscript-upload" in str(error)) == ("busy", True)
    assert (await task).status == "sucesso"


@jumping
async def test_an_abort_ends_an_upload() -> None:
    body = Body(Robots())
    task = await uploading(body, 4)
    assert (await body.call("roboscript-abort")).status == "sucesso"
    assert (await refused(task)).code == "expired"
    assert body.recording is None


@jumping
async def test_an_abort_ends_a_recording_that_somebody_else_left_open() -> None:
    body = Body(Robots())
    body.recording, body.slots[2] = 2, [("D0064", "01F4")]
    answer = await body.call("roboscript-abort")
    assert answer.status == "sucesso"
    assert (body.recording, body.slots[2]) == (None, [])


@jumping
async def test_an_abort_of_a_silent_robot_is_no_success() -> None:
    body = Body(Robots())
    body.deaf = set(range(1, 100))
    assert (await refused(body.call("roboscript-abort"))).code == "outcome_unknown"


@jumping
async def test_what_the_ending_is_answered_is_not_taken_for_an_answer_to_the_next_call() -> None:
    body = Body(Robots(), "2013")
    task = await uploading(body, 4)
    next_one = asyncio.ensure_future(body.call("drive", 7, timeout_s=5))
    await body.call("roboscript-abort")
    await refused(task)
    assert (await next_one).status == "sucesso"


@jumping
async def test_an_upload_is_not_begun_where_it_could_not_end() -> None:
    body = Body(Robots())
    assert (await refused(body.call("roboscript-upload", 3, SCRIPT, timeout_s=1))).code == "refused"
    assert (await refused(body.call("roboscript-upload", 3, "drive 1000"))).code == "refused"
    assert body.heard == []


@jumping
async def test_an_upload_cannot_be_put() -> None:
    body = Body(Robots())
    tell = body.robots.conversations.tell(body.robot, "roboscript-upload", [3, SCRIPT], fresh_s=5)
    assert (await refused(tell)).code == "bad_request"
    assert body.heard == []


@jumping
async def test_a_message_that_cannot_leave_ends_it() -> None:
    body = Body(Robots())
    task = await uploading(body, 3)
    body.robots.stuck = True
    await asyncio.sleep(3)
    body.robots.flows()
    assert (await refused(task)).code == "expired"
    assert body.recording is None


@jumping
async def test_nothing_is_ended_that_never_began() -> None:
    body = Body(Robots())
    body.robots.refuse = CallError("link_down", "link corpo is down")
    assert await refused(body.call("roboscript-upload", 3, SCRIPT)) is body.robots.refuse
    assert MITYA not in body.robots.conversations.alone


class TestSilence:
    """Where the protocol has no answer."""

    @staticmethod
    @jumping
    async def test_silence_after_a_command_has_left_is_its_answer_and_nothing_is_owed() -> None:
        body = Body(Robots())
        answer = await body.call("drive", 100)
        assert (answer.status, answer.remark) == (None, "sent; this robot does not answer")
        assert answer.elapsed_ms == pytest.approx(300)
        assert not body.robots.conversations._late
        assert (await body.call("drive", 50, timeout_s=30)).elapsed_ms == pytest.approx(300)
        assert body.heard == ["D0064", "D0032"]

    @staticmethod
    @jumping
    async def test_an_error_in_that_time_is_the_answer() -> None:
        body = Body(Robots())
        body.object_at = 1
        answer = await body.call("drive", 100)
        assert (answer.status, answer.values) == ("falha", ["E0001"])
        assert answer.remark is not None

    @staticmethod
    @jumping
    async def test_the_time_counts_from_when_it_left() -> None:
        body = Body(Robots())
        body.robots.stuck = True
        task = asyncio.ensure_future(body.call("drive", 100, timeout_s=5))
        await asyncio.sleep(1)
        body.robots.flows()
        assert (await task).elapsed_ms == pytest.approx(1300)

    @staticmethod
    @jumping
    async def test_of_a_command_that_still_waits_nobody_is_told_that_it_was_sent() -> None:
        body = Body(Robots())
        body.robots.stuck = True
        body.robots.expire = lambda link: None  # type: ignore[method-assign]
        assert (await refused(body.call("drive", 100))).code == "outcome_unknown"

    @staticmethod
    @jumping
    async def test_a_command_that_did_not_leave_was_not_sent() -> None:
        body = Body(Robots())
        body.robots.stuck = True
        assert (await refused(body.call("drive", 100))).code == "expired"
        assert body.heard == []

"""Who is missed, and what a robot is told then; no bus, no links, and the time as the test says."""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from types import SimpleNamespace
from typing import NoReturn

import pytest

from psiu_broker.codecs import psiu_ascii
from psiu_broker.config.tables import (
    BrokerConfiguration,
    Configuration,
    FailsafeConfiguration,
    RobotConfiguration,
    ZenohConfiguration,
)
from psiu_broker.errors import CallError
from psiu_broker.failsafe import AGAIN_S, AWAITED_S, Failsafe
from psiu_broker.frame import EVERYONE, Address, Frame
from psiu_broker.profiles import PsiuProfile
from psiu_broker.profiles.psiu import PsiuOptions

MNERIM, PC = Address.named("MNERIM"), Address.named("PC")
PROFILE = PsiuProfile()


class Lab:
    """MNERIM on `radio`; each stop leaves at once, unless `fails` says why it cannot."""

    def __init__(
        self, *on: str, command: str = "pare", silent_s: float = 5.0, robots: Sequence[str] = ("MNERIM",)
    ) -> None:
        options = FailsafeConfiguration.model_validate(
            {"command": command, "on": on or ("program_gone", "broker_stop"), "silent_s": silent_s}
        )
        table = {
            name: RobotConfiguration(name, "radio", "psiu-ascii", None, None, PsiuOptions(), failsafe=options)
            for name in robots
        }
        made = Configuration(BrokerConfiguration(name="base"), ZenohConfiguration(), {}, table)
        self.now, self.heard_at = 100.0, 0.0
        self.stopped: list[str] = []
        self.fails: CallError | None = None
        self.answers, self.cut_off = True, False
        self.behind = ""
        self.failsafe = Failsafe(made, self._stop, lambda _: PROFILE, lambda _: self.heard_at, lambda: self.now)
        self.failsafe.link_opened("radio")
        self.command = command

    @property
    def stops(self) -> int:
        return len(self.stopped)

    def moves(self, program: str | None = None, word: str = "parafrente", robot: str = "MNERIM") -> None:
        """A call of a program's, or of nobody's in particular, leaves."""
        request, to = PROFILE.request(word, [] if word != "parafrente" else [10]), Address.named(robot)
        ward, frame = self.failsafe.ward(to), self.frame(request.payload.decode(), to)
        assert ward is not None
        self.failsafe.offered(ward, frame, request, program)
        self.failsafe.left("radio", frame, self.now)

    def frame(self, text: str, to: Address = MNERIM) -> Frame:
        return psiu_ascii.message(PC, to, *text.split())

    def moved_by_another_robot(self) -> None:
        self.failsafe.left("radio", self.frame("parafrente 10"), self.now)

    async def after(self, seconds: float) -> int:
        """How often MNERIM was told to stop so far."""
        self.now += seconds
        self.failsafe.tick(self.now)
        for _ in range(5):
            await asyncio.sleep(0)
        return self.stops

    async def _stop(self, robot: Address, options: FailsafeConfiguration, timeout_s: float) -> None:
        self.stopped.append(str(robot))
        if self.fails is not None:
            raise self.fails
        self.failsafe.left("radio", self.frame(self.command, robot), self.now)
        if self.behind:
            self.moves(self.behind)
        if self.cut_off:
            self.failsafe.link_closed("radio")
            raise CallError("link_down", "before it answered")
        if not self.answers:
            await asyncio.sleep(timeout_s)


async def test_the_robot_of_a_program_that_vanished_is_stopped_once() -> None:
    lab = Lab()
    lab.failsafe.program_came("p")
    lab.moves("p")
    assert await lab.after(60) == 0
    lab.failsafe.program_gone("p")
    assert await lab.after(0) == 1
    assert await lab.after(60) == 1


async def test_only_who_moved_it_last_is_missed() -> None:
    lab = Lab()
    for program in ("p", "q"):
        lab.failsafe.program_came(program)
        lab.moves(program)
    lab.failsafe.program_gone("p")
    assert await lab.after(1) == 0
    lab.failsafe.program_gone("q")
    assert await lab.after(0) == 1


@pytest.mark.parametrize(("text", "to"), [("parafrente 10", MNERIM), ("parafrente 10", EVERYONE), ("xyzzy", MNERIM)])
async def test_who_is_no_program_takes_no_robot_from_the_program_that_moved_it(text: str, to: Address) -> None:
    lab = Lab()
    lab.failsafe.program_came("p")
    lab.moves("p")
    lab.failsafe.left("radio", lab.frame(text, to), lab.now)
    lab.failsafe.program_gone("p")
    assert await lab.after(0) == 1


async def test_a_call_of_nobody_in_particular_takes_no_robot_from_a_program() -> None:
    lab = Lab()
    lab.failsafe.program_came("p")
    lab.moves("p")
    lab.moves(None, "buzina")
    lab.failsafe.program_gone("p")
    assert await lab.after(0) == 1


async def test_what_a_program_asked_for_before_it_went_in_good_order_takes_no_robot_from_another() -> None:
    lab = Lab()
    for program in ("p", "q"):
        lab.failsafe.program_came(program)
    lab.moves("p")
    lab.failsafe.program_done("q")
    lab.moves("q")
    lab.failsafe.program_gone("p")
    assert await lab.after(0) == 1


async def test_who_is_no_program_is_not_missed() -> None:
    lab = Lab()
    lab.moves()
    lab.moved_by_another_robot()
    assert await lab.after(60) == 0


async def test_all_robots_of_a_program_are_stopped_and_no_other() -> None:
    lab = Lab(robots=("MNERIM", "LEONIDES", "CANHAO"))
    for program in ("p", "q"):
        lab.failsafe.program_came(program)
    lab.moves("p")
    lab.moves("p", robot="LEONIDES")
    lab.moves("q", robot="CANHAO")
    lab.failsafe.program_gone("p")
    await lab.after(1)
    assert lab.stopped == ["MNERIM", "LEONIDES"]


@pytest.mark.parametrize("word", ["qualseunome", "quantoscomandos", "pare"])
async def test_who_only_asked_or_stopped_it_is_not_missed(word: str) -> None:
    lab = Lab("program_gone", "link_silent", "broker_stop")
    lab.failsafe.program_came("p")
    lab.moves("p", word)
    lab.failsafe.program_gone("p")
    await lab.after(60)
    await lab.failsafe.close()
    assert lab.stops == 0


async def test_a_stop_ends_the_watch() -> None:
    lab = Lab()
    lab.failsafe.program_came("p")
    lab.moves("p")
    lab.moves("p", "pare")
    lab.failsafe.program_gone("p")
    assert await lab.after(1) == 0


@pytest.mark.parametrize(("text", "to"), [("pare sucesso", MNERIM), ("pare", EVERYONE)])
async def test_neither_an_answer_nor_a_stop_to_everyone_ends_the_watch(text: str, to: Address) -> None:
    lab = Lab()
    lab.failsafe.program_came("p")
    lab.moves("p")
    lab.failsafe.left("radio", lab.frame(text, to), lab.now)
    lab.failsafe.program_gone("p")
    assert await lab.after(1) == 1


async def test_who_goes_in_good_order_is_not_missed() -> None:
    lab = Lab()
    lab.failsafe.program_came("p")
    lab.moves("p")
    lab.failsafe.program_done("p")
    lab.failsafe.program_gone("p")
    assert await lab.after(60) == 0
    lab.moves("p")
    assert await lab.after(60) == 0, "what it asked for last may leave later"


async def test_a_program_without_the_token_that_it_promises_is_missed_soon() -> None:
    lab = Lab()
    lab.moves("p")
    assert await lab.after(AWAITED_S / 2) == 0
    assert await lab.after(AWAITED_S) == 1


async def test_a_token_may_come_a_little_after_the_call() -> None:
    lab = Lab()
    lab.moves("p")
    lab.failsafe.program_came("p")
    assert await lab.after(10 * AWAITED_S) == 0


async def test_nothing_more_is_sent_for_a_program_that_is_gone() -> None:
    lab = Lab()
    lab.failsafe.program_came("p")
    lab.failsafe.program_gone("p")
    with pytest.raises(CallError, match="is gone"):
        lab.moves("p")
    lab.failsafe.program_came("p")
    lab.moves("p")


async def test_after_a_trouble_of_the_bus_each_program_has_to_show_itself_again() -> None:
    lab = Lab()
    lab.failsafe.program_came("p")
    lab.moves("p")
    lab.failsafe.programs_unsure()
    lab.failsafe.program_came("p")
    assert await lab.after(2 * AWAITED_S) == 0
    lab.failsafe.programs_unsure()
    assert await lab.after(2 * AWAITED_S) == 1


async def test_a_robot_that_is_silent_after_it_was_moved_is_stopped() -> None:
    lab = Lab("link_silent", silent_s=2.0)
    lab.moves()
    assert await lab.after(1.5) == 0
    lab.heard_at = lab.now
    assert await lab.after(1.5) == 0
    assert await lab.after(1.0) == 1
    assert await lab.after(60) == 1


async def test_a_robot_whose_link_went_down_is_stopped_when_it_is_open_again_and_only_then() -> None:
    lab = Lab("link_silent", silent_s=1000)
    lab.fails = CallError("link_down", "no")
    lab.moves()
    lab.failsafe.link_closed("radio")
    await lab.after(0)
    lab.fails, before = None, lab.stops
    lab.failsafe.link_opened("radio")
    assert await lab.after(0) == before + 1
    assert await lab.after(60) == before + 1


async def cut_off_before_it_answered() -> Lab:
    """MNERIM, whose stop left as its link went down."""
    lab = Lab()
    lab.cut_off = True
    lab.failsafe.program_came("p")
    lab.moves("p")
    lab.failsafe.program_gone("p")
    assert await lab.after(60) == 1
    lab.cut_off = False
    return lab


async def test_a_stop_that_its_link_may_have_lost_is_sent_anew_when_the_link_is_open_again() -> None:
    lab = await cut_off_before_it_answered()
    lab.failsafe.link_opened("radio")
    assert await lab.after(0) == 2
    assert await lab.after(60) == 2


async def test_a_stop_that_its_link_may_have_lost_is_not_sent_anew_once_another_program_moves_the_robot() -> None:
    lab = await cut_off_before_it_answered()
    lab.failsafe.program_came("q")
    lab.moves("q")
    lab.failsafe.link_opened("radio")
    assert await lab.after(60) == 1


async def test_a_stop_that_its_link_may_have_lost_is_not_sent_anew_where_the_robot_was_moved_behind_it() -> None:
    lab = Lab()
    lab.failsafe.program_came("q")
    lab.cut_off, lab.behind = True, "q"
    lab.failsafe.program_came("p")
    lab.moves("p")
    lab.failsafe.program_gone("p")
    assert await lab.after(0) == 1
    lab.failsafe.link_opened("radio")
    assert await lab.after(60) == 1


async def due_and_stuck(*on: str) -> Lab:
    """MNERIM, which `p` moved before it vanished, and which could not be told to stop."""
    lab = Lab(*on)
    lab.fails = CallError("expired", "the link was stuck")
    lab.failsafe.program_came("p")
    lab.moves("p")
    lab.failsafe.program_gone("p")
    assert await lab.after(0) == 1
    return lab


async def test_a_stop_that_did_not_leave_is_tried_again_until_another_program_moves_the_robot() -> None:
    lab = await due_and_stuck()
    assert await lab.after(AGAIN_S / 2) == 1
    assert await lab.after(AGAIN_S) == 2
    lab.failsafe.program_came("q")
    lab.moves("q")
    assert await lab.after(10 * AGAIN_S) == 2
    lab.fails = None
    lab.failsafe.program_gone("q")
    assert await lab.after(0) == 3


async def test_who_moves_a_robot_meanwhile_and_would_not_be_missed_spares_it_no_stop() -> None:
    lab = await due_and_stuck()
    lab.moves()
    lab.moved_by_another_robot()
    lab.failsafe.program_done("q")
    lab.moves("q")
    lab.fails = None
    assert await lab.after(AGAIN_S) == 2
    assert await lab.after(10 * AGAIN_S) == 2


@pytest.mark.parametrize("on", [(), ("program_gone",)], ids=["on broker_stop too", "on program_gone alone"])
async def test_a_stop_that_did_not_leave_is_tried_again_at_once_when_the_broker_stops(on: tuple[str, ...]) -> None:
    lab = await due_and_stuck(*on)
    lab.fails = None
    await lab.failsafe.close()
    assert lab.stops == 2


async def test_a_stop_that_fails_while_the_broker_stops_is_tried_once_more() -> None:
    lab = Lab()
    lab.moves()
    lab.fails = CallError("busy", "no room")
    await lab.failsafe.close()
    assert lab.stops == 2


async def test_a_robot_is_missed_anew_though_the_answer_to_its_last_stop_is_still_awaited() -> None:
    lab = Lab()
    lab.answers = False
    for times in (1, 2):
        lab.failsafe.program_came("p")
        lab.moves("p")
        lab.failsafe.program_gone("p")
        assert await lab.after(0) == times
    await lab.failsafe.close()


async def test_while_a_link_is_down_its_robots_are_told_nothing_and_one_line_says_so(
    caplog: pytest.LogCaptureFixture,
) -> None:
    lab = Lab("link_silent", "program_gone", silent_s=2.0)
    lab.failsafe.program_came("p")
    lab.moves("p")
    lab.failsafe.link_closed("radio")
    lab.failsafe.program_gone("p")
    for _ in range(600):
        assert await lab.after(1) == 0
    assert [record.message for record in caplog.records] == [
        "MNERIM is told to stop, once link radio is open: its link went down"
    ]
    await lab.failsafe.close()
    assert lab.stops == 0


async def test_nothing_is_told_of_links_that_close_because_the_broker_ends(caplog: pytest.LogCaptureFixture) -> None:
    lab = Lab("link_silent")
    lab.moves()
    await lab.failsafe.close()
    lab.failsafe.link_closed("radio")
    assert await lab.after(60) == 0
    assert caplog.records == []


async def test_a_stop_that_fails_again_and_again_is_told_once_and_so_is_its_end(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("INFO")
    lab = await due_and_stuck()
    for _ in range(600):
        await lab.after(AGAIN_S)
    lab.fails = None
    await lab.after(AGAIN_S)
    assert [record.message for record in caplog.records] == [
        "MNERIM is told to stop: the program that moved it is gone",
        "MNERIM could not be told to stop yet: the link was stuck",
        "MNERIM has been told to stop",
    ]


async def test_a_program_on_a_link_has_no_token_to_show_after_a_trouble_of_the_bus() -> None:
    lab = Lab()
    lab.failsafe.program_came("@panel")
    lab.moves("@panel")
    lab.failsafe.programs_unsure()
    assert await lab.after(10 * AWAITED_S) == 0
    lab.moves("@panel")
    lab.failsafe.program_gone("@panel")
    assert await lab.after(0) == 1


async def test_the_robot_of_another_broker_is_left_to_it() -> None:
    lab = Lab()
    lab.fails = CallError("unknown_robot", "it is elsewhere")
    lab.moves("p")
    assert await lab.after(2 * AWAITED_S) == 1
    assert await lab.after(60) == 1


@pytest.mark.parametrize(("text", "to", "stopped"), [
    ("parafrente 10", MNERIM, 1), ("parafrente 10", EVERYONE, 1), ("buzina", MNERIM, 1),
    ("parafrente sucesso", MNERIM, 0), ("qualseunome", EVERYONE, 0), ("pare", MNERIM, 0), ("parafrente 1", PC, 0),
])  # fmt: skip
async def test_what_other_robots_command_counts_when_the_broker_stops(text: str, to: Address, stopped: int) -> None:
    lab = Lab()
    lab.failsafe.left("radio", lab.frame(text, to), lab.now)
    await lab.failsafe.close()
    assert lab.stops == stopped


async def test_what_stops_the_robot_is_a_stop_in_whatever_words_it_is_sent() -> None:
    """As to a board that knows no single pins, which is told of a whole port at once."""
    lab = Lab(command="desliga")
    lab.moves("p")
    ward, request = lab.failsafe.ward(MNERIM), PROFILE.request("desliga", [])
    frame = lab.frame("porta 16")
    assert ward is not None
    lab.failsafe.offered(ward, frame, request, "p")
    assert lab.failsafe.stops(frame)
    lab.failsafe.left("radio", frame, lab.now)
    assert not ward.moves


async def test_a_robot_that_says_it_cannot_be_stopped_so_breaks_no_link(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a board that tells what its pins can do before it was sent anything."""
    lab = Lab(command="desliga")

    def cannot(*_: object) -> NoReturn:
        raise CallError("refused", "pin 13 cannot be output")

    monkeypatch.setattr(lab.failsafe, "_profile", lambda _: SimpleNamespace(request=cannot, moves=PROFILE.moves))
    assert not lab.failsafe.stops(lab.frame("parafrente 10"))
    lab.failsafe.left("radio", lab.frame("parafrente 10"), lab.now)
    ward = lab.failsafe.ward(MNERIM)
    assert ward is not None
    assert ward.moves


async def test_what_stops_the_robot_is_a_stop_whatever_its_word() -> None:
    lab = Lab(command="descansa")
    assert lab.failsafe.stops(lab.frame("descansa"))
    assert not lab.failsafe.stops(lab.frame("parafrente 10"))
    lab.moves()
    lab.failsafe.left("radio", lab.frame("descansa"), lab.now)
    await lab.failsafe.close()
    assert lab.stops == 0


async def test_a_robot_that_never_answers_does_not_keep_a_broker_from_stopping() -> None:
    lab = Lab()
    lab.moves()
    never: Callable[..., Awaitable[None]] = lambda *_: asyncio.sleep(60)  # noqa: E731
    lab.failsafe._stop = never
    async with asyncio.timeout(5):
        await lab.failsafe.close()

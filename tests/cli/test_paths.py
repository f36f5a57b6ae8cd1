"""`psiu why` and `psiu trace` across brokers, from what brokers answer."""

import json
from collections.abc import Callable
from typing import Any, Self

import pytest
from click.testing import Result

from psiu_broker.cli import connection, paths
from psiu_broker.cli.paths import followed
from psiu_broker.messages import NOTHING, Trace, TraceHop, Why

Run = Callable[..., Result]


class Bus:
    """In the client's place: brokers that answer what the test says."""

    def __init__(self) -> None:
        self.answers: dict[str, Any] = {}
        self.others: list[str] = []
        self.asked: list[tuple[str, ...]] = []

    def __call__(self, *_: object) -> Self:
        return self

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None: ...

    def ask(self, *what: str, timeout_s: float = 0) -> dict[str, Any]:
        self.asked.append(what)
        return self.answers

    def brokers(self) -> list[str]:
        return self.others

    def refuse_where_denied(self) -> None: ...


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> Bus:
    bus = Bus()
    monkeypatch.setattr(connection, "Client", bus)
    return bus


def why(broker: str, **more: Any) -> Why:
    usual = {"a": "A", "b": "B", "delivered": True, "verdict": "delivered", "steps": [f"a step of {broker}"]}
    return Why.model_validate(usual | {"broker": broker} | more)


def told(*decisions: Why) -> dict[str, Why]:
    return {each.broker: each for each in decisions}


def names(*decisions: Why, begin: str | None = None) -> list[str]:
    return [hop.broker for hop in followed(told(*decisions), begin).hops]


HERE = why("north", entry="radio", via="base")
THERE = why("base", entry="@mesh", link="wifi", age_s=2, cost_ms=41.7, filter="max_age_s = 2")


def test_the_way_begins_where_a_is_and_follows_from_broker_to_broker() -> None:
    assert names(why("alone"), THERE, HERE) == ["north", "base"]
    path = followed(told(why("alone"), THERE, HERE))
    assert (path.delivered, path.verdict) == (True, "would arrive")


def test_it_begins_at_the_first_where_nobody_has_a_or_where_it_is_told_to() -> None:
    assert names(why("base", entry="@mesh"), why("north")) == ["base"]
    assert names(THERE, HERE, begin="base") == ["base"]


def test_the_broker_that_stops_it_is_named() -> None:
    stop = why("base", entry="@mesh", delivered=False, verdict="link_down")
    path = followed(told(stop, HERE))
    assert (path.delivered, path.verdict) == (False, "would not arrive at base: link_down")


def test_a_broker_that_does_not_answer_ends_the_way() -> None:
    path = followed(told(HERE))
    assert (path.delivered, path.verdict) == (False, "would not arrive: base does not answer")


def test_a_circle_ends() -> None:
    path = followed(told(HERE, why("base", entry="@mesh", via="north")))
    assert (path.delivered, path.verdict) == (False, "would not arrive: base would hand it back to north")


def test_what_goes_to_everyone_passes_all_brokers_once() -> None:
    first = why("north", b="??", entry="radio", via="*")
    deaf = why("gate", b="??", entry="@mesh", delivered=False, verdict="no_route")
    path = followed(told(deaf, first, THERE))
    assert [hop.broker for hop in path.hops] == ["north", "gate", "base"]
    assert path.delivered


def answers(*decisions: Why) -> dict[str, Any]:
    return {each.broker: each.model_dump(mode="json") for each in decisions}


def test_each_hop_is_a_line_with_its_facts_and_steps(bus: Bus, tool: Run) -> None:
    bus.answers = answers(THERE, HERE)
    shown = tool("why", "A", "B")
    assert bus.asked == [("why", "A", "B")]
    assert shown.stdout.splitlines() == [
        "A → B would arrive",
        "  north → base",
        "    a step of north",
        "  base → wifi",
        "    a step of base",
        "    B was heard 2 s ago; takes about 41.7 ms on wifi; max_age_s = 2",
    ]


def test_one_broker_tells_its_steps_alone(bus: Bus, tool: Run) -> None:
    bus.answers = answers(why("base", entry="radio", delivered=False, verdict="no_route"))
    assert tool("why", "A", "B").stdout == "A → B would not arrive: no_route\n  a step of base\n"


def test_a_filter_that_is_a_step_already_is_not_said_twice(bus: Bus, tool: Run) -> None:
    bus.answers = answers(why("base", delivered=False, verdict="no_route", steps=["dropped: nobody"], filter="nobody"))
    assert tool("why", "A", "B").stdout.splitlines()[1:] == ["  dropped: nobody"]


def test_json_has_the_hops_in_their_order(bus: Bus, tool: Run) -> None:
    bus.answers = answers(THERE, HERE)
    assert [Why.model_validate(each) for each in json.loads(tool("why", "A", "B", "--json").stdout)] == [HERE, THERE]


def test_a_broker_of_before_the_mesh_is_understood(bus: Bus, tool: Run) -> None:
    bus.answers = {"old": {"a": "A", "b": "B", "delivered": True, "verdict": "delivered", "steps": []}}
    assert tool("why", "A", "B").stdout == "A → B would arrive\n"
    assert json.loads(tool("why", "A", "B", "--json").stdout)[0]["broker"] == "old"


def test_the_first_broker_can_be_named(bus: Bus, tool: Run) -> None:
    bus.answers = answers(THERE, HERE)
    assert "north" not in tool("why", "A", "B", "--broker", "base").stdout
    refused = tool("why", "A", "B", "--broker", "bse")
    assert (refused.exit_code, refused.stderr) == (3, "psiu: no broker bse answers; there is base, north\n")


TRACE = Trace(
    a="BETA",
    b="MNERIM",
    question="qualseunome",
    answered=True,
    hops=[
        TraceHop(at="north", event="sent", elapsed_ms=0),
        TraceHop(at="base", event="received", elapsed_ms=0.4),
        TraceHop(at="base/radio", event="written", elapsed_ms=1),
        TraceHop(at="MNERIM", event="answered", elapsed_ms=12.5),
    ],
    total_ms=13,
)


def test_a_trace_is_a_line_for_each_place(bus: Bus, tool: Run) -> None:
    bus.answers = {"north": TRACE.model_dump(mode="json")}
    shown = tool("trace", "BETA", "MNERIM")
    assert bus.asked == [("trace", "BETA", "MNERIM")]
    assert shown.exit_code == 0
    assert [line.split("\t") for line in shown.stdout.splitlines()] == [
        ["0.0", "north", "sent"],
        ["0.4", "base", "received"],
        ["1.0", "base/radio", "written"],
        ["12.5", "MNERIM", "answered"],
    ]
    assert [Trace.model_validate(each) for each in json.loads(tool("trace", "A", "B", "--json").stdout)] == [TRACE]


def test_a_terminal_gets_the_times_as_bars(capsys: pytest.CaptureFixture[str]) -> None:
    paths.show_trace(TRACE, drawn=True)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "BETA → MNERIM qualseunome: answered in 13.0 ms"
    assert [line.count("█") for line in lines[2:]] == [1, 1, 1, 29]
    assert lines[-1].rstrip().endswith("█")


def test_silence_exits_3_after_the_way_so_far(bus: Bus, tool: Run) -> None:
    silent = TRACE.model_copy(update={"answered": False, "reason": "silent after 3 tries", "hops": TRACE.hops[:2]})
    bus.answers = {"north": silent.model_dump(mode="json")}
    shown = tool("trace", "BETA", "MNERIM")
    assert (shown.exit_code, len(shown.stdout.splitlines())) == (3, 2)
    assert shown.stderr == "psiu: MNERIM did not answer qualseunome: silent after 3 tries\n"
    unasked = silent.model_copy(update={"question": NOTHING, "reason": "MNERIM speaks mitya"})
    bus.answers = {"north": unasked.model_dump(mode="json")}
    assert tool("trace", "BETA", "MNERIM").stderr == "psiu: nothing was sent: MNERIM speaks mitya\n"


def test_a_robot_on_no_broker_is_told_apart_from_no_broker(bus: Bus, tool: Run) -> None:
    refused = tool("trace", "NINGUEM", "MNERIM")
    assert (refused.exit_code, refused.stderr) == (3, "psiu: there is no broker at tcp/127.0.0.1:7447\n")
    bus.others = ["base"]
    refused = tool("trace", "NINGUEM", "MNERIM", "--json")
    assert (refused.exit_code, json.loads(refused.stdout)["error"]) == (3, "unknown_robot")
    assert refused.stderr == "psiu: NINGUEM is on no broker: psiu robots lists who is known\n"

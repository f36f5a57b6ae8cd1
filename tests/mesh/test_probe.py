"""Times of several clocks, in one order."""

import pytest

from psiu_broker.mesh.probe import Probed, Stamp, journey
from psiu_broker.messages import TraceHop

ANSWERED = Probed(
    question="qualseunome",
    answered=True,
    hops=[
        TraceHop(at="north/radio", event="written", elapsed_ms=1),
        TraceHop(at="MNERIM", event="answered", elapsed_ms=10),
    ],
    took_ms=10,
)


def told(hops: list[TraceHop]) -> list[tuple[str, str, float]]:
    return [(hop.at, hop.event, hop.elapsed_ms) for hop in hops]


def test_what_is_not_the_robot_s_is_half_there_and_half_back() -> None:
    assert told(journey("base", "north", ANSWERED, [], 14, str)) == [
        ("base", "sent", 0),
        ("north", "received", 2),
        ("north/radio", "written", 3),
        ("MNERIM", "answered", 12),
        ("base", "received", 14),
    ]


@pytest.mark.parametrize("ahead_ms", [0, 5_000_000, -70])
def test_a_relay_is_told_by_its_name_whatever_its_clock_says(ahead_ms: float) -> None:
    stamps = [
        Stamp("a", "send", 1000),
        Stamp("a", "route", 1000.1),
        Stamp("b", "route", 1001 + ahead_ms),
        Stamp("c", "route", 4001.9),
        Stamp("c", "receive", 4002),
        Stamp("c", "send", 4012),
        Stamp("b", "route", 1013 + ahead_ms),
        Stamp("a", "receive", 1014),
    ]
    hops = told(journey("base", "north", ANSWERED, stamps, 14, {"b": "gate"}.__getitem__))
    assert [hop for hop in hops if hop[1] == "routed"] == [("gate", "routed", 1), ("gate", "routed", 13)]
    assert [at for at, _, _ in hops] == ["base", "gate", "north", "north/radio", "MNERIM", "gate", "base"]


def test_times_never_run_back_or_past_the_end() -> None:
    stamps = [Stamp("a", "send", 0), Stamp("b", "route", -900), Stamp("c", "receive", 1), Stamp("a", "receive", 14)]
    hops = journey("base", "north", ANSWERED.model_copy(update={"took_ms": 90}), stamps, 14, str)
    times = [hop.elapsed_ms for hop in hops]
    assert times == sorted(times)
    assert (times[0], times[-1]) == (0, 14)

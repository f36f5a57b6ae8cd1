"""A question that one broker asks another for `psiu trace`, and when it was where. Pure."""

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field

from psiu_broker.messages import TraceHop


class Probed(BaseModel):
    """What became of a question on the last broker's side. Times are ms since it came there, by its steady clock."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    question: str = Field(max_length=255)
    answered: bool
    reason: str | None = Field(default=None, max_length=4096)
    hops: list[TraceHop] = Field(default=[], max_length=64)
    took_ms: float = Field(ge=0)


class Stamp(NamedTuple):
    """Zenoh's own record: a message passed a session, by the wall clock of that session."""

    zenoh_id: str
    """Without leading zeros, as Zenoh writes it."""
    point: Literal["send", "route", "receive"]
    at_ms: float


def journey(
    asker: str, owner: str, probed: Probed, stamps: Sequence[Stamp], took_ms: float, name: Callable[[str], str]
) -> list[TraceHop]:
    """The way from `asker` to `owner`, to the robot, and back, in ms since the question left `asker`.

    Args:
        stamps: of the way there and back; none where Zenoh offers none.
        took_ms: from the question to its answer, by the asker's steady clock.
        name: of the broker with a Zenoh id.
    """
    there_ms = max(took_ms - probed.took_ms, 0.0) / 2
    before, after = _relays(stamps, name)
    hops = [
        TraceHop(at=asker, event="sent", elapsed_ms=0),
        *before,
        TraceHop(at=owner, event="received", elapsed_ms=there_ms),
        *(hop.model_copy(update={"elapsed_ms": there_ms + hop.elapsed_ms}) for hop in probed.hops),
        *after,
        TraceHop(at=asker, event="received", elapsed_ms=took_ms),
    ]
    latest = 0.0
    ordered = []
    for hop in hops:  # clocks of several brokers are never quite right
        latest = min(max(latest, hop.elapsed_ms), took_ms)
        ordered.append(hop.model_copy(update={"elapsed_ms": round(latest, 3)}))
    return ordered


def _relays(stamps: Sequence[Stamp], name: Callable[[str], str]) -> tuple[list[TraceHop], list[TraceHop]]:
    """Where Zenoh relayed the question, and where the answer."""
    turn = next((index for index, stamp in enumerate(stamps) if stamp.point == "receive"), None)
    if turn is None:
        return [], []
    there, back = stamps[: turn + 1], stamps[turn + 1 :]
    ends = {there[0].zenoh_id, there[-1].zenoh_id}
    return (
        [_relay(stamp, there, back, name) for stamp in there if stamp.zenoh_id not in ends],
        [_relay(stamp, there, back, name) for stamp in back if stamp.zenoh_id not in ends],
    )


def _relay(stamp: Stamp, there: Sequence[Stamp], back: Sequence[Stamp], name: Callable[[str], str]) -> TraceHop:
    begun_ms = there[0].at_ms
    first = next((each.at_ms for each in there if each.zenoh_id == stamp.zenoh_id), None)
    last = next((each.at_ms for each in reversed(back) if each.zenoh_id == stamp.zenoh_id), None)
    # As in NTP: the way from us to the relay takes as long as the way back.
    ahead_ms = 0.0 if first is None or last is None else ((first - begun_ms) + (last - back[-1].at_ms)) / 2
    return TraceHop(at=name(stamp.zenoh_id), event="routed", elapsed_ms=stamp.at_ms - ahead_ms - begun_ms)

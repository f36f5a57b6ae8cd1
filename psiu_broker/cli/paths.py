"""The way from one robot to another across brokers: `psiu why` and `psiu trace`."""

from collections.abc import Mapping
from typing import Final, NamedTuple

import click

from psiu_broker.cli.commands import examples
from psiu_broker.cli.connection import Connection, NoWay, connects
from psiu_broker.cli.output import (
    ago,
    milliseconds,
    on_terminal,
    print_models,
    print_rows,
    print_table,
    printable,
    styled,
)
from psiu_broker.frame import MESH
from psiu_broker.messages import NOTHING, Trace, Why

TRACE_TIMEOUT_S: Final = 15.0
"""More than a broker takes for a trace."""

_SEVERAL: Final = "*"
_BAR: Final = 32


class Path(NamedTuple):
    """What the brokers say on the way of a frame, in its order."""

    hops: tuple[Why, ...]
    broken: str | None
    """Why nobody knows what follows the last one."""

    @property
    def delivered(self) -> bool:
        end = self.hops[0] if self.hops[0].via == _SEVERAL else self.hops[-1]
        return self.broken is None and end.delivered

    @property
    def verdict(self) -> str:
        """In words, with the broker that stops it where there are several."""
        if self.delivered:
            return "would arrive"
        last = self.hops[-1]
        reason = self.broken or last.verdict
        at = f" at {last.broker}" if len(self.hops) > 1 and self.broken is None else ""
        return f"would not arrive{at}: {reason}"


@click.command(epilog=examples("psiu why BETA MNERIM", "psiu why base 0x12", "psiu why BETA '??' --json"))
@click.argument("a")
@click.argument("b")
@click.option("--broker", metavar="NAME", help="Begin at this broker; left out: at the one that A is on.")
@connects
def why(connection: Connection, a: str, b: str, broker: str | None) -> None:
    """Tell what would become of a frame from robot A to robot B now, and why, broker by broker.

    A robot is a name, a PSIU HEXA address such as 0x12 or red.0x12, or ?? for everyone. With --json: a list with the
    decision of each broker on the way, in its order (psiu schema Why). The way is cut where the last one hands the
    frame on, by via, to a broker that is not in the list.
    """
    with connection.client() as client:
        told = client.ask("why", a, b)
        read = {name: Why.model_validate(told[name]) for name in sorted(told)}
    decisions = {name: each.model_copy(update={"broker": name}) for name, each in read.items()}
    if not decisions:
        raise connection.nobody()
    if broker is not None and broker not in decisions:
        raise connection.failure("no_broker", f"no broker {broker} answers; there is {', '.join(decisions)}")
    path = followed(decisions, broker)
    if connection.as_json:
        print_models(path.hops)
        return
    first = path.hops[0]
    colour = "green" if path.delivered else "red"
    click.echo(styled(f"{first.a} → {first.b} {path.verdict}", fg=colour, bold=True))
    several = len(path.hops) > 1 or path.broken is not None
    for hop in path.hops:
        if several:
            click.echo(f"  {styled(f'{hop.broker} {_outcome(hop)}', bold=True)}")
        lines = [*hop.steps, *([facts] if (facts := _facts(hop)) else [])]
        for line in lines:
            click.echo(f"  {'  ' if several else ''}{printable(line)}")


@click.command(epilog=examples("psiu trace BETA MNERIM", "psiu trace base MNERIM --json | jq '.[].total_ms'"))
@click.argument("a")
@click.argument("b")
@connects
def trace(connection: Connection, a: str, b: str) -> None:
    """Have the broker that A is on ask robot B a harmless question, and show its way with times.

    B is asked how many commands it has, or pinged; nothing moves. A is a robot or a broker. In a pipe each line has,
    between tabs: ms since the question left, where, what happened there. With --json: a list (psiu schema Trace).
    The exit code is 3 if B did not answer; one line on stderr says why.
    """
    with connection.client() as client:
        told = client.ask("trace", a, b, timeout_s=TRACE_TIMEOUT_S)
        traces = [Trace.model_validate(told[name]) for name in sorted(told)]
        if not traces:
            client.refuse_where_denied()
            if not client.brokers():
                raise connection.nobody()
    if not traces:
        raise connection.failure("unknown_robot", f"{a} is on no broker: psiu robots lists who is known")
    if connection.as_json:
        print_models(traces)
    for each in traces if not connection.as_json else ():
        show_trace(each, drawn=on_terminal())
    silent = next((each for each in traces if not each.answered), None)
    if silent is not None:
        reason = silent.reason or "it was silent"
        outcome = "nothing was sent" if silent.question == NOTHING else f"{silent.b} did not answer {silent.question}"
        raise NoWay(f"{outcome}: {reason}")


def followed(decisions: Mapping[str, Why], begin: str | None = None) -> Path:
    """The decisions that a frame meets, from broker to broker; `decisions` is by name and not empty."""
    hop = decisions[begin] if begin is not None else _home(decisions)
    hops = [hop]
    while hop.via is not None:
        if hop.via == _SEVERAL:
            hops += [other for other in decisions.values() if other not in hops]
            return Path(tuple(hops), None)
        following = decisions.get(hop.via)
        if following is None:
            return Path(tuple(hops), f"{hop.via} does not answer")
        if following in hops:
            return Path(tuple(hops), f"{hop.broker} would hand it back to {hop.via}")
        hop = following
        hops.append(hop)
    return Path(tuple(hops), None)


def show_trace(trace: Trace, *, drawn: bool) -> None:
    if not drawn:
        print_rows((hop.elapsed_ms, hop.at, hop.event) for hop in trace.hops)
        return
    said = f"answered in {milliseconds(trace.total_ms)}" if trace.answered else "no answer"
    heading = f"{trace.a} → {trace.b} {trace.question}: {said}"
    click.echo(styled(heading, fg="green" if trace.answered else "red", bold=True))
    before = 0.0
    rows = []
    for hop in trace.hops:
        rows.append((milliseconds(hop.elapsed_ms), hop.at, hop.event, _bar(before, hop.elapsed_ms, trace.total_ms)))
        before = hop.elapsed_ms
    print_table(("after", "where", "what", ""), rows, "The question did not leave.")


def _home(decisions: Mapping[str, Why]) -> Why:
    """Of the broker that A is on; where nobody has A, the first one's."""
    own = (each for each in decisions.values() if each.entry not in (None, MESH))
    return next(own, next(iter(decisions.values())))


def _outcome(hop: Why) -> str:
    if hop.via is not None:
        return f"→ {'the other brokers' if hop.via == _SEVERAL else hop.via}"
    if not hop.delivered:
        return "stops it"
    return f"→ {hop.link}" if hop.link is not None else hop.verdict


def _facts(hop: Why) -> str:
    facts = [
        None if hop.age_s is None else f"{hop.b} was heard {ago(hop.age_s)}",
        None if hop.cost_ms is None else f"takes about {milliseconds(hop.cost_ms)} on {hop.link or 'the way'}",
        # What stopped it is often a step already.
        None if hop.filter is None or any(hop.filter in step for step in hop.steps) else hop.filter,
    ]
    return "; ".join(fact for fact in facts if fact is not None)


def _bar(begin: float, end: float, total: float) -> str:
    """The time from `begin` to `end` as its part of the whole."""
    if total <= 0:
        return ""
    first, last = (min(_BAR, round(_BAR * each / total)) for each in (begin, end))
    return " " * first + "█" * max(last - first, 1)

"""The robots that `psiu sim` can be: the options that each protocol has for them, and what they make."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, NamedTuple, get_args

import click
from pydantic import ValidationError

from psiu_broker.cli import sim_views
from psiu_broker.cli.by_protocol import Offer, Offers, of_protocol
from psiu_broker.cli.commands import number, parsed
from psiu_broker.profiles.node import Node
from psiu_broker.simulator import (
    QUIRKS,
    TEAMS,
    AmarinoBoard,
    AsciiRobot,
    Drift,
    Extra,
    FirmataBoard,
    HexaRobot,
    MityaBody,
    MityaVersion,
    Robot,
    SoccerRobot,
)
from psiu_broker.simulator.firmata import CHANNELS

__all__ = ["OFFERS", "SIMULATED", "Cast", "Simulated", "cast"]

_SECONDS: Final = click.FloatRange(0)


@dataclass(frozen=True)
class Cast:
    """The robots that are played on one line, and how they are told of."""

    robots: Sequence[Robot]
    view: Callable[[Any], Iterable[sim_views.Seen]]
    """What a person sees of one of them: always as many things, in the same order."""
    text: bool = False
    """Their bytes are text that a person can read."""
    steady: bool = False
    """The same comes or goes again and again, and is told once."""
    words: bool = True
    """What they hear is told in words as well; else what they do says it."""
    moves: bool = False
    """They do things when nothing happens on the line."""


@dataclass(frozen=True)
class Simulated:
    """The robots of one protocol.

    `make` gets the options that were given, by name, the `seed`, and whether the line carries `datagrams`.
    """

    make: Callable[..., Cast]
    offers: Sequence[Offer]
    required: str | None = None
    """The option without which there is no robot."""


def cast(protocol: str, options: Mapping[str, Any], *, seed: int, datagrams: bool) -> Cast:
    """The robots of a command's `options`.

    Raises:
        click.UsageError: an option is another protocol's, has a wrong value, or is missing.
    """
    simulated = SIMULATED[protocol]
    given = of_protocol(protocol, options, OFFERS)
    if simulated.required is not None and simulated.required not in given:
        raise click.UsageError(f"--{simulated.required} is missing: who is the robot?")
    try:
        return simulated.make(seed=seed, datagrams=datagrams, **given)
    except ValueError as error:
        raise click.UsageError(str(error)) from error


class NamedNode(NamedTuple):
    """A node with its name and, for a sensor, the signal that it answers."""

    name: str
    node: Node
    signal: int

    @classmethod
    def parse(cls, text: str) -> "NamedNode":
        """Read ``garra=4:servo`` or ``sonar=7:distance=99``.

        Raises:
            ValueError: `text` is not of this form, or there is no such type.
        """
        match = re.fullmatch(r"(\w+)=(\w+):([\w-]+)(?:=(\w+))?", text)
        if match is None:
            raise ValueError(f"{text!r} is not NAME=NUMBER:TYPE[=SIGNAL], such as garra=4:servo")
        try:
            node = Node.model_validate({"node": number(match[2]), "type": match[3]})
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            raise ValueError(f"{text!r}: {first['loc'][0]}: {first['msg']}") from error
        return cls(match[1], node, number(match[4] or "42"))


class Level(NamedTuple):
    """What an input of a board has: one level, or one that goes from `low` to `high` and back, for ever."""

    pin: str
    low: int
    high: int | None

    @classmethod
    def parse(cls, text: str) -> "Level":
        """Read ``7=1``, ``A0=512`` or ``A0=100:900``.

        Raises:
            ValueError: `text` is not of this form, or what drifts is no analog pin.
        """
        match = re.fullmatch(r"(A?\d{1,2})=(\d{1,4})(?::(\d{1,4}))?", text)
        if match is None or (match[3] is not None and match[1][0] != "A"):
            raise ValueError(f"{text!r} is not PIN=LEVEL or, from and to for an analog one, such as A0=100:900")
        return cls(match[1], int(match[2]), None if match[3] is None else int(match[3]))


class Function(NamedTuple):
    """What a board does at a flag: it answers `answer`, with what it was told where that is empty, or not at all."""

    flag: str
    answer: str | None

    @classmethod
    def parse(cls, text: str) -> "Function":
        """Read ``A``, ``A=42`` or ``A=``.

        Raises:
            ValueError: `text` is not of this form.
        """
        flag, equals, answer = text[:1], text[1:2], text[2:]
        if equals not in ("", "=") or not flag:
            raise ValueError(f"{text!r} is not FLAG or FLAG=ANSWER, such as A=42")
        return cls(flag, answer if equals else None)


def _ascii(*, seed: int, datagrams: bool, name: str, commands: Sequence[Extra] = (), **given: Any) -> Cast:
    return Cast([AsciiRobot(name, extras=commands, seed=seed, **given)], sim_views.position, text=True)


def _hexa(*, seed: int, datagrams: bool, address: int, nodes: Sequence[NamedNode] = (), **given: Any) -> Cast:
    if nodes:
        given["actuators"] = [each.node.node for each in nodes if each.node.is_actuator]
        given["sensors"] = {each.node.node: each.signal for each in nodes if not each.node.is_actuator}
    names = {each.node.node: (each.name, each.node) for each in nodes}
    return Cast([HexaRobot(address, **given)], partial(sim_views.signals, nodes=names))


def _mitya(*, seed: int, datagrams: bool, **given: Any) -> Cast:
    return Cast([MityaBody(phone=datagrams, **given)], sim_views.body, text=True, moves=True)


def _soccer(*, seed: int, datagrams: bool, preset: str = "mirosot", address: int | None = None, **given: Any) -> Cast:
    team = SoccerRobot.team(preset, **given)
    if address is not None and not 1 <= address <= len(team):
        raise ValueError(f"an address is 1–{len(team)}, one of the robots of the team, not {address}")
    return Cast(
        team if address is None else [team[address - 1]], sim_views.wheels, steady=True, words=False, moves=True
    )


def _firmata(*, seed: int, datagrams: bool, levels: Sequence[Level] = (), **given: Any) -> Cast:
    drifts = {int(each.pin[1:]): Drift(each.low, each.high) for each in levels if each.high is not None}
    board = FirmataBoard(**given, drifts=drifts)
    for each in levels:
        if each.high is None or int(each.pin[1:]) >= CHANNELS:  # of such a pin it says that there is none
            board.set_pin(each.pin, each.low)
    return Cast([board], sim_views.pins, steady=True)


def _amarino(*, seed: int, datagrams: bool, functions: Sequence[Function] = (), **given: Any) -> Cast:
    if functions:
        given["functions"] = {each.flag: each.answer for each in functions}
    return Cast([AmarinoBoard(**given)], sim_views.board, text=True)


def _telemetry(what: str) -> Offer:
    return Offer(
        "telemetry_s", f"Tell {what}, unasked, so often.", spelled="--telemetry", metavar="SECONDS", type=_SECONDS
    )


_ANSWER_AFTER: Final = Offer(
    "answer_s", "How long any answer takes.", spelled="--answer-after", metavar="SECONDS", type=_SECONDS
)


def _choice(values: Iterable[Any]) -> click.Choice[Any]:
    return click.Choice(list(values))


def _quirks(ctx: click.Context, param: click.Parameter, wanted: bool | None) -> None:
    if wanted and not ctx.resilient_parsing:
        for name, text in QUIRKS.items():
            click.echo(f"{name:<15} {text}")
        ctx.exit()


_NUMBER: Final[Mapping[str, Any]] = {"metavar": "NUMBER", "callback": parsed(number)}

SIMULATED: Final[Mapping[str, Simulated]] = {
    "psiu-ascii": Simulated(
        _ascii,
        [
            Offer("name", "The robot's name."),
            Offer("version", "Of which draft; usual: 1, the document.", type=_choice(["1", "0.5", "0"])),
            Offer(
                "commands",
                "One more command, its numbers of parameters, and what it answers.",
                spelled="--command",
                metavar="NAME:INTS[,FLOATS[,CHARS]][=ANSWER]",
                callback=parsed(Extra.parse),
                multiple=True,
            ),
            Offer(
                "quirks",
                "A fault of real firmware; see --list-quirks.",
                spelled="--quirk",
                type=_choice(QUIRKS),
                metavar="QUIRK",
                multiple=True,
            ),
            Offer(
                "list_quirks",
                "Say what each quirk does, and end.",
                is_flag=True,
                is_eager=True,
                expose_value=False,
                callback=_quirks,
            ),
            Offer(
                "per_unit_s",
                "How long a centimetre or a degree takes.",
                spelled="--per-unit",
                metavar="SECONDS",
                type=_SECONDS,
            ),
            Offer(
                "wildcard_delay_s",
                "Answer ?? after a random time up to this.",
                spelled="--wildcard-delay",
                metavar="SECONDS",
                type=_SECONDS,
            ),
            _telemetry("where it is"),
            _ANSWER_AFTER,
        ],
        required="name",
    ),
    "psiu-hexa": Simulated(
        _hexa,
        [
            Offer("address", "The robot's address, 0-255.", **_NUMBER),
            Offer(
                "topology",
                "Which addresses packets carry; usual: ad-hoc.",
                type=_choice(["ad-hoc", "master-slave", "point-to-point"]),
            ),
            Offer("size", "What the size byte counts; usual: nominal.", type=_choice(["nominal", "real"])),
            Offer(
                "crc",
                "How the check byte is made; usual: smbus.",
                type=_choice(["smbus", "maxim-dow", "dvb-s2", "nrsc-5", "xor", "sum", "negsum", "none"]),
            ),
            Offer("fragment", "Break and rejoin long complex messages.", is_flag=True),
            Offer(
                "nodes",
                "A node; types as in the broker's configuration (servo, dc, on-off, distance, switch...)."
                " SIGNAL is what a sensor answers.",
                spelled="--node",
                metavar="NAME=NUMBER:TYPE[=SIGNAL]",
                callback=parsed(NamedNode.parse),
                multiple=True,
            ),
            Offer("busy_s", "Be busy so long after a signal.", spelled="--busy", metavar="SECONDS", type=_SECONDS),
            Offer("sensor_reply", "How sensors mark an answer; usual: node-0.", type=_choice(["node-0", "bit7"])),
            Offer("master", "To whom it speaks unasked; usual: 0.", **_NUMBER),
            _telemetry("its signals"),
            _ANSWER_AFTER,
        ],
        required="address",
    ),
    "mitya": Simulated(
        _mitya,
        [
            Offer("name", "How it is called here; usual: MITYA."),
            Offer(
                "version",
                "Whose firmware; usual: 2012, which never gets back into step by itself. With --udp it is"
                " the phone with its body.",
                type=_choice(get_args(MityaVersion)),
            ),
            Offer("volts", "What its battery has; usual: 5.02.", metavar="VOLTS", type=float),
            _telemetry("the battery (2012: a hit)"),
            _ANSWER_AFTER,
        ],
    ),
    "soccer": Simulated(
        _soccer,
        [
            Offer("preset", "Whose packets they read; usual: mirosot. All the team is there.", type=_choice(TEAMS)),
            Offer("address", "Only this robot of the team, counted from 1.", **_NUMBER),
            Offer("robots", "How many there are, if not as in the preset; so for the next.", **_NUMBER),
            Offer("bytes_per_robot", "Bytes of each robot's share.", **_NUMBER),
            Offer("byte_codec", "What a byte says.", type=_choice(["raw", "int8", "mirosot"])),
            Offer("start", "The byte that begins a packet.", **_NUMBER),
            Offer("trailer", "What ends a packet.", type=_choice(["end", "fill", "none"])),
            Offer("end", "The byte that ends a packet.", **_NUMBER),
            Offer(
                "stop_after_s",
                "Stop by itself when nothing came for so long; usual: never.",
                spelled="--stop-after",
                metavar="SECONDS",
                type=_SECONDS,
            ),
        ],
    ),
    "firmata": Simulated(
        _firmata,
        [
            Offer("name", "How it is called here; usual: uno."),
            Offer("firmware", "The name of its sketch; usual: StandardFirmata.ino.", metavar="NAME"),
            Offer(
                "levels",
                "What an input has: 0 or 1; where analog 0-1023, or up and down between two.",
                spelled="--pin",
                metavar="PIN=LEVEL[:LEVEL]",
                callback=parsed(Level.parse),
                multiple=True,
            ),
            Offer(
                "boot_s",
                "Be deaf for so long, then say who it is, as an Uno does.",
                spelled="--boot",
                metavar="SECONDS",
                type=_SECONDS,
            ),
            Offer("instance", "Be a FirmataExpress board of this number.", **_NUMBER),
        ],
    ),
    "amarino": Simulated(
        _amarino,
        [
            Offer("name", "How it is called here; usual: board."),
            Offer(
                "functions",
                "A flag with a function, and what that answers; nothing behind = answers what it was told."
                " Usual: A, B= and C=42.",
                spelled="--function",
                metavar="FLAG[=ANSWER]",
                callback=parsed(Function.parse),
                multiple=True,
            ),
            Offer(
                "readings",
                "A value that it tells; usual: 21.5.",
                spelled="--reading",
                metavar="NUMBER",
                type=float,
                multiple=True,
            ),
            _telemetry("its readings"),
            _ANSWER_AFTER,
        ],
    ),
}
"""By the name of the protocol."""

OFFERS: Final[Offers] = {protocol: simulated.offers for protocol, simulated in SIMULATED.items()}

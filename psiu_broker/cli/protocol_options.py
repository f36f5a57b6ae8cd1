"""The options of the codecs as options of a command, so that both have the same names, values and words."""

from collections.abc import Mapping, Sequence
from typing import Any, Final, Literal, get_args, get_origin

import click
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from psiu_broker.cli.by_protocol import Offer, Offers, of_protocol, offered, spelling
from psiu_broker.cli.commands import number, parsed
from psiu_broker.protocols import CODECS, PROTOCOLS

_WITHOUT: Final = frozenset({"silence_ms", "realign", "baud", "rate_hz", "hold_s", "steady", "buffer"})
"""What means nothing to bytes that are all there, or to those that nobody sends."""
_SIMPLE: Final = (bool, int, float, str)


def codec_options(protocol: str, options: Mapping[str, Any]) -> BaseModel:
    """What a codec of `protocol` is made of, from a command's `options`.

    Raises:
        click.UsageError: an option is another protocol's, or has a wrong value.
    """
    return _made(protocol, of_protocol(protocol, options, CODEC_OFFERS))


def _made(protocol: str, given: Mapping[str, Any]) -> BaseModel:
    try:
        return CODECS[protocol].Options.model_validate(given)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where, said = spelling(str(next(iter(first["loc"]), ""))), first["msg"].removeprefix("Value error, ")
        shown = "" if where == "--" or first["type"] == "value_error" else f", not {first['input']!r}"
        raise click.UsageError(f"{said}{shown}" if where == "--" else f"{where}: {said}{shown}") from error


def _offers(protocol: str) -> Sequence[Offer]:
    fields = CODECS[protocol].Options.model_fields
    return [_offer(name, field) for name, field in fields.items() if name not in _WITHOUT and _is_simple(field)]


def _is_simple(field: FieldInfo) -> bool:
    """Whether it is one word; lists and tables are for the configuration."""
    kind: Any = field.annotation
    return get_origin(kind) is Literal or kind in _SIMPLE or any(each in _SIMPLE for each in get_args(kind))


def _offer(name: str, field: FieldInfo) -> Offer:
    kind: Any = field.annotation
    spelled = spelling(name)
    settings: dict[str, Any] = {}
    if kind is bool:
        spelled = f"{spelled}/--no-{spelled[2:]}"
    elif get_origin(kind) is Literal:
        settings = {"type": click.Choice(get_args(kind))}
    elif kind is int or int in get_args(kind):
        settings = {"metavar": "NUMBER", "callback": parsed(number)}
    elif kind is float or float in get_args(kind):
        settings = {"metavar": "NUMBER", "type": float}
    default = "" if field.default is None or field.default == "" else f"; usual: {_shown(field.default)}"
    return Offer(name, f"{field.description}{default}.", spelled=spelled, **settings)


def _shown(default: Any) -> str:
    return {True: "yes", False: "no"}[default] if isinstance(default, bool) else str(default)


CODEC_OFFERS: Final[Offers] = {protocol: _offers(protocol) for protocol in PROTOCOLS}

protocol_options: Final = offered(CODEC_OFFERS)
"""Give a `ByProtocol` an option for each that a codec has."""

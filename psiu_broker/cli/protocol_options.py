"""The options of the codecs as options of a command, so that both have the same names, values and words."""

from collections.abc import Callable, Mapping
from typing import Any, Final, Literal, TypeVar, get_args, get_origin

import click
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from psiu_broker.cli.commands import number, parsed
from psiu_broker.protocols import CODECS

Command = TypeVar("Command", bound=Callable[..., Any])

_WITHOUT: Final = frozenset({"silence_ms"})
"""What means nothing to bytes that are all there."""


def protocol_options(command: Command) -> Command:
    """Give `command` an option for each that a codec has; None where the user gives none."""
    fields: dict[str, FieldInfo] = {}
    owners: dict[str, list[str]] = {}
    for protocol, codec in CODECS.items():
        for name, field in codec.Options.model_fields.items():
            if name not in _WITHOUT:
                fields.setdefault(name, field)
                owners.setdefault(name, []).append(protocol)
    for name, field in reversed(fields.items()):
        command = _option(name, field, " and ".join(owners[name]))(command)
    return command


def given(options: Mapping[str, Any]) -> dict[str, Any]:
    """Those of a command's `options` that belong to codecs and were given."""
    known = {name for codec in CODECS.values() for name in codec.Options.model_fields}
    return {name: value for name, value in options.items() if name in known and value is not None}


def codec_options(protocol: str, options: Mapping[str, Any]) -> BaseModel:
    """What a codec of `protocol` is made of; a usage error for an option that is another's or has a wrong value."""
    model = CODECS[protocol].Options
    for name in options:
        if name not in model.model_fields:
            owner = next(other for other, codec in CODECS.items() if name in codec.Options.model_fields)
            raise click.UsageError(f"{_spelled(name)} is an option of {owner}; add --protocol {owner}")
    try:
        return model.model_validate(options)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise click.UsageError(f"{_spelled(str(first['loc'][0]))}: {first['msg']}, not {first['input']!r}") from error


def _option(name: str, field: FieldInfo, owner: str) -> Callable[[Command], Command]:
    kind: Any = field.annotation
    spelled = _spelled(name)
    declaration = f"{spelled}/--no-{spelled[2:]}" if kind is bool else spelled
    more: dict[str, Any] = {}
    if get_origin(kind) is Literal:
        more = {"type": click.Choice(get_args(kind))}
    elif kind is int or int in get_args(kind):
        more = {"metavar": "NUMBER", "callback": parsed(number)}
    default = "" if field.default is None or field.default == "" else f"; usual: {_shown(field.default)}"
    return click.option(declaration, name, default=None, help=f"{owner}: {field.description}{default}.", **more)


def _shown(default: Any) -> str:
    return {True: "yes", False: "no"}[default] if isinstance(default, bool) else str(default)


def _spelled(name: str) -> str:
    return f"--{name.replace('_', '-')}"

"""Options that only some protocols have: each is declared once, and told under each protocol that has it."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, TypeVar

import click

Command = TypeVar("Command", bound=Callable[..., Any])


class Offer:
    """An option as one protocol has it: its name as a parameter, what it does there, and what click is to know."""

    def __init__(self, name: str, text: str, *, spelled: str | None = None, **settings: Any) -> None:
        self.name = name
        self.spelled = spelled or spelling(name)
        self._settings = {"default": None, **settings, "help": text}

    @property
    def choices(self) -> Sequence[Any]:
        """The values that it may have, where they are few; else none."""
        kind = self._settings.get("type")
        return kind.choices if isinstance(kind, click.Choice) else ()

    def option(self) -> click.Option:
        return _Owned([self.spelled, self.name], **self._settings)

    def give(self, command: Command, choices: Sequence[Any]) -> Command:
        """Give `command` this option, which takes all of `choices`, where there are any."""
        settings = {**self._settings, "type": click.Choice(list(choices))} if choices else self._settings
        return click.option(self.spelled, self.name, cls=_Owned, **settings)(command)


Offers = Mapping[str, Sequence[Offer]]
"""What each protocol offers."""


class ByProtocol(click.Command):
    """A command whose help tells the options that each protocol offers by themselves."""

    def __init__(self, *args: Any, offers: Offers, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._offers = offers

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        shared = [param for param in self.get_params(ctx) if not isinstance(param, _Owned)]
        sections: dict[str, Sequence[click.Parameter]] = {"Options": shared}
        for protocol, offers in self._offers.items():
            sections[f"Options of {protocol}"] = [offer.option() for offer in offers]
        for title, params in sections.items():
            records = [record for param in params if (record := param.get_help_record(ctx)) is not None]
            if records:
                with formatter.section(title):
                    formatter.write_dl(records)


def offered(offers: Offers) -> Callable[[Command], Command]:
    """Give a `ByProtocol` all that is offered: None, or nothing at all, where the user gives none.

    Where protocols have different choices for one option it takes them all; `of_protocol` knows whose each is.
    """
    by_name = _by_name(offers)

    def give(command: Command) -> Command:
        for each in reversed(by_name.values()):
            choices = dict.fromkeys(choice for offer in each.values() for choice in offer.choices)
            command = next(iter(each.values())).give(command, list(choices))
        return command

    return give


def of_protocol(protocol: str, options: Mapping[str, Any], offers: Offers) -> dict[str, Any]:
    """Those of a command's `options` that were offered and given.

    Raises:
        click.UsageError: `protocol` does not have one of them, or not with this value.
    """
    by_name = _by_name(offers)
    given = {name: value for name, value in options.items() if name in by_name and value not in _NOT_GIVEN}
    for name, value in given.items():
        owners = by_name[name]
        spelled = next(iter(owners.values())).spelled.partition("/")[0]
        if protocol not in owners:
            names = " or ".join(owners)
            raise click.UsageError(f"{spelled} is an option of {names}; add --protocol {names}")
        choices = owners[protocol].choices
        for each in (value if isinstance(value, tuple) else (value,)) if choices else ():
            if each not in choices:
                raise click.UsageError(f"{spelled} of {protocol} is {' or '.join(map(str, choices))}, not {each}")
    return given


def spelling(name: str) -> str:
    return f"--{name.replace('_', '-')}"


class _Owned(click.Option):
    """Told under its protocols."""


_NOT_GIVEN: Final = (None, ())


def _by_name(offers: Offers) -> dict[str, dict[str, Offer]]:
    """The offers of each name, by protocol."""
    found: dict[str, dict[str, Offer]] = {}
    for protocol, each in offers.items():
        for offer in each:
            found.setdefault(offer.name, {})[protocol] = offer
    return found

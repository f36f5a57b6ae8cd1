"""`psiu-broker check` and `psiu-broker schema`, and how every command reads the configuration."""

from pathlib import Path
from typing import Any, Final

import click

from psiu_broker.cli.commands import Failure, examples
from psiu_broker.cli.output import print_json
from psiu_broker.config import Configuration, json_schema, load
from psiu_broker.errors import ConfigurationError

WRONG: Final = 78
"""EX_CONFIG: the service manager is told not to try again."""


class WrongConfiguration(Failure):
    """Each mistake of the file is a line on stderr."""

    exit_code = WRONG

    def __init__(self, error: ConfigurationError) -> None:
        super().__init__(str(error))
        self._problems = error.problems

    def show(self, file: Any = None) -> None:
        for problem in self._problems:
            click.echo(problem, file=file, err=file is None)


def read(file: Path) -> Configuration:
    """The configuration in `file`, or the end of the command."""
    try:
        return load(file)
    except ConfigurationError as error:
        raise WrongConfiguration(error) from error


@click.command(epilog=examples("psiu-broker check /etc/psiu-broker/psiu-broker.toml"))
@click.argument("file", type=click.Path(path_type=Path))
def check(file: Path) -> None:
    """Say whether the configuration FILE is good, or what is wrong, a line a mistake.

    The exit code is 0 if it is good, whatever the warnings, else 78.
    """
    configuration = read(file)
    links, robots = len(configuration.links), len(configuration.robots)
    trunks = f"{_count(len(configuration.trunks), 'trunk')}, " if configuration.trunks else ""
    click.echo(f"{file}: good: {_count(links, 'link')}, {trunks}{_count(robots, 'robot')}")
    for warning in configuration.warnings:
        click.echo(f"warning: {warning}", err=True)


@click.command(epilog=examples("psiu-broker schema > psiu-broker.schema.json"))
def schema() -> None:
    """Print the JSON schema of the configuration file: every table, key, default and explanation."""
    print_json(json_schema())


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"

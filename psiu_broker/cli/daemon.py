"""`psiu-broker`, the daemon."""

from typing import Final, NoReturn

import click

from psiu_broker import __version__
from psiu_broker.cli import commands

_HERE: Final = "psiu_broker.cli"


@click.group(
    cls=commands.Commands,
    where={
        "run": ("Be the broker.", f"{_HERE}.run:run"),
        "check": ("Say what is wrong in a configuration.", f"{_HERE}.configuration:check"),
        "schema": ("Print the JSON schema of the configuration.", f"{_HERE}.configuration:schema"),
        "keys": ("Make keys and certificates for brokers and programs.", f"{_HERE}.keys:keys"),
        "demo": ("See a broker and simulated robots of every protocol at work.", f"{_HERE}.demo:demo"),
    },
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog=commands.examples(
        "psiu-broker demo",
        "psiu-broker check psiu-broker.toml",
        "psiu-broker run --config psiu-broker.toml",
    ),
)
@click.version_option(__version__, package_name="psiu-broker")
def psiu_broker() -> None:
    """Join small robots on serial, Bluetooth and UDP links into one network. The tool for people is psiu."""


def main() -> NoReturn:
    """The console command `psiu-broker`."""
    commands.run(psiu_broker, "psiu-broker")

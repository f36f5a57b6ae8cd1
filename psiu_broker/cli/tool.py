"""`psiu`, the tool for people: asks brokers, moves robots, and makes simulated ones."""

from typing import Final, NoReturn

import click

from psiu_broker import __version__
from psiu_broker.cli.commands import Commands, examples, run

_HERE: Final = "psiu_broker.cli"


@click.group(
    cls=Commands,
    where={
        "discover": ("Ask who is there and what they can do.", f"{_HERE}.call:discover"),
        "robots": ("List the robots that are known.", f"{_HERE}.tables:robots"),
        "call": ("Tell a robot a command and wait for its answer.", f"{_HERE}.call:call"),
        "send": ("Tell a robot a command and go on.", f"{_HERE}.call:send"),
        "monitor": ("Print what robots say, as it happens.", f"{_HERE}.monitor:monitor"),
        "links": ("List the links and what they wait for.", f"{_HERE}.tables:links"),
        "routes": ("List where frames for each robot go.", f"{_HERE}.tables:routes"),
        "why": ("Tell what would become of a frame from A to B.", f"{_HERE}.paths:why"),
        "trace": ("Have B asked something harmless, and show the way.", f"{_HERE}.paths:trace"),
        "ping": ("Ask a robot something harmless, again and again.", f"{_HERE}.ping:ping"),
        "mesh": ("Show the brokers, what is between them, and who owns which robot.", f"{_HERE}.mesh:mesh"),
        "conflicts": ("List the names that more than one robot has.", f"{_HERE}.conflicts:conflicts"),
        "ledger": ("Show the fate of every frame.", f"{_HERE}.ledger:ledger"),
        "status": ("Show how the broker is.", f"{_HERE}.tables:status"),
        "decode": ("Decode bytes into frames.", f"{_HERE}.decode:decode"),
        "encode": ("Encode a frame into bytes.", f"{_HERE}.encode:encode"),
        "roboscript": ("Check, upload and play the scripts of a Robot Mitya.", f"{_HERE}.roboscript:roboscript"),
        "sim": ("Be a simulated robot.", f"{_HERE}.sim:sim"),
        "schema": ("Print the JSON schema of the messages.", f"{_HERE}.schema:schema"),
    },
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog=examples(
        "psiu discover",
        "psiu call MNERIM parafrente 100",
        "psiu monitor",
        "psiu sim --name MNERIM --pty /tmp/psiu-radio",
    ),
)
@click.version_option(__version__, package_name="psiu-broker")
def psiu() -> None:
    """Talk to robots through a running psiu-broker.

    Every command has --help with examples, and --json for programs. In a pipe, tables are plain lines with tabs.
    """


def main() -> NoReturn:
    """The console command `psiu`."""
    run(psiu, "psiu")

"""`psiu-broker keys`: keys and certificates for a laboratory's brokers and programs."""

import json
import re
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import click

from psiu_broker.cli.commands import Failure, examples, parsed

DAYS: Final = 730
_NAME: Final = re.compile(r"[A-Za-z0-9]([A-Za-z0-9_-]{0,61}[A-Za-z0-9])?")


def _name(text: str) -> str:
    if not _NAME.fullmatch(text):
        raise ValueError(f"{text!r}: expected a name of letters, digits, - and _, 63 at most")
    if text.lower() == "ca":
        raise ValueError("ca is the authority itself; choose another name")
    return text


@click.command(
    epilog=examples(
        "psiu-broker keys keys --broker base --broker hill --program operator --program screen",
        "psiu-broker keys keys --program operator --renew",
    )
)
@click.argument("folder", type=click.Path(path_type=Path, file_okay=False))
@click.option("--broker", "brokers", metavar="NAME", multiple=True, callback=parsed(_name), help="Make a broker's.")
@click.option("--program", "programs", metavar="NAME", multiple=True, callback=parsed(_name), help="Make a program's.")
@click.option("--days", default=DAYS, show_default=True, type=click.IntRange(1, 3650), help="How long they are good.")
@click.option("--renew", is_flag=True, help="Put new ones in the place of those that are there.")
def keys(folder: Path, brokers: tuple[str, ...], programs: tuple[str, ...], days: int, renew: bool) -> None:
    """Make keys and certificates in FOLDER: NAME.key and NAME.pem for each broker and each program.

    The first time an authority is made too: ca.pem, which everybody needs, and ca.key, which makes others. Who has
    ca.key can be anybody: keep it here, and give each only its own two files and ca.pem. What a name may do stands in
    [zenoh.access] of the brokers. To take a name its rights, remove it there; to take a lost key's, choose a new name.
    """
    names = [*brokers, *programs]
    if not names:
        raise click.UsageError("name somebody: --broker NAME or --program NAME")
    if len(set(names)) < len(names):
        raise click.UsageError("each name stands for one broker or program; one is there twice")
    try:
        authority: Any = import_module("psiu_broker.cli.authority")
    except ImportError as error:
        raise Failure(str(error)) from error
    there = [name for name in names if (folder / f"{name}.pem").exists() or (folder / f"{name}.key").exists()]
    if there and not renew:
        raise Failure(f"{folder} has {' and '.join(there)} already; --renew makes new ones in their place")
    try:
        maker = authority.Authority(folder)
        for name in names:
            maker.make(name, days, broker=name in brokers)
    except (OSError, ValueError) as error:
        raise Failure(f"{folder}: {error}") from error
    click.echo(_told(folder, brokers, programs, days, is_new=maker.is_new))


def _told(folder: Path, brokers: tuple[str, ...], programs: tuple[str, ...], days: int, *, is_new: bool) -> str:
    made = [f"{folder}/ca.pem for everybody; keep {folder}/ca.key to yourself"] if is_new else []
    made += [f"{folder}/{name}.pem and {name}.key, good for {days} days" for name in (*brokers, *programs)]
    for broker in brokers[:1]:
        made += [
            "",
            f"In the configuration of {broker}; who may only listen goes from commanders to listeners:",
            "",
            "[zenoh]",
            'listen = ["tls/0.0.0.0:7447"]',
            "[zenoh.tls]",
            f"ca = {_quoted(f'{folder}/ca.pem')}",
            f"certificate = {_quoted(f'{folder}/{broker}.pem')}",
            f"key = {_quoted(f'{folder}/{broker}.key')}",
            "[zenoh.access]",
            f"brokers = [{', '.join(map(_quoted, brokers))}]",
            f"commanders = [{', '.join(map(_quoted, programs))}]",
            "listeners = []",
        ]
    return "\n".join(made)


def _quoted(text: str) -> str:
    """`text` in TOML."""
    return json.dumps(text, ensure_ascii=False)

"""How the commands reach a broker, and how they say that it cannot be reached."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import wraps
from pathlib import Path
from typing import Any, Concatenate, Final, ParamSpec, TypeVar

import click
from pydantic import ValidationError

from psiu_broker.bus.client import Client
from psiu_broker.bus.keys import Keys
from psiu_broker.cli.commands import Failure
from psiu_broker.cli.output import print_json
from psiu_broker.config import TlsConfiguration
from psiu_broker.config.certificates import problem, warnings
from psiu_broker.errors import CallError, PsiuError

P = ParamSpec("P")
R = TypeVar("R")

NO_WAY: Final = 3
"""The exit code where there was no broker, no way to the robot, or no answer."""
NO_BROKER: Final = "no_broker"
"""What stands for `error` in JSON where not even a broker answered; the other codes are the broker's."""


class NoWay(Failure):
    """There is no broker, no way to the robot, or no answer from it."""

    exit_code = NO_WAY


@dataclass(frozen=True)
class Connection:
    """Where the brokers are, and whether the user wants JSON."""

    endpoints: tuple[str, ...]
    prefix: str
    as_json: bool
    tls: TlsConfiguration | None = None

    @contextmanager
    def client(self) -> Iterator[Client]:
        """A client for as long as the block lasts; what fails inside ends the command.

        Answers are validated inside: one that cannot be read ends it too.
        """
        try:
            with Client(self.endpoints, self.prefix, self.tls) as client:
                yield client
        except CallError as error:
            raise self.failure(error.code, str(error)) from error
        except PsiuError as error:
            raise self.failure(NO_BROKER, str(error)) from error
        except ValidationError as error:
            raise self.failure(NO_BROKER, _unreadable(error)) from error
        except ValueError as error:  # a name that no key can carry
            raise self.failure("bad_request", str(error)) from error

    def failure(self, code: str, message: str) -> Failure:
        """One line for people, and with --json an object for programs."""
        if self.as_json:
            print_json({"error": code, "message": message})
        return NoWay(message)

    def nobody(self) -> Failure:
        places = " or ".join(self.endpoints)
        if self.tls is not None:
            name = Path(self.tls.certificate).stem
            return self.failure(NO_BROKER, f"no broker at {places} lets {name} know; see its [zenoh.access]")
        return self.failure(NO_BROKER, f"there is no broker at {places}")


def _unreadable(error: ValidationError) -> str:
    first = error.errors(include_url=False)[0]
    place = ".".join(map(str, (error.title, *first["loc"])))
    said = f"the broker's answer cannot be read ({place}: {first['msg'][:1].lower()}{first['msg'][1:]})"
    return f"{said}; is it of another version than this psiu?"


def connects(command: Callable[Concatenate[Connection, P], R]) -> Callable[..., R]:
    """Give a command --connect, --keys, --prefix and --json, and a `Connection` as its first argument."""

    @click.option(
        "--connect",
        metavar="ENDPOINT",
        multiple=True,
        envvar="PSIU_CONNECT",
        help="Where the broker listens; repeat it, or separate by commas, and the first that answers is used."
        "  [environment: PSIU_CONNECT; default: tcp/127.0.0.1:7447, with keys tls/127.0.0.1:7447]",
    )
    @click.option(
        "--keys",
        metavar="FOLDER/NAME",
        envvar="PSIU_KEYS",
        help="Who to be: NAME.pem and NAME.key, as psiu-broker keys makes them, beside ca.pem."
        "  [environment: PSIU_KEYS]",
    )
    @click.option("--prefix", default="psiu", show_default=True, help="The first part of every key.", callback=_prefix)
    @click.option("--json", "as_json", is_flag=True, help="Print JSON, for programs.")
    @wraps(command)
    def connected(
        *args: Any, connect: tuple[str, ...], keys: str | None, prefix: str, as_json: bool, **kwargs: Any
    ) -> R:
        tls = _tls(keys) if keys else None
        default = "tcp/127.0.0.1:7447" if tls is None else "tls/127.0.0.1:7447"
        endpoints = tuple(each for text in connect or (default,) for each in re.split(r"[,\s]+", text) if each)
        if not endpoints:
            raise click.UsageError(f"--connect needs an endpoint, such as {default}")
        for endpoint in endpoints:
            if endpoint.startswith("tls/") and tls is None:
                raise click.UsageError(f"{endpoint} wants to see a certificate: --keys FOLDER/NAME")
            if not endpoint.startswith("tls/") and tls is not None:
                raise click.UsageError(f"{endpoint} sees no certificate: write tls/HOST:PORT, or leave --keys out")
        return command(Connection(endpoints, prefix, as_json, tls), *args, **kwargs)

    return connected


def _tls(keys: str) -> TlsConfiguration:
    """The files of ``FOLDER/NAME``; raises UsageError where something is wrong with them."""
    path = Path(keys)
    folder = path.parent
    tls = TlsConfiguration(ca=str(folder / "ca.pem"), certificate=f"{path}.pem", key=f"{path}.key")
    if (found := problem(tls, serves=False)) is not None:
        raise click.UsageError(f"--keys {keys}: {found[1]}")
    for _, text in warnings(tls, datetime.now(UTC), serves=False):
        click.echo(f"warning: {text}", err=True)
    return tls


def _prefix(ctx: click.Context, param: click.Parameter, prefix: str) -> str:
    try:
        return Keys(prefix).prefix
    except ValueError as error:
        raise click.BadParameter(str(error)) from error

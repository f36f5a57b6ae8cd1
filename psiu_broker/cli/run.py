"""`psiu-broker run`: the daemon."""

import asyncio
import logging
import os
import signal
import sys
from pathlib import Path
from typing import Final

import click

from psiu_broker import __version__
from psiu_broker.broker import Broker
from psiu_broker.cli.commands import INTERRUPTED, Failure, examples
from psiu_broker.cli.configuration import read
from psiu_broker.cli.logs import log_to_stderr
from psiu_broker.config import Configuration
from psiu_broker.errors import BusError
from psiu_broker.service import Notifier

STATUS_EVERY_S: Final = 2.0

log = logging.getLogger(__name__)


@click.command(
    epilog=examples(
        "psiu-broker run --config psiu-broker.toml",
        "psiu-broker run --config psiu-broker.toml -v",
        "psiu-broker check psiu-broker.toml && psiu-broker run --config psiu-broker.toml",
    )
)
@click.option(
    "--config",
    "file",
    metavar="FILE",
    type=click.Path(path_type=Path),
    required=True,
    help="The configuration; psiu-broker schema tells what may be in it.",
)
@click.option("-v", "--verbose", is_flag=True, help="Log what is only of use when something is wrong, too.")
@click.option("-q", "--quiet", is_flag=True, help="Log warnings and errors only.")
def run(file: Path, verbose: bool, quiet: bool) -> None:
    """Be the broker, until SIGTERM or Ctrl-C; a second one ends it at once.

    Logs to stderr, one line a record. The exit code is 0 after a clean end, 78 if the configuration is wrong, 1 if
    the broker cannot start: its port is in use.
    """
    if verbose and quiet:
        raise click.UsageError("-v or -q, not both")
    log_to_stderr(logging.DEBUG if verbose else logging.WARNING if quiet else logging.INFO)
    configuration = read(file)
    for warning in configuration.warnings:
        log.warning("%s", warning)
    try:
        asyncio.run(_serve(configuration))
    except BusError as error:
        raise Failure(str(error)) from error
    # All is closed. A thread that still waits for a driver, and then meets an object of Zenoh while the interpreter
    # goes, would have the process aborted.
    logging.shutdown()
    os._exit(0)


async def _serve(configuration: Configuration) -> None:
    """Raises BusError."""
    stopping = asyncio.Event()

    def stop() -> None:
        if stopping.is_set():
            sys.stderr.flush()
            os._exit(INTERRUPTED)
        stopping.set()

    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stop)
    notifier = Notifier()
    broker = Broker(configuration)
    log.info("psiu-broker %s: %s starts", __version__, configuration.broker.name)
    await broker.start()
    try:
        notifier.ready(_status(broker))
        log.info("%s is ready: programs connect to %s", configuration.broker.name, " ".join(configuration.zenoh.listen))
        tasks = [
            asyncio.create_task(notifier.feed(broker.healthy), name="watchdog"),
            asyncio.create_task(_tell_status(notifier, broker), name="status"),
        ]
        for task in tasks:
            task.add_done_callback(_ended)
        await stopping.wait()
        log.info("%s stops", configuration.broker.name)
        notifier.stopping()
        for task in tasks:
            task.cancel()
    finally:
        await broker.stop()
    log.info("%s has stopped", configuration.broker.name)


async def _tell_status(notifier: Notifier, broker: Broker) -> None:
    """Keep what ``systemctl status`` shows in step."""
    told = _status(broker)
    while True:
        await asyncio.sleep(STATUS_EVERY_S)
        status = _status(broker)
        if status != told:
            notifier.status(status)
            told = status


def _status(broker: Broker) -> str:
    status = broker.status()
    return f"{status.links_open} of {status.links} links open, {status.robots} robots known"


def _ended(task: asyncio.Task[None]) -> None:
    # Whoever feeds the watchdog no more will be ended by it; the journal should say why.
    if not task.cancelled() and (error := task.exception()) is not None:
        log.error("the task %s failed: %r", task.get_name(), error)

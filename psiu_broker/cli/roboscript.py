"""`psiu roboscript`: scripts of a Robot Mitya as files, checked, uploaded, played and read back."""

import re
import sys
from collections.abc import Callable, Sequence
from queue import SimpleQueue
from threading import Thread
from types import TracebackType
from typing import Any, BinaryIO, Final, Self

import click
from pydantic_core import from_json

from psiu_broker.bus.client import Client
from psiu_broker.bus.keys import robot_chunk
from psiu_broker.cli.call import FALHA
from psiu_broker.cli.commands import Commands, Failure, examples
from psiu_broker.cli.connection import Connection, connects
from psiu_broker.cli.output import milliseconds, print_json, print_rows, printable, styled
from psiu_broker.codecs.mitya import MESSAGE_BYTES, SCRIPT
from psiu_broker.errors import CallError
from psiu_broker.frame import Address
from psiu_broker.messages import Answer, CallRequest
from psiu_broker.profiles.roboscript import ABORT, SLOTS, UPLOAD, Problem, decompiled, problem_lines, read, vocabulary
from psiu_broker.profiles.roboscript.script import TEXT_MAX

_HERE: Final = "psiu_broker.cli.roboscript"
_CAPTURE_MAX: Final = 1_000_000
_LINE: Final = re.compile(r"line (\d+): (.*)", re.DOTALL)
_ABORTED_S: Final = 5.0
_SHOWN_EVERY: Final = 10


@click.group(
    cls=Commands,
    where={
        "check": ("Check a script without a robot.", f"{_HERE}:check"),
        "upload": ("Record a script in a slot of a robot.", f"{_HERE}:upload"),
        "play": ("Have a robot play a slot.", f"{_HERE}:play"),
        "abort": ("End a recording that was left open.", f"{_HERE}:abort"),
        "decompile": ("Make a script of a captured upload.", f"{_HERE}:decompile"),
    },
    epilog=examples(
        "psiu roboscript check dance.txt",
        "psiu roboscript upload MITYA 3 dance.txt",
        "psiu roboscript play MITYA 3",
    ),
)
def roboscript() -> None:
    """Check, upload and play the scripts of a Robot Mitya of 2012 or 2013.

    A script is a text file with one action a line: its name or its letter, and a value. wait is the time until the
    next action in milliseconds. What follows # or ; is for people.

    \b
      # a short dance
      drive 100
      wait 500
      drive 0
      mood happy

    Actions: drive, left, right, stop, head-horizontal, head-vertical, tail, mood, headlights, wag, nod, shake, fire;
    since 2013 turn-horizontal, turn-vertical and battery, too. psiu robots --json tells what each of them takes.

    A body holds 10 scripts, in the slots 0 to 9, until it is switched off: about 130 actions together, the waits of
    one script less than 65.5 seconds.
    """


_version = click.option(
    "--version",
    type=click.Choice(["2012", "2013", "2014"]),
    default="2012",
    show_default=True,
    help="The letters of which Robot Mitya; as in its link's configuration.",
)
_json = click.option("--json", "as_json", is_flag=True, help="Print JSON, for programs.")
_script = click.argument("file", type=click.File("rb"))
_slot = click.argument("slot", type=click.IntRange(0, SLOTS - 1))


class Wrong(Failure):
    """A script, or what became of it, with lines such as ``dance.txt:7: …`` that editors can read."""

    exit_code = FALHA

    def __init__(self, lines: Sequence[str]) -> None:
        super().__init__("\n".join(lines))
        self._lines = lines

    def show(self, file: Any = None) -> None:
        for line in self._lines:
            click.echo(line, file=file, err=file is None)


@click.command(
    epilog=examples(
        "psiu roboscript check dance.txt",
        "psiu roboscript check --version 2013 dance.txt && psiu roboscript upload MITYA 3 dance.txt",
        "echo 'drive 100' | psiu roboscript check -",
    )
)
@_script
@_version
@_json
def check(file: BinaryIO, version: Any, as_json: bool) -> None:
    """Check the script in FILE (- is standard input), without a robot.

    Every mistake is told as FILE:LINE: what is wrong; what is right: what to do. The exit code is 0 without any, else
    1.
    """
    script = read(_text(file), vocabulary(version))
    if as_json:
        print_json(
            {
                "file": _name(file),
                "version": version,
                "actions": len(script.actions),
                "total_ms": script.total_ms,
                "problems": _as_json(script.problems),
            }
        )
        if script.problems:
            click.get_current_context().exit(FALHA)
    elif script.problems:
        raise Wrong(problem_lines(script.problems, _name(file)))
    else:
        click.echo(f"{_name(file)}: {len(script.actions)} actions, {script.total_ms / 1000:g} s, for {version}")


@click.command(
    epilog=examples("psiu roboscript upload MITYA 3 dance.txt", "psiu roboscript upload MITYA 0 - < dance.txt")
)
@click.argument("robot")
@_slot
@_script
@connects
def upload(connection: Connection, robot: str, slot: int, file: BinaryIO) -> None:
    """Record the script in FILE in a SLOT, 0 to 9, of ROBOT, whose older script is lost.

    The script is checked first, for the version and the commands that the robot has. It takes a second for ten
    actions. Meanwhile the robot hears nothing else, from nobody; only a stop ends the recording and stops it. So does
    Ctrl-C here. Whatever goes wrong, the robot is left with its motors off, not recording, and without half a script.
    If this command is killed, the broker goes on to the end.

    What the robot objects to is told with the line that it is about. The exit code is 0 once it has recorded, 1 if
    the script is wrong or the robot objects, 3 if there was no way to the robot or no answer. With --json: an answer
    (psiu schema Answer), or a refusal (psiu schema Refusal). In a pipe, lines with the messages sent and all of them.
    """
    text, name = _text(file), _name(file)
    # What is wrong with the whole is so in any version; all else is for the broker to know.
    whole = [problem for problem in read(text, vocabulary("2012")).problems if not problem.line]
    if whole:
        raise _wrong(connection, [problem.text for problem in whole], name)
    with connection.client() as client:
        shown = Progress(robot, quiet=connection.as_json)
        try:
            with client.listening(f"{client.keys.prefix}/*/{robot_chunk(Address.parse(robot))}/**", shown.take), shown:
                answer = client.call(robot, UPLOAD, CallRequest(parameters=[slot, text]))
        except KeyboardInterrupt:
            _end(client, robot)
            raise
        except CallError as error:
            raise _failure(connection, error, name) from None
    if connection.as_json:
        print_json(answer.model_dump(mode="json"))
        if answer.status == "falha":
            click.get_current_context().exit(FALHA)
    elif answer.status == "falha":
        raise Wrong([_with_file(answer.remark or "the robot objects", name)])
    else:
        said = "recorded" if answer.status == "sucesso" else answer.remark or "sent"
        head = f"{printable(robot)}: {styled(f'slot {slot} {said}', fg='green', bold=True)}"
        click.echo(f"{head} ({milliseconds(answer.elapsed_ms)})")


@click.command(epilog=examples("psiu roboscript play MITYA 3", "psiu roboscript play MITYA 3 --json"))
@click.argument("robot")
@_slot
@connects
def play(connection: Connection, robot: str, slot: int) -> None:
    """Have ROBOT play the script in a SLOT, 0 to 9.

    It begins at once and is not waited for; an empty slot plays nothing. The exit code is that of psiu call.
    """
    _tell(connection, robot, lambda client: client.call(robot, "play", CallRequest(parameters=[slot])))


@click.command(epilog=examples("psiu roboscript abort MITYA"))
@click.argument("robot")
@connects
def abort(connection: Connection, robot: str) -> None:
    """End whatever ROBOT records: an upload under way, or a recording that somebody left open.

    What it was recording is lost, and its motors stop. It does no harm to a robot that does not record. The exit code
    is that of psiu call.
    """
    _tell(connection, robot, lambda client: client.call(robot, ABORT))


@click.command(
    epilog=examples(
        "echo r0103Z0002D0064W01F4D0000W0000Z0000 | psiu roboscript decompile",
        "psiu roboscript decompile upload.hex > dance.txt",
        "psiu roboscript decompile --version 2013 capture.bin",
    )
)
@click.argument("file", type=click.File("rb"), default="-")
@_version
@_json
def decompile(file: BinaryIO, version: Any, as_json: bool) -> None:
    """Make a script of a captured upload: FILE, or standard input.

    The capture is what was sent to the robot, as it was or in hexadecimal. What is wrong with it is told on stderr;
    then the exit code is 1.
    """
    text, problems = decompiled(file.read(_CAPTURE_MAX), vocabulary(version))
    if as_json:
        print_json({"script": text, "problems": list(problems)})
    else:
        click.echo(text, nl=False)
    if problems and not as_json:
        raise Wrong([f"{_name(file)}: {problem}" for problem in problems])
    if problems:
        click.get_current_context().exit(FALHA)


class Progress:
    """How much of an upload has left, told as it leaves: `take` is handed what is said to the robot, on any thread.

    At a terminal one line that changes, on stderr; in a pipe a line for every tenth message.
    """

    def __init__(self, robot: str, *, quiet: bool) -> None:
        self._robot = printable(robot)
        self._terminal = sys.stderr.isatty()
        self._quiet = quiet
        self._said: SimpleQueue[bytes | None] = SimpleQueue()
        self._thread = Thread(target=self._show, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._said.put(None)
        self._thread.join()
        if self._terminal and not self._quiet:
            click.echo("\r\x1b[K", nl=False, err=True)

    def take(self, payload: bytes) -> None:
        self._said.put(payload)

    def _show(self) -> None:
        sent, total = 0, 0
        while (payload := self._said.get()) is not None:
            wire = _recorded(payload)
            if wire is None:
                continue
            if wire.startswith(b"r01"):
                sent, total = 0, 0
            if not total and wire.startswith(b"Z"):
                total, sent = 2 * int(wire[1:], 16) + 3, 1
            sent += 1
            if not self._quiet and total and sent <= total:
                self._tell(sent, total)

    def _tell(self, sent: int, total: int) -> None:
        if self._terminal:
            line = f"\r{self._robot}: {sent} of {total} messages\x1b[K"
            click.echo(line, nl=False, err=True)
        elif sent % _SHOWN_EVERY == 0:
            print_rows([(sent, total)])
            sys.stdout.flush()


def _recorded(payload: bytes) -> bytes | None:
    """The bytes of a message that is part of an upload; None for any other, and whatever else may be on the bus."""
    try:
        message = from_json(payload)
        command, wire = message["command"], bytes.fromhex(message["wire"])
    except (ValueError, TypeError, LookupError):
        return None
    is_part = isinstance(command, str) and (command.startswith(SCRIPT) or command == "record")
    return wire if is_part and len(wire) == MESSAGE_BYTES else None


def _tell(connection: Connection, robot: str, call: Callable[[Client], Answer]) -> None:
    with connection.client() as client:
        answer = call(client)
    if connection.as_json:
        print_json(answer.model_dump(mode="json"))
    else:
        colour = {"sucesso": "green", "falha": "red"}.get(answer.status or "")
        said = styled(printable(answer.remark or answer.status or "answered"), fg=colour, bold=True)
        click.echo(f"{printable(robot)}: {said} ({milliseconds(answer.elapsed_ms)})")
    if answer.status == "falha":
        click.get_current_context().exit(FALHA)


def _end(client: Client, robot: str) -> None:
    """Ctrl-C: the recording is ended before we go."""
    try:
        client.call(robot, ABORT, CallRequest(timeout_s=_ABORTED_S))
        click.echo(
            f"{printable(robot)}: the recording was ended; upload the script again before it is played", err=True
        )
    except CallError as error:
        click.echo(f"{printable(robot)}: {error}", err=True)


def _failure(connection: Connection, error: CallError, file: str) -> Failure:
    """What became of an upload; the mistakes of the script, where it is these."""
    lines = str(error).split("\n")
    if error.code == "refused" and _LINE.fullmatch(lines[0]):
        return _wrong(connection, lines, file)
    return connection.failure(error.code, _with_file(str(error), file) if _LINE.fullmatch(str(error)) else str(error))


def _wrong(connection: Connection, lines: Sequence[str], file: str) -> Failure:
    """The mistakes of a script, which was not sent."""
    if connection.as_json:
        print_json({"error": "refused", "message": "\n".join(lines)})
    return Wrong([_with_file(line, file) for line in lines])


def _with_file(text: str, file: str) -> str:
    """``line 7: …`` as ``dance.txt:7: …``; anything else as a fault of the whole."""
    match = _LINE.fullmatch(text)
    return printable(f"{file}:{match[1]}: {match[2]}" if match else f"{file}: {text}")


def _text(file: BinaryIO) -> str:
    return file.read(2 * TEXT_MAX).decode("utf-8", "replace")


def _name(file: BinaryIO) -> str:
    name = str(getattr(file, "name", "-"))
    return printable("standard input" if name in ("<stdin>", "-") else name)


def _as_json(problems: Sequence[Problem]) -> list[dict[str, Any]]:
    return [{"line": problem.line, "text": problem.text} for problem in problems]

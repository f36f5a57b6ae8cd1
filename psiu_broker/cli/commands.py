"""What both commands share: subcommands imported on demand, examples in their help, and one line for what failed."""

import io
import os
import re
import sys
from collections.abc import Callable, Mapping
from difflib import get_close_matches
from importlib import import_module
from typing import Any, Final, NoReturn, TypeVar

import click

T = TypeVar("T")

INTERRUPTED: Final = 130
_NEGATIVE: Final = re.compile(r"-(\d+\.?\d*|\.\d+)")
_MARK: Final = "\0"


class Commands(click.Group):
    """A group whose commands are imported when they are asked for, so that its own help is there at once.

    `where` says for each command what it does, in a line, and where it is: ``module:name``.
    """

    def __init__(self, *args: Any, where: Mapping[str, tuple[str, str]], **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._where = where

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self._where)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in self._where:
            near = get_close_matches(cmd_name, self._where, n=1)
            ctx.fail(f"there is no command {cmd_name!r}; " + (f"did you mean {near[0]}?" if near else "see --help"))
        module, _, name = self._where[cmd_name][1].partition(":")
        command: click.Command = getattr(import_module(module), name)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, summary) for name, (summary, _) in self._where.items()])


class WordsCommand(click.Command):
    """A command whose arguments may be negative numbers: ``psiu call BRACO garra -45``."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        options = [param for param in self.params if isinstance(param, click.Option)]
        takes_value = {name for option in options if not option.is_flag for name in option.opts}
        marked = [
            _MARK + word if _NEGATIVE.fullmatch(word) and before not in takes_value else word
            for before, word in zip(["", *args], args, strict=False)
        ]
        rest = super().parse_args(ctx, marked)
        for name, value in ctx.params.items():
            if isinstance(value, str):
                ctx.params[name] = value.removeprefix(_MARK)
            elif isinstance(value, tuple):
                ctx.params[name] = tuple(each.removeprefix(_MARK) for each in value)
        return rest


class Failure(click.ClickException):
    """Ends the command with one line on stderr, which begins with the command's name, and `exit_code`."""

    exit_code = 1

    def __init__(self, message: str) -> None:
        super().__init__(message)
        context = click.get_current_context(silent=True)
        self._name = (context.find_root().info_name if context else None) or "psiu"

    def show(self, file: Any = None) -> None:
        click.echo(f"{self._name}: {' '.join(self.message.split())}", file=file, err=file is None)


def parsed(parse: Callable[[str], T]) -> Callable[[click.Context, click.Parameter, Any], Any]:
    """A callback for an option whose text `parse` reads; its ValueError is what the user is told."""

    def callback(ctx: click.Context, param: click.Parameter, value: str | tuple[str, ...] | None) -> Any:
        try:
            if isinstance(value, tuple):
                return tuple(parse(each) for each in value)
            return None if value is None else parse(value)
        except ValueError as error:
            raise click.BadParameter(str(error)) from error

    return callback


def number(text: str) -> int:
    """An int as TOML writes one: ``18`` or ``0x12``.

    Raises:
        ValueError: `text` is none.
    """
    try:
        return int(text, 0)
    except ValueError:
        raise ValueError(f"{text!r} is not a number such as 18 or 0x12") from None


def examples(*lines: str) -> str:
    """The end of a command's help."""
    return "\n".join(("\b", "Examples:", *(f"  {line}" for line in lines)))


def run(group: click.Group, name: str) -> NoReturn:
    """Run the command line; ends the process."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        result = group.main(prog_name=name, standalone_mode=False)
        code = result if isinstance(result, int) else 0
        sys.stdout.flush()
    except click.ClickException as error:
        error.show()
        code = error.exit_code
    except (click.Abort, KeyboardInterrupt):
        code = INTERRUPTED
    except BrokenPipeError:
        code = 0
    closed_pipe_is_fine()
    sys.exit(code)


def closed_pipe_is_fine() -> None:
    """Let the interpreter end without a complaint that nobody reads stdout any more."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())

"""What a new user sees first."""

import subprocess
import sys
from collections.abc import Callable

import pytest
from click.testing import Result

from psiu_broker import __version__
from psiu_broker.cli.daemon import psiu_broker
from psiu_broker.cli.tool import psiu

Run = Callable[..., Result]

ON_THE_BUS = (
    "discover",
    "robots",
    "call",
    "send",
    "monitor",
    "links",
    "routes",
    "why",
    "trace",
    "mesh",
    "conflicts",
    "ledger",
    "ping",
    "status",
)
ALONE = ("decode", "encode", "sim", "schema")
GROUPS = ("roboscript",)


@pytest.mark.parametrize("command", [*ON_THE_BUS, *ALONE])
def test_the_help_of_every_tool_command_has_examples_and_offers_json(tool: Run, command: str) -> None:
    shown = tool(command, "--help")
    assert shown.exit_code == 0
    assert f"Examples:\n    psiu {command}" in shown.output
    assert "--json" in shown.output
    assert ("--connect" in shown.output) == (command in ON_THE_BUS)


@pytest.mark.parametrize("command", ["check", "upload", "play", "abort", "decompile"])
def test_the_help_of_every_roboscript_command_has_examples_and_offers_json(tool: Run, command: str) -> None:
    assert command in tool("roboscript", "--help").output
    shown = tool("roboscript", command, "--help")
    assert shown.exit_code == 0
    assert "Examples:" in shown.output
    assert f"psiu roboscript {command}" in shown.output
    assert "--json" in shown.output


@pytest.mark.parametrize("command", ["run", "check", "schema", "keys", "demo"])
def test_the_help_of_every_daemon_command_has_examples(daemon: Run, command: str) -> None:
    shown = daemon(command, "--help")
    assert shown.exit_code == 0
    assert f"Examples:\n    psiu-broker {command}" in shown.output


def test_every_command_is_tested_here() -> None:
    assert set(psiu.list_commands(None)) == {*ON_THE_BUS, *ALONE, *GROUPS}  # type: ignore[arg-type]
    assert set(psiu_broker.list_commands(None)) == {"run", "check", "schema", "keys", "demo"}  # type: ignore[arg-type]


@pytest.mark.parametrize("module", ["tool", "daemon"])
def test_the_first_help_waits_for_no_heavy_library(module: str) -> None:
    group = {"tool": "psiu", "daemon": "psiu_broker"}[module]
    program = (
        f"import sys; from psiu_broker.cli.{module} import {group}\n"
        f"{group}.main(['--help'], standalone_mode=False)\n"
        "print(sorted({'zenoh', 'pydantic', 'rich', 'asyncio'} & set(sys.modules)))"
    )
    shown = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert shown.stdout.rstrip().endswith("[]"), shown.stdout


def test_an_unknown_command_is_refused_with_the_one_that_was_probably_meant(tool: Run) -> None:
    refused = tool("robot")
    assert refused.exit_code == 2
    assert "did you mean robots?" in refused.output
    assert "see --help" in tool("xyzzy").output


def test_both_tell_their_version(tool: Run, daemon: Run) -> None:
    assert __version__ in tool("--version").output
    assert __version__ in daemon("--version").output

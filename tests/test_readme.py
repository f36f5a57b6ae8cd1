"""The READMEs say what is true: every example loads or runs, every option, command, code and file exists."""

import json
import re
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import click
import pytest
from pydantic import BaseModel, TypeAdapter
from secure_keys import make_keys

from psiu_broker.cli import daemon, tool
from psiu_broker.config import (
    AccessConfiguration,
    BrokerConfiguration,
    LinkOptions,
    MeshConfiguration,
    TlsConfiguration,
    ZenohConfiguration,
    load,
)
from psiu_broker.config.tables import FailsafeConfiguration, PolicyRule, RobotTable
from psiu_broker.errors import CallCode
from psiu_broker.messages import Answer, Decoded, Refusal
from psiu_broker.protocols import PROTOCOLS
from psiu_broker.registry import adapter_class, adapter_names

TREE = Path(__file__).parents[1]
ENGLISH = (TREE / "README.md").read_text()
PORTUGUESE = (TREE / "README.pt-BR.md").read_text()
READMES = pytest.mark.parametrize("readme", [ENGLISH, PORTUGUESE], ids=["en", "pt-BR"])
GROUPS: dict[str, click.Group] = {"psiu": tool.psiu, "psiu-broker": daemon.psiu_broker}

MANY_BROKERS = re.compile(r"^## (?:Many|Muitos) brokers\n.*?(?=^## )", re.MULTILINE | re.DOTALL)
PROTOCOLS_TOLD = re.compile(r"^## (?:Protocols|Protocolos)\n.*?(?=^## )", re.MULTILINE | re.DOTALL)
FAILSAFE_TOLD = re.compile(
    r"^## (?:When nobody is left|Quando não sobra ninguém)\n.*?(?=^## )", re.MULTILINE | re.DOTALL
)
RIGHTS_TOLD = re.compile(r"^## (?:Who may do what|Quem pode o quê)\n.*?(?=^## )", re.MULTILINE | re.DOTALL)
POLICY_TOLD = re.compile(r"^## (?:Who commands whom|Quem comanda quem)\n.*?(?=^## )", re.MULTILINE | re.DOTALL)
FENCED = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
MODELS: dict[str, type[BaseModel]] = {
    "[broker]": BrokerConfiguration,
    "[zenoh]": ZenohConfiguration,
    "[zenoh.tls]": TlsConfiguration,
    "[zenoh.access]": AccessConfiguration,
    "[mesh]": MeshConfiguration,
    "[[policy]]": PolicyRule,
    "[links.NAME]": LinkOptions,
    "[robots.NAME]": RobotTable,
    "[robots.NAME.failsafe]": FailsafeConfiguration,
    **{f'adapter = "{name}"': adapter_class(name) for name in ("serial", "udp", "rfcomm", "pty")},
}


def blocks(readme: str, language: str) -> list[str]:
    return [text for name, text in FENCED.findall(readme) if name == language]


def prose(readme: str) -> str:
    return FENCED.sub("", re.sub(r"<!--.*?-->", "", readme, flags=re.DOTALL))


def code(text: str) -> list[str]:
    """What stands in single backticks."""
    return re.findall(r"`([^`\n]+)`", text)


def rows(readme: str) -> Iterator[tuple[str, list[str]]]:
    """Each table row with the bold name above its table; "" without one."""
    title = ""
    for line in prose(readme).splitlines():
        if line.startswith("**`"):
            title = code(line)[0]
        elif line.startswith("#"):
            title = ""
        elif line.startswith("|") and not line.startswith("| ---"):
            yield title, [cell.strip() for cell in line.strip("|").split(" | ")]


def command_lines(readme: str) -> set[str]:
    written = [line for block in blocks(readme, "sh") for line in block.splitlines()] + code(prose(readme))
    found = set()
    for line in written:
        program, _, rest = line.strip().rpartition("bin/")[2].partition(" ")
        if program in GROUPS and rest:
            found.add(f"{program} {rest}")
    return found


def headings(readme: str) -> list[int]:
    return [len(marks) for marks in re.findall(r"^(#+) ", FENCED.sub("", readme), re.MULTILINE)]


def test_both_languages_have_the_same_sections_examples_and_tables() -> None:
    assert headings(ENGLISH) == headings(PORTUGUESE)
    assert FENCED.findall(ENGLISH) == FENCED.findall(PORTUGUESE)
    assert [(title, row[0]) for title, row in rows(ENGLISH) if row[0].startswith("`")] == [
        (title, row[0]) for title, row in rows(PORTUGUESE) if row[0].startswith("`")
    ]
    assert [len(row) for _, row in rows(ENGLISH)] == [len(row) for _, row in rows(PORTUGUESE)]


@READMES
def test_ten_minutes_of_reading(readme: str) -> None:
    [many], [protocols] = MANY_BROKERS.findall(readme), PROTOCOLS_TOLD.findall(readme)
    [rights], [failsafe] = RIGHTS_TOLD.findall(readme), FAILSAFE_TOLD.findall(readme)
    [policy] = POLICY_TOLD.findall(readme)
    apart = sum(map(_words, (many, protocols, rights, policy, failsafe)))
    assert _words(readme) - apart <= 2300
    assert _words(failsafe) <= 170
    assert _words(rights) <= 200
    assert _words(policy) <= 260
    assert _words(many) <= 650
    assert _words(protocols) <= 600


def _words(text: str) -> int:
    return sum(bool(re.search(r"\w", word)) for word in prose(text).split())


@READMES
def test_the_configurations_load(readme: str, tmp_path: Path) -> None:
    files = [block for block in blocks(readme, "toml") if "[broker]" in block]
    assert len(files) == 2
    for text in files:
        file = tmp_path / "broker.toml"
        file.write_text(text)
        configuration = load(file)
        assert configuration.broker.name == "base"
    assert set(configuration.links) == {"radio", "wifi", "arm"}
    assert configuration.robots["BRACO"].options.nodes["garra"].type == "servo"


@READMES
def test_the_rules_load(readme: str, tmp_path: Path) -> None:
    [whole] = [block for block in blocks(readme, "toml") if "[links.wifi]" in block]
    [rules] = [block for block in blocks(readme, "toml") if block.startswith("[[policy]]")]
    file = tmp_path / "broker.toml"
    file.write_text(whole + rules)
    assert [rule.action for rule in load(file).policy] == ["allow", "deny"]


@READMES
def test_the_tables_for_many_brokers_load(readme: str, tmp_path: Path) -> None:
    tables = [block for block in blocks(readme, "toml") if re.match(r"\[(?:zenoh|mesh|trunks)\b", block)]
    make_keys(tmp_path / "keys", ["base"], [])
    file = tmp_path / "broker.toml"
    file.write_text("\n".join(['[broker]\nname = "base"', *tables]))
    configuration = load(file)
    assert configuration.mesh.connect
    assert configuration.zenoh.access is not None
    assert set(configuration.trunks) == {"base"}
    assert "**`[trunks.NAME]`**" in readme


@READMES
def test_the_programs_are_those_that_are_tested(readme: str) -> None:
    examples = [TREE / "tests/examples" / name for name in ("plain_zenoh.py", "unix_adapter.py")]
    assert blocks(readme, "python") == [example.read_text() for example in examples]


@READMES
def test_every_option_is_told_with_its_default(readme: str) -> None:
    told: dict[str, dict[str, str]] = {}
    for title, row in rows(readme):
        if title in MODELS and "`" in row[0]:
            for name in code(row[0]):
                told.setdefault(title, {})[name] = row[1]
    assert set(told) == set(MODELS)
    for title, options in told.items():
        fields = MODELS[title].model_fields
        assert set(options) == set(fields), title
        for name, default in options.items():
            assert _reads(default) == _default(fields[name]), f"{title} {name}"


def _reads(cell: str) -> object:
    """A default as the table shows it: TOML in backticks, – for none, a word for one that must be given."""
    if cell == "–":
        return None
    match = re.fullmatch(r"`(.*)`", cell)
    return tomllib.loads(f"x = {match[1]}")["x"] if match else "required"


def _default(field: Any) -> object:
    if field.is_required():
        return "required"
    return TypeAdapter(Any).dump_python(field.default, mode="json")


@READMES
def test_every_extra_that_users_may_want_is_told(readme: str) -> None:
    extras = tomllib.loads((TREE / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(extras) - {"test", "lint", "fuzz", "audit"} <= set(code(readme))


@READMES
def test_every_adapter_and_protocol_is_told(readme: str) -> None:
    ours = {name for name in adapter_names() if adapter_class(name).__module__.startswith("psiu_adapters.")}
    for name in ours:
        assert f'adapter = "{name}"' in code(readme)
    [protocols] = PROTOCOLS_TOLD.findall(readme)
    assert {code(row[0])[0] for _, row in rows(protocols) if code(row[0])} == set(PROTOCOLS)


@READMES
def test_every_example_of_a_protocol_is_linked(readme: str) -> None:
    folder = TREE / "deploy/examples/protocols"
    linked = set(re.findall(r"\((deploy/examples/protocols/\S+)\)", readme))
    assert linked == {str(file.relative_to(TREE)) for file in folder.glob("*.toml")}


@READMES
def test_the_tables_for_protocols_load(readme: str, tmp_path: Path) -> None:
    [protocols] = PROTOCOLS_TOLD.findall(readme)
    marcha, painel = blocks(protocols, "toml")
    file = tmp_path / "broker.toml"
    body = '[links.corpo]\nadapter = "serial"\ndevice = "/dev/corpo"\nprotocol = "mitya"\n'
    radio = '[links.radio]\nadapter = "serial"\ndevice = "/dev/radio"\nprotocol = "psiu-ascii"\n'
    robots = '[robots.MITYA]\nlink = "corpo"\n[robots.MNERIM]\nlink = "radio"\n'
    file.write_text("\n".join(['[broker]\nname = "base"', body, radio, painel, robots, marcha]))
    configuration = load(file)
    assert configuration.links["painel"].options.plays == "MNERIM"
    assert set(configuration.robots["MITYA"].options.commands) == {"marcha"}


@READMES
def test_the_commands_take_what_is_written(readme: str) -> None:
    for line in sorted(command_lines(readme)):
        program, *arguments = shlex.split(line)
        context = click.Context(GROUPS[program], info_name=program)
        if not arguments[0].startswith("-"):
            name, command, rest = GROUPS[program].resolve_command(context, arguments)
            assert command is not None
            if rest and "--help" not in rest:
                try:
                    command.make_context(name, rest, parent=context).close()
                except click.ClickException as error:
                    pytest.fail(f"{line}: {error.format_message()}")


@READMES
def test_every_command_is_told(readme: str) -> None:
    told = {tuple(line.split()[:2]) for line in command_lines(readme)}
    for program, group in GROUPS.items():
        for name in group.list_commands(click.Context(group)):
            assert (program, name) in told


@READMES
def test_every_reason_for_no_answer_is_told(readme: str) -> None:
    told = [code(row[0])[0] for _, row in rows(readme) if re.fullmatch(r"`[a-z_]+`", row[0]) and len(row) == 2]
    assert set(get_args(CallCode)) <= set(told)


@READMES
def test_the_messages_are_real(readme: str) -> None:
    decoded, answer, refusal = (json.loads(block) for block in blocks(readme, "json"))
    Decoded.model_validate(decoded, extra="forbid")
    Answer.model_validate(answer, extra="forbid")
    Refusal.model_validate(refusal, extra="forbid")
    assert set(decoded) == set(Decoded.model_fields)
    assert set(answer) == set(Answer.model_fields)
    assert bytes.fromhex(decoded["wire"]) == b"base 040 parafrente sucesso MNERIM 03012"


@READMES
def test_files_and_make_targets_exist(readme: str) -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", readme):
        assert (TREE / target).exists(), target
    for path in re.findall(r"^(\S+/\S+)\s{2,}", "\n".join(blocks(readme, "text")), re.MULTILINE):
        assert (TREE / path).exists(), path
    makefile = (TREE / "Makefile").read_text()
    written = [*code(readme), *blocks(readme, "sh"), *blocks(readme, "text")]
    for target in re.findall(r"make ([a-z-]+)", "\n".join(written)):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target

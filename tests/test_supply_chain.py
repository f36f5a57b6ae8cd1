"""What the code never does with what it hears, and that CI installs exactly what was looked at."""

import ast
import json
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parent.parent
LOCK = ROOT / ".ci" / "lock.txt"
SOURCES = [
    file for folder in ("psiu_broker", "adapters", "tests", ".ci", "deploy") for file in (ROOT / folder).rglob("*.py")
]
RUNS_WORDS = {"eval", "exec", "compile", "__import__"}
RUNS_BYTES = {
    "pickle", "cPickle", "cloudpickle", "dill", "marshal", "shelve", "jsonpickle", "yaml", "ruamel", "joblib", "runpy",
}  # fmt: skip
RUNS_SHELLS = {"getoutput", "getstatusoutput", "create_subprocess_shell", "subprocess_shell"}
OF_MODULES = {"os": {"system", "popen"}, "builtins": RUNS_WORDS}
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def dangers(source: str) -> Iterator[str]:
    """Whatever in `source` makes code of words or bytes."""
    tree = list(ast.walk(ast.parse(source)))
    imported = {each.asname: each.name for node in tree if isinstance(node, ast.Import) for each in node.names}
    for node in tree:
        match node:
            case ast.Name(id=name, ctx=ast.Load()) if name in RUNS_WORDS:
                yield f"line {node.lineno}: {name}"
            case ast.Import(names=names):
                modules = [each.name for each in names]
                yield from (f"line {node.lineno}: {each}" for each in modules if each.partition(".")[0] in RUNS_BYTES)
            case ast.ImportFrom(module=str(module)) if module.partition(".")[0] in RUNS_BYTES:
                yield f"line {node.lineno}: {module}"
            case ast.ImportFrom(module=str(module), names=names):
                told = RUNS_SHELLS | OF_MODULES.get(module, set())
                yield from (f"line {node.lineno}: {each.name}" for each in names if each.name in told)
            case ast.Attribute(attr=name) if name in RUNS_SHELLS:
                yield f"line {node.lineno}: {name}"
            case ast.Attribute(value=ast.Name(id=module), attr=name) if name in OF_MODULES.get(
                imported.get(module, module), set()
            ):
                yield f"line {node.lineno}: {module}.{name}"
            case ast.keyword(arg="shell", value=value) if not (isinstance(value, ast.Constant) and not value.value):
                yield f"line {value.lineno}: shell="


@pytest.mark.parametrize("file", SOURCES, ids=lambda file: str(file.relative_to(ROOT)))
def test_no_code_is_made_of_words_or_bytes(file: Path) -> None:
    assert not list(dangers(file.read_text()))


@pytest.mark.parametrize(
    "source",
    [
        "eval('1')",
        "run = exec",
        "import pickle",
        "from yaml import load",
        "import os, marshal",
        "call('x', shell=True)",
        "call('x', shell=wanted)",
        "types.FunctionType(compile('1', '', 'exec'), {})",
        "builtins.eval('1')",
        "from builtins import exec as run",
        "os.system('x')",
        "import os as harmless\nharmless.system('x')",
        "from os import popen",
        "subprocess.getoutput('x')",
        "await asyncio.create_subprocess_shell('x')",
        "import ruamel.yaml",
    ],
)
def test_what_makes_code_of_words_or_bytes_is_found(source: str) -> None:
    assert list(dangers(source))


def test_nothing_else_is_taken_for_it() -> None:
    harmless = "re.compile('x')\nplatform.system()\nrun(['x'], shell=False)\nfrom re import compile as made\n"
    assert list(dangers(harmless)) == []


def locked() -> dict[str, str]:
    """What the lock names, and which version."""
    pins = re.findall(r"^([A-Za-z0-9_.-]+)(?:\[[^]]*\])?==([^\s;\\]+)", LOCK.read_text(), re.MULTILINE)
    return {canonicalize_name(name): version for name, version in pins}


def test_the_lock_holds_a_version_that_is_asked_for_of_all_that_is_asked_for() -> None:
    build = tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"]
    extras = [each for extra in PROJECT["optional-dependencies"].values() for each in extra]
    versions = locked()
    for text in (*PROJECT["dependencies"], *extras, *build):
        asked = Requirement(text)
        name = canonicalize_name(asked.name)
        assert name in versions, f"{name} is not in {LOCK.name}: make lock"
        assert asked.specifier.contains(versions[name], prereleases=True), f"{name} {versions[name]}: make lock"


def test_each_package_of_the_lock_is_known_by_its_hash() -> None:
    logical = LOCK.read_text().replace("\\\n", " ").splitlines()
    pins = [line for line in logical if line and not line.lstrip().startswith("#")]
    assert len(pins) > 50
    assert all("==" in line and "--hash=sha256:" in line for line in pins)


def test_ci_builds_with_what_the_lock_names_and_fetches_nothing_else_for_that() -> None:
    builds = re.findall(r"^.*-m build .*$", (ROOT / ".ci/run").read_text(), re.MULTILINE)
    assert builds
    assert all("--no-isolation" in line for line in builds)


GOOD = {"name": "click", "version": "8.3.1", "vulns": []}
BAD = {"name": "pillow", "version": "1.0", "vulns": [{"id": "PYSEC-2026-1", "fix_versions": []}]}
SKIPPED = {"name": "attrs", "skip_reason": "Dependency not found on PyPI and could not be audited"}


@pytest.mark.parametrize(
    ("answer", "ended", "code", "said"),
    [
        ({"dependencies": [GOOD]}, 0, 0, ["1 of 1 packages audited, 0 vulnerabilities"]),
        (
            {"dependencies": [GOOD, BAD]}, 1, 1,
            ["2 of 2 packages audited, 1 vulnerabilities", "pillow 1.0: PYSEC-2026-1"],
        ),
        (
            {"dependencies": [SKIPPED, BAD]}, 1, 1,
            ["1 of 2 packages audited, 1 vulnerabilities", "pillow 1.0: PYSEC-2026-1", "NOT AUDITED: attrs"],
        ),
        (
            {"dependencies": [SKIPPED]}, 0, 0,
            ["0 of 1 packages audited, 0 vulnerabilities",
             "NOT AUDITED: the package index tells nothing of vulnerabilities, of no package"],
        ),
        ({}, 1, 0, ["NOT AUDITED: no answer from the package index"]),
        (None, 1, 0, ["NOT AUDITED: no answer from the package index"]),
        (None, 2, 1, []),
    ],
)  # fmt: skip
def test_an_audit_fails_by_vulnerabilities_and_says_aloud_what_was_not_audited(
    tmp_path: Path, answer: object, ended: int, code: int, said: list[str]
) -> None:
    text = "" if answer is None else json.dumps(answer)
    (tmp_path / "pip_audit.py").write_text(f"import sys\nprint({text!r})\nsys.exit({ended})\n")
    audit = subprocess.run(
        [sys.executable, ROOT / ".ci/audit.py"],
        env=os.environ | {"PYTHONPATH": str(tmp_path)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert audit.returncode == code, audit
    assert audit.stdout.split("\n")[: len(said)] == said
    assert ("NOT AUDITED" in audit.stderr) == (ended == 2)


def test_an_audit_without_its_program_fails() -> None:
    audit = subprocess.run([sys.executable, "-S", ROOT / ".ci/audit.py"], capture_output=True, text=True, check=False)
    assert (audit.returncode, audit.stderr) == (1, "NOT AUDITED: pip-audit is missing; make audit installs it\n")


def test_every_test_that_the_threat_model_appeals_to_is_there() -> None:
    named = set(re.findall(r"`(tests/[^`]*\.py)`", (ROOT / "SECURITY.md").read_text()))
    assert len(named) > 15
    assert [file for file in sorted(named) if not (ROOT / file).exists()] == []

"""What the code never does with what it hears, and that CI installs exactly what was looked at."""

import ast
import re
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
RUNS_WORDS = {"eval", "exec", "__import__"}
RUNS_BYTES = {"pickle", "cPickle", "dill", "marshal", "shelve", "jsonpickle", "yaml", "joblib"}
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def dangers(source: str) -> Iterator[str]:
    """Whatever in `source` makes code of words or bytes."""
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Name(id=name, ctx=ast.Load()) if name in RUNS_WORDS:
                yield f"line {node.lineno}: {name}"
            case ast.Import(names=names):
                modules = [each.name for each in names]
                yield from (f"line {node.lineno}: {each}" for each in modules if each.partition(".")[0] in RUNS_BYTES)
            case ast.ImportFrom(module=str(module)) if module.partition(".")[0] in RUNS_BYTES:
                yield f"line {node.lineno}: {module}"
            case ast.keyword(arg="shell", value=ast.Constant(value=True)):
                yield f"line {node.lineno}: shell=True"


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
    ],
)
def test_what_makes_code_of_words_or_bytes_is_found(source: str) -> None:
    assert list(dangers(source))


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


def test_every_test_that_the_threat_model_appeals_to_is_there() -> None:
    named = set(re.findall(r"`(tests/[^`]*\.py)`", (ROOT / "SECURITY.md").read_text()))
    assert len(named) > 15
    assert [file for file in sorted(named) if not (ROOT / file).exists()] == []

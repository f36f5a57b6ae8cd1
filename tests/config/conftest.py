"""How tests read a configuration."""

from pathlib import Path
from textwrap import dedent

import pytest

from psiu_broker.config import Configuration, load
from psiu_broker.errors import ConfigurationError


@pytest.fixture
def read(tmp_path, monkeypatch):
    """Loads text as radio.toml, which lies in the current folder."""
    monkeypatch.chdir(tmp_path)

    def read(text: str) -> Configuration:
        Path("radio.toml").write_text(dedent(text), encoding="utf-8")
        return load(Path("radio.toml"))

    return read


@pytest.fixture
def problems(read):
    """What is said about text, a line each, without the file's name that begins every line."""

    def problems(text: str) -> list[str]:
        with pytest.raises(ConfigurationError) as caught:
            read(text)
        assert all(line.startswith("radio.toml:") for line in caught.value.problems)
        return [line.removeprefix("radio.toml: ") for line in caught.value.problems]

    return problems

"""Adapters are found by entry point; what is broken in one stays with that one."""

import logging
import sys
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from psiu_broker import registry
from psiu_broker.adapter import Adapter
from psiu_broker.registry import UnknownAdapter, adapter_class, adapter_names


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A directory on the import path, as a third party's package installed there would be."""
    monkeypatch.syspath_prepend(tmp_path)
    registry._found.cache_clear()
    yield tmp_path
    registry._found.cache_clear()
    for module in tmp_path.glob("*.py"):
        sys.modules.pop(module.stem, None)


def install(where: Path, name: str, value: str, source: str = "") -> None:
    """Put a distribution with one adapter below `where`, in a module of its own."""
    (where / f"{value.partition(':')[0]}.py").write_text(source)
    metadata = where / f"{value.partition(':')[0]}-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {metadata.name[:-14]}\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(f"[{registry.GROUP}]\n{name} = {value}\n")


def test_our_own_adapters_are_found_like_anyone_elses() -> None:
    assert set(adapter_names()) >= {"serial", "rfcomm", "udp"}
    for name in ("serial", "udp"):
        assert issubclass(adapter_class(name), Adapter)
    assert adapter_class("udp").datagrams is True


def test_an_adapter_of_another_package_is_found_by_its_entry_point(installed: Path) -> None:
    install(
        installed,
        "carrier-pigeon",
        "pigeon_adapter:Pigeon",
        "from psiu_broker.adapter import Adapter\nclass Pigeon(Adapter):\n    loft: str\n",
    )
    assert "carrier-pigeon" in adapter_names()
    assert set(adapter_class("carrier-pigeon").model_fields) == {"loft"}


@pytest.mark.parametrize(
    "source",
    ["import a_module_that_nobody_has", "raise RuntimeError('boom\\nmore')", "1 /", "", "import sys; sys.exit(3)"],
)
def test_a_broken_adapter_breaks_no_other(installed: Path, source: str) -> None:
    install(installed, "broken", "broken_adapter:Broken", source)
    assert {"broken", "udp"} <= set(adapter_names())
    with pytest.raises(
        UnknownAdapter, match=r"the adapter 'broken' \(broken_adapter:Broken\) cannot be loaded"
    ) as raised:
        adapter_class("broken")
    assert "\n" not in str(raised.value)
    assert issubclass(adapter_class("udp"), Adapter)


def test_something_that_is_no_adapter_is_refused_in_words(installed: Path) -> None:
    install(installed, "wrong", "wrong_adapter:Wrong", "class Wrong: pass")
    with pytest.raises(UnknownAdapter, match=r"is not a psiu_broker\.adapter\.Adapter"):
        adapter_class("wrong")


def test_an_unknown_name_is_a_key_error_with_what_was_probably_meant() -> None:
    with pytest.raises(KeyError) as raised:
        adapter_class("seriel")
    assert isinstance(raised.value, UnknownAdapter)
    assert raised.value.suggestion == "serial"
    assert str(raised.value).startswith("there is no adapter 'seriel' (known: ")


def test_an_unknown_name_like_no_other_has_no_suggestion() -> None:
    with pytest.raises(UnknownAdapter) as raised:
        adapter_class("zzz")
    assert raised.value.suggestion is None


def test_two_adapters_with_one_name_are_noticed_and_the_first_is_used(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    entries = [
        EntryPoint("udp", "psiu_adapters.udp:Udp", registry.GROUP),
        EntryPoint("udp", "other_adapters:Udp", registry.GROUP),
    ]
    monkeypatch.setattr(registry, "entry_points", lambda group: entries)
    registry._found.cache_clear()
    with caplog.at_level(logging.WARNING):
        assert adapter_class("udp").__module__ == "psiu_adapters.udp"
    assert "two adapters are called 'udp'" in caplog.text
    registry._found.cache_clear()

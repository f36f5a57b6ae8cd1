"""`psiu-broker keys`, and the tool that shows them."""

import json
import shutil
import stat
import sys
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from cryptography.hazmat.primitives import serialization
from secure_keys import files

from psiu_broker.cli.authority import Authority
from psiu_broker.cli.tool import psiu
from psiu_broker.config import load
from psiu_broker.config.certificates import problem, read_certificate

Run = Callable[..., Result]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("lab")


@pytest.fixture(scope="module")
def secure(made: Path, process: type[Any], port: Callable[..., int]) -> Iterator[tuple[Any, str]]:
    """A broker as `psiu-broker keys` says that it should be, at an endpoint."""
    keys = process(
        "psiu-broker", "keys", "keys", "--broker", "base", "--program", "operator", "--program", "screen", cwd=made
    )
    assert keys.ended() == 0, keys.err
    keys.close()
    endpoint = f"tls/127.0.0.1:{port(1)}"
    text = "\n".join(keys.out[keys.out.index("[zenoh]") :])
    text = text.replace("tls/0.0.0.0:7447", endpoint).replace(', "screen"', "")
    file = made / "base.toml"
    file.write_text('[broker]\nname = "base"\n' + text.replace("listeners = []", 'listeners = ["screen"]'))
    broker = process("psiu-broker", "run", "--config", file)
    try:
        broker.until("is ready")
        yield broker, endpoint
    finally:
        broker.close()


@pytest.fixture
def ask(secure: tuple[Any, str], made: Path) -> Run:
    def ask(name: str | None, *words: str) -> Result:
        env = {"PSIU_CONNECT": secure[1]} | ({"PSIU_KEYS": f"{made}/keys/{name}"} if name else {})
        return CliRunner().invoke(psiu, words, env=env, prog_name="psiu")

    return ask


def test_everybody_gets_a_key_that_only_its_owner_reads(daemon: Run, tmp_path: Path) -> None:
    folder = tmp_path / "keys"
    result = daemon("keys", str(folder), "--broker", "base", "--program", "operator")
    assert result.exit_code == 0, result.output
    assert f"keep {folder}/ca.key to yourself" in result.output
    assert {file.name: stat.S_IMODE(file.stat().st_mode) for file in folder.iterdir()} == {
        "ca.pem": 0o644, "ca.key": 0o600, "base.pem": 0o644, "base.key": 0o600,
        "operator.pem": 0o644, "operator.key": 0o600,
    }  # fmt: skip
    assert problem(files(folder, "base"), serves=True) is None
    assert problem(files(folder, "operator"), serves=False) is None


@pytest.mark.parametrize("folder", ["keys", 'the "best" keys\\ção 🤖'])
def test_what_it_prints_is_a_configuration(
    daemon: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str
) -> None:
    monkeypatch.chdir(tmp_path)
    result = daemon("keys", folder, "--broker", "base", "--broker", "hill", "--program", "operator")
    assert "who may only listen goes from commanders to listeners" in result.output
    file = tmp_path / "base.toml"
    file.write_text('[broker]\nname = "base"\n[zenoh]' + result.output.partition("[zenoh]")[2])
    configuration = load(file)
    assert configuration.warnings == ()
    assert configuration.zenoh.access is not None
    assert configuration.zenoh.access.model_dump() == {
        "brokers": ("base", "hill"), "commanders": ("operator",), "listeners": ()
    }  # fmt: skip


def test_more_are_made_later_by_the_same_authority_and_none_is_lost(daemon: Run, tmp_path: Path) -> None:
    folder = str(tmp_path)
    daemon("keys", folder, "--broker", "base", "--days", "10")
    first, authority = (tmp_path / "base.pem").read_text(), (tmp_path / "ca.pem").read_text()
    refused = daemon("keys", folder, "--broker", "base", "--program", "operator")
    assert refused.exit_code == 1
    assert refused.stderr == f"psiu-broker: {folder} has base already; --renew makes new ones in their place\n"
    assert (tmp_path / "base.pem").read_text() == first
    assert not (tmp_path / "operator.pem").exists()
    assert daemon("keys", folder, "--program", "operator").exit_code == 0
    assert daemon("keys", folder, "--broker", "base", "--renew").exit_code == 0
    assert (tmp_path / "ca.pem").read_text() == authority
    old, new = (tmp_path / "old.pem"), tmp_path / "base.pem"
    old.write_text(first)
    assert (read_certificate(str(new)).until - read_certificate(str(old)).until).days == 720
    assert problem(files(tmp_path, "base"), serves=True) is None


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        ((), 2, "name somebody: --broker NAME or --program NAME"),
        (("--broker", "a", "--program", "a"), 2, "one is there twice"),
        (("--broker", "../a"), 2, "expected a name of letters, digits, - and _"),
        (("--broker", "a b"), 2, "expected a name"),
        (("--broker", "*"), 2, "expected a name"),
        (("--broker", ""), 2, "expected a name"),
        (("--broker", "x" * 64), 2, "63 at most"),
        (("--program", "CA"), 2, "ca is the authority itself"),
    ],
)
def test_a_name_that_cannot_be_is_refused(
    daemon: Run, tmp_path: Path, words: tuple[str, ...], code: int, said: str
) -> None:
    refused = daemon("keys", str(tmp_path / "keys"), *words)
    assert refused.exit_code == code
    assert said in refused.output
    assert not (tmp_path / "keys").exists()


def test_a_folder_without_the_authority_s_key_makes_none(daemon: Run, tmp_path: Path) -> None:
    daemon("keys", str(tmp_path), "--broker", "base")
    (tmp_path / "ca.key").unlink()
    refused = daemon("keys", str(tmp_path), "--broker", "hill")
    assert (refused.exit_code, "ca.key is not there, which makes more; put it back" in refused.stderr) == (1, True)
    assert not (tmp_path / "hill.key").exists()


def test_an_authority_s_key_that_is_another_s_or_has_a_password_makes_none(daemon: Run, tmp_path: Path) -> None:
    for folder in ("ours", "others"):
        assert daemon("keys", str(tmp_path / folder), "--broker", "base").exit_code == 0
    secret = tmp_path / "ours" / "ca.key"
    ours = serialization.load_pem_private_key(secret.read_bytes(), None)
    locked = ours.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.BestAvailableEncryption(b"word")
    )
    for data, said in (
        (locked, "ca.key has a password; take it off: "),
        ((tmp_path / "others" / "ca.key").read_bytes(), "ca.key is not the key of ca.pem"),
        (b"", "ours: "),
    ):
        secret.write_bytes(data)
        refused = daemon("keys", str(tmp_path / "ours"), "--broker", "base", "--renew")
        assert (refused.exit_code, said in refused.stderr, refused.stderr.count("\n")) == (1, True, 1), refused.output
    assert problem(files(tmp_path / "ours", "base"), serves=True) is None, "what was there is there still"


def test_nobody_is_told_that_a_certificate_is_good_for_longer_than_its_authority(daemon: Run, tmp_path: Path) -> None:
    assert daemon("keys", str(tmp_path / "now"), "--broker", "base", "--days", "3650").exit_code == 0
    begun = datetime.now(UTC) - timedelta(days=3600, hours=12)
    Authority(tmp_path, begun).make("base", 3650, broker=True)
    refused = daemon("keys", str(tmp_path), "--program", "operator")
    assert refused.exit_code == 1
    end = begun + timedelta(days=3650)
    text = f"ca.pem ends on {end:%Y-%m-%d}, in less than 730 days; --days 49 at most, or begin anew in another folder"
    assert text in refused.stderr
    assert daemon("keys", str(tmp_path), "--program", "operator", "--days", "49").exit_code == 0


def test_an_authority_s_key_without_its_certificate_is_left_as_it_is(daemon: Run, tmp_path: Path) -> None:
    assert daemon("keys", str(tmp_path / "k"), "--broker", "base").exit_code == 0
    key = (tmp_path / "k" / "ca.key").read_bytes()
    (tmp_path / "k" / "ca.pem").unlink()
    again = daemon("keys", str(tmp_path / "k"), "--program", "operator")
    assert again.exit_code != 0
    assert "ca.key is there without ca.pem" in again.output
    assert (tmp_path / "k" / "ca.key").read_bytes() == key


def test_without_cryptography_it_says_what_to_install(
    daemon: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "cryptography", None)
    monkeypatch.delitem(sys.modules, "psiu_broker.cli.authority", raising=False)
    refused = daemon("keys", str(tmp_path / "keys"), "--broker", "base")
    assert refused.exit_code == 1
    assert refused.stderr == "psiu-broker: making keys needs cryptography: pip install 'psiu-broker[keys]'\n"


def test_the_tool_shows_its_keys(ask: Run) -> None:
    result = ask("operator", "status", "--json")
    assert result.exit_code == 0, result.output
    assert [status["broker"] for status in json.loads(result.stdout)] == ["base"]
    assert ask("screen", "links").exit_code == 0


def test_a_listener_s_call_ends_with_the_reason(ask: Run) -> None:
    for words in (("call", "MNERIM", "parafrente", "1"), ("send", "MNERIM", "parafrente", "1")):
        result = ask("screen", *words, "--json")
        assert result.exit_code == 3
        assert json.loads(result.stdout) == {
            "error": "refused",
            "message": "broker base lets screen only listen; nothing was sent (zenoh.access in its configuration)",
        }
    assert json.loads(ask("operator", "call", "MNERIM", "x", "--json").stdout)["error"] == "unknown_robot"


def test_a_listener_s_ping_ends_with_the_reason_and_is_no_loss(ask: Run) -> None:
    result = ask("screen", "ping", "MNERIM", "--count", "3", "--every", "0.01")
    assert (result.exit_code, result.stdout) == (3, "")
    assert "broker base lets screen only listen; nothing was sent" in result.stderr


def test_a_name_without_any_right_is_told_so(ask: Run, daemon: Run, made: Path) -> None:
    daemon("keys", str(made / "keys"), "--program", "stranger", "--renew")
    result = ask("stranger", "status")
    assert result.exit_code == 3
    assert "lets stranger know; see its [zenoh.access]" in result.stderr


def test_keys_of_another_laboratory_do_not_open(
    daemon: Run, secure: tuple[Any, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("psiu_broker.bus.client.OPEN_TIMEOUT_S", 0.5)
    daemon("keys", str(tmp_path), "--program", "operator")
    words = ("status", "--connect", secure[1], "--keys", f"{tmp_path}/operator")
    result = CliRunner().invoke(psiu, words, prog_name="psiu")
    assert result.exit_code == 3
    assert f"is it running, and has it keys by {tmp_path}/ca.pem?" in result.stderr


def test_an_endpoint_that_does_not_fit_the_keys_is_refused(ask: Run, made: Path) -> None:
    bare = ask(None, "status")
    assert bare.exit_code == 2
    assert "wants to see a certificate: --keys FOLDER/NAME" in bare.stderr
    plain = ask("operator", "status", "--connect", "tcp/127.0.0.1:7447")
    assert plain.exit_code == 2
    assert "tcp/127.0.0.1:7447 sees no certificate" in plain.stderr


def test_keys_that_are_missing_or_open_to_others_are_refused(ask: Run, made: Path, tmp_path: Path) -> None:
    missing = ask("nobody", "status")
    assert missing.exit_code == 2
    assert "nobody.pem: cannot be read: No such file or directory" in missing.stderr
    for name in ("ca.pem", "operator.pem", "operator.key"):
        shutil.copy(made / "keys" / name, tmp_path)
    (tmp_path / "operator.key").chmod(0o644)
    opened = ask(None, "status", "--keys", f"{tmp_path}/operator")
    assert opened.exit_code == 2
    assert "operator.key may be read by others, who could pass for its owner; run: chmod 6" in opened.stderr


def test_with_keys_the_tool_looks_for_the_broker_of_this_computer(
    tool: Run, made: Path, secure: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("psiu_broker.bus.client.OPEN_TIMEOUT_S", 0.3)
    result = tool("status", "--keys", f"{made}/keys/operator", env={"PSIU_CONNECT": None})
    assert "tls/127.0.0.1:7447" in result.output or result.exit_code == 0


def test_a_broker_with_a_certificate_about_to_end_says_so_at_start(
    daemon: Run, start: Callable[..., Any], tmp_path: Path, bus_port: int
) -> None:
    daemon("keys", str(tmp_path / "keys"), "--broker", "base", "--days", "5")
    file = tmp_path / "base.toml"
    tls = 'ca = "keys/ca.pem"\ncertificate = "keys/base.pem"\nkey = "keys/base.key"\n'
    endpoint = f"tls/127.0.0.1:{bus_port}"
    file.write_text(f'[broker]\nname = "base"\n[zenoh]\nlisten = ["{endpoint}"]\n[zenoh.tls]\n{tls}')
    broker = start("psiu-broker", "run", "--config", file)
    line = broker.until("WARNING")
    assert "zenoh.tls.certificate: " in line
    assert line.endswith("in 4 days; make another where ca.key is: psiu-broker keys FOLDER --broker base --renew")
    broker.until("is ready")
    (tmp_path / "keys/base.key").chmod(0o644)
    refused = start("psiu-broker", "run", "--config", file)
    assert refused.ended() == 78
    assert "run: chmod 6" in refused.err[0]

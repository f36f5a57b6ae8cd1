"""A broker that other computers reach lets in whom it knows, or says that it does not; and the keys are looked at."""

from collections.abc import Callable
from pathlib import Path
from textwrap import dedent

import psutil
import pytest
from ports import free_port
from secure_keys import make_keys

from psiu_broker.broker import Broker
from psiu_broker.config import Configuration, json_schema, load
from psiu_broker.config.shown import shown
from psiu_broker.errors import ConfigurationError

Read = Callable[[str], Configuration]

BROKER = '[broker]\nname = "base"\n'
TLS = '[zenoh.tls]\nca = "keys/ca.pem"\ncertificate = "keys/base.pem"\nkey = "keys/base.key"\n'
ACCESS = '[zenoh.access]\nbrokers = ["hill"]\ncommanders = ["operator"]\nlisteners = ["screen"]\n'
TRUNK = '[trunks.hill]\nadapter = "rfcomm"\naddress = "98:D3:31:00:00:07"\n'
PROTECT = "keep to 127.0.0.1, or to tls/ with [zenoh.tls] and [zenoh.access], or say unprotected = true in [zenoh]"
ADD_TLS = "write [zenoh.tls] with ca, certificate and key, which psiu-broker keys makes"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("protection")
    make_keys(folder / "keys", ["base"], ["operator"])
    return folder


@pytest.fixture
def read(folder: Path) -> Read:
    def read(text: str) -> Configuration:
        file = folder / "base.toml"
        file.write_text(dedent(BROKER + text))
        return load(file)

    return read


@pytest.fixture
def problems(read: Read, folder: Path) -> Callable[[str], list[str]]:
    def problems(text: str) -> list[str]:
        with pytest.raises(ConfigurationError) as caught:
            read(text)
        return [line.removeprefix(f"{folder}/base.toml: ") for line in caught.value.problems]

    return problems


def open_sockets() -> set[tuple[str, int]]:
    """Where this process may be spoken to: what listens, and datagrams."""
    found = psutil.Process().net_connections("inet")
    return {(each.laddr.ip, each.laddr.port) for each in found if each.status in ("LISTEN", "NONE") and each.laddr}


async def test_a_broker_configured_as_usual_is_on_loopback_and_looks_for_nobody(tmp_path: Path) -> None:
    file, port = tmp_path / "base.toml", free_port()
    file.write_text(f'{BROKER}[zenoh]\nlisten = ["tcp/127.0.0.1:{port}"]\n')
    before = open_sockets()
    broker = Broker(load(file))
    await broker.start()
    try:
        assert open_sockets() - before == {("127.0.0.1", port)}
    finally:
        await broker.stop()
    file.write_text(BROKER)
    assert load(file).zenoh.listen == ("tcp/127.0.0.1:7447",)


def listen(*endpoints: str, more: str = "") -> str:
    return f"[zenoh]\nlisten = [{', '.join(repr(each) for each in endpoints)}]\n{more}"


@pytest.mark.parametrize(
    "endpoint",
    ["tcp/0.0.0.0:7447", "tcp/[::]:7447", "tcp/192.168.1.2:7447", "udp/0.0.0.0:7447", "ws/robot.lan:7447",
     "tcp/127.0.0.1.evil.net:7447"],
)  # fmt: skip
def test_nobody_listens_beyond_loopback_without_protection(
    problems: Callable[[str], list[str]], read: Read, endpoint: str
) -> None:
    for key, text in (
        ("zenoh.listen[0]", listen(endpoint)),
        ("mesh.connect[0]", f"[mesh]\nconnect = ['{endpoint}']"),
        ("zenoh.listen[0]", listen(endpoint) + TLS),
    ):
        assert problems(text) == [f"{key}: {endpoint} lets every computer that reaches it move the robots; {PROTECT}"]
    [warning] = read(listen(endpoint, more="unprotected = true\n")).warnings
    assert "lets every computer that reaches it move the robots" in warning


def test_keys_alone_do_not_say_who_may_do_what(problems: Callable[[str], list[str]]) -> None:
    [line] = problems(listen("tls/0.0.0.0:7447") + TLS)
    assert line.startswith("zenoh.listen[0]: tls/0.0.0.0:7447 lets every computer")


def test_nobody_looks_for_brokers_around_without_protection(problems: Callable[[str], list[str]], read: Read) -> None:
    text = "whoever answers on the local network may move the robots"
    assert problems("[mesh]\ndiscover = true") == [f"mesh.discover: {text}; {PROTECT}"]
    [warning] = read("[zenoh]\nunprotected = true\n[mesh]\ndiscover = true").warnings
    assert f"mesh.discover: {text}" in warning


def test_with_keys_and_rules_all_is_well(read: Read, folder: Path) -> None:
    text = listen("tls/0.0.0.0:7447", "tls/[::]:7448") + TLS + ACCESS
    configuration = read(text + "[mesh]\ndiscover = true\nconnect = ['tls/hill.lan:7447']")
    assert configuration.warnings == ()
    assert configuration.zenoh.tls is not None
    assert configuration.zenoh.tls.key == str(folder / "keys/base.key")
    # What other programs may read tells where the key is, and nothing of it.
    assert "PRIVATE" not in str(shown(configuration))


def test_paths_are_from_the_folder_of_the_file_wherever_the_broker_runs(
    read: Read, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read(listen("tls/127.0.0.1:7447") + TLS)
    monkeypatch.chdir(folder)
    configuration = load(Path("base.toml"))
    monkeypatch.chdir(tmp_path)
    assert configuration.zenoh.tls is not None
    assert Path(configuration.zenoh.tls.ca).exists()


@pytest.mark.parametrize("plain", ["tcp/127.0.0.1:7447", "unixsock-stream//run/psiu.sock", "udp/0.0.0.0:7447"])
def test_with_rules_everybody_shows_a_certificate(problems: Callable[[str], list[str]], plain: str) -> None:
    scheme = plain.partition("/")[0]
    expected = (
        f'expected tls/HOST:PORT, got "{plain}", where nobody shows the certificate that access asks;'
        f" write tls/ in place of {scheme}/"
    )
    more = "unprotected = true\n"
    assert problems(listen("tls/127.0.0.1:1", plain, more=more) + TLS + ACCESS) == [f"zenoh.listen[1]: {expected}"]
    mesh = f"[mesh]\nconnect = ['{plain}']"
    assert problems(listen("tls/127.0.0.1:1", more=more) + TLS + ACCESS + mesh) == [f"mesh.connect[0]: {expected}"]


def test_rules_and_endpoints_that_need_keys_say_so(problems: Callable[[str], list[str]]) -> None:
    assert problems(listen("tls/127.0.0.1:7447")) == [f'zenoh.listen[0]: "tls/127.0.0.1:7447" needs a key; {ADD_TLS}']
    assert problems("[mesh]\nconnect = ['tls/127.0.0.1:7447']") == [
        f'mesh.connect[0]: "tls/127.0.0.1:7447" needs a key; {ADD_TLS}'
    ]
    access, *_ = problems(listen("tls/127.0.0.1:7447") + ACCESS)
    assert access == f"zenoh.access: the names are those of certificates, and there are none; {ADD_TLS}"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            ACCESS.replace('"screen"', '"operator"'),
            'zenoh.access.listeners[0]: "operator" is one of commanders already',
        ),
        (ACCESS.replace('"hill"', '"hill", "hill"'), 'zenoh.access.brokers: "hill" is there twice; remove one'),
        (ACCESS.replace('"hill"', '""'), "zenoh.access.brokers[0]: "),
        (ACCESS + "admins = []\n", "zenoh.access.admins: unknown key; "),
        (ACCESS.replace('["hill"]', '"hill"'), "zenoh.access.brokers: expected a list, got "),
    ],
)
def test_rules_that_contradict_themselves_are_refused(
    problems: Callable[[str], list[str]], text: str, expected: str
) -> None:
    [line] = problems(listen("tls/127.0.0.1:7447") + TLS + text)
    assert line.startswith(expected)


@pytest.mark.parametrize("option", ["ca", "certificate", "key"])
def test_a_key_file_that_is_missing_or_not_told_is_a_mistake(problems: Callable[[str], list[str]], option: str) -> None:
    lines = [line for line in TLS.splitlines(keepends=True) if not line.startswith(option)]
    [line] = problems(listen("tls/127.0.0.1:7447") + "".join(lines))
    assert line.startswith(f"zenoh.tls.{option}: missing; write {option} = …")
    [line] = problems(listen("tls/127.0.0.1:7447") + "".join(lines) + f'{option} = "none"\n')
    assert line.startswith(f"zenoh.tls.{option}: ")
    assert "cannot be read: No such file" in line


def test_a_key_that_others_may_read_stops_the_broker_with_what_to_run(
    problems: Callable[[str], list[str]], folder: Path
) -> None:
    key = folder / "keys/base.key"
    key.chmod(0o644)
    try:
        [line] = problems(listen("tls/127.0.0.1:7447") + TLS)
    finally:
        key.chmod(0o600)
    assert line.startswith(f"zenoh.tls.key: {key} may be read by others, who could pass for its owner; run: chmod 6")


def test_a_program_s_certificate_is_refused(problems: Callable[[str], list[str]]) -> None:
    [line] = problems(listen("tls/127.0.0.1:7447") + TLS.replace("base.", "operator."))
    assert line.startswith("zenoh.tls.certificate: ")
    assert "operator.pem is a program's" in line


def test_a_trunk_is_told_to_be_a_way_round_the_rules(read: Read) -> None:
    [warning] = read(listen("tls/127.0.0.1:7447") + TLS + ACCESS + TRUNK).warnings
    assert warning.endswith(
        "trunks.hill: whoever is at its far end counts as a broker, and shows no certificate;"
        " see that nobody else reaches it"
    )
    assert read(TRUNK).warnings == ()


@pytest.mark.parametrize("host", ["192.168.1.7", "hill.lan", "[fd00::7]", "[::1", "127.0.0.1.evil.net"])
def test_a_trunk_over_the_network_needs_protection_as_any_other_way(
    problems: Callable[[str], list[str]], read: Read, host: str
) -> None:
    trunk = f'[trunks.hill]\nadapter = "serial"\ndevice = "socket://{host}:4000"\n'
    text = f"whoever answers at socket://{host}:4000, or is on the way there, may move the robots"
    how = "go by a tunnel that ends on 127.0.0.1"
    assert problems(trunk) == [f"trunks.hill.device: {text}; {how}, or say unprotected = true in [zenoh]"]
    [warning] = read("[zenoh]\nunprotected = true\n" + trunk).warnings
    assert warning.endswith(f"trunks.hill.device: {text}; {how}")
    [warning] = read(listen("tls/127.0.0.1:7447") + TLS + ACCESS + trunk).warnings
    assert "counts as a broker" in warning


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "[::1]"])
def test_a_trunk_on_this_computer_needs_none(read: Read, host: str) -> None:
    assert read(f'[trunks.hill]\nadapter = "serial"\ndevice = "socket://{host}:4000"\n').warnings == ()


def test_editors_know_the_tables() -> None:
    properties = json_schema()["properties"]["zenoh"]["properties"]
    assert {"tls", "access", "unprotected"} <= set(properties)

"""What is installed beside the package, checked by the tools of those who read it."""

import os
import re
import shutil
import stat
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from psiu_broker import __version__
from psiu_broker.bus.session import Session
from psiu_broker.config import load

TREE = Path(__file__).parents[1]
DEPLOY = TREE / "deploy"
SERVICE = DEPLOY / "psiu-broker.service"
EXAMPLE = DEPLOY / "examples" / "psiu-broker.toml"
SYSTEMD_ANALYZE = shutil.which("systemd-analyze")
SYSTEMD_SYSUSERS = shutil.which("systemd-sysusers")
SYSTEMD_TMPFILES = shutil.which("systemd-tmpfiles")
GUIDE = (DEPLOY / "README.md").read_text()


@pytest.mark.skipif(SYSTEMD_ANALYZE is None, reason="systemd-analyze is missing: the unit is NOT checked")
def test_systemd_finds_nothing_wrong_with_the_unit(tmp_path):
    # The unit is checked in a root of its own, where its program is "installed" as an empty executable.
    program = re.search(r"^ExecStart=(\S+)", SERVICE.read_text(), re.MULTILINE)
    assert program is not None
    installed = tmp_path / program[1].lstrip("/")
    installed.parent.mkdir(parents=True)
    installed.touch(mode=0o755)
    units = tmp_path / "etc/systemd/system"
    units.mkdir(parents=True)
    shutil.copy(SERVICE, units)
    result = subprocess.run(
        [SYSTEMD_ANALYZE, "verify", "--recursive-errors=no", "--man=no", f"--root={tmp_path}", SERVICE.name],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (result.returncode, result.stdout + result.stderr) == (0, "")


@pytest.mark.skipif(SYSTEMD_ANALYZE is None, reason="systemd-analyze is missing: the hardening is NOT checked")
def test_the_unit_is_hardened():
    result = subprocess.run(
        [SYSTEMD_ANALYZE, "security", "--offline=true", "--threshold=20", "--no-pager", str(SERVICE)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    assert "Overall exposure level" in result.stdout


MAY = {
    "User": ["psiu-broker"],
    "SupplementaryGroups": ["dialout"],
    "CapabilityBoundingSet": [""],
    "AmbientCapabilities": [""],
    "NoNewPrivileges": ["yes"],
    "ProtectProc": ["invisible"],
    "ProcSubset": ["pid"],
    "ProtectSystem": ["strict"],
    "ProtectHome": ["yes"],
    "PrivateTmp": ["yes"],
    "DevicePolicy": ["closed"],
}
WRITES = re.compile("ReadWrite|Bind|StateDirectory|CacheDirectory|LogsDirectory|ConfigurationDirectory")


def settings() -> dict[str, list[str]]:
    """What the unit says, by option."""
    said: dict[str, list[str]] = {}
    for option, value in re.findall(r"^(\w+)=(.*)$", SERVICE.read_text(), re.MULTILINE):
        said.setdefault(option, []).append(value)
    return said


def test_the_service_may_no_more_than_the_threat_model_says():
    said = settings()
    assert {option: said.get(option) for option in MAY} == MAY
    assert not [option for option in said if WRITES.match(option)], "it writes in its RuntimeDirectory only"
    devices = [value.removeprefix("char-").removesuffix(" rw") for value in said["DeviceAllow"]]
    assert set(devices) == {"ttyUSB", "ttyACM", "ttyAMA", "ttyS", "rfcomm"}


def test_a_wrong_configuration_is_not_tried_again_and_anything_else_is_for_ever():
    unit = SERVICE.read_text().splitlines()
    assert {"Type=notify", "Restart=on-failure", "RestartPreventExitStatus=78", "StartLimitIntervalSec=0"} <= set(unit)


async def test_the_group_of_the_service_and_nobody_else_reaches_the_socket_that_the_guide_tells_of(tmp_path):
    unit = dict(line.split("=", 1) for line in SERVICE.read_text().splitlines() if re.match(r"\w+=", line))
    (endpoint,) = set(re.findall(r"unixsock-stream/[^\s\"]+", (DEPLOY / "README.md").read_text() + SERVICE.read_text()))
    path = Path(endpoint.removeprefix("unixsock-stream/"))
    assert path.parent == Path("/run") / unit["RuntimeDirectory"]
    assert unit["RuntimeDirectoryMode"] == "0750"
    made = tmp_path / path.name
    before = os.umask(int(unit["UMask"], 8))
    try:
        session = await Session.open([f"unixsock-stream/{made}"])
        mode = stat.S_IMODE(made.stat().st_mode)
        await session.close()
    finally:
        os.umask(before)
    assert f"{mode:o}" == "770"


def test_the_example_may_listen_there(tmp_path):
    file = tmp_path / "psiu-broker.toml"
    file.write_text(EXAMPLE.read_text().replace("tcp/127.0.0.1:7447", "unixsock-stream//run/psiu-broker/psiu.sock"))
    assert load(file).warnings == ()


@pytest.mark.skipif(SYSTEMD_SYSUSERS is None, reason="systemd-sysusers is missing: the user is NOT made")
def test_the_user_is_made_and_may_open_serial_ports(tmp_path):
    (tmp_path / "etc").mkdir()
    folder = tmp_path / "usr/lib/sysusers.d"
    folder.mkdir(parents=True)
    shutil.copy(DEPLOY / "psiu-broker.sysusers", folder / "psiu-broker.conf")
    subprocess.run(
        [SYSTEMD_SYSUSERS, f"--root={tmp_path}", "psiu-broker.conf"], check=True, capture_output=True, text=True
    )
    users = (tmp_path / "etc/passwd").read_text()
    groups = (tmp_path / "etc/group").read_text()
    assert re.search(r"^psiu-broker:.*nologin$", users, re.MULTILINE)
    assert re.search(r"^dialout:.*[:,]psiu-broker$", groups, re.MULTILINE)


def test_the_modules_of_every_allowed_device_are_loaded_before_the_service_starts():
    modules = {
        line for line in (DEPLOY / "psiu-broker.modules-load").read_text().splitlines() if not line.startswith("#")
    }
    allowed = set(re.findall(r"^DeviceAllow=char-(\S+) rw$", SERVICE.read_text(), re.MULTILINE))
    built_in = {"ttyAMA", "ttyS"}
    of = {"ttyUSB": "usbserial", "ttyACM": "cdc_acm", "rfcomm": "rfcomm"}
    assert {of[device] for device in allowed - built_in} == modules


def test_the_udev_rules_read_as_udev_rules():
    word = r'[A-Z_]+(\{[A-Za-z0-9_.]+\})?(==|!=|=|\+=|:=)"[^"]*"'
    rules = [
        line for line in (DEPLOY / "psiu-broker.rules").read_text().splitlines() if line and not line.startswith("#")
    ]
    assert rules
    for rule in rules:
        assert re.fullmatch(f"{word}(, {word})*", rule), rule
    jumps = {label for rule in rules for label in re.findall(r'GOTO="(\w+)"', rule)}
    assert jumps == {label for rule in rules for label in re.findall(r'LABEL="(\w+)"', rule)}


def test_the_example_is_the_readme_s_configuration_and_loads_without_a_warning():
    configuration = load(EXAMPLE)
    assert list(configuration.links) == ["radio", "wifi", "arm"]
    assert list(configuration.robots) == ["BRACO"]
    assert configuration.warnings == ()


def test_the_changelog_tells_of_this_version():
    assert f"## {__version__}" in (TREE / "CHANGELOG.md").read_text()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files away")
@pytest.mark.skipif(
    None in (SYSTEMD_SYSUSERS, SYSTEMD_TMPFILES), reason="systemd-tmpfiles is missing: no folder is made"
)
def test_the_broker_reads_the_keys_that_the_guide_has_installed_and_nobody_else_does(tmp_path):
    for kind in ("sysusers", "tmpfiles"):
        folder = tmp_path / f"usr/lib/{kind}.d"
        folder.mkdir(parents=True)
        shutil.copy(DEPLOY / f"psiu-broker.{kind}", folder / "psiu-broker.conf")
    (tmp_path / "etc/psiu-broker").mkdir(parents=True)
    run = partial(subprocess.run, check=True, capture_output=True, text=True)
    run([SYSTEMD_SYSUSERS, f"--root={tmp_path}", "psiu-broker.conf"])
    run([SYSTEMD_TMPFILES, "--create", f"--root={tmp_path}", "psiu-broker.conf"])
    keys = tmp_path / "etc/psiu-broker/keys"
    [gid] = re.findall(r"^psiu-broker:[^:]*:(\d+):", (tmp_path / "etc/group").read_text(), re.MULTILINE)
    told = (keys.stat().st_uid, keys.stat().st_gid, stat.S_IMODE(keys.stat().st_mode))
    assert told == (0, int(gid), 0o750)

    [script] = [text for text in re.findall(r"```sh\n(.*?)```", GUIDE, re.DOTALL) if "psiu-broker keys" in text]
    script = script.replace("/opt/psiu-broker/bin", str(Path(sys.executable).parent)).replace(
        "-g psiu-broker", f"-g {gid}"
    )
    made = run(["sh", "-ec", script.replace("/root/", f"{tmp_path}/root/").replace("/etc/", f"{tmp_path}/etc/")])
    assert {file.name: f"{stat.S_IMODE(file.stat().st_mode):o}" for file in keys.iterdir()} == {
        "ca.pem": "644", "base.pem": "644", "base.key": "640",
    }  # fmt: skip
    assert keys.joinpath("base.key").stat().st_gid == int(gid)
    file = tmp_path / "etc/psiu-broker/psiu-broker.toml"
    tables = made.stdout.partition("[zenoh]")[2].replace(f"{tmp_path}/root/keys", "keys")
    file.write_text(f'[broker]\nname = "base"\n[zenoh]{tables}')
    assert load(file).warnings == ()

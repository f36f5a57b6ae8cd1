"""Scripts: `psiu roboscript` as its user meets it, with a real broker, a pseudo-terminal and a simulated body."""

import asyncio
import json
import os
import pty
import re
import signal
import socket
import subprocess
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from ports import free_port

from psiu_broker.broker import Broker
from psiu_broker.cli.tool import psiu
from psiu_broker.config import load
from psiu_broker.errors import CallError
from psiu_broker.frame import Address
from psiu_broker.messages import Answer, CallRequest, Refusal
from psiu_broker.profiles.roboscript import recording, vocabulary
from psiu_broker.simulator import PtyPort, UdpPort
from psiu_broker.simulator.mitya import Action, MityaBody
from psiu_broker.simulator.robot import Reply

PSIU = Path(sys.executable).parent / "psiu"
DANCE = "# a dance\ndrive 100\nwait 500\n\ndrive 0\n"
DANCED = [Action("D", 100, 500), Action("D", 0, 0)]
LONG = "drive 1\nwait 2\n" * 20
RECORDED = 20
Run = Callable[..., Result]


class Noisy(MityaBody):
    """On its line the message of one number, from 1, is spoilt: the body reads it as another."""

    spoilt = 0
    taken = 0
    cut = b""
    """A message that loses its first byte on the way."""

    def receive(self, data: bytes, now: float) -> list[Reply]:
        return super().receive(data.replace(self.cut, self.cut[1:]) if self.cut else data, now)

    def _take(self, message: bytes, now: float) -> list[Reply]:
        self.taken += 1
        return super()._take(b"D00?0" if self.taken == self.spoilt else message, now)


class Lab:
    """A broker, in this process, with MITYA on a pseudo-terminal, and panel programs over UDP that command it.

    A phone is at a UDP port instead.
    """

    def __init__(self, folder: Path, body: MityaBody) -> None:
        bus, self.panel = free_port(), free_port(socket.SOCK_DGRAM)
        self.folder = folder
        self.body = body
        phone, here = (free_port(socket.SOCK_DGRAM) for _ in range(2))
        self.port = UdpPort(body, listen=f"127.0.0.1:{phone}") if body.phone else PtyPort(body, link=folder / "corpo")
        device = f'adapter = "udp"\nlisten = "127.0.0.1:{here}"\npeers = ["127.0.0.1:{phone}"]'
        if isinstance(self.port, PtyPort):
            device = f'adapter = "serial"\ndevice = "{self.port.path}"\nbaudrate = 115200'
        self.env = {"PSIU_CONNECT": f"tcp/127.0.0.1:{bus}"}
        file = folder / "lab.toml"
        file.write_text(
            f"""
[broker]
name = "base"
[zenoh]
listen = ["tcp/127.0.0.1:{bus}"]
[links.corpo]
{device}
protocol = "mitya"
version = "{body.version}"
[links.painel]
adapter = "udp"
listen = "127.0.0.1:{self.panel}"
protocol = "mitya"
version = "{body.version}"
plays = "MITYA"
[robots.MITYA]
link = "corpo"
"""
        )
        self.broker = Broker(load(file))

    async def run(self, *words: str | Path) -> Result:
        """`psiu roboscript` with these words; stdout is no terminal."""
        arguments = ["roboscript", *map(str, words)]
        return await asyncio.to_thread(lambda: CliRunner().invoke(psiu, arguments, env=self.env, prog_name="psiu"))

    async def start(self, *words: str | Path, stderr: int = subprocess.PIPE) -> asyncio.subprocess.Process:
        """The same in a process of its own."""
        return await asyncio.create_subprocess_exec(
            PSIU, "roboscript", *words, env={**os.environ, **self.env}, stdout=subprocess.PIPE, stderr=stderr
        )

    async def call(self, command: str, *parameters: int | str) -> Answer | None:
        return await self.broker.call(Address.named("MITYA"), command, CallRequest(parameters=list(parameters)))

    def file(self, text: str) -> Path:
        path = self.folder / "dance.txt"
        path.write_text(text)
        return path

    async def recorded(self, actions: int) -> None:
        """Wait until the body has so many actions in slot 3 and records on."""
        await self.until(lambda: self.body.recording == 3 and len(self.body.scripts.get(3, ())) >= actions)

    async def until(self, true: Callable[[], object]) -> None:
        async with asyncio.timeout(10):
            while not true():  # noqa: ASYNC110 - the state of robot and broker is values, not events
                await asyncio.sleep(0.01)

    def moves(self) -> int:
        """The speed of its left motor now."""
        self.body.advance(asyncio.get_running_loop().time())
        return self.body.body.left

    @property
    def open(self) -> bool:
        return next(link.state for link in self.broker.links() if link.name == "corpo") == "open"


@asynccontextmanager
async def lab(folder: Path, body: MityaBody | None = None) -> AsyncIterator[Lab]:
    made = Lab(folder, body or MityaBody())
    await made.port.open()
    await made.broker.start()
    try:
        await made.until(lambda: made.open)
        await asyncio.sleep(0.05)  # for what the greeting is answered
        yield made
        ledger = made.broker.ledger()
        assert ledger.balances, ledger
    finally:
        await made.broker.stop()
        await made.port.close()


@pytest.mark.parametrize("version", ["2012", "2013"])
async def test_a_script_is_uploaded_with_its_progress_and_played(tmp_path: Path, version: str) -> None:
    async with lab(tmp_path, MityaBody(version=version)) as made:  # type: ignore[arg-type]
        told = await made.run("upload", "MITYA", "3", made.file(LONG))
        assert (told.exit_code, told.stderr) == (0, ""), told.output
        *progress, last = told.stdout.splitlines()
        assert re.fullmatch(r"MITYA: slot 3 recorded \([0-9.]+ ms\)", last)
        assert progress == [f"{sent}\t43" for sent in (10, 20, 30, 40)]
        letter = "D" if version == "2012" else "G"
        assert made.body.scripts[3] == [Action(letter, 1, 2)] * RECORDED
        played = await made.run("play", "MITYA", "3")
        assert played.exit_code == 0
        await made.until(lambda: made.moves() == 1)
        shown = await made.run("play", "MITYA", "3", "--json")
        assert Answer.model_validate_json(shown.stdout).status == (None if version == "2012" else "sucesso")


async def test_over_udp_the_phone_is_silent_where_all_is_well_and_tells_what_is_not(tmp_path: Path) -> None:
    async with lab(tmp_path, MityaBody(phone=True, memory=2)) as made:
        told = await made.run("upload", "MITYA", "3", made.file("nod\nfire\n"))
        assert told.exit_code == 0, told.output
        assert "the phone passes on only what goes wrong, and nothing did" in told.stdout
        assert made.body.scripts[3] == [Action("y", 1, 0), Action("f", 1, 0)]
        file = made.file("nod\nfire\nnod\n")
        told = await made.run("upload", "MITYA", "3", file)
        assert (told.exit_code, told.stderr.startswith(f"{file}: Z0003: E0005, ")) == (1, True)
        assert made.body.recording is None


async def test_programs_get_an_answer(tmp_path: Path) -> None:
    async with lab(tmp_path) as made:
        told = await made.run("upload", "MITYA", "3", made.file(DANCE), "--json")
        assert told.exit_code == 0
        assert Answer.model_validate_json(told.stdout).status == "sucesso"
        assert made.body.scripts[3] == DANCED


async def test_every_mistake_is_told_with_file_and_line_and_nothing_is_sent(tmp_path: Path) -> None:
    async with lab(tmp_path, MityaBody(version="2013")) as made:
        file = made.file("drive 100\nF 1\ndrive 300\n")
        heard = len(made.body.heard)
        told = await made.run("upload", "MITYA", "3", file)
        assert (told.exit_code, told.stdout) == (1, "")
        assert told.stderr.splitlines() == [
            f"{file}:2: F is a letter of 2012; in 2013 it is M: write mood",
            f"{file}:3: 300 is no value of drive; it takes -255 to 255: write drive 100",
        ]
        in_json = await made.run("upload", "MITYA", "3", file, "--json")
        assert (in_json.exit_code, Refusal.model_validate_json(in_json.stdout).error) == (1, "refused")
        assert len(made.body.heard) == heard


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("# nothing\n", "it has no action; a script has 1 to 130: write a line such as drive 100"),
        ("# long\n" * 20_000, "it has more than 30000 bytes: shorten its comments"),
    ],
)
def test_a_script_that_is_wrong_as_a_whole_is_wrong_and_needs_no_robot(
    tool: Run, tmp_path: Path, text: str, wrong: str
) -> None:
    file = tmp_path / "dance.txt"
    file.write_text(text)
    nowhere = ("--connect", "tcp/127.0.0.1:1")
    told = tool("roboscript", "upload", "MITYA", "3", str(file), *nowhere)
    assert (told.exit_code, told.stdout, told.stderr) == (1, "", f"{file}: {wrong}\n")
    in_json = tool("roboscript", "upload", "MITYA", "3", str(file), "--json", *nowhere)
    refusal = Refusal.model_validate_json(in_json.stdout)
    assert (in_json.exit_code, refusal.error, refusal.message) == (1, "refused", wrong)


async def test_at_a_terminal_the_progress_is_one_line_that_goes_when_it_is_done(tmp_path: Path) -> None:
    async with lab(tmp_path) as made:
        ours, its = pty.openpty()
        try:
            process = await made.start("upload", "MITYA", "3", made.file(DANCE), stderr=its)
            out, _ = await process.communicate()
            shown = os.read(ours, 10_000).decode()
        finally:
            os.close(ours)
            os.close(its)
        assert process.returncode == 0
        assert re.fullmatch(rb"MITYA: slot 3 recorded \(.*\)\n", out)
        *progress, gone = shown.removeprefix("\r").split("\r")
        assert progress[:4] == [f"MITYA: {sent} of 7 messages\x1b[K" for sent in range(2, 6)]
        assert gone == "\x1b[K"


@pytest.fixture
def unhurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Messages so far apart that a busy machine hears the objection to one before it sends the next."""
    monkeypatch.setattr(recording, "PAUSE_S", 0.125)
    monkeypatch.setattr(recording, "FIRST_PAUSES", 2)


@pytest.mark.usefixtures("unhurried")
@pytest.mark.parametrize("version", ["2012", "2013"])
async def test_what_the_robot_objects_to_is_told_with_its_line(tmp_path: Path, version: str) -> None:
    body = Noisy(version=version)  # type: ignore[arg-type]
    async with lab(tmp_path, body) as made:
        body.spoilt = body.taken + 5
        file = made.file(DANCE)
        told = await made.run("upload", "MITYA", "3", file)
        code = "E0001" if version == "2012" else "#0001"
        assert (told.exit_code, told.stdout) == (1, "")
        assert re.match(rf"{file}:5: .*: {code}, ", told.stderr), told.stderr
        assert (body.recording, body.scripts.get(3)) == (None, None)
        assert body.body.left == body.body.right == 0
        body.spoilt = 0
        assert (await made.run("upload", "MITYA", "3", file)).exit_code == 0
        body.spoilt = body.taken + 5
        in_json = await made.run("upload", "MITYA", "3", file, "--json")
        assert (in_json.exit_code, json.loads(in_json.stdout)["values"]) == (1, [code, 5])


@pytest.mark.usefixtures("unhurried")
async def test_a_body_that_lost_step_in_the_middle_is_brought_back_into_it(tmp_path: Path) -> None:
    body = Noisy()
    async with lab(tmp_path, body) as made:
        body.cut = b"W01F4"
        file = made.file(DANCE)
        told = await made.run("upload", "MITYA", "3", file)
        assert told.exit_code == 1
        assert re.match(rf"{file}:5: .*: E0004, ", told.stderr), told.stderr
        body.cut = b""
        assert (await made.run("upload", "MITYA", "3", file)).exit_code == 0
        assert body.scripts[3] == DANCED


async def test_a_body_without_room_says_so(tmp_path: Path) -> None:
    async with lab(tmp_path, MityaBody(memory=1)) as made:
        file = made.file(DANCE)
        told = await made.run("upload", "MITYA", "3", file)
        assert told.exit_code == 1
        assert told.stderr.startswith(f"{file}: Z0002: E0005, ")
        assert made.body.recording is None


async def test_a_killed_tool_leaves_a_whole_script(tmp_path: Path) -> None:
    async with lab(tmp_path) as made:
        process = await made.start("upload", "MITYA", "3", made.file(LONG))
        await made.recorded(2)
        process.kill()
        await process.communicate()
        await made.until(lambda: made.body.recording is None)
        assert len(made.body.scripts[3]) == RECORDED


async def test_ctrl_c_ends_the_recording_and_empties_the_slot(tmp_path: Path) -> None:
    async with lab(tmp_path) as made:
        process = await made.start("upload", "MITYA", "3", made.file(LONG))
        await made.recorded(2)
        process.send_signal(signal.SIGINT)
        _, errors = await process.communicate()
        assert (process.returncode, b"the recording was ended" in errors) == (130, True), errors
        assert (made.body.recording, made.body.scripts.get(3)) == (None, None)


async def test_after_a_cut_link_the_recording_is_ended_as_soon_as_it_is_back(tmp_path: Path) -> None:
    async with lab(tmp_path) as made:
        file = made.file(LONG)
        upload = asyncio.create_task(made.run("upload", "MITYA", "3", file))
        await made.recorded(2)
        made.port.unplug()
        told = await upload
        assert told.exit_code == 3
        assert re.match(rf"psiu: {file}:\d+: .*link corpo is down", told.stderr), told.stderr
        assert "will be told to end it when its link is open again" in told.stderr
        assert made.body.recording == 3
        made.port.plug()
        await made.until(lambda: made.body.recording is None)
        assert made.body.scripts.get(3) is None
        assert await made.call("drive", 7) is not None
        assert made.body.body.left == 7


async def test_a_broker_that_stops_ends_the_recording(tmp_path: Path) -> None:
    async with lab(tmp_path) as made:
        upload = asyncio.create_task(made.run("upload", "MITYA", "3", made.file(LONG)))
        await made.recorded(2)
        await made.broker.stop()
        assert (await upload).exit_code == 3
        await made.until(lambda: made.body.recording is None)
        assert made.body.scripts.get(3) is None


async def test_a_stop_ends_the_recording_and_stops_the_robot(tmp_path: Path) -> None:
    async with lab(tmp_path) as made:
        await made.call("drive", 50)
        upload = asyncio.create_task(made.run("upload", "MITYA", "3", made.file(LONG)))
        await made.recorded(2)
        assert made.body.body.left == 50
        await made.call("stop")
        assert made.body.body.left == 0
        told = await upload
        assert (told.exit_code, "stop came meanwhile" in told.stderr) == (3, True)
        assert made.body.scripts.get(3) is None


@pytest.mark.parametrize(("version", "phone"), [("2012", False), ("2013", False), ("2012", True)])
async def test_a_stop_ends_the_script_that_the_robot_plays(tmp_path: Path, version: str, phone: bool) -> None:
    async with lab(tmp_path, MityaBody(version=version, phone=phone)) as made:  # type: ignore[arg-type]
        uploaded = await made.run("upload", "MITYA", "3", made.file("drive 50\nwait 60000\ndrive 60\n"))
        assert uploaded.exit_code == 0, uploaded.output
        await made.run("play", "MITYA", "3")
        await made.until(lambda: made.moves() == 50)
        await made.call("stop")
        await made.until(lambda: made.moves() == 0 and made.body.recording is None)
        assert not made.body.playing
        assert len(made.body.scripts[3]) == 2
        answer = await made.call("drive", 7)
        assert answer is not None
        assert answer.status == ("sucesso" if version == "2013" else None)
        await made.until(lambda: made.moves() == 7)


async def test_nothing_else_reaches_a_robot_that_records(tmp_path: Path) -> None:
    async with lab(tmp_path) as made:
        upload = asyncio.create_task(made.run("upload", "MITYA", "3", made.file(LONG)))
        await made.recorded(2)
        with pytest.raises(CallError, match="MITYA is at roboscript-upload and hears nothing else"):
            await made.broker.call(Address.named("MITYA"), "drive", CallRequest(parameters=[9], timeout_s=0.1))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as panel:
            panel.sendto(b"D0064", ("127.0.0.1", made.panel))
            await made.until(lambda: made.broker.ledger().total.dropped.get("refused"))
            assert (await upload).exit_code == 0
            assert made.body.scripts[3] == [Action("D", 1, 2)] * RECORDED
            panel.sendto(b"D0063", ("127.0.0.1", made.panel))
            await made.until(lambda: made.body.body.left == 0x63)


async def test_a_recording_that_somebody_left_open_can_be_ended(tmp_path: Path) -> None:
    async with lab(tmp_path) as made:
        made.body.recording = 5
        told = await made.run("abort", "MITYA")
        assert (told.exit_code, "records no longer" in told.stdout) == (0, True)
        assert made.body.recording is None


async def test_an_unknown_robot_and_a_slot_that_is_none(tmp_path: Path) -> None:
    async with lab(tmp_path) as made:
        file = made.file(DANCE)
        told = await made.run("upload", "NINGUEM", "3", file)
        assert (told.exit_code, "NINGUEM" in told.stderr) == (3, True)
        assert (await made.run("upload", "MITYA", "10", file)).exit_code == 2
        assert (await made.run("upload", "MITYA", "3", tmp_path / "none.txt")).exit_code == 2


def test_a_script_is_checked_without_a_broker(tool: Run, tmp_path: Path) -> None:
    file = tmp_path / "dance.txt"
    file.write_text(DANCE)
    told = tool("roboscript", "check", str(file))
    assert (told.exit_code, told.stdout) == (0, f"{file}: 2 actions, 0.5 s, for 2012\n")
    file.write_text("drive 300\nwait\nnod\n")
    told = tool("roboscript", "check", str(file))
    assert (told.exit_code, told.stdout) == (1, "")
    assert [line.split(": ")[0] for line in told.stderr.splitlines()] == [f"{file}:1", f"{file}:2"]
    in_json = tool("roboscript", "check", str(file), "--version", "2013", "--json")
    assert in_json.exit_code == 1
    said = json.loads(in_json.stdout)
    assert (said["version"], [problem["line"] for problem in said["problems"]]) == ("2013", [1, 2])


def test_a_script_may_come_from_standard_input(tool: Run) -> None:
    told = tool("roboscript", "check", "-", input=DANCE)
    assert (told.exit_code, told.stdout) == (0, "standard input: 2 actions, 0.5 s, for 2012\n")
    assert tool("roboscript", "check", "-", input=b"\xff\xfe").exit_code == 1
    assert "has no RoboScript" in tool("roboscript", "check", "-", "--version", "2014", input=DANCE).stderr


def test_a_capture_becomes_a_script_that_checks(tool: Run) -> None:
    capture = "r0103Z0002D0064W01F4D0000W0000Z0000\n"
    told = tool("roboscript", "decompile", input=capture)
    assert (told.exit_code, told.stderr) == (0, "")
    assert tool("roboscript", "check", "-", input=told.stdout).exit_code == 0
    assert tool("roboscript", "decompile", input=capture.encode().hex()).stdout == told.stdout
    in_json = tool("roboscript", "decompile", "--json", input=capture)
    assert json.loads(in_json.stdout) == {"script": told.stdout, "problems": []}


def test_what_is_wrong_with_a_capture_goes_to_stderr(tool: Run) -> None:
    told = tool("roboscript", "decompile", input="r0103Z0001D0064W01F4")
    assert told.exit_code == 1
    assert told.stdout.endswith("drive 100\nwait 500\n")
    assert told.stderr == "standard input: its end, Z0000, is missing\n"
    assert tool("roboscript", "decompile", "--json", input="").exit_code == 1


def test_the_help_names_every_action(tool: Run) -> None:
    shown = tool("roboscript", "--help").output
    for version in ("2012", "2013"):
        for name in vocabulary(version).forms:
            assert re.search(rf"\b{name}\b", shown), name

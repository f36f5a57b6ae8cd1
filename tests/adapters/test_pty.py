"""The pty adapter: what every adapter promises, and the coming and going of the programs that open it."""

import asyncio
import fcntl
import grp
import os
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from adapter_contract import FRAME, PATIENCE_S, AdapterContract, FarEnd, Recorder, open_descriptors

from psiu_adapters import pty as pty_module
from psiu_adapters.openings import Openings
from psiu_adapters.pty import Pty
from psiu_broker.adapter import Adapter, Transport
from psiu_broker.errors import LinkBusy, LinkError, LinkLost

TIOCGEXCL = 0x80045440


class Program(FarEnd):
    """A program that opens the port by its name."""

    def __init__(self, path: Path, **options: object) -> None:
        self.adapter = Pty(path=str(path), **options)
        self.path = path
        # One number for its whole life, so that tests which count descriptors see it before and after.
        self.fd = os.open("/dev/null", os.O_RDWR)

    def meet(self, transport: Transport) -> None:
        self.come()

    def come(self) -> None:
        port = os.open(self.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        os.dup2(port, self.fd, inheritable=False)
        os.close(port)

    def go(self) -> None:
        nothing = os.open("/dev/null", os.O_RDWR)
        os.dup2(nothing, self.fd, inheritable=False)
        os.close(nothing)

    def end(self) -> None:
        os.close(self.fd)

    async def say(self, data: bytes) -> None:
        assert os.write(self.fd, data) == len(data)

    async def heard(self, size: int) -> bytes:
        data = b""
        async with asyncio.timeout(PATIENCE_S):
            while len(data) < size:
                try:
                    data += os.read(self.fd, size - len(data)) or pytest.fail("hung up")
                except BlockingIOError:
                    await asyncio.sleep(0.001)
        return data

    async def vanish(self) -> None:
        self.go()


@pytest.fixture
def far(tmp_path: Path) -> Iterator[Program]:
    program = Program(tmp_path / "board")
    yield program
    program.end()


async def opened(far: Program, recorder: Recorder) -> Transport:
    """The transport once it knows of the program, whose coming is taken for told."""
    transport = await far.adapter.open(recorder)
    far.come()
    await recorder.until(lambda: recorder.heard)
    assert recorder.heard == [(b"", None)]
    recorder.heard.clear()
    return transport


class TestContract(AdapterContract):
    losable = False

    @pytest.fixture
    def far(self, far: Program) -> Program:
        return far

    @pytest.fixture
    def absent(self, tmp_path: Path) -> Adapter:
        return Pty(path=str(tmp_path / "nothing" / "board"))

    async def open(self, far: FarEnd, recorder: Recorder) -> Transport:
        assert isinstance(far, Program)
        transport = await opened(far, recorder)
        far.meet(transport)
        return transport


class TestContractWithoutInotify(TestContract):
    @pytest.fixture(autouse=True)
    def _no_inotify(self, monkeypatch: pytest.MonkeyPatch, recwarn: pytest.WarningsRecorder) -> None:
        def none(_self: Openings) -> None:
            raise OSError(24, "Too many open files")

        monkeypatch.setattr(Openings, "__init__", none)
        monkeypatch.setattr(pty_module, "LOOK_S", 0.005)


class TestComingAndGoing:
    async def test_a_program_that_only_opens_the_port_is_told_of_before_it_says_anything(
        self, far: Program, recorder: Recorder
    ) -> None:
        transport = await far.adapter.open(recorder)
        await asyncio.sleep(0.05)
        assert recorder.heard == []
        assert tuple(transport.peers) == ()
        far.come()
        await recorder.until(lambda: recorder.heard)
        assert recorder.heard == [(b"", None)]
        assert tuple(transport.peers) == (None,)
        await transport.close()

    async def test_a_program_that_leaves_is_lost_and_the_link_is_not(self, far: Program, recorder: Recorder) -> None:
        transport = await opened(far, recorder)
        await far.say(b"half a fra")
        far.go()
        await recorder.until(lambda: recorder.gone)
        assert recorder.data == b"half a fra"
        assert recorder.gone == [None]
        assert recorder.losses == []
        assert tuple(transport.peers) == ()
        assert transport.write(b"to nobody", None) is True
        await transport.close()

    async def test_the_next_program_finds_the_same_name_and_nothing_of_the_one_before(
        self, far: Program, recorder: Recorder
    ) -> None:
        transport = await opened(far, recorder)
        settings = termios.tcgetattr(far.fd)
        settings[3] |= termios.ECHO | termios.ICANON
        termios.tcsetattr(far.fd, termios.TCSANOW, settings)
        assert transport.write(b"never read", None) is True
        far.go()
        await recorder.until(lambda: recorder.gone)
        recorder.heard.clear()  # the echo
        far.come()
        await recorder.until(lambda: recorder.heard)
        assert not termios.tcgetattr(far.fd)[3] & (termios.ECHO | termios.ICANON)
        assert transport.write(FRAME, None) is True
        assert await far.heard(len(FRAME)) == FRAME
        await asyncio.sleep(0.02)
        assert recorder.data == b"", "an echo"
        await transport.close()

    async def test_a_program_that_locked_and_stopped_the_port_keeps_nobody_out_once_it_has_left(
        self, far: Program, recorder: Recorder
    ) -> None:
        transport = await opened(far, recorder)
        fcntl.ioctl(far.fd, termios.TIOCEXCL)
        termios.tcflow(far.fd, termios.TCOOFF)
        far.go()
        await recorder.until(lambda: recorder.gone)
        far.come()
        await recorder.until(lambda: recorder.heard)
        assert fcntl.ioctl(far.fd, TIOCGEXCL, bytes(4)) == bytes(4)
        assert transport.write(FRAME, None) is True
        assert await far.heard(len(FRAME)) == FRAME
        await far.say(b"and back")
        await recorder.until(lambda: recorder.data == b"and back")
        await transport.close()

    async def test_a_program_gone_before_anybody_looked_is_told_of_with_all_it_said(
        self, far: Program, recorder: Recorder
    ) -> None:
        transport = await far.adapter.open(recorder)
        far.come()
        await far.say(b"hello and goodbye")
        far.go()
        await recorder.until(lambda: recorder.gone)
        assert recorder.heard == [(b"", None), (b"hello and goodbye", None)]
        await transport.close()

    async def test_programs_in_quick_succession_are_told_apart(self, far: Program, recorder: Recorder) -> None:
        transport = await opened(far, recorder)
        for _ in range(20):
            far.go()
            far.come()
            await recorder.until(lambda: recorder.heard)
            recorder.heard.clear()
            assert transport.write(b"welcome", None) is True
            assert await far.heard(7) == b"welcome"
        assert recorder.gone == [None] * 20
        assert recorder.losses == []
        await transport.close()

    async def test_a_second_opening_of_the_port_is_no_new_program(self, far: Program, recorder: Recorder) -> None:
        transport = await opened(far, recorder)
        for _ in range(3):
            os.close(os.open(far.path, os.O_RDWR | os.O_NOCTTY))
            await asyncio.sleep(0.01)
        assert recorder.gone == []
        await far.say(b"still here")
        await recorder.until(lambda: recorder.data == b"still here")
        assert recorder.heard == [(b"still here", None)]
        await transport.close()

    async def test_nothing_is_spent_while_nobody_has_it_open(self, far: Program, recorder: Recorder) -> None:
        transport = await opened(far, recorder)
        far.go()
        await recorder.until(lambda: recorder.gone)
        before = time.process_time()
        await asyncio.sleep(0.3)
        assert time.process_time() - before < 0.15
        await transport.close()

    async def test_programs_without_number_leave_no_descriptor(self, far: Program, recorder: Recorder) -> None:
        transport = await opened(far, recorder)
        before = len(open_descriptors())
        for number in range(1, 50):
            far.go()
            await recorder.until(lambda number=number: len(recorder.gone) == number)  # type: ignore[misc]
            far.come()
            await recorder.until(lambda: recorder.heard)
            recorder.heard.clear()
        assert len(open_descriptors()) == before
        await transport.close()

    async def test_a_frame_cut_by_a_program_that_left_is_not_finished_for_the_next(
        self, far: Program, recorder: Recorder
    ) -> None:
        transport = await opened(far, recorder)
        assert transport.write(bytes(1 << 20), None) is True
        assert transport.write(b"refused", None) is False
        far.go()
        await recorder.until(lambda: recorder.gone)
        far.come()
        await recorder.until(lambda: recorder.heard)
        assert transport.write(FRAME, None) is True
        assert await far.heard(len(FRAME)) == FRAME
        await transport.close()

    async def test_closing_hangs_up_on_the_program_as_pulling_a_plug_would(
        self, far: Program, recorder: Recorder
    ) -> None:
        transport = await opened(far, recorder)
        await transport.close()
        with pytest.raises(OSError, match="Input/output"):
            os.write(far.fd, b"anybody there?")
        assert not far.path.is_symlink()

    async def test_a_program_is_another_process_and_needs_no_library_of_ours(
        self, far: Program, recorder: Recorder
    ) -> None:
        transport = await far.adapter.open(recorder)
        done = await asyncio.to_thread(
            subprocess.run,
            [sys.executable, "-c", f"open({str(far.path)!r}, 'wb', buffering=0).write(b'from outside')"],
            check=True,
        )
        assert done.returncode == 0
        await recorder.until(lambda: recorder.gone)
        assert recorder.data == b"from outside"
        await transport.close()


class TestName:
    async def test_the_name_of_another_pseudo_terminal_is_taken_over(self, far: Program, recorder: Recorder) -> None:
        far.path.symlink_to("/dev/pts/987654")
        transport = await opened(far, recorder)
        assert str(far.path.readlink()) == transport.status()["device"]
        await transport.close()

    @pytest.mark.parametrize("what", ["file", "directory", "link"])
    async def test_anything_else_of_that_name_is_left_alone(self, far: Program, recorder: Recorder, what: str) -> None:
        if what == "file":
            far.path.write_text("precious")
        elif what == "directory":
            far.path.mkdir()
        else:
            far.path.symlink_to("/dev/ttyUSB0")
        before = far.path.lstat()[:7]
        with pytest.raises(LinkBusy, match="remove it or choose another name"):
            await far.adapter.open(recorder)
        assert far.path.lstat()[:7] == before
        assert list(far.path.parent.iterdir()) == [far.path]

    async def test_a_name_that_somebody_took_over_is_left_to_them(self, far: Program, recorder: Recorder) -> None:
        transport = await opened(far, recorder)
        far.path.unlink()
        far.path.symlink_to("/dev/pts/987654")
        await transport.close()
        assert str(far.path.readlink()) == "/dev/pts/987654"

    async def test_a_name_that_cannot_be_given_again_loses_the_link(self, far: Program, recorder: Recorder) -> None:
        transport = await opened(far, recorder)
        far.path.unlink()
        far.path.write_text("precious")
        far.go()
        await recorder.until(lambda: recorder.losses)
        assert isinstance(recorder.losses[0], LinkLost)
        assert recorder.gone == [None]
        await transport.close()
        assert far.path.read_text() == "precious"

    async def test_room_made_for_the_name_is_worth_another_try(
        self, far: Program, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(pty_module, "POLL_S", 0.01)
        far.path.write_text("in the way")
        waiting = asyncio.create_task(far.adapter.changed())
        await asyncio.sleep(0.03)
        assert not waiting.done()
        far.path.unlink()
        async with asyncio.timeout(PATIENCE_S):
            await waiting

    @pytest.mark.parametrize("path", ["board", "", "/", "/run/board/"])
    def test_a_name_that_is_none_is_refused(self, path: str) -> None:
        with pytest.raises(ValueError, match="path"):
            Pty(path=path)


class TestRights:
    async def test_it_is_for_its_own_user_alone_unless_told(self, far: Program, recorder: Recorder) -> None:
        transport = await far.adapter.open(recorder)
        assert far.path.stat().st_mode & 0o777 == 0o600
        await transport.close()

    async def test_it_can_be_given_to_a_group_and_so_can_those_that_follow(
        self, tmp_path: Path, recorder: Recorder
    ) -> None:
        group = grp.getgrgid(os.getgroups()[-1] if os.getgroups() else os.getgid())
        far = Program(tmp_path / "board", group=group.gr_name)
        transport = await opened(far, recorder)
        assert (far.path.stat().st_mode & 0o777, far.path.stat().st_gid) == (0o660, group.gr_gid)
        far.go()
        await recorder.until(lambda: recorder.gone)
        assert (far.path.stat().st_mode & 0o777, far.path.stat().st_gid) == (0o660, group.gr_gid)
        await transport.close()
        far.end()

    async def test_the_rights_can_be_chosen(self, tmp_path: Path, recorder: Recorder) -> None:
        transport = await Pty(path=str(tmp_path / "board"), mode="0640").open(recorder)
        assert (tmp_path / "board").stat().st_mode & 0o777 == 0o640
        await transport.close()

    async def test_a_group_that_does_not_exist_is_named(self, tmp_path: Path, recorder: Recorder) -> None:
        with pytest.raises(LinkError, match="this computer has no group robotics-club"):
            await Pty(path=str(tmp_path / "board"), group="robotics-club").open(recorder)

    @pytest.mark.parametrize("mode", ["0999", "rw", "7777", 0o600])
    def test_rights_that_are_none_are_refused(self, tmp_path: Path, mode: object) -> None:
        with pytest.raises(ValueError, match="mode"):
            Pty(path=str(tmp_path / "board"), mode=mode)

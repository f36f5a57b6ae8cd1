"""The serial adapter on ptys: what every adapter promises, and what unplugging does."""

import asyncio
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from adapter_contract import FRAME, PATIENCE_S, AdapterContract, Recorder, open_descriptors
from pty_robot import Pty

from psiu_adapters import hotplug
from psiu_adapters.serial import Serial
from psiu_broker.adapter import Adapter


class TestContract(AdapterContract):
    @pytest.fixture(autouse=True)
    def _libudev_was_found(self) -> None:
        """Once in a process, by other processes whose pipes would be taken for descriptors left behind."""
        hotplug._udev()

    @pytest.fixture
    def far(self, pty: Pty) -> Pty:
        return pty

    @pytest.fixture
    def absent(self, tmp_path: Path) -> Adapter:
        return Serial(device=str(tmp_path / "nothing"))


class TestContractPaced(TestContract):
    @pytest.fixture
    def far(self, tmp_path: Path) -> Iterator[Pty]:
        far = Pty(tmp_path / "paced", pace=True, baudrate=1_000_000)
        yield far
        far.unplug()


class TestUnplugging:
    async def test_a_frame_that_was_cut_by_unplugging_does_not_leave_after_the_return(
        self, pty: Pty, recorder: Recorder
    ) -> None:
        transport = await pty.adapter.open(recorder)
        big = bytes(64) * 512
        assert transport.write(big, None) is True
        assert transport.write(b"refused", None) is False
        pty.unplug()
        await recorder.until(lambda: recorder.losses)
        await transport.close()
        pty.plug_in()
        again = await pty.adapter.open(recorder)
        assert again.write(FRAME, None) is True
        assert await pty.heard(len(FRAME)) == FRAME
        await again.close()
        with pytest.raises(OSError, match=r"Input/output|Resource temporarily"):
            os.read(pty.master, 1)

    async def test_the_loss_names_the_device(self, pty: Pty, recorder: Recorder) -> None:
        transport = await pty.adapter.open(recorder)
        pty.unplug()
        await recorder.until(lambda: recorder.losses)
        assert str(recorder.losses[0]) == f"{pty.link}: gone (unplugged or disconnected)"
        await transport.close()

    async def test_bytes_that_came_before_the_loss_are_received(self, pty: Pty, recorder: Recorder) -> None:
        transport = await pty.adapter.open(recorder)
        await pty.say(b"[BASE ROBO 007 oi")
        await recorder.until(lambda: recorder.data)
        pty.unplug()
        await recorder.until(lambda: recorder.losses)
        assert recorder.data == b"[BASE ROBO 007 oi"
        await transport.close()

    async def test_unplugging_while_a_close_waits_for_a_slow_robot_ends_it(self, pty: Pty, recorder: Recorder) -> None:
        before = open_descriptors()
        transport = await pty.adapter.open(recorder)
        assert transport.write(bytes(64) * 512, None) is True
        closing = asyncio.create_task(transport.close())
        await asyncio.sleep(0)
        pty.unplug()
        async with asyncio.timeout(PATIENCE_S):
            await closing
        assert recorder.losses == []
        assert len(open_descriptors()) == len(before) - 1

    async def test_a_wake_up_for_nothing_does_not_look_like_unplugging(self, pty: Pty, recorder: Recorder) -> None:
        transport = await pty.adapter.open(recorder)
        # As when another program was quicker to read what had come.
        transport._read()  # type: ignore[attr-defined]
        await pty.say(b"still here")
        await recorder.until(lambda: recorder.data == b"still here")
        assert recorder.losses == []
        await transport.close()

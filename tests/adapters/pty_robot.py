"""A robot on a pty: closing the master looks to the kernel like pulling the plug."""

import asyncio
import os
import tty
from pathlib import Path

from adapter_contract import PATIENCE_S, FarEnd

from psiu_adapters.serial import Serial


class Pty(FarEnd):
    """A robot on a pty, plugged in at `link` as a by-id name is."""

    def __init__(self, link: Path, **options: object) -> None:
        self.link = link
        self.plug_in()
        self.adapter = Serial(device=str(link), **{"pace": False, **options})  # type: ignore[arg-type]

    def plug_in(self) -> None:
        self.master, slave = os.openpty()
        tty.setraw(slave)
        self.link.symlink_to(os.ttyname(slave))
        os.close(slave)
        os.set_blocking(self.master, False)

    def unplug(self) -> None:
        if self.master >= 0:
            os.close(self.master)
            self.master = -1
            self.link.unlink()

    async def say(self, data: bytes) -> None:
        assert os.write(self.master, data) == len(data)

    async def heard(self, size: int) -> bytes:
        loop = asyncio.get_running_loop()
        data = b""
        async with asyncio.timeout(PATIENCE_S):
            while len(data) < size:
                ready = asyncio.Event()
                loop.add_reader(self.master, ready.set)
                try:
                    await ready.wait()
                finally:
                    loop.remove_reader(self.master)
                data += os.read(self.master, size - len(data))
        return data

    async def vanish(self) -> None:
        self.unplug()

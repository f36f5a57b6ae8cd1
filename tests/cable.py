"""A serial cable between two programs: two ptys joined crosswise, which can be cut, made deaf, and mended."""

import asyncio
import os
import tty
from contextlib import suppress
from pathlib import Path
from typing import Final

READ_BYTES: Final = 4096


class Cable:
    """Its `ends` are what the programs open, the same names for as long as it lives."""

    def __init__(self, folder: Path, name: str) -> None:
        self.name = name
        self.ends = (folder / f"{name}.0", folder / f"{name}.1")
        self.carried: list[tuple[int, bytes]] = []
        """What was read at which end, swallowed or not."""
        self.deaf = False
        """Bytes are swallowed, as by a radio out of range; the ports stay open."""
        self._masters: list[int] = []
        self._slaves: list[int] = []

    def plug(self) -> None:
        """Lay the cable (again)."""
        self.deaf = False
        loop = asyncio.get_running_loop()
        for side, end in enumerate(self.ends):
            master, slave = os.openpty()
            tty.setraw(slave)
            os.set_blocking(master, False)
            self._masters.append(master)
            # Open on our side too: else the master is at end of file until somebody opens the other.
            self._slaves.append(slave)
            end.symlink_to(os.ttyname(slave))
            loop.add_reader(master, self._read, side)

    def cut(self) -> None:
        """Take the ports away at both ends; harmless twice."""
        for end, master, slave in zip(self.ends, self._masters, self._slaves, strict=False):
            asyncio.get_running_loop().remove_reader(master)
            end.unlink()
            os.close(master)
            os.close(slave)
        self._masters.clear()
        self._slaves.clear()

    def count(self, data: bytes) -> int:
        """How often `data` went over the cable, both ways together."""
        return sum(b"".join(part for end, part in self.carried if end == side).count(data) for side in (0, 1))

    def _read(self, side: int) -> None:
        data = os.read(self._masters[side], READ_BYTES)
        self.carried.append((side, data))
        if not self.deaf:
            self._put(1 - side, data)

    def _put(self, side: int, data: bytes) -> None:
        with suppress(BlockingIOError):  # nobody reads there and the buffer is full: a line overruns too
            os.write(self._masters[side], data)

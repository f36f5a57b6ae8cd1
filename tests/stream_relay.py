"""A stream between two programs that both dial, which can be cut and restored."""

import asyncio
from types import TracebackType
from typing import Self

Ends = tuple[asyncio.StreamReader, asyncio.StreamWriter]


class Relay:
    """Listens at two `ports` on loopback and joins who calls the one with who calls the other."""

    def __init__(self) -> None:
        self.ports: list[int] = [0, 0]
        self.joined = 0
        """How often two were joined."""
        self.carried = 0
        """Bytes, both ways."""
        self.cut_at: int | None = None
        """Cut when so many have been carried, to the byte."""
        self._servers: list[asyncio.Server] = []
        self._ends: list[Ends | None] = [None, None]
        self._tasks: set[asyncio.Task[None]] = set()

    async def __aenter__(self) -> Self:
        await self.restore()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.cut()
        if self._tasks:
            await asyncio.wait(self._tasks)

    @property
    def serving(self) -> bool:
        """Whether it takes calls."""
        return bool(self._servers)

    async def restore(self) -> None:
        """Take calls (again)."""
        self.cut_at = None
        for side in (0, 1):
            server = await asyncio.start_server(
                lambda reader, writer, side=side: self._came(side, (reader, writer)),  # type: ignore[misc]
                "127.0.0.1",
                self.ports[side],
            )
            self.ports[side] = server.sockets[0].getsockname()[1]
            self._servers.append(server)

    def cut(self) -> None:
        """Hang up at both ends, and take no more calls."""
        for server in self._servers:
            server.close()
        self._servers.clear()
        for side in (0, 1):
            self._hang_up(side)

    def _came(self, side: int, ends: Ends) -> None:
        self._hang_up(side)
        self._ends[side] = ends
        one, other = self._ends
        if one is not None and other is not None:
            self.joined += 1
            for reader, writer in ((one[0], other[1]), (other[0], one[1])):
                task = asyncio.ensure_future(self._pump(reader, writer))
                self._tasks.add(task)
                task.add_done_callback(self._tasks.discard)

    async def _pump(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while data := await reader.read(4096):
                if self.cut_at is not None and self.carried + len(data) >= self.cut_at:
                    writer.write(data[: self.cut_at - self.carried])
                    self.cut()
                    return
                self.carried += len(data)
                writer.write(data)
                await writer.drain()
        except OSError:
            pass
        finally:
            for side in (0, 1):
                ends = self._ends[side]
                if ends is not None and (ends[0] is reader or ends[1] is writer):
                    self._hang_up(side)

    def _hang_up(self, side: int) -> None:
        ends, self._ends[side] = self._ends[side], None
        if ends is not None:
            ends[1].close()

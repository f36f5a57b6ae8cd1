"""A TCP connection in a process of its own: python -m tests.system.wire LISTEN CONNECT, two ports of this computer.

While the process is stopped (SIGSTOP), the wire is cut: nothing passes, and nobody is told.
"""

import asyncio
import sys


async def main(listen: int, connect: int) -> None:
    async def came(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        far_reader, far_writer = await asyncio.open_connection("127.0.0.1", connect)
        await asyncio.gather(_pump(reader, far_writer), _pump(far_reader, writer))

    async with await asyncio.start_server(came, "127.0.0.1", listen) as server:
        print("laid", flush=True)
        await server.serve_forever()


async def _pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    while data := await reader.read(65_536):
        writer.write(data)
        await writer.drain()
    writer.close()


asyncio.run(main(*map(int, sys.argv[1:])))

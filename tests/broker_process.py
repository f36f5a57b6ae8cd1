"""Brokers in processes of their own, asked over their own buses."""

import asyncio
import contextlib
import json
import os
import signal
import sys
import tempfile
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import zenoh
from ports import free_port

CONFIGURATION = """
[broker]
name = "{name}"
[zenoh]
listen = ["tcp/127.0.0.1:{port}"]
"""


class BrokerProcess:
    """A broker in a process of its own, with `more` than the usual in its configuration."""

    def __init__(self, folder: Path, name: str, more: str) -> None:
        self.name = name
        self.port = free_port()
        self.file = folder / f"{name}.toml"
        self.file.write_text(CONFIGURATION.format(name=name, port=self.port) + more)

    @contextlib.asynccontextmanager
    async def running(self, **environment: str) -> AsyncIterator[asyncio.subprocess.Process]:
        """Ends as told, unless the test has killed it."""
        command = (str(Path(sys.executable).parent / "psiu-broker"), "run", "--config", str(self.file))
        with tempfile.TemporaryDirectory(prefix="psiu-") as temporary:
            process = await asyncio.create_subprocess_exec(
                *command, env={**os.environ, "TMPDIR": temporary, **environment}, stderr=asyncio.subprocess.PIPE
            )
            assert process.stderr is not None
            try:
                async with asyncio.timeout(20):
                    while b"is ready" not in await process.stderr.readline():
                        pass
                yield process
            finally:
                # Not process.terminate(), which may notice before asyncio that it has died; how would be lost then.
                if process.returncode is None:
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(process.pid, signal.SIGTERM)
                await process.communicate()
            assert process.returncode in (0, -signal.SIGKILL)
            assert process.returncode or os.listdir(temporary) == [], "it leaves nothing behind"  # noqa: PTH208

    async def asked(self, what: str) -> dict[str, Any]:
        """What the brokers that a program at this one reaches say, by their names."""
        return await asyncio.to_thread(self._asked, what)

    async def until(self, what: str, expected: dict[str, Any]) -> None:
        """Ask until each broker in `expected`, and no other, says at least that."""
        found: dict[str, Any] = {}
        async with asyncio.timeout(15):
            while not (
                found.keys() == expected.keys() and all(found[name].items() >= expected[name].items() for name in found)
            ):
                await asyncio.sleep(0.05)
                found = await self.asked(what)

    def _asked(self, what: str) -> dict[str, Any]:
        config = {
            "mode": "client",
            "connect": {"endpoints": [f"tcp/127.0.0.1:{self.port}"], "timeout_ms": 5000, "exit_on_failure": True},
            "scouting": {"multicast": {"enabled": False}},
        }
        with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
            replies = session.get(f"psiu/@broker/*/{what}", target=zenoh.QueryTarget.ALL, timeout=2)
            found = {str(reply.ok.key_expr).split("/")[2]: reply.ok.payload.to_bytes() for reply in replies if reply.ok}
        answers = {name: json.loads(payload) for name, payload in found.items()}
        return {name: answer[0] if isinstance(answer, list) else answer for name, answer in answers.items()}

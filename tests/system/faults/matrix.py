"""What may befall a link, and the links that it may befall.

Each row is a coroutine that has its trouble come and go, and returns when it went, by the clock of `time.monotonic`.
It shows on its way that the trouble was there.
"""

import asyncio
import contextlib
import os
import random
import resource
import signal
import time
from collections.abc import Awaitable, Callable
from typing import Final, NamedTuple

from mocked_bluez import PAIRED, Bluetooth
from system.faults.ends import ENDS, QUESTION, Kind, at_another_rate
from system.faults.lab import Base, Lab, SteppedClock, fill

from psiu_broker.messages import CallRequest
from psiu_broker.simulator import Faults

HALF: Final = b"base 041 parafrente suc"
HOUR_S: Final = 3600.0
KINDS: Final[tuple[Kind, ...]] = tuple(ENDS)
DATAGRAM: Final = 256


class Trouble(NamedTuple):
    lab: Lab
    bluetooth: Bluetooth | None
    """Where the link is by Bluetooth."""
    clock: SteppedClock | None

    async def is_waiting(self) -> bool:
        return (await self.lab.link())["state"] in ("waiting", "opening")


async def absent_at_start(trouble: Trouble) -> float:
    await asyncio.sleep(1.0)
    if not isinstance(trouble.lab.end, ENDS["udp"]):
        assert await trouble.is_waiting()
    await trouble.lab.end.open()
    return time.monotonic()


async def vanishes_mid_frame(trouble: Trouble) -> float:
    """Half a frame has arrived: behind a whole one, which is seen."""
    end, lab = trouble.lab.end, trouble.lab
    before = (await lab.link())["frames_in"]
    end.say(end.robot.say("base", QUESTION, 1) + HALF)

    async def read() -> bool:
        return (await lab.link())["frames_in"] > before

    await lab.until(read)
    end.unplug()
    await asyncio.sleep(1.0)
    if not isinstance(end, ENDS["udp"]):
        assert await trouble.is_waiting()
    end.plug()
    return time.monotonic()


async def comes_back_elsewhere(trouble: Trouble) -> float:
    trouble.lab.end.move()
    return time.monotonic()


async def writer_stuck(trouble: Trouble) -> float:
    """More is sent than the kernel takes, until the oldest of it is too old."""
    end, base = trouble.lab.end, trouble.lab.base
    end.freeze()
    request = CallRequest(parameters=["x" * 200])
    for _ in range(40):
        for _ in range(10):
            await asyncio.to_thread(base.client.put_call, "MNERIM", "diga", request)
        await asyncio.sleep(0.02)

    async def dropped() -> bool:
        (own,) = (each for each in (await base.ask("ledger"))["accounts"] if each["link"] == "@self")
        return sum(own["dropped"].get(reason, 0) for reason in ("expired", "queue_full")) > 0

    await trouble.lab.until(dropped)
    end.thaw()
    return time.monotonic()


async def garbage_flood(trouble: Trouble) -> float:
    luck, end = random.Random(1), trouble.lab.end
    until = time.monotonic() + 2.0
    while time.monotonic() < until:
        for _ in range(8):
            end.say(luck.randbytes(DATAGRAM))
        await asyncio.sleep(0)
    assert (await trouble.lab.link())["malformed"] > 100
    return time.monotonic()


async def wrong_baud(trouble: Trouble) -> float:
    end, lab = trouble.lab.end, trouble.lab
    end.wrong = at_another_rate
    for turn in range(100):
        if turn == 50:  # what was on its way has arrived
            before = await lab.link()
        end.send(end.robot.say("base", QUESTION, turn))
        await asyncio.sleep(0.02)
    link = await lab.link()
    assert link["frames_in"] == before["frames_in"], "nothing is understood"
    assert link["malformed"] > before["malformed"]
    end.wrong = None
    return time.monotonic()


async def flaps(trouble: Trouble) -> float:
    """Ten times a second, for three seconds."""
    end, lab = trouble.lab.end, trouble.lab
    before = (await lab.link())["reopened"]
    for _ in range(30):
        end.unplug()
        await asyncio.sleep(0.05)
        end.plug()
        await asyncio.sleep(0.05)
    over = time.monotonic()

    async def opened_again() -> bool:
        return (await lab.link())["reopened"] > before

    if not isinstance(end, ENDS["udp"]):
        await lab.until(opened_again)
    return over


async def one_byte_at_a_time(trouble: Trouble) -> float:
    """It never stops: what is measured is one answer in such pieces."""
    assert trouble.lab.end.longest_piece == 1
    return time.monotonic()


async def clock_steps(trouble: Trouble) -> float:
    assert trouble.clock is not None
    base = trouble.lab.base

    async def uptime_s() -> float:
        return float((await base.ask("status"))["uptime_s"])

    before = await uptime_s()
    for to_s in (HOUR_S, -HOUR_S, 0.0):
        trouble.clock.step(to_s)
        assert abs(await uptime_s() - before - to_s) < HOUR_S / 10, "the step is seen"
        began = time.monotonic()
        await base.answered()
    return began


async def disk_full(trouble: Trouble) -> float:
    """The log and all temporary files are on a file system of 64 kB; the link goes and comes while that is full."""
    lab = trouble.lab
    rest = lab.base.log.parent / "rest"
    fill(rest)
    for _ in range(3):
        lab.end.unplug()
        await asyncio.sleep(0.5)
        lab.end.plug()
        await asyncio.sleep(0.5)
    assert os.statvfs(rest).f_bavail == 0
    rest.unlink()
    return time.monotonic()


async def dbus_restarts(trouble: Trouble) -> float:
    """And bluetoothd with it; the robot is gone meanwhile, so that the broker has to call it anew."""
    bluetooth, end = trouble.bluetooth, trouble.lab.end
    assert bluetooth is not None
    await bluetooth.end()
    end.unplug()
    await trouble.lab.until(trouble.is_waiting)
    end.plug()
    await bluetooth.again()
    await bluetooth.start(known=PAIRED)
    return time.monotonic()


async def zenoh_peer_restarts(trouble: Trouble) -> float:
    """Another broker is killed and started anew; what is measured is a call by it, from the start of its process on."""
    lab = trouble.lab
    peer = Base(lab.folder, "peer", "", f'connect = ["tcp/127.0.0.1:{lab.base.port}"]')
    await peer.start()
    await peer.answered()
    await peer.stop(signal.SIGKILL)
    began = time.monotonic()
    await peer.start()
    try:
        await peer.answered()
        trouble.lab.recovered_s = time.monotonic() - began
    finally:
        assert await peer.stop() == 0
    return began


async def stands_still(trouble: Trouble) -> float:
    process = trouble.lab.base.process
    process.send_signal(signal.SIGSTOP)
    await asyncio.sleep(5.0)
    process.send_signal(signal.SIGCONT)
    return time.monotonic()


async def no_descriptors(trouble: Trouble) -> float:
    """The link goes while no more file can be opened, and programs knock in vain; a UDP link stays: it opens none."""
    lab = trouble.lab
    pid = lab.base.process.pid
    _, hard = before = resource.prlimit(pid, resource.RLIMIT_NOFILE)
    resource.prlimit(pid, resource.RLIMIT_NOFILE, (3, hard))
    lab.end.unplug()
    await asyncio.sleep(0.5)
    lab.end.plug()
    for _ in range(20):
        with contextlib.suppress(OSError):
            _, writer = await asyncio.open_connection("127.0.0.1", lab.base.port)
            writer.close()
    await asyncio.sleep(2.0)
    if not isinstance(lab.end, ENDS["udp"]):
        assert await trouble.is_waiting()
    resource.prlimit(pid, resource.RLIMIT_NOFILE, before)
    return time.monotonic()


class Row(NamedTuple):
    name: str
    happens: Callable[[Trouble], Awaitable[float]]
    kinds: tuple[Kind, ...] = KINDS
    usual: tuple[Kind, ...] = ()
    """Of `kinds`, those that every run of the tests has."""
    why_not: str = ""
    """Why it cannot befall the others."""
    faults: Faults | None = None


ROWS: Final = (
    Row("absent at start", absent_at_start, usual=("rfcomm",)),
    Row("vanishes mid-frame", vanishes_mid_frame, usual=("serial", "udp")),
    Row("back under another node", comes_back_elsewhere, ("serial", "udp"), ("udp",), "known by its address anywhere"),
    Row("writer stuck", writer_stuck, ("serial", "rfcomm"), ("serial",), "datagrams to who does not read are lost"),
    Row("garbage flood", garbage_flood, usual=("udp",)),
    Row("wrong baud", wrong_baud, ("serial", "rfcomm"), (), "no wire with a rate"),
    Row("flapping at 10 Hz", flaps, usual=("rfcomm",)),
    Row(
        "one byte at a time",
        one_byte_at_a_time,
        ("serial", "rfcomm"),
        ("serial",),
        "a datagram arrives whole",
        Faults(one_byte_at_a_time=True),
    ),
    Row("clock steps ±1 h", clock_steps, usual=("serial",)),
    Row("disk full", disk_full),
    Row("D-Bus restarts", dbus_restarts, ("rfcomm",), (), "no D-Bus"),
    Row("Zenoh peer restarts", zenoh_peer_restarts),
    Row("SIGSTOP for 5 s", stands_still),
    Row("no file descriptors left", no_descriptors, usual=("serial",)),
)

"""What is done to a router: a flood that always has so many frames in flight, and single frames a millisecond apart."""

import time
from collections.abc import Sequence
from typing import NamedTuple

from tests.bench.ends import LEFT, RIGHT, Ends
from tests.bench.frames import BROKER

IN_FLIGHT = 64
GIVEN_UP_S = 1.0
PERIOD_NS = 1_000_000


class Flood(NamedTuple):
    """`lost` never came; `doubled` came more than once."""

    delivered: int
    lost: int
    doubled: int
    seconds: float


def flood(ends: Ends, frames: Sequence[bytes]) -> Flood:
    """Send all `frames`, which differ, at most 64 of them in flight, until all came or nothing comes any more."""
    number = {frame: at for at, frame in enumerate(frames)}
    came = bytearray(len(frames))
    sent = received = doubled = 0
    begun = last = time.perf_counter()
    while received < len(frames):
        room = min(IN_FLIGHT - sent + received, len(frames) - sent)
        if room:
            sent += ends.send(sent, room)
        caught = ends.receive()
        for frame in caught:
            at = number.get(frame)
            if at is None:
                continue
            if came[at]:
                doubled += 1
            else:
                came[at] = 1
                received += 1
        if caught:
            last = time.perf_counter()
        elif time.perf_counter() - last > GIVEN_UP_S:
            break
    return Flood(received, len(frames) - received, doubled, last - begun)


def latencies(ends: Ends, frames: Sequence[bytes]) -> list[float]:
    """How long each of `frames` took, sent one a millisecond, in µs; a lost one is left out."""
    took = []
    due = time.perf_counter_ns()
    for at, frame in enumerate(frames):
        due = max(due + PERIOD_NS, time.perf_counter_ns())
        while time.perf_counter_ns() < due:
            pass
        begun = time.perf_counter_ns()
        ends.send(at, 1)
        while time.perf_counter_ns() - begun < GIVEN_UP_S * 1e9:
            if frame in ends.receive():
                took.append((time.perf_counter_ns() - begun) / 1000)
                break
    return took


def introduce(ends: Ends, side: int, introductions: Sequence[bytes], patience_s: float = 10.0) -> None:
    """Let each robot ask the broker something and hear the answer, so that the broker knows the robot.

    Raises:
        TimeoutError: no answer.
    """
    for introduction in introductions:
        robot = introduction.split(b" ")[-2]
        deadline = time.monotonic() + patience_s
        ends.say(side, introduction)
        while not any(frame.startswith(robot + b" ") for frame in ends.hear(side, 0.05)):
            if time.monotonic() > deadline:
                raise TimeoutError(f"{robot.decode()} asked {BROKER.decode()} and got no answer")


def first_frame(ends: Ends, introductions: tuple[bytes, bytes], frame: bytes, patience_s: float = 30.0) -> None:
    """Knock every millisecond until `frame` gets through.

    Raises:
        TimeoutError: it never does.
    """
    deadline = time.monotonic() + patience_s
    while frame not in ends.hear(RIGHT, 0.001):
        if time.monotonic() > deadline:
            raise TimeoutError("no frame was forwarded")
        ends.say(LEFT, introductions[LEFT])
        ends.say(RIGHT, introductions[RIGHT])
        ends.say(LEFT, frame)


def quiet(ends: Ends, silence_s: float = 0.1) -> None:
    """Read both sides until nothing more comes."""
    while ends.hear(LEFT, silence_s) or ends.hear(RIGHT, silence_s):
        pass

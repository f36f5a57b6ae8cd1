"""The frames of the load: 41 bytes each, all different, from robots on the left to robots on the right."""

from collections.abc import Sequence

BROKER = b"base"


def frame(destination: bytes, message: bytes, source: bytes) -> bytes:
    size = len(destination) + len(message) + len(source) + 12
    body = b"%b %03d %b %b " % (destination, size, message, source)
    return b"%b%05d" % (body, sum(body) & 0xFFFF)


def names(robots: int) -> tuple[list[bytes], list[bytes]]:
    """Half of the robots on the left, half on the right."""
    half = robots // 2
    return [b"P%04d" % number for number in range(half)], [b"R%04d" % number for number in range(half)]


def introductions(robots: Sequence[bytes]) -> list[bytes]:
    """What makes each robot known: a question to the broker, who answers."""
    return [frame(BROKER, b"quantoscomandos", robot) for robot in robots]


def load(robots: int, count: int) -> list[bytes]:
    """`count` commands that go round all pairs of a robot on the left and one on the right."""
    left, right = names(robots)
    return [
        frame(right[number % len(right)], b"parafrente %08d" % number, left[number % len(left)])
        for number in range(count)
    ]

"""What a codec takes for bytes, in time and in memory."""

import time
from collections import deque
from collections.abc import Iterable, Mapping
from typing import Any

from attack.crafted import Craft

from psiu_broker.codecs.codec import Codec, Directory


def cost_us(craft: Craft, size: int, cut: int, tries: int) -> float:
    """CPU time for a byte of a stream of `size` bytes that comes `cut` bytes at a time: the least of `tries`."""
    data = craft.of_size(size)
    pieces = [data[at : at + cut] for at in range(0, size, cut)]
    return min(_took(craft.make(), pieces) for _ in range(tries)) / size * 1e6


def held_bytes(codec: Codec) -> int:
    """Bytes and characters that `codec` holds back from its stream, in whatever it keeps."""
    seen: set[int] = set()
    todo: deque[Any] = deque([vars(codec)])
    total = 0
    while todo:
        value = todo.popleft()
        if id(value) in seen or isinstance(value, (type, Directory)) or callable(value):
            continue
        seen.add(id(value))
        match value:
            case bytes() | bytearray() | str():
                total += len(value)
            case Mapping():
                todo += [*value.keys(), *value.values()]
            case Iterable():
                total += len(list(value))
                todo += list(value)
            case _:
                names = [name for kind in type(value).__mro__ for name in getattr(kind, "__slots__", ())]
                todo += [*getattr(value, "__dict__", {}).values(), *(getattr(value, name, None) for name in names)]
    return total


def _took(codec: Codec, pieces: list[bytes]) -> float:
    begun = time.process_time()
    for piece in pieces:
        codec.decode(piece, 0.0)
    codec.flush(0.0)
    return time.process_time() - begun

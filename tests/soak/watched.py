"""psiu-broker that notes what memory it uses: python watched.py FILE run --config …

The file holds, as text, the bytes `in_use` now.
"""

import ctypes
import os
import sys
import threading
import time
from pathlib import Path
from typing import Any, Final

EVERY_S: Final = 0.5
EXACT: Final = {"PYTHONMALLOC": "malloc", "GLIBC_TUNABLES": "glibc.malloc.tcache_count=0"}
"""Python and Zenoh share one heap then, and no thread keeps for itself what was freed."""
INTERNED: Final = 50_000


class _Heap(ctypes.Structure):
    """What glibc tells of all that it has handed out: see mallinfo2(3)."""

    _fields_ = tuple(
        (name, ctypes.c_size_t)
        for name in ("arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "used", "free", "top")
    )


def in_use() -> int:
    """Bytes that were allocated and not freed, by whomever, in the environment `EXACT`."""
    told: Any = ctypes.CDLL(None).mallinfo2
    told.restype = _Heap
    heap = told()
    return int(heap.used + heap.hblkhd)


def _note(file: Path) -> None:
    with file.open("w") as out:
        while True:
            os.pwrite(out.fileno(), f"{in_use():20}".encode(), 0)
            time.sleep(EVERY_S)


def main() -> None:
    threading.Thread(target=_note, args=(Path(sys.argv.pop(1)),), name="watch", daemon=True).start()

    from psiu_broker.cli.daemon import main as run  # noqa: PLC0415 - watched from the first import on

    # Python's table of interned names takes its final size: it would else grow by 1 MiB at once, some minutes later.
    grown = [sys.intern(f"name {number}") for number in range(INTERNED)]
    del grown
    run()


if __name__ == "__main__":
    main()

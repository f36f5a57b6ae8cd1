"""psiu-broker with a wall clock that the test steps: python stepped_clock.py OFFSET-FILE run --config …

The file holds seconds, as a double; only this program's own reading of the clock is moved by them.
"""

import mmap
import struct
import sys
import time
from pathlib import Path


def main() -> None:
    with Path(sys.argv.pop(1)).open("rb") as file:
        offset = mmap.mmap(file.fileno(), 8, prot=mmap.PROT_READ)
    real = time.time
    time.time = lambda: real() + struct.unpack("d", offset[:8])[0]

    from psiu_broker.cli.daemon import main as run  # noqa: PLC0415 - with the clock that is stepped

    run()


if __name__ == "__main__":
    main()

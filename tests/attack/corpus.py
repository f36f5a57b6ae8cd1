"""The kept inputs of each target, a line of hexadecimal digits each, in ``corpus/TARGET.hex``."""

import sys
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, Final

import psiu_broker

FOLDER: Final = Path(__file__).parent / "corpus"
MOST: Final = 300
ATTACKED: Final = str(Path(psiu_broker.__file__).parent)

Step = tuple[str, int, int]
"""A file, and two of its lines of which one follows the other."""
Feature = tuple[Step, int]
"""A step, and about how often it is taken: once, twice, up to four times, up to eight…"""


def kept(target: str) -> Sequence[bytes]:
    file = FOLDER / f"{target}.hex"
    return [bytes.fromhex(line) for line in file.read_text().splitlines()] if file.exists() else []


def keep(target: str, inputs: Iterable[bytes], tell: Callable[[bytes], None]) -> int:
    """Keep those of `inputs` that take a step in the broker which no shorter one takes so often; how many they are."""
    reached: set[Feature] = set()
    lines: list[str] = []
    for data in sorted(set(inputs), key=lambda data: (len(data), data)):
        features = _features(tell, data)
        if len(lines) < MOST and not features <= reached:
            reached |= features
            lines.append(data.hex())
    FOLDER.mkdir(exist_ok=True)
    (FOLDER / f"{target}.hex").write_text("\n".join(lines) + "\n")
    return len(lines)


def _features(tell: Callable[[bytes], None], data: bytes) -> set[Feature]:
    """What `data` does in the broker's code."""
    steps: Counter[Step] = Counter()

    def enter(frame: FrameType, event: str, argument: Any) -> Any:
        file, last = frame.f_code.co_filename, frame.f_lineno
        if not file.startswith(ATTACKED):
            return None

        def step(frame: FrameType, event: str, argument: Any) -> Any:
            nonlocal last
            steps[file, last, frame.f_lineno] += 1
            last = frame.f_lineno
            return step

        return step

    sys.settrace(enter)
    try:
        tell(data)
    finally:
        sys.settrace(None)
    return {(step, (times - 1).bit_length()) for step, times in steps.items()}

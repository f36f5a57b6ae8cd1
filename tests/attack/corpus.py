"""The kept inputs of each target, a line of hexadecimal digits each, in ``corpus/TARGET.hex``."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

FOLDER: Final = Path(__file__).parent / "corpus"
MOST: Final = 300


def kept(target: str) -> Sequence[bytes]:
    file = FOLDER / f"{target}.hex"
    return [bytes.fromhex(line) for line in file.read_text().splitlines()] if file.exists() else []


def keep(target: str, inputs: Iterable[bytes]) -> None:
    """Keep `inputs` and nothing else; of very many, the shortest."""
    lines = sorted({each.hex() for each in inputs}, key=lambda line: (len(line), line))[:MOST]
    FOLDER.mkdir(exist_ok=True)
    (FOLDER / f"{target}.hex").write_text("\n".join(lines) + "\n")

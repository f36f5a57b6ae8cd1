"""Attack everything that hears strangers, guided by coverage: python -m tests.attack --seconds 60"""

import importlib.util
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import click

sys.path.insert(0, str(Path(__file__).parents[1]))

from attack.corpus import keep, kept
from attack.targets import TARGETS, tell

ROOT: Final = Path(__file__).parents[2]
LONGEST: Final = 2048
"""Bytes of an input: two of the longest frames and some."""
STUCK_S: Final = 300
"""What one input may take at most by the clock, if it is nowhere that its CPU time (`tell`) could be looked at."""
MEMORY_MIB: Final = 1024

_DONE: Final = re.compile(r"Done (\d+) runs in (\d+) second")
_COVERED: Final = re.compile(r"cov: (\d+)")


class _Hex(click.ParamType):
    name = "HEX"

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> bytes:
        try:
            return bytes.fromhex(value)
        except ValueError:
            self.fail(f"{value} is no hexadecimal", param, ctx)


@click.command()
@click.option("--seconds", type=click.IntRange(1), default=60, help="For all targets together; 60 by default.")
@click.option("--keep", "keeping", is_flag=True, help="Keep the inputs that reached something new in the corpus.")
@click.option("--input", "told", type=_Hex(), help="Tell the targets this one input instead; needs no atheris.")
@click.argument("targets", nargs=-1, type=click.Choice(list(TARGETS)))
def main(seconds: int, keeping: bool, told: bytes | None, targets: Sequence[str]) -> None:
    """Attack TARGETS, or all; 1 if an input did what it must not."""
    if told is not None:
        for name in targets or TARGETS:
            tell(name, told)
        return
    if importlib.util.find_spec("atheris") is None:
        raise click.ClickException("atheris is not installed; it is in the extra fuzz, for Python 3.11 to 3.13")
    names = targets or list(TARGETS)
    each_s = max(1, seconds // len(names))
    broken = [name for name in names if not _attack(name, each_s, keeping=keeping)]
    if broken:
        raise click.ClickException(f"broken: {', '.join(broken)}")


def _attack(name: str, seconds: int, *, keeping: bool) -> bool:
    with tempfile.TemporaryDirectory() as made:
        found, known, artifacts = (Path(made) / part for part in ("found", "known", "artifacts"))
        for folder in (found, known, artifacts):
            folder.mkdir()
        for number, data in enumerate(kept(name)):
            (known / f"{number}").write_bytes(data)
        run = _fuzz(
            name, found, known, f"-max_total_time={seconds}", f"-max_len={LONGEST}", f"-timeout={STUCK_S}",
            f"-report_slow_units={STUCK_S}", f"-rss_limit_mb={MEMORY_MIB}", f"-artifact_prefix={artifacts}/",
        )  # fmt: skip
        done, covered = _DONE.search(run.stderr), _COVERED.findall(run.stderr)
        if run.returncode or done is None:
            print(run.stdout, run.stderr, sep="\n")
            if not any(artifacts.iterdir()):
                print(f"{name}: no input did it; libFuzzer ended by itself or was ended, with {run.returncode}")
            for artifact in artifacts.iterdir():
                data = artifact.read_bytes().hex()
                print(f"{name}: {artifact.name.partition('-')[0]} by this input; tell it again with")
                print(f"  python -m tests.attack --input '{data}' {name}", flush=True)
            return False
        new = len(list(found.iterdir()))
        print(
            f"{name:12} {int(done[1]):>10,} inputs in {done[2]:>4} s, {covered[-1]} places reached, {new} inputs new",
            flush=True,
        )
        if keeping:
            inputs = [*kept(name), *(file.read_bytes() for file in found.iterdir())]
            print(f"{name:12} {keep(name, inputs, TARGETS[name]):>10,} inputs kept", flush=True)
        return True


def _fuzz(name: str, *arguments: Path | str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "tests.attack.fuzzer", name, *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, errors="replace", check=False)


if __name__ == "__main__":
    main()

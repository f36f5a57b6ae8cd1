"""One target under atheris: python -m tests.attack.fuzzer TARGET FOLDER, and libFuzzer's own arguments."""

import sys
from functools import partial
from pathlib import Path

import atheris

sys.path.insert(0, str(Path(__file__).parents[1]))

with atheris.instrument_imports(include=["psiu_broker"]):
    from attack.targets import tell

name = sys.argv.pop(1)
atheris.Setup(sys.argv, partial(tell, name))
atheris.Fuzz()

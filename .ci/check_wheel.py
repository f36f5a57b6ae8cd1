"""Fails unless the wheel named on the command line is pure, for any platform, and holds our two packages only."""

import sys
from pathlib import Path
from zipfile import ZipFile

wheel = Path(sys.argv[1])
names = ZipFile(wheel).namelist()
tops = {name.partition("/")[0] for name in names}
packages = {top for top in tops if not top.endswith(".dist-info")}
wrong = [
    *([] if wheel.name.endswith("-py3-none-any.whl") else [f"{wheel.name} is not py3-none-any"]),
    *([] if packages == {"psiu_broker", "psiu_adapters"} else [f"it holds {sorted(packages)}"]),
    *(f"{package}/py.typed is missing" for package in packages if f"{package}/py.typed" not in names),
    *(f"{name} does not belong in it" for name in names if "/test" in f"/{name}" or "__pycache__" in name),
    *([] if any(name.endswith("licenses/LICENSE") for name in names) else ["LICENSE is missing"]),
]
sys.exit("\n".join(wrong) or None)

"""Fails if a package of the lock has a vulnerability that the package index tells of, and says NOT AUDITED of which it
tells nothing, because it keeps no such list or cannot be reached."""

import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

lock = Path(__file__).parent / "lock.txt"
command = [sys.executable, "-m", "pip_audit", "--requirement", lock, "--disable-pip", "--format", "json"]
if find_spec("pip_audit") is None:
    sys.exit("NOT AUDITED: pip-audit is missing; make audit installs it")
audit = subprocess.run(  # noqa: S603 - its words are all written here
    [*command, "--progress-spinner", "off"], capture_output=True, text=True, check=False
)
if audit.returncode not in (0, 1):  # 1: vulnerabilities, or no answer
    sys.exit(f"NOT AUDITED: pip-audit does not take how it is called here\n{audit.stderr[-500:]}")
try:
    packages = json.loads(audit.stdout)["dependencies"]
except (ValueError, KeyError, TypeError):
    print(f"NOT AUDITED: no answer from the package index\n{audit.stderr[-500:]}")
    sys.exit()
told = [package for package in packages if "skip_reason" not in package]
found = [f"{each['name']} {each['version']}: {bad['id']}" for each in told for bad in each["vulns"]]
print(f"{len(told)} of {len(packages)} packages audited, {len(found)} vulnerabilities", *found, sep="\n")
if not told:
    print("NOT AUDITED: the package index tells nothing of vulnerabilities, of no package")
elif untold := [package["name"] for package in packages if "skip_reason" in package]:
    print(f"NOT AUDITED: {', '.join(untold)}")
sys.exit(bool(found))

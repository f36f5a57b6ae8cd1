"""Fails if a package of the lock has a vulnerability that the package index tells of, where it tells of any."""

import json
import subprocess
import sys
from pathlib import Path

lock = Path(__file__).parent / "lock.txt"
command = [sys.executable, "-m", "pip_audit", "--requirement", lock, "--disable-pip", "--format", "json"]
audit = subprocess.run(  # noqa: S603 - its words are all written here
    [*command, "--progress-spinner", "off"], capture_output=True, text=True, check=False
)
try:
    packages = json.loads(audit.stdout)["dependencies"]
except (ValueError, KeyError):
    print(f"no audit: the package index tells of no vulnerabilities here\n{audit.stderr[-500:]}")
    sys.exit()
told = [package for package in packages if "skip_reason" not in package]
found = [f"{each['name']} {each['version']}: {bad['id']}" for each in told for bad in each["vulns"]]
print(f"{len(told)} of {len(packages)} packages could be audited, {len(found)} vulnerabilities", *found, sep="\n")
sys.exit(bool(found))

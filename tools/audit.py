"""Look for known vulnerabilities of what deploy/requirements.lock installs, and name packages that were not looked up.

make audit
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
COMMAND = "-m uv tool run -q --from pip-audit==2.10.1 pip-audit --require-hashes --disable-pip --progress-spinner off"


def verdict(report: dict[str, Any]) -> tuple[bool, list[str]]:
    """Whether a report of pip-audit is good, and what to tell. A package that was skipped was not checked."""
    packages = report["dependencies"]
    skipped = [package["name"] for package in packages if "skip_reason" in package]
    found = [
        f"{package['name']} {package['version']}: {flaw['id']}"
        for package in packages
        for flaw in package.get("vulns", [])
    ]
    if skipped or not packages:
        found.append(f"NOT CHECKED: {len(skipped)} of {len(packages)} packages could not be looked up")
    return not found, found or [f"no known vulnerabilities in {len(packages)} packages"]


def main() -> int:
    """Run pip-audit and tell the verdict; 1 if something is known or could not be looked up."""
    with tempfile.TemporaryDirectory() as folder:
        written = Path(folder) / "report.json"
        command = [
            sys.executable,
            *COMMAND.split(),
            "-r",
            str(ROOT / "deploy" / "requirements.lock"),
            "-f",
            "json",
            "-o",
            str(written),
        ]
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
        if not written.is_file():
            print("NOT CHECKED:", (ended.stderr.strip().splitlines() or ["pip-audit wrote no report"])[-1])
            return 1
        good, lines = verdict(json.loads(written.read_text(encoding="utf-8")))
    print("\n".join(lines))
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())

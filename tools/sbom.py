"""Write a software bill of materials (CycloneDX 1.5 JSON) of what deploy/requirements.lock installs.

make sbom
"""

import json
import re
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
PIN = re.compile(r"^([\w.-]+)==(\S+)", re.MULTILINE)
HASH = re.compile(r"--hash=sha256:([0-9a-f]{64})")


def pins(text: str) -> dict[str, tuple[str, list[str]]]:
    """Version and SHA-256 hashes of each package of a requirements file."""
    parts = re.split(r"^(?=[\w])", text, flags=re.MULTILINE)
    return {match[1]: (match[2], HASH.findall(part)) for part in parts if (match := PIN.match(part))}


def bill(text: str) -> dict[str, object]:
    """The bill of materials of a requirements file. A hash is that of one of the files that may be installed."""
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {"component": {"type": "application", "name": "fcslam"}},
        "components": [
            {
                "type": "library",
                "name": name,
                "version": version,
                "purl": f"pkg:pypi/{name.lower()}@{version}",
                "externalReferences": [
                    {
                        "type": "distribution",
                        "url": f"https://pypi.org/project/{name}/{version}/",
                        "hashes": [{"alg": "SHA-256", "content": digest} for digest in hashes],
                    }
                ],
            }
            for name, (version, hashes) in pins(text).items()
        ],
    }


if __name__ == "__main__":
    json.dump(bill((ROOT / "deploy" / "requirements.lock").read_text(encoding="utf-8")), sys.stdout, indent=1)
    sys.stdout.write("\n")

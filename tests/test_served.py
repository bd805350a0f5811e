"""The short form of benchmarks/served.py: a real recording through a real service is the map of `fcslam map`."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.system
@pytest.mark.skipif("FCSLAM_DATA" not in os.environ, reason="needs the real logs: set FCSLAM_DATA")
def test_a_served_recording_is_a_mapped_one(tmp_path):
    command = [sys.executable, ROOT / "benchmarks" / "served.py", "--recordings", "mit-csail", "--seconds", "0"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    command += ["--results", tmp_path]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    (row,) = json.loads((tmp_path / "served.json").read_text())["tables"]["The same as `fcslam map`"]
    assert row["packets"] > 1000
    assert row["closures"] > 50

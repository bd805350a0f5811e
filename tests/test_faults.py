"""The short form of benchmarks/faults.py: a real server and real robots, and a network that spares nothing."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.system
def test_the_same_map_whatever_happens(tmp_path):
    command = [sys.executable, ROOT / "benchmarks" / "faults.py", "--scenarios", "all at once", "disk full"]
    command += ["--robots", "2", "--path", "25", "--results", tmp_path]
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr

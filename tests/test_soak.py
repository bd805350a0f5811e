"""The short form of benchmarks/soak.py: nothing grows while robots stand, and connections break again and again."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.system
@pytest.mark.attack
def test_nothing_grows_while_robots_stand(tmp_path):
    options = ["--hours", "3", "--minutes", "5", "--robots", "2", "--rate", "2", "--patrol", "0"]
    command = [sys.executable, ROOT / "benchmarks" / "soak.py", *options, "--results", tmp_path]
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    tables = json.loads((tmp_path / "soak_standing.json").read_text())["tables"]
    first, _, last = tables["Hours"]
    assert first["packets"] == last["packets"] > 100
    assert last["connections"] >= first["connections"] + 10
    assert len(tables["Growth of each process"]) == 6

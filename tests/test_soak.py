"""The short form of benchmarks/soak.py: nothing grows while robots stand, and connections break again and again."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from common import figures

ROOT = Path(__file__).parents[1]


@pytest.mark.system
@pytest.mark.attack
def test_nothing_grows_while_robots_stand(tmp_path):
    options = ["--hours", "3", "--minutes", "5", "--robots", "2", "--rate", "2", "--patrol", "0"]
    command = [sys.executable, ROOT / "benchmarks" / "soak.py", *options, "--results", tmp_path]
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    report = tmp_path / "soak_standing.csv"
    first, _, last = ({name: float(value) for name, value in row.items()} for row in figures(report, "Hours"))
    assert first["packets"] == last["packets"] > 100
    assert last["connections"] >= first["connections"] + 10
    assert len(figures(report, "Growth of each process")) == 6

"""Short forms of two benchmarks, with a real server and real robots."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from common import figures

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.system


def run(script, *options):
    command = [sys.executable, ROOT / "benchmarks" / script, *options]
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr


def test_the_same_map_whatever_happens(tmp_path):
    """A network that spares nothing."""
    scenarios = ["--scenarios", "all at once", "disk full"]
    run("faults.py", *scenarios, "--robots", "2", "--path", "8", "--speed", "4", "--results", tmp_path)


@pytest.mark.attack
def test_nothing_grows_while_robots_stand(tmp_path):
    """And connections break again and again."""
    options = ["--hours", "3", "--minutes", "3", "--robots", "2", "--rate", "2", "--patrol", "0"]
    run("soak.py", *options, "--results", tmp_path)
    report = tmp_path / "soak_standing.csv"
    first, _, last = ({name: float(value) for name, value in row.items()} for row in figures(report, "Hours"))
    assert first["packets"] == last["packets"] > 100
    assert last["connections"] >= first["connections"] + 10
    assert len(figures(report, "Growth of each process")) == 6

"""The command line: help with examples, numbers, and one clear line with exit code 2 for bad input."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fcslam import __version__
from fcslam.cli import main
from fcslam.config import load
from fcslam.lab.presets import Preset
from fcslam.mission.mission import MissionConfig
from fcslam.runs import RobotTrajectory, Run


@pytest.fixture
def run_and_relations(tmp_path, monkeypatch):
    """Two robots that stand 1 m apart, one relation that says 1.25 m, one that nothing answers; in an own folder."""
    monkeypatch.chdir(tmp_path)
    trajectories = {
        f"r{k}": RobotTrajectory(f"r{k}", 0, np.array([100.0 * k]), np.array([[float(k), 0.0, 0.0]])) for k in (0, 1)
    }
    Run(trajectories).save(tmp_path / "run")
    (tmp_path / "relations").write_text("0 100 1.25 0 0 0 0 0\n0 999 0 0 0 0 0 0\n")
    return str(tmp_path / "run"), str(tmp_path / "relations")


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"fcslam {__version__}\n"


def test_no_command_is_help(capsys):
    main([])
    shown = capsys.readouterr()
    assert "evaluate" in shown.out + shown.err


def test_config_dump_of_a_preset_is_a_configuration_file(capsys, tmp_path):
    file = tmp_path / "paper.yaml"
    assert main(["tools", "config", "paper"]) == 0
    file.write_text(capsys.readouterr().out)
    assert load(MissionConfig, file) == load(MissionConfig, Preset.PAPER.file)
    assert load(MissionConfig, file) != MissionConfig()


def test_relations_table(run_and_relations, capsys, tmp_path):
    assert main(["evaluate", "relations", *run_and_relations, "--csv", str(tmp_path / "table.csv")]) == 0
    out = capsys.readouterr().out
    assert "0.2500" in out
    assert "1 of 2 relations used" in out
    assert (tmp_path / "table.csv").read_text().startswith("name,value,unit\ntranslation_error_mean,0.25,m\n")
    run, relations = run_and_relations
    assert main(["evaluate", "relations", run, relations, "--across-robots", "--parts", run]) == 0
    assert "1 of 2 relations across robots used" in capsys.readouterr().out


def test_a_full_disk_behind_stdout_is_one_line():
    command = [sys.executable, "-m", "fcslam.cli", "evaluate", "--help"]
    with Path("/dev/full").open("w", encoding="utf-8") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr == "fcslam: standard output cannot be written (No space left on device); make room\n"


def test_a_closed_pipe_behind_stdout_is_silent():
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-m", "fcslam.cli", "--version"]
    done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writing)
    assert (done.returncode, done.stderr) == (1, "")

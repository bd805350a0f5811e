"""Benchmarks are not run by the tests, but they must start: each names its command, imports, and skips politely."""

import ast
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import common
import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"
SHARED = ("common", "convert_logs", "processes")
SCRIPTS = sorted(path for path in FOLDER.glob("*.py") if path.stem not in SHARED)


def load(path: Path):
    """The script as a module of a name that no test folder has."""
    spec = importlib.util.spec_from_file_location(f"benchmark_{path.stem}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_docstring_names_the_command():
    docstrings = {path.name: ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) for path in SCRIPTS}
    assert [name for name, text in docstrings.items() if f"python benchmarks/{name}" not in text] == []


def test_every_script_has_a_report():
    assert [path.name for path in SCRIPTS if not (FOLDER / "results" / f"{path.stem}.md").exists()] == []


@pytest.mark.slow
@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_imports_without_running(path, capsys):
    try:
        script = load(path)
    except ModuleNotFoundError as error:
        if error.name not in ("torch", "flwr"):
            raise
        pytest.skip("needs fcslam[federated]")
    assert callable(script.main)
    assert capsys.readouterr().out == ""


def test_missing_recordings_fail_with_their_names(monkeypatch, tmp_path):
    monkeypatch.setenv("FCSLAM_DATA", str(tmp_path))
    with pytest.raises(SystemExit, match=r"intel\.clf\.xz missing"):
        common.recordings("slam-benchmark/intel.clf.xz")


def test_a_script_without_recordings_succeeds(tmp_path):
    environment = {name: value for name, value in os.environ.items() if name != "FCSLAM_DATA"}
    environment["PYTHONPATH"] = str(FOLDER.parent / "src")
    command = [sys.executable, FOLDER / "relations.py", "--results", tmp_path]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert ended.stdout.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_report_is_two_files_that_say_the_same(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["sample.py"])
    chosen = common.options("Sample.").parse_args(["--results", str(tmp_path), "--date", "2026-11-05"])
    report = common.Report("benchmarks/sample.py", "Sample.", chosen)
    report.table("Numbers", {"what": "", "m": ".2f"}, [("a", 1.23456), ("b", float("nan"))])
    report.write()
    markdown = (tmp_path / "sample.md").read_text(encoding="utf-8")
    assert "| a | 1.23 |" in markdown
    assert "| b | - |" in markdown
    assert "- date: 2026-11-05" in markdown
    assert markdown in capsys.readouterr().out
    assert common.figures(tmp_path / "sample.csv", "Numbers") == [{"what": "a", "m": "1.23456"}, {"what": "b", "m": ""}]


@pytest.mark.slow
def test_the_command_is_measured_and_its_failure_ends_the_script():
    cost = common.run_fcslam("--version")
    assert cost.cpu_s > 0.0
    assert 0.0 < cost.wall_s < 60.0
    assert cost.peak_mb > 5.0  # the system counts what this process held when it forked, so no upper bound
    with pytest.raises(SystemExit, match="failed"):
        common.run_fcslam("map", "no-such-log", "--output", "nowhere")


def test_commands_of_reports_name_no_folder_of_one_machine():
    results = FOLDER / "results"
    commands = [
        (report.name, line)
        for report in results.glob("*.md")
        for line in report.read_text(encoding="utf-8").splitlines()
        if line.startswith("- command:")
    ]
    assert commands
    assert [each for each in commands if re.search(r" /(?!path/to/)", each[1])] == []

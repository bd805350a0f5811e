"""`fcslam demo`: everything in one command, its own folder replaced, nobody else's touched."""

import csv
import io
import sys
from contextlib import redirect_stderr, redirect_stdout

import pytest

from fcslam.cli import main
from fcslam.lab.simulation import engine
from fcslam.records import CameraImage
from fcslam.runs import open_run
from fcslam.sources import open_source
from tests.lab.simulation.gl import require_gl

TINY = ["demo", "--robots", "2", "--path-length", "8"]
TINIEST = ["--no-camera", "--robots", "1", "--path-length", "3"]


def run_demo(output, *more):
    return main([*TINY, *more, "--output", str(output)])


def told(output):
    """The values of the table, by name."""
    with (output / "evaluation.csv").open() as file:
        return {row["name"]: float(row["value"]) for row in csv.DictReader(file)}


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """A demo with LiDARs alone, run twice into one folder, in which something was left in between; and what it said."""
    output = tmp_path_factory.mktemp("shown") / "demo"
    assert run_demo(output, *TINIEST) == 0
    (output / "notes").write_text("mine")
    (output / "recordings" / "stale").write_text("of the first run")
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        assert run_demo(output, "--no-camera") == 0
    return output, out.getvalue().splitlines(), err.getvalue().splitlines()


@pytest.mark.slow
def test_it_ends_with_a_run_and_a_table(shown):
    shown, _, _ = shown
    run = open_run(shown / "run")
    assert [trajectory.robot for trajectory in run.trajectories.values()] == ["robot_1", "robot_2"]
    assert min(trajectory.path_length_m for trajectory in run.trajectories.values()) > 7.0
    figures = told(shown)
    assert figures["maps"] == 1
    assert figures["false_joins"] == 0
    assert max(figures["ate_rmse_robot_1"], figures["ate_rmse_robot_2"]) < 0.05
    assert figures["map_f1"] > 0.9


@pytest.mark.slow
def test_it_replaces_itself_and_nothing_else(shown):
    shown, _, _ = shown
    assert (shown / "notes").read_text() == "mine"
    assert not (shown / "recordings" / "stale").exists()
    assert "path_length_m: 8.0" in (shown / "recordings" / "simulation.yaml").read_text()


@pytest.mark.slow
def test_it_says_where_everything_is(shown):
    output, out, err = shown
    assert out[-3:] == [
        f"run folder: {output / 'run'}",
        f"map: {output / 'run/map.png'}",
        f"all numbers: {output / 'evaluation.csv'}",
    ]
    assert [line[:6] for line in err if " of 3 " in line] == [f"{k} of 3" for k in range(1, 4)]


def refused(output, capsys, *more):
    """The one line with which it ends."""
    assert run_demo(output, *more) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_what_is_no_demo_is_left_alone(tmp_path, capsys):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "notes").write_text("mine")
    assert "holds something that is not a demo" in refused(tmp_path, capsys, "--no-camera")
    assert (tmp_path / "run" / "notes").read_text() == "mine"
    assert "cannot be used as the output folder" in refused(tmp_path / "run" / "notes", capsys, "--no-camera")


@pytest.mark.slow
def test_without_a_gl_library_one_line_says_what_to_install_and_an_earlier_demo_stays(shown, capsys, monkeypatch):
    shown, _, _ = shown
    monkeypatch.setattr(engine, "_BACKENDS", ("none",))
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    line = refused(shown, capsys)
    assert "apt-get install" in line
    assert "--no-camera" in line
    assert (shown / "run").exists()


def test_without_the_simulator_one_line_says_what_to_install(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    assert "pip install 'fcslam[sim]'" in refused(tmp_path / "demo", capsys, "--no-camera")
    assert not (tmp_path / "demo").exists()


@pytest.mark.system
def test_with_cameras(tmp_path):
    require_gl()
    assert run_demo(tmp_path / "demo", "--path-length", "4") == 0
    records = open_source(tmp_path / "demo" / "recordings" / "robot_1").records()
    assert sum(isinstance(record, CameraImage) for record in records) > 30
    figures = told(tmp_path / "demo")
    assert figures["camera_places"] > 0
    assert figures["maps"] == 1

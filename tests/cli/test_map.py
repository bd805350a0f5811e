"""The real command: whole runs, and every bad input in one line with nothing left behind."""

import csv
import json

import pytest
import yaml

from fcslam.cli import main
from fcslam.cli import map as mapping
from fcslam.config import dump
from fcslam.mission.mission import MissionConfig
from fcslam.runs import open_run
from tests.carmen_logs import write_carmen
from tests.robot.lifting import ride
from tests.robot.test_lifts import SHORT
from tests.small_fleet import contents
from tests.sources.carmen_text import drive, flaser, pose_at, save

pytestmark = pytest.mark.slow

RUN_FILES = {
    "closures.csv", "config.yaml", "local", "map.pgm", "map.png", "map.yaml", "metrics.json", "mission.fcslam",
    "joins.csv", "quality.json", "pose_graph.g2o", "robots.csv", "trajectories",
}  # fmt: skip


def run_map(*arguments):
    return main(["map", *map(str, arguments)])


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def maps_of(run):
    return {row["robot"]: int(row["map"]) for row in rows_of(run / "robots.csv")}


def names_in(folder):
    return {path.name for path in folder.iterdir()}


@pytest.fixture(scope="module")
def run(logs, tmp_path_factory):
    """The three robots' run folder."""
    folder = tmp_path_factory.mktemp("runs") / "deep" / "run"
    assert run_map(*logs, "--output", folder, "--config", "seed=5") == 0
    return folder


@pytest.fixture
def log(tmp_path):
    """A short healthy recording."""
    return save(tmp_path / "healthy.log", drive(40))


# Whole runs


def test_the_run_folder_is_complete(run, drawn):
    assert names_in(run) == RUN_FILES
    assert names_in(run.parent) == {run.name}
    assert names_in(run / "trajectories") == {f"{robot.name}.tum" for robot in drawn.robots}
    local = {f"{robot.name}.{kind}" for robot in drawn.robots for kind in ("tum", "pgm", "yaml")}
    assert names_in(run / "local") == local
    for robot in rows_of(run / "robots.csv"):
        truth = next(r for r in drawn.robots if r.name == robot["robot"])
        assert int(robot["scans"]) == len(truth.stamps)
        assert float(robot["path_length_m"]) == pytest.approx(8.0, rel=0.1)
    assert {row["status"] for row in rows_of(run / "closures.csv")} >= {"accepted"}
    assert all(metric.keys() == {"name", "value", "unit"} for metric in json.loads((run / "metrics.json").read_text()))
    assert (run / "pose_graph.g2o").read_text().startswith("VERTEX_SE2 0 ")


def test_without_fusing_every_robot_has_its_own_map(logs, tmp_path, drawn, capsys):
    run = tmp_path / "run"
    assert run_map(*logs, "--config", "fleet.join_maps=false", "--output", run) == 0
    assert maps_of(run) == {robot.name: k for k, robot in enumerate(drawn.robots)}
    assert {f"map{tail}.{kind}" for tail in ("", "_1", "_2") for kind in ("pgm", "png", "yaml")} <= names_in(run)
    assert yaml.safe_load((run / "map_2.yaml").read_text())["image"] == "map_2.pgm"
    assert all(row["robot_i"] == row["robot_j"] for row in rows_of(run / "closures.csv"))
    lines = capsys.readouterr().out.splitlines()
    assert (
        sum(line.startswith(f"map {k} ({robot.name}): ") for k, robot in enumerate(drawn.robots) for line in lines) == 3
    )
    assert yaml.safe_load((run / "config.yaml").read_text())["fleet"]["join_maps"] is False


def test_the_configuration_goes_round(logs, run, tmp_path, capsys):
    """A dumped configuration is a valid one, and the run's own gives the run again, byte for byte."""
    assert main(["tools", "config"]) == 0
    (tmp_path / "dumped.yaml").write_text(capsys.readouterr().out)
    assert run_map(logs[0], "--config", tmp_path / "dumped.yaml", "--output", tmp_path / "one") == 0
    assert (tmp_path / "one" / "config.yaml").read_text() == dump(MissionConfig())
    assert run_map(*logs, "--config", run / "config.yaml", "--output", tmp_path / "again") == 0
    assert contents(tmp_path / "again") == contents(run)


@pytest.mark.parametrize("ranges", [(float("nan"),) * 8, (-1.0,) * 8, (81.91,) * 8, (0.0,) * 8])
def test_a_laser_that_never_sees_anything_is_no_traceback(tmp_path, capsys, ranges):
    log = save(tmp_path / "blind.log", [flaser(100 + 0.2 * k, pose_at(k), ranges=ranges) for k in range(40)])
    code = run_map(log, "--output", tmp_path / "run")
    assert code in (0, 2)
    assert (tmp_path / "run").exists() is (code == 0)
    assert "Traceback" not in capsys.readouterr().err


def test_a_recording_of_one_scan_is_a_run(tmp_path):
    assert run_map(save(tmp_path / "one.log", drive(1)), "--output", tmp_path / "run") == 0
    assert maps_of(tmp_path / "run") == {"one": 0}


def test_the_preset_of_the_paper_goes_under_the_configuration_file(tmp_path, log, refused):
    run, file = tmp_path / "run", tmp_path / "own.yaml"
    file.write_text("fleet: {matcher: {delta: 1.5}}")
    assert run_map(log, "--config", "paper", "--config", file, "--output", run) == 0
    fleet = yaml.safe_load((run / "config.yaml").read_text())["fleet"]
    assert (fleet["matcher"]["decision"], fleet["matcher"]["delta"]) == ("similarity", 1.5)
    assert (fleet["fusion"], fleet["matcher"]["vocabulary"]["strategy"]) == ("two_point", "windowed")
    assert not (run / "quality.json").exists(), "no graph says how accurate a rigid map is"
    file.write_text("fleet: {fusion: joint}")
    line = refused("map", log, "--config", "paper", "--config", file, "--output", tmp_path / "other")
    assert f"{file}: fleet: matcher.decision similarity measures no transform" in line
    assert "set fusion to two_point" in line


def test_a_ride_in_a_lift_gives_two_maps_and_the_option_that_names_the_floor(tmp_path, capsys):
    scans, _, (opening,) = ride(3, 4, laser=SHORT)
    write_carmen(tmp_path / "anna.clf", scans)
    assert run_map(tmp_path / "anna.clf", "--output", tmp_path / "run") == 0
    run, out = open_run(tmp_path / "run"), capsys.readouterr().out
    assert {name: each.map_index for name, each in run.trajectories.items()} == {"anna": 0, "anna+1": 1}
    assert run.trajectories["anna+1"].stamps[0] == pytest.approx(opening, abs=1.0)
    assert "anna+1: anna was lost or rode in a lift; this session begins at" in out
    option = out.partition("give --floor ")[2].partition("=FLOOR")[0]
    assert run_map(tmp_path / "anna.clf", "--floor", f"{option}=2", "--output", tmp_path / "named") == 0
    named = open_run(tmp_path / "named")
    assert [(name, each.floor) for name, each in named.trajectories.items()] == [("anna", ""), ("anna+1", "2")]
    assert len(named.trajectories["anna+1"].stamps) == pytest.approx(len(run.trajectories["anna+1"].stamps), abs=1)
    assert "anna+1: anna came to floor 2" in capsys.readouterr().out


@pytest.mark.parametrize("force", [(), ("--force",)])
def test_ctrl_c_leaves_no_folder_and_the_old_run_alone(tmp_path, capsys, monkeypatch, force):
    log = save(tmp_path / "long.log", drive(120))
    run = tmp_path / "run"
    if force:
        assert run_map(log, "--output", run) == 0
    before = {file.name: file.read_bytes() for file in run.iterdir() if file.is_file()} if force else {}

    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("fcslam.cli.progress.ProgressDisplay.show", interrupt)
    capsys.readouterr()
    assert run_map(log, "--output", run, *force) == 130
    assert capsys.readouterr().err.strip().splitlines()[-1] == "fcslam: interrupted"
    assert names_in(tmp_path) == ({"long.log", "run"} if force else {"long.log"})
    assert not force or {file.name: file.read_bytes() for file in run.iterdir() if file.is_file()} == before


@pytest.mark.parametrize(
    ("options", "floors"),
    [
        ([], {}),
        (["2"], {"a": "2", "b": "2"}),
        (["b=-1"], {"b": "-1"}),
        (["1", "b=2"], {"a": "1", "b": "2"}),
        (["1", "b@9.5=2", "b@30=1"], {"a": "1", "b": "1", "b@9.5": "2", "b@30": "1"}),
    ],
)
def test_floors_are_those_of_all_recordings_or_of_one(options, floors):
    assert mapping.floors_of(options, ["a", "b"]) == floors

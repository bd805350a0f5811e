"""`fcslam map` on bags, names for robots, and `fcslam record`."""

import numpy as np
import pytest

from fcslam.cli import main
from fcslam.runs import open_run, read_tum
from fcslam.sources import open_source
from tests.sources.bag_messages import drive, odom, save

pytestmark = pytest.mark.slow


def run(*arguments):
    return main([*map(str, arguments)])


@pytest.fixture
def bag(tmp_path):
    return save(tmp_path / "run1.bag", drive(40))


# Bags and logs are the same recordings


@pytest.fixture(scope="module")
def from_log(logs, tmp_path_factory):
    """One drawn robot's trajectory from its log."""
    output = tmp_path_factory.mktemp("runs") / "run"
    assert run("map", f"robot={logs[0]}", "-o", output) == 0
    return read_tum(output / "trajectories" / "robot.tum")


@pytest.mark.parametrize("name", ["run.bag", "run.mcap"])
def test_a_bag_made_of_a_log_gives_the_same_trajectory(logs, from_log, tmp_path, name):
    assert run("record", logs[0], "-o", tmp_path / name) == 0
    assert run("map", f"robot={tmp_path / name}", "-o", tmp_path / "out") == 0
    stamps, poses = read_tum(tmp_path / "out" / "trajectories" / "robot.tum")
    np.testing.assert_allclose(stamps, from_log[0], atol=1e-9)
    assert np.hypot(*(poses - from_log[1])[:, :2].T).max() < 1e-3


@pytest.mark.parametrize("copy", ["copy.bag", "copy.mcap"])
def test_a_copy_of_a_recording_under_another_name_is_refused(tmp_path, refused, copy):
    bag, copy = save(tmp_path / "run.bag", drive(40)), save(tmp_path / copy, drive(40))
    assert "run and copy have the same scans at" in refused("map", bag, copy, "-o", tmp_path / "out")
    other = save(tmp_path / "other.bag", drive(40, start=150.0))  # the same drive later
    assert run("map", bag, other, "-o", tmp_path / "out") == 0


def test_choices_and_faults_are_said(tmp_path, capsys):
    said = [*drive(40), *(odom(100 + k, (9, 9, 0), topic="/filtered") for k in range(9))]
    bag = save(tmp_path / "run.bag", said[1:])
    assert run("map", bag, "--sensors", "laser-pose=-0.1,0,0", "-o", tmp_path / "out") == 0
    error = capsys.readouterr().err
    assert f"{bag}: reads odometry from /odom, not from /filtered (--sensors odom-topic chooses)\n" in error
    assert run("map", bag, "--sensors", "laser-pose=0,0,0", "--split", 2, "-o", tmp_path / "two") == 0
    assert capsys.readouterr().err.count("reads odometry from") == 1


# Names


@pytest.mark.parametrize(
    ("files", "given", "robots"),
    [
        (("run1.bag", "run1.mcap"), ("anna=run1.bag", "ben=run1.mcap"), ["anna", "ben"]),
        (("speed=2.bag", "speed=3.bag"), ("speed=2.bag", "slow=speed=3.bag"), ["speed_2", "slow"]),
    ],
)
def test_names_tell_equal_files_apart_and_a_file_may_have_an_equals_sign(tmp_path, monkeypatch, files, given, robots):
    monkeypatch.chdir(tmp_path)
    for name, scans, start in zip(files, (40, 15), (100.0, 150.0), strict=True):
        save(tmp_path / name, drive(scans, start))
    assert run("map", *given, "-o", "out") == 0
    found = open_run("out").trajectories
    assert {name: len(robot.stamps) for name, robot in found.items()} == dict(zip(robots, (40, 15), strict=True))


# fcslam record, of a recording


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3", "folder"])
def test_every_format_can_be_written_and_read(tmp_path, bag, name, capsys):
    output = tmp_path / "deep" / name
    assert run("record", bag, "-o", output) == 0
    assert capsys.readouterr().out == f"40 scans: {output}\n"
    assert open_source(output).survey().scan_count == 40
    assert [path.name for path in output.parent.iterdir()] == [name]


@pytest.mark.parametrize("name", ["a.bag", "folder"])
def test_only_force_replaces(tmp_path, bag, refused, name):
    output = tmp_path / name
    assert run("record", bag, "-o", output) == 0
    assert "--force" in refused("record", bag, "-o", output)
    shorter = save(tmp_path / "short.mcap", drive(12))
    assert run("record", shorter, "-o", output, "--force") == 0
    assert open_source(output).survey().scan_count == 12
    assert run("record", output, "-o", output, "--force") == 0
    assert open_source(output).survey().scan_count == 12

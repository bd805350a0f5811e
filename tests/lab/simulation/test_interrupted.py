"""A fleet on disk: interrupted and gone on with is the same, to the byte; a full disk is one line."""

import resource
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from fcslam.cli import main
from fcslam.lab.simulation.noise import LidarSettings
from fcslam.lab.simulation.options import Building
from fcslam.lab.simulation.recording import record_robot
from fcslam.lab.simulation.sensors import Camera, RayCaster
from fcslam.lab.simulation.simulated_fleet import CameraSettings, SimulatedRobot, SimulationSettings, simulate_fleet
from fcslam.records import GroundTruth, LaserScan, Odometry
from fcslam.sources import RecordingWriter, open_source
from tests.lab.simulation.gl import require_gl

BLIND = SimulationSettings(
    building=Building.FLAT, robots=1, path_length_m=3.0, camera=None, lidar=LidarSettings(beams=40, rate_hz=10.0)
)
SEEING = BLIND.model_copy(update={"camera": CameraSettings(width=64, height=48, rate_hz=4.0)})
COMMAND = ["tools", "simulate", "--building", "flat", "--path-length", "4"]
COMMAND += ["--robots", "2", "--no-camera", "--seed", "2"]


def files(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def spoil(folder, tail):
    """Files after a crash in the middle of a write."""
    for name in ("scans.bin", "ranges.bin", "images.bin", "ground_truth.tum"):
        if (folder / name).exists():
            with (folder / name).open("ab") as file:
                file.write(tail)
    if (folder / "images").exists():
        (folder / "images" / f"{len(list((folder / 'images').iterdir())):08d}.jpg").write_bytes(tail)


def interrupted_and_resumed(robot, folder, items, tail, monkeypatch):
    """How many scans and images were made after the interruption."""
    record_robot(robot, folder, lambda records: islice(records, items))
    spoil(folder, tail)
    made = []
    cast, take = RayCaster.cast, Camera.take
    with monkeypatch.context() as patch:
        patch.setattr(RayCaster, "cast", lambda self, pose, laser: made.append("scan") or cast(self, pose, laser))
        patch.setattr(Camera, "take", lambda self, pose: made.append("image") or take(self, pose))
        record_robot(robot, folder, resume=True)
    return made


@pytest.mark.slow
@pytest.mark.parametrize("items", [0, 1, 2, 37, 100, 10_000])
def test_interrupted_and_resumed_is_the_same_as_uninterrupted(items, tmp_path, monkeypatch):
    (robot,) = simulate_fleet(BLIND, 1).robots
    record_robot(robot, tmp_path / "whole")
    made = interrupted_and_resumed(robot, tmp_path / "cut", items, b"12.5 0.3", monkeypatch)
    assert files(tmp_path / "cut") == files(tmp_path / "whole")
    assert len(made) == max(0, len(robot.stamps) - (items + 1) // 2)


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    """A robot with a camera, and the files of its whole recording."""
    require_gl()
    (robot,) = simulate_fleet(SEEING, 1).robots
    folder = tmp_path_factory.mktemp("seen") / "whole"
    record_robot(robot, folder)
    return robot, files(folder)


@pytest.mark.system
@pytest.mark.parametrize("items", [9, 60, 61, 10_000])
def test_images_that_are_there_are_not_rendered_again(seen, items, tmp_path, monkeypatch):
    robot, whole = seen
    made = interrupted_and_resumed(robot, tmp_path / "cut", items, b"\xff\xd8\xff", monkeypatch)
    assert files(tmp_path / "cut") == whole
    assert len(made) == max(0, len(robot.stamps) + len(robot.image_stamps) - (items + 1) // 2)


def test_a_recording_with_a_gap_is_made_again(tmp_path):
    """A power cut may take a scan and leave what came after it."""
    (robot,) = simulate_fleet(BLIND, 1).robots
    record_robot(robot, tmp_path / "whole")
    with RecordingWriter.create(tmp_path / "cut", robot.lasers) as writer:
        for scan in islice(robot.items(), 0, 40, 2):
            writer.write(scan)
        writer.write(Odometry(robot.stamps[20], robot.T_odom_base[20]))
    content = (tmp_path / "cut" / "scans.bin").read_bytes()
    (tmp_path / "cut" / "scans.bin").write_bytes(content[:-1])
    record_robot(robot, tmp_path / "cut", resume=True)
    assert files(tmp_path / "cut") == files(tmp_path / "whole")


def test_what_is_left_out_is_not_made_and_the_rest_is_the_same():
    (robot,) = simulate_fleet(BLIND, 1).robots
    whole, rest = list(robot.items()), list(robot.items(first_scan=20))
    assert [item.stamp for item in rest if isinstance(item, GroundTruth)] == list(robot.stamps)
    expected = [item for item in whole if isinstance(item, LaserScan)][20:]
    for a, b in zip(expected, (item for item in rest if isinstance(item, LaserScan)), strict=True):
        assert a.stamp == b.stamp
        np.testing.assert_array_equal(a.ranges_m, b.ranges_m)


@pytest.mark.slow
def test_the_command_goes_on(tmp_path, monkeypatch):
    """The second robot is cut off by Ctrl-C, the first is whole."""
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    assert main([*COMMAND, "--output", str(whole)]) == 0
    items = SimulatedRobot.items

    def cut_off(robot, *first):
        for number, item in enumerate(items(robot, *first)):
            if robot.number == 1 and number == 31:
                raise KeyboardInterrupt
            yield item

    with monkeypatch.context() as patch:
        patch.setattr(SimulatedRobot, "items", cut_off)
        assert main([*COMMAND, "--output", str(cut)]) == 130
    assert not (cut / "ground_truth").exists()
    assert main([*COMMAND, "--output", str(cut), "--resume"]) == 0
    assert files(cut) == files(whole)
    assert main([*COMMAND, "--output", str(cut), "--resume"]) == 0
    assert files(cut) == files(whole)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (["--seed", "3"], "seed was 2 and is now 3"),
        (["--path-length", "5"], "path_length_m was 4.0 and is now 5.0"),
        (["--config", "moved_furniture=0.5"], "moved_furniture was 0.0 and is now 0.5"),
    ],
)
def test_other_settings_are_refused(change, words, tmp_path, capsys):
    assert main([*COMMAND, "--output", str(tmp_path)]) == 0
    before = files(tmp_path)
    assert main([*COMMAND, *change, "--output", str(tmp_path), "--resume"]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()[-1:]
    assert words in line
    assert files(tmp_path) == before


def test_without_resume_an_interrupted_fleet_is_left_alone(tmp_path, capsys):
    assert main([*COMMAND, "--output", str(tmp_path)]) == 0
    assert main([*COMMAND, "--output", str(tmp_path)]) == 2
    assert "is not empty; choose another place, or go on with it by --resume" in capsys.readouterr().err


def test_resume_leaves_a_folder_of_something_else_alone(tmp_path, capsys):
    (tmp_path / "notes").write_text("mine")
    assert main([*COMMAND, "--output", str(tmp_path), "--resume"]) == 2
    assert "is not empty; choose another place" in capsys.readouterr().err
    assert files(tmp_path) == {Path("notes"): b"mine"}


@pytest.mark.slow
def test_a_full_disk_is_one_line_and_the_recordings_go_on_later(tmp_path, capsys):
    """A limit on file sizes stands for the disk."""
    whole, full = tmp_path / "whole", tmp_path / "full"
    assert main([*COMMAND, "--output", str(whole)]) == 0
    capsys.readouterr()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, before[1]))
    try:
        code = main([*COMMAND, "--output", str(full)])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "cannot be written (File too large)" in line
    assert "--resume" in line
    source = open_source(full / "robot_1")
    assert 10 < source.survey().scan_count < open_source(whole / "robot_1").survey().scan_count
    assert not source.faults
    assert main([*COMMAND, "--output", str(full), "--resume"]) == 0
    assert files(full) == files(whole)

"""`fcslam info`: text for people, JSON for programs."""

import json

import numpy as np
import pytest

from fcslam.cli import main
from tests.sources.bag_messages import drive, save, scan
from tests.sources.clouds import at_rest, rotation, spinning, xyz
from tests.sources.test_clouds_in_space import drive as drive_3d

pytestmark = pytest.mark.slow


@pytest.fixture
def bag(tmp_path):
    return save(tmp_path / "run1.bag", drive(40))


def test_the_text_says_what_is_in_it_and_that_it_can_be_mapped(bag, capsys):
    assert main(["info", str(bag)]) == 0
    out, err = capsys.readouterr()
    lines = out.splitlines()
    assert lines[0] == f"{bag}: ROS bag"
    assert "  /scan: sensor_msgs/LaserScan, 40 messages, 5.0 Hz, frame laser" in lines
    assert "transforms: base_link -> laser" in lines
    assert "robot: run1" in lines
    assert "odometry: 82 readings of /odom at 10.5 Hz" in lines
    assert any(line.startswith("laser 0: 40 scans at 5.0 Hz, 8 beams from -90.0 to 67.5 degrees") for line in lines)
    assert lines[-1] == "can be mapped"
    assert err == ""


def test_what_cannot_be_mapped_ends_with_the_reason(tmp_path, capsys):
    said = [message for message in drive(40) if message.topic != "/scan"]
    assert main(["info", str(save(tmp_path / "run1.bag", said))]) == 1
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("cannot be mapped: ")
    assert "no laser scans" in last


def test_a_folder_of_clouds_is_a_recording_that_can_be_mapped_with_3d(tmp_path, capsys):
    for number in range(8):
        points = spinning(at_rest, columns=90).points
        (tmp_path / f"{number}.bin").write_bytes(np.column_stack((points, points[:, 0])).astype("<f4").tobytes())
    assert main(["info", str(tmp_path), "--calibrate"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"{tmp_path}: folder of point clouds"
    assert "8 scans in 0.7 s, path of 0.0 m by odometry" in lines
    assert any("the points have no times in a usual unit; their order gives them" in line for line in lines)
    assert not any(line.startswith("laser") for line in lines)
    assert lines[-2:] == ["can be mapped with --3d", "calibration: of ROS bags only"]
    for file in tmp_path.iterdir():
        file.write_bytes(b"nonsense")
    assert main(["info", str(tmp_path)]) == 1
    assert "is not a cloud that can be read" in capsys.readouterr().out.splitlines()[-1]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, ["--3d reads /odom, /points, /imu, with times"]),
        ({"layout": (12, xyz())}, ["--3d reads /odom, /points, /imu", "their order gives them"]),
        ({"R": rotation(roll=np.pi)}, ["--3d reads /odom, /points, /imu, with times", "the LiDAR is upside down"]),
    ],
)
def test_a_bag_with_clouds_says_what_3d_reads(tmp_path, capsys, changes, said):
    assert main(["info", str(save(tmp_path / "run.mcap", drive_3d(**changes)))]) == 0
    lines = capsys.readouterr().out.splitlines()
    first = lines.index(said[0])
    assert all(part in lines[first + 1] for part in said[1:])


def test_names_of_a_bag_do_not_reach_the_terminal_as_they_are(tmp_path, capsys):
    said = [scan(100.0 + k, frame="la\x1b[31mser\nx", topic="/scan\x1b[2J") for k in range(9)]
    assert main(["info", str(save(tmp_path / "run1.bag", [*drive(9), *said]))]) == 0
    out = capsys.readouterr().out
    assert "\x1b" not in out
    assert "  /scan?[2J: sensor_msgs/LaserScan, 9 messages, 1.0 Hz, frame la?[31mser x" in out.splitlines()


def test_json_holds_the_same(bag, capsys):
    assert main(["info", str(bag), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["format"] == "ROS bag"
    assert found["bag"]["topics"][1]["name"] == "/scan"
    assert found["lasers"][0]["model"]["beam_count"] == 8
    assert found["problem"] is None

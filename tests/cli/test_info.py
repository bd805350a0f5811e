"""`fcslam info`: text for people, JSON for programs."""

import json

import pytest

from fcslam.cli import main
from tests.sources.bag_messages import drive, save


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
    assert any(line.startswith("laser 0: 40 scans at 5.0 Hz, 8 beams from -90.0 to 67.5 degrees") for line in lines)
    assert lines[-1] == "can be mapped"
    assert err == ""


def test_what_cannot_be_mapped_ends_with_the_reason(tmp_path, capsys):
    said = [message for message in drive(40) if message.topic != "/odom"]
    assert main(["info", str(save(tmp_path / "run1.bag", said))]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("cannot be mapped: ")
    assert "no odometry" in last


def test_json_holds_the_same(bag, capsys):
    assert main(["info", str(bag), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["format"] == "ROS bag"
    assert found["bag"]["topics"][1]["name"] == "/scan"
    assert found["lasers"][0]["model"]["beam_count"] == 8
    assert found["problem"] is None


def test_no_recording_is_one_line(tmp_path, capsys):
    assert main(["info", str(tmp_path / "nowhere.bag")]) == 2
    assert capsys.readouterr().err.count("\n") == 1

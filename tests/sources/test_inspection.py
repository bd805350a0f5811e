"""Findings of `fcslam info` in recordings of each format, mappable or not."""

import pytest

from fcslam.sources import BagOptions, write_bag
from fcslam.sources.inspection import inspect
from tests.sources import camera_records, carmen_text
from tests.sources.bag_messages import BEAMS, LASER_POSE, drive, mounted, odom, save, text, without


@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3"])
def test_a_bag_names_its_topics_rates_and_frames(tmp_path, suffix):
    said = [*drive(40), text(101.0)]
    found = inspect(save(tmp_path / f"run{suffix}", said))
    assert found.format == "ROS bag"
    assert found.problem is None
    topics = {topic.name: topic for topic in found.bag.topics}
    assert sorted(topics) == ["/chatter", "/odom", "/scan", "/tf_static"]
    assert topics["/scan"].type == "sensor_msgs/LaserScan"
    assert (topics["/scan"].messages, topics["/chatter"].rate_hz) == (40, None)
    assert topics["/scan"].rate_hz == pytest.approx(5.0)
    assert topics["/odom"].rate_hz == pytest.approx(10.0, rel=0.02)
    assert found.bag.transforms == (("base_link", "laser"),)
    assert found.bag.laser_frames == {"/scan": ("laser",)}
    (laser,) = found.lasers
    assert (laser.scans, laser.model.beam_count) == (40, BEAMS)
    assert laser.model.T_base_laser == pytest.approx(LASER_POSE)
    assert laser.rate_hz == pytest.approx(5.0)
    assert (found.scans, found.camera) == (40, None)
    assert found.duration_s == pytest.approx(7.8)


def test_a_bag_that_cannot_be_mapped_is_shown_with_the_reason(tmp_path):
    path = save(tmp_path / "run.bag", without(drive(40), "/tf_static"))
    found = inspect(path)
    assert "so the pose of the laser of /scan is unknown" in found.problem
    assert {topic.name for topic in found.bag.topics} == {"/odom", "/scan"}
    assert found.scans == 0
    assert inspect(path, BagOptions(laser_poses=((0.0, 0.0, 0.0),))).problem is None
    lonely = inspect(save(tmp_path / "lonely.bag", [mounted(), odom(100.0, (0.0, 0.0, 0.0))]))
    assert "no laser scans" in lonely.problem


def test_a_log_has_no_topics_and_a_bag_shows_its_camera(tmp_path):
    log = inspect(carmen_text.save(tmp_path / "run.clf", carmen_text.drive(30)))
    assert (log.format, log.bag, log.scans, log.problem) == ("CARMEN log", None, 30, None)
    write_bag(tmp_path / "run.mcap", camera_records.drive(20))
    found = inspect(tmp_path / "run.mcap")
    assert (found.format, found.scans, found.images, found.odometry) == ("ROS bag", 20, 20, 20)
    assert found.camera == camera_records.CAMERA

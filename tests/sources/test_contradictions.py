"""Scans that contradict the odometry are counted, and nothing else is."""

import numpy as np
import pytest

from fcslam.records import LaserModel, LaserScan, frozen
from fcslam.sources import Fault, open_source, write_recording
from tests.lidar.worlds import corridor, drive, ranges, room

LASER = LaserModel(360, -np.pi, np.deg2rad(1.0), 20.0)
WAY = drive([(0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0), (0.0, 0.0)], step_m=0.2)


def faults(tmp_path, poses, odometry, world=None, repeat=False):
    rng = np.random.default_rng(0)
    seen = ranges(poses, room() if world is None else world, LASER, 0.01, rng)
    if repeat:
        seen[40:60] = seen[40]
    scans = [
        LaserScan(0.2 * k, frozen(row, np.float32), LASER, frozen(pose))
        for k, (row, pose) in enumerate(zip(seen, odometry, strict=True))
    ]
    write_recording(tmp_path / "run.fcslam", [LASER], None, scans)
    source = open_source(tmp_path / "run.fcslam")
    assert len(list(source.records())) == len(scans), "they are kept"
    return source.faults


def test_a_healthy_drive_and_a_robot_that_stands(tmp_path):
    still = np.repeat(WAY, 4, axis=0)
    assert not faults(tmp_path, still, still)


def test_odometry_that_stands_still_while_the_robot_drives(tmp_path):
    found = faults(tmp_path, WAY, np.zeros_like(WAY))
    assert found[Fault.FROZEN_ODOMETRY].count > 0.5 * len(WAY)
    assert "scans that change while the odometry stands still kept" in str(found)


def test_odometry_that_freezes_on_the_way(tmp_path):
    odometry = WAY.copy()
    odometry[30:] = odometry[30]
    assert faults(tmp_path, WAY, odometry)[Fault.FROZEN_ODOMETRY].first_line > 31


def test_a_scanner_that_repeats_its_last_scan(tmp_path):
    assert faults(tmp_path, WAY, WAY, repeat=True)[Fault.FROZEN_SCAN].count == pytest.approx(19, abs=6)


def test_odometry_that_turns_while_the_robot_stands(tmp_path):
    standing = np.zeros((60, 3))
    turning = np.column_stack((np.zeros((60, 2)), 0.1 * np.arange(60)))
    assert faults(tmp_path, standing, turning)[Fault.FROZEN_SCAN].count > 10


def test_a_corridor_looks_the_same_from_everywhere(tmp_path):
    along = np.column_stack((0.2 * np.arange(60), np.zeros((60, 2))))
    assert not faults(tmp_path, along, along, corridor())

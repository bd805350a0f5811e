"""A 3D LiDAR whose heading contradicts the wheels is named."""

import re
from pathlib import Path

import numpy as np
import pytest

from fcslam.lidar.frontend import LidarConfig
from fcslam.records import CloudScan
from fcslam.robot.calibrating import calibrated
from fcslam.sources.clouds_in_space import BAND_LASER, CloudRecording
from fcslam.sources.faults import Faults
from fcslam.sources.source import Survey
from tests.sources.clouds import rotation, spinning

LIDAR = (0.1, 0.05, 0.4)


def pose_at(times):
    """To and fro along a curve in the room, shape (N, 3)."""
    turn = 0.9 * np.sin(0.5 * np.asarray(times))
    return np.stack((2.0 * np.sin(turn), 2.0 - 2.0 * np.cos(turn), turn), axis=1)


class Curves(CloudRecording):
    """Drives to and fro in a room."""

    def __init__(self, turned_rad, has_wheels=True):
        super().__init__(Path("room"), "anna", "turn")
        self._R, self._has_wheels = rotation(yaw=turned_rad), has_wheels

    def survey(self):
        return Survey(200, 20.0, 15.0 * self._has_wheels, (BAND_LASER,), Faults({}))

    def _scans(self, audit):  # noqa: ARG002
        for stamp in np.arange(0.0, 20.0, 0.1):
            turn = spinning(lambda times, t=stamp: pose_at(t + times), LIDAR, self._R, columns=480)
            readings = stamp + np.arange(0.0, 0.1, 0.02)
            wheels = np.column_stack((readings, pose_at(readings)))[: 5 * self._has_wheels]
            points = (turn.points + LIDAR).astype(np.float32)  # as tf says
            yield 0, CloudScan(stamp, points, turn.times.astype(np.float32), np.array(LIDAR), wheels, np.zeros((0, 7)))


@pytest.mark.slow
@pytest.mark.parametrize("turned_deg", [0, 90, 180, -60])
def test_a_turned_lidar_is_named(turned_deg):
    notes = calibrated(Curves(np.radians(turned_deg)), LidarConfig()).survey().notes
    assert len(notes) == (turned_deg != 0)
    for note in notes:
        degrees, side = re.search(r"turned by about (\d+) deg to the (left|right) .*; not corrected$", note).groups()
        assert float(degrees) * (1 if side == "left" else -1) == pytest.approx(turned_deg, abs=10.0)


def test_without_wheels_no_cloud_is_read_for_it(monkeypatch):
    monkeypatch.setattr(Curves, "records", lambda _: pytest.fail("read"))
    assert not calibrated(Curves(1.0, has_wheels=False), LidarConfig()).survey().notes

"""Karto's scan matcher finds known offsets, and maps a drive when the setting selects it."""

import numpy as np

from fcslam.lidar.field import field_of
from fcslam.lidar.frontend import LidarConfig, LidarFrontend
from fcslam.lidar.karto import match_covariance
from tests.lidar.worlds import bare_scan, drifting, pose_errors, recording, ring, ring_drive


def test_along_a_bare_wall_the_position_is_unsure():
    x = np.linspace(-5.0, 5.0, 200)
    wall = bare_scan(np.stack((x, np.full(200, 2.0)), axis=1))
    covariance = match_covariance(wall, field_of([(wall, np.zeros(3))]), np.zeros(3))
    assert np.all(np.linalg.eigvalsh(covariance) > 0.0)
    assert covariance[0, 0] > 5.0 * covariance[1, 1]


def test_the_setting_selects_it_and_a_drive_is_tracked():
    truth = ring_drive()[:200]
    odometry = drifting(truth, np.random.default_rng(1))
    frontend, local, keyscans = LidarFrontend("r", LidarConfig(tracker="karto")), [], 0
    for scan in recording(truth, odometry, ring()):
        tracking = frontend.localize(scan)
        keyscans += frontend.process(scan, tracking)[1] is not None
        local.append(tracking.tracked.T_local_base)
        assert tracking.tracked.scan is not None or not tracking.tracked.information.any()
    shift, turn = pose_errors(np.array(local), truth)
    assert 40 < keyscans < 120
    assert pose_errors(odometry, truth)[0].max() > 0.5
    assert shift.max() < 0.15
    assert np.rad2deg(turn.max()) < 1.5

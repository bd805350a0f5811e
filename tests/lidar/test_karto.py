"""Karto's scan matcher finds known offsets, and maps a drive when the setting selects it."""

import numpy as np
import pytest

from fcslam.geometry import se2
from fcslam.lidar.frontend import LidarConfig, LidarFrontend
from fcslam.lidar.karto import CELL_M, FINE_RAD, BufferedScan, match_in_buffer
from tests.lidar.worlds import drifting, pose_errors, recording, ring, ring_drive, room, scan_at

TRUTH = np.array((0.4, -0.3, 0.2))


def room_scan():
    return scan_at(TRUTH, room()).points


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (0.08, -0.1, 0.12), (-0.13, 0.05, -0.25)])
def test_a_scan_finds_its_offset_in_a_buffer_of_itself_to_the_fine_step(offset):
    points = room_scan()
    buffer = [BufferedScan(se2.transform(TRUTH, points), TRUTH[:2])]
    match = match_in_buffer(points, buffer, TRUTH + offset)
    np.testing.assert_array_less(np.abs(match.T_local_base - TRUTH), (1.5 * CELL_M, 1.5 * CELL_M, 1.5 * FINE_RAD))
    assert match.response > 0.8
    assert np.all(np.linalg.eigvalsh(match.covariance) > 0.0)


def test_along_a_bare_wall_the_position_is_unsure():
    points = np.stack((np.linspace(-5.0, 5.0, 200), np.full(200, 2.0)), axis=1)
    match = match_in_buffer(points, [BufferedScan(points, np.zeros(2))], np.zeros(3))
    assert match.covariance[0, 0] > 5.0 * match.covariance[1, 1]


@pytest.mark.parametrize("points", [room_scan(), np.empty((0, 2))])
def test_without_points_or_surfaces_in_reach_there_is_no_response(points):
    match = match_in_buffer(points, [BufferedScan(room_scan() + 100.0, np.full(2, 100.0))], np.zeros(3))
    assert match.response == 0.0
    np.testing.assert_array_equal(match.T_local_base, np.zeros(3))


def test_the_setting_selects_it_and_a_drive_is_tracked():
    truth = ring_drive()[:200]
    odometry = drifting(truth, np.random.default_rng(1))
    frontend, local, keyscans = LidarFrontend("r", LidarConfig(tracker="karto")), [], 0
    for scan in recording(truth, odometry, ring()):
        tracking = frontend.localize(scan)
        keyscans += frontend.process(scan, tracking).keyscan is not None
        local.append(tracking.tracked.T_local_base)
        assert tracking.tracked.scan is not None or not tracking.tracked.information.any()
    shift, turn = pose_errors(np.array(local), truth)
    assert 40 < keyscans < 120
    assert pose_errors(odometry, truth)[0].max() > 0.5
    assert shift.max() < 0.15
    assert np.rad2deg(turn.max()) < 1.5

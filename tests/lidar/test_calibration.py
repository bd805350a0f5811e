"""Calibration from motion: known faults of a made-up drive are found, and nothing is found where there is none."""

import numpy as np
import pytest

from fcslam.geometry import se2
from fcslam.lidar.calibration import OdometryTrack, ScanMotions, calibrate

MOUNTING = np.array((0.12, 0.03, 0.1))
SCAN_S, SWEEP_S = 0.14, 0.14


def base_at(stamps):
    """A robot that drives loops of varying curvature, turns on the spot and stops."""
    dense = np.arange(0.0, 131.0, 0.005)
    speed = 0.4 * (np.sin(0.5 * dense) > -0.3)
    turn = 1.1 * np.sin(0.9 * dense) + 0.4 * np.cos(0.37 * dense)
    heading = np.cumsum(turn) * 0.005
    x, y = np.cumsum(speed * np.cos(heading)) * 0.005, np.cumsum(speed * np.sin(heading)) * 0.005
    return np.stack([np.interp(stamps, dense, axis) for axis in (x, y, heading)], axis=1)


def drive(delay_s=0.0, turn_scale=1.0, distance_scale=1.0, correction=(0.0, 0.0, 0.0), share=1.0, noise=1.0):
    """Motions of the scans, with the laser at ``correction`` from its stated mounting, and of the odometry."""
    rng = np.random.default_rng(5)
    stamps = np.arange(1.0, 110.0, SCAN_S)
    laser = se2.compose(base_at(stamps), se2.compose(correction, MOUNTING))
    seen = se2.compose(laser, se2.inverse(MOUNTING))
    seen += noise * rng.normal(0.0, (0.002, 0.002, 0.0005), seen.shape)
    turned = (
        base_at(stamps + share * SWEEP_S)[:, 2] - base_at(stamps)[:, 2] + noise * rng.normal(0.0, 0.003, len(stamps))
    )
    motions = ScanMotions(stamps, seen, turned, np.zeros(len(stamps)), np.full(len(stamps), SWEEP_S))
    ticks = np.arange(0.0, 130.0, 0.02)
    steps = se2.relative(base_at(ticks)) / (distance_scale, distance_scale, turn_scale)
    poses = [np.zeros(3)]
    for step in steps:
        theta = poses[-1][2]
        cos, sin = np.cos(theta), np.sin(theta)
        poses.append(poses[-1] + (cos * step[0] - sin * step[1], sin * step[0] + cos * step[1], step[2]))
    return motions, OdometryTrack(ticks + delay_s, np.array(poses))


@pytest.mark.parametrize("delay_s", [0.0, 0.06, -0.14, 0.2])
def test_a_delay_is_found(delay_s):
    found = calibrate(*drive(delay_s=delay_s))
    assert found.delay.value == pytest.approx(delay_s, abs=0.003)
    assert abs(found.delay.value - delay_s) < 4.0 * found.delay.sigma < 0.012


@pytest.mark.parametrize("correction", [(0.0, 0.0, 0.035), (0.1, -0.05, 0.0), (0.0, 0.0, 3.1), (0.05, 0.0, -0.5)])
def test_a_wrong_mounting_is_found(correction):
    found = calibrate(*drive(correction=correction))
    for estimate, truth, tolerance in zip(found.mounting, correction, (0.01, 0.01, 0.005), strict=True):
        assert estimate.value == pytest.approx(truth, abs=tolerance)
        assert abs(estimate.value - truth) < 4.0 * estimate.sigma


@pytest.mark.parametrize("turn_scale", [0.93, -1.0])
def test_scales_of_odometry_are_found(turn_scale):
    found = calibrate(*drive(turn_scale=turn_scale, distance_scale=1.12))
    assert found.turn_scale.value == pytest.approx(turn_scale, abs=0.01)
    if turn_scale < 0.0:
        return
    assert found.distance_scale.value == pytest.approx(1.12, abs=0.01)
    assert not found.delay.differs(0.0, 0.004)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_the_duration_of_a_scan_is_found(share):
    assert calibrate(*drive(share=share)).sweep_share.value == pytest.approx(share, abs=0.03)


def test_a_robot_that_hardly_moves_says_nothing():
    motions, odometry = drive()
    none = np.zeros(len(motions.stamps))
    still = ScanMotions(motions.stamps, np.zeros_like(motions.T_local_base), none, none, motions.last_s)
    found = calibrate(still, odometry)
    assert found.delay is None
    assert found.mounting is None

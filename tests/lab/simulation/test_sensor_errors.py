"""Errors of sensors: odometry drifts and ranges are noisy as the settings say."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from fcslam import config
from fcslam.errors import InputError
from fcslam.geometry import se2
from fcslam.lab.simulation.floorplan import draw_floor_plan
from fcslam.lab.simulation.noise import LidarSettings, simulate_ranges
from fcslam.lab.simulation.odometry import (
    KINDS,
    OdometryErrors,
    read_odometry,
    simulate_odometry,
)
from fcslam.lab.simulation.options import OdometryKind
from fcslam.lab.simulation.simulated_fleet import SimulationSettings
from fcslam.records import LaserModel
from tests.lab.simulation.driving import drive, route

NO_DRIFT = OdometryErrors(travel_noise_m=0, heading_noise_rad=0, turn_noise_rad=0, scale_bias=0, veer_bias_rad_m=0)
STRAIGHT = np.column_stack((np.linspace(0.0, 20.0, 401), np.zeros((401, 2))))


def true_drive(seed):
    rng = np.random.default_rng(seed)
    return drive(route(draw_floor_plan(rng), 60.0, rng), 0.2)[1]


def test_noise_and_dropouts_are_as_large_as_said():
    laser = LaserModel(400, -np.pi, 2.0 * np.pi / 400, 12.0)
    true = np.random.default_rng(1).uniform(0.5, 14.0, (300, 400)).clip(max=12.0)
    settings = LidarSettings(range_noise_m=0.02, dropout=0.1)
    ranges = simulate_ranges(true, laser, settings, np.random.default_rng(0))
    hit, returned = true < laser.max_range_m, ranges < laser.max_range_m
    assert not np.any(returned & ~hit)
    assert np.mean(~returned[hit]) == pytest.approx(0.1, abs=0.01)
    assert np.std((ranges - true)[returned]) == pytest.approx(0.02, rel=0.05)
    exact = LidarSettings(range_noise_m=0.0, dropout=0.0)
    np.testing.assert_array_equal(simulate_ranges(true, laser, exact, np.random.default_rng(0)), true)


def test_wheels_without_faults_tell_the_truth():
    truth = true_drive(0)
    odometry = simulate_odometry(truth, NO_DRIFT, np.random.default_rng(0))
    np.testing.assert_allclose(odometry[0], 0.0)
    np.testing.assert_allclose(se2.between(se2.compose(truth[0], odometry), truth), 0.0, atol=1e-9)


def test_heading_noise_grows_with_the_square_root_of_the_way():
    settings = replace(NO_DRIFT, heading_noise_rad=0.01)
    rng = np.random.default_rng(5)
    headings = np.array([simulate_odometry(STRAIGHT, settings, rng)[:, 2] for _ in range(400)])
    assert np.std(headings[:, 80]) == pytest.approx(0.02, rel=0.15)
    assert np.std(headings[:, 320]) == pytest.approx(0.04, rel=0.15)


@pytest.mark.parametrize(
    ("bias", "turn_share", "travel_share"), [("scale_bias", 1.0, 0.0), ("veer_bias_rad_m", 0.0, 1.0)]
)
def test_biases_grow_with_what_causes_them(bias, turn_share, travel_share):
    turning = np.column_stack((np.zeros((101, 2)), np.linspace(0.0, 3.0, 101)))
    driving = np.column_stack((np.linspace(0.0, 3.0, 101), np.zeros((101, 2))))
    settings, rng = replace(NO_DRIFT, **{bias: 0.01}), np.random.default_rng(6)
    for truth, share in ((turning, turn_share), (driving, travel_share)):
        wrong = np.array([simulate_odometry(truth, settings, rng)[:, 2] - truth[:, 2] for _ in range(400)])
        assert np.std(wrong[:, 100]) == pytest.approx(share * 0.03, rel=0.15, abs=1e-12)
        np.testing.assert_allclose(wrong[:, 50], wrong[:, 100] / 2.0, atol=1e-9)


STAMPS = 100.0 + 0.02 * np.arange(401)


def read(truth=STRAIGHT, seed=3, noise=NO_DRIFT, **faults):
    settings = replace(noise, **faults)
    return read_odometry(STAMPS, truth, settings, np.random.default_rng(seed))


def test_carpet_makes_distances_and_turns_too_long_on_a_quarter_of_the_floor():
    truth = STRAIGHT + np.array((0.0, 5.0, 0.3))
    steps = se2.relative(read(truth, carpet_slip=0.2).T_odom_base)
    on_carpet = (truth[:-1, 0] // 4.0) % 2 == 1
    np.testing.assert_allclose(np.hypot(*steps[:, :2].T), np.where(on_carpet, 0.06, 0.05), atol=1e-9)
    beside = read(STRAIGHT + np.array((0.0, 1.0, 0.0)), carpet_slip=0.2).T_odom_base
    np.testing.assert_allclose(beside, STRAIGHT, atol=1e-9)
    turning = np.column_stack((np.full((401, 2), 5.0), np.linspace(0.0, 2.0, 401)))
    assert read(turning, carpet_slip=0.2).T_odom_base[-1, 2] == pytest.approx(2.4)


def test_steps_hold_the_pose_between_updates():
    readings = read(update_hz=5.0)
    changes = np.flatnonzero(np.diff(readings.T_odom_base[:, 0])) + 1
    np.testing.assert_allclose(readings.stamps[changes] - 100.0, 0.2 * np.arange(1, 41), atol=1e-9)
    np.testing.assert_allclose(readings.T_odom_base[changes], STRAIGHT[changes], atol=1e-9)


def test_late_messages_have_the_poses_of_earlier():
    sound, late = read(), read(delay_s=0.2)
    np.testing.assert_array_equal(late.T_odom_base, sound.T_odom_base)
    stamps = np.array([100.01, 101.2, 103.21])
    np.testing.assert_allclose(late.at(stamps + 0.2), sound.at(stamps), atol=1e-12)
    assert late.at(np.array([100.1]))[0].tolist() == [0.0, 0.0, 0.0]


def test_a_reset_starts_at_zero_and_changes_no_motion():
    noise = KINDS[OdometryKind.GOOD]
    sound, reset = (read(noise=noise, **faults).T_odom_base for faults in ({}, {"reset_at": 0.5}))
    np.testing.assert_allclose(reset[200], 0.0, atol=1e-12)
    np.testing.assert_array_equal(reset[:200], sound[:200])
    np.testing.assert_allclose(se2.relative(reset)[200:], se2.relative(sound)[200:], atol=1e-9)


def test_scales_are_wrong_by_eight_percent_in_the_mean():
    ends = [read(noise=KINDS[OdometryKind.SCALED], seed=seed).T_odom_base[-1, 0] for seed in range(300)]
    assert np.mean(np.abs(np.array(ends) / 20.0 - 1.0)) == pytest.approx(0.08, abs=0.01)


@pytest.mark.parametrize(
    "content", [{"robots": 0}, {"path_length_m": -1}, {"lidar": {"dropout": 2}}, {"lidar": {"beam": 3}}]
)
def test_impossible_settings_are_refused(content):
    with pytest.raises(InputError, match="fleet"):
        config.parse(SimulationSettings, content, "fleet")


def test_good_odometry_is_right_to_a_few_percent_and_slipping_odometry_slips():
    _, poses = drive(np.array([[0.0, 0.0], [100.0, 0.0]]), 0.1)
    ends, steps = {}, {}
    for kind in (OdometryKind.GOOD, OdometryKind.SLIPPING):
        drives = np.array([simulate_odometry(poses, KINDS[kind], np.random.default_rng(k)) for k in range(100)])
        ends[kind], steps[kind] = drives[:, 500], np.linalg.norm(np.diff(drives[..., :2], axis=1), axis=2)
    half = poses[500, 0]
    good, slipping = ends[OdometryKind.GOOD], ends[OdometryKind.SLIPPING]
    assert np.std(good[:, 0] - half) < 0.04 * half
    assert np.rad2deg(np.std(good[:, 2])) < 6.0
    assert steps[OdometryKind.GOOD].max() < 0.15
    slips = steps[OdometryKind.SLIPPING] > 0.15
    assert 0.02 < slips.sum() / (len(slips) * 100.0) < 0.06
    assert 0.6 < steps[OdometryKind.SLIPPING].max() < 0.85
    assert np.std(slipping[:, 0]) > np.std(good[:, 0])


def test_scanners_of_less_than_a_turn_end_at_their_edges():
    sick = LidarSettings(beams=181, field_of_view_rad=np.pi)
    half, full = (settings.model((0.0, 0.0, 0.0)) for settings in (sick, LidarSettings()))
    np.testing.assert_allclose(half.angles_rad()[[0, 90, 180]], [-np.pi / 2.0, 0.0, np.pi / 2.0], atol=1e-12)
    assert full.angles_rad()[0] == -np.pi
    assert all(a < b for a, b in pairwise(full.angles_rad()))
    assert full.angles_rad()[-1] < np.pi - 0.5 * full.angle_increment_rad

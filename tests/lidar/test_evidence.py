"""One surface does not overrule odometry that was right, several do."""

import numpy as np
import pytest

from fcslam.lidar.evidence import SURFACE_NATS, over_steps, resolve, surface_gains, surfaces
from fcslam.lidar.field import field_of
from fcslam.lidar.matching import match_scan
from fcslam.lidar.odometry import OdometryError
from tests.lidar.worlds import path, room, scan_at

HERE = np.zeros(3)
RIGHT = OdometryError(0.01, 0.005)
"""Odometry that was right to a centimetre."""
HELD = np.diag((1e12, 1e12, 1e12))
"""Information that holds a match at the guess."""


def ramp(ground_m, at_x=0.0):
    """Two bare walls, and ground across the way, ``ground_m`` ahead of a robot at ``at_x``."""
    ground = path((at_x + ground_m, -3.0), (at_x + ground_m, 3.0))
    return np.vstack((path((-60, -3), (60, -3)), path((60, 3), (-60, 3)), ground))


def resolved(walls_before, walls_now, T_field_guess, pose=HERE, learned=RIGHT):
    field, scan = field_of([(scan_at(HERE, walls_before), HERE)]), scan_at(pose, walls_now)
    match = match_scan(scan, field, T_field_guess, np.diag((100.0, 100.0, 400.0)))
    return match, *resolve(scan, field, T_field_guess, match, learned, 0.0)


def test_ground_that_travels_along_does_not_hold_the_robot_back():
    step = np.array((0.3, 0.0, 0.0))
    match, chosen, contradicts = resolved(ramp(6.0), ramp(6.0, at_x=0.3), step, step)
    assert match.T_field_base[0] < 0.1
    assert chosen.T_field_base == pytest.approx(step, abs=0.03)
    assert contradicts


def test_several_surfaces_overrule_odometry():
    slip = np.array((0.4, 0.2, 0.1))
    match, chosen, contradicts = resolved(room(), room(), slip)
    assert chosen is match
    assert chosen.T_field_base == pytest.approx(HERE, abs=0.02)
    assert not contradicts


def test_odometry_that_was_wrong_before_does_not_overrule_a_single_surface():
    step = np.array((0.3, 0.0, 0.0))
    match, chosen, contradicts = resolved(ramp(6.0), ramp(6.0, at_x=0.3), step, step, OdometryError(0.3, 0.1))
    assert chosen is match
    assert not contradicts


def test_a_surface_counts_once_whatever_its_number_of_points():
    scan = scan_at(HERE, path((5.0, -4.0), (5.0, 4.0)))
    field = field_of([(scan, HERE)])
    here, off = (match_scan(scan, field, np.array((x, 0.0, 0.0)), HELD) for x in (0.0, 0.3))
    gains = here.log_likelihoods - off.log_likelihoods
    assert gains.sum() > 2.0 * SURFACE_NATS
    assert surface_gains(scan, gains) == pytest.approx([gains.sum()])


def test_gaps_and_corners_end_surfaces():
    scan = scan_at(HERE, np.vstack((path((3, -3), (3, 3), (-3, 3)), path((-3, -3), (-3, -1)))))
    assert len(set(surfaces(scan))) == 3
    assert len(surfaces(scan.only(np.zeros(len(scan), bool)))) == 0


def test_errors_of_many_steps_grow_with_the_root():
    error = OdometryError(1.6, 0.8)
    assert over_steps(error, 4.0, 0.25) == pytest.approx((0.4, 0.2))
    assert over_steps(error, 0.25, 0.25) == error
    assert over_steps(error, 0.0, 0.0) == error


@pytest.mark.parametrize(
    ("sigma_m", "explained", "is_kept"), [(0.026, 0.7, False), (0.1, 0.7, True), (0.026, 0.9, True)]
)
def test_odometry_corrects_a_match_near_it_only_if_it_is_exact_and_the_match_unclear(sigma_m, explained, is_kept):
    step = np.array((0.1, 0.0, 0.0))
    field, scan = field_of([(scan_at(HERE, ramp(25.0)), HERE)]), scan_at(step, ramp(25.0, at_x=0.1))
    match = match_scan(scan, field, step, np.diag((100.0, 100.0, 400.0)))
    match = match._replace(explained=explained * match.known)
    chosen, contradicts = resolve(scan, field, step, match, OdometryError(sigma_m, 0.02), 0.0)
    assert (chosen is match) == is_kept
    assert chosen.T_field_base[0] == pytest.approx(0.0 if is_kept else 0.1, abs=0.03)
    assert not contradicts


@pytest.mark.parametrize(("sigma_m", "explained", "is_kept"), [(0.03, 0.7, False), (0.03, 0.9, True), (0.1, 0.4, True)])
def test_unclear_match_is_kept_only_if_it_agrees_with_odometry(sigma_m, explained, is_kept):
    scan = scan_at(HERE, room())
    field = field_of([(scan, HERE)])
    off = match_scan(scan, field, np.array((0.1, 0.0, 0.0)), HELD)
    match = off._replace(explained=explained * off.known)
    chosen, _ = resolve(scan, field, HERE, match, OdometryError(sigma_m, 0.02), 0.0)
    assert (chosen is match) == is_kept


def test_where_no_surface_alone_pulls_a_match_from_odometry_the_trusting_one_has_tails():
    """A corridor with a few narrow posts: held by ten times odometry's information, they would not move the robot."""
    posts = [path((x, y), (x, 0.9 * y)) for x in (-6.0, -2.0, 3.0, 7.0) for y in (-3.0, 3.0)]
    walls = np.vstack((path((-60, -3), (60, -3)), path((60, 3), (-60, 3)), *posts))
    slip = np.array((0.15, 0.0, 0.0))
    seen = scan_at(HERE, walls)
    field, scan = field_of([(seen, HERE)]), seen.thinned(0.1, 180)
    match = match_scan(scan, field, slip, np.diag((100.0, 100.0, 400.0)))
    at_odometry = match_scan(scan, field, slip, HELD)
    weak = match._replace(log_likelihoods=at_odometry.log_likelihoods)
    chosen, contradicts = resolve(scan, field, slip, weak, RIGHT, 0.0)
    assert contradicts
    assert chosen.T_field_base == pytest.approx(HERE, abs=0.03)

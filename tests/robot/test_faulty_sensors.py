"""A scanner or an odometry that fails on the way: what a robot maps then."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.geometry import se2
from fcslam.robot.mapped_scans import MappedScans
from fcslam.robot.wheel_odometry import FROZEN
from tests import small_fleet
from tests.lidar.worlds import pose_errors

FIRST, LAST = 60, 100
"""Scans between which the sensor fails."""


@pytest.fixture(scope="module")
def robot():
    return small_fleet.draw(1, path_length_m=30.0).robots[0]


def drive(scans):
    return small_fleet.driven(scans)[0]


def errors_m(robot, track):
    """Of the positions of one session, each relative to its first pose."""
    return pose_errors(track.T_odom_base(), small_fleet.truth_at(robot, track.stamps))[0]


@pytest.mark.slow
def test_scans_that_the_driver_repeats_are_left_out(robot):
    scans = list(robot.scans())
    stalled = [
        replace(scan, ranges_m=scans[FIRST].ranges_m) if FIRST < number <= LAST else scan
        for number, scan in enumerate(scans)
    ]
    (track,) = drive(stalled).tracks
    gone = {scan.stamp for scan in scans} - set(track.stamps)
    assert len(gone) > 0.8 * (LAST - FIRST), "but those at which the robot stood"
    assert gone <= {scan.stamp for scan in scans[FIRST + 1 : LAST + 1]}
    assert errors_m(robot, track).max() < 0.3


@pytest.mark.slow
def test_odometry_that_freezes_on_the_way_ends_the_session_and_is_not_used_again(robot):
    """It goes on from the old value, as of an encoder without a plug: the motion meanwhile is missing.

    The odometry began far from where a prediction begins.
    """
    far = np.array([100.0, 50.0, 2.0])
    scans = [replace(scan, T_odom_base=se2.compose(far, scan.T_odom_base)) for scan in robot.scans()]
    held, again = scans[FIRST].T_odom_base, scans[LAST].T_odom_base
    for number, scan in enumerate(scans[FIRST:], FIRST):
        pose = held if number <= LAST else se2.compose(held, se2.between(again, scan.T_odom_base))
        scans[number] = replace(scan, T_odom_base=pose)
    frontend = drive(scans)
    before, after = frontend.tracks
    assert frontend.odometry.check.fault == FROZEN
    assert not frontend.motion.model.is_measured
    assert len(before) + len(after) > 0.95 * len(scans)
    assert scans[FIRST - 2].stamp <= before.stamps[-1] < scans[LAST].stamp
    assert errors_m(robot, before).max() < 0.3
    assert errors_m(robot, after).max() < 0.3


@pytest.mark.slow
def test_people_who_pass_a_robot_at_rest_end_no_session(robot):
    """Scans that change for a moment, while the odometry stands still for a good reason."""
    scans = list(robot.scans())[: FIRST + 1]
    rng = np.random.default_rng(0)
    for number in range(60):
        near = number % 12 < 6  # someone stands in front of the robot, again and again
        ranges_m = np.where(near, np.minimum(scans[FIRST].ranges_m, 0.6), scans[FIRST].ranges_m)
        noisy = (ranges_m + rng.normal(0.0, 0.01, len(ranges_m))).astype(np.float32)
        scans.append(replace(scans[FIRST], stamp=scans[FIRST].stamp + (number + 1) / 3.0, ranges_m=noisy))
    frontend = drive(scans)
    assert frontend.odometry.check.fault is None
    assert len(frontend.tracks) == 1


@pytest.mark.parametrize("seen", [np.inf, 0.0])
def test_a_covered_laser_clears_nothing(robot, seen):
    scan = next(iter(robot.scans()))
    covered = replace(scan, ranges_m=np.full_like(scan.ranges_m, seen), stamp=scan.stamp + 0.3)
    assert not MappedScans().of(covered).ranges_m.any()
    part = np.where(np.arange(len(scan.ranges_m)) < 100, seen, scan.ranges_m).astype(np.float32)
    mapped = MappedScans().of(replace(scan, ranges_m=part)).ranges_m
    assert np.array_equal(mapped[:100], np.full(100, seen, np.float32)), "of a scan with returns, inf is free"

"""Beams that are measured while the robot moves: each is placed where the robot was, and matching finds the motion."""

import numpy as np
import pytest

from fcslam.geometry import se2
from fcslam.lidar.field import field_of
from fcslam.lidar.matching import FIXED, match_scan
from fcslam.lidar.occupancy import Casting, OccupancyConfig, cast
from fcslam.lidar.scan import point_scan, rays_of
from fcslam.records import LaserModel, Sweep
from tests.lidar.worlds import box
from tests.lidar.worlds import cast as cast_rays

pytestmark = pytest.mark.slow

LASER = LaserModel(360, -np.pi, 2.0 * np.pi / 360, 20.0, (0.12, -0.05, 0.2))
HALF_M = np.array((3.0, 2.2))
"""Half the sides of the room around the origin."""
SWEEP = Sweep(0.0, 0.14, (0.5, -0.05, 1.3), (0.8, 0.2, -4.0))
NO_PRIOR = np.zeros((3, 3))


def ranges_in_room(T_room_base, sweep, laser=LASER):
    """Ranges to the walls, each from where the laser is at the time of its beam; the oracle of every test."""
    T_room_laser = np.tile(se2.compose(T_room_base, laser.T_base_laser), (laser.beam_count, 1))
    if sweep is not None:
        moved = [sweep.displacement(t) for t in np.linspace(*sweep[:2], laser.beam_count)]
        T_room_laser = se2.compose(se2.compose(T_room_base, np.array(moved)), laser.T_base_laser)
    walls = box(*-HALF_M, *HALF_M)
    return cast_rays(T_room_laser[:, :2], T_room_laser[:, 2] + laser.angles_rad(), walls).astype(np.float32)


def distance_to_walls(points):
    return np.abs(np.abs(points) - HALF_M).min(axis=1)


@pytest.mark.parametrize(
    "sweep",
    [
        SWEEP,
        SWEEP._replace(first_s=0.14, last_s=0.0),
        SWEEP._replace(first_s=-0.14, last_s=0.0),
        SWEEP._replace(first_s=-0.07, last_s=0.07),
    ],
    ids=["first beam stamped", "clockwise", "last beam stamped", "middle stamped"],
)
def test_every_return_lies_on_its_wall(sweep):
    pose = np.array((0.3, -0.2, 0.7))
    scan = point_scan(ranges_in_room(pose, sweep), LASER, sweep)
    assert distance_to_walls(se2.transform(pose, scan.points)).max() < 1e-5
    assert np.allclose(np.hypot(*scan.normals[(scan.normals != 0.0).any(axis=1)].T), 1.0)


def test_without_the_times_the_returns_are_off():
    pose = np.array((0.3, -0.2, 0.7))
    scan = point_scan(ranges_in_room(pose, SWEEP), LASER)
    assert distance_to_walls(se2.transform(pose, scan.points)).max() > 0.1


def test_a_robot_at_rest_needs_no_times():
    ranges = ranges_in_room(np.zeros(3), None)
    swept, at_once = point_scan(ranges, LASER, Sweep(0.0, 0.14)), point_scan(ranges, LASER)
    np.testing.assert_allclose(swept.points, at_once.points, atol=1e-12)
    np.testing.assert_allclose(swept.normals, at_once.normals, atol=1e-9)
    assert swept.times_s[0] == 0.0
    assert swept.times_s[-1] == pytest.approx(0.14)


def test_a_match_finds_pose_and_velocity():
    """From a velocity that is off by 0.8 rad/s: what a robot without odometry predicts while it brakes."""
    field = field_of([(point_scan(ranges_in_room(np.zeros(3), None), LASER), np.zeros(3))])
    truth = np.array((0.2, 0.1, 0.3))
    sweep, guess = Sweep(0.0, 0.14, (0.5, 0.0, 1.3)), truth + np.array((0.02, -0.02, 0.02))
    assumed = sweep._replace(velocity=(0.5, 0.0, 0.5))
    scan = point_scan(ranges_in_room(truth, sweep), LASER, assumed)
    loose = match_scan(scan, field, guess, NO_PRIOR, np.array((4.0, 4.0, 1.0)))
    assert loose.velocity[2] == pytest.approx(0.8, abs=0.05)
    np.testing.assert_allclose(loose.T_field_base, truth, atol=0.02)
    fixed = match_scan(scan, field, guess, NO_PRIOR, FIXED)
    assert np.abs(fixed.velocity).max() < 1e-6
    assert abs(fixed.T_field_base[2] - truth[2]) > 5.0 * abs(loose.T_field_base[2] - truth[2])


def test_an_open_velocity_costs_information():
    field = field_of([(point_scan(ranges_in_room(np.zeros(3), None), LASER), np.zeros(3))])
    scan = point_scan(ranges_in_room(np.zeros(3), SWEEP), LASER, SWEEP)
    matches = [match_scan(scan, field, np.zeros(3), NO_PRIOR, np.full(3, known)).information for known in (1.0, 1e12)]
    assert np.linalg.eigvalsh(matches[1] - matches[0]).min() > -1e-3
    assert np.trace(matches[1]) > 1.5 * np.trace(matches[0])


def test_occupancy_rays_begin_where_the_robot_was():
    """Walls of the swept scan fill the cells of the walls, and no cell in front of them."""
    config, pose = OccupancyConfig(resolution_m=0.05), np.array((0.31, -0.22, 0.7))
    grid = cast([Casting(ranges_in_room(pose, SWEEP), LASER, pose, SWEEP)], config)
    rows, columns = np.nonzero(grid.hits)
    hits = (np.stack((columns, rows), axis=1) + 0.5) * grid.resolution_m + grid.origin_xy
    assert distance_to_walls(hits).max() < 0.06
    origins, _ = rays_of(LASER, SWEEP)
    assert np.linalg.norm(origins[-1] - origins[0]) > 0.05


def test_a_turn_that_begins_within_a_scan_is_found_against_a_confident_prior():
    """The prior of a robot that drove straight: points that say 1.5 rad/s outweigh its standard deviation of 0.06."""
    pose, quarter_s = np.array((0.3, -0.2, 0.7)), Sweep(0.0, 0.25)
    field = field_of([(point_scan(ranges_in_room(np.zeros(3), None), LASER), np.zeros(3))])
    turning = quarter_s._replace(velocity=(0.0, 0.0, 1.5))
    scan = point_scan(ranges_in_room(pose, turning), LASER, quarter_s)
    confident = np.array((0.04, 0.04, 0.06)) ** -2.0
    found = match_scan(scan, field, pose, np.diag((100.0, 100.0, 25.0)), confident)
    assert found.velocity[2] == pytest.approx(1.5, rel=0.2)
    assert np.abs(found.T_field_base - pose).max() < 0.03

"""Scanners whose beams vary, and several on one robot, from the sensor to the map."""

import numpy as np
import pytest

from fcslam.geometry import se2
from fcslam.maps.occupancy_map import Occupancy, parse_map
from fcslam.mission.mission import MissionConfig, run_mission
from fcslam.records import Beams, LaserModel
from fcslam.wire.messages import Hello
from tests.lidar.worlds import Recording, box, drifting, drive, path, pose_errors, recording, ring, ring_drive
from tests.small_fleet import driven

pytestmark = pytest.mark.slow

HALF = LaserModel(181, -np.pi / 2, np.deg2rad(1.0), 20.0)
TURN = LaserModel(360, -np.pi, np.deg2rad(1.0), 20.0)


def interleaved(number):
    count, first, increment = HALF.beams
    return HALF.with_beams(Beams(count - (number % 4 > 0), first + 0.25 * (number % 4) * increment, increment))


def jittering(number):
    count = 360 + (7 * number) % 23 - 11
    return TURN.with_beams(Beams(count - (number % 5 == 0), -np.pi, 2.0 * np.pi / count))


def mapped(scans):
    run = run_mission([Recording(scans)], MissionConfig())
    return run, run.trajectories["r"].T_map_base


@pytest.fixture(scope="module")
def truth():
    return ring_drive(1.1)


@pytest.fixture(scope="module")
def odometry(truth):
    return drifting(truth, np.random.default_rng(4), scale=1.03, veer_rad_m=0.015, noise=0.02)


@pytest.mark.parametrize("laser_of", [interleaved, jittering])
def test_a_scanner_whose_beams_vary_maps_as_well_as_one_whose_do_not(truth, odometry, laser_of):
    errors = {}
    for name, laser in (("varying", laser_of), ("steady", laser_of(4))):
        run, poses = mapped(recording(truth, odometry, ring(), laser, seed=3))
        errors[name] = pose_errors(poses, truth)[0].mean()
        assert run.metrics["intra_robot_closures_accepted"].value > 0
    assert errors["varying"] < 1.15 * errors["steady"] + 0.005
    assert errors["varying"] < 0.05


REAR = LaserModel(181, -np.pi / 2, np.deg2rad(1.0), 20.0, (-0.2, 0.0, np.pi))
FRONT = LaserModel(181, -np.pi / 2, np.deg2rad(1.0), 20.0, (0.2, 0.0, 0.0))


def in_turn(number):
    return (FRONT, REAR)[number % 2]


def hall():
    """A hall whose far wall, behind the robot, only the rear laser sees."""
    return np.vstack((box(-6, -2, 8, 2), path((1, 2), (1, 1.2), (2, 1.2), (2, 2)), path((4, -2), (4.5, -1), (5, -2))))


@pytest.fixture(scope="module")
def two_lasers():
    """A drive straight ahead, with each laser alone and with both in turn."""
    poses = drive([(0.0, 0.0), (5.0, 0.3)], step_m=0.05)
    odometry = drifting(poses, np.random.default_rng(1))
    both = recording(poses, odometry, hall(), in_turn, seed=3)
    return poses, both


def occupied_near(run, poses, x, truth):
    """Occupied cells within 0.1 m of the wall at ``x`` of the world, away from its corners."""
    grid = parse_map("map", run.map_files["map.pgm"], run.map_files["map.yaml"].decode())
    T_world_map = se2.compose(truth[0], se2.inverse(poses[0]))
    rows, columns = np.nonzero(grid.cells == Occupancy.OCCUPIED)
    centres = np.column_stack((columns, rows)) * grid.resolution_m + np.array(grid.origin_xy) + 0.5 * grid.resolution_m
    found = se2.transform(T_world_map, centres)
    return int(np.sum((np.abs(found[:, 0] - x) < 0.1) & (np.abs(found[:, 1]) < 1.5)))


def test_the_map_of_two_lasers_has_what_only_one_of_them_saw(two_lasers):
    truth, both = two_lasers
    front = [scan for scan in both if scan.laser == FRONT]
    run_both, poses_both = mapped(both)
    run_front, poses_front = mapped(front)
    assert occupied_near(run_front, poses_front, -6.0, truth[::2]) == 0
    assert occupied_near(run_both, poses_both, -6.0, truth) > 40
    assert occupied_near(run_both, poses_both, 8.0, truth) > 40
    errors = pose_errors(poses_both, truth)[0].mean(), pose_errors(poses_front, truth[::2])[0].mean()
    assert errors[0] < errors[1] + 0.005
    assert run_both.metrics["keyscans"].value == pytest.approx(2 * run_front.metrics["keyscans"].value, abs=2)


def test_a_laser_is_announced_before_its_first_keyscan(two_lasers):
    bodies = [packet.body for packet in driven(two_lasers[1])[1]]
    hellos = [body.lasers for body in bodies if isinstance(body, Hello)]
    assert hellos == [(FRONT,), (FRONT, REAR)]
    lasers = [body.laser for body in bodies if hasattr(body, "ranges_m")]
    assert lasers[:4] == [0, 1, 0, 1]
    assert all(body.beams is None for body in bodies if hasattr(body, "ranges_m"))


def test_a_laser_that_always_scans_just_after_the_other_is_matched_too():
    """The robot moves by less than ``still_m`` in between, so only odometry could tell the second pose."""
    truth = np.repeat(drive([(0.0, 0.0), (5.0, 0.3)], step_m=0.1), 2, axis=0)
    scans = recording(truth, truth, hall(), in_turn, seed=3)
    run, poses = mapped(scans)
    assert occupied_near(run, poses, -6.0, truth) > 40

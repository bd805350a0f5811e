"""Odometry that no robot can have is bridged."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.geometry import se2
from fcslam.records import CameraImage, CameraModel, Channel, LaserModel, LaserScan, Transform, frozen
from fcslam.robot.frontend import RobotConfig
from fcslam.robot.wheel_odometry import WheelOdometry
from tests import small_fleet
from tests.lidar.worlds import chain

LASER = LaserModel(3, -1.0, 1.0, 10.0)
CAMERA = CameraModel(1, 1, 1.0, 1.0, 0.0, 0.0, Transform((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
RANGES = frozen(np.ones(3), np.float32)


def scans_of(poses, step_s=0.1):
    return [LaserScan(step_s * k, RANGES, LASER, frozen(pose)) for k, pose in enumerate(poses)]


def wandering(count, seed):
    rng = np.random.default_rng(seed)
    return chain(rng.uniform((-0.05, -0.05, -0.1), (0.2, 0.05, 0.1), (count - 1, 3)))


def bridged(poses):
    """The poses after the bridges, and the number of jumps."""
    odometry = WheelOdometry()
    return np.array([odometry.place(scan).T_odom_base for scan in scans_of(poses)]), odometry.jumps


def test_odometry_without_a_jump_is_not_touched():
    scans, odometry = scans_of(wandering(100, 0)), WheelOdometry()
    assert all(odometry.place(scan) is scan for scan in scans)
    assert odometry.jumps == 0


@pytest.mark.parametrize("far", [(30.0, 0.0, 0.0), (3e3, -2e3, 1.0), (1e5, 1e5, -3.0), (0.0, 0.0, 3.1)])
@pytest.mark.parametrize("lasting", [1, 4, 1000])
def test_motions_that_do_not_jump_are_kept_whatever_jumps_lie_between(far, lasting):
    """A spike jumps twice, a reset once."""
    poses = wandering(60, 1)
    read = poses.copy()
    read[30 : 30 + lasting] = se2.compose(np.array(far), poses[30 : 30 + lasting])
    found, jumps = bridged(read)
    jumped = {29} | ({29 + lasting} if 30 + lasting < 60 else set())
    assert jumps == len(jumped)
    kept = [k for k in range(59) if k not in jumped]
    np.testing.assert_allclose(se2.relative(found)[kept], se2.relative(poses)[kept], atol=1e-6)
    assert np.hypot(*se2.relative(found)[:, :2].T).max() < 0.25


@pytest.mark.parametrize("broken", [np.nan, np.inf])
def test_a_reading_that_is_no_number_is_bridged(broken):
    poses = wandering(20, 2)
    poses[10] = broken
    found, jumps = bridged(poses)
    assert np.isfinite(found).all()
    assert jumps == 1


def test_a_bridge_is_never_taken_for_standing_still():
    """The tracker does not match the scans of a robot that stands."""
    poses = np.zeros((10, 3))
    poses[5:, 0] = 1e3
    found, _ = bridged(poses)
    assert np.hypot(*(found[5] - found[4])[:2]) == pytest.approx(0.02)


def test_scans_without_a_clock_may_be_metres_apart():
    poses = np.zeros((5, 3))
    poses[:, 0] = 4.0 * np.arange(5)
    odometry = WheelOdometry()
    for scan in scans_of(poses, step_s=0.0):
        odometry.place(scan)
    assert odometry.jumps == 0


def test_images_move_with_the_scans():
    poses = wandering(40, 3)
    read = poses.copy()
    read[20:] = se2.compose(np.array((500.0, 0.0, 2.0)), poses[20:])
    odometry = WheelOdometry()
    for scan in scans_of(read):
        seen = odometry.place(scan)
        offset = np.array((0.1, 0.02, 0.03))
        image = CameraImage(scan.stamp, b"", CAMERA, frozen(se2.compose(scan.T_odom_base, offset)))
        np.testing.assert_allclose(
            se2.between(seen.T_odom_base, odometry.place_image(image).T_odom_base), offset, atol=1e-6
        )
        without = replace(image, T_odom_base=None)
        assert odometry.place_image(without) is without


@pytest.mark.slow
@pytest.mark.parametrize("far_m", [3.0, 30.0, 3e3, 2e4, 1.5e5])
def test_a_robot_maps_on_through_spikes(far_m):
    robot = small_fleet.draw(1, path_length_m=12.0).robots[0]
    scans = list(robot.scans())
    read = list(scans)
    for k in (len(scans) // 4, len(scans) // 2, 3 * len(scans) // 4):
        away = se2.compose(scans[k].T_odom_base, np.array((far_m, 0.3 * far_m, 0.5)))
        read[k] = replace(scans[k], T_odom_base=frozen(away))

    def mapped(records):
        frontend, _ = small_fleet.driven(records, RobotConfig(channels=(Channel.LIDAR,)))
        assert len(frontend.tracks) == 1
        return frontend, frontend.scan_poses.T_odom_base()

    frontend, poses = mapped(read)
    assert frontend.odometry.jumps == 6
    error = se2.between(mapped(scans)[1], poses)
    assert np.hypot(error[:, 0], error[:, 1]).max() < 0.03
    assert np.abs(error[:, 2]).max() < 0.01

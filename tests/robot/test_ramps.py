"""Robots whose clouds are 2D scans: a drive over a ramp is named, and nothing else is."""

import numpy as np
import pytest

from fcslam import map_recordings
from fcslam.robot.calibrating import ramps_of
from fcslam.runs import Use
from fcslam.sources import open_source
from fcslam.sources.point_clouds import CloudMounting, slopes_of
from tests.sources.bag_messages import odom, quaternion, save, tf
from tests.sources.clouds import VELODYNE, Measured, cloud, rotation, said
from tests.sources.test_bag_clouds import START

LIDAR = np.array([0.1, 0.0, 0.5])
FOOT_M, TOP_M, SLOPE_RAD = 4.0, 8.0, np.radians(7.0)


def height(x):
    return np.tan(SLOPE_RAD) * np.clip(x - FOOT_M, 0.0, TOP_M - FOOT_M)


def seen(x, yaw, pitch, is_flat):
    """The points of a corridor from a robot at ``x``."""
    along, across = np.meshgrid(np.arange(-4.5, 4.5, 0.15) + x, np.linspace(-1.2, 1.2, 9))
    walls = [np.array([a, y, z]) for a in along[0] for y in (-1.3, 1.3) for z in (0.3, 0.5, 0.9)]
    world = np.vstack((np.column_stack((along.ravel(), across.ravel(), np.zeros(along.size))), walls))
    if not is_flat:
        world[:, 2] += height(world[:, 0])
    in_base = (world - [x, 0.0, 0.0 if is_flat else height(x)]) @ (rotation(yaw=yaw) @ rotation(pitch=pitch))
    return in_base[np.hypot(in_base[:, 0], in_base[:, 1]) > 1.0]


def bag_of(path, poses, is_flat=False, leaning_rad=0.0):
    messages = [tf(START, "base_link", "lidar", tuple(LIDAR), quaternion(), topic="/tf_static")]
    for number, (x, yaw, pitch) in enumerate(poses):
        stamp = START + 0.1 * number
        points = (seen(x, yaw, pitch, is_flat) - LIDAR) @ rotation(pitch=leaning_rad)
        measured = Measured(points, np.linspace(0.0, 0.1, len(points)))
        messages += [said("/points", stamp, cloud(stamp, measured, VELODYNE)), odom(stamp, (x, 0.0, yaw))]
    return open_source(save(path / "drive.mcap", messages))


def drive(first_m, last_m, step_m=0.1):
    """Along the corridor; the wheels of a robot are 0.4 m apart."""
    xs = np.arange(first_m, last_m, np.copysign(step_m, last_m - first_m))
    pitches = np.arctan2(height(xs + 0.2) - height(xs - 0.2), 0.4)
    return np.column_stack((xs, np.zeros(len(xs)), -pitches))


@pytest.mark.slow
@pytest.mark.parametrize(("first_m", "last_m", "end_s"), [(1.0, 11.0, 8), (11.0, 1.0, 8), (1.0, 7.0, 3)])
def test_a_drive_over_a_ramp_is_named(tmp_path, first_m, last_m, end_s):
    source = bag_of(tmp_path, drive(first_m, last_m))
    said = f"{source.path}: the robot drives over a ramp between 2 s and {end_s} s, and a 2D map is wrong there; "
    assert ramps_of(source) == (said + "map with --3d",)


@pytest.mark.slow
def test_the_verdict_on_a_2d_map_counts_a_ramp(tmp_path):
    verdict = map_recordings(bag_of(tmp_path, drive(1.0, 11.0)).path).verdict[0]
    assert verdict.use is Use.WAIT
    assert "drives over a ramp" in " ".join((str(verdict), *verdict.details))


@pytest.mark.slow
@pytest.mark.parametrize("leaning_rad", [0.0, np.radians(5.0)])
@pytest.mark.parametrize("kind", ["flat", "nods", "turns"])
def test_no_ramp_is_named_on_a_flat_floor(tmp_path, kind, leaning_rad):
    poses = drive(0.0, 6.0) * [1.0, 0.0, 0.0]
    if kind == "nods":
        poses[:, 2] = np.radians(6.0) * np.sign(np.sin(np.arange(len(poses)) / 5.0))
    elif kind == "turns":  # in front of a ramp
        poses = drive(1.0, FOOT_M - 0.7)
        turn = np.column_stack((np.full(20, FOOT_M - 0.7), np.linspace(0.0, np.pi, 20), np.zeros(20)))
        poses = np.vstack((poses, turn, poses[::-1] + np.array([0.0, np.pi, 0.0])))
    assert not ramps_of(bag_of(tmp_path, poses, kind != "turns", leaning_rad))


def test_a_wall_with_little_floor_before_it_shows_no_slope():
    corridor = seen(0.0, 0.0, 0.0, is_flat=True)
    wall = np.array([(-2.6, y, z) for y in np.arange(-1.2, 1.2, 0.1) for z in np.arange(0.0, 1.0, 0.05)])
    points = np.vstack((corridor[corridor[:, 0] > -2.6], wall))
    mounting = CloudMounting(rotation(pitch=np.radians(4.0)), LIDAR, 0.0)
    ahead_rad, behind_rad = slopes_of((points - LIDAR) @ mounting.rotation.T + LIDAR, mounting)
    assert np.degrees(ahead_rad) == pytest.approx(-4.0, abs=0.5)
    assert np.isnan(behind_rad)

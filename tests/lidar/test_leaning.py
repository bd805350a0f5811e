"""A laser that leans sees the floor in a line that moves with the robot: it is left out of the map. A wall is not."""

import math
from dataclasses import replace

import numpy as np
import pytest

from fcslam.geometry import se2
from fcslam.lidar.facing import watch_facing
from fcslam.lidar.frontend import LidarConfig
from fcslam.lidar.leaning import floor_line, wrong_laser
from fcslam.metrics.trajectory import PositionErrors, align, position_errors
from fcslam.records import LaserModel, LaserScan, frozen
from fcslam.robot.calibrating import calibrated
from fcslam.sources import open_source, write_bag
from fcslam.sources.bags.options import BagCorrection
from fcslam.sources.returns import FloorLine
from tests.carmen_logs import write_carmen
from tests.lidar import worlds
from tests.small_fleet import driven

pytestmark = pytest.mark.slow

LASER = LaserModel(360, -math.pi, math.radians(1.0), 20.0, (0.2, 0.0, 0.5))
POSES = worlds.ring_drive(rounds=1.5)
SCANS = worlds.recording(POSES, POSES, worlds.ring(), LASER)


def with_floor(floor, scans=SCANS, nod=0.02):
    """Scans of a robot that nods, and whose laser sees the floor."""
    rng = np.random.default_rng(2)

    def ranges(scan):
        ahead = np.cos(scan.laser.angles_rad() - floor.heading_rad)
        distance_m = floor.distance_m * (1.0 + nod * rng.normal())
        at_m = distance_m / np.maximum(ahead, 1e-3) + rng.normal(0.0, 0.02, len(ahead))
        return frozen(np.minimum(scan.ranges_m, np.where(ahead > 0.1, at_m, np.inf)), np.float32)

    return [replace(scan, ranges_m=ranges(scan)) for scan in scans]


@pytest.mark.parametrize("floor", [FloorLine(2.0, 0.0), FloorLine(2.5, 0.5), FloorLine(1.5, -3.1)])
def test_the_line_is_found(floor):
    found = floor_line(with_floor(floor))
    assert found.distance_m == pytest.approx(floor.distance_m, rel=0.06)
    assert abs(se2.wrap_angle(found.heading_rad - floor.heading_rad)) < 0.05
    scans = [scan for scan in with_floor(floor) for scan in (scan, scan)]
    assert floor_line(scans) == found, "scans at one place count once"


def test_level_lasers_and_short_drives_tell_nothing():
    leaning = with_floor(FloorLine(2.0, 0.0))
    assert floor_line(SCANS) is None
    assert floor_line(leaning[:100]) is None
    assert floor_line([replace(scan, T_odom_base=frozen((math.nan,) * 3)) for scan in leaning]) is None
    in_millimetres = [replace(scan, T_odom_base=frozen(scan.T_odom_base * (1e3, 1e3, 1.0))) for scan in SCANS]
    assert floor_line(in_millimetres) is None, "every wall moves with the robot"


def test_walls_at_one_distance_along_a_corridor_are_no_floor():
    ahead = [(x, 0.0, 0.0) for x in np.arange(0.0, 20.0, 0.3)]
    turning = [(20.0, 0.0, angle) for angle in np.arange(0.0, math.pi, 0.35)]
    back = [(x, 0.0, math.pi) for x in np.arange(20.0, 0.0, -0.3)]
    poses = np.array([*ahead, *turning, *back, *((0.0, 0.0, math.pi + angle) for _, _, angle in turning)])
    assert floor_line(worlds.recording(poses, poses, worlds.corridor(), LASER)) is None


def circle(radius_m, corners=72):
    angles = np.linspace(0.0, 2.0 * math.pi, corners + 1)
    return radius_m * np.stack((np.cos(angles), np.sin(angles)), axis=1)


def lane(radius_m, half_m=6.0):
    """An oval with two straight sides."""
    right, left = np.array_split(np.roll(circle(radius_m)[:-1], 18, axis=0), 2)
    return np.concatenate((right, left)) + np.repeat([(half_m, 0.0), (-half_m, 0.0)], len(right), axis=0)


@pytest.mark.parametrize("outline", [circle, lane])
def test_the_wall_of_a_lane_and_of_a_round_building_is_mapped(tmp_path, outline):
    walls = np.vstack([worlds.path(*outline(radius_m), closed=True) for radius_m in (1.8, 4.5)])
    piers = [worlds.box(x - 0.2, y - 0.2, x + 0.2, y + 0.2) for x, y in outline(1.8)[::9]]
    poses = worlds.drive([*outline(3.0), *outline(3.0)[:40]])
    odometry = worlds.drifting(poses, np.random.default_rng(1))
    write_bag(tmp_path / "r.mcap", worlds.recording(poses, odometry, np.vstack((walls, *piers)), LASER))
    source = calibrated(open_source(tmp_path / "r.mcap"), LidarConfig())
    assert source.survey().notes == ()
    found = path_of(source)
    assert PositionErrors.of(position_errors(align(poses, found), poses, found)).rmse_m < 0.02


def test_what_is_at_the_line_or_beyond_is_left_out_and_nothing_else():
    floor = FloorLine(2.0, 0.7)
    angles = LASER.angles_rad()
    scan = replace(SCANS[0], ranges_m=frozen(np.full(360, 1.5), np.float32))
    assert np.array_equal(floor.left_out(scan).ranges_m, scan.ranges_m)
    for far in (3.0, np.inf):
        kept = np.isfinite(floor.left_out(replace(scan, ranges_m=frozen(np.full(360, 3.0), np.float32))).ranges_m)
        assert np.array_equal(kept, 3.0 * np.cos(angles - 0.7) <= 0.88 * 2.0)
        nothing = floor.left_out(replace(scan, ranges_m=frozen(np.full(360, far), np.float32))).ranges_m
        assert np.isnan(nothing[np.cos(angles - 0.7) > 0.6]).all()


def path_of(source):
    """Poses of all scans in the local map of a robot."""
    (track,) = driven(source.records())[0].tracks
    return track.T_odom_base()


def largest_error_m(source):
    return worlds.pose_errors(path_of(source), POSES)[0].max()


@pytest.mark.parametrize("upside_down", [False, True])
def test_a_bag_is_mapped_without_the_floor(tmp_path, upside_down):
    path = tmp_path / "leaning.bag"
    write_bag(path, with_floor(FloorLine(2.0, 0.4)))
    bag = open_source(path)
    if upside_down:  # as tf says; the scans tell that it is not
        bag = bag.corrected(BagCorrection(upside_down=True), ())
    source = calibrated(bag, LidarConfig())
    said = [note for note in source.survey().notes if "sees the floor" in note]
    assert len(said) == 1
    assert "a line 2." in said[0]
    assert said[0].endswith("mount it level; its returns are left out")
    assert largest_error_m(source) < (0.2 if upside_down else 0.05)
    assert upside_down or largest_error_m(bag) > 0.3


def test_a_log_names_the_beams_to_leave_out(tmp_path):
    path = tmp_path / "leaning.log"
    write_carmen(path, with_floor(FloorLine(2.0, 0.0), scans=SCANS))
    notes = calibrated(open_source(path), LidarConfig()).survey().notes
    (said,) = (note for note in notes if "sees the floor" in note)
    assert "robot: {lidar: {ignore: [[" in said


def test_a_live_robot_is_told():
    poses = worlds.drive(3 * [(-3.0, -1.0), (1.5, -2.0), (3.2, 1.0), (-0.5, 2.0)], step_m=0.15)
    scans = worlds.recording(poses, poses, worlds.room(), LASER)
    seen: list[LaserScan] = []
    found = [watch_facing(seen, scan) for scan in with_floor(FloorLine(2.0, 0.0), scans)]
    (watched,) = filter(len, found)
    assert "the laser leans and sees the floor: a line 2." in str(wrong_laser(watched))

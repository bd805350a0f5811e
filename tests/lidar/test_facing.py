"""A laser that is turned or upside down contradicts the odometry, and how it faces is found."""

import math
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

import fcslam
from fcslam.geometry import se2
from fcslam.lidar.facing import AS_STATED, contradicted_facing
from fcslam.lidar.frontend import LidarConfig
from fcslam.live.records import Wiring
from fcslam.records import LaserModel, LaserScan, Sweep, frozen
from fcslam.robot.calibrating import calibrate_bag, calibrated
from fcslam.sources import BagOptions, open_source, write_bag
from tests.carmen_logs import write_carmen
from tests.lidar import worlds
from tests.live.same_thread import SameThread

pytestmark = pytest.mark.slow

SAMPLE_LOG = Path(__file__).parents[2] / "examples" / "logs" / "anna.clf.xz"
NARROW = LaserModel(91, -math.pi / 2, math.radians(2.0), 5.0, (0.2, 0.05, 0.0))
WIDE = LaserModel(180, -math.pi, math.radians(2.0), 12.0, (0.2, 0.05, 0.0))


@lru_cache
def drive(laser, rounds=0.6):
    poses = worlds.ring_drive(rounds)
    rng = np.random.default_rng(3)
    return worlds.recording(poses, worlds.drifting(poses, rng), worlds.ring(), laser)


def stated(scans, turned_deg=0.0, upside_down=False, distance=1.0):
    """The scans of a laser that faces so against what is stated, or of odometry with such a scale."""
    found = []
    for scan in scans:
        x, y, theta = scan.laser.T_base_laser
        laser = replace(scan.laser, T_base_laser=(x, y, theta - math.radians(turned_deg)))
        ranges_m = scan.ranges_m
        if upside_down:
            first_rad = -(laser.angle_min_rad + laser.beams.span_rad)
            laser, ranges_m = replace(laser, angle_min_rad=first_rad), frozen(ranges_m[::-1], np.float32)
        odometry = frozen(scan.T_odom_base / (distance, distance, 1.0))
        found.append(LaserScan(scan.stamp, ranges_m, laser, odometry, scan.sweep))
    return found


@pytest.mark.parametrize(
    ("laser", "turned_deg", "upside_down"),
    [(NARROW, 0, False), (NARROW, 180, False), (NARROW, 40, False), (NARROW, 0, True), (NARROW, 90, True),
     (WIDE, 0, False), (WIDE, 180, True), (WIDE, -90, False)],
    ids=str,
)  # fmt: skip
def test_how_a_laser_faces_is_found(laser, turned_deg, upside_down):
    found = contradicted_facing(stated(drive(laser), turned_deg, upside_down))
    if not turned_deg and not upside_down:
        assert found is None
        return
    assert math.remainder(found.facing.turned_deg - turned_deg, 360.0) == pytest.approx(0.0, abs=3.0)
    assert found.facing.upside_down == upside_down
    assert found.agreement > found.stated_agreement + 0.15


def test_a_bare_corridor_does_not_tell():
    poses = worlds.drive([(0.0, 0.0), (20.0, 0.0)])
    scans = worlds.recording(poses, poses, worlds.corridor(), WIDE)
    for turned_deg, upside_down in ((0, False), (180, False), (0, True)):
        assert contradicted_facing(stated(scans, turned_deg, upside_down)) is None


@pytest.mark.parametrize("turned_deg", [180, 90])
def test_a_drive_of_three_metres_is_enough(turned_deg):
    scans = drive(WIDE)[:36]
    assert contradicted_facing(scans) is None
    assert contradicted_facing(stated(scans, turned_deg)).facing.turned_deg == pytest.approx(turned_deg, abs=3.0)


@pytest.mark.parametrize("clockwise", [False, True])
def test_a_turn_of_one_second_fits_the_odometry(clockwise):
    t = np.arange(0.0, 40.0, 0.02)
    poses = np.stack((2.0 * np.cos(0.3 * t), 1.5 * np.sin(0.6 * t), np.sin(1.3 * t)), axis=1)

    def pose(stamp):
        return np.stack([np.interp(stamp, t, axis) for axis in poses.T], axis=-1)

    beam_s = np.linspace(1.0, 0.0, WIDE.beam_count) if clockwise else np.linspace(0.0, 1.0, WIDE.beam_count)
    scans = []
    for stamp in np.arange(0.0, 38.0):
        seen = worlds.ranges(pose(stamp + beam_s), worlds.room(), WIDE)
        twist = se2.log(se2.between(pose(stamp), pose(stamp + 0.02))) / 0.02
        later = se2.log(se2.between(pose(stamp + 0.98), pose(stamp + 1.0))) / 0.02
        sweep = Sweep(beam_s[0], beam_s[-1], tuple(twist), tuple(later - twist))
        ranges_m = frozen(np.diagonal(seen).copy(), np.float32)
        scans.append(LaserScan(stamp, ranges_m, WIDE, frozen(pose(stamp)), sweep))
    assert contradicted_facing(scans) is None
    assert contradicted_facing(replace(scan, sweep=None) for scan in scans) is not None


def test_scans_that_fit_in_no_way_are_said():
    scans, rng = drive(WIDE)[:150], np.random.default_rng(1)
    order = rng.permutation(WIDE.beam_count)
    changes = {
        "odometry of another robot": lambda scan: replace(scan, T_odom_base=frozen(rng.normal(0.0, 0.5, 3))),
        "intensities": lambda scan: replace(scan, ranges_m=frozen(2.0 + 1.5 * np.sin(7.0 * scan.ranges_m), np.float32)),
        "beams in another order": lambda scan: replace(scan, ranges_m=frozen(scan.ranges_m[order], np.float32)),
    }
    for change in changes.values():
        found = contradicted_facing(map(change, scans))
        assert found.facing == AS_STATED
        assert "no other mounting is certain" in str(found)


def test_without_odometry_nothing_is_compared():
    scans = drive(WIDE)
    assert contradicted_facing(replace(scan, T_odom_base=frozen((math.nan,) * 3)) for scan in scans) is None


@pytest.mark.parametrize(("turned_deg", "upside_down"), [(180, False), (-90, True)])
def test_a_bag_whose_tf_is_wrong_is_read_as_the_laser_faces(tmp_path, turned_deg, upside_down):
    scans = drive(NARROW)
    path = tmp_path / "wrong.mcap"
    write_bag(path, stated(scans, turned_deg, upside_down))
    wrong = open_source(path)
    corrected = calibrated(wrong, LidarConfig())
    notes = " ".join(corrected.survey().notes)
    assert "the scans contradict the odometry" in notes
    assert ("180 deg" in notes or "90 deg to the right" in notes) == bool(turned_deg)
    assert ("upside down" in notes.split(";")[0]) == upside_down
    first = next(record for record in corrected.records() if isinstance(record, LaserScan))
    off = se2.between(NARROW.T_base_laser, first.laser.T_base_laser)
    assert np.hypot(off[0], off[1]) < 0.1
    assert off[2] == pytest.approx(0.0, abs=0.05)
    assert np.array_equal(first.ranges_m, np.where(scans[0].ranges_m >= 5.0, np.nan, scans[0].ranges_m), equal_nan=True)
    x, y, theta = NARROW.T_base_laser
    given = BagOptions(laser_poses=((x, y, theta - math.radians(turned_deg)),))
    kept = calibrated(open_source(path, given), LidarConfig())
    assert "--sensors laser-pose is kept" in " ".join(kept.survey().notes)
    assert kept.survey().lasers[0].T_base_laser == given.laser_poses[0]


def test_a_pose_that_the_user_gives_is_kept_where_the_motion_shows_another(tmp_path):
    write_bag(tmp_path / "anna.bag", open_source(SAMPLE_LOG).records())
    given = (0.12, 0.0, 0.0)  # the log says 0.05 m
    kept = calibrated(open_source(tmp_path / "anna.bag", BagOptions(laser_poses=(given,))), LidarConfig()).survey()
    assert kept.lasers[0].T_base_laser == given
    assert kept.notes[-1].endswith("along y from where it is stated; --sensors laser-pose is kept")


@pytest.mark.parametrize(("turned_deg", "upside_down"), [(180, False), (0, True)])
def test_what_a_log_says_to_do_about_its_laser_is_true(tmp_path, turned_deg, upside_down):
    write_carmen(tmp_path / "wrong.clf", stated(drive(NARROW), turned_deg, upside_down))
    log = open_source(tmp_path / "wrong.clf")
    source = calibrated(log, LidarConfig())
    assert len(list(source.records())) == source.survey().scan_count
    note = source.survey().notes[-1]
    assert "write the recording as a bag by `fcslam record` and map that" in note
    assert "--sensors" not in note, "an option of bags"
    write_bag(tmp_path / "wrong.mcap", log.records())
    corrected = calibrate_bag(open_source(tmp_path / "wrong.mcap"), LidarConfig()).correction
    assert corrected.upside_down == upside_down
    assert math.remainder(math.degrees(corrected.mounting[2]) - turned_deg, 360.0) == pytest.approx(0.0, abs=3.0)


def test_a_laser_may_be_given_upside_down(tmp_path):
    scans = drive(NARROW)[:20]
    path = tmp_path / "wrong.mcap"
    write_bag(path, stated(scans, 0.0, upside_down=True))
    source = open_source(path, BagOptions(laser_poses=((*NARROW.T_base_laser, True),)))
    first = next(record for record in source.records() if isinstance(record, LaserScan))
    assert first.laser.T_base_laser == NARROW.T_base_laser
    assert np.array_equal(first.ranges_m, np.where(scans[0].ranges_m >= 5.0, np.nan, scans[0].ranges_m), equal_nan=True)


@pytest.mark.parametrize(("turned_deg", "said"), [(0, False), (180, True)])
def test_a_live_robot_says_once_that_its_laser_faces_another_way(turned_deg, said):
    told = []
    scans = stated(drive(NARROW), turned_deg)
    with fcslam.Robot("anna", scans[0].laser, wiring=Wiring(SameThread()), on_event=told.append) as robot:
        for scan in scans:
            robot.add_scan(scan.ranges_m, scan.stamp, scan.T_odom_base)
    lines = [event.text for event in told if "the laser is turned by about 180 deg" in event.text]
    assert len(lines) == said
    assert all("not corrected" in line for line in lines)


@pytest.mark.parametrize("distance", [0.8, 1.2])
def test_a_scale_of_the_wheels_is_said_in_one_line(tmp_path, distance):
    poses = worlds.drive(3 * [(-3.0, -1.0), (1.5, -2.0), (3.2, 1.0), (-0.5, 2.0)], step_m=0.05)
    write_bag(tmp_path / "r.mcap", stated(worlds.recording(poses, poses, worlds.room(), WIDE), distance=distance))
    (line,) = calibrate_bag(open_source(tmp_path / "r.mcap"), LidarConfig()).lines
    assert float(line.split("the robot's distance is ")[1].split()[0]) == pytest.approx(distance, rel=0.02)
    assert line.endswith("correct the radius of the wheels in its driver")

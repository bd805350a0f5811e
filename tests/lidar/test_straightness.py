"""Walls that look bent show a laser whose ranges are not distances; straight walls and round things do not."""

import math
from dataclasses import replace

import numpy as np
import pytest

from fcslam.lidar.facing import FacingWatch, wrong_laser
from fcslam.lidar.frontend import LidarConfig
from fcslam.lidar.straightness import excess_of
from fcslam.records import LaserModel, frozen
from fcslam.robot.calibrating import calibrate_bag, contradictions_of
from fcslam.sources import open_source, write_bag
from fcslam.sources.logs.carmen_writer import write_carmen
from tests.lidar import worlds

pytestmark = pytest.mark.slow

LASER = LaserModel(360, -math.pi, math.radians(1.0), 12.0, (0.2, 0.0, 0.0))
POSES = worlds.drive(3 * [(-3.0, -1.0), (1.5, -2.0), (3.2, 1.0), (-0.5, 2.0)], step_m=0.15)
SCANS = worlds.recording(POSES, POSES, worlds.room(), LASER)
CONVERSIONS = {
    "logarithm": lambda r: 2.0 * np.log(r + 0.5),
    "root": lambda r: 2.0 * np.sqrt(r),
    "root, feet": lambda r: np.sqrt(r / 0.3048),
}


def changed(change, scans=SCANS):
    def ranges(scan):
        is_return = (scan.ranges_m > 0.0) & (scan.ranges_m < LASER.max_range_m)
        return frozen(np.where(is_return, change(np.maximum(scan.ranges_m, 0.1)), scan.ranges_m), np.float32)

    return [replace(scan, ranges_m=ranges(scan)) for scan in scans]


@pytest.mark.parametrize("excess_m", [0.3, 0.15, -0.2])
def test_a_zero_that_is_off_is_measured(excess_m):
    scans = changed(lambda ranges_m: ranges_m + excess_m)
    found = excess_of(scans)
    assert found.at_short_m == pytest.approx(excess_m, abs=0.1)
    assert found.at_long_m == pytest.approx(excess_m, abs=0.05)
    assert f"too {'long' if excess_m > 0 else 'short'} by 0." in str(found)


@pytest.mark.parametrize("change", CONVERSIONS.values(), ids=CONVERSIONS)
def test_ranges_that_are_not_linear_are_said(change):
    found = excess_of(changed(change))
    assert found.at_long_m > 1.1 * found.at_short_m > 0.0


def test_straight_walls_are_right():
    noise = np.random.default_rng(2)
    for sigma_m in (0.0, 0.01, 0.03):
        assert excess_of(changed(lambda r, s=sigma_m: r + noise.normal(0.0, s, len(r)))) is None
    for quantum_m in (0.01, 0.05):
        assert excess_of(changed(lambda r, q=quantum_m: np.round(r / q) * q)) is None
    assert excess_of(changed(lambda ranges_m: 0.3048 * ranges_m)) is None  # another unit bends no wall


def test_round_things_and_rough_ones_are_not_taken_for_walls():
    angles = LASER.angle_min_rad + LASER.angle_increment_rad * np.arange(LASER.beam_count)
    rng = np.random.default_rng(4)
    columns = 1.5 - 0.5 * np.abs(np.cos(3.0 * angles))
    assert excess_of(changed(lambda _: columns)) is None
    assert excess_of(changed(lambda ranges_m: ranges_m + rng.uniform(-0.3, 0.3, len(ranges_m)))) is None


def test_a_robot_that_stands_still_or_has_no_odometry_says_nothing():
    scans = changed(lambda ranges_m: ranges_m + 0.3)
    assert excess_of([scans[0]] * 100) is None
    assert excess_of(replace(scan, T_odom_base=frozen((math.nan,) * 3)) for scan in scans) is None


def test_bags_logs_and_live_lasers_say_it_once(tmp_path):
    scans = changed(lambda ranges_m: ranges_m + 0.3)
    write_bag(tmp_path / "run.mcap", scans)
    write_carmen(tmp_path / "run.log", scans)
    found = calibrate_bag(open_source(tmp_path / "run.mcap"), LidarConfig())
    assert found.correction.mounting == (0.0, 0.0, 0.0)
    watch = FacingWatch()
    live = [str(wrong_laser(watched)) for scan in scans if (watched := watch.add(scan))]
    for lines in (found.lines, contradictions_of(open_source(tmp_path / "run.log")), live):
        assert sum("the walls in the scans are bent, as if ranges were too long by 0.3" in line for line in lines) == 1

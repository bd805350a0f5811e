"""Logs that state less than CARMEN does: no stamps, or ticks instead of poses."""

import math
from itertools import pairwise

import numpy as np
import pytest

from fcslam.errors import SourceError
from fcslam.geometry import se2
from fcslam.records import LaserScan
from fcslam.sources import Fault, ScanRange, open_source, split
from tests.sources.carmen_text import pose_at, save, scans_of

RADIUS_M, TRACK_M, TICKS_A_TURN = 0.077, 0.33, 2000
SCAN_AGE_S = 0.15
RANGES = [1000 + k for k in range(682)]


def dpslam(scans, beams=181):
    lines = []
    for step in range(scans):
        lines.append("Odometry " + " ".join(f"{value:.6f}" for value in pose_at(step)) + " ")
        lines.append(f"Laser {beams} " + " ".join(f"{1.0 + 0.01 * k:.6f}" for k in range(beams)) + " ")
    return lines


def coreslam(time_us, left, right, ranges=RANGES, older=False):
    """A line of the rover; the older layout has the right encoder mounted the other way round."""
    words = [time_us, left, -right, 1.0, 2.0, 3.0, *[0] * 7] if older else [time_us, 14710, left, right, *["0.5"] * 21]
    return " ".join(map(str, [*words, *ranges]))


def drive(wheels_m, older=False, period_us=100_000):
    """Lines of a rover whose wheels have gone so far, (left, right) each."""
    ticks_a_metre = TICKS_A_TURN / (2 * math.pi * RADIUS_M)
    return [
        coreslam(5_000_000 + period_us * k, round(left * ticks_a_metre), round(right * ticks_a_metre), older=older)
        for k, (left, right) in enumerate(wheels_m)
    ]


def test_dpslam_scans_take_the_pose_before_them_and_made_stamps(tmp_path):
    source = open_source(save(tmp_path / "loop.log", dpslam(5)))
    scans = scans_of(source)
    np.testing.assert_array_equal([scan.T_odom_base for scan in scans], [pose_at(k) for k in range(5)])
    assert [scan.stamp for scan in scans] == [0.0, 1.0, 2.0, 3.0, 4.0]
    np.testing.assert_allclose(scans[3].ranges_m, 1.0 + 0.01 * np.arange(181), rtol=1e-6)
    laser = source.survey().lasers[0]
    assert laser.T_base_laser == pytest.approx((0.4, 0.0, 0.0))
    np.testing.assert_allclose(np.degrees(laser.angles_rad()), np.arange(-90, 91), atol=1e-9)
    assert laser.max_range_m < 8.191


def test_made_stamps_are_said(tmp_path):
    source = open_source(save(tmp_path / "loop.log", dpslam(6)))
    assert source.survey().faults[Fault.NO_STAMP].count == 6
    assert "1 s apart: 6 (first: line 2)" in str(source.survey().faults)
    for part, first_line in zip(split(source, 2), (2, 8), strict=True):
        scans_of(part)
        assert part.faults[Fault.NO_STAMP].count == 3
        assert part.faults[Fault.NO_STAMP].first_line == first_line
    assert source.survey(ScanRange(4)).faults[Fault.NO_STAMP].count == 2


def test_a_dpslam_scan_before_all_odometry_is_broken(tmp_path):
    source = open_source(save(tmp_path / "loop.log", dpslam(5)[1:]))
    assert [scan.stamp for scan in scans_of(source)] == [0.0, 1.0, 2.0, 3.0]
    assert source.faults[Fault.BROKEN_LINE].count == source.faults[Fault.BROKEN_LINE].first_line == 1


@pytest.mark.parametrize("older", [False, True])
def test_ticks_straight_ahead_are_metres(tmp_path, older):
    steps_m = 0.05 * np.arange(30)
    scans = scans_of(open_source(save(tmp_path / "exp.dat", drive(zip(steps_m, steps_m, strict=True), older))))
    poses = np.array([scan.T_odom_base for scan in scans])
    scanned_at_m = np.maximum(0.0, steps_m - 0.05 * SCAN_AGE_S / 0.1)
    np.testing.assert_allclose(poses[:, 0], scanned_at_m, atol=2e-4)
    np.testing.assert_array_equal(poses[:, 1:], 0.0)
    np.testing.assert_allclose([scan.stamp for scan in scans], 5.0 + 0.1 * np.arange(30))


@pytest.mark.parametrize("older", [False, True])
@pytest.mark.parametrize(("left_speed", "right_speed"), [(0.3, 0.5), (0.5, 0.3), (-0.3, 0.3), (0.2, -0.1)])
def test_ticks_follow_the_circle_that_the_wheels_are_on(tmp_path, older, left_speed, right_speed):
    times = 0.1 * np.arange(60)
    source = open_source(save(tmp_path / "exp.dat", drive(np.outer(times, (left_speed, right_speed)), older)))
    turning = (right_speed - left_speed) / TRACK_M
    radius_m = TRACK_M / 2 * (right_speed + left_speed) / (right_speed - left_speed)
    for time, scan in zip(times, scans_of(source), strict=True):
        heading = turning * max(0.0, time - SCAN_AGE_S)
        circle = radius_m * math.sin(heading), radius_m * (1.0 - math.cos(heading)), heading
        np.testing.assert_allclose(se2.between(np.array(circle), scan.T_odom_base), 0.0, atol=3e-3)


def test_driving_back_on_the_same_ticks_ends_where_it_began(tmp_path):
    wheels = np.cumsum(np.random.default_rng(3).normal(0.0, 0.05, (40, 2)), axis=0)
    there_and_back = [*wheels, *wheels[::-1], *[wheels[0]] * 4]
    scans = scans_of(open_source(save(tmp_path / "exp.dat", drive(there_and_back))))
    np.testing.assert_allclose(scans[-1].T_odom_base, scans[0].T_odom_base, atol=1e-9)


def test_the_rovers_laser_looks_past_its_body(tmp_path):
    ranges = [0] * 70 + [7, 19, 20, *range(1003, 1542)] + [0] * 70
    lines = [coreslam(100_000 * k, 100 * k, 100 * k, ranges) for k in range(3)]
    source = open_source(save(tmp_path / "exp.dat", lines))
    laser = source.survey().lasers[0]
    assert laser.beam_count == 542
    assert laser.angles_rad()[270] == pytest.approx(0.0, abs=1e-9)
    assert np.degrees(laser.angle_increment_rad) == pytest.approx(360 / 1024)
    assert laser.T_base_laser == pytest.approx((0.145, 0.0, 0.0))
    np.testing.assert_allclose(scans_of(source)[0].ranges_m[:4], [0.0, 0.0, 0.02, 1.003], rtol=1e-6)
    assert source.faults.counts.keys() <= {Fault.REPEATED_SCAN}, "the ranges are all alike"


@pytest.mark.parametrize(
    "damaged",
    ["", "1 2 3", "9" * 4000, coreslam(1, 10**4000, 2), coreslam(1, 10**30, 2), coreslam(1, "nan", 2),
     coreslam("now", 1, 2), coreslam(10**400, 1, 2), coreslam(1, 1, 2, [*RANGES[:-80], "far", *RANGES[-79:]])],
)  # fmt: skip
def test_a_damaged_line_of_ticks_costs_only_itself(tmp_path, damaged):
    lines = drive(np.outer(0.03 * np.arange(30), (1.0, 1.1)))
    healthy = scans_of(open_source(save(tmp_path / "healthy.dat", lines)))
    source = open_source(save(tmp_path / "exp.dat", [*lines, damaged, ""]))
    for one, other in zip(healthy, scans_of(source), strict=True):
        np.testing.assert_array_equal(one.T_odom_base, other.T_odom_base)
    assert source.faults[Fault.BROKEN_LINE].count == bool(damaged)


def test_encoders_that_are_reset_cost_one_line(tmp_path):
    lines = drive(np.outer(0.03 * np.arange(60) + 8.0, (1.0, 1.1)))
    again = [coreslam(11_000_000 + 100_000 * k, 190 * k, 210 * k) for k in range(40)]
    source = open_source(save(tmp_path / "exp.dat", [*lines, *again]))
    assert len(scans_of(source)) == 99
    assert source.faults[Fault.BROKEN_LINE].count == 1


def test_one_damaged_count_of_ticks_costs_one_line(tmp_path):
    lines = drive(np.outer(0.03 * np.arange(60), (1.0, 1.1)))
    lines[30] = coreslam(8_000_000, 10**9, 2)
    source = open_source(save(tmp_path / "exp.dat", lines))
    assert len(scans_of(source)) == 59
    assert source.faults[Fault.BROKEN_LINE].count == 1


def test_another_number_of_columns_is_refused(tmp_path):
    path = save(tmp_path / "exp.dat", [line + " 7" for line in drive(np.zeros((20, 2)))])
    with pytest.raises(SourceError, match="known format"):
        open_source(path)


def test_every_pass_starts_anew(tmp_path):
    for lines in (dpslam(8), drive(np.outer(0.1 * np.arange(8), (1.0, 1.1)))):
        source = open_source(save(tmp_path / "run.log", lines))
        passes = [[(scan.stamp, *scan.T_odom_base) for scan in scans_of(source)] for _ in range(2)]
        assert passes[0] == passes[1]
        parts = [record for k in (0, 3) for record in source.records(ScanRange(k, k + 3 if k == 0 else None))]
        assert [scan.stamp for scan in parts if isinstance(scan, LaserScan)] == [scan[0] for scan in passes[0]]
        assert all(one[0] < other[0] for one, other in pairwise(passes[0]))

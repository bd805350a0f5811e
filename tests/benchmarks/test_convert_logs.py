"""Logs of other programs become bags: their units, their laser, and encoder ticks as poses."""

import gzip
import json
import math
from pathlib import Path

import numpy as np
import pytest
from convert_logs import readable, records_of

from fcslam.geometry import se2
from fcslam.records import LaserScan
from fcslam.sources import open_source
from tests.sources.carmen_text import drive as carmen_lines
from tests.sources.carmen_text import pose_at, save, scans_of

RADIUS_M, TRACK_M, TICKS_A_TURN, SCAN_AGE_S = 0.077, 0.33, 2000, 0.15
RANGES_MM = [1000 + k for k in range(682)]


def converted(path: Path, lines: list[str]) -> list[LaserScan]:
    return list(records_of(save(path, lines)) or ())


def cmu(scans: int) -> list[str]:
    poses = [" ".join(f"{100 * value:.2f}" for value in pose_at(k)[:2]) + f" {pose_at(k)[2]:.6f}" for k in range(scans)]
    return [f"L {pose} {pose} {' '.join(['100.5'] * 180)} {k}.25" for k, pose in enumerate(poses)]


def dpslam(scans: int) -> list[str]:
    lines = []
    for step in range(scans):
        lines.append("Odometry " + " ".join(f"{value:.6f}" for value in pose_at(step)) + " ")
        lines.append("Laser 181 " + " ".join(f"{1.0 + 0.04 * k:.6f}" for k in range(181)) + " ")
    return lines


def ticks_line(time_us, left, right, ranges=RANGES_MM, older=False):
    """A line of the rover; the older layout has the right encoder mounted the other way round."""
    words = [time_us, left, -right, 1.0, 2.0, 3.0, *[0] * 7] if older else [time_us, 14710, left, right, *["0.5"] * 21]
    return " ".join(map(str, [*words, *ranges]))


def ticks(wheels_m, older=False):
    """Lines of a rover whose wheels have gone so far, (left, right) each."""
    per_metre = TICKS_A_TURN / (2 * math.pi * RADIUS_M)
    return [
        ticks_line(5_000_000 + 100_000 * k, round(left * per_metre), round(right * per_metre), older=older)
        for k, (left, right) in enumerate(wheels_m)
    ]


def csm(step, **fields):
    readings = [1.0 + 0.1 * k for k in range(8)]
    content = {
        "nrays": 8, "min_theta": -1.4, "max_theta": 1.4, "readings": [*readings[:3], None, *readings[4:]],
        "valid": [1, 1, 1, 0, 1, 1, 1, 0], "odometry": pose_at(step), "timestamp": [1000 + step, 250000], **fields,
    }  # fmt: skip
    return json.dumps({key: value for key, value in content.items() if value != "none"})


def test_logs_in_centimetres(tmp_path):
    scans = converted(tmp_path / "run.log", [line for k, line in enumerate(cmu(5)) for line in (f"O 0 0 0 {k}", line)])
    assert [scan.stamp for scan in scans] == [0.25, 1.25, 2.25, 3.25, 4.25]
    np.testing.assert_allclose([scan.T_odom_base for scan in scans], [pose_at(k) for k in range(5)], atol=1e-4)
    np.testing.assert_allclose(scans[0].ranges_m, 1.005, rtol=1e-6)
    np.testing.assert_allclose(np.degrees(scans[0].laser.angles_rad()), np.arange(-90, 90), atol=1e-9)


def test_scans_without_stamps_take_the_pose_before_them(tmp_path):
    scans = converted(tmp_path / "loop.log", dpslam(5)[1:])
    assert [scan.stamp for scan in scans] == [0.0, 1.0, 2.0, 3.0], "the first scan has no pose"
    np.testing.assert_array_equal([scan.T_odom_base for scan in scans], [pose_at(k) for k in range(1, 5)])
    assert scans[0].laser.T_base_laser == (0.4, 0.0, 0.0)
    np.testing.assert_allclose(np.degrees(scans[0].laser.angles_rad()), np.arange(-90, 91), atol=1e-9)
    np.testing.assert_allclose(scans[0].ranges_m[:180], 1.0 + 0.04 * np.arange(180), rtol=1e-6)
    assert scans[0].ranges_m[180] == np.inf, "8.2 m is no return"


@pytest.mark.parametrize("older", [False, True])
@pytest.mark.parametrize(("left_speed", "right_speed"), [(0.3, 0.5), (0.5, 0.3), (-0.3, 0.3), (0.2, -0.1)])
def test_ticks_follow_the_circle_that_the_wheels_are_on(tmp_path, older, left_speed, right_speed):
    times = 0.1 * np.arange(60)
    scans = converted(tmp_path / "exp.dat", ticks(np.outer(times, (left_speed, right_speed)), older))
    turning = (right_speed - left_speed) / TRACK_M
    radius_m = TRACK_M / 2 * (right_speed + left_speed) / (right_speed - left_speed)
    for time, scan in zip(times, scans, strict=True):
        heading = turning * max(0.0, time - SCAN_AGE_S)
        circle = radius_m * math.sin(heading), radius_m * (1.0 - math.cos(heading)), heading
        np.testing.assert_allclose(se2.between(np.array(circle), scan.T_odom_base), 0.0, atol=3e-3)


@pytest.mark.parametrize(
    "damaged",
    ["", "1 2 3", ticks_line(1, 10**30, 2), ticks_line(1, "nan", 2), ticks_line("now", 1, 2), ticks_line(8e6, 10**9, 2),
     ticks_line(1, 1, 2, [*RANGES_MM[:-80], "far", *RANGES_MM[-79:]])],
)  # fmt: skip
def test_a_damaged_line_costs_only_itself(tmp_path, damaged):
    lines = ticks(np.outer(0.03 * np.arange(30), (1.0, 1.1)))
    healthy = converted(tmp_path / "healthy.dat", lines)
    for one, other in zip(healthy, converted(tmp_path / "exp.dat", [*lines, damaged]), strict=True):
        np.testing.assert_array_equal(one.T_odom_base, other.T_odom_base)


@pytest.mark.parametrize(
    "fields", [{}, {"theta": [-1.4 + 0.4 * k for k in range(8)], "min_theta": "none", "max_theta": "none"}]
)
def test_logs_of_csm(tmp_path, fields):
    scans = converted(tmp_path / "run.log", [csm(k, **fields) for k in range(3)])
    assert [scan.stamp for scan in scans] == [1000.25, 1001.25, 1002.25]
    np.testing.assert_array_equal([scan.T_odom_base for scan in scans], [pose_at(k) for k in range(3)])
    np.testing.assert_allclose(scans[0].ranges_m, [1.0, 1.1, 1.2, 0.0, 1.4, 1.5, 1.6, 0.0], rtol=1e-6)
    assert scans[0].laser.angles_rad()[[0, -1]] == pytest.approx((-1.4, 1.4))


@pytest.mark.parametrize("lines", [cmu(30), dpslam(30), ticks(np.outer(0.03 * np.arange(30), (1.0, 1.1)))])
def test_the_bag_holds_the_same_scans(tmp_path, lines):
    log = tmp_path / "run.log.gz"
    log.write_bytes(gzip.compress("\n".join(lines).encode()))
    source = open_source(readable(log, tmp_path / "bags"))
    assert source.name == "run"
    scans = list(records_of(log) or ())
    for read, scan in zip(scans_of(source), scans, strict=True):
        assert read.stamp == pytest.approx(scan.stamp, abs=1e-9)
        np.testing.assert_allclose(read.T_odom_base, scan.T_odom_base, atol=1e-9)
        np.testing.assert_array_equal(read.ranges_m, scan.ranges_m)
        np.testing.assert_allclose(read.laser.angles_rad(), scan.laser.angles_rad(), atol=1e-6)


def test_other_recordings_stay_as_they_are(tmp_path):
    log = save(tmp_path / "run.log", carmen_lines(5))
    assert readable(log) == log
    assert readable(tmp_path) == tmp_path

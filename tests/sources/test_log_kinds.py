"""Lines of text logs that other programs write: raw scans, no times, decimal commas, unstated angles."""

import math
from dataclasses import replace

import numpy as np
import pytest

from fcslam.errors import SourceError
from fcslam.sources import Fault, open_source
from tests.sources.camera_records import same
from tests.sources.carmen_text import drive, flaser, odom, pose_at, save, scans_of

RANGES = tuple(round(1.0 + 0.1 * k, 3) for k in range(8))


def assert_like(scans, count, first=-1.4, last=1.4):
    assert len(scans) == count
    np.testing.assert_array_equal([scan.T_odom_base for scan in scans], [pose_at(k) for k in range(count)])
    angles = scans[0].laser.angles_rad()
    assert (angles[0], angles[-1]) == pytest.approx((first, last))


def untimed(lines):
    """Without the three words of the time at the end of a line."""
    return [line.rsplit(None, 3)[0] for line in lines]


def test_lines_without_times(tmp_path):
    timed = scans_of(open_source(save(tmp_path / "timed.log", drive(12))))
    source = open_source(save(tmp_path / "run.log", untimed(drive(12))))
    assert all(map(same, scans_of(source), (replace(scan, stamp=k) for k, scan in enumerate(timed))))
    assert source.survey().scan_count == 12
    assert source.faults[Fault.NO_STAMP].count == 12
    assert not source.faults[Fault.BROKEN_LINE].count


def test_decimal_commas(tmp_path):
    wanted = scans_of(open_source(save(tmp_path / "points.log", drive(12))))
    scans = scans_of(open_source(save(tmp_path / "run.log", [line.replace(".", ",") for line in drive(12)])))
    assert len(scans) == len(wanted) == 12
    assert all(map(same, scans, wanted))


def raw(stamp, remissions=()):
    words = [0, -1.4, 2.8, 0.4, 30.0, 0.01, 0, 8, *RANGES, len(remissions), *remissions, stamp, "robot", 0.0]
    return "RAWLASER1 " + " ".join(map(str, words))


def test_raw_scans_have_the_pose_of_the_odometry_before_them(tmp_path):
    lines = [line for k in range(12) for line in (odom(100 + k, pose_at(k)), raw(100.1 + k, (1,) * (k % 2)))]
    scans = scans_of(open_source(save(tmp_path / "run.log", [raw(99.0), *lines])))
    assert_like(scans, 12)
    np.testing.assert_allclose(scans[0].ranges_m, RANGES, rtol=1e-6)
    assert scans[0].stamp == 100.1
    assert scans[0].laser.max_range_m == 30.0


def test_raw_scans_beside_others_are_passed_over(tmp_path):
    lines = [line for k, line in enumerate(drive(12)) for line in (raw(100.0 + k), line)]
    assert len(scans_of(open_source(save(tmp_path / "run.log", lines)))) == 12


def test_lines_that_are_no_scans_are_named(tmp_path):
    lines = [line for k in range(5) for line in (odom(k, pose_at(k)), "RLASER 1 2 3", "TRUEPOS 1 2 3")]
    with pytest.raises(SourceError, match=r"no laser scan in this CARMEN log; give a log with scans"):
        open_source(save(tmp_path / "run.log", lines)).survey()


@pytest.mark.parametrize(
    ("parameter", "taken_deg"),
    [
        ("", 180),
        ("PARAM laser_front_laser_fov 360 h 0", 360),
        ("PARAM laser_front_laser_fov 6.283185 h 0", 360),
    ],
)
def test_the_angles_are_those_of_the_parameter_or_assumed(tmp_path, parameter, taken_deg):
    lines = [flaser(k, (0.001 * k, 0.0, 0.12 * k), ranges=(2.0,) * 180) for k in range(40)]
    source = open_source(save(tmp_path / "run.log", [*filter(None, [parameter]), *lines]))
    assert math.degrees(source.survey().lasers[0].angle_increment_rad) * 180 == pytest.approx(taken_deg)

from copy import copy
from itertools import zip_longest

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fcslam.errors import SourceError
from fcslam.geometry import se2
from fcslam.records import LaserScan, Odometry
from fcslam.sources import Fault, open_source, split
from tests.sources.carmen_text import drive, flaser, pose_at, save, scans_of


@pytest.fixture
def recording(tmp_path):
    return open_source(save(tmp_path / "run.clf", drive(23)))


@settings(max_examples=23, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(1, 23))
def test_parts_hold_every_scan_once_in_equal_shares(recording, parts):
    shares = [scans_of(part) for part in split(recording, parts)]
    assert [scan.stamp for share in shares for scan in share] == [scan.stamp for scan in scans_of(recording)]
    assert max(map(len, shares)) - min(map(len, shares)) <= 1


def test_each_part_starts_at_zero_and_moves_as_the_whole(recording):
    whole = np.array([scan.T_odom_base for scan in scans_of(recording)])
    start = 0
    for part in split(recording, 4):
        poses = np.array([scan.T_odom_base for scan in scans_of(part)])
        np.testing.assert_array_equal(poses[0], (0.0, 0.0, 0.0))
        np.testing.assert_allclose(poses, se2.between(whole[start], whole[start : start + len(poses)]), atol=1e-12)
        start += len(poses)


def test_odometry_is_moved_along_and_given_to_one_part_only(recording):
    parts = [list(part.records()) for part in split(recording, 3)]
    assert all(isinstance(part[0], LaserScan) for part in parts)
    kept = [record.stamp for part in parts for record in part if isinstance(record, Odometry)]
    logged = [record.stamp for record in recording.records() if isinstance(record, Odometry)]
    assert kept == logged[1:], "only the reading before the first scan is left out"
    for part in parts:
        for odometry, scan in zip(part[1::2], part[2::2], strict=False):
            np.testing.assert_array_equal(odometry.T_odom_base, scan.T_odom_base)


def test_parts_are_named_and_surveyed_as_robots_of_their_own(recording):
    parts = split(recording, 3)
    assert [part.name for part in parts] == ["run_1", "run_2", "run_3"]
    for part in parts:
        survey, scans = part.survey(), scans_of(part)
        poses = np.array([scan.T_odom_base for scan in scans])
        assert survey.scan_count == len(scans)
        assert survey.duration_s == pytest.approx(scans[-1].stamp - scans[0].stamp)
        assert survey.path_length_m == pytest.approx(np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1).sum())
        assert survey.lasers[0] == recording.survey().lasers[0]


def test_parts_can_be_read_side_by_side(tmp_path):
    lines = drive(40)
    lines[9] = lines[11] = lines[61] = "???"
    parts = split(open_source(save(tmp_path / "run.log", lines)), 2)
    together = list(zip_longest(*(part.records() for part in parts)))
    for number, part in enumerate(parts):
        assert part.faults[Fault.BROKEN_LINE].count == (2, 1)[number]
        alone = list(part.records())
        for one, other in zip([pair[number] for pair in together if pair[number]], alone, strict=True):
            assert one.stamp == other.stamp
    next(copy(parts[0]).records())
    assert parts[0].faults[Fault.BROKEN_LINE].count == 2, "a copy counts its own pass"


def test_every_fault_is_counted_in_one_part(tmp_path):
    lines = [flaser(t, pose_at(k)) for k, t in enumerate([0, 1, 2, 3, 2.5, 4, 5, 4.5, 6, 6, 7, 8])]
    lines.insert(6, "???")
    source = open_source(save(tmp_path / "run.log", lines))
    scans_of(source)
    for count in range(1, 12):
        parts = split(source, count)
        for part in parts:
            scans_of(part)
        for kind in Fault:
            assert sum(part.faults[kind].count for part in parts) == source.faults[kind].count


@pytest.mark.parametrize("parts", [0, -1, 24])
def test_more_parts_than_scans_are_refused(recording, parts):
    with pytest.raises(SourceError, match="cannot be cut"):
        split(recording, parts)

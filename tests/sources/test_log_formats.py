"""Logs by CARMEN and by other programs: raw scans, no times, decimal commas, unstated angles."""

import bz2
import gzip
import lzma
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fcslam.errors import SourceError
from fcslam.geometry import se2
from fcslam.records import LaserScan, Odometry
from fcslam.sources import Fault, FaultCount, open_source
from tests.sources.camera_records import same
from tests.sources.carmen_text import BEAMS, drive, flaser, odom, pose_at, refusal, robotlaser, save, scans_of


def test_every_message_becomes_its_record_in_file_order(tmp_path):
    lines = ["# CARMEN Logfile", "PARAM robot_width 0.5 host 0", *drive(3), "SYNC mark 1 host 0", "", "RLASER 1 2 3"]
    source = open_source(save(tmp_path / "run.log", lines))
    records = list(source.records())
    assert [type(record) for record in records] == [Odometry, LaserScan] * 3
    assert [record.stamp for record in records] == pytest.approx([99.95, 100.0, 100.15, 100.2, 100.35, 100.4])
    np.testing.assert_array_equal([record.T_odom_base for record in records[::2]], [pose_at(k) for k in range(3)])
    np.testing.assert_allclose(records[3].ranges_m, 1.01 + 0.1 * np.arange(BEAMS), rtol=1e-6)
    assert records[3].ranges_m.dtype == np.float32
    assert not records[3].ranges_m.flags.writeable
    assert not records[3].T_odom_base.flags.writeable
    assert not source.faults


@pytest.mark.parametrize("compress", [bytes, gzip.compress, lzma.compress, bz2.compress])
@pytest.mark.parametrize("name", ["run.clf", "run.clf.xz", "run.log.gz"])
def test_content_decides_the_compression(tmp_path, compress, name):
    path = tmp_path / name
    path.write_bytes(compress("\n".join(drive(5)).encode()))
    source = open_source(path)
    assert source.name == "run"
    assert len(scans_of(source)) == source.survey().scan_count == 5


@pytest.mark.parametrize(
    ("name", "robot"),
    [
        ("intel.clf.xz", "intel"),
        ("acapulco-corrected.log.gz", "acapulco-corrected"),
        ("ual_2014_05_23.CLF.XZ", "ual_2014_05_23"),
        ("my robot.log", "my_robot"),
        ("v1.2.log", "v1.2"),
        (".log", "robot"),
    ],
)
def test_the_robot_is_named_after_the_file(tmp_path, name, robot):
    assert open_source(save(tmp_path / name, drive(2))).name == robot


@pytest.mark.parametrize(
    "messy", [lambda line: line.replace(" ", "\t"), lambda line: f"  {line.replace(' ', '  ')} \r"]
)
def test_white_space_does_not_matter(tmp_path, messy):
    tidy = list(open_source(save(tmp_path / "tidy.log", drive(4))).records())
    untidy = list(open_source(save(tmp_path / "untidy.log", map(messy, drive(4)))).records())
    assert len(tidy) == len(untidy)
    assert all(map(same, tidy, untidy))


@pytest.mark.parametrize(
    ("beams", "first_deg", "step_deg"),
    [
        (180, -90, 1.0),
        (181, -90, 1.0),
        (360, -90, 0.5),
        (361, -90, 0.5),
        (401, -50, 0.25),
        (541, -135, 0.5),
        (1081, -135, 0.25),
        (90, -90, 2.0),
    ],
)
def test_the_beam_count_decides_the_angles_of_flaser(tmp_path, beams, first_deg, step_deg):
    laser = open_source(save(tmp_path / "run.log", drive(2, beams=beams))).survey().lasers[0]
    angles_deg = np.degrees(laser.angles_rad())
    assert angles_deg[0] == pytest.approx(first_deg)
    np.testing.assert_allclose(np.diff(angles_deg), step_deg)
    assert angles_deg[beams // 2] == pytest.approx(0.0, abs=1e-9)
    assert laser.max_range_m == 50.0


@pytest.mark.parametrize(
    ("beams", "resolution", "fov", "span_deg"),
    [
        (360, "1.0", "6.283185", 359),
        (360, "1.0", "360", 359),
        (360, "0.5", "180", 179.5),
        (360, "1.0", "180", 179.5),
        (360, "x", "nan", 179.5),
        (180, None, "360", 358),
        (180, None, "6.283185", 358),
        (180, None, None, 179),
    ],
)
def test_parameters_state_the_field_of_view_where_they_fit_the_count(tmp_path, beams, resolution, fov, span_deg):
    stated = {"resolution": resolution, "fov": fov}
    parameters = [f"PARAM laser_front_laser_{name} {value} h 0" for name, value in stated.items() if value is not None]
    laser = open_source(save(tmp_path / "run.log", [*parameters, *drive(2, beams=beams)])).survey().lasers[0]
    assert np.degrees(np.ptp(laser.angles_rad())) == pytest.approx(span_deg)


@pytest.mark.parametrize(("kind", "max_range_m"), [(0, 50.0), (2, 81.0)])
@pytest.mark.parametrize("remissions", [(), (5, 6, 7)])
def test_robotlaser_states_its_geometry(tmp_path, kind, max_range_m, remissions):
    config = (kind, -2.0, 4.0, 2.0, 81.0, 0.01, 0)
    lines = [robotlaser(k, pose_at(k), config, (1.5, 2.5, 3.5), remissions) for k in range(3)]
    source = open_source(save(tmp_path / "run.log", lines))
    laser = source.survey().lasers[0]
    np.testing.assert_allclose(laser.angles_rad(), [-2.0, 0.0, 2.0])
    assert laser.max_range_m == max_range_m
    scans = scans_of(source)
    assert [scan.stamp for scan in scans] == [0.0, 1.0, 2.0]
    np.testing.assert_array_equal(scans[2].T_odom_base, pose_at(2))
    np.testing.assert_array_equal(scans[2].ranges_m, [1.5, 2.5, 3.5])


def test_a_stated_geometry_goes_before_a_guessed_one(tmp_path):
    config = (3, -0.5, 1.0, 0.5, 20.0, 0, 0)
    lines = [flaser(0, pose_at(0), ranges=(1, 2, 3)), robotlaser(1, pose_at(1), config, (1, 2, 3))]
    survey = open_source(save(tmp_path / "run.log", lines)).survey()
    assert survey.scan_count == 2
    assert survey.lasers[0].max_range_m == 20.0


mountings = st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(-3, 3))


@settings(max_examples=25)
@given(mountings)
def test_both_poses_of_the_scans_say_where_the_laser_sits(tmp_path_factory, mounting):
    mounting = tuple(round(value, 3) for value in mounting)
    lines = ["PARAM robot_frontlaser_offset 0.3 h 0"]
    for step in range(5):
        laser = tuple(f"{value:.6f}" for value in se2.compose(pose_at(step), mounting))
        lines.append(flaser(step, pose_at(step), laser))
    found = open_source(save(tmp_path_factory.mktemp("log") / "run.log", lines)).survey().lasers[0].T_base_laser
    expected = mounting if any(mounting) else (0.3, 0.0, 0.0)
    np.testing.assert_allclose(found, expected, atol=2e-4)


def test_the_parameter_says_where_the_laser_sits_if_the_poses_do_not(tmp_path):
    parameter = "PARAM robot_frontlaser_offset -0.04 host 0"
    same_pose_twice = save(tmp_path / "same.log", [parameter, *drive(5)])
    corrected = [flaser(k, pose_at(k), (1.0 + k, 2.0 * k, 0.0)) for k in range(20)]
    one_corrected = save(tmp_path / "corrected.log", [parameter, *corrected])
    for path in (same_pose_twice, one_corrected):
        assert open_source(path).survey().lasers[0].T_base_laser == (-0.04, 0.0, 0.0)


def test_scans_without_poses_take_that_of_the_odometry_before_them(tmp_path):
    lines = []
    for step in range(12):
        lines += [odom(step, pose_at(step)), flaser(step + 0.5, (0, 0, 0))]
    source = open_source(save(tmp_path / "run.log", lines))
    poses = [scan.T_odom_base for scan in scans_of(source)]
    np.testing.assert_array_equal(poses, [pose_at(step) for step in range(12)])
    steps = np.diff([pose_at(step)[:2] for step in range(12)], axis=0)
    assert source.survey().path_length_m == pytest.approx(np.linalg.norm(steps, axis=1).sum())


def test_a_log_is_read_once_and_its_records_again_if_need_be(tmp_path):
    lines = drive(10)
    path = save(tmp_path / "run.log", [*lines[:9], "FLASER damaged", *lines[9:]])
    source = open_source(path)
    source.survey()
    path.rename(tmp_path / "away.log")
    kept = list(source.records())
    with pytest.raises(SourceError):
        next(source.records())
    (tmp_path / "away.log").rename(path)
    again = list(source.records())
    assert len(kept) == len(again) == len(lines)
    assert all(map(same, kept, again))
    assert source.faults[Fault.BROKEN_LINE] == FaultCount(1, 10)


NUMBERS = [
    "1.5",
    " 7",
    "0.1",
    "123456.789012345",
    "0.000000000000001",
    "1e-3",
    "1234567890123456789",
    "4.35",
    ".5",
    "5.",
]


@given(st.lists(st.sampled_from(NUMBERS) | st.floats(0.0, 100.0).map(repr), min_size=2, max_size=9))
def test_ranges_are_read_as_python_reads_numbers(tmp_path_factory, words):
    path = save(tmp_path_factory.mktemp("log") / "run.log", [flaser(0, pose_at(0), ranges=words)])
    (scan,) = scans_of(open_source(path))
    np.testing.assert_array_equal(scan.ranges_m, np.minimum(np.float32(list(map(float, words))), np.float32(1e6)))


def test_lines_without_times(tmp_path):
    timed = scans_of(open_source(save(tmp_path / "timed.log", drive(12))))
    source = open_source(save(tmp_path / "run.log", (line.rsplit(None, 3)[0] for line in drive(12))))
    assert all(map(same, scans_of(source), (replace(scan, stamp=k) for k, scan in enumerate(timed))))
    assert source.survey().scan_count == 12
    assert source.faults[Fault.NO_STAMP].count == 12
    assert not source.faults[Fault.BROKEN_LINE].count


def test_decimal_commas(tmp_path):
    wanted = scans_of(open_source(save(tmp_path / "points.log", drive(12))))
    scans = scans_of(open_source(save(tmp_path / "run.log", [line.replace(".", ",") for line in drive(12)])))
    assert len(scans) == len(wanted) == 12
    assert all(map(same, scans, wanted))


RANGES = tuple(round(1.0 + 0.1 * k, 3) for k in range(8))


def raw(stamp, remissions=()):
    words = [0, -1.4, 2.8, 0.4, 30.0, 0.01, 0, 8, *RANGES, len(remissions), *remissions, stamp, "robot", 0.0]
    return "RAWLASER1 " + " ".join(map(str, words))


def test_raw_scans_have_the_pose_of_the_odometry_before_them(tmp_path):
    lines = [line for k in range(12) for line in (odom(100 + k, pose_at(k)), raw(100.1 + k, (1,) * (k % 2)))]
    scans = scans_of(open_source(save(tmp_path / "run.log", [raw(99.0), *lines])))
    np.testing.assert_array_equal([scan.T_odom_base for scan in scans], [pose_at(k) for k in range(12)])
    np.testing.assert_allclose(scans[0].laser.angles_rad(), np.linspace(-1.4, 1.4, 8))
    np.testing.assert_array_equal(scans[0].ranges_m, np.float32(RANGES))
    assert (scans[0].stamp, scans[0].laser.max_range_m) == (100.1, 30.0)


def test_raw_scans_beside_others_are_passed_over(tmp_path):
    lines = [line for k, line in enumerate(drive(12)) for line in (raw(100.0 + k), line)]
    assert len(scans_of(open_source(save(tmp_path / "run.log", lines)))) == 12


def test_lines_that_are_no_scans_are_named(tmp_path):
    lines = [line for k in range(5) for line in (odom(k, pose_at(k)), "RLASER 1 2 3", "TRUEPOS 1 2 3")]
    assert "no laser scan in this CARMEN log; give a log with scans" in refusal(save(tmp_path / "run.log", lines))

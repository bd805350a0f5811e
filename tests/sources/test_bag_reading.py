"""Bags of every kind, as robots record them."""

import math
import os
from copy import copy

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fcslam.records import LaserScan, Odometry
from fcslam.sources import BagOptions, open_source, split
from tests.sources.bag_messages import (
    ANGLE_MIN,
    BEAMS,
    INCREMENT,
    LASER_POSE,
    Said,
    drive,
    mounted,
    odom,
    pose_at,
    quaternion,
    readings_in_tf,
    save,
    scan,
    text,
    tf,
    without,
)
from tests.sources.carmen_text import drive as drive_log
from tests.sources.carmen_text import peak_of, scans_of
from tests.sources.carmen_text import save as save_log

pytestmark = pytest.mark.slow

KINDS = ["run.bag", "run.mcap", "run.db3", "run"]


@pytest.mark.parametrize("name", KINDS)
def test_every_kind_of_bag_says_the_same(tmp_path, name):
    source = open_source(save(tmp_path / name, [*drive(40), text(101.0)]))
    survey = source.survey()
    assert source.name == "run"
    assert (survey.scan_count, survey.lasers[0].beam_count, bool(survey.faults), survey.notes) == (40, BEAMS, False, ())
    assert survey.duration_s == pytest.approx(39 * 0.2)
    assert survey.lasers[0].T_base_laser == pytest.approx(LASER_POSE, abs=1e-9)
    assert survey.lasers[0].max_range_m == 20.0
    np.testing.assert_allclose(survey.lasers[0].angles_rad(), ANGLE_MIN + INCREMENT * np.arange(BEAMS), atol=1e-12)
    for step, record in enumerate(scans_of(source)):
        at = 0.2 * step + 0.05
        assert record.stamp == pytest.approx(100.0 + at, abs=1e-9)
        np.testing.assert_allclose(record.T_odom_base, pose_at(at), atol=1e-3)
        np.testing.assert_allclose(record.ranges_m, [1.0 + 0.01 * step + 0.1 * b for b in range(BEAMS)], rtol=1e-6)
        assert not record.ranges_m.flags.writeable
    assert not source.faults


@pytest.mark.parametrize(
    ("name", "compression"),
    [("run.bag", "bz2"), ("run.bag", "lz4"), ("run", "storage"), ("run", "message"), ("run", "file")],
)
def test_compression_changes_nothing(tmp_path, name, compression):
    (tmp_path / "plain").mkdir()
    plain = open_source(save(tmp_path / "plain" / name, drive(30)))
    packed = open_source(save(tmp_path / name, drive(30), compression))
    for before, after in zip(plain.records(), packed.records(), strict=True):
        assert before.stamp == after.stamp
        np.testing.assert_array_equal(before.T_odom_base, after.T_odom_base)


def test_odometry_goes_with_the_scan_before_it(tmp_path):
    said = [mounted(0.5), *(odom(k, (k, 0, 0)) for k in range(1, 8)), *(scan(k + 0.5) for k in range(1, 7))]
    source = open_source(save(tmp_path / "run.bag", said))
    kinds = "".join("S" if isinstance(record, LaserScan) else "o" for record in source.records())
    assert kinds == "o" + "So" * 6
    assert all(isinstance(record, LaserScan | Odometry) for record in source.records())


@pytest.mark.parametrize("name", KINDS)
def test_parts_and_copies_are_read_side_by_side(tmp_path, name):
    source = open_source(save(tmp_path / name, drive(40)))
    whole = [scan.stamp for scan in scans_of(source)]
    robots = split(source, 3)
    assert [robot.survey().scan_count for robot in robots] == [13, 13, 14]
    together = list(zip(*(robot.records() for robot in robots), strict=False))
    assert together[0][1].stamp == whole[13]
    assert [scan.stamp for robot in robots for scan in scans_of(robot)] == whole
    np.testing.assert_array_equal(scans_of(robots[2])[0].T_odom_base, 0.0)
    assert len(list(zip(source.records(), copy(source).records(), strict=True))) > 40


def test_memory_does_not_grow_with_the_recording(tmp_path):
    short, long = (save(tmp_path / f"{scans}.db3", drive(scans)) for scans in (600, 1500))
    # Of several passes, the least: threads of other tests, and modules that load at the first use, take memory as well.
    short_bytes, long_bytes = (min(peak_of(open_source(path)) for _ in range(3)) for path in (short, long))
    assert long_bytes < 1.2 * short_bytes + 20_000


def test_odometry_at_the_scans_stamp_is_the_scans_to_the_last_bit(tmp_path):
    poses = [(0.1 * k / 3, -0.7 / (k + 1), round(0.1 * k, 6)) for k in range(20)]
    said = [mounted(0.5)]
    for k, pose in enumerate(poses, start=1):
        said += [odom(k, pose), scan(k)]
    for name in KINDS:
        read = [scan.T_odom_base.tolist() for scan in scans_of(open_source(save(tmp_path / name, said)))]
        assert read == [list(pose) for pose in poses]


def test_a_topic_of_odometry_is_preferred_to_tf_unless_tf_is_asked_for(tmp_path):
    said = [*drive(20), *(tf(100 + k, "odom", "base_link", (7.0, 0.0, 0.0)) for k in range(5))]
    bag = save(tmp_path / "run.bag", said)
    assert scans_of(open_source(bag))[0].T_odom_base[0] < 1.0
    assert scans_of(open_source(bag, BagOptions(odom_topic="tf")))[0].T_odom_base[0] == 7.0


def test_odometry_in_a_map_is_left_for_any_other(tmp_path):
    """A second filter corrects it, so it jumps."""
    corrected = [odom(100.0 + 0.1 * k, (9.0, 0.0, 0.0), "/a/odom", parent="map") for k in range(40)]
    for name, others in (("topic", drive(20)), ("tf", [*readings_in_tf(drive(20)), *without(drive(20), "/odom")])):
        source = open_source(save(tmp_path / f"{name}.bag", [*corrected, *others]))
        assert scans_of(source)[0].T_odom_base[0] < 1.0
    leaps = [odom(100.0 + 0.02 * k, (9.0 * (k % 60 > 30), 0.0, 0.0), "/a/odom") for k in range(200)]
    assert scans_of(open_source(save(tmp_path / "leaps.bag", [*leaps, *drive(20)])))[0].T_odom_base[1] != 0.0
    alone = open_source(save(tmp_path / "alone.bag", [*corrected, *without(drive(20), "/odom")]))
    assert scans_of(alone)[0].T_odom_base[0] == 9.0


def test_stamps_of_zero_among_others_are_of_their_clock(tmp_path):
    """As of a simulator, whose clock begins at zero."""
    said = [Said(topic, kind, seconds + 1.7e9, fields) for topic, kind, seconds, fields in drive(40)]
    right = scans_of(open_source(save(tmp_path / "right.bag", said)))
    for zero in ("/scan", "/odom"):
        some = [
            Said(topic, kind, seconds, {**fields, "stamp": 0.0} if topic == zero and k % 4 < 2 else fields)
            for k, (topic, kind, seconds, fields) in enumerate(said)
        ]
        source = open_source(save(tmp_path / f"{zero[1:]}.bag", some))
        for expected, found in zip(right, scans_of(source), strict=True):
            assert found.stamp == pytest.approx(expected.stamp, abs=1e-6)
            np.testing.assert_allclose(found.T_odom_base, expected.T_odom_base, atol=1e-5)
        assert f"messages of {zero} have no stamp; their times of recording count" in " ".join(source.survey().notes)


def test_stamps_that_were_never_set_are_those_of_the_recording(tmp_path):
    said = [message._replace(fields={**message.fields, "stamp": 0.0}) for message in drive(20)]
    source = open_source(save(tmp_path / "run.bag", said))
    assert [scan.stamp for scan in scans_of(source)] == pytest.approx([100.07 + 0.2 * k for k in range(20)], abs=1e-9)


def test_ranges_by_rep_117(tmp_path):
    ranges = (0.05, 0.1, 19.9, 20.0, 25.0, math.inf, -math.inf, math.nan)
    source = open_source(save(tmp_path / "run.bag", [mounted(), odom(100, (0, 0, 0)), scan(100, ranges)]))
    expected = np.array([math.nan, 0.1, 19.9, *(math.nan,) * 2, math.inf, *(math.nan,) * 2], dtype=np.float32)
    np.testing.assert_array_equal(scans_of(source)[0].ranges_m, expected)


angles = st.floats(-3.0, 3.0)
lengths = st.floats(-3.5, 3.5)  # in all less than the 10 m from the base from which a laser is refused


@settings(max_examples=40, deadline=None)
@given(st.tuples(lengths, lengths, angles), st.tuples(lengths, lengths, angles), st.booleans())
def test_what_the_laser_sees_is_where_tf_says(tmp_path_factory, mast, turned, upside_down):
    """base <- mast -> laser, turned and perhaps upside down; rotations by SciPy."""
    roll = math.pi if upside_down else 0.0
    said = [
        tf(99, "/mast", "/base_link", (*mast[:2], 0.7), quaternion(mast[2])),
        tf(99, "mast", "laser", (*turned[:2], 1.1), quaternion(turned[2], roll), topic="/tf_static"),
        odom(100, (0, 0, 0)),
        scan(100, np.arange(1, 9)),
    ]
    (read,) = scans_of(open_source(save(tmp_path_factory.mktemp("bag") / "run.bag", said)))
    beams = ANGLE_MIN + INCREMENT * np.arange(8)
    points = np.column_stack((np.arange(1, 9) * np.cos(beams), np.arange(1, 9) * np.sin(beams), np.zeros(8)))
    in_mast = Rotation.from_euler("xyz", [roll, 0, turned[2]]).apply(points) + np.array([*turned[:2], 1.1])
    in_base = Rotation.from_euler("z", mast[2]).inv().apply(in_mast - np.array([*mast[:2], 0.7]))
    x, y, theta = read.laser.T_base_laser
    directions = theta + read.laser.angles_rad()
    seen = np.column_stack((x + read.ranges_m * np.cos(directions), y + read.ranges_m * np.sin(directions)))
    order = slice(None, None, -1 if upside_down else 1)
    np.testing.assert_allclose(seen, in_base[order, :2], atol=1e-5)


def test_a_laser_on_the_base_itself_needs_no_tf(tmp_path):
    said = [message for message in drive(12) if message.topic != "/tf_static"]
    for message in said:
        message.fields.update({"frame": "base_link"} if message.topic == "/scan" else {})
    assert open_source(save(tmp_path / "run.bag", said)).survey().lasers[0].T_base_laser == (0.0, 0.0, 0.0)


def test_the_users_pose_replaces_tf(tmp_path):
    options = BagOptions(laser_poses=((0.5, -0.25, 1.5),))
    for said in (drive(12), drive(12)[1:]):
        source = open_source(save(tmp_path / f"{len(said)}.bag", said), options)
        assert source.survey().lasers[0].T_base_laser == (0.5, -0.25, 1.5)


def several():
    """A narrow laser that is heard more often, a wide one, and two odometries."""
    said = drive(20)
    said += [scan(100.05 + 0.1 * k, topic="/narrow", angle_increment=INCREMENT / 2) for k in range(30)]
    return said + [odom(100 + 0.05 * k, (9, 9, 0), topic="/filtered") for k in range(90)]


def test_the_widest_laser_is_chosen_and_said_and_the_user_may_choose(tmp_path):
    bag = save(tmp_path / "run.bag", several())
    source = open_source(bag)
    assert source.survey().scan_count == 20
    first, second = source.survey().notes
    assert "from /scan, not from /narrow (--sensors scan-topic" in first
    assert "from /odom, not from /filtered (--sensors odom-topic" in second
    assert str(bag) in first
    source = open_source(bag, BagOptions(scan_topics=("/narrow",), odom_topic="filtered"))
    assert source.survey().scan_count == 30
    assert source.survey().notes == ()
    assert scans_of(source)[0].T_odom_base[0] == 9.0


def test_a_name_may_be_given(tmp_path):
    assert open_source(save(tmp_path / "run.bag", drive(12)), name="anna").name == "anna"
    assert open_source(save_log(tmp_path / "run.log", drive_log(12)), name="ben").name == "ben"


@pytest.mark.attack
@pytest.mark.parametrize("name", [*KINDS, "run.clf"])
@pytest.mark.parametrize("strange", [b"\xff", b"a b#c%20d?e.db3", "läufer.clf".encode()], ids=str)
def test_content_decides_and_any_letters_are_a_name(tmp_path, name, strange):
    """Names that are no UTF-8, and with the ending of another format."""
    path = tmp_path / name
    if name in KINDS:
        save(path, drive(10))
    else:
        save_log(path, drive_log(10))
    other = path.rename(tmp_path / os.fsdecode(strange))
    source = open_source(other)
    assert source.survey().scan_count == sum(isinstance(record, LaserScan) for record in source.records()) == 10

"""A written bag reads back the same, and other programs can read it."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.highlevel import AnyReader

from fcslam.errors import InputError, SourceError
from fcslam.records import LaserModel, LaserScan, Odometry, Sweep, frozen
from fcslam.sources import open_source, write_bag
from tests.sources.bag_messages import STORES, drive, save
from tests.sources.carmen_text import only_scans, pose_at, scans_of

pytestmark = pytest.mark.slow

KINDS = ["run.bag", "run.mcap", "run.db3", "run"]
SICK = LaserModel(181, -90 * math.radians(1.0), math.radians(1.0), 50.0, (0.25, 0.0, 0.0))
ROUND = LaserModel(12, -math.pi, math.tau / 12, 12.5, (-0.1, 0.05, 0.4))

coordinates = st.floats(-1000, 1000).map(lambda value: round(value, 6))
poses = st.tuples(coordinates, coordinates, st.floats(-2.8, 2.8).map(lambda value: round(value, 6)))
steps = st.tuples(*[st.floats(-0.1, 0.1)] * 3)
"""Odometry without jumps."""
ranges = st.one_of(st.floats(0, 60, width=32), st.just(math.nan), st.just(math.inf))


@st.composite
def recordings(draw):
    """Records at stamps of microseconds, whose clock steps back now and then."""
    start = draw(poses)
    near = steps.map(lambda step: frozen(np.round(np.add(start, step), 6)))
    laser = draw(st.sampled_from([SICK, ROUND]))
    records, stamp = [], draw(st.sampled_from([0.2, 1e6, 1.3e9]))
    for _ in range(draw(st.integers(3, 10))):
        stamp = round(stamp + draw(st.sampled_from([-0.3, 0.0, 0.1, 0.7, 0.9])), 6)
        pose, stamp = draw(near), max(stamp, 1e-6)
        if draw(st.booleans()):
            records.append(Odometry(stamp, pose))
            pose = draw(near)
        values = [2.0, *draw(st.lists(ranges, min_size=3, max_size=3))]
        filled = np.resize(np.array(values, dtype=np.float32), laser.beam_count)
        records.append(LaserScan(stamp, frozen(filled, np.float32), laser, pose))
    return records


@settings(max_examples=30, deadline=None)
@given(recordings(), st.sampled_from(KINDS))
def test_what_is_written_reads_back_to_the_last_bit(tmp_path_factory, records, name):
    path = tmp_path_factory.mktemp("bag") / name
    write_bag(path, records)
    source = open_source(path)
    written = only_scans(records)
    read = scans_of(source)
    assert len(read) == len(written)
    for before, after in zip(written, read, strict=True):
        assert after.stamp == before.stamp
        assert after.T_odom_base.tolist() == before.T_odom_base.tolist()
        assert after.laser == before.laser
        beyond = np.isfinite(before.ranges_m) & (before.ranges_m >= before.laser.max_range_m)
        np.testing.assert_array_equal(after.ranges_m, np.where(beyond, np.nan, before.ranges_m))


def straight(count=20, laser=ROUND):
    one = frozen(np.full(laser.beam_count, 2.0), np.float32)
    return [LaserScan(100.0 + 0.2 * k, one, laser, frozen(pose_at(k))) for k in range(count)]


def turning(sweep, count=40):
    """Odometry at 50 Hz and scans of a robot that turns at 1.5 rad/s and drives at 0.5 m/s."""
    ranges_m = frozen(np.arange(2.0, 2.0 + ROUND.beam_count), np.float32)
    for k in range(count):
        stamp, pose = 100.0 + 0.02 * k, frozen((0.01 * k, 0.0, 0.03 * k))
        yield Odometry(stamp, pose)
        if k % 10 == 5:
            yield LaserScan(stamp, ranges_m, ROUND, pose, sweep)


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("sweep", [Sweep(0.0, 0.1), Sweep(0.1, 0.0)], ids=["counter-clockwise", "clockwise"])
def test_the_times_of_the_beams_come_back_and_the_motion_from_the_odometry(tmp_path, name, sweep):
    records = list(turning(sweep))
    write_bag(tmp_path / name, records)
    scans = only_scans(records)
    read = scans_of(open_source(tmp_path / name))
    for before, after in zip(scans, read, strict=True):
        assert after.stamp == before.stamp
        np.testing.assert_allclose(after.T_odom_base, before.T_odom_base, atol=1e-9)
        np.testing.assert_array_equal(after.ranges_m, np.where(before.ranges_m >= 12.5, np.nan, before.ranges_m))
        np.testing.assert_allclose(after.laser.angles_rad(), ROUND.angles_rad(), atol=1e-6)
        assert after.sweep[:2] == pytest.approx(sweep[:2], abs=1e-8)
        assert after.sweep.velocity[2] == pytest.approx(1.5, abs=1e-6)
        assert after.sweep.velocity[0] == pytest.approx(0.5 * math.cos(after.T_odom_base[2]), abs=0.01)


def test_a_clockwise_scan_has_negative_increments_and_the_stamp_of_its_first_measured_beam(tmp_path):
    write_bag(tmp_path / "run.mcap", turning(Sweep(0.06, -0.05), 10))
    with AnyReader([tmp_path / "run.mcap"], default_typestore=STORES[False]) as reader:
        (scan,) = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages() if c.topic == "/scan"]
    assert scan.header.stamp.sec + scan.header.stamp.nanosec * 1e-9 == pytest.approx(100.05, abs=1e-8)
    assert scan.angle_increment == pytest.approx(-ROUND.angle_increment_rad)
    assert scan.angle_min == pytest.approx(ROUND.angles_rad()[-1], abs=1e-6)
    assert scan.angle_max == pytest.approx(ROUND.angles_rad()[0], abs=1e-6)
    assert scan.ranges[-1] == 2.0
    assert (scan.time_increment, scan.scan_time) == pytest.approx((0.01, 0.12))


def test_a_robot_without_odometry_has_none_in_the_bag(tmp_path):
    unknown = [LaserScan(s.stamp, s.ranges_m, s.laser, frozen((math.nan,) * 3)) for s in straight(5)]
    write_bag(tmp_path / "run.mcap", unknown)
    with AnyReader([tmp_path / "run.mcap"], default_typestore=STORES[False]) as reader:
        assert {topic: info.msgcount for topic, info in reader.topics.items()} == {
            "/scan": 5, "/odom": 0, "/tf": 0, "/tf_static": 1,
        }  # fmt: skip


@pytest.mark.parametrize("name", KINDS)
def test_equal_records_give_equal_bytes(tmp_path, name):
    contents = []
    for folder in "ab":
        (tmp_path / folder).mkdir()
        write_bag(tmp_path / folder / name, straight(300))
        files = sorted(path for path in (tmp_path / folder).rglob("*") if path.is_file())
        assert len(files) == (2 if name == "run" else 1)
        contents.append([path.read_bytes() for path in files])
    assert contents[0] == contents[1]


@pytest.mark.parametrize("name", KINDS)
def test_others_read_it(tmp_path, name):
    """By rosbags' own reader: topics, types, frames; the time of recording only grows, header stamps may not."""
    records = straight()
    records[5], records[6] = records[6], records[5]
    write_bag(tmp_path / name, records)
    with AnyReader([tmp_path / name], default_typestore=STORES[name == "run.bag"]) as reader:
        assert {topic: (info.msgtype, info.msgcount) for topic, info in reader.topics.items()} == {
            "/scan": ("sensor_msgs/msg/LaserScan", 20),
            "/odom": ("nav_msgs/msg/Odometry", 20),
            "/tf": ("tf2_msgs/msg/TFMessage", 20),
            "/tf_static": ("tf2_msgs/msg/TFMessage", 1),
        }
        messages = [(c.topic, t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages()]
    times = [bag_time for topic, bag_time, _ in messages if topic == "/scan"]
    assert times == sorted(set(times))
    scans = [message for topic, _, message in messages if topic == "/scan"]
    stamps = [scan.header.stamp.sec + scan.header.stamp.nanosec * 1e-9 for scan in scans]
    assert stamps == pytest.approx([record.stamp for record in records], abs=1e-9)
    (static,) = [message.transforms[0] for topic, _, message in messages if topic == "/tf_static"]
    assert (static.header.frame_id, static.child_frame_id) == ("base_link", scans[0].header.frame_id)
    assert static.transform.translation.x == ROUND.T_base_laser[0]
    odometry = next(message for topic, _, message in messages if topic == "/odom")
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("odom", "base_link")
    assert scans[0].angle_max == pytest.approx(math.pi - math.tau / 12, abs=1e-6)


def test_a_file_is_replaced_when_the_new_one_is_complete(tmp_path):
    def interrupted():
        yield from straight(5)
        raise KeyboardInterrupt

    for name in KINDS[:3]:
        path = tmp_path / name
        path.write_text("old")
        with pytest.raises(KeyboardInterrupt):
            write_bag(path, interrupted())
        assert path.read_text() == "old"
        write_bag(path, straight(5))
        assert open_source(path).survey().scan_count == 5
    assert {path.name for path in tmp_path.iterdir()} == set(KINDS[:3])


@pytest.mark.parametrize("name", ["missing/run.bag", "missing/run.mcap", "run.zip", "full", "missing#1.db3"])
def test_what_cannot_be_written_is_reported(tmp_path, name):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    with pytest.raises(InputError, match=r"full|missing|run\.zip"):
        write_bag(tmp_path / name, straight(2))


def test_a_clock_that_begins_at_zero_reads_back_to_the_last_bit(tmp_path):
    """The first stamp is zero, and the times of recording of equal stamps differ by a nanosecond."""
    ranges_m, pose = frozen(np.ones(ROUND.beam_count), np.float32), frozen((0.0, 0.0, 0.0))
    stamps = [0.125 * (k // 3) for k in range(30)]
    write_bag(tmp_path / "run.mcap", [LaserScan(stamp, ranges_m, ROUND, pose) for stamp in stamps])
    assert [scan.stamp for scan in scans_of(open_source(tmp_path / "run.mcap"))][3:] == stamps[3:]


@pytest.mark.parametrize("stamp", [-1.0, 2.0**31, math.nan])
def test_stamps_that_ros_does_not_have(tmp_path, stamp):
    one = frozen(np.ones(12), np.float32)
    with pytest.raises(InputError, match="ROS counts from 0 s"):
        write_bag(tmp_path / "run.bag", [LaserScan(stamp, one, ROUND, frozen((0, 0, 0)))])
    assert list(tmp_path.iterdir()) == []


def test_faults_of_the_source_are_not_hidden(tmp_path):
    bag = save(tmp_path / "run.bag", drive(20)[1:])
    with pytest.raises(SourceError, match="no transform"):
        write_bag(tmp_path / "out.mcap", open_source(bag).records())
    assert list(tmp_path.iterdir()) == [bag]

"""Scans whose beams vary, several lasers of one robot, and topics of a fleet, through every kind of recording."""

import math

import numpy as np
import pytest

from fcslam.records import Beams, LaserModel, LaserScan, frozen
from fcslam.sources import BagOptions, Fault, FaultCount, open_source, write_bag
from tests.carmen_logs import write_carmen
from tests.sources.bag_messages import drive, mounted, odom, pose_at, scan, tf
from tests.sources.bag_messages import save as save_bag
from tests.sources.carmen_text import pose_at as log_pose
from tests.sources.carmen_text import refusal, robotlaser, save, scans_of

SICK = LaserModel(181, -math.pi / 2, math.radians(1.0), 50.0)
TURNING = LaserModel(1100, -math.pi, math.tau / 1100, 12.0)
REAR = LaserModel(181, -math.pi / 2, math.radians(1.0), 30.0, (-0.3, 0.0, math.pi))


def interleaved(laser=SICK):
    """The lasers of a cycle of four scans."""
    count, first, increment = laser.beams
    yield laser
    for step in (1, 2, 3):
        yield laser.with_beams(Beams(count - 1, first + 0.25 * step * increment, increment))


def jittering(laser=TURNING):
    for count in (1080, 1100, 1150, 1099):
        yield laser.with_beams(Beams(count, laser.angle_min_rad, math.tau / count))


def scans(lasers, cycles=6):
    """Scans whose ranges tell the directions of their beams."""
    lasers = list(lasers) * cycles
    return [
        LaserScan(100.0 + 0.25 * k, frozen(np.round(6.0 + laser.angles_rad(), 3), np.float32), laser,
                  frozen((0.125 * k, 0.0, 0.0)))
        for k, laser in enumerate(lasers)
    ]  # fmt: skip


@pytest.mark.parametrize("kind", [interleaved, jittering], ids=["interleaved", "jittering"])
@pytest.mark.parametrize("name", ["run.clf", "run.bag", "run.mcap"])
def test_every_format_keeps_the_beams_of_each_scan(tmp_path, kind, name):
    written = scans(kind())
    (write_carmen if name.endswith(".clf") else write_bag)(tmp_path / name, written)
    source = open_source(tmp_path / name)
    read = scans_of(source)
    assert source.survey().scan_count == len(read) == len(written)
    assert not source.faults
    for before, after in zip(written, read, strict=True):
        np.testing.assert_allclose(after.laser.angles_rad(), before.laser.angles_rad(), atol=2e-6)
        np.testing.assert_array_equal(after.ranges_m, before.ranges_m)
        assert after.laser.T_base_laser == before.laser.T_base_laser


def test_lines_that_state_their_angles(tmp_path):
    def line(k, start, count):
        return robotlaser(100 + k, log_pose(k), (0, start, math.pi, math.radians(1.0), 30.0, 0.01, 0), (1.0,) * count)

    starts = [-math.pi / 2 + math.radians(0.25 * (k % 4)) for k in range(20)]
    lines = [line(k, start, 181 - (k % 4 > 0)) for k, start in enumerate(starts)]
    lines[7] = line(7, 0.0, 100)
    source = open_source(save(tmp_path / "run.log", lines))
    assert [scan.laser.angle_min_rad for scan in scans_of(source)] == pytest.approx([*starts[:7], *starts[8:]])
    assert source.faults[Fault.OTHER_BEAMS] == FaultCount(1, 8)


def test_one_range_more_or_less_than_the_angles_say(tmp_path):
    """The most common complaint of slam_toolbox: 361 range readings, expected 360."""
    one_more = {"angle_max": -math.pi + 359 * math.tau / 360, "angle_min": -math.pi, "angle_increment": math.tau / 360}
    said = [mounted(), *(odom(100 + k, pose_at(k)) for k in range(4))]
    said += [scan(100 + k, (1.0,) * (360 + (k > 0)), **one_more) for k in range(4)]
    source = open_source(save_bag(tmp_path / "run.bag", said))
    assert [len(scan.ranges_m) for scan in scans_of(source)] == [360, 361, 361, 361]
    assert source.faults.counts.keys() <= {Fault.REPEATED_SCAN}, "the ranges are all alike"


def front_and_rear(rear_frame="rear", rear_pose=True):
    """Both at 5 Hz; each scan of the rear laser is recorded before one of the front laser that was taken earlier."""
    said = drive(20)
    if rear_pose:
        said.append(tf(100.0, "base_link", "rear", (-0.3, 0.0, 0.3), (0.0, 0.0, 1.0, 0.0), topic="/tf_static"))
    rear = [scan(100.06 + 0.2 * k, topic="/rear", bag_time=100.065 + 0.2 * k, frame=rear_frame) for k in range(20)]
    return [*said, *rear]


BOTH = BagOptions(scan_topics=("/scan", "/rear"))


def test_two_lasers_are_merged_in_time(tmp_path):
    source = open_source(save_bag(tmp_path / "run.bag", front_and_rear()), BOTH)
    front, rear = source.survey().lasers
    read = scans_of(source)
    assert source.survey().scan_count == len(read) == 40
    assert [scan.stamp for scan in read] == sorted(scan.stamp for scan in read)
    assert [scan.laser for scan in read] == [front, rear] * 20
    assert rear.T_base_laser == pytest.approx((-0.3, 0.0, math.pi))
    assert not source.faults
    assert len(scans_of(open_source(tmp_path / "run.bag", BagOptions(scan_topics=("/rear",))))) == 20


def test_a_laser_that_falls_silent_does_not_hold_up_the_other(tmp_path):
    said = [message for message in front_and_rear() if message.topic != "/rear" or message.bag_time < 101.0]
    read = scans_of(open_source(save_bag(tmp_path / "run.bag", said), BOTH))
    assert len(read) == 25
    assert [scan.stamp for scan in read] == sorted(scan.stamp for scan in read)


@pytest.mark.parametrize(
    ("said", "options", "words"),
    [
        (front_and_rear("laser"), BOTH, "/scan and /rear have one frame, 'laser'"),
        (
            front_and_rear(rear_pose=False),
            BOTH,
            "so the pose of the laser of /rear is unknown; give it with --sensors laser-pose=X,Y,THETA ",
        ),
        (
            front_and_rear(),
            BagOptions(("/scan", "/rear"), laser_poses=((0.0, 0.0, 0.0),)),
            "1 laser-pose for the lasers /scan, /rear; give one for each",
        ),
    ],
)
def test_lasers_that_cannot_be_told_apart_are_refused_in_one_line(tmp_path, said, options, words):
    assert words in refusal(save_bag(tmp_path / "run.bag", said), options)


def test_poses_of_lasers_by_hand(tmp_path):
    poses = ((0.1, 0.0, 0.0), (-0.4, 0.0, 3.0))
    bag = save_bag(tmp_path / "run.bag", front_and_rear("laser", rear_pose=False))
    lasers = open_source(bag, BagOptions(("/scan", "/rear"), laser_poses=poses)).survey().lasers
    assert tuple(laser.T_base_laser for laser in lasers) == poses


def test_a_bag_holds_several_lasers(tmp_path):
    written = scans([SICK, REAR])
    write_bag(tmp_path / "run.mcap", written)
    read = scans_of(open_source(tmp_path / "run.mcap", BagOptions(scan_topics=("/scan", "/scan_2"))))
    mountings = np.array([scan.laser.T_base_laser for scan in read])
    np.testing.assert_allclose(mountings, [(0.0, 0.0, 0.0), (-0.3, 0.0, math.pi)] * 6, atol=1e-9)
    assert all(np.array_equal(before.ranges_m, after.ranges_m) for before, after in zip(written, read, strict=True))

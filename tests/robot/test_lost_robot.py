"""A robot that is put down elsewhere begins another session, and nothing ties the two."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.geometry import se2
from fcslam.lidar.lost import LostConfig
from fcslam.records import Channel, Constraint, Keyscan, frozen
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.wire.messages import Hello
from fcslam.wire.packets import encode
from tests import small_fleet
from tests.robot.kidnapping import drives, kidnapping

pytestmark = pytest.mark.slow

LIDAR = (Channel.LIDAR,)
ROBOT = RobotConfig(channels=LIDAR)
BLIND = RobotConfig(channels=LIDAR, lost=LostConfig(doubted=0.0))


def driven(records, config=ROBOT):
    return small_fleet.driven(records, config)


def test_a_kidnapped_robot_begins_anew_where_it_was_put_down():
    scans, moment = kidnapping()
    robot, packets = driven(scans)
    assert len(robot.tracks) == 2
    first, second = ([packet for packet in packets if packet.epoch == epoch] for epoch in (0, 1))
    assert [*first, *second] == packets
    assert packets == small_fleet.in_order(packets)
    for session in (first, second):
        assert isinstance(session[0].body, Hello)
        assert [packet.sequence for packet in session] == list(range(len(session)))
        keyscans = [packet.body.id.number for packet in session if isinstance(packet.body, Keyscan)]
        assert keyscans == list(range(len(keyscans)))
    assert max(p.body.stamp for p in first if isinstance(p.body, Keyscan)) <= moment
    assert min(p.body.stamp for p in second if isinstance(p.body, Keyscan)) > moment
    assert [pose.stamp for track in robot.tracks for pose in track] == [scan.stamp for scan in scans]


def test_both_sessions_are_what_two_robots_would_have_said():
    scans, moment = kidnapping()
    _, packets = driven(scans)
    cut = next(k for k, scan in enumerate(scans) if scan.stamp > moment)
    alone = [*driven(scans[:cut], BLIND)[1], *driven(scans[cut:], BLIND)[1]]
    assert [replace_epoch(packet) for packet in packets] == [encode(packet) for packet in alone]


def replace_epoch(packet):
    body = replace(packet.body, epoch=0) if isinstance(packet.body, Hello) else packet.body
    return encode(replace(packet, epoch=0, body=body))


def test_a_robot_that_drove_on_unseen_begins_anew():
    scans = [scan for scan in drives()[0] if scan.stamp < 1010.0]
    T_odom_there = np.array((26.0, 3.0, 0.4))
    after = [
        replace(scan, stamp=scan.stamp + 300.0, T_odom_base=frozen(se2.compose(T_odom_there, scan.T_odom_base)))
        for scan in scans
    ]
    robot, packets = driven([*scans, *after])
    assert [len(track) for track in robot.tracks] == [len(scans), len(after)]
    motions = [packet.body.T_i_j for packet in packets if isinstance(packet.body, Constraint)]
    assert max(np.hypot(x, y) for x, y, _ in motions) < 1.0


def test_a_drive_without_surprises_says_the_same_whether_it_is_watched_or_not():
    for scans in drives():
        robot, watched = driven(scans)
        assert len(robot.tracks) == 1
        assert [encode(packet) for packet in watched] == [encode(packet) for packet in driven(scans, BLIND)[1]]


def test_doubt_that_passes_leaves_no_trace():
    """Somebody stands before the laser for three scans."""
    scans = list(drives()[0])
    for k in range(100, 103):
        close = np.full_like(scans[k].ranges_m, 0.4)
        close[::2] = 0.9
        scans[k] = replace(scans[k], ranges_m=frozen(close, np.float32))
    robot = RobotFrontend("r", ROBOT)
    said = [robot.process(scan) for scan in scans]
    assert said[100] == said[101] == said[102] == []
    assert len(robot.tracks) == 1
    packets = [packet for some in said for packet in some] + robot.finish()
    assert [encode(packet) for packet in packets] == [encode(packet) for packet in driven(scans, BLIND)[1]]


def test_a_recording_that_ends_in_doubt_is_whole():
    scans, moment = kidnapping()
    end = next(k for k, scan in enumerate(scans) if scan.stamp > moment) + 3
    robot, packets = driven(scans[:end])
    assert len(robot.scan_poses) == end
    assert [encode(packet) for packet in packets] == [encode(packet) for packet in driven(scans[:end], BLIND)[1]]

"""One robot's way from sensor records to packets."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.records import (
    CameraImage,
    CameraModel,
    Constraint,
    ConstraintKind,
    Keyscan,
    Place,
    Transform,
    frozen,
)
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.wire.packets import decode, encode
from tests import small_fleet
from tests.small_fleet import driven


@pytest.fixture(scope="module")
def scans():
    return list(small_fleet.draw(1, path_length_m=12.0).robots[0].scans())


def bodies(packets, kind):
    return [packet.body for packet in packets if isinstance(packet.body, kind)]


@pytest.mark.slow
def test_packets_are_numbered_timed_and_survive_the_wire(scans):
    _, packets = driven(scans)
    assert [packet.sequence for packet in packets] == list(range(len(packets)))
    assert {(packet.robot, packet.epoch) for packet in packets} == {("r", 0)}
    assert all(np.diff([packet.time for packet in packets]) >= 0.0)
    assert packets == small_fleet.in_order(packets)
    for packet in packets:
        assert encode(decode(encode(packet))) == encode(packet)


@pytest.mark.slow
def test_broken_images_cause_no_packet_and_change_none(scans):
    camera = CameraModel(1, 1, 1.0, 1.0, 0.0, 0.0, Transform((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
    seen = [CameraImage(scan.stamp, bytes(5000), camera, scan.T_odom_base) for scan in scans]
    assert RobotFrontend("r", RobotConfig()).process(seen[0]) == []
    both = [record for pair in zip(scans, seen, strict=True) for record in pair]
    assert [encode(packet) for packet in driven(both)[1]] == [encode(packet) for packet in driven(scans)[1]]


def test_every_keyscan_is_followed_by_the_motion_that_leads_to_it(scans):
    _, packets = driven(scans)
    chain = [
        body
        for body in (packet.body for packet in packets)
        if isinstance(body, Keyscan) or (isinstance(body, Constraint) and body.kind is ConstraintKind.ODOMETRY)
    ]
    assert isinstance(chain[0], Keyscan)
    for number, (keyscan, motion) in enumerate(zip(chain[1::2], chain[2::2], strict=True), start=1):
        assert keyscan.id.number == number
        assert (motion.i, motion.j) == (number - 1, number)


def test_places_name_keyscans_that_were_sent_before(scans):
    _, packets = driven(scans)
    sent = -1
    assert bodies(packets, Place)
    for packet in packets:
        if isinstance(packet.body, Keyscan):
            sent = packet.body.id.number
        if isinstance(packet.body, Place):
            assert 0 <= packet.body.first <= packet.body.id.number <= packet.body.last <= sent
    anchors = [place.id.number for place in bodies(packets, Place)]
    assert anchors == sorted(set(anchors))


def test_every_scan_has_a_pose_on_a_keyscan(scans):
    frontend, packets = driven(scans)
    assert [pose.stamp for pose in frontend.scan_poses] == [scan.stamp for scan in scans]
    keyscans = bodies(packets, Keyscan)
    at = {keyscan.stamp: keyscan.id.number for keyscan in keyscans}
    for pose in frontend.scan_poses:
        assert 0 <= pose.keyscan < len(keyscans)
        if pose.stamp in at:
            assert pose.keyscan == at[pose.stamp]
            assert np.allclose(pose.T_keyscan_base, 0.0, atol=1e-9)


@pytest.mark.slow
def test_ranges_between_two_steps_of_the_wire_make_no_difference(scans):
    """The robot works with the ranges that the cloud sees: what the wire rounds off changes nothing."""
    rng = np.random.default_rng(0)
    rounded = [replace(scan, ranges_m=frozen(0.002 * np.rint(scan.ranges_m / 0.002), np.float32)) for scan in scans]
    jittered = [
        replace(s, ranges_m=frozen(s.ranges_m + rng.uniform(-0.0008, 0.0008, len(s.ranges_m)), np.float32))
        for s in rounded
    ]
    expected = [encode(packet) for packet in driven(rounded)[1]]
    assert [encode(packet) for packet in driven(jittered)[1]] == expected


def test_time_on_packets_never_goes_back(scans):
    back = [replace(scan, stamp=scan.stamp - (0.9 if k % 7 == 3 else 0.0)) for k, scan in enumerate(scans)]
    _, packets = driven(back)
    assert all(np.diff([packet.time for packet in packets]) >= 0.0)
    for packet in packets:
        encode(packet)  # no keyscan is later than its packet


@pytest.mark.slow
@pytest.mark.parametrize("blind", [slice(0, 1), slice(0, 5), slice(20, 24), slice(0, None)])
def test_scans_that_see_nothing_do_not_stop_a_robot(scans, blind):
    """Covered at the start, dazzled on the way, or blind for all time."""
    seen = list(scans)
    seen[blind] = [replace(s, ranges_m=frozen(np.full_like(s.ranges_m, np.nan), np.float32)) for s in seen[blind]]
    frontend, packets = driven(seen)
    keyscans = bodies(packets, Keyscan)
    assert len(frontend.scan_poses) == len(scans)
    assert keyscans
    assert all(0 <= pose.keyscan < len(keyscans) for pose in frontend.scan_poses)
    for packet in packets:
        encode(packet)

"""Replies of the cloud: acknowledgements without a gap, new corrections, and detectors that a robot lacks."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.cloud.replies import NEWS_M, NEWS_RAD, SessionCorrection, is_news, replies
from fcslam.records import Channel, Correction, DetectorFile, frozen
from fcslam.wire.messages import Acknowledgement, DetectorUpdate

OTHER = DetectorFile(Channel.CAMERA, "other-1", 1, 5, bytes(32))
CORRECTION = Correction("a", 3, 0, frozen((1.0, 2.0, 3.1)), 0.5)


def bodies(expected, announced=None, versions=None):
    detectors = {} if announced is None else {announced.channel: announced}
    packets = replies("a", expected, None, -1, detectors, versions or {})
    assert [packet.sequence for packet in packets] == list(range(len(packets)))
    assert {packet.robot for packet in packets} <= {"a"}
    return [packet.body for packet in packets]


def test_each_epoch_is_acknowledged_up_to_its_first_gap():
    assert bodies({0: 5, 1: 0, 2: 1}) == [Acknowledgement("a", 0, 4), Acknowledgement("a", 2, 0)]
    assert bodies({}) == []


@pytest.mark.parametrize(("known", "sent"), [(-1, True), (2, True), (3, False), (4, False)])
def test_a_correction_is_sent_to_a_robot_that_lacks_it(known, sent):
    (_, *rest) = replies("a", {1: 1}, SessionCorrection("a", 1, 7.0, CORRECTION), known)
    assert [(packet.epoch, packet.time, packet.body) for packet in rest] == [(1, 7.0, CORRECTION)] * sent


@pytest.mark.parametrize(
    ("versions", "sent"),
    [
        ({Channel.CAMERA: "orb-1"}, True),
        ({Channel.CAMERA: "other-1"}, False),
        ({Channel.LIDAR: "b"}, False),
        (None, False),
    ],
)
def test_a_detector_is_announced_until_the_robot_uses_it(versions, sent):
    """A robot without a camera never needs one."""
    assert bodies({0: 1}, OTHER, versions)[1:] == [DetectorUpdate("a", OTHER)] * sent


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({}, False),
        ({"version": 9}, False),
        ({"map_index": 1}, True),
        ({"T_map_odom": frozen((1.0 + 0.9 * NEWS_M, 2.0, 3.1))}, False),
        ({"T_map_odom": frozen((1.0, 2.0 - 1.1 * NEWS_M, 3.1))}, True),
        ({"T_map_odom": frozen((1.0, 2.0, 3.1 + 1.1 * NEWS_RAD))}, True),
        ({"T_map_odom": frozen((1.0, 2.0, 3.1 - 2.0 * np.pi))}, False),
        ({"quality": 0.51}, False),
        ({"quality": 0.53}, True),
        ({"quality": 0.0}, True),
    ],
)
def test_what_is_news(change, expected):
    assert is_news(CORRECTION, replace(CORRECTION, **change)) is expected
    assert is_news(None, CORRECTION)

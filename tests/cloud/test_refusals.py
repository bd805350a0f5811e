"""Packets that do not fit: what is refused, why, and that the fleet is none the worse for it."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from fcslam.cloud.cloud import Cloud
from fcslam.cloud.replies import is_news
from fcslam.cloud.settings import FleetConfig
from fcslam.errors import PacketError
from fcslam.records import Beams, Channel, ConstraintKind, Correction, KeyscanId, frozen
from fcslam.wire.messages import Acknowledgement, Hello, Packet
from fcslam.wire.packets import decode, encode
from tests.scripted import LASER, closures, keyscan, motion, place, rectangle, stream
from tests.small_fleet import feed, fingerprint, in_order

POSES = rectangle(17)
STEP = np.array([1.0, 0.0, 0.0])
PACKETS = in_order([*stream("a", POSES, start_s=0.0), *stream("b", POSES, start_s=0.5)])
SCRIPT = closures(("a", POSES), ("b", POSES), [(0, 0), (4, 4), (8, 8), (12, 12)])
HALF = len(PACKETS) // 2
KNOWN = sum(packet.robot == "a" for packet in PACKETS[:HALF])
"""Packets that robot a has sent by then."""
NUMBER = sum(packet.robot == "a" and hasattr(packet.body, "ranges_m") for packet in PACKETS[:HALF])
"""Keyscans among them."""
NOW = PACKETS[HALF].time

HOSTILE = {
    "keyscan of an unknown robot": (keyscan("x", 0, NOW), "before its hello"),
    "motion of an unknown robot": (motion("x", 0, 1, STEP), "does not lead to a new keyscan"),
    "closure of an unknown robot": (motion("x", 0, 1, STEP, ConstraintKind.CLOSURE), "names keyscan 0"),
    "place of an unknown robot": (place("x", 0), "names keyscan 0"),
    "another laser": (Hello("a", 0, (replace(LASER, max_range_m=9.0),), {}), "changes or lacks an announced laser"),
    "a laser that is not announced": (replace(keyscan("a", NUMBER, NOW), laser=1), "of laser 1, 1 announced"),
    "beams of another laser": (
        replace(keyscan("a", NUMBER, NOW, beams=4), beams=Beams(4, -np.pi, np.pi / 2)),
        "not of laser 0: its beams are 90 degrees apart",
    ),
    "too many beams": (keyscan("a", NUMBER, NOW, beams=9), "9 beams, 8 announced"),
    "too few beams": (keyscan("a", NUMBER, NOW, beams=1), "1 beams, 8 announced"),
    "a keyscan left out": (keyscan("a", NUMBER + 1, NOW), f"keyscan {NUMBER + 1} where {NUMBER} is next"),
    "a keyscan again": (keyscan("a", NUMBER - 1, NOW), f"keyscan {NUMBER - 1} where {NUMBER} is next"),
    "motion again": (motion("a", NUMBER - 2, NUMBER - 1, STEP), "does not lead to a new keyscan"),
    "motion ahead": (motion("a", NUMBER - 1, NUMBER, STEP), "does not lead to a new keyscan"),
    "closure ahead": (motion("a", 0, NUMBER, STEP, ConstraintKind.CLOSURE), f"names keyscan {NUMBER}"),
    "place ahead": (place("a", NUMBER), f"names keyscan {NUMBER}"),
    "place that reaches ahead": (place("a", 1, last=NUMBER + 5), f"names keyscan {NUMBER + 5}"),
    "place again": (place("a", 4), "described before"),
    "place of another detector": (place("a", 1, detector_version="test-2"), "detector test-2"),
    "place of a channel not announced": (
        place("a", 1, channel=Channel.CAMERA, keypoints=np.zeros((0, 3), np.float32)),
        "none was announced",
    ),
    "correction": (Correction("a", 0, 0, frozen(np.zeros(3))), "goes to a robot"),
    "acknowledgement": (Acknowledgement("a", 0, 3), "goes to a robot"),
}


def refusal_of(cloud, data):
    """Why the cloud refuses these bytes; None if it accepts them."""
    try:
        cloud.receive(data)
    except PacketError as error:
        return str(error)
    return None


@cache
def result_of(count):
    """What a fleet makes of so many packets, by the script that the fixture ``scripted`` was given."""
    return fingerprint(feed(Cloud(FleetConfig(), seed=0), PACKETS[:count]).finalize())


@pytest.fixture
def reference(scripted):
    scripted(SCRIPT)
    return result_of(len(PACKETS))


def next_packet(body, after=0):
    """The next that the body's robot would send, ``after`` others."""
    robot = body.id.robot if hasattr(body, "id") else body.robot
    return Packet(robot, 0, (KNOWN if robot == "a" else 0) + after, NOW, body)


def rest(body, refused):
    """The second half of the packets; a's numbers follow on those that were refused."""
    after = refused if next_packet(body).robot == "a" else 0
    return [replace(p, sequence=p.sequence + after) if p.robot == "a" else p for p in PACKETS[HALF:]]


@pytest.mark.slow
@pytest.mark.parametrize(("body", "reason"), HOSTILE.values(), ids=HOSTILE)
def test_what_does_not_fit_is_refused_and_leaves_no_trace(scripted, reference, body, reason):
    before = result_of(HALF)
    cloud = feed(scripted(SCRIPT), PACKETS[:HALF])
    for attempt in range(2):  # a second attempt fares no better
        assert reason in refusal_of(cloud, encode(next_packet(body, attempt)))
    assert fingerprint(cloud.finalize()) == before
    assert fingerprint(feed(cloud, rest(body, refused=2)).finalize()) == reference


@pytest.mark.slow
@pytest.mark.parametrize(("body", "reason"), HOSTILE.values(), ids=HOSTILE)
def test_what_comes_early_and_does_not_fit_does_no_harm_either(scripted, reference, body, reason):
    """It waits for the packets before it; the packet that lets it speak is not blamed."""
    cloud = scripted(SCRIPT)
    refusal_of(cloud, encode(next_packet(body)))
    for packet in PACKETS[:HALF]:
        assert refusal_of(cloud, encode(packet)) is None
    assert fingerprint(feed(cloud, rest(body, refused=1)).finalize()) == reference


@pytest.mark.parametrize("name", ["a+1", "a+0", "x+2+3"])
def test_a_robot_that_is_called_like_a_session_is_refused(scripted, reference, name):
    cloud = feed(scripted(SCRIPT), PACKETS[:HALF])
    again = Packet(name, 0, 0, NOW, Hello(name, 0, (LASER,), {}))
    assert "without '+" in refusal_of(cloud, encode(again))
    assert fingerprint(feed(cloud, PACKETS[HALF:]).finalize()) == reference


def test_a_keyscan_waits_for_the_motion_to_the_one_before(scripted):
    packets = stream("a", POSES, start_s=0.0)
    cloud = feed(scripted(), packets[:3])  # hello, keyscan 0, place 0
    feed(cloud, [Packet("a", 0, 3, 1.0, keyscan("a", 1, 1.0))])
    skipped = encode(Packet("a", 0, 4, 2.0, keyscan("a", 2, 2.0)))
    assert "before the motion to keyscan 1" in refusal_of(cloud, skipped)
    dangling = encode(Packet("a", 0, 5, 2.0, place("a", 1)))
    assert "names keyscan 1" in refusal_of(cloud, dangling)
    (robot,) = cloud.finalize().robots
    assert [k.id.number for k in robot.keyscans] == [0]


def test_every_packet_is_acknowledged_and_a_place_may_bring_a_correction(scripted):
    cloud = scripted(SCRIPT)
    corrected, versions = {}, []
    for packet in PACKETS:
        replies = [decode(data) for data in cloud.receive(encode(packet))]
        assert replies[0].body == Acknowledgement(packet.robot, 0, packet.sequence)
        assert [(reply.robot, reply.sequence) for reply in replies] == [(packet.robot, k) for k in range(len(replies))]
        for reply in replies[1:]:
            assert hasattr(packet.body, "descriptors")
            assert packet.robot not in corrected or is_news(corrected[packet.robot], reply.body)
            corrected[packet.robot] = reply.body
            versions.append(reply.body.version)
    assert versions == list(range(len(versions)))
    for session, correction in corrected.items():
        assert not is_news(correction, *cloud.fleet.corrections(session)) or session == "a"
    assert {robot: c.map_index for robot, c in corrected.items()} == {"a": 0, "b": 0}
    assert np.allclose(corrected["b"].T_map_odom, 0.0, atol=1e-6), "both started at the same pose"


def test_a_duplicate_is_acknowledged_again(scripted):
    cloud = feed(scripted(SCRIPT), PACKETS)
    (reply,) = cloud.receive(encode(PACKETS[0]))
    newest = max(packet.sequence for packet in PACKETS if packet.robot == PACKETS[0].robot)
    assert decode(reply).body == Acknowledgement(PACKETS[0].robot, 0, newest)


@pytest.mark.slow
@pytest.mark.parametrize("changed", [{"keypoints": 0.0}, {"keypoints": 300.0}])
def test_places_made_to_confuse_are_matched_without_harm(packets, changed):
    """Through the real matcher: all keypoints in one spot or far away, all descriptors equal."""

    def poisoned(packet):
        if not hasattr(packet.body, "descriptors") or packet.robot != "robot_2":
            return packet
        count = 200
        body = replace(
            packet.body,
            keypoints=frozen(np.full((count, 2), changed["keypoints"]), np.float32),
            descriptors=frozen(np.full((count, 32), 170), np.uint8),
        )
        return replace(packet, body=body)

    result = feed(Cloud(FleetConfig(), seed=0), map(poisoned, packets)).finalize()
    others = {robot.robot: robot.map_index for robot in result.robots}
    assert others["robot_1"] == others["robot_3"] == 0
    assert KeyscanId("robot_2", 0) in {robot.keyscans[0].id for robot in result.robots}


def test_detectors_of_two_channels_may_have_one_name():
    """Places of different channels are never compared, whatever their detectors are called."""
    cloud = Cloud(FleetConfig(), seed=0)
    rng = np.random.default_rng(0)
    for robot in ("x", "y"):
        bodies = [Hello(robot, 0, (LASER,), dict.fromkeys(Channel, "one"))]
        bodies += [keyscan(robot, 0, NOW)]
        for channel, axes in ((Channel.LIDAR, 2), (Channel.CAMERA, 3)):
            keypoints = rng.uniform(0.1, 2.0, (30, axes)).astype(np.float32)
            codes = np.random.default_rng(1).integers(0, 256, (30, 32), np.uint8)
            names = {"channel": channel, "detector_version": "one", "keypoints": keypoints, "descriptors": codes}
            bodies.append(place(robot, 0, **names))
        for sequence, body in enumerate(bodies):
            cloud.receive(encode(Packet(robot, 0, sequence, NOW, body)))
    assert len(cloud.finalize().robots) == 2


def test_a_further_laser_may_be_announced_later(scripted):
    """Keyscans of it are accepted from then on; those that were announced before stay."""
    rear = replace(LASER, T_base_laser=(-0.2, 0.0, 3.0))
    cloud = feed(scripted(SCRIPT), PACKETS[:HALF])
    varied = replace(keyscan("a", NUMBER, NOW, beams=9), laser=1, beams=Beams(9, -np.pi, 2.0 * np.pi / 9))
    versions = {Channel.LIDAR: "test-1"}
    sent = [
        (Hello("a", 0, (rear,), versions), "an announced laser"),
        (Hello("a", 0, (LASER, rear), versions), None),
        (Hello("a", 0, (LASER,), versions), "an announced laser"),
        (varied, None),
    ]
    for after, (body, reason) in enumerate(sent):
        refusal = refusal_of(cloud, encode(next_packet(body, after)))
        assert (refusal is None) if reason is None else (reason in refusal)

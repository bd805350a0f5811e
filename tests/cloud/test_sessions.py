"""A robot that starts again: a session of its own, on its earlier ones by closures alone; numbers that never come."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fcslam.cloud.sessions import robot_and_epoch, robot_of, session_name
from fcslam.errors import PacketError
from fcslam.geometry import se2
from fcslam.records import NAME, ConstraintKind, Correction, KeyscanId
from fcslam.wire.messages import Hello
from fcslam.wire.packets import decode, encode
from tests.scripted import closures, motion, rectangle, stream
from tests.small_fleet import feed, fingerprint, map_of

POSES = rectangle(29)
CLOSURE = ConstraintKind.CLOSURE
PAIRS = [(0, 0), (8, 8), (16, 16), (24, 24)]


def started_again(packets, epoch=1):
    """The same robot's packets in another epoch."""
    return [
        replace(
            packet,
            epoch=epoch,
            body=replace(packet.body, epoch=epoch) if isinstance(packet.body, Hello) else packet.body,
        )
        for packet in packets
    ]


def two_starts():
    return [*stream("a", POSES, start_s=0.0), *started_again(stream("a", POSES, start_s=500.0))]


def test_a_session_is_to_the_cloud_what_another_robot_would_be(scripted):
    """Renamed by hand, the second session gives the same result to the last bit."""
    script = closures(("a", POSES), ("a+1", POSES), PAIRS)
    result = feed(scripted(script), two_starts()).finalize()
    assert map_of(result) == {"a": 0, "a+1": 0}
    other = [*stream("a", POSES, start_s=0.0), *stream("b", POSES, start_s=500.0)]
    script = [replace(line, j=KeyscanId("b", line.j.number)) for line in script]
    twin = feed(scripted(script), other).finalize()
    for robot, same in zip(result.robots, twin.robots, strict=True):
        assert robot.T_map_base.tobytes() == same.T_map_base.tobytes()
    assert len(result.closures) == len(twin.closures)


def test_without_closures_sessions_stay_apart_and_a_third_is_told_from_the_second(scripted):
    packets = [*two_starts(), *started_again(stream("a", POSES, start_s=900.0), epoch=7)]
    assert map_of(feed(scripted(), packets).finalize()) == {"a": 0, "a+1": 1, "a+7": 2}


def test_corrections_are_addressed_to_the_robot_in_its_epoch(scripted):
    cloud = scripted(closures(("a", POSES), ("a+1", POSES), PAIRS))
    told = [decode(data) for packet in two_starts() for data in cloud.receive(encode(packet))]
    assert {packet.robot for packet in told} == {"a"}
    assert {packet.epoch for packet in told if isinstance(packet.body, Correction)} == {0, 1}


def test_what_was_refused_for_good_does_not_hold_up_what_comes_after(scripted):
    """A closure that fails leaves the session as it would be without that closure."""
    packets = stream("a", POSES, 0.0, [motion("a", 0, 20, se2.between(POSES[0], POSES[20]), CLOSURE)])
    reference = fingerprint(feed(scripted(), packets).finalize())
    wrong = replace(packets[-1], body=packets[1].body)
    last = replace(packets[-1], sequence=wrong.sequence + 1)
    cloud = feed(scripted(), packets[:-1])
    with pytest.raises(PacketError, match="keyscan 0 where"):
        cloud.receive(encode(wrong))
    cloud.receive(encode(last))
    cloud.receive(encode(wrong))  # once more, by a robot that did not hear of it
    assert fingerprint(cloud.finalize()) == reference


def test_a_refused_packet_lets_through_what_waited_for_it(scripted):
    packets = stream("a", POSES, 0.0)
    lost = next(n for n, packet in enumerate(packets) if hasattr(packet.body, "descriptors"))
    cloud = feed(scripted(), [*packets[:lost], *packets[lost + 1 :]])
    assert len(cloud.finalize().robots[0].keyscans) == 1
    with pytest.raises(PacketError, match="keyscan 0 where"):
        cloud.receive(encode(replace(packets[lost], body=packets[1].body)))
    assert len(cloud.finalize().robots[0].keyscans) == len(POSES)


def test_the_estimate_on_the_way_is_the_result_where_nothing_is_in_doubt(scripted):
    cloud = feed(scripted(closures(("a", POSES), ("a+1", POSES), PAIRS)), two_starts())
    estimate, result = cloud.fleet.estimate(), cloud.finalize()
    assert map_of(estimate) == map_of(result)
    for live, final in zip(estimate.robots, result.robots, strict=True):
        assert np.allclose(live.T_map_base, final.T_map_base, atol=1e-6)
        assert np.allclose(live.T_local_base, final.T_local_base, atol=1e-6)


@pytest.mark.slow
@given(st.from_regex(NAME, fullmatch=True).filter(lambda name: robot_of(name) == name), st.integers(0, 10**6))
def test_a_sessions_name_tells_robot_and_epoch(robot, epoch):
    assert robot_and_epoch(session_name(robot, epoch)) == (robot, epoch)

"""Places that are described again by another detector: what the cloud makes of them."""

from dataclasses import replace

import pytest

from fcslam.errors import PacketError
from fcslam.records import Channel, Place
from fcslam.wire.messages import Hello, Packet
from fcslam.wire.packets import encode
from tests.scripted import LASER, closures, rectangle, stream
from tests.small_fleet import feed, fingerprint, in_order

POSES = rectangle(17)
FIRST = in_order([*stream("a", POSES, start_s=0.0), *stream("b", POSES, start_s=0.5)])
SCRIPT = closures(("a", POSES), ("b", POSES), [(0, 0), (4, 4), (8, 8), (12, 12)])
ANEW = "test-2"


def again(robot):
    """A hello with another detector, and all places of a robot by it."""
    said = [packet for packet in FIRST if packet.robot == robot]
    bodies = [Hello(robot, 0, (LASER,), {Channel.LIDAR: ANEW})]
    bodies += [replace(p.body, detector_version=ANEW) for p in said if isinstance(p.body, Place)]
    return [Packet(robot, 0, len(said) + number, said[-1].time, body) for number, body in enumerate(bodies)]


def test_a_closure_that_is_confirmed_counts_once_however_often_its_places_are_described(scripted):
    once = feed(scripted(SCRIPT), FIRST).finalize()
    twice = feed(scripted(SCRIPT), in_order([*FIRST, *again("a"), *again("b")])).finalize()
    assert len(once.closures) == 4
    assert [(c.i, c.j, c.status) for c in twice.closures] == [(c.i, c.j, c.status) for c in once.closures]
    assert twice.graph.poses().tobytes() == once.graph.poses().tobytes()


def test_the_result_is_a_function_of_the_set_with_two_versions_too(scripted):
    packets = [*FIRST, *again("a"), *again("b")]
    expected = fingerprint(feed(scripted(SCRIPT), in_order(packets)).finalize())
    for arrived in (packets, [*FIRST, *again("b"), *again("a")], sorted(packets, key=lambda packet: packet.robot)):
        assert fingerprint(feed(scripted(SCRIPT), arrived).finalize()) == expected


def test_a_version_is_described_once_and_after_its_hello(scripted):
    cloud = feed(scripted(SCRIPT), FIRST)
    hello, place, *_ = again("a")
    early = replace(place, sequence=hello.sequence)
    with pytest.raises(PacketError, match=f"place of detector {ANEW}; test-1 was announced"):
        cloud.receive(encode(early))
    # The refused packet keeps its number.
    for packet in (hello, place):
        cloud.receive(encode(replace(packet, sequence=packet.sequence + 1)))
    with pytest.raises(PacketError, match="described before"):
        cloud.receive(encode(replace(place, sequence=place.sequence + 2)))

"""A recording of a network in memory is read as a bag; what is missing on a computer is said in one line."""

import sys
import threading

import numpy as np
import pytest

from fcslam.errors import InputError
from fcslam.ros.inbox import SILENCE_S, Inbox
from fcslam.ros.node import await_sensors
from fcslam.ros.record import record
from fcslam.ros.ros2 import INSTALL, Ros2Network
from fcslam.sources import BagOptions, open_source
from fcslam.sources.bags.codec import ODOMETRY, SCAN, TRANSFORMS
from tests.full_disk import largest_file
from tests.ros.memory_network import MemoryNetwork, offered
from tests.ros.ros_messages import encoded, odometry, scan, transform

RANGES = [5.0] * 180


TOPICS = [offered("/scan", SCAN), offered("/odom", ODOMETRY), offered("/tf_static", TRANSFORMS)]


def messages_of(scans, ranges, **laser):
    """A mounting, and then odometry and a scan each second."""
    yield "/tf_static", TRANSFORMS, transform(0.0, "base_link", "laser")
    for stamp in range(1, scans + 1):
        yield "/odom", ODOMETRY, odometry(stamp, (stamp, 0.0, 0.0))
        yield "/scan", SCAN, scan(stamp, ranges, **laser)


def recorded(output, messages, stop_after=None):
    """Record these messages; returns what is said, and the counts of each topic or the error.

    With ``stop_after`` messages, the recording is stopped, and they keep coming.
    """
    network = MemoryNetwork(TOPICS)
    topics = await_sensors(network, "", BagOptions(), 0.0, 0.0)
    stop, said = threading.Event(), []

    def write():
        try:
            said.append(record(network, topics, output, stop, said.append))
        except InputError as error:
            said.append(str(error))

    thread = threading.Thread(target=write, daemon=True)
    thread.start()
    while "/clock" not in network.subscribed:
        stop.wait(0.01)
    for number, (topic, kind, message) in enumerate(messages):
        network.say(topic, kind, message)
        if number == stop_after:
            stop.set()
        if not thread.is_alive():
            break
    stop.set()
    thread.join(120.0)
    return said


def test_a_recording_is_a_bag(tmp_path):
    output = tmp_path / "day.mcap"
    assert recorded(output, messages_of(8, RANGES)) == [{"/tf_static": 1, "/odom": 8, "/scan": 8}]
    survey = open_source(output).survey()
    assert (survey.scan_count, survey.path_length_m) == (8, 7.0)
    assert [path.name for path in tmp_path.iterdir()] == ["day.mcap"]


def test_a_full_disk_keeps_what_was_recorded_before(tmp_path):
    messages = list(messages_of(399, [5.0] * 3000, increment=0.001))
    part = tmp_path / "day.part.mcap"
    with largest_file(3_500_000):
        (error,) = recorded(tmp_path / "day.mcap", messages)
    assert f"what was recorded before is in {part}; free some space" in error
    assert list(tmp_path.iterdir()) == [part]
    assert 200 < open_source(part).survey().scan_count < 399


def test_messages_that_the_reader_cannot_take_are_counted():
    network, losses = MemoryNetwork(), []
    inbox = Inbox(2 * len(encoded(SCAN, scan(1.0, RANGES))), losses.append)
    inbox.subscribe(network, {"/scan": SCAN}, {}, iter(range(9)).__next__)
    for stamp in range(4):
        network.say("/scan", SCAN, scan(stamp, RANGES))
    assert (inbox.lost, len(losses)) == (2, 2)
    assert inbox.get(0.0).received_ns == 0
    network.say("/scan", SCAN, scan(4.0, RANGES))
    assert [inbox.get(0.0).received_ns for _ in range(2)] == [1, 2]
    assert (inbox.lost, inbox.get(0.0)) == (2, None)


@pytest.mark.attack
def test_a_second_publisher_is_named_once_and_counts_when_the_first_is_silent():
    network, lines, now = MemoryNetwork(), [], [0.0]
    inbox = Inbox(notify=lines.append, clock=lambda: now[0])
    inbox.subscribe(network, {"/scan": SCAN, "/tf": TRANSFORMS}, {}, lambda: 0)

    def taken(topic, kind, message, publisher):
        network.say(topic, kind, message, publisher)
        return inbox.get(0.0) is not None

    for now[0] in np.arange(0.0, 5.0, 0.1):
        assert taken("/scan", SCAN, scan(now[0], RANGES), "driver")
        assert not taken("/scan", SCAN, scan(now[0], RANGES), f"stranger {now[0]:.1f}")
        assert taken("/tf", TRANSFORMS, transform(now[0], "odom", "base_link"), f"node {now[0]:.1f}")
    (line,) = lines
    assert line.startswith("/scan has two publishers, driver and stranger 0.0; the messages of the second one are left")
    now[0] += SILENCE_S + 0.1
    assert taken("/scan", SCAN, scan(now[0], RANGES), "driver, started again")
    assert not taken("/scan", SCAN, scan(now[0], RANGES), "driver")


def test_a_missing_middleware_is_told_with_the_command_that_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "cyclonedds", None)
    with pytest.raises(InputError, match="install it: ") as caught:
        Ros2Network(0, {})
    assert str(caught.value).endswith(INSTALL)


def test_a_recording_ends_although_messages_keep_coming(tmp_path):
    (counts,) = recorded(tmp_path / "day.mcap", messages_of(100_000, RANGES), stop_after=50)
    assert 50 < sum(counts.values()) < 200_001

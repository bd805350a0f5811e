"""A robot between a network in memory and its map: what it publishes, and what it says."""

import threading

import numpy as np
import pytest

import fcslam
from fcslam.bridges.network import Endpoint, Quality
from fcslam.bridges.node import EMPTY, FINISH, RobotNode, await_sensors
from fcslam.bridges.parameters import NodeParameters
from fcslam.errors import NetworkError
from fcslam.sources import BagOptions
from fcslam.sources.bags.codec import ODOMETRY, SCAN, TRANSFORMS
from tests import small_fleet
from tests.bridges.memory_network import MemoryNetwork, offered
from tests.bridges.ros_messages import CODEC, odometry, scan, transform
from tests.live.same_thread import SameThread

TOPICS = (("/robot1/scan", SCAN, False), ("/robot1/odom", ODOMETRY), ("/tf_static", TRANSFORMS, True, True))


@pytest.fixture(scope="module")
def scans():
    return list(small_fleet.draw(1, path_length_m=4.0).robots[0].scans())


@pytest.fixture
def network():
    return MemoryNetwork([offered(*topic) for topic in TOPICS])


@pytest.fixture
def robot():
    with fcslam.Robot("robot1", executor=SameThread()) as robot:
        yield robot


def start(network, robot, notify=lambda _: None, **parameters):
    topics = await_sensors(network, "/robot1", BagOptions(), 0.0, 0.0)
    return RobotNode(network, "/robot1", topics, BagOptions(), robot, NodeParameters(**parameters), notify)


def plays(network, scans):
    laser = scans[0].laser
    network.say("/tf_static", TRANSFORMS, transform(0.0, "base_link", "laser", laser.T_base_laser))
    for record in scans:
        network.say("/robot1/odom", ODOMETRY, odometry(record.stamp, record.T_odom_base, "robot1/odom"))
        ranges = np.where(record.ranges_m >= laser.max_range_m, np.inf, record.ranges_m)
        network.say("/robot1/scan", SCAN, scan(
            record.stamp, ranges, "laser", laser.angle_min_rad, laser.angle_increment_rad, laser.max_range_m,
        ))  # fmt: skip


def run_until(node, count):
    node.run(lambda scans: node.stop() if scans == count else None)


def test_every_scan_gets_a_pose_and_the_map_is_published(network, robot, scans):
    node = start(network, robot)
    plays(network, scans)
    run_until(node, len(scans))
    node.publish_map()
    assert [pose.header.stamp.sec for pose in network.sent["/robot1/pose"]] == [int(s.stamp) for s in scans]
    (grid,) = network.sent["/robot1/map"]
    expected = robot.map()
    assert (grid.info.height, grid.info.width) == expected.cells.shape
    assert set(grid.data) == {-1, 0, 100}
    assert grid.header.frame_id == "map"
    (path,) = network.sent["/robot1/path"]
    assert path.poses[0].header.stamp.sec == int(scans[0].stamp)


def test_map_to_odom_carries_the_frame_of_the_odometry(network, robot, scans):
    node = start(network, robot)
    plays(network, scans)
    run_until(node, len(scans))
    sent = [message.transforms[0] for message in network.sent["/tf"]]
    assert {(t.header.frame_id, t.child_frame_id) for t in sent} <= {("map", "robot1/odom")}
    stamps = [t.header.stamp.sec * 10**9 + t.header.stamp.nanosec for t in sent]
    assert stamps == sorted(set(stamps))


def test_the_finish_topic_ends_the_drive(network, robot):
    node = start(network, robot)
    thread = threading.Thread(target=node.run)
    thread.start()
    network.say(f"/robot1/{FINISH}", EMPTY, CODEC.make(EMPTY, structure_needs_at_least_one_member=0))
    thread.join(10.0)
    assert not thread.is_alive()


def test_what_is_offered_reliably_is_asked_for_reliably(network, robot):
    start(network, robot)
    asked = network.subscribed
    assert not asked["/robot1/scan"].reliable
    assert asked["/robot1/odom"].reliable
    assert asked["/tf_static"].latched


def test_a_second_robot_of_one_name_is_refused(network, robot):
    network.others.append(offered("/robot1/map", "nav_msgs/OccupancyGrid"))
    with pytest.raises(NetworkError, match="another node publishes /robot1/map: a second robot of this name"):
        start(network, robot)


def test_a_simulated_clock_that_does_not_run_is_told(network, robot):
    node = start(network, robot, use_sim_time=True, topic_timeout=0.01)
    with pytest.raises(NetworkError, match="nobody publishes /clock; start the simulator"):
        node.run()


def test_peers_that_get_nothing_are_told_once(network, robot):
    said = []
    node = start(network, robot, said.append)
    network.others += [
        Endpoint("/robot1/pose", "geometry_msgs/PoseWithCovarianceStamped", False, Quality(True, True)),
        Endpoint("/robot1/map", "nav_msgs/GridCells", False, Quality(True)),
    ]
    for _ in range(2):
        node.watch_network()
    assert len(said) == 2
    assert "/robot1/pose: a subscription asks for transient local messages, and the publisher is volatile" in said[0]
    assert "/robot1/map: another node takes it as nav_msgs/GridCells" in said[1]


def test_missing_topics_end_the_wait():
    with pytest.raises(NetworkError, match="nobody publishes anything"):
        await_sensors(MemoryNetwork(), "/robot1", BagOptions(), 0.0, 0.0)

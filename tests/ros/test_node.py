"""A robot between a network in memory and its map: what it publishes, and what it says."""

import threading
import time
from contextlib import contextmanager
from itertools import pairwise

import numpy as np
import pytest

import fcslam
from fcslam.errors import InputError
from fcslam.geometry import se2, se3
from fcslam.geometry.groups import compose
from fcslam.live.records import Wiring
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap
from fcslam.ros.node import EMPTY, FINISH, FLOOR, INITIAL_POSE, STRING, RobotNode, await_sensors
from fcslam.ros.outputs import POSE
from fcslam.ros.parameters import NodeParameters
from fcslam.ros.sensors import ODOMETRY_PATIENCE_S, STEPS_BACK_FOR_RESTART
from fcslam.sources import BagOptions
from fcslam.sources.bags.codec import ODOMETRY, POINT_CLOUD, SCAN, TRANSFORMS
from fcslam.sources.bags.transforms import in_space
from fcslam.wire.fleet_replies import FrontierReply, MapFrontiers, QualityReply, TeammatePose
from tests import small_fleet
from tests.live.same_thread import SameThread
from tests.ros.memory_network import MemoryNetwork, offered
from tests.ros.ros_messages import CODEC, odometry, scan, transform
from tests.sources.clouds import VELODYNE, Measured, cloud
from tests.spinning_lidar import circle, room
from tests.spinning_lidar import drive as drive_lidar
from tests.waiting import wait_for

pytestmark = pytest.mark.slow

TOPICS = (("/robot1/scan", SCAN, False), ("/robot1/odom", ODOMETRY), ("/tf_static", TRANSFORMS, True, True))
LOST_AT_A_RESTART = STEPS_BACK_FOR_RESTART - 1


@pytest.fixture(scope="module")
def scans():
    return list(small_fleet.draw(1, path_length_m=4.0).robots[0].scans())


@pytest.fixture
def network():
    return MemoryNetwork([offered(*topic) for topic in TOPICS])


@pytest.fixture
def robot():
    with fcslam.Robot("robot1", wiring=Wiring(SameThread())) as robot:
        yield robot


def start(network, robot, notify=lambda _: None, suggest_pose=None, change_floor=None, **parameters):
    topics = await_sensors(network, "/robot1", BagOptions(), 0.0, 0.0)
    node = NodeParameters(**parameters)
    return RobotNode(network, "/robot1", topics, BagOptions(), robot, node, notify, suggest_pose, change_floor)


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
    node.run(lambda scans, _: node.stop() if scans == count else None)


def test_every_scan_gets_a_pose_and_the_map_is_published(network, robot, scans):
    node = start(network, robot)
    plays(network, scans)
    run_until(node, len(scans))
    node.publish_map()
    poses = network.sent["/robot1/pose"]
    assert [pose.header.stamp.sec for pose in poses] == [int(s.stamp) for s in scans]
    covariance = poses[-1].pose.covariance.reshape(6, 6)
    assert covariance[np.ix_((0, 1, 5), (0, 1, 5))] == pytest.approx(robot.pose.covariance)
    assert np.flatnonzero(np.diag(covariance)).tolist() == [0, 1, 5]
    assert poses[-1].pose.pose.orientation.z == pytest.approx(np.sin(robot.pose.theta / 2.0))
    (grid,) = network.sent["/robot1/map"]
    expected = robot.map()
    assert (grid.info.height, grid.info.width) == expected.cells.shape
    assert set(grid.data) == {-1, 0, 100}
    assert grid.header.frame_id == "map"
    (path,) = network.sent["/robot1/path"]
    assert path.poses[0].header.stamp.sec == int(scans[0].stamp)


def test_odometry_that_a_slow_robot_has_not_read_yet_is_not_late(network, robot, scans):
    """Each reading comes after the scan that follows it, as one of a scanner that spins; one scan takes long to map."""
    node, laser, found = start(network, robot), scans[0].laser, []
    network.say("/tf_static", TRANSFORMS, transform(0.0, "base_link", "laser", laser.T_base_laser))
    for before, record in pairwise(scans):
        seen = scan(record.stamp, record.ranges_m, "laser", *laser.beams[1:], laser.max_range_m)
        network.say("/robot1/scan", SCAN, seen)
        network.say("/robot1/odom", ODOMETRY, odometry(before.stamp, before.T_odom_base))

    def watch(count, pose):
        found.append(pose.T_odom_base)
        if count == len(scans) - 9:
            time.sleep(1.1 * ODOMETRY_PATIENCE_S)
        if count == len(scans) - 3:
            node.stop()

    node.run(watch)
    expected = [scan.T_odom_base for scan in scans[1:]]
    np.testing.assert_allclose(found, expected[: len(found)], atol=1e-6)


def test_map_to_odom_carries_the_frame_of_the_odometry(network, robot, scans):
    node = start(network, robot)
    plays(network, scans)
    run_until(node, len(scans))
    sent = [message.transforms[0] for message in network.sent["/tf"]]
    assert {(t.header.frame_id, t.child_frame_id) for t in sent} <= {("map", "robot1/odom")}
    stamps = [t.header.stamp.sec * 10**9 + t.header.stamp.nanosec for t in sent]
    assert stamps == sorted(set(stamps))


def test_a_robot_in_space_publishes_six_degrees_of_freedom_and_points_for_who_asks(tmp_path):
    kinds = {"/points": POINT_CLOUD, "/odom": ODOMETRY, "/tf_static": TRANSFORMS}
    network, options = MemoryNetwork([offered(topic, kind) for topic, kind in kinds.items()]), BagOptions(in_3d=True)
    topics = await_sensors(network, "", options, 0.0, 0.0)
    space = {"fleet": {"dimensions": 3}}
    _, *turns = drive_lidar(room(1), circle((6.0, 4.0), 1.6, 0.8), 80, azimuths=120)  # a stamp of 0 is none
    with fcslam.Robot("anna", lidar_3d=True, config=space, wiring=Wiring(SameThread())) as robot:
        node = RobotNode(network, "", topics, options, robot, NodeParameters(), lambda _: None)
        network.say("/tf_static", TRANSFORMS, transform(0.0, "base_link", "lidar", (0.1, 0.0, 0.0), height_m=0.6))
        for turn, _ in turns:
            points = Measured(turn.points_m - turn.origin_m.astype(np.float32), turn.times_s)
            network.say("/points", POINT_CLOUD, cloud(turn.stamp, points, VELODYNE))
            for stamp, *pose in turn.wheels:
                network.say("/odom", ODOMETRY, odometry(stamp, pose))
        run_until(node, len(turns) - 1)
        robot.finish()
        node.publish_map()
        assert network.sent["/cloud_map"] == [], "nobody has asked for points"
        network.others.append(offered("/cloud_map", POINT_CLOUD)._replace(publishes=False))
        node.publish_map()
        node.publish_map()
        run = robot.save(tmp_path / "run")
        newest = robot.pose
    found = np.array([pose_in(message.pose.pose) for message in network.sent["/pose"]])
    truth = np.array([pose for _, pose in turns[: len(found)]])
    off = se3.log(se3.between(se3.between(truth[0], truth), se3.between(found[0], found)))
    assert np.abs(off[:, :3]).max() < 0.05
    assert np.diag(network.sent["/pose"][-1].pose.covariance.reshape(6, 6)) == pytest.approx(
        np.diag(newest.covariance_6d)
    )
    assert np.abs(se3.between(newest.T_map_base_6d, compose(newest.T_map_odom_6d, newest.T_odom_base))[:6]).max() < 1e-9
    (points,) = network.sent["/cloud_map"]
    heights = points.data.view("<f4").reshape(-1, 3)[:, 2]
    assert np.ptp(heights) == pytest.approx(3.0, abs=0.2)
    assert {"map.ply", "map.pgm"} <= run.map_files.keys()
    assert set(network.sent["/map"][-1].data) == {-1, 0, 100}
    assert len(network.sent["/path"][-1].poses) > 10


def pose_in(pose):
    """A pose of ROS, shape (7,)."""
    at, turn = pose.position, pose.orientation
    return np.array((at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w))


def test_the_finish_topic_ends_the_drive(network, robot):
    node = start(network, robot)
    thread = threading.Thread(target=node.run)
    thread.start()
    network.say(f"/robot1/{FINISH}", EMPTY, CODEC.make(EMPTY, structure_needs_at_least_one_member=0))
    thread.join(120.0)
    assert not thread.is_alive()


def test_what_is_offered_reliably_is_asked_for_reliably(network, robot):
    start(network, robot)
    asked = network.subscribed
    assert not asked["/robot1/scan"].reliable
    assert asked["/robot1/odom"].reliable
    assert asked["/tf_static"].latched


def test_a_second_robot_of_one_name_is_refused(network, robot):
    network.others.append(offered("/robot1/map", "nav_msgs/OccupancyGrid"))
    with pytest.raises(InputError, match="another node publishes /robot1/map: a second robot of this name"):
        start(network, robot)


def test_a_simulated_clock_that_does_not_run_is_told_once_and_the_robot_maps(network, robot, scans):
    said = []
    node = start(network, robot, said.append, use_sim_time=True, topic_timeout=0.01)
    plays(network, scans)
    with running(node):
        wait_for(lambda: said and node.scans == len(scans))
        time.sleep(0.3)
    assert len(said) == 1
    assert "nobody publishes /clock, so map -> odom is published once for each scan; start the simulator" in said[0]


def test_a_robot_of_the_same_name_that_comes_later_is_told_once(network, robot):
    said = []
    node = start(network, robot, said.append)
    network.others.append(offered("/robot1/map", "nav_msgs/OccupancyGrid", latched=True))
    for _ in range(2):
        node.watch_network()
    assert said == ["another node publishes /robot1/map now, too; give each robot a name of its own"]


@contextmanager
def running(node):
    """The drive in a thread of its own."""
    thread = threading.Thread(target=node.run)
    thread.start()
    try:
        yield thread
    finally:
        node.stop()
        thread.join(120.0)
        assert not thread.is_alive()


@pytest.mark.parametrize(
    ("topic", "line"),
    [
        (INITIAL_POSE, "an initial pose is ignored: the robot maps, and its first scan is the origin of the map"),
        (FLOOR, "a floor is ignored: the robot localizes in one finished map"),
    ],
)
def test_what_a_robot_cannot_do_is_refused_with_the_reason(network, robot, topic, line):
    said = []
    start(network, robot, said.append)
    for _ in range(2):
        network.say(f"/robot1/{topic}", STRING, CODEC.make(STRING, data="2"))
    assert said == [line]


def test_a_floor_begins_a_session_on_it(network, robot, scans):
    said = []
    node = start(network, robot, said.append, None, robot.change_floor)
    for floor in ("2", "not a floor"):
        network.say("/robot1/fcslam/floor", STRING, CODEC.make(STRING, data=floor))
    assert said == ["a floor is refused: floor 'not a floor' is not 1 to 16 of A-Z a-z 0-9 . _ + -"]
    plays(network, scans)
    run_until(node, len(scans))
    robot.finish()
    assert robot.trajectory().floor == "2"


def given_pose(x, y, theta, frame="map"):
    pose = CODEC.pose(in_space(np.array((x, y, theta))))
    posed = CODEC.make("geometry_msgs/PoseWithCovariance", pose=pose, covariance=np.zeros(36))
    return CODEC.make(POSE, header=CODEC.header(0, frame), pose=posed)


@pytest.fixture(scope="module")
def own_map(scans):
    with fcslam.Robot("robot1", wiring=Wiring(SameThread())) as robot:
        for scan in scans:
            robot.add(scan)
        robot.finish()
        return robot.map()


def test_a_robot_in_a_finished_map_publishes_tf_only_while_it_is_localized(network, scans, own_map):
    said = []
    with fcslam.LocalizedRobot("robot1", own_map, wiring=Wiring(SameThread())) as robot:
        node = start(network, robot, said.append, suggest_pose=robot.suggest_pose)
        node.publish_map()
        (grid,) = network.sent["/robot1/map"]
        assert (grid.info.height, grid.info.width) == own_map.cells.shape
        plays(network, scans[:10])
        run_until(node, 10)
        assert not network.sent["/tf"]
        assert not network.sent["/robot1/pose"]
        node.diagnose()
        assert "not localized for" in network.sent["/diagnostics"][-1].status[0].message
        x, y, theta = se2.between(scans[0].T_odom_base, scans[9].T_odom_base)  # the map begins at the first scan
        network.say(f"/robot1/{INITIAL_POSE}", POSE, given_pose(x, y, theta))
        assert said[-1].endswith("it counts once the walls confirm it")
        node = start(network, robot, said.append, suggest_pose=robot.suggest_pose)
        plays(network, scans[10:20])
        run_until(node, 10)
        assert len(network.sent["/robot1/pose"]) >= 10
        node.diagnose()
        assert network.sent["/diagnostics"][-1].status[0].message.startswith("localized for")
        node.publish_map()
        assert len(network.sent["/robot1/map"]) <= 2, "once for each start"


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (given_pose(0.0, 0.0, 0.0, "odom"), "it is in frame 'odom'; give it in 'map'"),
        (given_pose(1e300, 0.0, 0.0), "is outside of the map"),
        (given_pose(np.nan, 0.0, 0.0), "the translation is not finite"),
    ],
)
def test_an_initial_pose_that_cannot_be_used_is_refused(network, own_map, message, reason):
    said = []
    with fcslam.LocalizedRobot("robot1", own_map, wiring=Wiring(SameThread())) as robot:
        start(network, robot, said.append, suggest_pose=robot.suggest_pose)
        network.say(f"/robot1/{INITIAL_POSE}", POSE, message)
        for text in ("", "again"):
            network.say(f"/robot1/{INITIAL_POSE}", STRING, CODEC.make(STRING, data=text))
    assert len(said) == 1, "one line, however many come"
    assert reason in said[0]


def test_silence_is_told_once_and_the_robot_goes_on(network, robot, scans):
    said = []
    node = start(network, robot, said.append)
    plays(network, scans[:10])
    later = threading.Timer(3.0, plays, (network, scans[10:20]))
    later.start()
    run_until(node, 20)
    later.join()
    assert len(said) == 2
    assert said[0].startswith("no scan for")
    assert said[1].startswith("scans arrive again after")
    assert robot.status().scans == 20


def test_a_bag_in_a_loop_is_told_once_and_mapped(network, robot, scans):
    said = []
    node = start(network, robot, said.append)
    for _ in range(4):
        plays(network, scans)
    run_until(node, 4 * len(scans) - 3 * LOST_AT_A_RESTART)
    node.publish_map()
    assert len(said) == 1
    assert "as when a bag is played again; the robot goes on from there" in said[0]
    assert network.sent["/robot1/map"]


def frontier(x, y, *robots):
    return FrontierReply(point=(x, y), length=1.0, gain=8.0, distances={}, robots=robots)


class FollowedFleet:
    """A fleet as the service tells of it, without the service."""

    def __init__(self):
        self.map_index = 0
        self.frontiers = (
            MapFrontiers(map=0, frontiers=(frontier(3.0, 4.0, "robot1"), frontier(5.0, 6.0))),
            MapFrontiers(map=1, frontiers=(frontier(7.0, 8.0),)),
        )
        self.quality = ()

    def robots(self):
        return [
            TeammatePose(robot="robot1", map=0, floor="", pose=(0.0, 0.0, 0.0), age_s=0.2, stamp=0.0),
            TeammatePose(robot="r-2", map=0, floor="", pose=(1.0, 2.0, 0.5), age_s=1.5, stamp=0.0),
            TeammatePose(robot="3", map=1, floor="up", pose=(0.0, 0.0, 0.0), age_s=0.0, stamp=0.0),
        ]


class FleetRobot:
    """A robot whose joint map is more than its own."""

    name = "robot1"

    def __init__(self, robot, joint):
        self._robot, self.joint, self.fleet = robot, joint, FollowedFleet()

    def joint_map(self):
        return self.joint

    def __getattr__(self, name):
        return getattr(self._robot, name)


def test_with_a_fleet_map_is_the_joint_map_and_own_map_what_the_robot_saw(network, robot, scans):
    cells = np.zeros((128, 192), np.uint8)
    cells[5:120, 7:150] = Occupancy.FREE
    followed = FleetRobot(robot, OccupancyMap(cells, 0.05, (-3.2, -6.4)))
    node = start(network, followed)
    plays(network, scans[:10])
    run_until(node, 10)
    node.publish_map()
    (grid,), (own,) = network.sent["/robot1/map"], network.sent["/robot1/own_map"]
    assert (grid.info.height, grid.info.width) == cells.shape
    assert (own.info.height, own.info.width) == robot.map().cells.shape
    changed = cells.copy()
    changed[20, 30] = Occupancy.OCCUPIED
    followed.joint = OccupancyMap(changed, 0.05, (-3.2, -6.4))
    node.publish_map()
    assert network.sent["/robot1/map"][-1].data.reshape(128, 192)[20, 30] == 100
    followed.joint = None  # the robot was taken out: its own map goes on
    node.publish_map()
    assert network.sent["/robot1/map"][-1].info.width == own.info.width


@pytest.fixture
def followed(network, robot):
    """A robot of a fleet whose node runs."""
    followed = FleetRobot(robot, None)
    with running(start(network, followed)):
        wait_for(lambda: len(network.sent["/robot1/fleet/poses"]) >= 3)
        yield followed


@pytest.mark.usefixtures("followed")
def test_poses_and_state_of_the_fleet_are_published(network):
    poses = network.sent["/robot1/fleet/poses"][0]
    assert poses.header.frame_id == "map"
    assert [(pose.position.x, pose.position.y) for pose in poses.poses] == [(0.0, 0.0), (1.0, 2.0)]
    mate = network.sent["/robot1/fleet/r_2/pose"][0]
    now, then = (one.header.stamp.sec + 1e-9 * one.header.stamp.nanosec for one in (poses, mate))
    assert now - then == pytest.approx(1.5, abs=1e-5)
    status = {one.name: one for one in network.sent["/robot1/fleet/status"][0].status}
    values = {pair.key: pair.value for pair in status["robot r-2"].values}
    assert (values["map"], values["age_s"], values["x"]) == ("0", "1.50", "1.0000")


def test_how_good_the_map_is_is_published_when_it_changes(network, followed):
    good = QualityReply(
        map=0, verdict="9 of 9 m2 are good", bar=0.05, within=10.0, error_95=0.021, good_share=1.0, drives=()
    )
    bad = good.model_copy(update={"error_95_m": None, "drives": ("drive from (0.0, 1.0) to (2.0, 1.0) again",)})
    assert not network.sent["/robot1/fleet/quality"]
    for count, quality in enumerate((bad, good), 1):
        followed.fleet.quality = (quality,)
        wait_for(lambda count=count: len(network.sent["/robot1/fleet/quality"]) == count)
    (first,), (second,) = (message.status for message in network.sent["/robot1/fleet/quality"])
    assert (first.name, first.message, second.message) == ("map 0", bad.verdict, good.verdict)
    assert [int.from_bytes(one.level, "little") if isinstance(one.level, bytes) else one.level
            for one in (first, second)] == [1, 0]  # fmt: skip
    values = {pair.key: pair.value for pair in first.values}
    assert values["drive_1"] == bad.drives[0]
    assert {pair.key: pair.value for pair in second.values}["error_95_m"] == "0.021"


def test_the_frontiers_of_the_own_map_and_the_own_goal_are_published_when_they_change(network, followed):
    followed.fleet.frontiers = (MapFrontiers(map=0, frontiers=followed.fleet.frontiers[0].frontiers[:1]),)
    wait_for(lambda: len(network.sent["/robot1/fleet/frontiers"]) == 2)
    free, taken = network.sent["/robot1/fleet/frontiers"][0].markers
    assert [(point.x, point.y) for point in free.points] == [(5.0, 6.0)]
    assert [(point.x, point.y) for point in taken.points] == [(3.0, 4.0)]
    assert free.scale.x == free.scale.z > 0.0
    (goal,) = network.sent["/robot1/fleet/goal"]
    assert goal.header.frame_id == "map"
    assert (goal.pose.position.x, goal.pose.position.y) == (3.0, 4.0)
    turn_rad = 2.0 * np.arctan2(goal.pose.orientation.z, goal.pose.orientation.w)
    assert turn_rad == pytest.approx(np.arctan2(4.0, 3.0))

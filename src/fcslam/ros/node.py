"""A live robot on a ROS network: reads its sensors, maps, and publishes map and pose.

The thread that calls ``run`` reads messages. A second thread publishes ``map -> odom`` at a fixed rate. A third one
publishes the map, the path and diagnostics. So none of them delays the pose of a scan.
"""

import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from fcslam.config import one_line
from fcslam.errors import FcslamError, InputError
from fcslam.records import CloudScan, FloatArray, LaserScan, SensorRecord
from fcslam.ros.clock import CLOCK, CLOCK_TOPIC, RosClock, TransformStream
from fcslam.ros.inbox import POLL_S, SILENCE_S, Inbox
from fcslam.ros.live_plan import Notify
from fcslam.ros.network import Endpoint, Quality, RosNetwork
from fcslam.ros.outputs import MAP, OWN_MAP, POINTS, POSE, Outputs, nanoseconds
from fcslam.ros.parameters import NodeParameters
from fcslam.ros.sensors import LiveSensors
from fcslam.ros.topics import SensorTopics, choose_sensor_topics, resolved
from fcslam.sources.bags.codec import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, LASER_SCANS, SCANS, MessageCodec
from fcslam.sources.bags.options import BagOptions
from fcslam.sources.bags.transforms import planar, transform_of

if TYPE_CHECKING:
    from fcslam.live.fleet_view import FleetView
    from fcslam.live.localized_robot import LocalizedRobot
    from fcslam.live.records import RobotPose
    from fcslam.live.robot import Robot

STRING, EMPTY = "std_msgs/String", "std_msgs/Empty"
FINISH, FLOOR, INITIAL_POSE = "fcslam/finish", "fcslam/floor", "initialpose"
_LINES_TOLD = 100
"""Largest number of different lines that are printed; the names in some come from the network."""
_FLEET_PERIOD_S = 0.2
"""Time between two messages with the poses of the fleet."""
_SETTLES_FOR_ODOMETRY = 4
_LARGEST_DOMAIN = 232
_DEPTHS = {**dict.fromkeys((*SCANS, COMPRESSED_IMAGE, IMAGE), 10), **dict.fromkeys(LASER_SCANS, 100), CAMERA_INFO: 1}


def open_network(kind: str, environment: Mapping[str, str] = os.environ) -> RosNetwork:
    """Join a network of ROS 2 over DDS (``ros2``) or over Zenoh (``zenoh``); its domain is ROS_DOMAIN_ID, or 0."""
    text = environment.get("ROS_DOMAIN_ID") or "0"
    if not text.isdecimal() or int(text) > _LARGEST_DOMAIN:
        raise InputError(f"{text!r} is not a ROS 2 domain; give a number from 0 to {_LARGEST_DOMAIN}")
    if kind == "zenoh":
        from fcslam.ros.ros2_zenoh import ZenohNetwork

        return ZenohNetwork(int(text), environment)
    from fcslam.ros.ros2 import Ros2Network

    return Ros2Network(int(text), environment)


def await_sensors(
    network: RosNetwork, namespace: str, options: BagOptions, timeout_s: float, settle_s: float = 1.0
) -> SensorTopics:
    """The topics of the robot's sensors, once they are there; ``settle_s`` later, so that all of them are.

    Odometry may also come from tf, which is there early on most robots. So its topic is given more time to appear.
    """
    end_s = time.monotonic() + timeout_s
    while True:
        try:
            if choose_sensor_topics(network.endpoints(), namespace, options).odometry is None:
                time.sleep(_SETTLES_FOR_ODOMETRY * settle_s)
            time.sleep(settle_s)
            return choose_sensor_topics(network.endpoints(), namespace, options)
        except InputError:
            if time.monotonic() > end_s:
                raise
            time.sleep(POLL_S)


class RobotNode:
    """One robot between a ROS network and its map."""

    def __init__(
        self,
        network: RosNetwork,
        namespace: str,
        topics: SensorTopics,
        options: BagOptions,
        robot: "Robot | LocalizedRobot",
        parameters: NodeParameters,
        notify: Notify,
        suggest_pose: Callable[[FloatArray], None] | None = None,
        change_floor: Callable[[str], None] | None = None,
    ) -> None:
        """Begin to receive and to publish.

        ``suggest_pose`` takes initial poses, if the robot is in a finished map; ``change_floor`` floors, if it maps.
        """
        self._network, self._namespace, self._topics = network, namespace, topics
        self._map_topic = resolved(namespace, MAP)
        self._robot, self._parameters, self._notify = robot, parameters, notify
        self._suggest_pose, self._change_floor = suggest_pose, change_floor
        self._codec = MessageCodec(ros1=False)
        self._inbox = Inbox(notify=self._tell_once)
        self._stop = threading.Event()
        self._told: set[str] = set()
        self.scans = 0
        self._points: FloatArray | None = None
        """Points of the 3D map that were published last."""
        self._pose: RobotPose | None = None
        self._state: tuple[bool, float] | None = None
        """Whether the robot knows its pose in the map, and since which stamp."""
        self._clock = RosClock(parameters.use_sim_time)
        if self._has_namesake(network.endpoints()):
            raise InputError(
                f"another node publishes {self._map_topic}: a second robot of this name, or a map_server; stop it, or "
                "give each robot a namespace of its own"
            )
        self._outputs = Outputs(network, namespace, parameters.map_frame, topics.transforms[0], topics.in_space)
        self._transforms = TransformStream(
            nanoseconds(parameters.transform_bound), nanoseconds(parameters.transform_timeout)
        )
        self.sensors = LiveSensors(topics, namespace, options, self._tell_once)
        self._restarts = 0
        self._subscribe()

    def run(self, watch: "Callable[[int, RobotPose | None], None]" = lambda _scans, _pose: None) -> None:
        """Map until ``stop``; after each record, ``watch`` gets the number of scans and the pose of the last one."""
        threads = [
            threading.Thread(target=self._publish_transforms, name="tf", daemon=True),
            threading.Thread(target=self._publish_maps, name="maps", daemon=True),
            threading.Thread(target=self._publish_fleet, name="fleet topics", daemon=True),
        ]
        for thread in threads:
            thread.start()
        began_s = heard_s = time.monotonic()
        is_silent = False
        try:
            while not self._stop.is_set():
                message = self._inbox.get(POLL_S)
                # What a slow robot has not read yet is not late.
                now_s = time.monotonic() if message is None else message.arrived_s
                before = self.scans
                records = (
                    self.sensors.wait(now_s)
                    if message is None
                    else self.sensors.add(message.topic, message.payload, now_s, message.received_ns)
                )
                for record in records:
                    self._map(record)
                    watch(self.scans, self._pose)
                if message is not None and message.topic in self._topics.scans:
                    if is_silent:
                        self._notify(f"scans arrive again after {now_s - heard_s:.0f} s")
                    heard_s, is_silent = now_s, False
                elif not is_silent and now_s > heard_s + SILENCE_S and before:
                    self._notify(f"no scan for {SILENCE_S:.0f} s; the robot waits for the network or the driver")
                    is_silent = True
                if not self._clock.is_running and now_s > began_s + self._parameters.topic_timeout:
                    self._tell_once(
                        "use_sim_time is set and nobody publishes /clock, so map -> odom is published once for each "
                        "scan; start the simulator, play the bag with --clock, or leave use_sim_time out"
                    )
        finally:
            self._stop.set()
            for thread in threads:
                thread.join()
        for record in self.sensors.finish():
            self._map(record)

    def stop(self) -> None:
        """End ``run`` soon. Any thread may call this."""
        self._stop.set()

    def publish_map(self) -> None:
        """Publish the map, the path and the closures as they are now; the robot's own map only if there is a scan."""
        is_finished_map = self._suggest_pose is not None
        if self._pose is None and not is_finished_map:
            return
        stamp_ns = self._clock.now_ns() if self._pose is None else nanoseconds(self._pose.stamp)
        self._publish_points(stamp_ns)
        own = self._robot.own_map()
        joint = None if self._robot.fleet is None or self._pose is None else self._robot.joint_map()
        is_new = self._outputs.map(stamp_ns, own if joint is None else joint)
        if self._robot.fleet is not None:
            is_new |= self._outputs.map(stamp_ns, own, OWN_MAP)
        if is_new or is_finished_map:
            trajectory = self._robot.trajectory()
            self._outputs.path(stamp_ns, trajectory.stamps, trajectory.poses)
            self._outputs.closures(stamp_ns, self._robot.closures())

    def _publish_points(self, stamp_ns: int) -> None:
        """Publish the points of a map in space if somebody asks for them: they are large."""
        topic = resolved(self._namespace, POINTS)
        if not any(each.topic == topic and not each.publishes and not each.own for each in self._network.endpoints()):
            return
        points = self._robot.points()
        if points is None or not len(points) or (self._points is not None and np.array_equal(points, self._points)):
            return
        self._points = points
        self._outputs.points(stamp_ns, points)

    def _publish_fleet(self) -> None:
        """Publish where the robots of the fleet are, at a fixed rate; frontiers, and how good the map is, once."""
        frontiers = None
        quality: tuple[object, ...] = ()
        while not self._stop.wait(_FLEET_PERIOD_S):
            fleet = self._robot.fleet
            if fleet is None:
                return
            now_ns = self._clock.now_ns()
            self._outputs.fleet(now_ns, fleet.robots(), fleet.map_index)
            if fleet.frontiers is not frontiers:
                frontiers = fleet.frontiers
                self._publish_frontiers(now_ns, fleet)
            if fleet.quality != quality:
                quality = fleet.quality
                self._outputs.quality(now_ns, self._robot.name, quality)

    def _publish_frontiers(self, now_ns: int, fleet: "FleetView") -> None:
        found = [one for its in fleet.frontiers if its.map_index == fleet.map_index for one in its.frontiers]
        free, taken = (
            np.array([one.point for one in found if bool(one.robots) is has_robot]).reshape(-1, 2)
            for has_robot in (False, True)
        )
        name = self._robot.name
        point = next((np.array(one.point) for one in found if name in one.robots), None)
        own = next((mate.T_map_base for mate in fleet.robots() if mate.robot == name), None)
        goal = None
        if point is not None and own is not None:  # the robot arrives as it looks when it drives straight there
            goal = np.array((*point, np.arctan2(*(point - own[:2])[::-1])))
        self._outputs.frontiers(now_ns, free, taken, goal)

    def _map(self, record: SensorRecord) -> None:
        pose = self._robot.add(record)
        if self.sensors.restarts != self._restarts:
            self._restarts = self.sensors.restarts
            self._transforms.restart()
        if not isinstance(record, LaserScan | CloudScan) or pose is None:
            return
        self.scans += 1
        self._pose = pose
        stamp_ns = nanoseconds(pose.stamp)
        if self._state is None or self._state[0] != pose.is_localized:
            self._state = pose.is_localized, pose.stamp
        if np.isnan(pose.T_map_base[0]):
            self._transforms.pause()
            return
        T_map_odom = pose.T_map_odom if pose.T_map_base_6d is None else pose.T_map_odom_6d
        moved = pose.pose if self.sensors.planner.is_without_odometry else T_map_odom
        if moved is not None:
            self._transforms.add(stamp_ns, self._clock.now_ns(), moved)
        self._outputs.pose(stamp_ns, pose.pose, pose.covariance_6d)

    def _publish_transforms(self) -> None:
        period_s, planner = self._parameters.transform_publish_period, self.sensors.planner
        due_s = time.monotonic()
        while not self._stop.wait(max(0.0, due_s - time.monotonic())):
            transform = self._transforms.due(self._clock.now_ns())
            if transform is not None:
                child = planner.base_frame if planner.is_without_odometry else planner.odom_frame
                self._outputs.transform(transform[0], child, transform[1])
            due_s = max(due_s + period_s, time.monotonic() - period_s)

    def _publish_maps(self) -> None:
        due_s = 0.0
        drawn = 0 if self._suggest_pose is None else -1  # a finished map is there before the first scan
        while not self._stop.wait(1.0):
            self.watch_network()
            self.diagnose()
            may_be_new = self.scans != drawn or self._robot.fleet is not None  # what the others see comes in between
            if time.monotonic() < due_s or not may_be_new:
                continue
            try:
                drawn, due_s = self.scans, time.monotonic() + self._parameters.map_update_interval
                self.publish_map()
            except Exception as error:  # this thread also tells the state of the robot, so it must not end
                self._tell_once(f"a map cannot be published: {error or type(error).__name__}")

    def diagnose(self) -> None:
        """Publish the state of the robot."""
        pose, state = self._pose, self._state
        well = "mapping"
        if pose is None or state is None:
            trouble = "no scan yet"
        elif self._suggest_pose is None:
            trouble = "" if pose.is_localized else "lost: the scans contradict the map"
        else:
            since = f"for {max(0.0, pose.stamp - state[1]):.0f} s"
            trouble, well = "" if state[0] else f"not localized {since}", f"localized {since}"
        values: dict[str, object] = {"scans": self.scans, "messages lost": self._inbox.lost}
        if pose is not None:
            values |= {"quality": f"{pose.quality:.3f}", "map": pose.map_index, "stamp": f"{pose.stamp:.3f}"}
        faults = self.sensors.audit.faults()
        values |= {"faults": str(faults)} if faults else {}
        self._outputs.diagnostics(self._clock.now_ns(), self._robot.name, trouble, values, well)

    def _subscribe(self) -> None:
        self._inbox.subscribe(self._network, self._topics.kinds, _DEPTHS, self._clock.now_ns)
        commands: list[tuple[str, str, Callable[[bytes], object], str]] = [
            (FINISH, EMPTY, lambda _: self.stop(), ""),
            (INITIAL_POSE, POSE, self._take_pose, "an initial pose is refused"),
            (FLOOR, STRING, self._take_floor, "a floor is refused"),
        ]
        for name, kind, command, refusal in commands:
            take = partial(self._take, command, refusal)
            self._network.subscribe(resolved(self._namespace, name), kind, Quality(reliable=True), take)
        if self._clock.simulated:
            self._network.subscribe(
                CLOCK_TOPIC, CLOCK, Quality(reliable=False), lambda payload, _: self._clock.tick(payload, self._codec)
            )

    def _take(self, command: Callable[[bytes], object], refusal: str, payload: bytes, _publisher: str) -> None:
        """Do what a message asks for. Anybody on the network may send many, so each topic has one line of refusal."""
        try:
            command(payload)
        except (ValueError, FcslamError) as error:
            self._tell_once(f"{refusal}: {one_line(str(error))}", refusal)

    def _take_pose(self, payload: bytes) -> None:
        """Try a pose that somebody gives, as by RViz's "2D Pose Estimate"."""
        if self._suggest_pose is None:
            self._tell_once("an initial pose is ignored: the robot maps, and its first scan is the origin of the map")
            return
        message = self._codec.decode(payload, POSE)
        frame = message.header.frame_id.lstrip("/")
        if frame != self._parameters.map_frame:
            raise ValueError(f"it is in frame {one_line(repr(frame))}; give it in {self._parameters.map_frame!r}")
        at, turn = message.pose.pose.position, message.pose.pose.orientation
        x, y, theta = planar(transform_of((at.x, at.y, at.z), (turn.x, turn.y, turn.z, turn.w)))
        self._suggest_pose(np.array((x, y, theta)))
        line = f"initial pose ({x:.2f} m, {y:.2f} m, {theta:.2f} rad): it counts once the walls confirm it"
        self._tell_once(line, "initial pose")

    def _take_floor(self, payload: bytes) -> None:
        """Begin a session on another floor, as a lift's controller says."""
        if self._change_floor is None:
            self._tell_once("a floor is ignored: the robot localizes in one finished map")
            return
        self._change_floor(self._codec.decode(payload, STRING).data)

    def _has_namesake(self, endpoints: Sequence[Endpoint]) -> bool:
        return any(point.publishes and not point.own and point.topic == self._map_topic for point in endpoints)

    def watch_network(self) -> None:
        """Tell once whether another robot has this name."""
        if self._has_namesake(self._network.endpoints()):
            self._tell_once(f"another node publishes {self._map_topic} now, too; give each robot a name of its own")

    def _tell_once(self, line: str, about: str = "") -> None:
        """Tell the first line about something; by default about what it says itself."""
        about = about or line
        if line and about not in self._told and len(self._told) < _LINES_TOLD:
            self._told.add(about)
            self._notify(line)

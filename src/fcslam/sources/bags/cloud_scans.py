"""Scans from the point clouds and depth images of a bag: where their sensors sit is found once."""

from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from math import acos, degrees
from typing import TypeVar

from fcslam.errors import SourceError
from fcslam.sources.bags.camera import Calibration, calibration_of
from fcslam.sources.bags.census import BagMessage
from fcslam.sources.bags.clouds import (
    cloud_mounting,
    cloud_of,
    given_cloud_mounting,
    lacks_optical_frame,
    longest_cloud_s,
    notes_on_times,
    optical_note,
)
from fcslam.sources.bags.codec import IMAGE, LASER_SCANS, NANOSECONDS
from fcslam.sources.bags.container import Topic
from fcslam.sources.bags.messages import ScanMessage
from fcslam.sources.bags.options import BagOptions
from fcslam.sources.bags.robots import BagRobot
from fcslam.sources.bags.topics import calibration_beside
from fcslam.sources.bags.transforms import NoTransformError, TransformTree, is_fixed
from fcslam.sources.gate import FIRST_MESSAGES
from fcslam.sources.point_clouds import CloudMounting, PointCloud, directions_in, leaning, scan_of_cloud, unit_problem

_CLOUDS_TRIED = 10 * FIRST_MESSAGES
"""First clouds over which those are spread that show the floor and the directions of the sensor."""

Found = TypeVar("Found")


def valid(messages: Iterable[BagMessage], convert: Callable[[BagMessage], Found]) -> Iterator[Found]:
    """The messages that can be converted."""
    for message in messages:
        try:
            found = convert(message)
        except ValueError:
            continue
        yield found


def calibration_in(robot: BagRobot, topic: Topic | None) -> Calibration | None:
    """The first valid calibration of a camera; None without one."""
    messages = robot.bag.read([topic] if topic else [])
    return next(valid(messages, lambda message: calibration_of(message.content)), None)


class BagScans:
    """Turns the messages of a robot's lasers and clouds into scans."""

    def __init__(
        self,
        robot: BagRobot,
        scans: tuple[Topic, ...],
        options: BagOptions,
        tree: TransformTree,
        base_frame_of: Callable[[str], str],
    ) -> None:
        """``base_frame_of`` gives the frame of the robot's base for the frame of a sensor."""
        self.notes: list[str] = []
        """What is wrong with the mountings."""
        self._robot, self._scans, self._options, self._tree = robot, scans, options, tree
        self._base_frame_of = base_frame_of
        self._calibrations: dict[Topic, Calibration | None] = {}
        self._mountings: dict[tuple[Topic, str], CloudMounting] = {}

    def of(self, topic: Topic) -> Iterator[ScanMessage]:
        """The valid scans of a topic."""
        return valid(self._robot.bag.read([topic]), self.scan)

    def scan(self, message: BagMessage) -> ScanMessage:
        """The scan of a message; raises ValueError if it is invalid."""
        topic, content = message.topic, message.content
        if topic.type in LASER_SCANS:
            scan: ScanMessage = content
            return scan
        cloud = self.cloud(message)
        return scan_of_cloud(cloud, self.mounting(topic, cloud.frame), self._options.cloud_band)

    def mounting(self, topic: Topic, frame: str) -> CloudMounting:
        """Where the sensor with this frame sits, corrected by the floor that it sees."""
        if (topic, frame) not in self._mountings:
            clouds = list(self._some_clouds(topic, frame))
            if problem := unit_problem(clouds):
                raise SourceError(f"{self._robot.bag.path}: {topic.name}: {problem}")
            mounting = self._levelled(topic, clouds, self._mounting(topic, frame))
            self._mountings[topic, frame] = mounting._replace(directions=directions_in(clouds, mounting))
            self.notes += [f"{self._robot.bag.path}: {note}" for note in notes_on_times(topic.name, topic.type, clouds)]
        return self._mountings[topic, frame]

    def cloud(self, message: BagMessage) -> PointCloud:
        """The points of a message; raises ValueError if it is invalid."""
        topic = message.topic
        if topic not in self._calibrations:
            info = calibration_beside(topic, self._robot.topics) if topic.type == IMAGE else None
            self._calibrations[topic] = calibration_in(self._robot, info)
        its = self._robot.bag.census[topic]
        first_ns, last_ns = its.span_ns
        interval_s = len(its.frames) * (last_ns - first_ns) / (max(1, its.count - 1) * NANOSECONDS)
        longest_s = longest_cloud_s(interval_s)
        return cloud_of(message.content, topic.type, message.unstamped_ns, self._calibrations[topic], longest_s)

    def _mounting(self, topic: Topic, frame: str) -> CloudMounting:
        path = self._robot.bag.path
        if self._options.laser_poses:
            return given_cloud_mounting(self._options.laser_poses[self._scans.index(topic)], topic.type, frame)
        try:
            T_base_sensor = self._tree.fixed(self._base_frame_of(frame), frame)
        except NoTransformError as error:
            if is_fixed(frame):
                raise SourceError(
                    f"{path}: the points of {topic.name} are in '{frame}', in which the robot drives, so another "
                    "node has moved them; record the clouds of the sensor's driver, or choose them by --sensors "
                    "scan-topic"
                ) from error
            raise SourceError(
                f"{path}: tf has {error}, so the pose of the sensor of {topic.name} is unknown; give it "
                "with --sensors laser-pose=X,Y,THETA (metres, radians)"
            ) from error
        if lacks_optical_frame(T_base_sensor, topic.type, frame):
            self.notes.append(f"{path}: {optical_note(topic.name, frame)}")
        return cloud_mounting(T_base_sensor, topic.type, frame)

    def _levelled(self, topic: Topic, clouds: list[PointCloud], mounting: CloudMounting) -> CloudMounting:
        found = leaning(clouds, mounting)
        if found is None:
            return mounting
        self.notes.append(
            f"{self._robot.bag.path}: the floor in {topic.name} leans by {degrees(acos(found[2, 2])):.0f} deg against "
            f"the mounting of '{clouds[0].frame}'; corrected: correct it in tf"
        )
        return mounting._replace(rotation=found @ mounting.rotation)

    def _some_clouds(self, topic: Topic, frame: str) -> Iterator[PointCloud]:
        step = max(1, min(topic.message_count, _CLOUDS_TRIED) // FIRST_MESSAGES)
        clouds = valid(islice(self._robot.bag.read([topic]), 0, _CLOUDS_TRIED, step), self.cloud)
        return (cloud for cloud in clouds if cloud.frame == frame)

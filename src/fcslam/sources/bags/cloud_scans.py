"""Scans from the point clouds and depth images of a robot: where their sensors sit is found once."""

from collections.abc import Callable
from itertools import islice
from math import acos, degrees

import numpy as np

from fcslam.errors import SourceError
from fcslam.sources.bags.camera import Calibration, calibration_of
from fcslam.sources.bags.census import BagMessage, valid
from fcslam.sources.bags.clouds import (
    cloud_mounting,
    cloud_of,
    given_cloud_mounting,
    longest_cloud_s,
    notes_on_times,
)
from fcslam.sources.bags.codec import CLOUDS, IMAGE, LASER_SCANS
from fcslam.sources.bags.container import Topic
from fcslam.sources.bags.messages import ScanMessage, header_of
from fcslam.sources.bags.options import BagOptions
from fcslam.sources.bags.robots import BagRobot
from fcslam.sources.bags.topics import calibration_beside
from fcslam.sources.bags.transforms import NoTransformError, TransformTree, is_corrected, is_odom
from fcslam.sources.clouds_in_space import CloudReader, reader_of
from fcslam.sources.gate import FIRST_MESSAGES
from fcslam.sources.point_clouds import (
    CloudMounting,
    PointCloud,
    bends_in,
    directions_in,
    leaning,
    scan_of_cloud,
    slopes_of,
    unit_problem,
)

_CLOUDS_TRIED = 10 * FIRST_MESSAGES
"""First clouds over which those are spread that show the floor and the directions of the sensor."""


class CloudScans:
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
        self._known: dict[Topic, tuple[Calibration | None, float]] = {}
        """The camera of depth images, and the longest time that a cloud takes."""
        self._mountings: dict[tuple[Topic, str], CloudMounting] = {}

    def is_whole(self, topic: Topic) -> bool:
        """Whether the clouds of a topic are read whole, in 3D."""
        return self._options.in_3d and topic.type in CLOUDS

    def scan(self, message: BagMessage) -> ScanMessage:
        """The scan of a message; raises ValueError if it is invalid."""
        topic, content = message.topic, message.content
        if topic.type in LASER_SCANS:
            scan: ScanMessage = content
            return scan
        cloud = self.cloud(message)
        return scan_of_cloud(cloud, self._mounting(topic, cloud.frame), self._options.cloud_band)

    def cloud(self, message: BagMessage) -> PointCloud:
        """The points of a message; raises ValueError if it is invalid."""
        topic = message.topic
        if topic not in self._known:
            info = calibration_beside(topic, self._robot.topics) if topic.type == IMAGE else None
            headers = valid(
                islice(self._robot.bag.read([topic]), FIRST_MESSAGES),
                lambda each: header_of(each.content.header, each.unstamped_ns),
            )
            self._known[topic] = calibration_in(self._robot, info), longest_cloud_s(headers)
        return cloud_of(message.content, topic.type, message.unstamped_ns, *self._known[topic])

    def whole_reader(self, topic: Topic) -> tuple[CloudReader, tuple[str, ...]]:
        """How the clouds of a topic are read in 3D, and notes about it."""
        where = f"{self._robot.bag.label}{topic.name}"
        first = list(islice(valid(self._robot.bag.read([topic]), self.cloud), FIRST_MESSAGES))
        if not first:
            raise SourceError(f"{where}: no cloud can be read; correct the driver, or copy the bag again")
        return reader_of(first, self._mounting(topic, first[0].frame), self._options.cloud_band, where)

    def bends(self, topic: Topic) -> list[float]:
        """Stamps of the clouds of a topic at which the robot drives over a bend of the floor."""
        stamps, slopes = [], []
        for cloud in valid(self._robot.bag.read([topic]), self.cloud):
            mounting = self._mounting(topic, cloud.frame)
            stamps.append(cloud.stamp)
            slopes.append(slopes_of(mounting.in_base(cloud), mounting))
        return [stamps[k] for k in bends_in(np.array(slopes))]

    def _mounting(self, topic: Topic, frame: str) -> CloudMounting:
        """Where the sensor with this frame sits, corrected by the floor that it sees."""
        if (topic, frame) not in self._mountings:
            label = self._robot.bag.label
            step = max(1, min(topic.message_count, _CLOUDS_TRIED) // FIRST_MESSAGES)
            tried = islice(self._robot.bag.read([topic]), 0, _CLOUDS_TRIED, step)
            clouds = [cloud for cloud in valid(tried, self.cloud) if cloud.frame == frame]
            if problem := unit_problem(clouds):
                raise SourceError(f"{label}{topic.name}: {problem}")
            mounting, notes = self._stated_mounting(topic, frame)
            if (level := leaning(clouds, mounting)) is not None:
                mounting = mounting._replace(rotation=level @ mounting.rotation)
                notes.append(
                    f"the floor in {topic.name} leans by {degrees(acos(level[2, 2])):.0f} deg against the mounting of "
                    f"'{frame}'; corrected: correct it in tf"
                )
            notes += notes_on_times(topic.name, topic.type, clouds, self.is_whole(topic))
            self.notes += [f"{label}{note}" for note in notes]
            self._mountings[topic, frame] = mounting._replace(directions=directions_in(clouds, mounting))
        return self._mountings[topic, frame]

    def _stated_mounting(self, topic: Topic, frame: str) -> tuple[CloudMounting, list[str]]:
        given = dict(zip(self._scans, self._options.laser_poses, strict=False))
        if topic in given:
            return given_cloud_mounting(given[topic], topic.type, frame), []
        try:
            T_base_sensor = self._tree.fixed(self._base_frame_of(frame), frame)
        except NoTransformError as error:
            if is_odom(frame) or is_corrected(frame):
                raise SourceError(
                    f"{self._robot.bag.label}the points of {topic.name} are in '{frame}', in which the robot drives, "
                    "so another node has moved them; record the clouds of the sensor's driver, or choose them by "
                    "--sensors scan-topic"
                ) from error
            raise NoTransformError(f"{error}, so the pose of the sensor of {topic.name} is unknown") from error
        mounting, note = cloud_mounting(T_base_sensor, topic.type, frame)
        return mounting, [f"by tf, the camera of {topic.name} {note}"] if note else []


def calibration_in(robot: BagRobot, topic: Topic | None) -> Calibration | None:
    """The first valid calibration of a camera; None without one."""
    messages = robot.bag.read([topic] if topic else [])
    return next(valid(messages, lambda message: calibration_of(message.content)), None)

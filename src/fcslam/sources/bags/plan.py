"""Decides once, before a bag is read, which of its topics and frames are read, and how."""

from collections.abc import Iterator, Sequence
from itertools import chain, islice, pairwise
from math import dist, tau
from typing import NamedTuple

from fcslam.config import one_line
from fcslam.errors import SourceError
from fcslam.records import Sweep
from fcslam.sources.bags.camera import Calibration, image_of
from fcslam.sources.bags.census import BagMessage
from fcslam.sources.bags.clocks import ahead_note, clock_ahead_s
from fcslam.sources.bags.cloud_scans import BagScans, calibration_in, valid
from fcslam.sources.bags.codec import FIX, IMU, LASER_SCANS, NANOSECONDS, ODOMETRY
from fcslam.sources.bags.container import Topic
from fcslam.sources.bags.messages import OdometryReading, odometry_in
from fcslam.sources.bags.options import NO_ODOMETRY, BagCorrection, BagOptions
from fcslam.sources.bags.pairing import Message
from fcslam.sources.bags.rig import RecordedLaser, recorded_laser
from fcslam.sources.bags.robots import BagRobot, listed, usual
from fcslam.sources.bags.topics import KnownTopics, Topics, choose_topics
from fcslam.sources.bags.transforms import Link, TransformTree, is_corrected
from fcslam.sources.contradictions import CHANGED, changed_share
from fcslam.sources.gate import FIRST_MESSAGES
from fcslam.sources.motion import LARGEST_SPEED
from fcslam.sources.path_summary import fault_of_odometry, without_odometry
from fcslam.sources.returns import is_apart

_STRIDE = 5
"""Of the scans that show whether a robot moves, every such one is compared."""


class OdometryInput(NamedTuple):
    """Where the odometry of a bag comes from."""

    topics: tuple[Topic, ...]
    edge: Link | None
    """Parent and child frame in tf; None: the topic holds messages of odometry."""
    base_frame: str | None = None
    """Frame of the base, on a topic with several; None: any."""

    @property
    def name(self) -> str:
        """The name of the topic, or the frames in tf."""
        return self.topics[0].name if self.edge is None else f"tf from {self.edge[0]} to {self.edge[1]}"

    def readings(self, message: BagMessage) -> list[OdometryReading]:
        """The readings in a message of its topics; raises ValueError if it is invalid."""
        content = message.content
        if self.edge is None:
            return [content] if self.base_frame in (None, content.base_frame) else []
        return [odometry_in(each) for each in content if (each.parent, each.child) == self.edge]


class BagPlan(NamedTuple):
    """What is read from a bag for one robot, and how."""

    topics: Topics
    tree: TransformTree
    scans: BagScans
    lasers: tuple[RecordedLaser, ...]
    odometry: OdometryInput | None
    """The chosen topic, else tf; one that says nothing is none."""
    odometry_ahead_s: float
    """The clock of the odometry against that of the scans."""
    fixes_ahead_s: float
    """The same of the fixes."""
    imu_ahead_s: float
    """The same of the IMU of a robot without odometry."""
    calibration: Calibration | None
    """Of the camera; None without a camera or a readable calibration."""
    odometry_notes: tuple[str, ...]

    @property
    def stated_sweep(self) -> Sweep | None:
        """Times of the beams by a message of the first laser; None if it states none."""
        first = self.lasers[0].first
        return first.sweep if first.ranges_at_stamp is None else None

    def read_topics(self, with_images: bool) -> list[Topic]:
        """The topics of a pass over the bag."""
        camera = (self.topics.camera,) if with_images and self.topics.camera is not None else ()
        odometry = () if self.odometry is None else self.odometry.topics
        return list(dict.fromkeys((*odometry, *self.topics.scans, *camera)))

    def items(self, message: BagMessage, correction: BagCorrection) -> list[Message]:
        """The scans, readings and images in a message; raises ValueError if it is invalid."""
        if message.topic in self.topics.scans:
            scan = self.scans.scan(message)
            if correction.sweep is not None and scan.ranges_at_stamp is None:
                first_s, last_s = correction.sweep
                scan = scan._replace(sweep=Sweep(first_s, last_s) if first_s != last_s else None)
            return [
                scan._replace(laser=number)
                for number, laser in enumerate(self.lasers)
                if laser.topic == message.topic and laser.frame in (None, scan.frame)
            ]
        if message.topic == self.topics.camera:
            return [image_of(message.content, message.topic.type, message.unstamped_ns)]
        late_s = self.odometry_ahead_s + correction.odometry_delay_s
        readings = self.odometry.readings(message) if self.odometry else []
        return [reading._replace(stamp=reading.stamp - late_s) for reading in readings]


def plan_of(robot: BagRobot, options: BagOptions) -> BagPlan:
    """Plan how a robot of a bag is read."""
    return _Planner(robot, options).plan()


class _Planner:
    def __init__(self, robot: BagRobot, options: BagOptions) -> None:
        self._robot, self._options, self._bag, self._path = robot, options, robot.bag, robot.bag.path
        known = KnownTopics(robot.topics, robot.transforms, f"{robot.bag.path}: ")
        self._topics = choose_topics(
            known, options, self._view_rad, lambda topic: self._jumps(topic) or self._leaps(topic)
        )
        self._tree = robot.bag.tree(robot.transforms)
        self._scans = BagScans(robot, self._topics.scans, options, self._tree, self._base_frame_of)
        self._notes: list[str] = []

    def plan(self) -> BagPlan:
        """Decide everything."""
        topics = self._topics
        lasers = tuple(
            self._laser(topic, frame)
            for topic in topics.scans
            for frame in self._robot.scan_frames.get(topic.name, (None,))
        )
        odometry = self._odometry(lasers[0].first.frame)
        ahead_s = fixes_ahead_s = imu_ahead_s = 0.0
        if odometry is not None:
            ahead_s = self._ahead_s(lasers[0], odometry.name, self._lags_s(odometry))
        for fixes in self._robot.of_type(FIX)[:1]:
            fixes_ahead_s = self._ahead_s(lasers[0], fixes.name, self._bag.census[fixes].clock.lags_s)
        for imu in self._robot.of_type(IMU)[:1] if odometry is None else ():
            imu_ahead_s = self._ahead_s(lasers[0], imu.name, self._bag.census[imu].clock.lags_s)
        calibration = calibration_in(self._robot, topics.camera_info)
        notes = tuple(self._notes)
        clocks_s = ahead_s, fixes_ahead_s, imu_ahead_s
        return BagPlan(topics, self._tree, self._scans, lasers, odometry, *clocks_s, calibration, notes)

    def _laser(self, topic: Topic, frame: str | None) -> RecordedLaser:
        own = (scan for scan in self._scans.of(topic) if frame in (None, scan.frame))
        first = list(islice(own, FIRST_MESSAGES))
        if not first:
            raise SourceError(
                f"{self._path}: none of the {topic.message_count} scans in {topic.name} can be read"
                f"{self._first_error(topic)}; correct the laser's driver, or copy the bag again"
            )
        return recorded_laser(topic, first, frame)

    def _first_error(self, topic: Topic) -> str:
        for message in islice(self._bag.read([topic]), 1):
            try:
                self._scans.scan(message)
            except ValueError as error:
                return f" ({error})"
        return ""

    def _odometry(self, frame: str) -> OdometryInput | None:
        if self._options.odom_topic == NO_ODOMETRY:
            return None
        for candidate in self._odometry_candidates(frame):
            its = self._bag.census[candidate.topics[0]]
            error = its.error if candidate.edge is None and its.broken == its.count else ""
            readings = chain.from_iterable(valid(self._bag.read(candidate.topics), candidate.readings))
            fault = f"cannot be read ({error})" if error else fault_of_odometry(each.T_odom_base for each in readings)
            if fault is None or not (error or self._scans_change()):
                return candidate
            self._notes.append(f"{self._path}: {candidate.name} {fault}, so it is not used")
        its = self._bag.census[self._topics.scans[0]]
        interval_s = (its.span_ns[1] - its.span_ns[0]) / (max(1, its.count - 1) * NANOSECONDS)
        self._notes.append(f"{self._path}: {without_odometry(interval_s)}")
        return None

    def _odometry_candidates(self, frame: str) -> Iterator[OdometryInput]:
        options = self._options
        link = self._tree.odometry_link(frame, options.odom_frame, options.base_frame)
        measured = self._measured
        if options.odom_topic is None and options.odom_frame is not None:
            measured = []
        of_topics = [OdometryInput((topic,), None, self._base_frame(topic)) for topic in measured]
        if link is None or (measured and options.odom_topic is not None):
            yield from of_topics
        if measured and options.odom_topic is not None:
            return
        if link is not None:
            named = tuple(topic for topic in self._topics.odometry if topic.type != ODOMETRY)
            of_tf = OdometryInput(named or self._topics.transforms, link)
            yield from [of_tf, *of_topics] if any(map(self._jumps, measured)) else [*of_topics, of_tf]
        elif options.odom_frame or (options.base_frame and not measured):
            known = ", ".join(f"{one_line(parent)} -> {one_line(child)}" for parent, child in self._tree.links)
            raise SourceError(
                f"{self._path}: tf has no transform from {options.odom_frame or 'a frame'} to "
                f"{options.base_frame or 'a frame above the laser'}; give --sensors odom-frame and base-frame; "
                f"tf has {known or 'no transforms'}"
            )

    @property
    def _measured(self) -> list[Topic]:
        return [topic for topic in self._topics.odometry if topic.type == ODOMETRY]

    def _base_frame(self, topic: Topic) -> str | None:
        frames = [frame for frame in usual(self._bag.census[topic].frames) if frame]
        chosen = self._options.base_frame or self._robot.base_frames.get(topic.name)
        if len(frames) < 2:
            return None
        if chosen in frames:
            return chosen
        raise SourceError(
            f"{self._path}: {topic.name} has odometry of the frames {listed(frames)}, and tf does not say which one "
            "the laser is on; choose one by --sensors base-frame"
        )

    def _base_frame_of(self, frame: str) -> str:
        bases = [self._options.base_frame]
        for topic in self._measured:
            bases += [self._base_frame(topic), *self._bag.census[topic].frames]
        link = self._tree.odometry_link(frame, self._options.odom_frame)
        return next(filter(None, (*bases, *(link or ())[1:])), self._tree.usual_base)

    def _scans_change(self) -> bool:
        found = self._scans.of(self._topics.scans[0])
        first = next(found, None)
        return first is not None and any(
            changed_share(first.raw_ranges_m, scan.raw_ranges_m) > CHANGED
            for scan in islice(found, None, None, _STRIDE)
        )

    def _ahead_s(self, laser: RecordedLaser, name: str, lags_s: Sequence[float]) -> float:
        """How far the clock of a sensor with these lags is ahead of that of the scans, which are stamped before they
        end.
        """
        scans_s = self._bag.census[laser.topic].clock.lags_s
        ahead_s = clock_ahead_s([lag_s - laser.first.duration_s for lag_s in scans_s], lags_s)
        if ahead_s:
            self._notes.append(f"{self._path}: {ahead_note(name, ahead_s)}")
        return ahead_s

    def _lags_s(self, odometry: OdometryInput) -> list[float]:
        """Times from the stamps to the recording of the first readings."""
        return [
            message.bag_time_ns / NANOSECONDS - reading.stamp
            for message in islice(self._bag.read(odometry.topics), FIRST_MESSAGES)
            for reading in chain.from_iterable(valid([message], odometry.readings))
        ]

    def _jumps(self, topic: Topic) -> bool:
        frames = self._bag.census[topic].odom_frames
        return bool(frames) and all(map(is_corrected, frames))

    def _leaps(self, topic: Topic) -> bool:
        """Whether poses are farther apart than a robot drives, as where a map corrects them."""
        readings = valid(self._bag.read([topic]), lambda message: message.content)
        return any(
            is_apart(a.T_odom_base, b.T_odom_base)
            and dist(a.T_odom_base[:2], b.T_odom_base[:2]) > LARGEST_SPEED * abs(b.stamp - a.stamp)
            for a, b in pairwise(readings)
        )

    def _view_rad(self, topic: Topic) -> float:
        if topic.type not in LASER_SCANS:
            return tau
        scan = next(valid(self._bag.read([topic]), lambda message: message.content), None)
        return 0.0 if scan is None else scan.beams.span_rad

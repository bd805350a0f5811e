"""Decides once, before the messages of a robot are read, which of its topics and frames are read, and how."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain, islice, pairwise
from math import degrees, dist, inf, radians, tau
from statistics import quantiles
from typing import Final, NamedTuple

from fcslam.config import one_line
from fcslam.errors import InputError, SourceError
from fcslam.geometry import se2
from fcslam.records import LaserModel, Sweep
from fcslam.sources.bags.camera import Calibration, image_of
from fcslam.sources.bags.census import BagMessage, Messages, valid
from fcslam.sources.bags.cloud_scans import CloudScans, calibration_in
from fcslam.sources.bags.codec import FIX, IMU, LASER_SCANS, NANOSECONDS, ODOMETRY
from fcslam.sources.bags.container import Topic
from fcslam.sources.bags.fixes import FixReader
from fcslam.sources.bags.imu import ImuReader
from fcslam.sources.bags.messages import OdometryReading, ScanMessage, odometry_in
from fcslam.sources.bags.options import NO_ODOMETRY, BagCorrection, BagOptions
from fcslam.sources.bags.pairing import Item
from fcslam.sources.bags.rig import RecordedLaser, Rig, mountings_of, recorded_laser, turned_beams
from fcslam.sources.bags.robots import BagRobot, listed, usual
from fcslam.sources.bags.topics import KnownTopics, Topics, choose_topics
from fcslam.sources.bags.transforms import Link, Mounting, NoTransformError, TransformTree, is_corrected
from fcslam.sources.contradictions import CHANGED, changed_share
from fcslam.sources.faults import Audit, Fault
from fcslam.sources.gate import FIRST_MESSAGES, MAX_STEP_BACK_S
from fcslam.sources.motion import LARGEST_SPEED
from fcslam.sources.path_summary import fault_of_odometry, without_odometry
from fcslam.sources.returns import is_apart

USUAL_ODOM: Final = "odom"
"""Frame of an odometry that names none."""
_LEVEL_RAD = radians(2.0)
_STRIDE = 5
"""Every fifth scan is compared to see whether the robot moves."""
FEWEST_LAGS: Final = 4
"""Messages that show a clock."""


class OdometryInput(NamedTuple):
    """Where the odometry of a robot comes from."""

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
    """What is read of one robot, in a bag or live, and how."""

    options: BagOptions
    topics: Topics
    tree: TransformTree
    scans: CloudScans
    lasers: tuple[RecordedLaser, ...]
    odometry: OdometryInput | None
    """The chosen topic, else tf; one that says nothing is none."""
    odometry_ahead_s: float
    """The clock of the odometry against that of the scans."""
    frames: Link
    """Frames of the odometry, parent and child (the base); usual ones where no message names them."""
    fixes: Topic | None
    fixes_ahead_s: float
    imu: Topic | None
    """IMU of a robot without odometry, or with a 3D LiDAR."""
    imu_reader: ImuReader
    calibration: Calibration | None
    """Calibration of the camera; None without a camera or a readable calibration."""
    notes: tuple[str, ...]
    """About odometry and clocks."""

    @property
    def stated_sweep(self) -> Sweep | None:
        """Times of the beams by a message of the first laser; None if it states none."""
        first = self.lasers[0].first
        return first.sweep if first.ranges_at_stamp is None else None

    def read_topics(self, with_images: bool = False, with_imu: bool = False) -> list[Topic]:
        """The topics of a pass over the messages."""
        others = self.topics.camera if with_images else None, self.imu if with_imu else None
        odometry = () if self.odometry is None else self.odometry.topics
        return list(dict.fromkeys((*odometry, *self.topics.scans, *filter(None, others))))

    def read(self, messages: Iterable[BagMessage], audit: Audit, errors: dict[str, str]) -> Iterator[tuple[int, Item]]:
        """What is read of messages, with their numbers.

        ``audit`` counts those that are invalid, and ``errors`` gets the first of each topic.
        """
        for message in messages:
            try:
                items = self.items(message)
            except ValueError as error:
                errors.setdefault(message.topic.name, f"message {message.number} of it: {error}")
                is_image = message.topic == self.topics.camera
                audit.add(Fault.BROKEN_IMAGE if is_image else Fault.BROKEN_MESSAGE, message.number)
                continue
            for item in items:
                yield message.number, item

    def items(self, message: BagMessage) -> list[Item]:
        """What is read of a message; raises ValueError if it is invalid."""
        correction = self.options.correction
        if message.topic in self.topics.scans:
            if self.scans.is_whole(message.topic):
                return [self.scans.cloud(message)]
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
        if message.topic == self.imu:
            return [self.imu_reader.read(message.content, message.unstamped_ns)]
        if self.odometry is None or message.topic not in self.odometry.topics:
            return []
        late_s = self.odometry_ahead_s + correction.odometry_delay_s
        return [reading._replace(stamp=reading.stamp - late_s) for reading in self.odometry.readings(message)]

    def fix_reader(self, audit: Audit, ahead_s: float | None = None) -> FixReader:
        """Reads the fixes; ``audit`` counts the faults. None: their clock is as the plan says."""
        return FixReader(self.tree, self.frames[1], self.fixes_ahead_s if ahead_s is None else ahead_s, audit)

    def rig(self, farthest_m: Sequence[float]) -> tuple[Rig, list[str]]:
        """The mounted lasers, with these largest ranges, and the camera, and notes about them.

        Raises:
            NoTransformError: tf does not say where a laser sits, yet.
            InputError: a laser cannot be read as it is mounted.
        """
        poses, base_frame = self.options.laser_poses, self.frames[1]
        if poses and len(poses) != len(self.lasers):
            named = ", ".join(laser.name for laser in self.lasers)
            raise InputError(
                f"{len(poses)} laser-pose for the lasers {named}; give one for each laser, in the same order"
            )
        stated = mountings_of(self.lasers, self.tree, base_frame, poses)
        mountings = [_moved(mounted, self.options.correction) for mounted in stated]
        notes = [
            f"the laser of {laser.name} is tilted by {degrees(mounted.tilt_rad):.1f} degrees, read as level"
            for laser, mounted in zip(self.lasers, mountings, strict=True)
            if mounted.tilt_rad > _LEVEL_RAD
        ]
        lasers = tuple(
            LaserModel(*turned_beams(laser.first.beams, mounted.upside_down), range_max_m, mounted.T_base_laser)
            for laser, range_max_m, mounted in zip(self.lasers, farthest_m, mountings, strict=True)
        )
        camera, note, its = None, "", self.calibration
        if its is not None:
            note = "has distorted images, read as if they were not" * its.is_distorted
            try:
                camera = replace(its.camera, T_base_camera=self.tree.fixed(base_frame, its.frame))
            except NoTransformError as error:
                note = f"is left out, as tf has {error}"
        elif self.topics.camera is not None:
            note = "was never calibrated, it is left out"
        if note and self.topics.camera is not None:
            notes.append(f"the camera of {self.topics.camera.name} {note}")
        return Rig(lasers, tuple(mounted.upside_down for mounted in mountings), camera), notes


def plan_of(robot: BagRobot, options: BagOptions, topics: Topics | None = None) -> BagPlan:
    """Plan how a robot is read, on these ``topics``; None: they are chosen.

    Raises:
        NoTransformError: tf does not say where a sensor sits, yet.
        SourceError: the robot cannot be read.
    """
    return _Planner(robot, options, topics).plan()


def clock_ahead(bag: Messages, laser: RecordedLaser, name: str, lags_s: Sequence[float]) -> tuple[float, str]:
    """How far the clock of the sensor ``name`` with these lags is ahead of that of the scans, which are stamped before
    they end, and a line that says it. It is 0 if they differ by little, if one varies, or if there are few messages.
    """
    usual_s = []
    for each_s in ([lag_s - laser.first.duration_s for lag_s in bag.census[laser.topic].lags_s], lags_s):
        low_s, middle_s, high_s = quantiles(each_s, n=4) if len(each_s) >= FEWEST_LAGS else (0.0, 0.0, inf)
        if high_s - low_s > MAX_STEP_BACK_S:
            return 0.0, ""
        usual_s.append(middle_s)
    ahead_s = usual_s[0] - usual_s[1]
    if abs(ahead_s) < MAX_STEP_BACK_S:
        return 0.0, ""
    said = f"{ahead_s:.3f} s ahead of that of the scans by the times of recording; corrected"
    return ahead_s, f"{bag.label}the clock of {name} is {said}"


class _Planner:
    def __init__(self, robot: BagRobot, options: BagOptions, topics: Topics | None) -> None:
        self._robot, self._options, self._bag, self._label = robot, options, robot.bag, robot.bag.label
        self._topics = topics or choose_topics(
            KnownTopics(robot.topics, robot.transforms, self._label),
            options,
            self._view_rad,
            lambda topic: self._jumps(topic) or self._leaps(topic),
        )
        self._tree = robot.bag.tree(robot.transforms)
        self._scans = CloudScans(robot, self._topics.scans, options, self._tree, self._base_frame_of)
        self._notes: list[str] = []

    def plan(self) -> BagPlan:
        """Decide everything."""
        topics, bag = self._topics, self._bag
        lasers = tuple(
            self._laser(topic, frame)
            for topic in topics.scans
            for frame in self._robot.scan_frames.get(topic.name, (None,))
        )
        odometry = self._odometry(lasers[0].first.frame)
        frames = self._frames(odometry)
        needs_imu = odometry is None or self._scans.is_whole(lasers[0].topic)
        fixes, imu = next(iter(self._robot.of_type(FIX)), None), next(iter(self._robot.of_type(IMU)), None)
        imu = imu if needs_imu else None
        lags_s = {each.name: bag.census[each].lags_s for each in (fixes, imu) if each is not None}
        if odometry is not None:
            lags_s = {odometry.name: self._lags_s(odometry), **lags_s}
        clocks = {name: clock_ahead(bag, lasers[0], name, each_s) for name, each_s in lags_s.items()}
        odometry_ahead_s, fixes_ahead_s, imu_ahead_s = (
            clocks[each.name][0] if each is not None else 0.0 for each in (odometry, fixes, imu)
        )
        self._notes += [note for _, note in clocks.values() if note]
        return BagPlan(
            self._options,
            topics,
            self._tree,
            self._scans,
            lasers,
            odometry,
            odometry_ahead_s,
            frames,
            fixes,
            fixes_ahead_s,
            imu,
            ImuReader(self._tree, frames[1], imu_ahead_s),
            calibration_in(self._robot, topics.camera_info),
            tuple(self._notes),
        )

    def _frames(self, odometry: OdometryInput | None) -> Link:
        if odometry is None:
            return USUAL_ODOM, self._options.base_frame or self._tree.usual_base
        if odometry.edge is not None:
            return odometry.edge
        its = self._bag.census[odometry.topics[0]]
        bases = (self._options.base_frame, odometry.base_frame, *its.frames)
        return min(filter(None, its.odom_frames), default=USUAL_ODOM), next(filter(None, bases), self._tree.usual_base)

    def _laser(self, topic: Topic, frame: str | None) -> RecordedLaser:
        own = (scan for scan in self._valid_scans(topic) if frame in (None, scan.frame))
        first = list(islice(own, FIRST_MESSAGES))
        if not first:
            raise SourceError(
                f"{self._label}none of the {topic.message_count} scans in {topic.name} can be read"
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
            self._notes.append(f"{self._label}{candidate.name} {fault}, so it is not used")
        its = self._bag.census[self._topics.scans[0]]
        interval_s = (its.span_ns[1] - its.span_ns[0]) / (max(1, its.count - 1) * NANOSECONDS)
        self._notes.append(f"{self._label}{without_odometry(interval_s, bool(self._robot.of_type(IMU)))}")
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
                f"{self._label}tf has no transform from {options.odom_frame or 'a frame'} to "
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
            f"{self._label}{topic.name} has odometry of the frames {listed(frames)}, and tf does not say which one "
            "the laser is on; choose one by --sensors base-frame"
        )

    def _base_frame_of(self, frame: str) -> str:
        bases = [self._options.base_frame]
        for topic in self._measured:
            bases += [self._base_frame(topic), *self._bag.census[topic].frames]
        link = self._tree.odometry_link(frame, self._options.odom_frame)
        return next(filter(None, (*bases, *(link or ())[1:])), self._tree.usual_base)

    def _scans_change(self) -> bool:
        found = self._valid_scans(self._topics.scans[0])
        first = next(found, None)
        return first is not None and any(
            changed_share(first.raw_ranges_m, scan.raw_ranges_m) > CHANGED
            for scan in islice(found, None, None, _STRIDE)
        )

    def _valid_scans(self, topic: Topic) -> Iterator[ScanMessage]:
        return valid(self._bag.read([topic]), self._scans.scan)

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


def _moved(mounted: Mounting, correction: BagCorrection) -> Mounting:
    x, y, theta = se2.compose(correction.mounting, mounted.T_base_laser).tolist()
    mounted = mounted._replace(upside_down=mounted.upside_down != correction.upside_down)
    return mounted._replace(T_base_laser=(x, y, theta)) if any(correction.mounting) else mounted

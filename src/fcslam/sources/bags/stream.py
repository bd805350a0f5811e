"""The scans of a bag with their odometry, in the order of recording."""

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from itertools import chain, islice
from math import acos, degrees, tau
from pathlib import Path
from statistics import quantiles
from typing import NamedTuple, TypeVar

from fcslam.config import one_line
from fcslam.errors import SourceError
from fcslam.records import Sweep
from fcslam.sources.bags.camera import Calibration, ImageMessage, calibration_of, image_of
from fcslam.sources.bags.census import Clock, CountedBag
from fcslam.sources.bags.clouds import CloudMessage, cloud_mounting, cloud_of, given_cloud_mounting
from fcslam.sources.bags.codec import IMAGE, LASER_SCANS, ODOMETRY, SCANS
from fcslam.sources.bags.container import RawMessage, Topic
from fcslam.sources.bags.merging import merge_scans
from fcslam.sources.bags.messages import (
    BeamsError,
    OdometryReading,
    ScanMessage,
    odometry_in,
    odometry_of,
    scan_of,
    transforms_of,
)
from fcslam.sources.bags.options import NO_ODOMETRY, BagOptions
from fcslam.sources.bags.pairing import Entry, EntryGate, Message, pair_with_odometry, without_odometry
from fcslam.sources.bags.rig import usual_scan
from fcslam.sources.bags.robots import BagRobot, listed, robot_of, usual
from fcslam.sources.bags.sectors import SectorJoiner, are_sectors, cloud_sector_rad, joined_turns
from fcslam.sources.bags.topics import Candidates, Topics, calibration_beside, choose_topics, find_candidates
from fcslam.sources.bags.transforms import USUAL_BASES, NoTransformError, TransformTree, is_fixed
from fcslam.sources.contradictions import CHANGED, changed_share
from fcslam.sources.faults import Audit, Fault
from fcslam.sources.gate import SCANS_THAT_VOTE
from fcslam.sources.path_summary import WITHOUT_ODOMETRY, fault_of_odometry
from fcslam.sources.point_clouds import CloudBand, CloudMounting, PointCloud, directions_in, leaning
from fcslam.sources.pose import Pose

Found = TypeVar("Found")

_IMAGES_TRIED = 5
_STRIDE = 5
"""Of the scans that show whether a robot moves, every such one is compared."""
_READINGS_TRIED = 20
_CLOUDS_FOR_FLOOR, _CLOUDS_TRIED = 20, 200
"""Clouds that show the floor and the directions of the sensor, spread over the first ones."""
_FEWEST_LAGS = 4
_LARGEST_DELAY_S = 2.0
"""Messages of one clock are recorded within this time of each other's delay."""


class RecordedLaser(NamedTuple):
    """One laser of a bag, by its first scans."""

    topic: Topic
    first: ScanMessage
    """The first scan with its usual beams."""
    frame: str | None = None
    """Frame of its scans, on a topic with several; None: any."""
    is_in_sectors: bool = False
    """Whether its messages are sectors of a turn."""

    @property
    def name(self) -> str:
        """The topic, and the frame if it has several."""
        return self.topic.name if self.frame is None else f"{self.topic.name} in '{self.frame}'"

    def notes(self, path: Path, band: CloudBand) -> Iterator[str]:
        """How its messages become scans, if they are none."""
        if self.is_in_sectors:
            yield f"{path}: the scans of {self.name} are sectors of a turn, those of each turn are joined"
        if self.topic.type not in LASER_SCANS:
            yield (
                f"{path}: the scans of {self.name} are its nearest points from {band.low_m:g} m to {band.high_m:g} m "
                "above the floor (--sensors cloud-band chooses)"
            )
        if self.topic.type in SCANS and self.topic.type not in LASER_SCANS and self.first.sweep is None:
            yield (
                f"{path}: the points of {self.name} have no times, or all the same, so the motion of the robot during "
                "a cloud is corrected only if the drive shows how the sensor turns; let the driver publish them"
            )


class OdometryInput(NamedTuple):
    """Where the odometry of a bag comes from."""

    topics: tuple[Topic, ...]
    edge: tuple[str, str] | None
    """Parent and child frame in tf; None: the topic holds messages of odometry."""
    base_frame: str | None = None
    """Frame of the base, on a topic with several; None: any."""

    @property
    def name(self) -> str:
        """The name of the topic, or the frames in tf."""
        return self.topics[0].name if self.edge is None else f"tf from {self.edge[0]} to {self.edge[1]}"


class BagStream:
    """Decodes and combines the chosen topics of a bag."""

    def __init__(self, path: Path, options: BagOptions, robot: BagRobot | None = None) -> None:
        """``robot`` is one of several in the bag; None: the one that ``options`` name, or the only one."""
        self.path = path
        self.bag = CountedBag(path) if robot is None else robot.bag
        self._robot = robot
        self._options = options
        self.odometry_notes: list[str] = []
        """Why an odometry is not used."""
        self.cloud_band = options.cloud_band
        """The points of clouds that count."""
        self._depth_calibrations: dict[Topic, Calibration | None] = {}
        """Of depth images."""
        self._cloud_mountings: dict[tuple[Topic, str], CloudMounting] = {}
        """By topic and frame."""
        self.mounting_notes: list[str] = []
        """What is wrong with them."""
        self.first_errors: dict[str, str] = {}
        """The fault of the first invalid message of each topic, by its name."""

    @cached_property
    def robot(self) -> BagRobot:
        """The robot whose topics are read.

        Raises:
            SourceError: the bag cannot be read, or has several robots.
        """
        return self._robot or robot_of(self.bag, self._options)

    @cached_property
    def tree(self) -> TransformTree:
        """The frames and transforms of the robot."""
        return self.bag.census.tree(self.robot.transforms)

    @cached_property
    def candidates(self) -> Candidates:
        """The topics that can be read.

        Raises:
            SourceError: the bag cannot be read.
        """
        found = find_candidates(self.robot, self._field_of_view_rad, self._has_images)
        return found._replace(measured=[topic for topic in found.measured if not self._odometry_error(topic)])

    @cached_property
    def topics(self) -> Topics:
        """The topics to read.

        Raises:
            SourceError: the bag cannot be read, or a topic is missing.
        """
        return choose_topics(self.robot, self._options, self._field_of_view_rad, self._has_images)

    def _odometry_error(self, topic: Topic) -> str:
        """The fault of the first message of a topic of odometry; empty if one of the first ones is valid."""
        errors = []
        for message in islice(self.bag.messages([topic]), _READINGS_TRIED if topic.type == ODOMETRY else 0):
            try:
                self._reading_in(message)
            except ValueError as error:
                errors.append(str(error))
            else:
                return ""
        return next(iter(errors), "")

    @cached_property
    def lasers(self) -> list[RecordedLaser]:
        """The lasers, in the order of their topics.

        Raises:
            SourceError: none of a laser's scans can be read.
        """
        return [
            self._laser(topic, frame)
            for topic in self.topics.scans
            for frame in self.robot.scan_frames.get(topic.name, (None,))
        ]

    def _laser(self, topic: Topic, frame: str | None) -> RecordedLaser:
        own = (scan for scan in self._scans_of(topic) if frame in (None, scan.frame))
        scans = list(islice(own, SCANS_THAT_VOTE))
        if not scans:
            raise SourceError(
                f"{self.path}: none of the {topic.message_count} scans in {topic.name} can be read"
                f"{self._reason(topic)}; correct the laser's driver, or copy the bag again"
            )
        sector_rad = None if topic.type in LASER_SCANS else cloud_sector_rad(scans)
        if sector_rad is not None:
            raise SourceError(
                f"{self.path}: each cloud of {topic.name} is a sector of about {degrees(sector_rad):.0f} deg; let the "
                "driver publish whole turns, or record its laser scans"
            )
        is_in_sectors = are_sectors(scans)
        return RecordedLaser(topic, usual_scan(joined_turns(scans) if is_in_sectors else scans), frame, is_in_sectors)

    @cached_property
    def calibration(self) -> Calibration | None:
        """Calibration of the camera; None without a camera or a readable calibration."""
        return self._calibration_in(self.topics.camera_info)

    def _calibration_in(self, topic: Topic | None) -> Calibration | None:
        found = self._valid([topic] if topic else [], lambda message: calibration_of(self.bag.decode(message)))
        return next(found, None)

    def _valid(
        self, topics: Sequence[Topic], convert: Callable[[RawMessage], Found], most: int | None = None, step: int = 1
    ) -> Iterator[Found]:
        """Every ``step``-th of the first messages of some topics, converted; invalid ones are left out."""
        for message in islice(self.bag.messages(topics) if topics else (), 0, most, step):
            try:
                found = convert(message)
            except ValueError:
                continue
            yield found

    def entries(self, audit: Audit, with_images: bool = False) -> Iterator[tuple[int, Entry]]:
        """Odometry, consistent scans with odometry, and images if asked, each with its message's number."""
        gate = EntryGate((laser.first.beams for laser in self.lasers), audit)
        items = merge_scans(self._joined(self._items(audit, with_images)), len(self.lasers))
        entries = (without_odometry if self.odometry is None else pair_with_odometry)(items)
        yield from ((number, entry) for number, entry in entries if gate.admits(number, entry))

    def _joined(self, items: Iterator[tuple[int, Message]]) -> Iterator[tuple[int, Message]]:
        """The items with the sectors of a turn joined to one scan."""
        joiners = {laser: SectorJoiner() for laser, each in enumerate(self.lasers) if each.is_in_sectors}
        number = 0
        for number, item in items:
            if isinstance(item, ScanMessage) and item.laser in joiners:
                yield from ((number, turn) for turn in joiners[item.laser].add(item))
            else:
                yield number, item
        yield from ((number, turn) for joiner in joiners.values() for turn in joiner.flush())

    def count_broken_transforms(self, audit: Audit) -> None:
        """Count the transforms that no pass over the scans reads."""
        read = () if self.odometry is None else self.odometry.topics
        for topic, broken in self.bag.census.broken.items():
            if topic in self.topics.transforms and topic not in read:
                self.first_errors.setdefault(topic.name, f"message {broken.first} of it: {broken.error}")
                audit.add(Fault.BROKEN_MESSAGE, broken.first, broken.count)

    def _items(self, audit: Audit, with_images: bool) -> Iterator[tuple[int, Message]]:
        topics, odometry = self.topics, () if self.odometry is None else self.odometry.topics
        seen = (topics.camera,) if with_images and topics.camera is not None else ()
        for message in self.bag.messages(list(dict.fromkeys((*odometry, *topics.scans, *seen)))):
            try:
                items = self._items_in(message)
            except BeamsError:
                audit.add(Fault.BAD_BEAMS, message.number)
            except ValueError as error:
                self.first_errors.setdefault(message.topic.name, f"message {message.number} of it: {error}")
                is_image = message.topic == topics.camera
                audit.add(Fault.BROKEN_IMAGE if is_image else Fault.BROKEN_MESSAGE, message.number)
            else:
                for item in items:
                    yield message.number, item

    def _items_in(self, message: RawMessage) -> list[Message]:
        """Decode one message; raises ValueError if it is invalid."""
        if message.topic in self.topics.scans:
            scan = self._scan_in(message)
            return [
                self._corrected(scan)._replace(laser=number)
                for number, laser in enumerate(self.lasers)
                if laser.topic == message.topic and laser.frame in (None, scan.frame)
            ]
        if message.topic == self.topics.camera:
            return [self._image_in(message)]
        ahead_s = self._clock_ahead_s + self._options.correction.odometry_delay_s
        return [
            reading._replace(stamp=reading.stamp - ahead_s)
            for reading in (self._readings_in(message, self.odometry) if self.odometry else ())
        ]

    @cached_property
    def _clock_ahead_s(self) -> float:
        """The clock of the odometry against that of the scans by the times of recording; 0 if they are alike."""
        if self.odometry is None:
            return 0.0
        found = []
        for topics in (self.topics.scans[:1], self.odometry.topics):
            lags_s = list(chain.from_iterable(self._valid(topics, self._lags_s_in, _READINGS_TRIED)))
            if len(lags_s) < _FEWEST_LAGS:
                return 0.0
            low_s, middle_s, high_s = quantiles(lags_s, n=4)
            if high_s - low_s > _LARGEST_DELAY_S:
                return 0.0
            found.append(middle_s)
        ahead_s = found[0] - found[1]
        if abs(ahead_s) < _LARGEST_DELAY_S:
            return 0.0
        self.odometry_notes.append(
            f"{self.path}: the clock of {self.odometry.name} is {ahead_s:.3f} s ahead of that of the scans by the "
            "times of recording; corrected"
        )
        return ahead_s

    def _lags_s_in(self, message: RawMessage) -> list[float]:
        """How long before its recording a message of scans or odometry was complete, by its stamps."""
        if message.topic in self.topics.scans:
            ends_s = [self._scan_in(message).end]
        else:
            ends_s = [reading.stamp for reading in self._readings_in(message, self.odometry)] if self.odometry else []
        return [message.bag_time_ns / 1e9 - end_s for end_s in ends_s]

    def _corrected(self, scan: ScanMessage) -> ScanMessage:
        """The scan with the times of its beams as they were found."""
        times = self._options.correction.sweep
        if times is None or scan.ranges_at_stamp is not None:
            return scan
        return scan._replace(sweep=Sweep(*times) if times[0] != times[1] else None)

    @property
    def stated_sweep(self) -> Sweep | None:
        """Times of the beams by a message of the first laser; None if it states none."""
        first = self.lasers[0].first
        return first.sweep if first.ranges_at_stamp is None else None

    @cached_property
    def odometry(self) -> OdometryInput | None:
        """The odometry that is read: the chosen topic, else tf; one that says nothing is none."""
        if self._options.odom_topic == NO_ODOMETRY:
            return None
        for candidate in self._odometry_candidates():
            error = "" if candidate.edge is not None else self._odometry_error(candidate.topics[0])
            fault = f"cannot be read ({error})" if error else fault_of_odometry(self._poses_of(candidate))
            if fault is None or not (error or self._scans_change):
                return candidate
            self.odometry_notes.append(f"{self.path}: {candidate.name} {fault}, so it is not used")
        self.odometry_notes.append(f"{self.path}: {WITHOUT_ODOMETRY}")
        return None

    @cached_property
    def clocks(self) -> dict[str, Clock]:
        """The stamps of the lasers and of the odometry that are read, by the names of these."""
        read = {(topic, "", ""): topic.name for topic in self.topics.scans}
        if self.odometry is not None:
            read |= {(topic, *(self.odometry.edge or ("", ""))): self.odometry.name for topic in self.odometry.topics}
        clocks = self.bag.census.clocks
        return {name: clocks[stamped] for stamped, name in read.items() if stamped in clocks}

    @cached_property
    def _scans_change(self) -> bool:
        """Whether the scans show that the robot moves: some scan measures something else than the first."""
        scans = self._scans_of(self.topics.scans[0])
        first = next(scans, None)
        return first is not None and any(
            changed_share(first.raw_ranges_m, scan.raw_ranges_m) > CHANGED
            for scan in islice(scans, None, None, _STRIDE)
        )

    def _odometry_candidates(self) -> Iterator[OdometryInput]:
        """The chosen topic of odometry, then tf.

        Raises:
            SourceError: there is no odometry of the frames that the user names, or it is not clear which is the base.
        """
        options, frame = self._options, self.lasers[0].first.frame
        link = self.tree.odometry_link(frame, options.odom_frame, options.base_frame)
        measured = [topic for topic in self.topics.odometry if topic.type == ODOMETRY]
        if options.odom_topic is None and options.odom_frame is not None:
            measured = []
        for topic in measured:
            yield OdometryInput((topic,), None, self._base_frame(topic))
        if measured and options.odom_topic is not None:
            return
        if link is not None:
            named = tuple(topic for topic in self.topics.odometry if topic.type != ODOMETRY)
            yield OdometryInput(named or self.topics.transforms, link)
        elif options.odom_frame or (options.base_frame and not measured):
            known = ", ".join(f"{one_line(parent)} -> {one_line(child)}" for parent, child in self.tree.links)
            raise SourceError(
                f"{self.path}: tf has no transform from {options.odom_frame or 'a frame'} to "
                f"{options.base_frame or 'a frame above the laser'}; give --sensors odom-frame and base-frame; "
                f"tf has {known or 'no transforms'}"
            )

    def _base_frame(self, topic: Topic) -> str | None:
        """The frame of the base on a topic of odometry that has several.

        Raises:
            SourceError: tf does not say which of them is of the robot.
        """
        frames = [frame for frame in usual(self.bag.census.base_frames.get(topic, {})) if frame]
        chosen = self._options.base_frame or self.robot.base_frames.get(topic.name)
        if len(frames) < 2:
            return None
        if chosen in frames:
            return chosen
        raise SourceError(
            f"{self.path}: {topic.name} has odometry of the frames {listed(frames)}, and tf does not say which one the "
            "laser is on; choose one by --sensors base-frame"
        )

    def _poses_of(self, odometry: OdometryInput) -> Iterator[Pose]:
        readings = self._valid(odometry.topics, lambda message: self._readings_in(message, odometry))
        return (reading.T_odom_base for reading in chain.from_iterable(readings))

    def _readings_in(self, message: RawMessage, odometry: OdometryInput) -> list[OdometryReading]:
        """The readings of an odometry in one of its messages; raises ValueError if it is invalid."""
        if odometry.edge is None:
            reading = self._reading_in(message)
            return [reading] if odometry.base_frame in (None, reading.base_frame) else []
        transforms = list(transforms_of(self.bag.decode(message), message.bag_time_ns))
        return [odometry_in(each) for each in transforms if (each.parent, each.child) == odometry.edge]

    def _reading_in(self, message: RawMessage) -> OdometryReading:
        return odometry_of(self.bag.decode(message), message.bag_time_ns)

    def _scans_of(self, topic: Topic) -> Iterator[ScanMessage]:
        return self._valid([topic], self._scan_in)

    def _scan_in(self, message: RawMessage) -> ScanMessage:
        """Decode a laser scan, a point cloud or a depth image; raises ValueError if it is invalid."""
        content, topic = self.bag.decode(message), message.topic
        if topic.type in LASER_SCANS:
            return scan_of(content, message.bag_time_ns)
        if topic not in self._depth_calibrations:
            info = calibration_beside(topic, self.robot) if topic.type == IMAGE else None
            self._depth_calibrations[topic] = self._calibration_in(info)
        cloud = cloud_of(content, topic.type, message.bag_time_ns, self._depth_calibrations[topic])
        if (topic, cloud.frame) not in self._cloud_mountings:
            mounting = self._cloud_mounting(topic, cloud.frame)
            mounting = self._levelled(topic, cloud.frame, mounting)
            directions = directions_in(self._some_clouds(topic, cloud.frame), mounting)
            self._cloud_mountings[topic, cloud.frame] = mounting._replace(directions=directions)
        return cloud.scan(self._cloud_mountings[topic, cloud.frame], self.cloud_band)

    def _cloud_mounting(self, topic: Topic, frame: str) -> CloudMounting:
        """The mounting in tf, or the one that the user gives.

        Raises:
            SourceError: tf lacks it.
        """
        if self._options.laser_poses:
            return given_cloud_mounting(self._options.laser_poses[self.topics.scans.index(topic)], frame)
        try:
            return cloud_mounting(self.tree.fixed(self._base_frame_of(frame), frame))
        except NoTransformError as error:
            if is_fixed(frame):
                raise SourceError(
                    f"{self.path}: the points of {topic.name} are in '{frame}', in which the robot drives, so another "
                    "node has moved them; record the clouds of the sensor's driver, or choose them by --sensors "
                    "scan-topic"
                ) from error
            raise SourceError(
                f"{self.path}: tf has {error}, so the pose of the sensor of {topic.name} is unknown; give it "
                "with --sensors laser-pose=X,Y,THETA (metres, radians)"
            ) from error

    def _levelled(self, topic: Topic, frame: str, mounting: CloudMounting) -> CloudMounting:
        """The mounting, corrected with a note if the floor leans in most clouds."""
        found = leaning(self._some_clouds(topic, frame), mounting)
        if found is None:
            return mounting
        self.mounting_notes.append(
            f"{self.path}: the floor in {topic.name} leans by {degrees(acos(found[2, 2])):.0f} deg against the "
            f"mounting of '{frame}'; corrected: correct it in tf"
        )
        return mounting._replace(rotation=found @ mounting.rotation)

    def _some_clouds(self, topic: Topic, frame: str) -> Iterator[PointCloud]:
        calibration = self._depth_calibrations[topic]

        def convert(message: RawMessage) -> CloudMessage:
            return cloud_of(self.bag.decode(message), topic.type, message.bag_time_ns, calibration)

        step = max(1, min(topic.message_count, _CLOUDS_TRIED) // _CLOUDS_FOR_FLOOR)
        clouds = self._valid([topic], convert, _CLOUDS_TRIED, step)
        return (found.cloud for found in clouds if found.frame == frame)

    def _base_frame_of(self, frame: str) -> str:
        """The base of the robot with ``frame``, before its lasers are known."""
        bases = [self._options.base_frame]
        for topic in (topic for topic in self.topics.odometry if topic.type == ODOMETRY):
            bases.append(self._base_frame(topic))
            bases += [reading.base_frame for reading in self._valid([topic], self._reading_in, _READINGS_TRIED)]
        link = self.tree.odometry_link(frame, self._options.odom_frame)
        usual_ones = [each for each in USUAL_BASES if each in self.tree]
        return next(filter(None, (*bases, *(link or ())[1:], *usual_ones)), USUAL_BASES[-1])

    def _reason(self, topic: Topic) -> str:
        """The fault of the first scan, in brackets."""
        for message in islice(self.bag.messages([topic]), 1):
            try:
                self._scan_in(message)
            except ValueError as error:
                return f" ({error})"
        return ""

    def _image_in(self, message: RawMessage) -> ImageMessage:
        return image_of(self.bag.decode(message), message.topic.type, message.bag_time_ns)

    def _has_images(self, topic: Topic) -> bool:
        """Whether one of the first messages is a readable image; depth images are not."""
        return next(self._valid([topic], self._image_in, _IMAGES_TRIED), None) is not None

    def _field_of_view_rad(self, topic: Topic) -> float:
        """Of the topic's first scan; 0 if it cannot be read; a full turn of a point cloud."""
        if topic.type not in LASER_SCANS:
            return tau
        scan = next(self._scans_of(topic), None)
        return 0.0 if scan is None else scan.beams.span_rad

"""The scans of a bag with their odometry, in the order of recording."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from fcslam.errors import SourceError
from fcslam.records import Sweep
from fcslam.sources.bags.camera import (
    Calibration,
    ImageMessage,
    calibration_of,
    image_of,
)
from fcslam.sources.bags.codec import ODOMETRY
from fcslam.sources.bags.container import BagFile, RawMessage, Topic
from fcslam.sources.bags.merging import merge_scans
from fcslam.sources.bags.messages import (
    BeamsError,
    OdometryReading,
    ScanMessage,
    StampedTransform,
    is_odometry,
    odometry_in,
    odometry_of,
    scan_of,
    transforms_of,
)
from fcslam.sources.bags.options import NO_ODOMETRY, BagOptions
from fcslam.sources.bags.pairing import Entry, Message, PosedScan, pair_with_odometry, without_odometry
from fcslam.sources.bags.topics import Candidates, Topics, choose_topics, find_candidates
from fcslam.sources.bags.transforms import TransformTree
from fcslam.sources.contradictions import CHANGED, changed_share
from fcslam.sources.faults import Audit, Fault
from fcslam.sources.gate import SCANS_THAT_VOTE, ScanGate, usual_beams
from fcslam.sources.path_summary import WITHOUT_ODOMETRY, fault_of_odometry
from fcslam.sources.pose import Pose

_IMAGES_TRIED = 5
_STRIDE = 5
"""Of the scans that show whether a robot moves, every such one is compared."""
_READINGS_TRIED = 20


class RecordedLaser(NamedTuple):
    """One laser of a bag, by its first scans."""

    topic: Topic
    first: ScanMessage
    """The first scan with its usual beams."""


class OdometryInput(NamedTuple):
    """Where the odometry of a bag comes from."""

    topics: tuple[Topic, ...]
    edge: tuple[str, str] | None
    """Parent and child frame in tf; None: the topic holds messages of odometry."""

    @property
    def name(self) -> str:
        """The name of the topic, or the frames in tf."""
        return self.topics[0].name if self.edge is None else f"tf from {self.edge[0]} to {self.edge[1]}"

    def readings_in(self, topic: Topic, transforms: Sequence[StampedTransform]) -> Iterator[OdometryReading]:
        """The readings among the transforms of a message of ``topic``."""
        if self.edge is not None and topic in self.topics:
            yield from (odometry_in(each) for each in transforms if (each.parent, each.child) == self.edge)


class BagStream:
    """Decodes and combines the chosen topics of a bag."""

    def __init__(self, path: Path, options: BagOptions) -> None:
        self.path = path
        self._bag = BagFile(path)
        self._options = options
        self.odometry_notes: list[str] = []
        """Why an odometry is not used."""
        self.first_errors: dict[str, str] = {}
        """The fault of the first invalid message of each topic, by its name."""

    @property
    def reading_notes(self) -> tuple[str, ...]:
        """How the bag was read, if it is not whole; complete after a pass over all messages."""
        return self._bag.notes

    @cached_property
    def candidates(self) -> Candidates:
        """The topics that can be read.

        Raises:
            SourceError: the bag cannot be read.
        """
        found = find_candidates(self._bag, self._field_of_view_rad, self._has_images)
        return found._replace(measured=[topic for topic in found.measured if not self._odometry_error(topic)])

    @cached_property
    def topics(self) -> Topics:
        """The topics to read.

        Raises:
            SourceError: the bag cannot be read, or a topic is missing.
        """
        return choose_topics(self._bag, self._options, self._field_of_view_rad, self._has_images)

    def _odometry_error(self, topic: Topic) -> str:
        """The fault of the first message of a topic of odometry; empty if one of the first ones is valid."""
        errors = []
        for message in islice(self._bag.messages([topic]), _READINGS_TRIED if topic.type == ODOMETRY else 0):
            try:
                odometry_of(self._bag.decode(message), message.bag_time_ns)
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
        return [self._laser(topic) for topic in self.topics.scans]

    def _laser(self, topic: Topic) -> RecordedLaser:
        scans = list(islice(self._scans_of(topic), SCANS_THAT_VOTE))
        if not scans:
            raise SourceError(
                f"{self.path}: none of the {topic.message_count} scans in {topic.name} can be read"
                f"{self._reason(topic)}; correct the laser's driver, or copy the bag again"
            )
        usual = usual_beams([scan.beams for scan in scans])
        return RecordedLaser(topic, next(scan for scan in scans if scan.beams == usual))

    @cached_property
    def calibration(self) -> Calibration | None:
        """Calibration of the camera; None without a camera or a readable calibration."""
        topic = self.topics.camera_info
        for message in () if topic is None else self._bag.messages([topic]):
            try:
                return calibration_of(self._bag.decode(message))
            except ValueError:
                continue
        return None

    def entries(
        self, audit: Audit, tree: TransformTree | None = None, with_images: bool = False
    ) -> Iterator[tuple[int, Entry]]:
        """Odometry, consistent scans with odometry, and images if asked, each with its message's number.

        ``tree`` collects all transforms, if it is given.
        """
        gates = [ScanGate(laser.first.beams, audit) for laser in self.lasers]
        items = merge_scans(self._items(audit, tree, with_images), len(gates))
        for number, entry in (without_odometry if self.odometry is None else pair_with_odometry)(items):
            if not isinstance(entry, PosedScan):
                if isinstance(entry, OdometryReading) and entry.is_after_jump:
                    audit.add(Fault.ODOMETRY_JUMP, number)
                yield number, entry
            elif gates[entry.scan.laser].admits(number, entry.scan.stamp, entry.scan.beams):
                if entry.fault is not None:
                    audit.add(entry.fault, number)
                if entry.fault is not Fault.NO_ODOMETRY:
                    yield number, entry

    def _items(self, audit: Audit, tree: TransformTree | None, with_images: bool) -> Iterator[tuple[int, Message]]:
        topics, odometry = self.topics, () if self.odometry is None else self.odometry.topics
        heard = () if tree is None else topics.transforms
        seen = (topics.camera,) if with_images and topics.camera is not None else ()
        for message in self._bag.messages(list(dict.fromkeys((*odometry, *heard, *topics.scans, *seen)))):
            try:
                items = self._items_in(message, tree)
            except BeamsError:
                audit.add(Fault.BAD_BEAMS, message.number)
            except ValueError as error:
                self.first_errors.setdefault(message.topic.name, f"message {message.number} of it: {error}")
                is_image = message.topic == topics.camera
                audit.add(Fault.BROKEN_IMAGE if is_image else Fault.BROKEN_MESSAGE, message.number)
            else:
                for item in items:
                    yield message.number, item

    def _items_in(self, message: RawMessage, tree: TransformTree | None) -> list[Message]:
        """Decode one message; raises ValueError if it is invalid."""
        if message.topic in self.topics.scans:
            scan = scan_of(self._bag.decode(message), message.bag_time_ns)
            return [self._corrected(scan)._replace(laser=self.topics.scans.index(message.topic))]
        if message.topic == self.topics.camera:
            return [self._image_in(message)]
        if message.topic.type == ODOMETRY:
            return [self._in_time(odometry_of(self._bag.decode(message), message.bag_time_ns))]
        transforms = self._transforms_in(message)
        if tree is not None:
            for transform in transforms:
                tree.add(transform.parent, transform.child, transform.T_parent_child)
        readings = () if self.odometry is None else self.odometry.readings_in(message.topic, transforms)
        return [self._in_time(reading) for reading in readings]

    def _in_time(self, reading: OdometryReading) -> OdometryReading:
        """The reading with its stamp by the clock of the scans."""
        return reading._replace(stamp=reading.stamp - self._options.correction.odometry_delay_s)

    def _corrected(self, scan: ScanMessage) -> ScanMessage:
        """The scan with the times of its beams as they were found."""
        times = self._options.correction.sweep
        return scan if times is None else scan._replace(sweep=Sweep(*times) if times[0] != times[1] else None)

    @property
    def states_sweep(self) -> bool:
        """Whether the messages of the first laser say when the beams are measured."""
        return self.lasers[0].first.sweep is not None

    @cached_property
    def odometry(self) -> "OdometryInput | None":
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
    def _scans_change(self) -> bool:
        """Whether the scans show that the robot moves: some scan measures something else than the first."""
        scans = self._scans_of(self.topics.scans[0])
        first = next(scans, None)
        return first is not None and any(
            changed_share(first.raw_ranges_m, scan.raw_ranges_m) > CHANGED
            for scan in islice(scans, None, None, _STRIDE)
        )

    def _odometry_candidates(self) -> Iterator["OdometryInput"]:
        measured = [topic for topic in self.topics.odometry if topic.type == ODOMETRY]
        for topic in measured:
            yield OdometryInput((topic,), None)
        if measured and self._options.odom_topic is not None:
            return
        edge = self._odometry_edge
        if edge is not None:
            yield OdometryInput(self.topics.transforms, edge)

    @cached_property
    def _odometry_edge(self) -> tuple[str, str] | None:
        """Frames of the odometry in tf: the first transform whose parent frame contains "odom"; None without one."""
        transforms = self._transforms_of(self.topics.transforms)
        return next(((each.parent, each.child) for each in transforms if is_odometry(each)), None)

    def _poses_of(self, odometry: "OdometryInput") -> Iterator[Pose]:
        if odometry.edge is not None:
            for transform in self._transforms_of(odometry.topics):
                yield from (each.T_odom_base for each in odometry.readings_in(odometry.topics[0], [transform]))
            return
        for message in self._bag.messages(odometry.topics):
            with suppress(ValueError):
                yield odometry_of(self._bag.decode(message), message.bag_time_ns).T_odom_base

    def _transforms_of(self, topics: Sequence[Topic]) -> Iterator[StampedTransform]:
        for message in self._bag.messages(topics):
            with suppress(ValueError):
                yield from self._transforms_in(message)

    def _transforms_in(self, message: RawMessage) -> list[StampedTransform]:
        return list(transforms_of(self._bag.decode(message), message.bag_time_ns))

    def _scans_of(self, topic: Topic) -> Iterator[ScanMessage]:
        for message in self._bag.messages([topic]):
            try:
                scan = scan_of(self._bag.decode(message), message.bag_time_ns)
            except ValueError:
                continue
            yield scan

    def _reason(self, topic: Topic) -> str:
        """The fault of the first scan, in brackets."""
        for message in islice(self._bag.messages([topic]), 1):
            try:
                scan_of(self._bag.decode(message), message.bag_time_ns)
            except ValueError as error:
                return f" ({error})"
        return ""

    def _image_in(self, message: RawMessage) -> ImageMessage:
        return image_of(self._bag.decode(message), message.topic.type, message.bag_time_ns)

    def _has_images(self, topic: Topic) -> bool:
        """Whether one of the first messages is a readable image; depth images are not."""
        for message in islice(self._bag.messages([topic]), _IMAGES_TRIED):
            try:
                self._image_in(message)
            except ValueError:
                continue
            return True
        return False

    def _field_of_view_rad(self, topic: Topic) -> float:
        """Of the topic's first scan; 0 if it cannot be read."""
        scan = next(self._scans_of(topic), None)
        return 0.0 if scan is None else scan.beams.span_rad

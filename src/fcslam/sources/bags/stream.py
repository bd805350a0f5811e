"""The scans of a bag with their odometry, in the order of recording."""

from collections.abc import Iterator
from contextlib import suppress
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from fcslam.errors import SourceError
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
    ScanMessage,
    StampedTransform,
    is_odometry,
    odometry_in,
    odometry_of,
    scan_of,
    transforms_of,
)
from fcslam.sources.bags.options import BagOptions
from fcslam.sources.bags.pairing import Entry, Message, PosedScan, pair_with_odometry
from fcslam.sources.bags.topics import Candidates, Topics, choose_topics, find_candidates
from fcslam.sources.bags.transforms import TransformTree
from fcslam.sources.faults import Audit, Fault
from fcslam.sources.gate import SCANS_THAT_VOTE, ScanGate, usual_beams

_EDGES_NAMED = 10
_IMAGES_TRIED = 5
_READINGS_TRIED, _TRANSFORMS_TRIED = 20, 200


class RecordedLaser(NamedTuple):
    """One laser of a bag, by its first scans."""

    topic: Topic
    first: ScanMessage
    """The first scan with its usual beams."""


class BagStream:
    """Decodes and combines the chosen topics of a bag."""

    def __init__(self, path: Path, options: BagOptions) -> None:
        self.path = path
        self._bag = BagFile(path)
        self._options = options
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
        topics = choose_topics(self._bag, self._options, self._field_of_view_rad, self._has_images)
        chosen = topics.odometry[0]
        error = "" if self._options.odom_topic is not None else self._odometry_error(chosen)
        if not error or not any(map(is_odometry, self._first_transforms(topics))):
            return topics
        note = f"{self.path}: {chosen.name} cannot be read ({error}), so the odometry is read from tf"
        return topics._replace(odometry=topics.transforms, notes=(*topics.notes, note))

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

    def _first_transforms(self, topics: Topics) -> Iterator[StampedTransform]:
        for message in islice(self._bag.messages(topics.transforms), _TRANSFORMS_TRIED):
            with suppress(ValueError):
                yield from self._transforms_in(message)

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
        for number, entry in pair_with_odometry(merge_scans(self._items(audit, tree, with_images), len(gates))):
            if not isinstance(entry, PosedScan):
                yield number, entry
            elif gates[entry.scan.laser].admits(number, entry.scan.stamp, entry.scan.beams):
                if entry.fault is not None:
                    audit.add(entry.fault, number)
                if entry.fault is not Fault.NO_ODOMETRY:
                    yield number, entry

    def _items(self, audit: Audit, tree: TransformTree | None, with_images: bool) -> Iterator[tuple[int, Message]]:
        topics = self.topics
        heard = () if tree is None else topics.transforms
        seen = (topics.camera,) if with_images and topics.camera is not None else ()
        for message in self._bag.messages(list(dict.fromkeys((*topics.odometry, *heard, *topics.scans, *seen)))):
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
            return [scan._replace(laser=self.topics.scans.index(message.topic))]
        if message.topic == self.topics.camera:
            return [self._image_in(message)]
        if message.topic.type == ODOMETRY:
            return [odometry_of(self._bag.decode(message), message.bag_time_ns)]
        transforms = self._transforms_in(message)
        if tree is not None:
            for transform in transforms:
                tree.add(transform.parent, transform.child, transform.T_parent_child)
        if message.topic not in self.topics.odometry:
            return []
        return [
            odometry_in(transform)
            for transform in transforms
            if (transform.parent, transform.child) == self._odometry_edge
        ]

    @cached_property
    def _odometry_edge(self) -> tuple[str, str]:
        """Frames of the odometry in tf: the first transform whose parent frame contains "odom"."""
        seen: set[str] = set()
        for message in self._bag.messages(self.topics.odometry):
            try:
                transforms = self._transforms_in(message)
            except ValueError:
                continue
            for transform in transforms:
                if is_odometry(transform):
                    return transform.parent, transform.child
                seen.add(f"{transform.parent} -> {transform.child}")
        known = ", ".join(sorted(seen)[:_EDGES_NAMED]) or "nothing that can be read"
        raise SourceError(
            f"{self.path}: no odometry: no topic of type {ODOMETRY}, and in tf no transform from odom to base, but "
            f"{known}; record the odometry"
        )

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

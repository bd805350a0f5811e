"""The back end of one robot: keyscans and images in, records for the cloud out.

It builds submaps, closes loops, solves the pose graph and describes places. Its output is a function of its inputs in
their order, so it gives the same records wherever and whenever it runs (``fcslam.robot.backend_runner``).
"""

from collections import defaultdict
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from enum import Enum, auto
from functools import lru_cache
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field

from fcslam.config import Settings
from fcslam.errors import FeatureError
from fcslam.features.birdseye import DETECTOR_VERSION, Features
from fcslam.features.birdseye import describe as describe_surface
from fcslam.features.codes import LARGEST_HAMMING, mutual_matches
from fcslam.geometry import se2
from fcslam.lidar.backend import FinishedSubmap, LidarBackend
from fcslam.lidar.frontend import LidarConfig, MappedKeyscan, ScanPose
from fcslam.places.index import PlaceIndex
from fcslam.places.motions import rigid_hypotheses
from fcslam.places.vocabulary import VocabularyConfig
from fcslam.records import (
    PLACE_CHANNELS,
    CameraImage,
    Channel,
    Codes,
    DetectorFile,
    FloatArray,
    KeyscanFix,
    KeyscanId,
    LaserModel,
    LaserScan,
    Place,
    Tag,
    TagSighting,
)
from fcslam.robot.keyframe_folder import KeyframeFolder
from fcslam.robot.tag_detection import TagDetector, TagsConfig
from fcslam.robot.views import ViewExtractor, ViewsConfig
from fcslam.wire.limits import MAXIMUM_TAGS
from fcslam.wire.messages import Body, Hello


def _of_places(channel: Channel) -> Channel:
    if channel not in PLACE_CHANNELS:
        raise ValueError("tags describe no places; leave tag out and set robot.tags.size_m")
    return channel


class SessionConfig(Settings):
    """Settings of everything that turns sensor records into packets."""

    lidar: LidarConfig = Field(default=LidarConfig(), description="LiDAR SLAM of one robot")
    channels: tuple[Annotated[Channel, AfterValidator(_of_places)], ...] = Field(
        default=PLACE_CHANNELS, min_length=1, description="sensors that describe places: lidar, camera"
    )
    views: ViewsConfig = Field(default=ViewsConfig(), description="binary descriptors of camera images")
    tags: TagsConfig = Field(default=TagsConfig(), description="tags on walls, floors and ceilings")

    @property
    def uses_images(self) -> bool:
        """Whether the robot needs its camera."""
        return Channel.CAMERA in self.channels or self.tags.size_m is not None


@dataclass(frozen=True, slots=True, eq=False)
class NewKeyscan:
    """The next keyscan of the present session."""

    keyscan: MappedKeyscan
    lasers: tuple[LaserModel, ...]
    """All lasers so far."""


@dataclass(frozen=True, slots=True, eq=False)
class NewImage:
    """The next camera image of the present session, between two scans."""

    image: CameraImage
    scan: LaserScan
    pose: ScanPose
    """The newest scan and its pose."""
    scans: tuple[LaserScan, ...]
    """The newest scan of each laser."""


@dataclass(frozen=True, slots=True)
class NewDetector:
    """Another network for camera images, from now on; buffered images are described again at once."""

    file: DetectorFile
    path: Path


class Task(Enum):
    """What a back end does between two records."""

    PLACE_KEYFRAMES = auto()
    """Write where the keyframes of the present session are; the robot stands still and may learn from them."""
    END_SESSION = auto()
    """The next keyscan begins another session."""


VOCABULARY = VocabularyConfig()
"""Vocabulary of the places of one robot."""
PLACED_AFTER = 20
"""Keyframes after which the poses of all keyscans are written again."""

BackendInput = NewKeyscan | NewImage | KeyscanFix | NewDetector | Task


class RobotBackend:
    """Handles the inputs of one robot, session after session. The epoch is the number of the session, from 0."""

    def __init__(self, robot: str, config: SessionConfig, keyframes: Path | None = None) -> None:
        """Load the detector of camera images.

        ``keyframes`` is the folder that keeps the keyframes, for a process that learns; None: they are not kept.
        """
        self._robot = robot
        self._config = config
        self._folder = None if keyframes is None else KeyframeFolder(keyframes)
        self.views = ViewExtractor(robot, config.views, self._folder)
        self._unplaced = 0
        """Keyframes since their poses were written last."""
        self._session = _Session(robot, 0, self.views, config)

    def process(self, input: BackendInput) -> list[Body]:
        """Handle the next input; returns what the robot sends because of it.

        Raises:
            FeatureError: the file of a new detector is not the announced one or cannot be used, or it describes a
                channel that this robot does not use. Nothing has changed then.
        """
        match input:
            case NewKeyscan():
                return self._session.add(input)
            case NewImage():
                if Channel.CAMERA in self._config.channels and self._session.describe(input):
                    self._unplaced += 1
                    if self._unplaced >= PLACED_AFTER:
                        self._place()
                return list(self._session.find_tags(input))
            case KeyscanFix():
                return [input]
            case NewDetector():
                self._set_detector(input.file, input.path)
                return self._session.announcement()
            case Task.PLACE_KEYFRAMES:
                self._place()
            case Task.END_SESSION:
                rest = self._session.finish()
                self._place()
                if self._folder is not None:
                    self._folder.session += 1
                self.views.reset()
                self._session = _Session(self._robot, self._session.epoch + 1, self.views, self._config)
                return rest
        return []

    def _place(self) -> None:
        if self._folder is not None:
            self._folder.place(self._session.lidar.keyscan_poses())
        self._unplaced = 0

    def _set_detector(self, file: DetectorFile, path: Path) -> None:
        if file.channel is not Channel.CAMERA or file.channel not in self._config.channels:
            raise FeatureError(
                f"{file.version}: describes {file.channel} places; this robot does not use detectors of that channel"
            )
        if file.version != self.views.detector_version:
            self.views.set_detector(file, path)


class _Session:
    def __init__(self, robot: str, epoch: int, view_extractor: ViewExtractor, config: SessionConfig) -> None:
        self.epoch = epoch
        self._robot = robot
        self._config = config
        self._own_places = OwnPlaces()
        self.lidar = LidarBackend(robot, config.lidar, self._own_places)
        self._lasers: tuple[LaserModel, ...] = ()
        self._view_extractor = view_extractor
        self._views: list[Place] = []
        """Places of images that wait until the submap around them is complete."""
        self._submaps: dict[int, tuple[int, int]] = {}
        """By keyscan of a camera place: first and last keyscan of the submap that it was sent with."""
        self._described: set[tuple[int, str]] = set()
        """Keyscan and detector version of every camera place that was sent."""
        self._tag_detector = None if config.tags.size_m is None else TagDetector(config.tags)
        self._sighted: defaultdict[int, set[Tag]] = defaultdict(set)
        """The tags whose sightings were sent, by keyscan."""
        self._announced: Hello | None = None

    def add(self, input: NewKeyscan) -> list[Body]:
        self._lasers = input.lasers
        bodies = [*self.announcement(), *essential(input)]
        submap = self.lidar.add(input.keyscan)
        return bodies if submap is None else [*bodies, *self._submap_bodies(submap)]

    def describe(self, input: NewImage) -> bool:
        """Describe an image and keep the view until the submap around it is complete; returns whether it is one."""
        view = self._view_extractor.describe(input.image, input.scan, input.pose, input.scans)
        if view is not None:
            self._views.append(view)
        return view is not None

    def find_tags(self, input: NewImage) -> Iterator[TagSighting]:
        if self._tag_detector is None:
            return
        scan, pose, odometry = input.scan, input.pose, input.image.T_odom_base
        T_scan_image = np.zeros(3) if odometry is None else se2.between(scan.T_odom_base, odometry)
        T_keyscan_image = se2.compose(pose.T_keyscan_base, T_scan_image)
        keyscan = KeyscanId(self._robot, pose.keyscan)
        sent = self._sighted[pose.keyscan]
        for sighting in self._tag_detector.find(input.image, keyscan, T_keyscan_image):
            if sighting.tag not in sent and len(sent) < MAXIMUM_TAGS:
                sent.add(sighting.tag)
                yield sighting

    def finish(self) -> list[Body]:
        announcement, rest = self.announcement(), self.lidar.finish()
        last = rest[-1:]
        return [*announcement, *(body for submap in rest for body in self._submap_bodies(submap, submap in last))]

    def _submap_bodies(self, submap: FinishedSubmap, at_end: bool = False) -> list[Body]:
        bodies: list[Body] = list(submap.closures)
        if Channel.LIDAR in self._config.channels:
            keyscan, described = KeyscanId(self._robot, submap.anchor), self._own_places.features(submap.anchor)
            bodies.append(Place(keyscan, Channel.LIDAR, DETECTOR_VERSION, submap.first, submap.last, *described))
        complete = [view for view in self._views if at_end or view.id.number <= submap.anchor]
        self._views = self._views[len(complete) :]
        # A view outside of every submap is not a place: the robot may have jumped between two scans.
        shown = [view for view in complete if submap.first <= view.id.number <= submap.last]
        self._submaps |= {view.id.number: (submap.first, submap.last) for view in shown}
        return [*bodies, *(self._camera_place(view) for view in shown)]

    def announcement(self) -> list[Body]:
        """A hello at the start and if there is one more laser or another detector, then the camera places that this
        detector describes again."""
        hello, before = self._hello(), self._announced
        if not hello.lasers or hello == before:
            return []
        self._announced = hello
        if before is not None and hello.detector_versions == before.detector_versions:
            return [hello]
        views = {view.id: view for view in self._view_extractor.describe_again()} if self._submaps else {}
        self._views = [views.get(view.id, view) for view in self._views]
        sent = [view for view in views.values() if view.id.number in self._submaps]
        fresh = [view for view in sent if (view.id.number, view.detector_version) not in self._described]
        return [hello, *(self._camera_place(view) for view in fresh)]

    def _camera_place(self, view: Place) -> Place:
        self._described.add((view.id.number, view.detector_version))
        first, last = self._submaps[view.id.number]
        return replace(view, first=first, last=last)

    def _hello(self) -> Hello:
        known = {Channel.LIDAR: DETECTOR_VERSION, Channel.CAMERA: self._view_extractor.detector_version}
        versions = {channel: version for channel in self._config.channels if (version := known[channel]) is not None}
        return Hello(self._robot, self.epoch, self._lasers, versions)


class OwnPlaces:
    """The LiDAR places of one session (``lidar.closing.PlaceRecognizer``), with a vocabulary of their own.

    So the robot recognises where it was before, however far its estimate has drifted.
    """

    def __init__(self, vocabulary: VocabularyConfig = VOCABULARY) -> None:
        self._keypoints_m: dict[int, NDArray[np.float32]] = {}
        self._index: PlaceIndex[int] = PlaceIndex(vocabulary, np.random.default_rng(0))
        self._descriptors = lru_cache(self._index.descriptors)
        """Those of a place in the index, which holds each descriptor once."""
        self._waiting: dict[int, Codes] = {}
        """Descriptors of the places that the index lacks: a robot whose loops are short never asks it."""

    def store(self, keyscan: int, surface: FloatArray) -> None:
        """Describe and store a submap by the points of its surfaces, shape (N, 2), metres in its anchor's base."""
        self._keypoints_m[keyscan], self._waiting[keyscan] = describe_surface(surface)

    def features(self, keyscan: int) -> Features:
        """The description of a stored submap."""
        waiting = self._waiting.get(keyscan)
        return self._keypoints_m[keyscan], self._descriptors(keyscan) if waiting is None else waiting

    def most_similar(self, keyscan: int, among: Collection[int], most: int) -> list[int]:
        """At most ``most`` of these stored submaps that look like a stored one, the most similar first."""
        for stored, descriptors in self._waiting.items():
            self._index.add(stored, descriptors)
        self._waiting.clear()
        result = self._index.compare(self._descriptors(keyscan))
        return [stored for stored, _ in result.best(most, lambda place: place in among)]

    def forget(self, keyscan: int) -> None:
        """Forget a stored submap."""
        del self._keypoints_m[keyscan]
        if keyscan in self._index:
            self._index.forget(keyscan)
        else:
            del self._waiting[keyscan]

    def motions(self, a: int, b: int) -> list[FloatArray]:
        """Motions ``T_a_b``, shape (3,), that enough keypoints of two stored submaps support, the best first."""
        (keypoints_a, descriptors_a), (keypoints_b, descriptors_b) = self.features(a), self.features(b)
        matches = mutual_matches(descriptors_a, descriptors_b, LARGEST_HAMMING)
        return [T_a_b for T_a_b, _ in rigid_hypotheses(keypoints_a, keypoints_b, matches)]


def essential(input: NewKeyscan) -> list[Body]:
    """Records that the pose graph needs in any case: the keyscan and its odometry."""
    keyscan, odometry = input.keyscan.record, input.keyscan.odometry
    return [keyscan] if odometry is None else [keyscan, odometry]

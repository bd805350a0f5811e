"""One session of a robot: from a start with odometry at zero until it stops or is lost."""

from collections.abc import Iterable

from pydantic import Field

from fcslam.config import Settings
from fcslam.features.birdseye import DETECTOR_VERSION, BirdseyeConfig
from fcslam.lidar.mapper import FinishedSubmap, LidarConfig, Mapper, ScanPose, Step
from fcslam.lidar.tracker import TrackingResult
from fcslam.records import CameraImage, Channel, KeyscanId, LaserScan, Place
from fcslam.robot.own_places import OwnPlaces, OwnPlacesConfig
from fcslam.robot.views import CameraView, ViewExtractor, ViewsConfig
from fcslam.wire.messages import Body, Hello, Packet


class SessionConfig(Settings):
    """Settings of everything that turns sensor records into packets."""

    lidar: LidarConfig = Field(default=LidarConfig(), description="LiDAR SLAM of one robot")
    channels: tuple[Channel, ...] = Field(
        default=tuple(Channel), min_length=1, description="sensors that describe places: lidar, camera"
    )
    birdseye: BirdseyeConfig = Field(default=BirdseyeConfig(), description="binary descriptors of LiDAR submaps")
    own_places: OwnPlacesConfig = Field(
        default=OwnPlacesConfig(), description="place recognition on the robot, among its own LiDAR places"
    )
    views: ViewsConfig = Field(default=ViewsConfig(), description="binary descriptors of camera images")


class RobotSession:
    """Turns sensor records into numbered packets; the poses of all scans stay on the robot."""

    def __init__(
        self, robot: str, epoch: int, time: float, view_extractor: ViewExtractor, config: SessionConfig
    ) -> None:
        """``epoch`` counts the robot's sessions; no packet has a ``time`` before ``time``."""
        self.robot = robot
        self.epoch = epoch
        self.time = time
        """The largest stamp so far."""
        self.scan_poses: list[ScanPose] = []
        self._own_places = OwnPlaces(config.own_places, config.birdseye)
        self.mapper = Mapper(robot, config.lidar, self._own_places)
        self._config = config
        self._view_extractor = view_extractor
        self._views: list[CameraView] = []
        """Views that wait until the submap around them is complete."""
        self._submaps: dict[int, tuple[int, int]] = {}
        """By keyscan of a camera place: first and last keyscan of the submap that it was sent with."""
        self._described: set[tuple[int, str]] = set()
        """Keyscan and detector version of every camera place that was sent."""
        self._announced: Hello | None = None
        """The last hello."""
        self._sequence = 0

    def process_scan(self, scan: LaserScan, tracking: TrackingResult | None = None) -> list[Packet]:
        """Process the next scan, with its result of ``Mapper.localize`` if that was called; returns its packets."""
        self.time = max(self.time, scan.stamp)
        step = self.mapper.process(scan, tracking)
        announcement = self._announcement()
        self.scan_poses.append(step.pose)
        self._view_extractor.set_scan(scan, step.pose)
        return self._packets([*announcement, *self._bodies(step)])

    def process_image(self, image: CameraImage) -> None:
        """Describe an image and keep the view until the submap around it is complete."""
        view = self._view_extractor.describe(image)
        if view is not None:
            self._views.append(view)

    def finish(self) -> list[Packet]:
        """End the session; returns the packets of open submaps."""
        announcement, rest = self._announcement(), self.mapper.finish()
        last = rest[-1:]
        bodies = [body for submap in rest for body in self._submap_bodies(submap, submap in last)]
        return self._packets([*announcement, *bodies])

    def _bodies(self, step: Step) -> list[Body]:
        bodies: list[Body] = []
        if step.keyscan is not None:
            bodies.append(step.keyscan)
        if step.odometry is not None:
            bodies.append(step.odometry)
        if step.submap is not None:
            bodies += self._submap_bodies(step.submap)
        return bodies

    def _submap_bodies(self, submap: FinishedSubmap, at_end: bool = False) -> list[Body]:
        """Closures of a submap within this robot, its LiDAR place, and the camera places up to its anchor."""
        bodies: list[Body] = list(submap.closures)
        if Channel.LIDAR in self._config.channels:
            bodies.append(self._lidar_place(submap))
        complete = [view for view in self._views if at_end or view.keyscan <= submap.anchor]
        self._views = self._views[len(complete) :]
        # A view outside of every submap is no place: the robot may have jumped between two scans.
        shown = [view for view in complete if submap.first <= view.keyscan <= submap.last]
        self._submaps |= {view.keyscan: (submap.first, submap.last) for view in shown}
        return [*bodies, *(self._camera_place(view) for view in shown)]

    def _announcement(self) -> list[Body]:
        """A hello at the start and if there is one more laser or another detector, then the camera places that this
        detector describes again."""
        hello, before = self._hello(), self._announced
        if not hello.lasers or hello == before:
            return []
        self._announced = hello
        if before is not None and hello.detector_versions == before.detector_versions:
            return [hello]
        views = {view.keyscan: view for view in self._view_extractor.describe_again()} if self._submaps else {}
        self._views = [views.get(view.keyscan, view) for view in self._views]
        sent = [view for view in views.values() if view.keyscan in self._submaps]
        fresh = [view for view in sent if (view.keyscan, view.detector_version) not in self._described]
        return [hello, *(self._camera_place(view) for view in fresh)]

    def _lidar_place(self, submap: FinishedSubmap) -> Place:
        features = self._own_places.features(submap.anchor)
        return Place(
            KeyscanId(self.robot, submap.anchor), Channel.LIDAR, DETECTOR_VERSION, submap.first, submap.last,
            features.keypoints_m, features.descriptors,
        )  # fmt: skip

    def _camera_place(self, view: CameraView) -> Place:
        first, last = self._submaps[view.keyscan]
        self._described.add((view.keyscan, view.detector_version))
        return Place(
            KeyscanId(self.robot, view.keyscan), Channel.CAMERA, view.detector_version, first, last, view.keypoints,
            view.descriptors,
        )  # fmt: skip

    def _hello(self) -> Hello:
        versions = {Channel.LIDAR: DETECTOR_VERSION, Channel.CAMERA: self._view_extractor.detector_version}
        chosen = {channel: versions[channel] for channel in self._config.channels}
        return Hello(self.robot, self.epoch, self.mapper.lasers, chosen)

    def _packets(self, bodies: Iterable[Body]) -> list[Packet]:
        packets = []
        for body in bodies:
            packets.append(Packet(self.robot, self.epoch, self._sequence, self.time, body))
            self._sequence += 1
        return packets

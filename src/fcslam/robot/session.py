"""One session of a robot: from a start with odometry at zero to its end, or to where the robot was lost."""

from collections.abc import Iterable

from pydantic import Field

from fcslam.config import Settings
from fcslam.features.birdseye import DETECTOR_VERSION, BirdseyeConfig, describe
from fcslam.lidar.mapper import FinishedSubmap, LidarConfig, Mapper, ScanPose, Step
from fcslam.lidar.tracker import TrackingResult
from fcslam.records import CameraImage, Channel, KeyscanId, LaserModel, LaserScan, Place
from fcslam.robot.views import CameraView, ViewExtractor, ViewsConfig
from fcslam.wire.messages import Body, Hello, Packet


class SessionConfig(Settings):
    """What turns sensor records into packets."""

    lidar: LidarConfig = Field(default=LidarConfig(), description="LiDAR SLAM")
    channels: tuple[Channel, ...] = Field(
        default=tuple(Channel), min_length=1, description="what places are described by: lidar, camera"
    )
    birdseye: BirdseyeConfig = Field(default=BirdseyeConfig(), description="binary features of LiDAR submaps")
    views: ViewsConfig = Field(default=ViewsConfig(), description="binary features of camera images")


class RobotSession:
    """Turns sensor records into numbered packets; keeps every raw scan's pose for itself."""

    def __init__(
        self, robot: str, epoch: int, time: float, view_extractor: ViewExtractor, config: SessionConfig
    ) -> None:
        """``epoch`` counts the robot's sessions; packets bear no ``time`` before this."""
        self.robot = robot
        self.epoch = epoch
        self.time = time
        """The largest stamp so far."""
        self.scan_poses: list[ScanPose] = []
        self.mapper = Mapper(robot, config.lidar)
        self._config = config
        self._view_extractor = view_extractor
        self._views: list[CameraView] = []
        """Those that wait for the submap around them."""
        self._submaps: dict[int, tuple[int, int]] = {}
        """First and last keyscan of the submap that each camera place was sent with."""
        self._described: set[tuple[int, str]] = set()
        """Keyscans of camera places that were sent, with the version of the detector."""
        self._laser: LaserModel | None = None
        self._told: str | None = None
        """Version of the camera's detector in the last hello."""
        self._sequence = 0

    def process_scan(self, scan: LaserScan, tracking: TrackingResult | None = None) -> list[Packet]:
        """The packets that the next scan causes; ``tracking``: as the mapper saw it, if it has looked already."""
        self.time = max(self.time, scan.stamp)
        self._laser = scan.laser
        news = self._news()
        step = self.mapper.process(scan, tracking)
        self.scan_poses.append(step.pose)
        self._view_extractor.set_scan(scan, step.pose)
        return self._packets([*news, *self._bodies(step)])

    def process_image(self, image: CameraImage) -> None:
        """Keep what an image shows until the submap around it is complete."""
        view = self._view_extractor.describe(image)
        if view is not None:
            self._views.append(view)

    def finish(self) -> list[Packet]:
        """The packets of what is still open."""
        news, rest = self._news(), self.mapper.finish()
        last = rest[-1:]
        bodies = [body for submap in rest for body in self._submap_bodies(submap, submap in last)]
        return self._packets([*news, *bodies])

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
        """The robot's own closures to a submap, its LiDAR place, and the camera places on the way to its anchor."""
        bodies: list[Body] = list(submap.closures)
        if Channel.LIDAR in self._config.channels:
            bodies.append(self._lidar_place(submap))
        ripe = [view for view in self._views if at_end or view.keyscan <= submap.anchor]
        self._views = self._views[len(ripe) :]
        # Between two scans a robot may jump: a view whose surroundings no submap shows is no place.
        shown = [view for view in ripe if submap.first <= view.keyscan <= submap.last]
        self._submaps |= {view.keyscan: (submap.first, submap.last) for view in shown}
        return [*bodies, *(self._camera_place(view) for view in shown)]

    def _news(self) -> list[Body]:
        """A hello, first of all and with another detector; then the camera places that this had not described yet."""
        if self._laser is None or self._told == self._view_extractor.detector_version:
            return []
        self._told = self._view_extractor.detector_version
        views = {view.keyscan: view for view in self._view_extractor.describe_again()} if self._submaps else {}
        self._views = [views.get(view.keyscan, view) for view in self._views]
        sent = [view for view in views.values() if view.keyscan in self._submaps]
        fresh = [view for view in sent if (view.keyscan, view.detector_version) not in self._described]
        return [self._hello(self._laser), *(self._camera_place(view) for view in fresh)]

    def _lidar_place(self, submap: FinishedSubmap) -> Place:
        features = describe(submap.surface, self._config.birdseye)
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

    def _hello(self, laser: LaserModel) -> Hello:
        versions = {Channel.LIDAR: DETECTOR_VERSION, Channel.CAMERA: self._view_extractor.detector_version}
        return Hello(self.robot, self.epoch, laser, {channel: versions[channel] for channel in self._config.channels})

    def _packets(self, bodies: Iterable[Body]) -> list[Packet]:
        packets = []
        for body in bodies:
            packets.append(Packet(self.robot, self.epoch, self._sequence, self.time, body))
            self._sequence += 1
        return packets

"""One robot: sensor records in, packets out. It knows no network and no other robot."""

from collections.abc import Iterable
from dataclasses import replace

from pydantic import Field

from fcslam.config import Settings
from fcslam.features.birdseye import DETECTOR_VERSION, BirdseyeConfig, describe
from fcslam.lidar.mapper import FinishedSubmap, LidarConfig, Mapper, ScanPose, Step
from fcslam.records import Channel, KeyscanId, LaserScan, Place, SensorRecord
from fcslam.wire.messages import Body, Hello, Packet
from fcslam.wire.quantisation import dequantise, quantise


class RobotConfig(Settings):
    """What runs on a robot."""

    lidar: LidarConfig = Field(default=LidarConfig(), description="LiDAR SLAM")
    birdseye: BirdseyeConfig = Field(default=BirdseyeConfig(), description="binary features of LiDAR submaps")


class RobotFrontend:
    """Turns a robot's sensor records into the packets that leave it; keeps every raw scan's pose for itself."""

    def __init__(self, robot: str, config: RobotConfig) -> None:
        self.robot = robot
        self.scan_poses: list[ScanPose] = []
        self._config = config
        self._mapper = Mapper(robot, config.lidar)
        self._sequence = 0
        self._time = float("-inf")

    def process(self, record: SensorRecord) -> list[Packet]:
        """The packets that the next record of the recording causes."""
        if not isinstance(record, LaserScan):
            return []  # a scan brings its own odometry; images never leave the robot
        self._time = max(self._time, record.stamp)
        # The robot works with the ranges that the cloud will see, to the last bit.
        scan = replace(record, ranges_m=dequantise(quantise(record.ranges_m)))
        hello = [] if self.scan_poses else [self._hello(scan)]
        step = self._mapper.process(scan)
        self.scan_poses.append(step.pose)
        return self._packets([*hello, *self._bodies(step)])

    def finish(self) -> list[Packet]:
        """The packets of what was still open when the recording ended."""
        return self._packets([body for submap in self._mapper.finish() for body in self._submap_bodies(submap)])

    def _bodies(self, step: Step) -> list[Body]:
        bodies: list[Body] = []
        if step.keyscan is not None:
            bodies.append(step.keyscan)
        if step.odometry is not None:
            bodies.append(step.odometry)
        if step.submap is not None:
            bodies += self._submap_bodies(step.submap)
        return bodies

    def _submap_bodies(self, submap: FinishedSubmap) -> list[Body]:
        """A LiDAR place and the robot's own closures to it."""
        features = describe(submap.surface, self._config.birdseye)
        place = Place(
            KeyscanId(self.robot, submap.anchor), Channel.LIDAR, DETECTOR_VERSION, submap.first, submap.last,
            features.keypoints_m, features.descriptors,
        )  # fmt: skip
        return [*submap.closures, place]

    def _hello(self, scan: LaserScan) -> Hello:
        return Hello(self.robot, 0, scan.laser, {Channel.LIDAR: DETECTOR_VERSION})

    def _packets(self, bodies: Iterable[Body]) -> list[Packet]:
        packets = []
        for body in bodies:
            packets.append(Packet(self.robot, 0, self._sequence, self._time, body))
            self._sequence += 1
        return packets

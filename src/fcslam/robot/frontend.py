"""One robot: sensor records in, packets out. It knows no network and no other robot.

While what the robot sees is doubtful (``fcslam.lidar.lost``), records are put by. Either they turn out to belong to
what came before, and are processed as if nothing had been; or the robot is lost: its session ends where it last knew
where it was, and a new one begins with them, as after a restart. So no motion that nobody measured enters a map.
"""

from dataclasses import replace
from pathlib import Path

from pydantic import Field

from fcslam.errors import FeatureError
from fcslam.lidar.lost import LostConfig, can_decide, is_doubtful, is_lost
from fcslam.lidar.mapper import ScanPose
from fcslam.records import CameraImage, Channel, DetectorFile, FloatArray, LaserScan, SensorRecord
from fcslam.robot.session import RobotSession, SessionConfig
from fcslam.robot.views import ViewExtractor
from fcslam.wire.messages import Packet
from fcslam.wire.quantisation import dequantise, quantise


class RobotConfig(SessionConfig):
    """What runs on a robot."""

    lost: LostConfig = Field(default=LostConfig(), description="when the robot is lost, and begins anew")


class RobotFrontend:
    """Turns a robot's sensor records into the packets that leave it; keeps every raw scan's pose for itself.

    Packets bear the number of their session, from 0, as their epoch.
    """

    def __init__(self, robot: str, config: RobotConfig) -> None:
        self.robot = robot
        self.tracks: list[list[ScanPose]] = []
        """Poses of the scans of every session."""
        self._config = config
        self._view_extractor = ViewExtractor(config.views)
        self._put_by: list[LaserScan | CameraImage] = []
        """From the first scan on that is doubtful."""
        self._T_local_doubted: FloatArray | None = None
        """Where that seems to have been taken."""
        self._session = self._begin(float("-inf"))

    @property
    def scan_poses(self) -> list[ScanPose]:
        """Poses of the scans of the session that runs."""
        return self.tracks[-1]

    def process(self, record: SensorRecord) -> list[Packet]:
        """The packets that the next record of the recording causes."""
        match record:
            case LaserScan():
                # The robot works with the ranges that the cloud will see, to the last bit.
                return self._process_scan(replace(record, ranges_m=dequantise(quantise(record.ranges_m))))
            case CameraImage() if Channel.CAMERA in self._config.channels and self._put_by:
                self._put_by.append(record)
            case CameraImage() if Channel.CAMERA in self._config.channels:
                self._session.process_image(record)
        return []  # a scan brings its own odometry; images never leave the robot

    def set_detector(self, file: DetectorFile, path: Path) -> None:
        """Describe camera images by another network from now on, and, with the next scan, those that are still here.

        Args:
            file: as the cloud announced it.
            path: where it was fetched to.

        Raises:
            FeatureError: it is not that file, cannot be used, or this robot has no use for it; nothing has changed.
        """
        if file.channel is not Channel.CAMERA or file.channel not in self._config.channels:
            raise FeatureError(f"{file.version}: describes {file.channel} places; this robot takes none for those")
        if file.version != self._view_extractor.detector_version:
            self._view_extractor.set_detector(file, path)

    def finish(self) -> list[Packet]:
        """The packets of what was still open when the recording ended."""
        return [*self._go_on(), *self._session.finish()]

    def _process_scan(self, scan: LaserScan) -> list[Packet]:
        mapper, config = self._session.mapper, self._config.lost
        tracking = mapper.localize(scan)
        if not is_doubtful(tracking, mapper, config):
            if self._put_by:
                return [*self._go_on(), *self._session.process_scan(scan)]
            return self._session.process_scan(scan, tracking)
        if self._T_local_doubted is None:
            self._T_local_doubted = tracking.tracked.T_local_base
        self._put_by.append(scan)
        scans = [record for record in self._put_by if isinstance(record, LaserScan)]
        if not can_decide(scans, config):
            return []
        if not is_lost(scans, self._T_local_doubted, mapper, config):
            return self._go_on()
        rest = self._session.finish()
        self._view_extractor.reset()
        self._session = self._begin(self._session.time)
        return [*rest, *self._go_on()]

    def _begin(self, time: float) -> RobotSession:
        session = RobotSession(self.robot, len(self.tracks), time, self._view_extractor, self._config)
        self.tracks.append(session.scan_poses)
        return session

    def _go_on(self) -> list[Packet]:
        """With what was put by."""
        records, self._put_by, self._T_local_doubted = self._put_by, [], None
        packets: list[Packet] = []
        for record in records:
            if isinstance(record, LaserScan):
                packets += self._session.process_scan(record)
            else:
                self._session.process_image(record)
        return packets

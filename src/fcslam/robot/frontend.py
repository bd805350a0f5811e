"""The front end of one robot: sensor records in, packets out. It knows no network and no other robot.

While scans are doubtful (``fcslam.lidar.lost``), records are deferred. If they show the same place as before, they are
processed normally. If they show another place, the robot is lost: its session ends before the doubtful scans, and a new
one begins with them, as after a restart. So no unmeasured motion enters a map.
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
    """Settings of one robot."""

    lost: LostConfig = Field(default=LostConfig(), description="when the robot is lost and starts a new session")


class RobotFrontend:
    """Turns the sensor records of a robot into packets; the poses of all scans stay on the robot.

    The epoch of a packet is the number of its session, from 0.
    """

    def __init__(self, robot: str, config: RobotConfig) -> None:
        self.robot = robot
        self.tracks: list[list[ScanPose]] = []
        """Poses of the scans, by session."""
        self._config = config
        self._view_extractor = ViewExtractor(config.views)
        self._deferred: list[LaserScan | CameraImage] = []
        """Records since the first doubtful scan."""
        self._T_local_deferred: FloatArray | None = None
        """Pose of the first doubtful scan in the local frame, as it was matched, shape (3,)."""
        self._session = self._begin(float("-inf"))

    @property
    def scan_poses(self) -> list[ScanPose]:
        """Poses of the scans of the present session."""
        return self.tracks[-1]

    def process(self, record: SensorRecord) -> list[Packet]:
        """Process the next record of the recording; returns its packets."""
        match record:
            case LaserScan():
                # The robot maps with the quantised ranges, so robot and cloud see the same numbers.
                return self._process_scan(replace(record, ranges_m=dequantise(quantise(record.ranges_m))))
            case CameraImage() if Channel.CAMERA in self._config.channels and self._deferred:
                self._deferred.append(record)
            case CameraImage() if Channel.CAMERA in self._config.channels:
                self._session.process_image(record)
        return []  # scans carry their odometry; images never leave the robot

    def set_detector(self, file: DetectorFile, path: Path) -> None:
        """Use another network for camera images from now on; the next scan describes buffered images again.

        Args:
            file: the detector as the cloud announced it.
            path: the downloaded file.

        Raises:
            FeatureError: the file is not the announced one, cannot be used, or describes a channel that this robot does
                not use; nothing has changed.
        """
        if file.channel is not Channel.CAMERA or file.channel not in self._config.channels:
            raise FeatureError(f"{file.version}: describes {file.channel} places; this robot takes none for those")
        if file.version != self._view_extractor.detector_version:
            self._view_extractor.set_detector(file, path)

    def finish(self) -> list[Packet]:
        """End the recording; returns the packets of open submaps."""
        return [*self._process_deferred(), *self._session.finish()]

    def _process_scan(self, scan: LaserScan) -> list[Packet]:
        mapper, config = self._session.mapper, self._config.lost
        # 1. Localize the scan; unless it is doubtful, process it.
        tracking = mapper.localize(scan)
        if not is_doubtful(tracking, mapper, config):
            if self._deferred:
                return [*self._process_deferred(), *self._session.process_scan(scan)]
            return self._session.process_scan(scan, tracking)
        # 2. Defer a doubtful scan until there are enough of them for a decision.
        if self._T_local_deferred is None:
            self._T_local_deferred = tracking.tracked.T_local_base
        self._deferred.append(scan)
        scans = [record for record in self._deferred if isinstance(record, LaserScan)]
        if not can_decide(scans, config):
            return []
        # 3. Same place: process them. Another place: the robot is lost, and a new session begins with them.
        if not is_lost(scans, self._T_local_deferred, mapper, config):
            return self._process_deferred()
        rest = self._session.finish()
        self._view_extractor.reset()
        self._session = self._begin(self._session.time)
        return [*rest, *self._process_deferred()]

    def _begin(self, time: float) -> RobotSession:
        session = RobotSession(self.robot, len(self.tracks), time, self._view_extractor, self._config)
        self.tracks.append(session.scan_poses)
        return session

    def _process_deferred(self) -> list[Packet]:
        """Process the deferred records normally."""
        records, self._deferred, self._T_local_deferred = self._deferred, [], None
        packets: list[Packet] = []
        for record in records:
            if isinstance(record, LaserScan):
                packets += self._session.process_scan(record)
            else:
                self._session.process_image(record)
        return packets

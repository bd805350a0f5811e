"""The front end of one robot: sensor records in, packets out. It knows no network and no other robot.

It localizes every scan at once. Everything else is the work of the back end (``fcslam.robot.backend``), which may run
beside it: packets then come out later, but in the same order and with the same contents.

While scans are doubtful (``DeferredScans``), records are deferred. If they show the same place as before,
they are mapped normally. If they show another place, the robot is lost: its session ends before the doubtful scans, and
a new one begins with them, as after a restart. So no unmeasured motion enters a map. After a ride in a lift
(``fcslam.lidar.lifts``), the new session is on a floor without a name: the cloud finds out whether it knows this one.
"""

import math
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import Field

from fcslam.geometry import se2
from fcslam.lidar.frontend import ScanPose, motion_information
from fcslam.lidar.lost import LostConfig, has_moved_unseen
from fcslam.lidar.odometry import OdometryModel
from fcslam.lidar.tracker import TrackedScan, TrackingResult
from fcslam.records import CameraImage, DetectorFile, FloatArray, GnssFix, LaserScan, SensorRecord
from fcslam.robot.backend import BackendInput, NewDetector, RobotBackend, SessionConfig, Task
from fcslam.robot.backend_runner import Submit, inline
from fcslam.robot.mapped_scans import MappedScans
from fcslam.robot.packet_queue import PacketQueue
from fcslam.robot.predicted_motion import PredictedMotion
from fcslam.robot.session import DeferredScans, Motion, Outcome, Session
from fcslam.robot.track import ScanBelief, ScanTrack
from fcslam.robot.wheel_odometry import WheelOdometry
from fcslam.sources.contradictions import RepeatedScans
from fcslam.sources.gate import is_clock_step
from fcslam.wire.messages import Body, Packet

MOST_FIXES = 100
"""Fixes of satellite navigation that wait for a scan; older ones are dropped."""


class RobotConfig(SessionConfig):
    """Settings of one robot."""

    lost: LostConfig = Field(default=LostConfig(), description="when the robot is lost and starts a new session")

    @property
    def unused_in_space(self) -> str:
        """Which settings do nothing for a robot with a 3D LiDAR, one line; empty if those have their defaults."""
        planar = ("lidar.scan_duration_s", "lidar.tracker", "lidar.keyscans", "views", "tags", "lost")
        unused = [f"robot.{name}" for name in planar if attrgetter(name)(self) != attrgetter(name)(RobotConfig())]
        return f"{', '.join(unused)}: only robots with 2D LiDARs use these settings" if unused else ""


class NewestScan(NamedTuple):
    """The tracker's result for the newest scan."""

    pose: ScanPose
    tracked: TrackedScan
    quality: float
    """Share of the points in known area that lie on a surface; NaN if the scan was not matched."""
    is_deferred: bool
    """Whether it waits for the decision whether the robot is lost."""


class RobotFrontend:
    """Turns the sensor records of a robot into packets; the poses of all scans stay on the robot.

    The epoch of a packet is the number of its session, from 0.
    """

    scans = LaserScan
    """Records that have a pose."""

    def __init__(
        self,
        robot: str,
        config: RobotConfig,
        backend: Submit | None = None,
        mark: Callable[[LaserScan], LaserScan] = lambda scan: scan,
    ) -> None:
        """Start the first session.

        ``backend`` runs the back end beside this; None: inline. ``mark`` marks beams on other robots before a match.
        """
        self.robot = robot
        self.tracks: list[ScanTrack] = []
        """Poses of the scans, by session."""
        self.odometry = WheelOdometry()
        self._motion: Motion = self.odometry
        """Source of the motion in the sessions from the next one on."""
        self.packets = PacketQueue(robot, backend or inline(RobotBackend(robot, config)))
        self.newest: NewestScan | None = None
        self._config, self._mark = config, mark
        self._repeated = RepeatedScans()
        self._mapped = MappedScans(config.lidar.ignore, config.lidar.footprint)
        self._fixes: deque[GnssFix] = deque(maxlen=MOST_FIXES)
        self._deferred = DeferredScans(config.lost)
        self._before: LaserScan | None = None
        """The newest scan, mapped or not; None if the next one is of another place."""
        self._before_s = (float("-inf"), float("-inf"))
        """Stamps of the two newest scans."""
        self._begin(ScanTrack(is_new_floor=True))

    @property
    def scan_poses(self) -> ScanTrack:
        """Poses of the scans of the present session."""
        return self._session.poses

    @property
    def motion(self) -> Motion:
        """The motion of the present session: the odometry, or a prediction in its place."""
        return self._session.motion

    @property
    def belief(self) -> ScanBelief:
        """Pose and covariance of the newest scan."""
        assert self.newest is not None
        pose, tracked, _, _ = self.newest
        points = None if tracked.scan is None else tracked.information
        return ScanBelief(points, partial(_covariance, pose.T_keyscan_base, tracked, self.motion.model))

    @property
    def lacks_odometry(self) -> bool:
        """Whether scan matching alone gives the motion."""
        return self.motion is not self.odometry

    @property
    def odometry_fault(self) -> str | None:
        """Why the odometry does not count, as the end of a sentence."""
        return self.odometry.check.fault

    @property
    def travel_m(self) -> float:
        """Path length of the present session up to its newest keyscan, metres; turns count a little."""
        return self._session.lidar.travel_m

    @property
    def jumps(self) -> int:
        """Jumps of the odometry that were bridged."""
        return self.odometry.jumps

    def process(self, record: SensorRecord) -> list[Packet]:
        """Process the next record of the recording; returns the packets that are ready."""
        match record:
            case LaserScan():
                self._begin_where_unconnected(record)
                if self._repeated.admits(record):
                    if self._motion is self.odometry and self.odometry.check.says_nothing(record):
                        self._begin_without_odometry()
                    scan = self._session.place(record, self._before)
                    self._process_scan(self._mark(self._mapped.of(scan)))
            case CameraImage() if self._config.uses_images:
                image = self.motion.place_image(record)
                if self._deferred:
                    self._deferred.records.append(image)
                else:
                    self._describe(image)
            case GnssFix():
                self._fixes.append(record)
        return self.ready()  # scans carry their odometry; images never leave the robot

    def ready(self, wait: bool = False) -> list[Packet]:
        """The next packets, without those that the back end still works on, or after it has handled everything."""
        return self.packets.ready(wait)

    def set_detector(self, file: DetectorFile, path: Path) -> "Future[list[Body]]":
        """Use a network that the cloud announced for camera images from now on; it describes buffered images again.

        Done when the back end uses it, or refuses it with the ``FeatureError`` of ``RobotBackend.process``.
        """
        return self._submit(NewDetector(file, path))

    def place_keyframes(self) -> None:
        """Have the back end write where the keyframes are, if it keeps them."""
        self._submit(Task.PLACE_KEYFRAMES)

    def change_floor(self, floor: str) -> None:
        """Go on in a new session on another floor, 1 to 16 letters, digits and ``. _ + -``; empty: without a name."""
        if floor != self.scan_poses.floor:
            if len(self.scan_poses) or self._deferred:
                self.begin_session()
            self.scan_poses.floor, self.scan_poses.is_new_floor = floor, True

    def begin_session(self) -> None:
        """End the present session and begin another: the next scan is of another place, as after a ride in a lift."""
        self._end_deferral()
        if self.newest is None:
            self._begin(self.tracks.pop())
        else:
            self._end_session()
        self._before = None

    def finish(self) -> list[Packet]:
        """End the recording; returns all packets that are left."""
        self._end_deferral()
        self._submit(Task.END_SESSION)
        return self.ready(wait=True)

    def _begin_where_unconnected(self, scan: LaserScan) -> None:
        if scan.new_floor:
            self.change_floor(scan.new_floor)
        if is_clock_step(self._before_s, scan.stamp):
            if self._motion is not self.odometry:
                self._motion = PredictedMotion()
            self.begin_session()
        self._before_s = self._before_s[1], scan.stamp

    def _begin_without_odometry(self) -> None:
        self._motion, held = PredictedMotion(), []
        if self.odometry.check.may_be_frozen:
            self.scan_poses.cut(self.odometry.check.certain_s)
            held = self._deferred.take()
        self.begin_session()
        for record in held:
            if isinstance(record, LaserScan):
                self._process_scan(self._session.place(record, None))
            else:
                self._describe(self.motion.place_image(record))

    def _process_scan(self, scan: LaserScan) -> None:
        motion = self.motion
        if isinstance(motion, PredictedMotion) and motion.awaits_second(scan):
            if not self._deferred:  # the second scan shows the motion during this one
                tracked = TrackedScan(np.zeros(3), np.zeros((3, 3)), None, scan.sweep)
                self.newest = NewestScan(ScanPose(scan.stamp, 0, se2.IDENTITY), tracked, math.nan, is_deferred=True)
                self._before = scan
                self._deferred.records.append(scan)
                return
            scan = motion.begin(self._deferred.records, scan)
            self._map_deferred()
        scan = self._bridge_gap(scan)
        self._deferred.watch_cabin(scan, self._session)
        deskewed, tracking = self._session.track(scan)
        if self._deferred.is_doubtful(tracking, self._session):
            self._defer(scan, tracking)
        else:
            if self._deferred:
                self._map_deferred()
                tracking = self._session.lidar.localize(deskewed)
            self._map(deskewed, tracking)
        if self.newest is not None and not self._deferred:
            self._session.observe(scan.stamp, self.newest.pose, self.newest.tracked)

    def _bridge_gap(self, scan: LaserScan) -> LaserScan:
        """The scan; where nothing shows the motion to it, it begins a session, or is predicted and doubtful."""
        before, self._before = self._before, scan
        if before is None:
            return scan
        if has_moved_unseen(before, scan):
            self._end_deferral()
            self._end_session()
        elif self._deferred.follows_gap(before, scan, self._session):
            self._end_deferral()
            scan = self._session.place(scan, before)  # the frame of the predictions may have moved
            self._deferred.gap_s = scan.stamp - before.stamp
        return scan

    def _defer(self, scan: LaserScan, tracking: TrackingResult) -> None:
        self._deferred.records.append(self._session.follow(self._deferred.records, scan, tracking))
        pose = self._session.lidar.scan_pose(scan.stamp, tracking.tracked)
        self.newest = NewestScan(pose, tracking.tracked, tracking.quality, is_deferred=True)
        if self._deferred.can_decide(self._session):
            self._decide()

    def _decide(self) -> None:
        match self._deferred.decide(self._session):
            case Outcome.SAME_PLACE_OTHER_MAP:
                self._session.lidar.begin_local_map()
            case Outcome.OTHER_PLACE:
                self._end_session()
            case Outcome.OTHER_FLOOR:
                self._end_session()
                self.scan_poses.floor, self.scan_poses.is_new_floor = "", True
        self._deferred.cabin.leave()
        self._map_deferred()

    def _end_deferral(self) -> None:
        """Map the deferred records before there are enough of them for a decision; decide after a gap."""
        if self._deferred.must_decide:
            self._decide()
        else:
            self._map_deferred()

    def _map_deferred(self) -> None:
        for record in self._deferred.take():
            if isinstance(record, LaserScan):
                self._map(record, self._session.lidar.localize(record))
            else:
                self._describe(record)

    def _map(self, scan: LaserScan, tracking: TrackingResult) -> None:
        self.packets.advance(scan.stamp)
        due = [fix for fix in self._fixes if fix.stamp <= scan.stamp]
        for fix in due:
            self._fixes.remove(fix)
        pose, inputs = self._session.map(scan, tracking, due)
        for input in inputs:
            self._submit(input)
        self.newest = NewestScan(pose, tracking.tracked, tracking.quality, is_deferred=False)

    def _describe(self, image: CameraImage) -> None:
        view = self._session.view(image)
        if view is not None:
            self._submit(view)

    def _end_session(self) -> None:
        self._submit(Task.END_SESSION)
        self._begin(ScanTrack(self.scan_poses.floor))

    def _begin(self, track: ScanTrack) -> None:
        self._session = Session(self.robot, len(self.tracks), self._config.lidar, self._motion, track)
        self._deferred.cabin.leave()
        self.tracks.append(track)

    def _submit(self, input: BackendInput) -> "Future[list[Body]]":
        return self.packets.submit(input, self._session.epoch, self.scan_poses)


def _covariance(motion: FloatArray, tracked: TrackedScan, odometry: OdometryModel) -> FloatArray:
    return np.asarray(np.linalg.inv(motion_information(motion, tracked, odometry)), np.float64)

"""One session of a robot: everything that is tied together by measured motion, and the scans that may not be.

A robot defers its records while its scans are doubtful, for one of four reasons: its odometry may be frozen, there was
a gap without odometry, it leaves a closed cabin, or the map does not explain the scans (``fcslam.lidar.lost``). Once
there are enough of them, they are compared with the map, and an ``Outcome`` says how to go on.
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from enum import Enum, auto
from functools import partial

import numpy as np

from fcslam.geometry import se2
from fcslam.lidar.first_motion import LONGEST_GAP_S
from fcslam.lidar.frontend import LidarConfig, LidarFrontend, ScanPose
from fcslam.lidar.lifts import LEAVING_M, LEAVING_SCANS, Cabin
from fcslam.lidar.lost import (
    DOUBTFUL_TRAVEL_M,
    GAP_TRAVEL_M,
    MOST_SCANS,
    SETTLED_M,
    LostConfig,
    can_decide,
    drove_on,
    is_doubtful,
    is_lost,
)
from fcslam.lidar.tracker import DOUBTFUL, TrackedScan, TrackingResult
from fcslam.records import CameraImage, FloatArray, GnssFix, KeyscanFix, KeyscanId, LaserScan, Sweep
from fcslam.robot.backend import BackendInput, NewImage, NewKeyscan
from fcslam.robot.predicted_motion import Deferred, PredictedMotion, scans_of
from fcslam.robot.track import ScanTrack
from fcslam.robot.wheel_odometry import WheelOdometry, moving_on

LATE_S = 0.5
"""Largest time between a fix and the scan whose pose it measures."""


Motion = WheelOdometry | PredictedMotion
"""How a robot moves up to each scan and during it."""


class Session:
    """Tracks and maps the scans of one session, and keeps the newest of them."""

    def __init__(self, robot: str, epoch: int, config: LidarConfig, motion: Motion, poses: ScanTrack) -> None:
        self.epoch, self.motion, self.poses = epoch, motion, poses
        self.lidar = LidarFrontend(robot, config, motion.model)
        self.newest: tuple[LaserScan, ScanPose] | None = None
        """The newest scan that was mapped."""
        self._explained: dict[tuple[float, float, float], LaserScan] = {}
        """The newest scan of each laser that the map explained, by its mounting."""
        self._jumps = 0
        """Jumps of the odometry up to the newest scan that was mapped."""
        self._scans: dict[tuple[float, float, float], LaserScan] = {}
        """The newest scan of each laser, by its mounting."""
        self._fixed = -1  # newest keyscan with a fix

    def place(self, scan: LaserScan, before: LaserScan | None) -> LaserScan:
        """The next scan with its pose and velocity by odometry or prediction; ``before`` is the one before it."""
        duration_s = self.lidar.config.scan_duration_s
        if scan.sweep is None and duration_s > 0.0:
            scan = replace(scan, sweep=Sweep(0.0, duration_s))
            if before is not None and self.motion.model.is_measured:
                scan = moving_on(scan, before)
        return self.motion.place(scan)

    def track(self, scan: LaserScan) -> tuple[LaserScan, TrackingResult]:
        """Localize a scan; returns it as it was deskewed, too."""
        if isinstance(self.motion, WheelOdometry):
            return scan, self.lidar.localize(scan)
        return self.motion.track(scan, self.lidar, partial(self._in_odom, scan.stamp))

    def observe(self, stamp: float, pose: ScanPose, tracked: TrackedScan) -> None:
        """Continue a prediction from where the scan at ``stamp`` was found; odometry does not depend on that."""
        if isinstance(self.motion, PredictedMotion):
            self.motion.observe(stamp, self.poses.in_odom(pose), tracked)

    def follow(self, deferred: Deferred, scan: LaserScan, tracking: TrackingResult) -> LaserScan:
        """The next doubtful scan with its motion since those before it."""
        if isinstance(self.motion, WheelOdometry):
            return scan
        return self.motion.follow(deferred, scan, tracking.tracked, self.lidar, partial(self._in_odom, scan.stamp))

    def drove_on(self, scans: list[LaserScan]) -> bool:
        """Whether odometry without a jump and the scans agree that the robot drove to where doubtful scans are."""
        is_measured = self.motion.model.is_measured and self.motion.jumps == self._jumps
        return is_measured and drove_on(self._explained, scans, self.lidar.odometry, self.lidar.tracker.trust)

    def map(
        self, scan: LaserScan, tracking: TrackingResult, fixes: Iterable[GnssFix]
    ) -> tuple[ScanPose, list[BackendInput]]:
        """Continue from a localized scan; returns its pose, the keyscan that it becomes, and the fixes of keyscans."""
        pose, keyscan = self.lidar.process(scan, tracking)
        inputs: list[BackendInput] = []
        if keyscan is not None:
            if keyscan.odometry is not None:
                self.poses.extend(keyscan.odometry.T_i_j)
            inputs.append(NewKeyscan(keyscan, self.lidar.lasers))
        self.poses.add(pose)
        inputs.extend(self._keyscan_fixes(pose, fixes))
        self.newest = scan, pose
        self._scans[scan.laser.T_base_laser] = scan
        if tracking.explained >= DOUBTFUL * tracking.known:  # false if it was not matched
            self._explained[scan.laser.T_base_laser] = scan
        self._jumps = self.motion.jumps
        return pose, inputs

    def view(self, image: CameraImage) -> NewImage | None:
        """An image with the newest scans; None before the first scan."""
        return None if self.newest is None else NewImage(image, *self.newest, tuple(self._scans.values()))

    def _in_odom(self, stamp: float, tracked: TrackedScan) -> FloatArray:
        return self.poses.in_odom(self.lidar.scan_pose(stamp, tracked))

    def _keyscan_fixes(self, pose: ScanPose, fixes: Iterable[GnssFix]) -> Iterator[KeyscanFix]:
        """Each fix with the keyscan of the scan next to it, at most one for each keyscan."""
        poses = (pose,) if self.newest is None else (self.newest[1], pose)
        for fix in fixes:
            nearest = min(poses, key=lambda pose: abs(pose.stamp - fix.stamp))
            if abs(nearest.stamp - fix.stamp) > LATE_S or nearest.keyscan <= self._fixed:
                continue
            self._fixed = nearest.keyscan
            x, y = se2.transform(nearest.T_keyscan_base, np.array([fix.antenna_xy]))[0].tolist()
            keyscan = KeyscanId(self.lidar.robot, nearest.keyscan)
            yield KeyscanFix(keyscan, fix.latitude_deg, fix.longitude_deg, fix.altitude_m, fix.sigma_m, (x, y))


class Outcome(Enum):
    """What doubtful scans show."""

    SAME_PLACE = auto()
    SAME_PLACE_OTHER_MAP = auto()
    """The robot drove on, and its newest keyscans are wrong: another local map begins, tied to the past by odometry."""
    OTHER_PLACE = auto()
    """The robot is lost."""
    OTHER_FLOOR = auto()
    """The robot took a lift."""


class DeferredScans:
    """The records since the first doubtful scan."""

    def __init__(self, config: LostConfig) -> None:
        self._config = config
        self.records: Deferred = []
        self.gap_s = 0.0
        """Time before the first of them in which nothing shows the motion; 0: there was no gap."""
        self.cabin = Cabin()

    def __len__(self) -> int:
        return len(self.records)

    def follows_gap(self, before: LaserScan, scan: LaserScan, session: Session) -> bool:
        """Whether nothing shows the motion between two scans, and there is a map in which to look for the later one."""
        is_unseen = not session.motion.model.is_measured and scan.stamp - before.stamp > LONGEST_GAP_S
        return is_unseen and self._config.doubted > 0.0 and session.newest is not None

    def watch_cabin(self, scan: LaserScan, session: Session) -> None:
        """Follow the next scan in and out of a cabin, once something is known from before its door closed."""
        if session.lidar.settled_m < SETTLED_M:
            self.cabin.leave()
        else:
            self.cabin.add(scan)

    def is_doubtful(self, tracking: TrackingResult, session: Session) -> bool:
        """Whether a localized scan may show another place than those before it."""
        if session.motion.may_be_frozen or self.gap_s:
            return True
        return is_doubtful(tracking, session.lidar, self._config, self.cabin.is_leaving)

    def can_decide(self, session: Session) -> bool:
        """Whether there are enough scans to compare them with the map."""
        travel_m, most = GAP_TRAVEL_M if self.gap_s else DOUBTFUL_TRAVEL_M, MOST_SCANS
        if self.cabin.is_leaving:
            travel_m, most = LEAVING_M, LEAVING_SCANS
        return not session.motion.may_be_frozen and can_decide(scans_of(self.records), travel_m, most)

    @property
    def must_decide(self) -> bool:
        """Whether the scans are compared even if no more follow: only after a gap, if there are two."""
        return self.gap_s > 0.0 and len(scans_of(self.records)) > 1

    def decide(self, session: Session) -> Outcome:
        """Compare the scans with the newest keyscans of the session; scans that are found elsewhere are moved there."""
        lidar, gap_s, scans = session.lidar, self.gap_s, scans_of(self.records)
        if self.cabin.is_leaving and not gap_s:
            return Outcome.OTHER_FLOOR if is_lost(scans, lidar, self.cabin.closed_s) else Outcome.SAME_PLACE
        if not gap_s and is_lost(scans, lidar):
            return Outcome.SAME_PLACE_OTHER_MAP if session.drove_on(scans) else Outcome.OTHER_PLACE
        is_same = isinstance(session.motion, WheelOdometry) or session.motion.relocate(self.records, lidar, gap_s)
        return Outcome.SAME_PLACE if is_same else Outcome.OTHER_PLACE

    def take(self) -> Deferred:
        """End the deferral; returns the records."""
        records, self.records, self.gap_s = self.records, [], 0.0
        return records

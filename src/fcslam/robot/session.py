"""One session of a robot: everything that is tied together by measured motion."""

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from fcslam.geometry import se2
from fcslam.lidar.first_motion import LONGEST_GAP_S
from fcslam.lidar.frontend import LidarConfig, LidarFrontend, ScanPose
from fcslam.lidar.lost import drove_on
from fcslam.lidar.tracker import DOUBTFUL, TrackedScan, TrackingResult
from fcslam.records import CameraImage, FloatArray, GnssFix, KeyscanFix, KeyscanId, LaserScan, Sweep
from fcslam.robot.backend import BackendInput, NewImage, NewKeyscan
from fcslam.robot.predicted_motion import Deferred, PredictedMotion
from fcslam.robot.track import ScanTrack
from fcslam.robot.wheel_odometry import WheelOdometry, moving_on

LATE_S = 0.5
"""Largest time between a fix and the scan whose pose it measures."""
MOST_FIXES = 100
"""Fixes that wait for a scan; older ones are dropped."""


Motion = WheelOdometry | PredictedMotion
"""How a robot moves up to each scan and during it."""


class WaitingFixes:
    """Fixes of satellite navigation that wait for the next scan."""

    def __init__(self) -> None:
        self._fixes: deque[GnssFix] = deque(maxlen=MOST_FIXES)

    def add(self, fix: GnssFix) -> None:
        """Add the next fix."""
        self._fixes.append(fix)

    def until(self, stamp: float) -> list[GnssFix]:
        """Take the fixes up to a scan at ``stamp``, seconds."""
        due = [fix for fix in self._fixes if fix.stamp <= stamp]
        if due:
            self._fixes = deque((fix for fix in self._fixes if fix.stamp > stamp), maxlen=MOST_FIXES)
        return due


class Session:
    """Tracks and maps the scans of one session, and keeps the newest of them."""

    def __init__(self, robot: str, epoch: int, config: LidarConfig, motion: Motion, poses: ScanTrack) -> None:
        """Begin session number ``epoch`` of a robot; ``poses`` gets those of its scans."""
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
        self._fixed = -1
        """The newest keyscan with a fix."""

    def place(self, scan: LaserScan, before: LaserScan | None) -> LaserScan:
        """The next scan with its pose and velocity by odometry or prediction; ``before`` is the one before it."""
        duration_s = self.lidar.config.scan_duration_s
        if scan.sweep is None and duration_s > 0.0:
            scan = replace(scan, sweep=Sweep(0.0, duration_s))
            if before is not None and isinstance(self.motion, WheelOdometry):
                scan = moving_on(scan, before)
        return self.motion.place(scan)

    def track(self, scan: LaserScan) -> tuple[LaserScan, TrackingResult]:
        """Localize a scan; returns it as it was deskewed, too."""
        if isinstance(self.motion, PredictedMotion):
            return self.motion.track(scan, self.lidar, partial(self._in_odom, scan.stamp))
        return scan, self.lidar.localize(scan)

    def observe(self, stamp: float, pose: ScanPose, tracked: TrackedScan) -> None:
        """Continue the motion from where the scan at ``stamp`` was found."""
        if isinstance(self.motion, PredictedMotion):
            self.motion.observe(stamp, self.poses.in_odom(pose), tracked)

    def awaits_second(self, scan: LaserScan) -> bool:
        """Whether only a second scan shows the motion during this one."""
        return isinstance(self.motion, PredictedMotion) and self.motion.awaits_second(scan)

    def begin_motion(self, deferred: Deferred, second: LaserScan) -> LaserScan:
        """Give the first deferred scan the motion that the second one shows; returns this one, predicted from it."""
        return self.motion.begin(deferred, second) if isinstance(self.motion, PredictedMotion) else second

    def is_unseen(self, before: LaserScan, scan: LaserScan) -> bool:
        """Whether nothing shows the motion between two scans although there is a map."""
        is_predicted = isinstance(self.motion, PredictedMotion) and self.newest is not None
        return is_predicted and scan.stamp - before.stamp > LONGEST_GAP_S

    def follow(self, deferred: Deferred, scan: LaserScan, tracking: TrackingResult) -> LaserScan:
        """The next doubtful scan with its motion since those before it."""
        if not isinstance(self.motion, PredictedMotion):
            return scan
        return self.motion.follow(deferred, scan, tracking.tracked, self.lidar, partial(self._in_odom, scan.stamp))

    @property
    def may_be_frozen(self) -> bool:
        """Whether the odometry stands still although the newest scans have changed."""
        return isinstance(self.motion, WheelOdometry) and self.motion.check.may_be_frozen

    def drove_on(self, scans: Sequence[LaserScan]) -> bool:
        """Whether odometry without a jump and the scans agree that the robot drove to where doubtful scans are."""
        if isinstance(self.motion, PredictedMotion) or self.motion.jumps != self._jumps:
            return False
        return drove_on(self._explained, scans, self.lidar.odometry, self.lidar.trust)

    def relocate(self, deferred: Deferred, gap_s: float) -> bool:
        """Whether doubtful scans that do not contradict the map show the place before them; see ``PredictedMotion``."""
        return not isinstance(self.motion, PredictedMotion) or self.motion.relocate(deferred, self.lidar, gap_s)

    def map(self, scan: LaserScan, tracking: TrackingResult, fixes: Iterable[GnssFix]) -> list[BackendInput]:
        """Continue from a localized scan; returns the keyscan that it becomes, and the fixes of keyscans.

        Args:
            scan: the scan.
            tracking: where it was localized.
            fixes: those up to the scan.
        """
        step = self.lidar.process(scan, tracking)
        inputs: list[BackendInput] = []
        if step.keyscan is not None:
            if step.keyscan.odometry is not None:
                self.poses.extend(step.keyscan.odometry.T_i_j)
            inputs.append(NewKeyscan(step.keyscan, self.lidar.lasers))
        self.poses.add(step.pose)
        inputs.extend(self._keyscan_fixes(step.pose, fixes))
        self.newest = scan, step.pose
        self._scans[scan.laser.T_base_laser] = scan
        if tracking.explained >= DOUBTFUL * tracking.known:  # false if it was not matched
            self._explained[scan.laser.T_base_laser] = scan
        if not isinstance(self.motion, PredictedMotion):
            self._jumps = self.motion.jumps
        return inputs

    def view(self, image: CameraImage) -> NewImage | None:
        """An image with the newest scans; None before the first scan."""
        return None if self.newest is None else NewImage(image, *self.newest, tuple(self._scans.values()))

    def _in_odom(self, stamp: float, tracked: TrackedScan) -> FloatArray:
        """``T_odom_base`` of a localized scan, shape (3,), metres and radians."""
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

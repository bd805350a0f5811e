"""One session of a robot: everything that is tied together by measured motion."""

from collections import deque
from collections.abc import Iterable, Iterator

import numpy as np

from fcslam.geometry import se2
from fcslam.lidar.frontend import LidarConfig, LidarFrontend, ScanPose
from fcslam.lidar.odometry import OdometryModel
from fcslam.lidar.tracker import DOUBTFUL, TrackedScan, TrackingResult
from fcslam.records import CameraImage, FloatArray, GnssFix, KeyscanFix, KeyscanId, LaserScan
from fcslam.robot.backend import BackendInput, NewImage, NewKeyscan
from fcslam.robot.track import ScanTrack

LATE_S = 0.5
"""Largest time between a fix and the scan whose pose it measures."""
MOST_FIXES = 100
"""Fixes that wait for a scan; older ones are dropped."""


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
    """Maps the scans of one session and keeps the newest of them."""

    def __init__(self, robot: str, epoch: int, config: LidarConfig, odometry: OdometryModel, track: ScanTrack) -> None:
        """Begin session number ``epoch`` of a robot; ``track`` gets the poses of its scans."""
        self.epoch, self.track = epoch, track
        self.lidar = LidarFrontend(robot, config, odometry)
        self.newest: tuple[LaserScan, ScanPose] | None = None
        """The newest scan that was mapped."""
        self.explained: dict[tuple[float, float, float], LaserScan] = {}
        """The newest scan of each laser that the map explained, by its mounting."""
        self.jumps = 0
        """Jumps of the odometry up to the newest scan that was mapped."""
        self._scans: dict[tuple[float, float, float], LaserScan] = {}
        """The newest scan of each laser, by its mounting."""
        self._fixed = -1
        """The newest keyscan with a fix."""

    def in_odom(self, stamp: float, tracked: TrackedScan) -> FloatArray:
        """``T_odom_base`` of a localized scan, shape (3,), metres and radians."""
        return self.track.in_odom(self.lidar.scan_pose(stamp, tracked))

    def map(
        self, scan: LaserScan, tracking: TrackingResult, fixes: Iterable[GnssFix], jumps: int
    ) -> list[BackendInput]:
        """Continue from a localized scan; returns the keyscan that it becomes, and the fixes of keyscans.

        Args:
            scan: the scan.
            tracking: where it was localized.
            fixes: those up to the scan.
            jumps: jumps of the odometry up to the scan.
        """
        step = self.lidar.process(scan, tracking)
        inputs: list[BackendInput] = []
        if step.keyscan is not None:
            if step.keyscan.odometry is not None:
                self.track.extend(step.keyscan.odometry.T_i_j)
            inputs.append(NewKeyscan(step.keyscan, self.lidar.lasers))
        self.track.add(step.pose)
        inputs.extend(self._keyscan_fixes(step.pose, fixes))
        self.newest, self.jumps = (scan, step.pose), jumps
        self._scans[scan.laser.T_base_laser] = scan
        if tracking.explained >= DOUBTFUL * tracking.known:  # false if it was not matched
            self.explained[scan.laser.T_base_laser] = scan
        return inputs

    def view(self, image: CameraImage) -> NewImage | None:
        """An image with the newest scans; None before the first scan."""
        return None if self.newest is None else NewImage(image, *self.newest, tuple(self._scans.values()))

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

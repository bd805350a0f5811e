"""Odometry that no robot can have: a reading that jumps is bridged, so that scan matching goes on from where it was;
wheels that say nothing while the scans change are not used.
"""

import math
from dataclasses import replace

import numpy as np

from fcslam.geometry import se2
from fcslam.lidar.first_motion import LONGEST_GAP_S
from fcslam.lidar.odometry import WHEELS
from fcslam.records import CameraImage, CloudScan, FloatArray, LaserScan, frozen
from fcslam.sources.clouds_in_space import BAND_LASER
from fcslam.sources.contradictions import CHANGED, changed_share, stands_still
from fcslam.sources.faults import FEWEST
from fcslam.sources.path_summary import PathSummary

LEAST_BRIDGE_M, LEAST_BRIDGE_RAD = 0.02, 0.02
"""A bridge is at least such a motion: the tracker does not match the scans of a robot that stands still."""

WITHOUT_CLOCK_S = 2.0
"""Scans with equal stamps may be so far apart: some logs were recorded without a clock, a scan every two metres."""
LARGEST_SPEED_M_S, LARGEST_TURN_RAD_S = 5.0, 6.0
"""The fastest motion that wheel odometry may report between two scans; a faster one is a jump."""
SLACK_M, SLACK_RAD = 1.0, 1.5
"""Length and turn allowed to any step besides, metres and radians, as stamps may be wrong."""
SLIGHTLY_CHANGED = 0.1
"""Share of the beams that measure something else, of a robot that moved on a little."""
FROZEN = "stands still while the scans change"
"""Fault of odometry that measured the motion before."""


class WheelCheck:
    """Finds odometry that says nothing, from the beginning on or any more, while the scans change."""

    def __init__(self) -> None:
        self.fault: str | None = None
        """Why it is not odometry, as the end of a sentence; None if it can be."""
        self.certain_s = -math.inf
        """Stamp of the newest scan at which the odometry moved, or which measures what the scan at rest does."""
        self._at_rest: LaserScan | CloudScan | None = None
        """The first scan; once the odometry has said something, the first one where it now stands."""
        self._path = PathSummary()
        """Odometry until it says something."""
        self._changed = 0
        """Newest scans in a row that measure something else than the one at rest."""

    @property
    def may_be_frozen(self) -> bool:
        """Whether odometry that measured the motion before stands still, and the newest scan has changed."""
        return self._changed > 0 and self._path.says_something

    def says_nothing(self, scan: LaserScan | CloudScan) -> bool:
        """Whether the odometry up to the next scan says nothing while the scans change, or the first one has none."""
        if self._at_rest is None:
            self._at_rest = scan
            return bool(np.isnan(scan.T_odom_base).any())
        if not self._path.says_something:
            x, y, theta = scan.T_odom_base.tolist()
            self._path.add(scan.stamp, (x, y, theta))
        if self._path.says_something and not stands_still(self._at_rest, scan):
            self._at_rest, self._changed, self.certain_s = scan, 0, scan.stamp
            return False
        self._at_rest = before = _in_plane(self._at_rest)  # once
        now = _in_plane(scan)
        if now.laser == before.laser:
            share = changed_share(before.ranges_m, now.ranges_m, now.laser.max_range_m)
            self._changed = self._changed + 1 if share > CHANGED else 0
            if not share > SLIGHTLY_CHANGED:  # true for NaN
                self.certain_s = scan.stamp
        if self._changed >= FEWEST:
            self.fault = FROZEN if self._path.says_something else self._path.fault
        return self.fault is not None


class WheelOdometry:
    """Motion by wheel odometry. It moves the frame ``odom`` at every jump, so that odometry goes on as before it."""

    model = WHEELS

    def __init__(self) -> None:
        self.check = WheelCheck()
        """Whether it says anything."""
        self.jumps = 0
        """Number of jumps so far."""
        self._last: tuple[float, FloatArray] | None = None
        """Stamp and pose, as it was read, of the previous scan."""
        self._bridge: FloatArray | None = None
        """The present frame ``odom`` in the first one, shape (3,); None before the first jump."""
        self._motion: se2.Pose = (LEAST_BRIDGE_M, 0.0, 0.0)
        """The last motion between two scans of a robot that moved."""
        self._velocity = (0.0, 0.0, 0.0)
        """In the last sweep without a jump."""

    def place(self, scan: LaserScan) -> LaserScan:
        """The next scan, with its odometry free of jumps."""
        read = self._read(scan.stamp, scan.T_odom_base)
        scan = self._with_possible_sweep(scan)
        if self._bridge is None and read is scan.T_odom_base:
            return scan
        return replace(scan, T_odom_base=frozen(self.bridged(read)))

    def place_cloud(self, scan: CloudScan) -> CloudScan:
        """The next turn of a 3D LiDAR, with the readings of its wheels free of jumps; without those that say
        nothing."""
        if not len(scan.wheels):
            return scan
        wheels = scan.wheels.copy()
        for row in wheels:
            row[1:] = self.bridged(self._read(float(row[0]), row[1:].copy()))
        scan = replace(scan, wheels=frozen(wheels))
        says_nothing = self.check.says_nothing(scan) or self.may_be_frozen
        return replace(scan, wheels=scan.wheels[:0]) if says_nothing else scan

    def _read(self, stamp: float, read: FloatArray) -> FloatArray:
        """A pose (3,) that was read, or where it should be if it is not finite; a jump moves the frame ``odom``."""
        if self._last is not None:
            before_s, before = self._last
            if not all(map(math.isfinite, read.tolist())):
                self.jumps += 1
                read = se2.compose(before, self._motion)
            x, y, turn = motion = se2.motion(before, read)
            moved_m = math.hypot(x, y)
            if is_jump(motion, stamp - before_s):
                self.jumps += 1
                self._bridge = se2.compose(se2.compose(self.bridged(before), self._motion), se2.inverse(read))
            elif moved_m > LEAST_BRIDGE_M or abs(turn) > LEAST_BRIDGE_RAD:
                self._motion = motion
        self._last = stamp, read
        return read

    def _with_possible_sweep(self, scan: LaserScan) -> LaserScan:
        """The scan; if odometry jumped during its sweep, with the velocity in the sweep before."""
        sweep = scan.sweep
        if sweep is None:
            return scan
        (x, y, theta), (mean_x, mean_y, mean_theta) = sweep.velocity, sweep.mean_velocity
        speed_m_s = math.hypot(max(abs(x), abs(mean_x)), max(abs(y), abs(mean_y)))
        if speed_m_s <= LARGEST_SPEED_M_S and max(abs(theta), abs(mean_theta)) <= LARGEST_TURN_RAD_S:
            self._velocity = sweep.velocity
            return scan
        return replace(scan, sweep=sweep._replace(velocity=self._velocity, acceleration=(0.0, 0.0, 0.0)))

    @property
    def may_be_frozen(self) -> bool:
        """Whether the odometry stands still although the newest scans have changed."""
        return self.check.may_be_frozen

    def place_image(self, image: CameraImage) -> CameraImage:
        """An image taken since the last scan, with its odometry in the same frame."""
        if self._bridge is None or image.T_odom_base is None:
            return image
        return replace(image, T_odom_base=frozen(self.bridged(image.T_odom_base)))

    def bridged(self, T_odom_base: FloatArray) -> FloatArray:
        """A pose that was read, shape (3,), in the first frame ``odom``."""
        return T_odom_base if self._bridge is None else se2.compose(self._bridge, T_odom_base)


def _in_plane(scan: LaserScan | CloudScan) -> LaserScan:
    """The scan, or what a 2D laser would see of a cloud."""
    if isinstance(scan, LaserScan):
        return scan
    from fcslam.lidar3d.ground import seen_by  # a robot with a 2D laser does not load it

    points = scan.points_m.astype(np.float64)
    return LaserScan(scan.stamp, seen_by(BAND_LASER, points, points), BAND_LASER, scan.T_odom_base)


def is_jump(motion: se2.Pose, within_s: float) -> bool:
    """Whether no robot moves so far within a time."""
    within_s = within_s if within_s > 0.0 else WITHOUT_CLOCK_S
    (x, y, turn), reach_m = motion, SLACK_M + LARGEST_SPEED_M_S * within_s
    return math.hypot(x, y) > reach_m or abs(turn) > SLACK_RAD + LARGEST_TURN_RAD_S * within_s


def moving_on(scan: LaserScan, before: LaserScan) -> LaserScan:
    """The scan with the velocity since the previous one, by odometry, in its sweep."""
    elapsed_s = scan.stamp - before.stamp
    if scan.sweep is None or not 0.0 < elapsed_s <= LONGEST_GAP_S:
        return scan
    x, y, theta = (se2.log(se2.between(before.T_odom_base, scan.T_odom_base)) / elapsed_s).tolist()
    return replace(scan, sweep=scan.sweep._replace(velocity=(x, y, theta)))

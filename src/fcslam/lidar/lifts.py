"""A robot in a closed cabin, such as that of a lift: all around it are walls, until a door opens.

A cabin is told from a room by its size alone. So a robot that waited in a closed room counts as well, and only what it
sees behind the door tells whether it is on another floor (``fcslam.lidar.lost.is_lost``).
"""

import math
from typing import Final

import numpy as np

from fcslam.lidar.lost import MOST_SCANS, SETTLED_M
from fcslam.records import FloatArray, LaserScan

REACH_M: Final = 5.0
"""No more than ``OPEN`` of the beams of a scan within a cabin are longer."""
OPEN: Final = 0.03
AREA_M2: Final = 15.0
"""Largest area that a scan within a cabin shows."""
LEAST_SPAN_RAD: Final = math.radians(240.0)
"""A laser that sees less around it sees no cabin: before a wall, any place looks like one."""
OPENED: Final = 1.15
"""The door opens as the robot sees more than the smallest area by this factor."""
CLOSED_S: Final = 3.0
"""Least time that the robot stands behind the closed door, seconds."""
STANDS_M: Final = 0.1
"""A robot that moves by less stands; it may turn."""
LEAVING_M: Final = SETTLED_M
"""Path after which the surroundings of the door are compared, metres."""
LEAVING_SCANS: Final = 4 * MOST_SCANS
"""Number of scans after which they are compared at the latest."""


class Cabin:
    """Follows the scans of one laser in and out of cabins."""

    def __init__(self) -> None:
        self._mounting: tuple[float, float, float] | None = None
        self._smallest_m2 = math.inf
        """Smallest area seen in the present cabin; infinity outside."""
        self.closed_s = math.inf
        """Stamp from which the present cabin is closed."""
        self._stands_at: FloatArray | None = None
        self._stands_s = math.inf
        """Pose by odometry, shape (3,), around which the robot stands, and the stamp from which it does."""
        self._rode = False
        """Whether it stood there for ``CLOSED_S``: whoever drives through a small room rides nowhere."""
        self.is_leaving = False
        """Whether the door has opened, and the robot has not left the cabin behind."""

    def add(self, scan: LaserScan) -> None:
        """Take the next scan; only those of the laser of the first one count."""
        self._mounting = self._mounting or scan.laser.T_base_laser
        if scan.laser.T_base_laser != self._mounting:
            return
        if self._stands_at is None or math.dist(self._stands_at[:2], scan.T_odom_base[:2]) > STANDS_M:
            self._stands_at, self._stands_s = scan.T_odom_base, scan.stamp
        area_m2 = _seen_area_m2(scan)
        if area_m2 <= AREA_M2 and area_m2 <= OPENED * self._smallest_m2:
            if OPENED * area_m2 < self._smallest_m2:
                self.closed_s = scan.stamp
            self._smallest_m2 = min(area_m2, self._smallest_m2)
            self._rode |= scan.stamp - max(self.closed_s, self._stands_s) >= CLOSED_S
            self.is_leaving = False
        elif self._rode:
            self.is_leaving = True
        else:
            self.leave()

    def leave(self) -> None:
        """The robot has left the cabin."""
        self._smallest_m2, self.closed_s, self._rode, self.is_leaving = math.inf, math.inf, False, False


def _seen_area_m2(scan: LaserScan) -> float:
    """Area between the laser and the returns; infinity if it is open to some side, or not all sides are seen."""
    ranges_m, step_rad = scan.matched_ranges_m, abs(scan.laser.angle_increment_rad)
    if step_rad * scan.laser.beam_count < LEAST_SPAN_RAD:
        return math.inf
    valid = ranges_m > 0.0
    if step_rad * np.count_nonzero(valid) < LEAST_SPAN_RAD:
        return math.inf
    seen_m = np.where(valid & (ranges_m < scan.laser.max_range_m), ranges_m, np.where(valid, np.inf, 0.0))
    seen_m[2:-2] = np.minimum(seen_m[2:-2], np.maximum(seen_m[:-4], seen_m[4:]))  # some beams get lost
    if (seen_m > REACH_M).mean() > OPEN:
        return math.inf
    seen_m = np.minimum(seen_m, REACH_M)
    return 0.5 * step_rad * float(seen_m @ seen_m)

"""Finds scans that say nothing or contradict the odometry, so that a frozen encoder or scanner does not pass unnoticed.

- A scan has exactly the ranges of the previous scan, and the odometry moved, or the stamp is the same: a driver
  repeats it, or it was recorded twice. A robot skips it.
- A scan has no return, as of a covered laser. It clears nothing (``fcslam.robot.mapped_scans``).
- The odometry stands still and the scan changes: most beams measure another range than when it began to stand. The
  scan is kept.
"""

from math import hypot, inf, isnan, remainder, tau

import numpy as np

from fcslam.records import CloudScan, LaserScan, Ranges
from fcslam.sources.faults import Audit, Fault
from fcslam.sources.motion import STILL_M, STILL_RAD
from fcslam.sources.pose import Pose

CHANGE_M, CHANGE = 0.3, 0.05
"""A range that differs by more, in metres and as a share of it, measures something else."""
CHANGED = 0.6
"""Share of the beams that measure something else, if the scan changed."""
FEWEST_RETURNS = 20
"""Scans with fewer common returns are not compared."""


class RepeatedScans:
    """Finds scans that say nothing new: of a driver that repeats its last scan, or recorded twice."""

    def __init__(self) -> None:
        self._newest: dict[Pose, LaserScan] = {}
        """The newest scan of each laser, by its mounting."""

    def admits(self, scan: LaserScan) -> bool:
        """Whether the next scan does not repeat the previous one of its laser."""
        before = self._newest.get(scan.laser.T_base_laser)
        if before is not None and _repeats(before, scan):
            return False
        self._newest[scan.laser.T_base_laser] = scan
        return True


class ScanWatch:
    """Compares the scans of one pass with each other and with their odometry."""

    def __init__(self, audit: Audit) -> None:
        self._audit = audit
        self._repeated = RepeatedScans()
        self._at_rest: dict[Pose, LaserScan] = {}
        """The first scan of each laser where the odometry now stands."""

    def add(self, number: int, scan: LaserScan) -> None:
        """Count what is wrong with the next scan, which is on line (or in message) ``number``."""
        if not self._repeated.admits(scan):
            self._audit.add(Fault.REPEATED_SCAN, number)
            return
        if not count_returns(scan.ranges_m, scan.laser.max_range_m):
            self._audit.add(Fault.NO_RETURN, number)
        if any(map(isnan, scan.T_odom_base.tolist())):
            return
        rest = self._at_rest.get(scan.laser.T_base_laser)
        if rest is None or rest.laser != scan.laser or not stands_still(rest, scan):
            self._at_rest[scan.laser.T_base_laser] = scan
        elif changed_share(rest.ranges_m, scan.ranges_m, scan.laser.max_range_m) > CHANGED:
            self._audit.add(Fault.FROZEN_ODOMETRY, number)


def count_returns(ranges_m: Ranges, max_range_m: float) -> int:
    """Number of beams of a scan with a return below the maximum range."""
    return int(np.count_nonzero((ranges_m > 0.0) & (ranges_m < max_range_m)))


def _repeats(before: LaserScan, after: LaserScan) -> bool:
    """Whether both have the same ranges to the last bit, with enough returns, and the odometry moved or one stamp."""
    if before.ranges_m.tobytes() != after.ranges_m.tobytes():
        return False
    if before.stamp != after.stamp and (stands_still(before, after) or np.isnan(after.T_odom_base).any()):
        return False
    return count_returns(after.ranges_m, after.laser.max_range_m) >= FEWEST_RETURNS


def stands_still(before: LaserScan | CloudScan, after: LaserScan | CloudScan) -> bool:
    """Whether the odometry stood still between two scans; false without odometry."""
    (x0, y0, theta0), (x1, y1, theta1) = before.T_odom_base.tolist(), after.T_odom_base.tolist()
    return hypot(x1 - x0, y1 - y0) < STILL_M and abs(remainder(theta1 - theta0, tau)) < STILL_RAD


def changed_share(before_m: Ranges, after_m: Ranges, max_range_m: float = inf) -> float:
    """Share of the common returns of the same beams that measure something else; NaN if there are too few.

    Beams that only one of the scans has are left out. A range of ``max_range_m`` or more is not a return.
    """
    count = min(len(before_m), len(after_m))
    a, b = before_m[:count], after_m[:count]
    with np.errstate(invalid="ignore"):  # NaN is not a return
        both = (a > 0.0) & (a < max_range_m) & (b > 0.0) & (b < max_range_m)
        changed = np.abs(a - b) > np.maximum(CHANGE_M, CHANGE * np.minimum(a, b))
    returns = np.count_nonzero(both)
    return np.count_nonzero(changed & both) / returns if returns >= FEWEST_RETURNS else float("nan")

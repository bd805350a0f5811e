"""Compares how far scans and odometry turn, for a log whose angles are assumed by the number of beams.

When the robot turns in place by an angle, its scans shift by as many beams as lie in that angle. If another factor fits
all turns better, the laser looks over another angle.
"""

from math import degrees, hypot, remainder, tau
from pathlib import Path

import numpy as np

from fcslam.records import Beams, FloatArray, Ranges
from fcslam.sources.logs.laser import SICK_MAX_RANGE_M
from fcslam.sources.pose import Pose

_LEAST_RAD, _MOST_RAD, _STRAIGHT_M = 0.3, 0.6, 0.15
"""Turns that are compared, and how far the robot drives meanwhile at most."""
_PAIRS, _FEWEST_PAIRS = 60, 8
_SHARES = np.arange(0.25, 2.55, 0.05)
"""Turns of the scans, as shares of those of the odometry by the assumed angles, that are tried."""
_RIGHT = 0.8, 1.25
_CLEARLY = 0.5
"""Another share must fit with less than this part of the difference."""
_AS_WELL = 1.1
"""Differences that are larger by less fit as well as the best."""
_FEWEST_BEAMS = 0.3
"""Least share of the beams that are compared."""


class TurnCheck:
    """The turns of one log."""

    def __init__(self) -> None:
        self._held: tuple[Pose, Ranges] | None = None
        self._differences: list[FloatArray] = []

    def wants(self, T_odom_base: Pose) -> bool:
        """Whether the scan at this pose begins or ends a turn."""
        if len(self._differences) >= _PAIRS:
            return False
        if self._held is None:
            return True
        moved_m, turned_rad = _motion(self._held[0], T_odom_base)
        return abs(turned_rad) > _LEAST_RAD or moved_m > _STRAIGHT_M

    def add(self, T_odom_base: Pose, ranges_m: Ranges, beams: Beams) -> None:
        """Add a scan that is wanted."""
        if self._held is not None:
            before, before_m = self._held
            moved_m, turned_rad = _motion(before, T_odom_base)
            if moved_m <= _STRAIGHT_M and _LEAST_RAD < abs(turned_rad) < _MOST_RAD:
                shift = turned_rad / beams.angle_increment_rad
                self._differences.append(
                    np.array([_difference(before_m, ranges_m, round(share * shift)) for share in _SHARES])
                )
        self._held = T_odom_base, ranges_m

    def note(self, path: Path, beams: Beams) -> list[str]:
        """That the angles are others than assumed, as a sentence; empty if they are not."""
        if len(self._differences) < _FEWEST_PAIRS:
            return []
        differences = np.nanmean(self._differences, axis=0)
        best, assumed = np.nanmin(differences), differences[int(np.argmin(np.abs(_SHARES - 1.0)))]
        share = float(np.median(_SHARES[differences <= _AS_WELL * best]))
        if _RIGHT[0] <= share <= _RIGHT[1] or not best < _CLEARLY * assumed:
            return []
        assumed_deg = degrees(beams.beam_count * beams.angle_increment_rad)
        return [
            f"{path}: {beams.beam_count} beams are taken as {assumed_deg:.0f} degrees, but by the turns of the "
            f"odometry they span about {assumed_deg / share:.0f}; say it by a line PARAM laser_front_laser_fov DEGREES"
        ]


def _motion(a: Pose, b: Pose) -> tuple[float, float]:
    return hypot(b[0] - a[0], b[1] - a[1]), remainder(b[2] - a[2], tau)


def _difference(before_m: Ranges, after_m: Ranges, shift: int) -> float:
    """Median difference of the ranges after a shift of the beams; NaN if there are too few."""
    count = len(before_m)
    if abs(shift) >= count:
        return float("nan")
    a, b = before_m[max(shift, 0) : count + min(shift, 0)], after_m[max(-shift, 0) : count - max(shift, 0)]
    both = (a > 0.0) & (a < SICK_MAX_RANGE_M) & (b > 0.0) & (b < SICK_MAX_RANGE_M)
    if np.count_nonzero(both) < _FEWEST_BEAMS * count:
        return float("nan")
    return float(np.median(np.abs(a[both] - b[both])))

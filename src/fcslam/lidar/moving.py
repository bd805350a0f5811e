"""Returns from what does not stand still, as ground that travels with the robot. They are no part of a map.

A scan is compared with one of the same laser some metres before. A return contradicts it if its beam passes through a
surface that the earlier scan saw, or if it lies where the earlier scan looked through.
"""

from collections import deque
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import njit
from fcslam.geometry import se2
from fcslam.lidar.scan import PointScan
from fcslam.records import FloatArray

BASELINE_M = 3.0
"""Largest distance between the two scans. It exceeds the roughness of the ground far ahead, and most of what both scans
see is the same."""
MOST_KEPT = 24
"""Scans that are remembered: of two lasers at the spacing of keyscans, the last ``BASELINE_M``."""
MARGIN_M, MARGIN_SHARE = 0.3, 0.03
"""Least contradiction in metres, and as a share of the range: rough surfaces and grazing beams vary as much."""
NEIGHBOURS = 3
"""Neighbours on each side that share the decision: single returns from edges contradict without having moved."""
MOST, NEARLY_ALL = 0.5, 0.75
"""Share of contradicting neighbours for a return that itself contradicts, and for one that does not."""
JOINED_M: Final = 1.0
"""Neighbouring returns closer than this lie on one surface, which ends beams that cross between them."""
ADJACENT: Final = 0.06
"""Sine of the largest angle between two returns of the earlier scan between which everything is seen."""


class MovingReturns:
    """Finds moving returns in the scans of a drive, by the scans of the last metres."""

    def __init__(self) -> None:
        self._scans: deque[tuple[int, FloatArray, PointScan]] = deque(maxlen=MOST_KEPT)
        """Laser, pose and points."""

    def find(self, laser: int, T_local_base: FloatArray, scan: PointScan) -> NDArray[np.bool_]:
        """Which returns move, shape (N,).

        Args:
            laser: number of the scan's laser.
            T_local_base: pose of the scan, shape (3,), metres and radians.
            scan: all returns of the scan.
        """
        moving = np.zeros(len(scan), np.bool_)
        for other, T_local_before, before in self._scans:
            T_base_before = se2.between(T_local_base, T_local_before)
            if other == laser and np.hypot(T_base_before[0], T_base_before[1]) <= BASELINE_M:
                moving = moving_returns(scan, before, T_base_before)
                break
        self._scans.append((laser, T_local_base, scan))
        return moving


def moving_returns(scan: PointScan, before: PointScan, T_base_before: FloatArray) -> NDArray[np.bool_]:
    """Which returns of a scan contradict an earlier one, as most of their neighbours do, shape (N,).

    Args:
        scan: returns in ``base``.
        before: returns of the earlier scan, in the ``base`` of that time.
        T_base_before: pose of the earlier ``base`` in the present one, shape (3,), metres and radians.
    """
    if len(scan) <= 2 * NEIGHBOURS or len(before) < 2:
        return np.zeros(len(scan), np.bool_)
    seen = se2.transform(T_base_before, before.points)
    origin_before = se2.transform(T_base_before, before.origin[None])[0]
    contradicts = _passes_surface(scan.points, scan.origin, seen)
    contradicts |= _lies_in_view(scan.points, origin_before, seen)
    near = np.ones(2 * NEIGHBOURS + 1)
    share = np.convolve(contradicts, near, "same") / np.convolve(np.ones(len(scan)), near, "same")
    return np.asarray((contradicts & (share > MOST)) | (share > NEARLY_ALL))


@njit
def _passes_surface(points, origin, seen):  # type: ignore[no-untyped-def]
    """Whether the beam from ``origin`` to each point (N,) passes between two joined returns of ``seen``."""
    passes = np.zeros(len(points), np.bool_)
    for k in range(len(seen) - 1):
        ax, ay = seen[k, 0] - origin[0], seen[k, 1] - origin[1]
        bx, by = seen[k + 1, 0] - origin[0], seen[k + 1, 1] - origin[1]
        if (bx - ax) ** 2 + (by - ay) ** 2 > JOINED_M**2:
            continue
        for i in range(len(points)):
            px, py = points[i, 0] - origin[0], points[i, 1] - origin[1]
            a, b = px * ay - py * ax, px * by - py * bx
            if (a > 0.0) == (b > 0.0) or ax * px + ay * py <= 0.0:
                continue
            share = a / (a - b)
            crossed, length = np.hypot(ax + share * (bx - ax), ay + share * (by - ay)), np.hypot(px, py)
            passes[i] |= crossed < length - MARGIN_M - MARGIN_SHARE * length
    return passes


@njit
def _lies_in_view(points, origin, seen):  # type: ignore[no-untyped-def]
    """Whether two neighbouring beams from ``origin`` to ``seen`` both pass each point (N,)."""
    lies = np.zeros(len(points), np.bool_)
    for k in range(len(seen) - 1):
        ax, ay = seen[k, 0] - origin[0], seen[k, 1] - origin[1]
        bx, by = seen[k + 1, 0] - origin[0], seen[k + 1, 1] - origin[1]
        least = min(np.hypot(ax, ay), np.hypot(bx, by))
        if abs(ax * by - ay * bx) > ADJACENT * np.hypot(ax, ay) * np.hypot(bx, by):
            continue
        for i in range(len(points)):
            px, py = points[i, 0] - origin[0], points[i, 1] - origin[1]
            if (px * ay - py * ax > 0.0) == (px * by - py * bx > 0.0) or ax * px + ay * py <= 0.0:
                continue
            length = np.hypot(px, py)
            lies[i] |= least > length + MARGIN_M + MARGIN_SHARE * length
    return lies

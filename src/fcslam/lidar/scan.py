"""One scan as points with normals in the robot's base."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import njit
from fcslam.records import FloatArray, LaserModel, Ranges

NORMAL_REACH = 3
"""Neighbours on each side that a normal is fitted to."""
MINIMUM_GAP_M = 0.15
"""Neighbouring returns closer than this lie on one surface, whatever the angle between their beams."""
GAP_PER_SPACING = 3.0
"""Neighbouring returns closer than this many beam spacings lie on one surface."""
LINE_TOLERANCE_M = 0.05
"""Largest standard deviation of the neighbours from the fitted line of a normal."""
ROUNDEST = 0.1
"""Largest ratio of the neighbours' variance across the fitted line to that along it."""


@dataclass(frozen=True, slots=True)
class PointScan:
    """Valid returns of one scan in ``base``."""

    points: FloatArray
    """Shape (N, 2), metres."""
    normals: FloatArray
    """Shape (N, 2): unit vectors towards the laser; (0, 0) where the surface is not a line."""
    solitary: NDArray[np.bool_]
    """Shape (N,): returns on no line and in no row, as from a post or a trunk."""
    origin: FloatArray
    """Position of the laser, shape (2,), metres."""

    def __len__(self) -> int:
        return len(self.points)

    def thinned(self, spacing_m: float, limit: int | None = None, radius_m: float = np.inf) -> "PointScan":
        """Every return at least ``spacing_m`` from the one kept before, at most ``limit`` of them.

        Returns farther than ``radius_m`` from the origin of ``base`` are left out.
        """
        most = len(self) if limit is None else limit
        points, normals, solitary = _thin(self.points, self.normals, self.solitary, spacing_m, most, radius_m)
        return PointScan(points, normals, solitary, self.origin)

    def only(self, kept: NDArray[Any]) -> "PointScan":
        """The returns with the indices ``kept``, shape (K,), or where the mask ``kept``, shape (N,), is true."""
        return PointScan(self.points[kept], self.normals[kept], self.solitary[kept], self.origin)


def point_scan(ranges_m: Ranges, laser: LaserModel) -> PointScan:
    """Convert the valid ranges of a scan (finite, over 0, below the maximum) to points with normals.

    Args:
        ranges_m: shape (beam_count,), metres.
        laser: geometry and mounting of the laser.

    Returns:
        Points and normals in ``base``, shape (N, 2).

    Raises:
        ValueError: the number of ranges is not the number of beams.
    """
    if np.shape(ranges_m) != (laser.beam_count,):
        raise ValueError(f"the laser has {laser.beam_count} beams, the scan ranges of shape {np.shape(ranges_m)}")
    T_base_laser = np.array(laser.T_base_laser)
    beams = _beams(laser)
    points, normals, solitary = _project(
        ranges_m, beams, abs(laser.angle_increment_rad), laser.max_range_m, T_base_laser
    )
    return PointScan(points, normals, solitary, T_base_laser[:2])


@lru_cache(maxsize=256)  # the beams of some scanners vary from scan to scan
def _beams(laser: LaserModel) -> FloatArray:
    """Direction of each beam in ``base`` as cosine and sine, shape (N, 2)."""
    angles = laser.angles_rad() + laser.T_base_laser[2]
    return np.stack((np.cos(angles), np.sin(angles)), axis=1)


@njit
def _project(ranges, beams, spacing, max_range, T_base_laser):  # type: ignore[no-untyped-def]
    count = len(ranges)
    kept = np.empty(count, np.int64)
    xy = np.empty((count, 2))
    n = 0
    for i in range(count):
        r = ranges[i]
        if r > 0.0 and r < max_range:  # false for NaN
            xy[n, 0] = T_base_laser[0] + r * beams[i, 0]
            xy[n, 1] = T_base_laser[1] + r * beams[i, 1]
            kept[n] = i
            n += 1
    points = xy[:n].copy()
    normals = np.zeros((n, 2))
    solitary = np.zeros(n, np.bool_)
    for k in range(n):
        _fit_normal(points, kept, ranges, spacing, k, T_base_laser, normals)
        if normals[k, 0] == 0.0 and normals[k, 1] == 0.0:
            solitary[k] = not _in_row(points, k)
    return points, normals, solitary


@njit(allocates=False)
def _in_row(points, k):  # type: ignore[no-untyped-def]
    """Whether return k and two neighbours lie in a row, as the far returns from a wall seen at a grazing angle do."""
    for first in range(max(0, k - 2), min(k, len(points) - 3) + 1):
        ax, ay = points[first + 1, 0] - points[first, 0], points[first + 1, 1] - points[first, 1]
        bx, by = points[first + 2, 0] - points[first, 0], points[first + 2, 1] - points[first, 1]
        chord2 = bx * bx + by * by
        forward = 0.0 < ax * bx + ay * by < chord2
        if forward and (ax * by - ay * bx) ** 2 < LINE_TOLERANCE_M**2 * chord2:
            return True
    return False


@njit(allocates=False)
def _fit_normal(points, kept, ranges, spacing, k, T_base_laser, normals):  # type: ignore[no-untyped-def]
    """Total least squares through the neighbours of return k on the same surface; facing the laser."""
    first = last = k
    while first > 0 and k - first < NORMAL_REACH and _connected(points, kept, ranges, spacing, first - 1):
        first -= 1
    while last < len(points) - 1 and last - k < NORMAL_REACH and _connected(points, kept, ranges, spacing, last):
        last += 1
    m = last - first + 1
    if m < 3:
        return
    mx = my = 0.0
    for i in range(first, last + 1):
        mx += points[i, 0]
        my += points[i, 1]
    mx /= m
    my /= m
    sxx = sxy = syy = 0.0
    for i in range(first, last + 1):
        dx, dy = points[i, 0] - mx, points[i, 1] - my
        sxx += dx * dx
        sxy += dx * dy
        syy += dy * dy
    nx, ny = _across(sxx - syy, 2.0 * sxy)
    across = (nx * nx * sxx + 2.0 * nx * ny * sxy + ny * ny * syy) / m
    along = (sxx + syy) / m - across
    if across > LINE_TOLERANCE_M**2 or across > ROUNDEST * along:
        return
    if nx * (T_base_laser[0] - points[k, 0]) + ny * (T_base_laser[1] - points[k, 1]) < 0.0:
        nx, ny = -nx, -ny
    normals[k, 0] = nx
    normals[k, 1] = ny


@njit(allocates=False)
def _across(difference, mixed):  # type: ignore[no-untyped-def]
    """Unit normal of the line along half the angle of (difference, mixed), without trigonometric functions."""
    length = np.hypot(difference, mixed)
    if length == 0.0:
        return 0.0, 1.0
    if difference >= 0.0:
        cos = np.sqrt(0.5 + 0.5 * difference / length)
        sin = 0.5 * mixed / (length * cos)
    else:
        sin = np.copysign(np.sqrt(0.5 - 0.5 * difference / length), mixed)
        cos = 0.5 * mixed / (length * sin)
    return -sin, cos


@njit(allocates=False)
def _connected(points, kept, ranges, spacing, i):  # type: ignore[no-untyped-def]
    """Whether returns i and i + 1 lie on one surface."""
    if kept[i + 1] - kept[i] > 2:
        return False
    dx, dy = points[i + 1, 0] - points[i, 0], points[i + 1, 1] - points[i, 1]
    nearer = min(ranges[kept[i]], ranges[kept[i + 1]])
    limit = max(MINIMUM_GAP_M, GAP_PER_SPACING * nearer * spacing)
    return dx * dx + dy * dy < limit * limit


@njit
def _thin(points, normals, solitary, spacing, limit, radius):  # type: ignore[no-untyped-def]
    keep = np.empty(len(points), np.int64)
    n = 0
    for i in range(len(points)):
        if points[i, 0] ** 2 + points[i, 1] ** 2 >= radius * radius:
            continue
        if n > 0:
            dx = points[i, 0] - points[keep[n - 1], 0]
            dy = points[i, 1] - points[keep[n - 1], 1]
            if dx * dx + dy * dy < spacing * spacing:
                continue
        keep[n] = i
        n += 1
    count = min(n, limit)
    kept_points, kept_normals, kept_solitary = np.empty((count, 2)), np.empty((count, 2)), np.empty(count, np.bool_)
    for k in range(count):  # evenly spread over those that are far enough apart
        i = keep[k * (n - 1) // max(1, count - 1)]
        kept_points[k] = points[i]
        kept_normals[k] = normals[i]
        kept_solitary[k] = solitary[i]
    return kept_points, kept_normals, kept_solitary

"""One scan as points with normals in the robot's base."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import njit
from fcslam.records import FloatArray, Keyscan, LaserModel, Ranges, Sweep
from fcslam.sources.point_clouds import GAP_M, GAP_PER_SPACING

NORMAL_REACH = 3
"""Neighbours on each side that a normal is fitted to."""
GAP_SPACINGS = 2.0
"""A solitary return farther than this many spacings from the one kept before is kept in any case."""
LINE_TOLERANCE_M = 0.05
"""Largest standard deviation of the neighbours from the fitted line of a normal."""
ROUNDEST = 0.1
"""Largest ratio of the neighbours' variance across the fitted line to that along it."""

AT_ONCE: Final = np.empty(0)
"""Times of returns that were all measured at the stamp."""


@dataclass(frozen=True, slots=True)
class PointScan:
    """Valid returns of one scan in ``base`` at its stamp."""

    points: FloatArray
    """Shape (N, 2), metres."""
    normals: FloatArray
    """Shape (N, 2): unit vectors towards the laser; (0, 0) where the surface is not a line."""
    solitary: NDArray[np.bool_]
    """Shape (N,): returns on no line and in no row, as from a post or a trunk."""
    origin: FloatArray
    """Position of the laser, shape (2,), metres; in the middle of a sweep."""
    times_s: FloatArray = field(default_factory=lambda: AT_ONCE)
    """Shape (N,): time of each return after the stamp; shape (0,): all were measured at the stamp."""

    def __len__(self) -> int:
        return len(self.points)

    def thinned(self, spacing_m: float, limit: int | None = None, radius_m: float = np.inf) -> "PointScan":
        """Returns about ``spacing_m`` apart, at most ``limit`` of them.

        A return is kept if the one before it, and one more step as the returns before, are that far from the last one
        kept. Its own noise does not count: the noise of a range moves a return along an oblique wall, too. Returns kept
        by their own distance would be too far on one side of a wall and too near on the other, and would turn the robot
        with each match. Returns farther than ``radius_m`` from the origin of ``base`` are left out.
        """
        most = len(self) if limit is None else limit
        points, normals, solitary, times_s = _thin(
            self.points, self.normals, self.solitary, self.times_s, spacing_m, most, radius_m
        )
        return PointScan(points, normals, solitary, self.origin, times_s)

    def only(self, kept: NDArray[Any]) -> "PointScan":
        """The returns with the indices ``kept``, shape (K,), or where the mask ``kept``, shape (N,), is true."""
        times_s = self.times_s[kept] if len(self.times_s) else AT_ONCE
        return PointScan(self.points[kept], self.normals[kept], self.solitary[kept], self.origin, times_s)


def point_scan(ranges_m: Ranges, laser: LaserModel, sweep: Sweep | None = None) -> PointScan:
    """The valid ranges (beam_count,) of a scan (finite, over 0, below the maximum) as points with normals.

    Each return of a ``sweep`` is placed where the robot was then.
    """
    if ranges_m.shape != (laser.beam_count,):
        raise ValueError(f"the laser has {laser.beam_count} beams, the scan ranges of shape {ranges_m.shape}")
    origins, directions = _rays(laser)
    spacing_rad = abs(laser.angle_increment_rad)
    if sweep is None:
        points, normals, solitary, _ = _project(ranges_m, origins, directions, spacing_rad, laser.max_range_m)
        return PointScan(points, normals, solitary, origins[laser.beam_count // 2], AT_ONCE)
    return PointScan(*_project_swept(ranges_m, origins, directions, sweep, spacing_rad, laser.max_range_m))


def keyscan_points(keyscan: Keyscan, lasers: Sequence[LaserModel]) -> PointScan:
    """The points of a keyscan; ``lasers`` are those that its robot announced."""
    return point_scan(keyscan.ranges_m, keyscan.laser_model(lasers), keyscan.sweep)


def rays_of(laser: LaserModel, sweep: Sweep | None = None) -> tuple[FloatArray, FloatArray]:
    """Origins and directions of the beams of a scan in ``base`` at its stamp, shape (beam_count, 2) each.

    A return lies at ``origin + range * direction``, where ``point_scan`` places it.
    """
    if sweep is None:
        return _rays(laser)
    origins, directions, _ = _swept(*_rays(laser), sweep)
    return origins, directions


def beam_times(laser: LaserModel, sweep: Sweep) -> FloatArray:
    """Time of each beam after the stamp, seconds, shape (beam_count,)."""
    return np.linspace(sweep.first_s, sweep.last_s, laser.beam_count)


@lru_cache(maxsize=256)  # the beams of some scanners vary from scan to scan
def _rays(laser: LaserModel) -> tuple[FloatArray, FloatArray]:
    """The beams if all are measured at the stamp. Only here and in ``_swept`` beams get positions and directions."""
    angles = laser.angles_rad() + laser.T_base_laser[2]
    origins = np.tile(laser.T_base_laser[:2], (laser.beam_count, 1))
    return origins, np.stack((np.cos(angles), np.sin(angles)), axis=1)


@njit
def _swept(origins, directions, sweep):  # type: ignore[no-untyped-def]
    """Each beam where the robot was at its time, and these times, as ``beam_times``."""
    first, last, velocity, acceleration = sweep
    moved, turned, times = np.empty_like(origins), np.empty_like(directions), np.empty(len(origins))
    step = (last - first) / max(1, len(times) - 1)
    for i in range(len(times)):
        times[i] = last if 0 < i == len(times) - 1 else first + i * step
        moved[i, 0], moved[i, 1], turned[i, 0], turned[i, 1] = ray_at(
            origins[i], directions[i], times[i], velocity, acceleration
        )
    return moved, turned, times


@njit(allocates=False)
def ray_at(origin, direction, t, velocity, acceleration):  # type: ignore[no-untyped-def]
    """Origin and direction of a beam at ``t`` s, in ``base`` at the stamp (see ``Sweep``), as four numbers."""
    x = t * (velocity[0] + 0.5 * t * acceleration[0])
    y = t * (velocity[1] + 0.5 * t * acceleration[1])
    theta = t * (velocity[2] + 0.5 * t * acceleration[2])
    cos, sin = np.cos(theta), np.sin(theta)
    return (
        x + cos * origin[0] - sin * origin[1],
        y + sin * origin[0] + cos * origin[1],
        cos * direction[0] - sin * direction[1],
        sin * direction[0] + cos * direction[1],
    )


@njit
def _project_swept(ranges, origins, directions, sweep, spacing, max_range):  # type: ignore[no-untyped-def]
    origins, directions, times = _swept(origins, directions, sweep)
    points, normals, solitary, kept = _project(ranges, origins, directions, spacing, max_range)
    return points, normals, solitary, origins[len(origins) // 2].copy(), times[kept]


@njit
def _project(ranges, origins, directions, spacing, max_range):  # type: ignore[no-untyped-def]
    count = len(ranges)
    kept = np.empty(count, np.int64)
    xy = np.empty((count, 2))
    n = 0
    for i in range(count):
        r = ranges[i]
        if r > 0.0 and r < max_range:  # false for NaN
            xy[n, 0] = origins[i, 0] + r * directions[i, 0]
            xy[n, 1] = origins[i, 1] + r * directions[i, 1]
            kept[n] = i
            n += 1
    points, kept = xy[:n].copy(), kept[:n].copy()
    normals = np.zeros((n, 2))
    solitary = np.zeros(n, np.bool_)
    connected = np.empty(max(0, n - 1), np.bool_)
    for k in range(n - 1):
        connected[k] = _is_connected(points, kept, ranges, spacing, k)
    for k in range(n):
        _fit_normal(points, connected, k, origins[kept[k]], normals)
        if normals[k, 0] == 0.0 and normals[k, 1] == 0.0:
            solitary[k] = not _in_row(points, k)
    return points, normals, solitary, kept


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
def _fit_normal(points, connected, k, origin, normals):  # type: ignore[no-untyped-def]
    """Total least squares through the neighbours of return k on the same surface; facing the laser."""
    first = last = k
    while first > 0 and k - first < NORMAL_REACH and connected[first - 1]:
        first -= 1
    while last < len(connected) and last - k < NORMAL_REACH and connected[last]:
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
    if nx * (origin[0] - points[k, 0]) + ny * (origin[1] - points[k, 1]) < 0.0:
        nx, ny = -nx, -ny
    normals[k, 0] = nx
    normals[k, 1] = ny


@njit(allocates=False)
def _across(difference, mixed):  # type: ignore[no-untyped-def]
    """Unit normal of the line along half the angle of (difference, mixed), without trigonometric functions."""
    length = np.sqrt(difference * difference + mixed * mixed)
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
def _is_connected(points, kept, ranges, spacing, i):  # type: ignore[no-untyped-def]
    if kept[i + 1] - kept[i] > 2:
        return False
    dx, dy = points[i + 1, 0] - points[i, 0], points[i + 1, 1] - points[i, 1]
    nearer = min(ranges[kept[i]], ranges[kept[i + 1]])
    limit = max(GAP_M, GAP_PER_SPACING * nearer * spacing)
    return dx * dx + dy * dy < limit * limit


@njit(allocates=False)
def _distance(a, b):  # type: ignore[no-untyped-def]
    return np.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2)  # in a third of the time of np.hypot


@njit
def _thin(points, normals, solitary, times, spacing, limit, radius):  # type: ignore[no-untyped-def]
    keep = np.empty(len(points), np.int64)
    n = 0
    step = before = 0.0  # the last two distances of consecutive returns; the lesser leaves out gaps
    for i in range(len(points)):
        if i > 1:
            step, before = _distance(points[i - 1], points[i - 2]), step
        if points[i, 0] ** 2 + points[i, 1] ** 2 >= radius * radius:
            continue
        if n > 0:
            last = points[keep[n - 1]]
            expected = _distance(points[i - 1], last) + min(step, before)
            is_post = solitary[i] and _distance(points[i], last) >= GAP_SPACINGS * spacing
            if expected < spacing and not is_post:
                continue
        keep[n] = i
        n += 1
    count = min(n, limit)
    some_points, some_normals, some_solitary = np.empty((count, 2)), np.empty((count, 2)), np.empty(count, np.bool_)
    some_times = np.empty(count if len(times) > 0 else 0)
    for k in range(count):  # evenly spread over those that are far enough apart
        i = keep[k * (n - 1) // max(1, count - 1)]
        some_points[k, 0], some_points[k, 1] = points[i, 0], points[i, 1]
        some_normals[k, 0], some_normals[k, 1] = normals[i, 0], normals[i, 1]
        some_solitary[k] = solitary[i]
        if len(times) > 0:
            some_times[k] = times[i]
    return some_points, some_normals, some_solitary, some_times

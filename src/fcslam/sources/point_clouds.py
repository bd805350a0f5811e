"""Turns the points of a 3D LiDAR or a depth camera into the ranges of a 2D scan.

The points in a band of heights above the floor count. The nearest surface in each direction gives its range. The floor
is a plane that is fitted to each cloud, so a robot that pitches or a sensor that leans sees no floor in the band.

A scanner that turns measures its directions one after the other. The directions of a scan then begin where the turn
begins, so that their times are linear; a return that was not measured when its direction was is left out. Without
times, the order of the points shows where a turn begins. The points of other scanners are moved to where they are seen
at the mean time of all.
"""

from collections.abc import Iterable
from math import atan2, ceil, cos, nan, pi, radians, tau
from typing import Final, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from fcslam.geometry import se2
from fcslam.records import Beams, FloatArray, Ranges, Sweep
from fcslam.sources.bags.messages import ScanMessage

DIRECTIONS: Final = 720
"""In a full turn, at most."""
SPACING_RAD: Final = tau / DIRECTIONS
_COARSEST: Final = 8
"""Largest spacing of the directions that a sensor measures, in ``SPACING_RAD``."""
_FEWEST_DIRECTIONS: Final = 50
"""A cloud with returns in fewer does not tell how far apart they are."""
FARTHEST_M: Final = 100.0
"""Farther returns are left out; the usual distance of points that are not in metres."""
SAME_SURFACE_M: Final = 0.05
"""Returns that are closer, along a direction or to a plane, are of the same surface."""
LARGEST_GAP: Final = 3
"""Directions between two returns that may be neighbours on a surface."""
GAP_M, GAP_PER_SPACING = 0.15, 3.0
"""Such returns are on one surface if they are closer than this, or than this many spacings of their beams."""

FLOOR_ERROR_M: Final = 0.3
"""The floor is at most this far from where the mounting says."""
FLOOR_TILT_RAD: Final = radians(12.0)
"""The floor is inclined by at most this against the mounting."""
LEANING_RAD: Final = radians(10.0)
"""A mounting from which the floor leans by more in most clouds is wrong."""
LARGEST_LEANING_RAD: Final = radians(40.0)
"""Beyond, walls and the floor may be confused."""
FEWEST_FLOORS, _SAME_FLOOR_RAD = 8, radians(4.0)
"""Clouds that show it at least, and the largest deviation of their floors from the middle one."""
FLOOR_REACH_M: Final = 12.0
"""The floor is fitted to points up to this distance."""
_FLOOR_POINTS, _FLOOR_SAMPLES = 1500, 200
"""Most points that a floor is sought in, and planes through three of them that are tried."""
_FEWEST_ON_FLOOR = 30
"""Least number of points that are on a floor, less those below it."""
_GOOD_MOUNTING = 0.8
"""A floor by the mounting that has this share of the points of the best one is kept, without the noise of a fit."""
_FITS = 2
_LEAST_EXTENT_M = 0.15
"""Least standard deviation of the points of a floor in every direction."""

_BEND_RAD: Final = radians(3.0)
"""A floor whose slope changes by less is flat."""
_BEND_M: Final = 0.8
"""Standard deviation of the points of such a floor along x, at least; a wall with the floor before it has less."""
_BEND_CLOUDS: Final = 9
"""Clouds whose middle slope counts, and after which a robot has driven over a bend."""

LARGEST_BODY_M: Final = 1.5
"""Farther returns are not of the robot."""

_SLOTS = 90
"""Parts of a turn in time whose directions show how the scanner turns."""
_SHARPEST = 0.8
"""Least length of the mean direction of the points in such a part."""
_STRAY_RAD = 0.15
"""Largest deviation of a direction from a turn of constant speed."""
_SHORTEST_TURN_RAD = 0.5


Plane = tuple[FloatArray, float]
"""The plane ``normal @ p = distance_m``, with ``normal`` up."""


class CloudBand(NamedTuple):
    """Which points of a cloud count."""

    low_m: float = 0.1
    """Least height above the floor."""
    high_m: float = 0.6
    body_radius_m: float = 0.4
    """Points that are nearer to the origin of ``base`` are of the robot itself."""


class PointCloud(NamedTuple):
    """The returns of one message."""

    stamp: float
    frame: str
    points: FloatArray
    """Shape (N, 3), metres, finite, in the frame of the sensor."""
    times_s: FloatArray
    """Shape (N,): time of each return after the stamp; shape (0,): not known."""
    left_out: int = 0
    """Returns that were left out, as their times are wrong."""
    is_in_order: bool = False
    """Whether the times, in no known unit, gave the order of the returns."""


class CloudMounting(NamedTuple):
    """Where the sensor is in ``base``."""

    rotation: FloatArray
    """Shape (3, 3)."""
    position_m: FloatArray
    """Shape (3,)."""
    heading_rad: float
    """Heading of the level frame in which the scan is."""
    is_height_known: bool = True
    directions: int = DIRECTIONS

    def in_base(self, cloud: PointCloud) -> FloatArray:
        """The points of a cloud in ``base``, shape (N, 3)."""
        return cloud.points @ self.rotation.T + self.position_m


def scan_of_cloud(
    cloud: PointCloud, mounting: CloudMounting, band: CloudBand, motion: Sweep | None = None
) -> ScanMessage:
    """The nearest returns of a cloud in a band of heights, in the level frame of the sensor; NaN: none is in it.

    If ``motion`` says how ``base`` moves around the stamp of the scan, for a cloud whose directions are in no order,
    each point is moved to where it is seen at the stamp.
    """
    in_base = mounting.in_base(cloud)
    offset_s = float(cloud.times_s.mean()) if len(cloud.times_s) else 0.0
    if motion is not None:
        poses = np.column_stack((in_base[:, :2], np.zeros(len(in_base))))
        in_base[:, :2] = se2.compose(motion.displacement(cloud.times_s[:, None] - offset_s), poses)[:, :2]
    outside = np.hypot(in_base[:, 0], in_base[:, 1]) > band.body_radius_m
    floor = floor_in(in_base[outside], mounting)
    if floor is None and not mounting.is_height_known:
        raise ValueError("no floor is seen, so the height of the sensor is not known; publish its pose in tf")
    normal, distance_m = floor or (np.array([0.0, 0.0, 1.0]), 0.0)
    heights_m = in_base @ normal - distance_m
    xy = ((in_base - mounting.position_m) @ _levelling(normal, mounting.heading_rad).T)[:, :2]
    is_timed = len(cloud.times_s) > 0
    turn = turn_of(xy, cloud.times_s if is_timed else np.linspace(0.0, 1.0, len(xy))) if motion is None else None
    count, spacing_rad = mounting.directions, tau / mounting.directions
    kept = (heights_m > band.low_m) & (heights_m < band.high_m) & outside
    kept &= np.hypot(xy[:, 0], xy[:, 1]) < FARTHEST_M
    first, sweep = -count // 2, None
    angles = np.arctan2(xy[kept, 1], xy[kept, 0])
    if turn is None or not is_timed:
        if turn is not None:  # the drive may show how long it takes, if the directions are in the order of time
            first, _ = _directions(turn, count)
        index = np.remainder(np.rint(angles / spacing_rad).astype(np.int64) - first, count)
        if is_timed:
            sweep = Sweep(float(cloud.times_s.min()) - offset_s, float(cloud.times_s.max()) - offset_s)
    else:
        offset_s, (first, sweep) = 0.0, _directions(turn, count)
        angle_rad, rate_rad_s, _ = turn
        expected = angle_rad + rate_rad_s * cloud.times_s[kept]
        stray = np.remainder(angles - expected + pi, tau) - pi
        index = np.rint((expected + stray) / spacing_rad).astype(np.int64) - first
        index[np.abs(stray) > _STRAY_RAD] = -1
    ranges_m = _ranges(xy[kept], index, first, count)
    first = (first + count // 2) % count - count // 2
    beams = Beams(count, first * spacing_rad, spacing_rad)
    scan = ScanMessage(cloud.stamp + offset_s, cloud.frame, beams, 0.0, FARTHEST_M, ranges_m, sweep=sweep)
    if sweep is None or (turn is not None and is_timed):
        return scan
    return scan._replace(ranges_at_stamp=lambda motion: scan_of_cloud(cloud, mounting, band, motion).raw_ranges_m)


def directions_in(clouds: Iterable[PointCloud], mounting: CloudMounting) -> int:
    """Directions in a full turn of the scans of these clouds: so few that no empty ones part neighbouring returns.

    Otherwise, no return of a sparse scanner would have a normal.
    """
    gaps = []
    for cloud in clouds:
        x, y = (cloud.points @ mounting.rotation.T)[:, :2].T
        seen = np.unique(np.rint(np.arctan2(y, x) / SPACING_RAD))
        if len(seen) >= _FEWEST_DIRECTIONS:
            gaps.append(int(np.quantile(np.diff(seen), 0.1)))  # larger gaps are also where nothing is seen
    measured = min(int(np.median(gaps or [1])), _COARSEST)
    return DIRECTIONS // ceil(measured / LARGEST_GAP)


def unit_problem(clouds: Iterable[PointCloud]) -> str:
    """What is wrong with the unit of the points in these clouds; empty if nothing is."""
    distances_m = [float(np.median(np.linalg.norm(cloud.points, axis=1))) for cloud in clouds if len(cloud.points)]
    if not distances_m or (middle_m := float(np.median(distances_m))) <= FARTHEST_M:
        return ""
    return f"the points are {middle_m:.0f} m away, as if in another unit; publish them in metres"


def leaning(clouds: Iterable[PointCloud], mounting: CloudMounting) -> FloatArray | None:
    """The rotation of a wrong mounting that makes the floor level in most clouds, shape (3, 3); None if it is right."""
    floors = [floor_in(mounting.in_base(cloud), mounting, LARGEST_LEANING_RAD) for cloud in clouds]
    normals = np.array([floor[0] for floor in floors if floor is not None]).reshape(-1, 3)
    if len(normals) < max(FEWEST_FLOORS, len(floors) // 2):
        return None
    middle = np.median(normals, axis=0)
    middle /= np.linalg.norm(middle)
    is_same = normals @ middle > cos(_SAME_FLOOR_RAD)
    if middle[2] > cos(LEANING_RAD) or np.count_nonzero(is_same) < max(FEWEST_FLOORS, len(floors) // 2):
        return None
    return _levelling(middle, 0.0)


def floor_in(points: FloatArray, mounting: CloudMounting, largest_tilt_rad: float = FLOOR_TILT_RAD) -> Plane | None:
    """The floor among the ``points`` in ``base``; None if none is seen, or if it is where the mounting has it."""
    offset = points - mounting.position_m
    distances_m = np.hypot(offset[:, 0], offset[:, 1])
    slope = np.tan(largest_tilt_rad)
    if mounting.is_height_known:
        near = np.abs(points[:, 2]) < FLOOR_ERROR_M + slope * distances_m
    else:
        near = offset[:, 2] < slope * distances_m
    near &= distances_m < FLOOR_REACH_M
    chosen = np.flatnonzero(near)
    chosen = chosen[:: 1 + len(chosen) // _FLOOR_POINTS]
    lowest_first = np.argsort(offset[chosen, 2] / np.maximum(distances_m[chosen], 1e-3), kind="stable")
    able = points[chosen[lowest_first]]
    floor = _lowest_plane(able, mounting.is_height_known, largest_tilt_rad)
    for _ in range(_FITS):
        floor = floor and _fitted(floor, able)
    if floor is None or floor[0][2] < cos(largest_tilt_rad):
        return None
    normal, distance_m = floor
    height_m = float(normal @ mounting.position_m) - distance_m
    is_off = mounting.is_height_known and abs(height_m - mounting.position_m[2]) > FLOOR_ERROR_M
    return None if is_off or height_m < 0.0 else floor


def slopes_of(points: FloatArray, mounting: CloudMounting) -> tuple[float, float]:
    """Slopes of the floor along x ahead of ``base`` and behind it; NaN where it is not seen."""
    x, y = points[:, 0], np.abs(points[:, 1])
    ahead_rad, behind_rad = (_slope(points[part], mounting) for part in (x > 2.0 * y, x < -2.0 * y))
    return ahead_rad, behind_rad


def _slope(points: FloatArray, mounting: CloudMounting) -> float:
    normal, distance_m = floor_in(points, mounting) or (np.array([0.0, 0.0, 1.0]), 0.0)
    own = points[np.abs(points @ normal - distance_m) < SAME_SURFACE_M]
    is_seen = len(own) > _FEWEST_ON_FLOOR and float(np.std(own[:, 0])) > _BEND_M
    return -atan2(normal[0], normal[2]) if is_seen else nan


def bends_in(slopes: FloatArray) -> NDArray[np.int64]:
    """Rows of ``slopes_of`` the clouds of a drive, shape (N, 2), where the robot drives over a bend of the floor.

    The floor is bent by the same angle before, at, and after it, and the slopes ahead and behind change by that angle.
    A robot that nods or is mounted otherwise sees no bend, and one that turns in front of a ramp sees none meanwhile.
    """
    if len(slopes) < 3 * _BEND_CLOUDS:
        return np.empty(0, np.int64)
    windows = np.sort(sliding_window_view(slopes, _BEND_CLOUDS, axis=0), axis=-1)  # NaN is last
    half = _BEND_CLOUDS // 2
    seen = np.isfinite(windows).sum(axis=-1, keepdims=True)
    usual = np.where(seen > half, np.take_along_axis(windows, seen // 2, axis=-1), nan)[..., 0]
    states = np.array([usual[first : len(usual) - 4 * half + first] for first in (0, 2 * half, 4 * half)])
    bends, pitched = states[..., 0] - states[..., 1], (states[0] - states[2]).T
    is_bend = [(each > _BEND_RAD).all(axis=0) | (each < -_BEND_RAD).all(axis=0) for each in (bends, pitched)]
    return np.flatnonzero(is_bend[0] & is_bend[1]) + 3 * half


def _lowest_plane(points: FloatArray, is_height_known: bool, largest_tilt_rad: float) -> Plane | None:
    """The plane with most points, less those below it (RANSAC); None if that of the mounting is nearly as good.

    It goes through three of the first ``points``, the lowest as seen from the sensor.
    """
    if len(points) < _FEWEST_ON_FLOOR:
        return None
    triples = np.random.default_rng(0).integers(len(points) // 3, size=(_FLOOR_SAMPLES, 3))
    corners = points[triples]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    level = np.abs(normals[:, 2]) > cos(largest_tilt_rad) * np.maximum(lengths, 1e-6)
    normals = np.vstack(([0.0, 0.0, 1.0], normals[level] / normals[level, 2:]))
    distances_m = np.append(0.0, np.sum(normals[1:] * corners[level, 0], axis=1))
    heights_m = normals @ np.ascontiguousarray(points.T) - distances_m[:, None]
    scores = np.sum(heights_m < SAME_SURFACE_M, axis=1) - 2 * np.sum(heights_m < -SAME_SURFACE_M, axis=1)
    best = int(np.argmax(scores))
    is_of_mounting = is_height_known and scores[0] > _GOOD_MOUNTING * scores[best]
    if scores[best] < _FEWEST_ON_FLOOR or is_of_mounting:
        return None
    return normals[best], float(distances_m[best])


def _fitted(plane: Plane, points: FloatArray) -> Plane | None:
    normal, distance_m = plane
    own = points[np.abs(points @ normal - distance_m) < SAME_SURFACE_M]
    if len(own) < _FEWEST_ON_FLOOR:
        return None
    middle = own.mean(axis=0)
    variances, axes = np.linalg.eigh((own - middle).T @ (own - middle) / len(own))
    if variances[1] < _LEAST_EXTENT_M**2:
        return None
    normal = axes[:, 0] * np.copysign(1.0, axes[2, 0])
    return normal, float(normal @ middle)


def _levelling(normal: FloatArray, heading_rad: float) -> FloatArray:
    """The rotation that takes ``normal`` to the vertical, and then a heading to the x axis, shape (3, 3)."""
    x, y, z = normal
    level = np.array(
        [
            [1.0 - x * x / (1.0 + z), -x * y / (1.0 + z), -x],
            [-x * y / (1.0 + z), 1.0 - y * y / (1.0 + z), -y],
            [x, y, z],
        ]
    )
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    result: FloatArray = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ level
    return result


def _directions(turn: tuple[float, float, float], count: int) -> tuple[int, Sweep]:
    """The first of ``count`` directions of a turn in spacings, and the times of the directions."""
    angle_rad, rate_rad_s, begin_s = turn
    spacing_rad = tau / count
    begin = round((angle_rad + rate_rad_s * begin_s) / spacing_rad)
    first = begin if rate_rad_s > 0.0 else begin - count + 1
    ends = np.array([first, first + count - 1]) * spacing_rad
    first_s, last_s = ((ends - angle_rad) / rate_rad_s).tolist()
    return first, Sweep(first_s, last_s)


def turn_of(xy: FloatArray, times_s: FloatArray) -> tuple[float, float, float] | None:
    """Angle, rate and first time: the scanner looks along ``angle + rate * t`` at the time ``t`` after the stamp."""
    if len(times_s) < _SLOTS or not times_s.max() > times_s.min():
        return None
    begin_s, end_s = float(times_s.min()), float(times_s.max())
    slots = np.minimum(((times_s - begin_s) * (_SLOTS / (end_s - begin_s))).astype(np.int64), _SLOTS - 1)
    unit = xy / np.maximum(np.hypot(xy[:, 0], xy[:, 1]), 1e-9)[:, None]
    counts = np.bincount(slots, minlength=_SLOTS)
    seen = counts > 0
    x, y, times = (np.bincount(slots, each, _SLOTS)[seen] / counts[seen] for each in (unit[:, 0], unit[:, 1], times_s))
    if np.mean(np.hypot(x, y) > _SHARPEST) < _SHARPEST or len(times) < 3:
        return None
    angles = np.unwrap(np.arctan2(y, x))
    rate, angle = np.polyfit(times, angles, 1)
    turned_rad = abs(rate) * (end_s - begin_s)
    deviation_rad = float(np.sqrt(np.mean((angles - angle - rate * times) ** 2)))
    if not _SHORTEST_TURN_RAD < turned_rad < 1.2 * tau or deviation_rad > _STRAY_RAD:
        return None
    return float(angle), float(rate), begin_s


def _ranges(xy: FloatArray, index: NDArray[np.int64], first: int, count: int) -> Ranges:
    """Range of the nearest surface along each direction, shape (count,)."""
    spacing_rad = tau / count
    used = (index >= 0) & (index < count)
    xy, index = xy[used], index[used]
    distances_m = np.hypot(xy[:, 0], xy[:, 1])
    nearest_m = np.full(count, np.inf)
    np.minimum.at(nearest_m, index, distances_m)
    same = distances_m < nearest_m[index] + SAME_SURFACE_M
    counts = np.bincount(index[same], minlength=count)
    seen = np.flatnonzero(counts)
    points = np.stack([np.bincount(index[same], axis, count)[seen] / counts[seen] for axis in xy[same].T], axis=1)
    ranges_m = np.full(count, np.nan, np.float32)
    ranges_m[seen] = np.hypot(points[:, 0], points[:, 1])
    directions = (np.arange(count) + first) * spacing_rad
    rays = np.stack((np.cos(directions), np.sin(directions)), axis=1)
    if len(seen) < 2:
        return ranges_m
    # The returns on both sides of each direction: the range is where its ray meets the surface between them.
    right_of = _cross(rays[seen], points) < 0.0  # a return clockwise of its direction
    left = np.searchsorted(seen, np.arange(count), side="left")
    is_seen = counts > 0
    left[is_seen] += right_of
    inside = (left > 0) & (left < len(seen))
    a, b = points[left[inside] - 1], points[left[inside]]
    gap = seen[left[inside]] - seen[left[inside] - 1]
    spacing_m = gap * spacing_rad * np.minimum(np.hypot(a[:, 0], a[:, 1]), np.hypot(b[:, 0], b[:, 1]))
    apart_m = np.hypot(*(b - a).T)
    joined = (gap <= LARGEST_GAP) & (apart_m < np.maximum(GAP_M, GAP_PER_SPACING * spacing_m))
    across = _cross(rays[inside], b - a)
    joined &= across > 1e-9
    ranges_m[np.flatnonzero(inside)[joined]] = (_cross(a, b) / np.where(joined, across, 1.0))[joined]
    return ranges_m


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    result: FloatArray = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return result

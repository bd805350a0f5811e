"""Points of a scan that lie on another robot of the fleet: they are no part of the building.

A robot with a false pose must not hide a wall. So its points count only where other robots' scans look through.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import njit
from fcslam.lidar.occupancy import MINIMUM_PASSES, OCCUPIED_RATIO, Casting, OccupancyConfig, cast
from fcslam.lidar.scan import rays_of
from fcslam.records import FloatArray, frozen


class RobotPath(NamedTuple):
    """Where one robot was."""

    stamps: FloatArray
    """Shape (N,), seconds, ascending, at least one."""
    T_map_base: FloatArray
    """Shape (N, 3)."""


class _Suspects(NamedTuple):
    robot: str
    scans: NDArray[np.int64]  # (K,)
    beams: NDArray[np.int64]  # (K,)
    points: FloatArray  # (K, 2) in map


def without_teammates(
    scans: Sequence[Casting],
    stamps: FloatArray,
    senders: Sequence[str],
    paths: Mapping[str, Sequence[RobotPath]],
    config: OccupancyConfig,
) -> list[Casting]:
    """The scans without the points that lie on other robots.

    Between two poses of its path, a robot may be anywhere on the line between them. After the last one it stands there.
    The N scans have poses in ``map``; their stamps are of the same clock as the paths, and ``senders`` names the robot
    that made each scan. ``paths`` has one for each session of a robot.
    """
    found = [
        suspects
        for robot, own_paths in paths.items()
        if config.robot_radius_m > 0.0
        if (suspects := _suspects(scans, stamps, senders, robot, own_paths, config.robot_radius_m)) is not None
    ]
    kept = list(scans)
    if not found:
        return kept
    for suspects in found:
        _drop(kept, suspects, np.ones(len(suspects.scans), np.bool_))
    certain = {
        robot: cast([scan for scan, sender in zip(kept, senders, strict=True) if sender == robot], config)
        for robot in dict.fromkeys(senders)
    }
    kept = list(scans)
    for suspects in found:
        hits, passes = np.zeros((2, len(suspects.points)))
        for robot, grid in certain.items():
            if robot == suspects.robot:  # it does not decide what is hidden behind its own pose
                continue
            cells = np.floor((suspects.points - grid.origin_xy) / grid.resolution_m).astype(np.int64)
            inside = ((cells >= 0) & (cells < grid.hits.shape[::-1])).all(axis=1)
            columns, rows = cells[inside].T
            hits[inside] += grid.hits[rows, columns]
            passes[inside] += grid.passes[rows, columns]
        _drop(kept, suspects, (passes >= MINIMUM_PASSES) & (hits <= OCCUPIED_RATIO * passes))
    return kept


def _suspects(
    scans: Sequence[Casting],
    stamps: FloatArray,
    senders: Sequence[str],
    robot: str,
    paths: Sequence[RobotPath],
    radius_m: float,
) -> _Suspects | None:
    """Points of other robots' scans that lie on ``robot``; None if no point does."""
    numbers, beams, points = [], [], []
    begin, end = _whereabouts(paths, stamps)
    at = np.array([scan.T_map_base[:2] for scan in scans]).reshape(-1, 2)
    apart_m = _distance(at, begin, end)  # NaN before its first pose
    for k in np.flatnonzero(apart_m - radius_m < [scan.laser.max_range_m for scan in scans]).tolist():
        if senders[k] == robot:
            continue
        scan = scans[k]
        origins, directions = rays_of(scan.laser, scan.sweep)
        reach_m = scan.laser.max_range_m
        hit, at = returns_near(scan.ranges_m, origins, directions, reach_m, scan.T_map_base, begin[k], end[k], radius_m)
        numbers.append(np.full(len(hit), k))
        beams.append(hit)
        points.append(at)
    if not sum(map(len, beams)):
        return None
    return _Suspects(robot, np.concatenate(numbers), np.concatenate(beams), np.concatenate(points))


def _whereabouts(paths: Sequence[RobotPath], stamps: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Both ends of the line on which a robot was at each stamp, shape (N, 2) each; NaN before its first pose."""
    begin, end = np.full((2, len(stamps), 2), np.nan)
    for path in sorted(paths, key=lambda one: float(one.stamps[0])):
        rows = np.searchsorted(path.stamps, stamps, side="right") - 1
        known = rows >= 0
        begin[known] = path.T_map_base[rows[known], :2]
        end[known] = path.T_map_base[np.minimum(rows[known] + 1, len(path.stamps) - 1), :2]
    return begin, end


def _distance(points: FloatArray, begin: FloatArray, end: FloatArray) -> FloatArray:
    along = end - begin
    length = np.maximum((along**2).sum(axis=-1), 1e-12)
    share = np.clip(((points - begin) * along).sum(axis=-1) / length, 0.0, 1.0)
    distance: FloatArray = np.hypot(*np.moveaxis(points - begin - share[..., None] * along, -1, 0))
    return distance


@njit
def returns_near(ranges_m, origins, directions, reach_m, T_map_base, begin, end, radius_m):  # type: ignore[no-untyped-def]
    """Beams whose returns lie within ``radius_m`` of the line between two points, and these returns in ``map``."""
    cos, sin = np.cos(T_map_base[2]), np.sin(T_map_base[2])
    along_x, along_y = end[0] - begin[0], end[1] - begin[1]
    length = max(along_x * along_x + along_y * along_y, 1e-12)
    beams, points = np.empty(len(ranges_m), np.int64), np.empty((len(ranges_m), 2))
    count = 0
    for i in range(len(ranges_m)):
        r = np.float64(ranges_m[i])
        if not (r > 0.0 and r < reach_m):  # true for NaN
            continue
        x, y = origins[i, 0] + r * directions[i, 0], origins[i, 1] + r * directions[i, 1]
        x, y = T_map_base[0] + cos * x - sin * y, T_map_base[1] + sin * x + cos * y
        share = min(max(((x - begin[0]) * along_x + (y - begin[1]) * along_y) / length, 0.0), 1.0)
        if np.hypot(x - begin[0] - share * along_x, y - begin[1] - share * along_y) <= radius_m:
            beams[count], points[count, 0], points[count, 1] = i, x, y
            count += 1
    return beams[:count], points[:count]


def _drop(scans: list[Casting], suspects: _Suspects, chosen: NDArray[np.bool_]) -> None:
    numbers, beams = suspects.scans[chosen], suspects.beams[chosen]  # scan by scan
    kinds, first = np.unique(numbers, return_index=True)
    if not len(numbers):
        return
    for k, hit in zip(kinds.tolist(), np.split(beams, first[1:]), strict=True):
        ranges_m = np.array(scans[k].ranges_m)
        ranges_m[hit] = 0.0
        scans[k] = scans[k]._replace(ranges_m=frozen(ranges_m, np.float32))

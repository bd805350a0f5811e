"""Beams of a scan that hit another robot of the fleet: scans must not be matched by them.

A robot that drives along with this one would look like a wall that stands still to this one. The points stay in the
scan: whether the map shows them is decided where the scans of all robots are known (``fcslam.maps.teammates``).
"""

from collections.abc import Iterable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fcslam.geometry import se2
from fcslam.lidar.scan import rays_of
from fcslam.live.fleet_view import Teammate
from fcslam.records import FloatArray, LaserScan
from fcslam.runs.map_files import Occupancy, OccupancyMap

OLDEST_S: Final = 2.0
"""An older pose does not say where a robot is now."""
SPEED_MPS: Final = 0.5
"""By how much the place of a robot grows with the age of its pose."""
WALL_CELLS: Final = 2
"""A point so few cells from an occupied cell is of that wall."""


def beams_on_teammates(
    scan: LaserScan, T_map_base: FloatArray, mates: Iterable[Teammate], joint: OccupancyMap, radius_m: float
) -> NDArray[np.bool_] | None:
    """Which beams hit another robot, shape (beam_count,); None if none does.

    A pose alone takes no point away, as it may be false. A point counts only if the joint map says that the floor is
    free there, and no wall is near it. So nobody hides a wall of the map. What is new on that floor, such as a closed
    door, does not count while a robot says that it is there.

    Args:
        scan: the scan.
        T_map_base: where it was made, in the frame of ``joint``, shape (3,).
        mates: the other robots in that map.
        joint: the joint map.
        radius_m: of a robot.
    """
    reach_m = scan.laser.max_range_m
    places = [
        (mate.T_map_base[:2], limit_m)
        for mate in mates
        if mate.age_s <= OLDEST_S
        and np.hypot(*(mate.T_map_base - T_map_base)[:2]) <= reach_m + (limit_m := radius_m + SPEED_MPS * mate.age_s)
    ]
    if not places:
        return None
    is_return = (scan.ranges_m > 0.0) & (scan.ranges_m < reach_m)
    rays = rays_of(scan.laser, scan.sweep)
    returns = rays.origins[is_return] + scan.ranges_m[is_return, None] * rays.directions[is_return]
    points = se2.transform(T_map_base, returns)
    apart = np.array([np.hypot(*(points - place).T) <= limit_m for place, limit_m in places])
    near = apart.any(axis=0)
    found = np.zeros(scan.laser.beam_count, np.bool_)
    found[np.flatnonzero(is_return)[near]] = _is_floor(points[near], joint)
    return found if found.any() else None


def _is_floor(points: FloatArray, joint: OccupancyMap) -> NDArray[np.bool_]:
    """Whether points (N, 2) lie in free cells without a wall beside them."""
    size = np.array(joint.cells.shape[::-1])
    cells = np.floor((points - joint.origin_xy) / joint.resolution_m).astype(np.int64)
    inside = np.logical_and(cells >= 0, cells < size).all(axis=1)
    reach = np.arange(-WALL_CELLS, WALL_CELLS + 1)
    columns, rows = np.clip(cells.T[..., None] + reach, 0, size[:, None, None] - 1)  # (N, reach) each
    around = joint.cells[rows[:, :, None], columns[:, None, :]]
    is_free = around[:, WALL_CELLS, WALL_CELLS] == Occupancy.FREE
    found: NDArray[np.bool_] = inside & is_free & ~(around == Occupancy.OCCUPIED).any(axis=(1, 2))
    return found

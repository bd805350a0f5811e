"""Beams of a scan that hit another robot of the fleet: scans must not be matched by them.

A robot that drives along with this one would look like a wall that stands still to this one. The points stay in the
scan: whether the map shows them is decided where the scans of all robots are known (``fcslam.maps.teammates``).
"""

import math
from collections.abc import Iterable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import njit
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
FREE: Final = int(Occupancy.FREE)
OCCUPIED: Final = int(Occupancy.OCCUPIED)


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
    own_x, own_y, _ = T_map_base.tolist()
    near = [
        (x, y, limit_m)
        for mate in mates
        for x, y, _ in [mate.T_map_base.tolist()]
        if mate.age_s <= OLDEST_S
        and math.hypot(x - own_x, y - own_y) <= reach_m + (limit_m := radius_m + SPEED_MPS * mate.age_s)
    ]
    if not near:
        return None
    rays = rays_of(scan.laser, scan.sweep)
    found: NDArray[np.bool_] = _on_discs(
        scan.ranges_m,
        rays.origins,
        rays.directions,
        reach_m,
        np.array(T_map_base),  # a writable copy: code is compiled once
        np.array(near),
        joint.cells,
        np.array(joint.origin_xy),
        joint.resolution_m,
    )
    return found if found.any() else None


@njit
def _on_discs(ranges, origins, directions, reach, pose, discs, cells, corner, side):  # type: ignore[no-untyped-def]
    """Whether each return lies on the free floor of a map, within one of the ``discs`` (x, y, radius)."""
    found = np.zeros(len(ranges), np.bool_)
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    for i in range(len(ranges)):
        r = ranges[i]
        if not 0.0 < r < reach:
            continue
        x, y = origins[i, 0] + r * directions[i, 0], origins[i, 1] + r * directions[i, 1]
        x, y = pose[0] + cos * x - sin * y, pose[1] + sin * x + cos * y
        for k in range(len(discs)):
            if np.hypot(x - discs[k, 0], y - discs[k, 1]) <= discs[k, 2]:
                found[i] = _is_floor(x - corner[0], y - corner[1], cells, side)
                break
    return found


@njit(allocates=False)
def _is_floor(x, y, cells, side):  # type: ignore[no-untyped-def]
    """Whether a point lies in a free cell without a wall beside it; x and y from the map's lower left corner."""
    height, width = cells.shape
    row, column = int(np.floor(y / side)), int(np.floor(x / side))
    if not (0 <= row < height and 0 <= column < width) or cells[row, column] != FREE:
        return False
    for r in range(max(0, row - WALL_CELLS), min(height, row + WALL_CELLS + 1)):
        for c in range(max(0, column - WALL_CELLS), min(width, column + WALL_CELLS + 1)):
            if cells[r, c] == OCCUPIED:
                return False
    return True

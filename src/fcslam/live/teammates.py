"""Beams of a scan that hit another robot of the fleet: scans must not be matched by them.

A robot that drives along with this one would look like a wall that stands still to this one. The points stay in the
scan: whether the map shows them is decided where the scans of all robots are known (``fcslam.maps.teammates``).
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import njit
from fcslam.lidar.scan import rays_of
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap
from fcslam.records import FloatArray, LaserScan

OLDEST_S: Final = 2.0
"""An older pose does not say where a robot is now."""
SPEED_MPS: Final = 0.5
"""By how much the place of a robot grows with the age of its pose."""
WALL_CELLS: Final = 2
"""A point so few cells from an occupied cell is of that wall."""
FREE: Final = int(Occupancy.FREE)
OCCUPIED: Final = int(Occupancy.OCCUPIED)


def beams_on_teammates(
    scan: LaserScan,
    T_map_before: FloatArray,
    T_odom_before: FloatArray,
    places: FloatArray,
    since_s: float,
    joint: OccupancyMap,
    radius_m: float,
) -> NDArray[np.bool_] | None:
    """Which beams hit another robot, shape (beam_count,); None if none does.

    A pose alone takes no point away, as it may be false. A point counts only if the joint map says that the floor is
    free there, and no wall is near it. So nobody hides a wall of the map. What is new on that floor, such as a closed
    door, does not count while a robot says that it is there.

    Args:
        scan: the scan; its odometry says how far the robot drove since the scan before.
        T_map_before: where the scan before was made, in the frame of ``joint``, shape (3,); read-only, as in a record.
        T_odom_before: its odometry, shape (3,); read-only.
        places: of the other robots in that map: x, y and the age of their poses ``since_s`` ago, shape (N, 3), metres
            and seconds.
        since_s: time since then.
        joint, radius_m: the joint map, and the radius of a robot.
    """
    origins, directions = rays_of(scan.laser, scan.sweep)
    found: NDArray[np.bool_] | None = _on_discs(
        scan.ranges_m,
        origins,
        directions,
        scan.laser.max_range_m,
        T_map_before,
        T_odom_before,
        scan.T_odom_base,
        places,
        since_s,
        radius_m,
        joint.cells,
        joint.origin_xy,
        joint.resolution_m,
    )
    return found


@njit
def _on_discs(  # type: ignore[no-untyped-def]
    ranges, origins, directions, reach, T_map_before, T_odom_before, T_odom_base,
    places, since, radius, cells, corner, side,
):  # fmt: skip
    """Whether each return lies on the free floor of a map, where a robot may be; None if none does."""
    pose_x, pose_y, pose_theta = _driven_on(T_map_before, T_odom_before, T_odom_base)
    cos, sin = np.cos(pose_theta), np.sin(pose_theta)
    near = np.empty((len(places), 3))  # x and y in ``base``, and the square of its radius
    count = 0
    for k in range(len(places)):
        dx, dy, age = places[k, 0] - pose_x, places[k, 1] - pose_y, places[k, 2] + since
        limit = radius + SPEED_MPS * age
        if age <= OLDEST_S and np.hypot(dx, dy) <= reach + limit:
            near[count] = cos * dx + sin * dy, cos * dy - sin * dx, limit * limit
            count += 1
    if count == 0:
        return None
    found, is_any = np.zeros(len(ranges), np.bool_), False
    for i in range(len(ranges)):
        r = ranges[i]
        if not 0.0 < r < reach:
            continue
        x, y = origins[i, 0] + r * directions[i, 0], origins[i, 1] + r * directions[i, 1]
        for k in range(count):
            if (x - near[k, 0]) ** 2 + (y - near[k, 1]) ** 2 <= near[k, 2]:
                right, up = pose_x + cos * x - sin * y - corner[0], pose_y + sin * x + cos * y - corner[1]
                found[i] = _is_floor(right, up, cells, side)
                is_any = is_any or found[i]
                break
    return found if is_any else None


@njit(allocates=False)
def _driven_on(T_map_before, T_odom_before, T_odom_base):  # type: ignore[no-untyped-def]
    """x, y and theta in ``map`` after a motion by odometry."""
    dx, dy, turned = (
        T_odom_base[0] - T_odom_before[0],
        T_odom_base[1] - T_odom_before[1],
        T_map_before[2] - T_odom_before[2],
    )
    cos, sin = np.cos(turned), np.sin(turned)  # of ``odom`` in ``map``
    return T_map_before[0] + cos * dx - sin * dy, T_map_before[1] + sin * dx + cos * dy, turned + T_odom_base[2]


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

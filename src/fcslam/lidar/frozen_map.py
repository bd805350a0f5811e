"""A finished occupancy map as a submap: its walls as surfaces, its free cells as free space.

Scans and submaps of a robot are matched with it as with a submap that keyscans made, so one code serves both. The map
may come from any program; nothing but its cells counts.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, gaussian_filter

from fcslam.errors import SourceError
from fcslam.lidar.field import TOO_MANY_WALLS, WIDEST_M, SurfelField
from fcslam.lidar.scan import PointScan
from fcslam.lidar.submap import FREE_CELL_M, Submap
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap
from fcslam.records import FloatArray

NORMAL_M = FREE_CELL_M
"""Width of the Gaussian over free cells whose slope is the normal of a wall."""
COARSEST_M = 0.25
"""Largest side of a cell."""


def frozen_map(occupancy: OccupancyMap, name: str) -> Submap:
    """The surfaces and the free space of a map, which messages call ``name``, in the coordinate frame of the map."""
    side = occupancy.resolution_m
    if side > COARSEST_M:
        raise SourceError(f"{name}: cells of {side:g} m are too coarse; localization needs {COARSEST_M:g} m or finer")
    surface = _surface(occupancy)
    if not len(surface):
        raise SourceError(f"{name}: shows no wall beside free space; is it the right map?")
    low, high = surface.points.min(axis=0), surface.points.max(axis=0)
    if (high - low).max() > WIDEST_M:
        raise SourceError(f"{name}: extends over {(high - low).max():.0f} m; at most {WIDEST_M:.0f} m can be used")
    field = SurfelField(0.5 * (low + high))
    field.insert(surface, np.zeros(3))
    if field.is_full:
        raise SourceError(f"{name}: {TOO_MANY_WALLS}")
    return Submap.of(field, *_free_space(occupancy))


def _surface(occupancy: OccupancyMap) -> PointScan:
    free = occupancy.cells == Occupancy.FREE
    # What lies behind a cell without a free neighbour is never seen.
    beside = (occupancy.cells == Occupancy.OCCUPIED) & binary_dilation(free, np.ones((3, 3), np.bool_))
    rows, columns = np.nonzero(beside)
    slope = np.gradient(gaussian_filter(free.astype(np.float32), NORMAL_M / occupancy.resolution_m))
    normals = np.stack((slope[1][rows, columns], slope[0][rows, columns]), axis=1).astype(np.float64)
    length = np.hypot(normals[:, 0], normals[:, 1])[:, None]
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0.0)
    points = (np.stack((columns, rows), axis=1) + 0.5) * occupancy.resolution_m + np.array(occupancy.origin_xy)
    return PointScan(points, normals, np.zeros(len(points), bool), np.zeros(2))


def _free_space(occupancy: OccupancyMap) -> tuple[NDArray[np.bool_], FloatArray]:
    """Free cells of the size that submaps have: free where every cell of the map at its corners and middle is."""
    corner: FloatArray = np.array(occupancy.origin_xy)
    extent = occupancy.resolution_m * np.array(occupancy.cells.shape[::-1])
    columns, rows = np.floor(extent / FREE_CELL_M + 1e-9).astype(np.int64)
    cells = np.ones((rows, columns), bool)
    for share in (0.02, 0.5, 0.98):
        row = ((np.arange(rows) + share) * FREE_CELL_M / occupancy.resolution_m).astype(np.int64)
        for other in (0.02, 0.5, 0.98):
            column = ((np.arange(columns) + other) * FREE_CELL_M / occupancy.resolution_m).astype(np.int64)
            cells &= occupancy.cells[np.ix_(row, column)] == Occupancy.FREE
    return cells, corner

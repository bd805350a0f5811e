"""Voxel maps of robots with 3D LiDARs: from points to voxels, and from voxels to what a picture from above shows."""

from typing import Final

import numpy as np

from fcslam.records import FloatArray, VoxelMap

_HEIGHTS: Final = 0.3, 2.6, 10
"""Lowest and highest point over the floor that show whether a column is a wall, and the number of heights between."""
_LEAST_HEIGHTS: Final = 3
"""Heights at which a column of a wall is occupied; a table has fewer."""
COLUMN_M: Final = 0.1


def columns(local: VoxelMap) -> FloatArray:
    """Walls from above: the middles of columns that are occupied at several heights, in ``ground``, shape (K, 2)."""
    low_m, high_m, count = _HEIGHTS
    points = local.points_m
    height = np.floor((points[:, 2] - low_m) / (high_m - low_m) * count).astype(np.int64)
    inside = (height >= 0) & (height < count)
    cells = np.floor(points[inside, :2] / COLUMN_M).astype(np.int64)
    seen = np.unique(np.column_stack((cells, height[inside])), axis=0)
    walls, heights = np.unique(seen[:, :2], axis=0, return_counts=True)
    return np.asarray((walls[heights >= _LEAST_HEIGHTS] + 0.5) * COLUMN_M, np.float64)

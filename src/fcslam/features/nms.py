"""Non-maximum suppression by boxes around keypoints, as in SuperPoint's evaluation."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fcslam.compiled import njit

MOST_OVERLAP = 0.1
"""Largest intersection over union of two boxes. With integer pixels and boxes of side 4, keypoints 4 px apart along an
axis stay, and so do keypoints 3 px apart along one axis and 2 px along the other."""


def box_nms(positions_px: ArrayLike, side_px: float) -> NDArray[np.int64]:
    """Rows (K,), ascending, of the keypoints that no box of a stronger one overlaps by more than ``MOST_OVERLAP``.

    ``positions_px`` (N, 2) are finite, the strongest first. Suppressed keypoints suppress none. Boxes of side 0 keep
    everything.
    """
    points = np.asarray(positions_px, np.float64).reshape(-1, 2)
    if side_px <= 0.0 or not len(points):
        return np.arange(len(points))
    cells = np.floor((points - points.min(axis=0)) / side_px).astype(np.int64)
    rows: NDArray[np.int64] = np.flatnonzero(_keep(points, cells, float(side_px)))
    return rows


@njit
def _keep(points: NDArray[np.float64], cells: NDArray[np.int64], side: float) -> NDArray[np.bool_]:
    """Mask of the remaining keypoints. Only boxes in neighbouring cells can overlap; each cell chains its keypoints."""
    columns, rows = cells[:, 0].max() + 3, cells[:, 1].max() + 3
    newest = np.full((rows, columns), -1)
    before = np.full(len(points), -1)
    kept = np.zeros(len(points), np.bool_)
    for i in range(len(points)):
        column, row = cells[i, 0] + 1, cells[i, 1] + 1
        free = True
        for v in range(row - 1, row + 2):
            for u in range(column - 1, column + 2):
                j = newest[v, u]
                while free and j >= 0:
                    width = side - abs(points[i, 0] - points[j, 0])
                    height = side - abs(points[i, 1] - points[j, 1])
                    if width > 0.0 and height > 0.0:
                        common = width * height
                        free = common <= MOST_OVERLAP * (2.0 * side * side - common)
                    j = before[j]
        if free:
            kept[i] = True
            before[i], newest[row, column] = newest[row, column], i
    return kept

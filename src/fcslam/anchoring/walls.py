"""The direction of a map's walls."""

from typing import Final

import numpy as np

from fcslam.geometry import se2
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap
from fcslam.records import FloatArray

_COARSE_RAD: Final = float(np.radians(0.5))
_FINE_RAD: Final = float(np.radians(0.02))
"""Steps of the search for the direction of walls."""


def wall_direction(occupancy: OccupancyMap) -> float:
    """Direction of most walls, radians in [-pi/4, pi/4): walls along it and across it count the same.

    The direction is the one whose projections of the occupied cells are the most peaked.
    """
    rows, columns = np.nonzero(occupancy.cells == Occupancy.OCCUPIED)
    cells = np.stack((columns, rows), axis=-1) - np.array(occupancy.cells.shape[::-1]) / 2.0
    if not len(cells):
        return 0.0
    coarse = np.arange(-np.pi / 4, np.pi / 4, _COARSE_RAD)
    best = coarse[np.argmax([_peakedness(cells, angle) for angle in coarse])]
    fine = np.arange(best - _COARSE_RAD, best + _COARSE_RAD, _FINE_RAD)
    angle = float(fine[np.argmax([_peakedness(cells, angle) for angle in fine])])
    return (angle + np.pi / 4) % (np.pi / 2) - np.pi / 4


def _peakedness(cells: FloatArray, angle: float) -> float:
    """Sum of squares of the histograms of both coordinates of cells (N, 2), turned by -angle."""
    turned = se2.transform(np.array([0.0, 0.0, -angle]), cells)
    reach = int(np.ceil(np.hypot(*np.abs(cells).max(axis=0)))) + 1
    counts = (np.bincount(np.floor(axis + reach).astype(np.int64)) for axis in turned.T)
    return float(sum((count.astype(np.float64) ** 2).sum() for count in counts))

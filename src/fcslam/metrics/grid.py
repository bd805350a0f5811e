"""How well an occupancy grid agrees with the true one: surfaces within a tolerance, free space cell by cell.

Every occupied cell of the map must be near a true surface, also where the truth knows nothing: the true grid holds all
that the robots' beams could reach, so a surface elsewhere is invented.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fcslam.geometry import se2
from fcslam.records import FloatArray

TOLERANCE_M = 0.10
_ROUNDING_M = 1e-6
"""Cells exactly as far apart as the tolerance are near in whatever coordinate frame they are compared."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class LabelledGrid:
    """An occupancy grid that has been decided; cells that are neither occupied nor free are unknown."""

    occupied: Mask
    """Shape (H, W); row 0 is the lowest y, column 0 the lowest x of ``grid``."""
    free: Mask
    """Shape (H, W)."""
    resolution_m: float
    T_frame_grid: FloatArray
    """Where the lower left corner of cell (0, 0) lies, shape (3,)."""

    def centres(self, cells: Mask) -> FloatArray:
        """Centres (N, 2) of the cells for which ``cells``, shape (H, W), holds, in the grid's frame."""
        row, column = np.nonzero(cells)
        return se2.transform(self.T_frame_grid, (np.column_stack((column, row)) + 0.5) * self.resolution_m)

    def is_free(self, points: FloatArray) -> Mask:
        """Whether points (N, 2) in the grid's frame lie in free cells, shape (N,); outside nothing is free."""
        in_grid = se2.transform(se2.inverse(self.T_frame_grid), points)
        column, row = np.floor(in_grid / self.resolution_m).astype(np.int64).T
        height, width = self.free.shape
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        free = np.zeros(len(points), dtype=np.bool_)
        free[inside] = self.free[row[inside], column[inside]]
        return free


@dataclass(frozen=True, slots=True)
class GridAgreement:
    """A map against the true one; NaN where there is nothing to compare."""

    precision: float
    """Share of the map's occupied cells with a truly occupied one within the tolerance."""
    recall: float
    """Share of the truly occupied cells with an occupied one of the map within the tolerance."""
    free_iou: float
    """Area free in both over the area free in one of them."""

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall."""
        if self.recall == 0.0:  # then nothing is precise either, and a map without surfaces has no precision
            return 0.0
        return 2.0 * self.precision * self.recall / (self.precision + self.recall)


def grid_agreement(
    grid: LabelledGrid, truth: LabelledGrid, T_truth_map: FloatArray, tolerance_m: float = TOLERANCE_M
) -> GridAgreement:
    """Agreement of ``grid``, whose frame ``map`` is ``T_truth_map`` (3,) in the true one, with ``truth``.

    Nothing is resampled: centres of cells are moved, and free space is looked up at them.
    """
    if not np.isfinite(T_truth_map).all():
        return GridAgreement(np.nan, np.nan, np.nan)
    surfaces = se2.transform(T_truth_map, grid.centres(grid.occupied))
    true_surfaces = truth.centres(truth.occupied)
    return GridAgreement(
        _share_near(surfaces, true_surfaces, tolerance_m),
        _share_near(true_surfaces, surfaces, tolerance_m),
        _free_iou(grid, truth, T_truth_map),
    )


def _share_near(points: FloatArray, others: FloatArray, tolerance_m: float) -> float:
    """Share of ``points`` (N, 2) with one of ``others`` (M, 2) within the tolerance; NaN of none."""
    if not len(points):
        return np.nan
    if not len(others):
        return 0.0
    distance, _ = cKDTree(others).query(points, distance_upper_bound=tolerance_m + 2.0 * _ROUNDING_M)
    return float(np.mean(distance <= tolerance_m + _ROUNDING_M))


def _free_iou(grid: LabelledGrid, truth: LabelledGrid, T_truth_map: FloatArray) -> float:
    """From both sides: what is free in truth is looked up in the map, and what is free in the map in the truth."""
    T_map_truth = se2.inverse(T_truth_map)
    true_cells = truth.centres(truth.free)
    cells = grid.centres(grid.free)
    in_both = float(np.sum(grid.is_free(se2.transform(T_map_truth, true_cells)))) * truth.resolution_m**2
    invented = float(np.sum(~truth.is_free(se2.transform(T_truth_map, cells)))) * grid.resolution_m**2
    union = len(true_cells) * truth.resolution_m**2 + invented
    return in_both / union if union else np.nan

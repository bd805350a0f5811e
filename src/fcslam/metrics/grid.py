"""Agreement of an occupancy grid with the true one: surfaces within a tolerance, free space cell by cell.

Every occupied cell of the map must be near a true surface, even where the true grid is unknown. The true grid has all
surfaces that the robots' beams can reach, so a surface elsewhere is wrong.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fcslam.geometry import se2
from fcslam.records import FloatArray

TOLERANCE_M = 0.10
"""Largest distance of an occupied cell to its true counterpart: two cells of 0.05 m."""
_ROUNDING_M = 1e-6
"""Added to the tolerance, so that cells exactly that far apart match in every coordinate frame."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class LabelledGrid:
    """A classified occupancy grid; cells that are neither occupied nor free are unknown."""

    occupied: Mask
    """Shape (H, W); row 0 is the lowest y, column 0 the lowest x of ``grid``."""
    free: Mask
    """Shape (H, W)."""
    resolution_m: float
    T_frame_grid: FloatArray
    """Pose of the lower left corner of cell (0, 0), shape (3,)."""

    def centres(self, cells: Mask) -> FloatArray:
        """Centres (N, 2) of the cells selected by ``cells``, shape (H, W), metres in the grid's frame."""
        row, column = np.nonzero(cells)
        return se2.transform(self.T_frame_grid, (np.column_stack((column, row)) + 0.5) * self.resolution_m)

    def is_free(self, points: FloatArray) -> Mask:
        """Whether points (N, 2), metres in the grid's frame, lie in free cells, shape (N,); False outside the grid."""
        in_grid = se2.transform(se2.inverse(self.T_frame_grid), points)
        column, row = np.floor(in_grid / self.resolution_m).astype(np.int64).T
        height, width = self.free.shape
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        free = np.zeros(len(points), dtype=np.bool_)
        free[inside] = self.free[row[inside], column[inside]]
        return free


@dataclass(frozen=True, slots=True)
class GridAgreement:
    """Agreement of a map with the true one; NaN if it is undefined."""

    precision: float
    """Share of the map's occupied cells with a truly occupied cell within the tolerance."""
    recall: float
    """Share of the truly occupied cells with an occupied cell of the map within the tolerance."""
    free_iou: float
    """Intersection over union of the free areas."""

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall."""
        if self.recall == 0.0:  # precision is 0 too, or undefined for a map without surfaces
            return 0.0
        return 2.0 * self.precision * self.recall / (self.precision + self.recall)


def grid_agreement(grid: LabelledGrid, truth: LabelledGrid, T_truth_map: FloatArray) -> GridAgreement:
    """Compare ``grid`` with ``truth``.

    Grids are not resampled: cell centres are transformed, and free space is looked up at them. ``T_truth_map`` (3,) is
    the pose of ``map`` in the frame of the truth; NaN if unknown.
    """
    if not np.isfinite(T_truth_map).all():
        return GridAgreement(np.nan, np.nan, np.nan)
    surfaces = se2.transform(T_truth_map, grid.centres(grid.occupied))
    true_surfaces = truth.centres(truth.occupied)
    return GridAgreement(
        _share_near(surfaces, true_surfaces),
        _share_near(true_surfaces, surfaces),
        _free_iou(grid, truth, T_truth_map),
    )


def _share_near(points: FloatArray, others: FloatArray) -> float:
    """Share of ``points`` (N, 2) with one of ``others`` (M, 2) within the tolerance; NaN without points."""
    if not len(points):
        return np.nan
    if not len(others):
        return 0.0
    distance, _ = cKDTree(others).query(points, distance_upper_bound=TOLERANCE_M + 2.0 * _ROUNDING_M)
    return float(np.mean(distance <= TOLERANCE_M + _ROUNDING_M))


def _free_iou(grid: LabelledGrid, truth: LabelledGrid, T_truth_map: FloatArray) -> float:
    """IoU of free space: truly free cells are looked up in the map, and free cells of the map in the truth."""
    T_map_truth = se2.inverse(T_truth_map)
    true_cells = truth.centres(truth.free)
    cells = grid.centres(grid.free)
    in_both = float(np.sum(grid.is_free(se2.transform(T_map_truth, true_cells)))) * truth.resolution_m**2
    invented = float(np.sum(~truth.is_free(se2.transform(T_truth_map, cells)))) * grid.resolution_m**2
    union = len(true_cells) * truth.resolution_m**2 + invented
    return in_both / union if union else np.nan

"""The drivable space of a floor plan, and shortest paths in it that keep clear of obstacles.

The clearance of a point is its distance to the nearest wall or piece of furniture, computed on a fine grid. Paths are
searched on a coarser grid, whose points are numbered, and then straightened.
"""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, label, map_coordinates
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree

from fcslam.errors import InputError
from fcslam.geometry.cell_graph import cell_graph
from fcslam.lab.simulation.floorplan import FloorPlan, PieceKind
from fcslam.records import FloatArray, frozen

ROBOT_RADIUS_M = 0.25
_CLEARANCE_M = ROBOT_RADIUS_M + 0.05
"""Smallest clearance of a path; the margin exceeds the rounding of the grid."""
_COMFORT_M = 0.8
"""Clearance above which a metre has its plain cost of 1."""
CELL_M = 0.05
"""Side of a cell of the fine grid."""
_STEP = 2
"""Cells between two points of the search grid."""

Cells = NDArray[np.bool_]


class DrivableSpace:
    """Positions of a robot's centre: the largest connected area with enough clearance."""

    def __init__(self, plan: FloorPlan) -> None:
        """Compute the drivable space of ``plan`` with its furniture."""
        self._clearance_m = CELL_M * distance_transform_edt(~obstacle_cells(plan))
        parts, count = label(self._clearance_m[::_STEP, ::_STEP] >= _CLEARANCE_M, np.ones((3, 3)))
        if not count:
            raise InputError(
                f"the building has no place for a robot of {ROBOT_RADIUS_M:g} m radius; make its corridors wider"
            )
        self._inside: Cells = parts == 1 + np.argmax(np.bincount(parts.ravel())[1:])
        rows, columns = np.nonzero(self._inside)
        self.points: FloatArray = frozen((np.column_stack((columns, rows)) * _STEP + 0.5) * CELL_M)
        """Points (N, 2) of the search grid, 0.1 m apart, metres in ``building``."""
        self._nearby = KDTree(self.points)

    def nearest(self, point: FloatArray) -> int:
        """Number of the grid point nearest to ``point`` (2,)."""
        return int(self._nearby.query(point)[1])

    def costs(self, start: int) -> FloatArray:
        """Costs (N,) of the cheapest paths from grid point ``start`` to all points: metres, more in narrow places."""
        return np.asarray(dijkstra(self._graph, indices=np.array(start)))

    def path(self, start: int, end: int) -> FloatArray:
        """Corners (K, 2) of a cheap path of straight legs between two grid points, both included."""
        _, before = dijkstra(self._graph, indices=np.array(start), return_predecessors=True)
        numbers = [end]
        while numbers[-1] != start:
            numbers.append(int(before[numbers[-1]]))
        return self._straightened(self.points[numbers[::-1]])

    def leg_costs(self, start: FloatArray, ends: FloatArray) -> FloatArray:
        """Costs (M,) of straight legs from ``start`` (2,) to ``ends`` (M, 2); infinite if a robot would collide."""
        lengths = np.linalg.norm(ends - start, axis=1)
        shares = np.linspace(0.0, 1.0, 2 + int(lengths.max(initial=0.0) / CELL_M))
        samples = start + shares[:, None, None] * (ends - start)
        cells = (samples / CELL_M - 0.5)[..., ::-1]
        clearance_m = map_coordinates(self._clearance_m, cells.reshape(-1, 2).T, order=1, mode="nearest")
        clearance_m = clearance_m.reshape(len(shares), len(ends))
        costs = lengths * np.mean(_price(clearance_m), axis=0)
        return np.where(np.min(clearance_m, axis=0) >= _CLEARANCE_M, costs, np.inf)

    def _straightened(self, path: FloatArray) -> FloatArray:
        """Remove corners from a path (K, 2) as long as the cost hardly grows; clearance counts as in the search."""
        steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
        clearance_m = map_coordinates(self._clearance_m, (path / CELL_M - 0.5).T[::-1], order=1, mode="nearest")
        price = _price(clearance_m)
        driven = np.insert(np.cumsum(steps), 0, 0.0)
        spent = np.insert(np.cumsum(steps * 0.5 * (price[1:] + price[:-1])), 0, 0.0)
        corners, last = [0], len(path) - 1
        while corners[-1] < last:
            here = corners[-1]
            far = max(here + 2, int(np.searchsorted(driven, driven[here] + 20.0)))
            # A straight leg may cost 5 % more than the path that it replaces, and 0.2 m, because turns take time.
            allowed = 1.05 * (spent[here + 1 : far] - spent[here]) + 0.2
            good = np.flatnonzero(self.leg_costs(path[here], path[here + 1 : far]) <= allowed)
            corners.append(here + 1 + int(good[-1] if len(good) else 0))
        return path[corners]

    @cached_property
    def _graph(self) -> csr_array:
        """Costs (N, N) of the steps between neighbouring grid points, diagonal steps included."""
        return cell_graph(self._inside, _STEP * CELL_M, _price(self._clearance_m[::_STEP, ::_STEP]))


def _price(clearance_m: FloatArray) -> FloatArray:
    tightness = np.clip((_COMFORT_M - clearance_m) / (_COMFORT_M - _CLEARANCE_M), 0.0, 1.0)
    return np.asarray(1.0 + 2.0 * tightness**2)


def obstacle_cells(plan: FloorPlan) -> Cells:
    """Occupied cells, shape (H, W), row 0 in the south."""
    width, height = (int(np.ceil(size / CELL_M)) for size in plan.size_m)
    occupied = np.zeros((height, width), dtype=bool)
    reach = CELL_M * np.sqrt(0.5)
    for piece in plan.pieces:
        if piece.kind is PieceKind.LINTEL:
            continue
        low = np.maximum(((piece.outline.min(axis=0) - reach) / CELL_M).astype(int), 0)
        high = ((piece.outline.max(axis=0) + reach) / CELL_M).astype(int) + 1
        block = occupied[low[1] : high[1], low[0] : high[0]]
        rows, columns = np.indices(block.shape)
        centres = (np.stack((columns, rows), axis=-1) + low + 0.5) * CELL_M
        block |= np.all(_outside_m(centres, piece.outline) < reach, axis=-1)
    return occupied


def _outside_m(points: FloatArray, outline: FloatArray) -> FloatArray:
    """Signed distances (..., K) of points (..., 2) to the sides of an outline (K, 2), positive outside."""
    along = np.roll(outline, -1, axis=0) - outline
    normals = np.column_stack((along[:, 1], -along[:, 0])) / np.linalg.norm(along, axis=1)[:, None]
    return np.asarray(points @ normals.T - np.sum(normals * outline, axis=1))

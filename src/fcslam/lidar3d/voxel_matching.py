"""Alignment of two voxel maps, and whether they show the same place: surfaces on surfaces, and none in free space."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import njit
from fcslam.geometry import se3
from fcslam.geometry.groups import SE3
from fcslam.lidar.verification import CLOSURE_SIGMA_M, CLOSURE_SIGMA_RAD, UNFIXED
from fcslam.records import FloatArray, Reason, ReasonCode, VoxelMap

_NEIGHBOURS: Final = 16
"""Points around each one that give the direction of a surface."""
_FLAT, _WIDE, _PARALLEL = 0.15, 0.1, 0.9
"""Largest spread of points across a plane, as a share of that along it, and least of that along a second axis; least
cosine of two planes that are one."""
_REACHES_M, _ROUNDS = (0.6, 0.2), 10
"""Farthest corresponding points, for the guess and for the result, and the rounds from the first to the last."""
_OUTLIER, _RIDGE = 0.15, 1e-3
"""Width of the Cauchy loss as a share of the reach, and damping of directions that no plane fixes."""
_MOST_ALIGNED: Final = 3000
_ON_SURFACE_M: Final = 0.15
"""A point is on a surface that has a point so near."""
_OFF_SURFACE_M: Final = 0.4
"""A point in free space contradicts a map if it has no point so near."""
_FREE_M: Final = 0.2
"""Side of the cells of free space."""
_BEFORE_SURFACE_M: Final = 0.35
"""Free space ends so far before the point that a ray hit."""
_GRID: Final = (128, 128, 48), (-12.8, -12.8, -3.2)
"""Cells of free space, and the lowest corner."""
_SIGMA_M: Final = 0.5
"""Standard deviation of a point across its surface, for the information: those of neighbours are correlated."""
LEAST_SHARE, LARGEST_VIOLATION, LEAST_POINTS = 0.75, 0.06, 600
"""For points in known space: least share on surfaces, largest share in free space, least number on surfaces."""

ONE_PLACE: Final = 0.88
"""Least such share of points on surfaces, for what a robot saw within seconds: 0.91 in one room, 0.85 in two."""


@dataclass(frozen=True, eq=False)
class PreparedMap:
    """A voxel map, ready to be aligned and compared."""

    points: FloatArray
    """In ``ground``, metres, shape (N, 3)."""
    origins: FloatArray
    """From where each point was seen, shape (N, 3)."""

    @cached_property
    def planes(self) -> FloatArray:
        """The points of planes beside the directions that these face, shape (K, 6).

        Neighbours along one ring of a scanner show no plane, and the two sides of a wall are two.
        """
        points, count = self.points, min(_NEIGHBOURS, len(self.points))
        _, near = self.near.query(points, count)
        view = self.origins - points
        view /= np.linalg.norm(view, axis=1, keepdims=True) + 1e-9
        near = near.reshape(len(points), count)
        weight = ((view[near] * view[:, None]).sum(axis=2) > 0.0).astype(np.float64)
        weight /= weight.sum(axis=1, keepdims=True)
        around = points[near] - np.einsum("nk,nka->na", weight, points[near])[:, None]
        values, axes = np.linalg.eigh(np.einsum("nk,nka,nkb->nab", weight, around, around))
        normals = axes[:, :, 0] * np.where((axes[:, :, 0] * view).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
        is_plane = (values[:, 0] < _FLAT * values[:, 1]) & (values[:, 1] > _WIDE * values[:, 2])
        return np.hstack((points, normals))[is_plane]

    @cached_property
    def near_planes(self) -> Any:
        """Finds the nearest points of ``planes``."""
        from scipy.spatial import cKDTree

        return cKDTree(self.planes[:, :3])

    @cached_property
    def free(self) -> NDArray[np.bool_]:
        """Cells that rays passed, as ``_GRID``."""
        shape, corner = _GRID
        free = np.zeros(shape, np.bool_)
        _pass_rays(self.points, self.origins, np.array(corner), free)
        return free

    @cached_property
    def deep_free(self) -> NDArray[np.bool_]:
        """Those cells of ``free`` whose neighbours are free, too: rays that graze a thin thing pass beside it."""
        from scipy.ndimage import binary_erosion

        return np.asarray(binary_erosion(self.free, np.ones((3, 3, 3), np.bool_)), np.bool_)

    @cached_property
    def near(self) -> Any:
        """Finds the nearest points."""
        from scipy.spatial import cKDTree

        return cKDTree(self.points)


def prepared(voxels: VoxelMap) -> PreparedMap:
    """Prepare a voxel map."""
    return PreparedMap(voxels.points_m, voxels.origins_m[voxels.seen_from])


def align_maps(a: PreparedMap, b: PreparedMap, T_a_b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """T_a_b (7,) between the frames ``ground`` of two maps, and its information (6, 6) in the coordinates of b.

    Iterated least squares of the distances across planes that both maps show, from a guess on. Whether the result is
    right, it does not know; the information says which directions no plane fixes.
    """
    sample = b.planes[:: max(1, len(b.planes) // _MOST_ALIGNED)]
    points, normals = np.hsplit(sample, 2)
    targets, directions = np.hsplit(a.planes, 2)
    hessian = np.zeros((6, 6))
    for reach_m in np.geomspace(*_REACHES_M, _ROUNDS):
        turn, moved = se3.rotation(T_a_b), se3.transform(T_a_b, points)
        distance_m, nearest = a.near_planes.query(moved, distance_upper_bound=reach_m)
        rows = np.flatnonzero(np.isfinite(distance_m))
        parallel = (normals[rows] @ turn.T * directions[nearest[rows]]).sum(axis=1) > _PARALLEL
        rows, nearest = rows[parallel], nearest[rows[parallel]]
        off = (directions[nearest] * (targets[nearest] - moved[rows])).sum(axis=1)
        across = directions[nearest] @ turn
        jacobian = np.hstack((across, np.cross(points[rows], across)))
        weighted = jacobian / (1.0 + (off / (_OUTLIER * reach_m)) ** 2)[:, None]
        hessian = weighted.T @ jacobian
        T_a_b = se3.compose(T_a_b, se3.exp(np.linalg.solve(hessian + _RIDGE * np.eye(6), weighted.T @ off)))
    unit = SE3.sigmas(CLOSURE_SIGMA_M, CLOSURE_SIGMA_RAD)
    scaled = hessian * (len(b.planes) / max(1, len(sample)) / _SIGMA_M**2) * np.outer(unit, unit)
    values, axes = np.linalg.eigh(scaled)
    values = np.clip(values, UNFIXED * CLOSURE_SIGMA_RAD**2, 1.0)
    information = (axes * values) @ axes.T / np.outer(unit, unit)
    return T_a_b, np.asarray(0.5 * (information + information.T), np.float64)


def _agreement(query: PreparedMap, target: PreparedMap, T_target_query: FloatArray) -> tuple[float, float, int]:
    """How well ``query``, whose points are counted, agrees with ``target``.

    Returns, of the points in known space, the share on a surface, that in free space and well away from any surface,
    and the number on a surface.
    """
    points = se3.transform(T_target_query, query.points)
    distance_m, _ = target.near.query(points, distance_upper_bound=_OFF_SURFACE_M)
    is_free = _at(points, target.free)
    explained = distance_m <= _ON_SURFACE_M
    known = max(1, int(np.count_nonzero(explained | is_free)))
    count = int(np.count_nonzero(explained))
    violating = int(np.count_nonzero(is_free & (distance_m > _OFF_SURFACE_M)))
    return count / known, violating / known, count


def seen_through(query: PreparedMap, target: PreparedMap, T_target_query: FloatArray) -> tuple[int, int]:
    """The number of points of ``query`` in known space of ``target``, and of those deep in its free space.

    Points that are deep in free space of the query itself do not count: they are of people.
    """
    points = se3.transform(T_target_query, query.points[~_at(query.points, query.deep_free)])
    distance_m, _ = target.near.query(points, distance_upper_bound=_OFF_SURFACE_M)
    known = (distance_m <= _ON_SURFACE_M) | _at(points, target.free)
    through = (distance_m > _OFF_SURFACE_M) & _at(points, target.deep_free)
    return int(np.count_nonzero(known)), int(np.count_nonzero(through))


def disagreement(a: PreparedMap, b: PreparedMap, T_a_b: FloatArray, predicted: bool) -> Reason | None:
    """Why two maps do not show the same place at a transform; None if they do. A ``predicted`` one needs less."""
    shares, violations, counts = zip(_agreement(b, a, T_a_b), _agreement(a, b, se3.inverse(T_a_b)), strict=True)
    explained, violation, count, slack = min(shares), max(violations), min(counts), 2.0 if predicted else 1.0
    least, largest = 1.0 - slack * (1.0 - LEAST_SHARE), slack * LARGEST_VIOLATION
    if explained < least:
        return Reason(ReasonCode.NOT_ENOUGH_EXPLAINED, explained, least)
    if count < LEAST_POINTS:
        return Reason(ReasonCode.FEW_POINTS, count, LEAST_POINTS)
    if violation > largest:
        return Reason(ReasonCode.IN_FREE_SPACE, violation, largest)
    return None


def show_one_place(a: PreparedMap, b: PreparedMap) -> bool:
    """Whether two maps of one robot in one frame explain nearly all points of each other that are in known space."""
    shares = _agreement(a, b, se3.IDENTITY)[0], _agreement(b, a, se3.IDENTITY)[0]
    return min(shares) > ONE_PLACE


def _at(points: FloatArray, cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The values of cells as ``_GRID`` at points (N, 3), shape (N,); False outside."""
    shape, corner = _GRID
    rows = np.floor((points - corner) / _FREE_M).astype(np.int64)
    inside = ((rows >= 0) & (rows < shape)).all(axis=1)
    found = np.zeros(len(points), np.bool_)
    found[inside] = cells[tuple(rows[inside].T)]
    return found


@njit(allocates=False)
def _pass_rays(points, origins, corner, free):  # type: ignore[no-untyped-def]
    """Mark the cells between each point and where it was seen from."""
    for k in range(len(points)):
        length = 0.0
        for axis in range(3):
            length += (points[k, axis] - origins[k, axis]) ** 2
        length = np.sqrt(length)
        for step in range(int((length - _BEFORE_SURFACE_M) / (0.5 * _FREE_M))):
            share = step * 0.5 * _FREE_M / length
            cx = int(np.floor((origins[k, 0] + share * (points[k, 0] - origins[k, 0]) - corner[0]) / _FREE_M))
            cy = int(np.floor((origins[k, 1] + share * (points[k, 1] - origins[k, 1]) - corner[1]) / _FREE_M))
            cz = int(np.floor((origins[k, 2] + share * (points[k, 2] - origins[k, 2]) - corner[2]) / _FREE_M))
            if 0 <= cx < free.shape[0] and 0 <= cy < free.shape[1] and 0 <= cz < free.shape[2]:
                free[cx, cy, cz] = True

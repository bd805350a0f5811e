"""How a building differs from its floor plan: walls that are missing, new, or somewhere else."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from fcslam.anchoring.alignment import LEAST_SHARE
from fcslam.lidar.field import EMPTY, SurfelField
from fcslam.lidar.submap import FREE_CELL_M, SPACING_M, Submap
from fcslam.maps.changes import TOLERANCE_M
from fcslam.records import FloatArray

OFF_M: Final = TOLERANCE_M
"""A wall that is off by less stands where the plan has it."""
AWAY_M: Final = 3.0 * OFF_M
"""A surface farther than this from any surface of the other map is not in that map."""
SHORTEST_M: Final = 1.5
"""Shortest wall that is missing or moved: shorter lines of a plan are furniture and doors."""
SHORTEST_NEW_M: Final = 2.0
"""Shortest new wall, as shorter surfaces are furniture; a missing wall that stands parallel within it has moved."""
_STEPS: Final = round(2.0 * AWAY_M / SPACING_M)
"""Steps of ``SPACING_M`` to either side in which a wall is looked for."""
JOINED_M: Final = 0.35
"""Points of one wall are at most this far apart."""
PARALLEL: Final = 0.94
"""Least cosine between the normals of one wall."""


class DeviationKind(StrEnum):
    """What happened to a wall."""

    MISSING = "missing"
    """It is in the plan, and scans passed through it."""
    NEW = "new"
    """It is not in the plan."""
    MOVED = "moved"
    """It stands parallel to its place in the plan."""


@dataclass(frozen=True, slots=True)
class Deviation:
    """A wall that is not as the plan has it; coordinates are those of the plan, metres."""

    kind: DeviationKind
    start: tuple[float, float]
    """One end: of a moved wall, in the plan."""
    end: tuple[float, float]
    by_m: float | None = None
    """How far a moved wall stands from its place."""

    @property
    def length_m(self) -> float:
        """Length of the wall that differs."""
        return math.dist(self.start, self.end)


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """A map compared with the plan."""

    deviations: tuple[Deviation, ...]
    """The longest first."""
    confirmed_m: float
    """Length of the plan's surface that scans saw where the plan has it."""
    mean_off_m: float
    """Mean distance of the confirmed surface from the plan; NaN without any."""


@dataclass(frozen=True, slots=True, eq=False)
class _Wall:
    points: FloatArray
    normals: FloatArray
    off_m: float | None
    """Median distance of the other map's wall; None if no wall is close by."""

    @property
    def normal(self) -> FloatArray:
        """Direction across the wall, shape (2,)."""
        _, vectors = np.linalg.eigh(self.normals.T @ self.normals)
        return np.asarray(vectors[:, 1])

    def along(self, normal: FloatArray) -> tuple[float, float]:
        """First and last coordinate along walls with this normal."""
        at = self.points @ (-normal[1], normal[0])
        return float(at.min()), float(at.max())

    def deviation(self, kind: DeviationKind, by_m: float | None = None) -> Deviation:
        """The wall as a deviation of this kind."""
        normal = self.normal
        across = float(np.median(self.points @ normal)) * normal
        (x0, y0), (x1, y1) = (across + at * np.array((-normal[1], normal[0])) for at in self.along(normal))
        return Deviation(kind, (float(x0), float(y0)), (float(x1), float(y1)), by_m)


def compare_with_plan(plan: Submap, building: Submap) -> Comparison:
    """Find the walls of a building, a map in the coordinates of the plan, that differ from the plan."""
    points, normals = plan.surface.points, plan.surface.normals
    across = _across(points, normals, building.field)
    confirmed, unseen = np.abs(across) <= OFF_M, np.isnan(across)
    passed = unseen & _in_free(points, building) & (_distance(points, building) > AWAY_M)
    unknown = _distance(building.surface.points, plan) > AWAY_M
    new = list(_walls(building.surface.points, building.surface.normals, np.zeros(len(unknown)), unknown))
    taken: set[int] = set()
    found: list[Deviation] = []
    for wall in _walls(points, normals, across, passed | (~unseen & ~confirmed)):
        match = _moved(wall, new, SHORTEST_NEW_M)
        if match is not None:
            taken.add(match[0])
        by_m = wall.off_m if wall.off_m is not None else match[1] if match is not None else None
        found.append(wall.deviation(DeviationKind.MISSING if by_m is None else DeviationKind.MOVED, by_m))
    found += [wall.deviation(DeviationKind.NEW) for k, wall in enumerate(new) if k not in taken]
    least_m = {DeviationKind.NEW: SHORTEST_NEW_M}
    kept = [deviation for deviation in found if deviation.length_m >= least_m.get(deviation.kind, SHORTEST_M)]
    kept.sort(key=lambda deviation: (-deviation.length_m, deviation.start))
    mean_off_m = float(np.abs(across[confirmed]).mean()) if confirmed.any() else float("nan")
    return Comparison(tuple(kept), SPACING_M * int(confirmed.sum()), mean_off_m)


def _across(points: FloatArray, normals: FloatArray, field: SurfelField) -> FloatArray:
    """Distance of the other map's surface from each point (N, 2) along its normal; NaN if no surface is close by."""
    across = np.full(len(points), np.nan)
    for shift_m in sorted(np.arange(-_STEPS, _STEPS + 1) * SPACING_M, key=abs):
        rows = np.flatnonzero(np.isnan(across))
        labels = field.nearest(points[rows] + shift_m * normals[rows])
        rows, labels = rows[labels != EMPTY], labels[labels != EMPTY]
        apart = field.points[labels] - points[rows]
        distance = np.einsum("na,na->n", apart, normals[rows])
        beside2 = np.einsum("na,na->n", apart, apart) - distance**2
        same = np.einsum("na,na->n", field.normals[labels], normals[rows]) > PARALLEL
        same &= (beside2 < (2.0 * SPACING_M) ** 2) & (np.abs(distance - shift_m) <= SPACING_M)
        across[rows[same]] = distance[same]
    return across


def _distance(points: FloatArray, other: Submap) -> FloatArray:
    if not len(other.field.points):
        return np.full(len(points), np.inf)
    return np.asarray(cKDTree(other.field.points).query(points)[0])


def _in_free(points: FloatArray, building: Submap) -> NDArray[np.bool_]:
    free = building.free
    column, row = np.floor((points - building.free_corner) / FREE_CELL_M).astype(np.int64).T
    inside = (row >= 0) & (column >= 0) & (row < free.shape[0]) & (column < free.shape[1])
    result = np.zeros(len(points), bool)
    result[inside] = free[row[inside], column[inside]]
    return result


def _walls(points: FloatArray, normals: FloatArray, across: FloatArray, chosen: NDArray[np.bool_]) -> Iterator[_Wall]:
    """The straight walls among the chosen points: both sides of a wall are one."""
    rows = np.flatnonzero(chosen & np.any(normals != 0.0, axis=1))
    if not len(rows):
        return
    xy, its = points[rows], normals[rows]
    i, j = cKDTree(xy).query_pairs(JOINED_M, output_type="ndarray").T
    facing = np.einsum("na,na->n", its[i], its[j])
    # Along the wall, not across it: parallel walls close by are two.
    beside = np.abs(np.einsum("na,na->n", xy[j] - xy[i], its[i]))
    joined = (facing < -PARALLEL) | ((facing > PARALLEL) & (beside < OFF_M))
    links = coo_array((np.ones(int(joined.sum())), (i[joined], j[joined])), shape=(len(rows), len(rows)))
    _, label = connected_components(links, directed=False)
    order = np.argsort(label, kind="stable")
    for members in np.split(order, np.flatnonzero(np.diff(label[order])) + 1):
        off = np.abs(across[rows[members]])
        off = off[off > OFF_M]  # false for NaN
        is_known = len(off) >= LEAST_SHARE * len(members)  # enough of it has a wall close by
        its_off_m = float(np.median(off)) if is_known else None
        yield _Wall(xy[members], its[members], its_off_m)


def _moved(wall: _Wall, others: Sequence[_Wall], farthest_m: float) -> tuple[int, float] | None:
    normal = wall.normal
    first, last = wall.along(normal)
    best: tuple[int, float] | None = None
    for number, other in enumerate(others):
        low, high = other.along(normal)
        overlap = min(last, high) - max(first, low)
        if abs(float(other.normal @ normal)) < PARALLEL or overlap < 0.5 * min(last - first, SHORTEST_M):
            continue
        by_m = _apart(wall, other, normal)
        if by_m <= farthest_m and (best is None or by_m < best[1]):
            best = number, by_m
    return best


def _apart(wall: _Wall, other: _Wall, normal: FloatArray) -> float:
    """Distance of two parallel walls, side by side of the same facing if both have one."""
    sides = []
    for sign in (-1.0, 1.0):
        faces = [its.points[sign * (its.normals @ normal) > 0.0] @ normal for its in (wall, other)]
        if all(len(face) for face in faces):
            sides.append(float(np.median(faces[1]) - np.median(faces[0])))
    if not sides:
        sides = [float(np.median(other.points @ normal) - np.median(wall.points @ normal))]
    return abs(float(np.mean(sides)))

"""How a building differs from its floor plan: walls that are missing, new, or somewhere else."""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from fcslam.lidar.field import EMPTY, SurfelField
from fcslam.lidar.submap import FREE_CELL_M, SPACING_M, Submap
from fcslam.records import FloatArray

OFF_M: Final = 0.10
"""A wall that is off by less stands where the plan has it."""
AWAY_M: Final = 0.30
"""A surface farther than this from any surface of the other map is not in that map."""
SHORTEST_M: Final = 1.5
"""Shortest wall that is missing or moved: shorter lines of a plan are furniture and doors."""
SHORTEST_NEW_M: Final = 2.0
"""Shortest new wall: shorter surfaces are furniture."""
FARTHEST_M: Final = 2.0
"""A missing wall that stands parallel within this distance has moved."""
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
        return float(np.hypot(self.end[0] - self.start[0], self.end[1] - self.start[1]))


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
    """Points of one straight wall."""

    points: FloatArray
    normals: FloatArray
    off_m: float
    """Median distance from the plan, for walls that the other map has close by."""

    @property
    def normal(self) -> FloatArray:
        """Direction across the wall, shape (2,)."""
        _, vectors = np.linalg.eigh(self.normals.T @ self.normals)
        return np.asarray(vectors[:, 1])

    def along(self, tangent: FloatArray) -> tuple[float, float]:
        """First and last coordinate along a direction."""
        at = self.points @ tangent
        return float(at.min()), float(at.max())

    def ends(self) -> tuple[tuple[float, float], tuple[float, float]]:
        normal = self.normal
        tangent = np.array((-normal[1], normal[0]))
        first, last = self.along(tangent)
        across = float(np.median(self.points @ normal))
        start, end = across * normal + first * tangent, across * normal + last * tangent
        return (float(start[0]), float(start[1])), (float(end[0]), float(end[1]))


def compare_with_plan(plan: Submap, building: Submap) -> Comparison:
    """Find the walls of a building that differ from its plan.

    Args:
        plan: the plan.
        building: the map, in the coordinates of the plan.
    """
    points, normals = plan.surface.points, plan.surface.normals
    across = _across(points, normals, building.field)
    near = np.abs(across) <= OFF_M
    off = (np.abs(across) > OFF_M) & ~_has_close(points, normals, building)
    missing = np.isnan(across) & _in_free(points, building) & (_distance(points, building) > AWAY_M)
    unknown = _distance(building.surface.points, plan) > AWAY_M
    new = list(_walls(building.surface.points, building.surface.normals, np.zeros(len(unknown)), unknown))
    found: list[Deviation] = []
    for wall in _walls(points, normals, across, off):
        found.append(Deviation(DeviationKind.MOVED, *wall.ends(), abs(wall.off_m)))
    taken: set[int] = set()
    for wall in _walls(points, normals, np.zeros(len(points)), missing):
        match = _moved(wall, new)
        if match is None:
            found.append(Deviation(DeviationKind.MISSING, *wall.ends()))
        else:
            number, by_m = match
            taken.add(number)
            found.append(Deviation(DeviationKind.MOVED, *wall.ends(), by_m))
    found += (Deviation(DeviationKind.NEW, *wall.ends()) for k, wall in enumerate(new) if k not in taken)
    kept = [d for d in found if d.length_m >= (SHORTEST_NEW_M if d.kind is DeviationKind.NEW else SHORTEST_M)]
    kept.sort(key=lambda deviation: (-deviation.length_m, deviation.start))
    mean_off_m = float(np.abs(across[near]).mean()) if near.any() else float("nan")
    return Comparison(tuple(kept), SPACING_M * int(near.sum()), mean_off_m)


def _across(points: FloatArray, normals: FloatArray, field: SurfelField) -> FloatArray:
    """Distance of the other map's surface from each point (N, 2) along its normal; NaN if there is none close by."""
    across = np.full(len(points), np.nan)
    labels = field.nearest(points)
    known = np.flatnonzero(labels != EMPTY)
    surfels, its = field.points[labels[known]], field.normals[labels[known]]
    apart = surfels - points[known]
    distance = np.einsum("na,na->n", apart, normals[known])
    beside2 = np.einsum("na,na->n", apart, apart) - distance**2
    same = (np.einsum("na,na->n", its, normals[known]) > PARALLEL) & (beside2 < (2.0 * SPACING_M) ** 2)
    across[known[same]] = distance[same]
    return across


def _has_close(points: FloatArray, normals: FloatArray, building: Submap) -> NDArray[np.bool_]:
    """Whether the map has a surface of the same side where the plan has one, hidden by a nearer one of another side."""
    found = np.zeros(len(points), bool)
    for step in (-0.5 * OFF_M, 0.5 * OFF_M):
        across = _across(points + step * normals, normals, building.field)
        found |= np.abs(across + step) <= OFF_M
    return found


def _distance(points: FloatArray, other: Submap) -> FloatArray:
    """Distance of each point (N, 2) from the nearest surface of the other map."""
    if not len(other.field.points):
        return np.full(len(points), np.inf)
    return np.asarray(cKDTree(other.field.points).query(points)[0])


def _in_free(points: FloatArray, building: Submap) -> NDArray[np.bool_]:
    free = building.free
    column, row = np.floor((points - free.corner) / FREE_CELL_M).astype(np.int64).T
    inside = (row >= 0) & (column >= 0) & (row < free.cells.shape[0]) & (column < free.cells.shape[1])
    result = np.zeros(len(points), bool)
    result[inside] = free.cells[row[inside], column[inside]]
    return result


def _walls(
    points: FloatArray, normals: FloatArray, off: FloatArray, chosen: NDArray[np.bool_]
) -> Iterator[_Wall]:
    """The straight walls among the chosen points: both sides of a wall are one."""
    rows = np.flatnonzero(chosen & np.any(normals != 0.0, axis=1))
    if not len(rows):
        return
    xy, its, distance = points[rows], normals[rows], off[rows]
    i, j = cKDTree(xy).query_pairs(JOINED_M, output_type="ndarray").T
    facing = np.einsum("na,na->n", its[i], its[j])
    # Along the wall, not across it: parallel walls close by are two.
    beside = np.abs(np.einsum("na,na->n", xy[j] - xy[i], its[i]))
    joined = (np.abs(facing) > PARALLEL) & (np.abs(distance[i] - np.sign(facing) * distance[j]) < OFF_M)
    joined &= (beside < OFF_M) | (facing < 0.0)
    links = coo_array((np.ones(int(joined.sum())), (i[joined], j[joined])), shape=(len(rows), len(rows)))
    _, label = connected_components(links, directed=False)
    order = np.argsort(label, kind="stable")
    for members in np.split(order, np.flatnonzero(np.diff(label[order])) + 1):
        yield _Wall(xy[members], its[members], float(np.median(distance[members])))


def _moved(wall: _Wall, new: list[_Wall]) -> tuple[int, float] | None:
    """The new wall that stands parallel to a missing one, and how far it is; None if there is none."""
    normal = wall.normal
    tangent = np.array((-normal[1], normal[0]))
    first, last = wall.along(tangent)
    best: tuple[int, float] | None = None
    for number, other in enumerate(new):
        low, high = other.along(tangent)
        overlap = min(last, high) - max(first, low)
        if abs(float(other.normal @ normal)) < PARALLEL or overlap < 0.5 * min(last - first, SHORTEST_M):
            continue
        by_m = _apart(wall, other, normal)
        if by_m <= FARTHEST_M and (best is None or by_m < best[1]):
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

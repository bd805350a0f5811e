"""A labelled distance field: the surfaces seen so far, and for every cell near them the nearest one.

Surfaces are *surfels*: running means of returns that fell together, with a normal towards the robot. A sparse grid of
tiles stores in each cell the surfel nearest to its middle, so the distance to the map costs one look-up and is not
interpolated. Tiles exist only near surfaces: memory follows what was seen, not the range squared.
"""

import math
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import njit
from fcslam.geometry import se2
from fcslam.lidar.scan import PointScan
from fcslam.records import FloatArray

CELL_M: Final = 0.05
TILE: Final = 16
"""Cells along one side of a tile."""
REACH_M: Final = 10.0 * CELL_M
"""Cells farther than this from every surfel hold none."""
MERGE_M: Final = CELL_M
"""A return this close to a surfel that faces the same way is merged into it."""
MEAN_OVER: Final = 30.0
"""A surfel is a running mean over this many returns, so it can follow its surface."""
TABLE: Final = 512
"""Tiles along one side of the field: 409.6 m, more than any submap with any laser."""
WIDEST_M: Final = TABLE * TILE * CELL_M - 2.0
"""Largest extent in x or y of a map that becomes a field."""
EMPTY: Final = -1
MERGED: Final = 4
"""Columns of a surfel that later ones serve to merge returns."""
FIRST_SEEN: Final = 6
"""Column of the motion after which a surfel was first seen."""
MOST_SURFELS: Final = int(np.iinfo(np.int16).max)
"""Largest number of labels: 1.6 km of walls. Later returns are merged into surfels or left out."""
TOO_MANY_WALLS: Final = f"has too many walls; at most {1e-3 * MERGE_M * MOST_SURFELS:.1f} km can be used"

MOST_NEW_TILES: Final = (2 * math.ceil(REACH_M / (TILE * CELL_M)) + 1) ** 2
"""Largest number of tiles within reach of one surfel."""

_REACH_CELLS = round(REACH_M / CELL_M)


class FieldArrays(NamedTuple):
    """The arrays of a field, for compiled code."""

    corner: FloatArray
    """Lower left corner of the table, shape (2,), metres."""
    table: NDArray[np.int32]
    """Storage number of each tile, or EMPTY; shape (rows, columns)."""
    labels: NDArray[np.int16]
    """Nearest surfel of each cell of each stored tile, or EMPTY; shape (tiles, TILE, TILE)."""
    surfels: FloatArray
    """x, y, normal x, normal y, number of returns, whether all of them were solitary, and the motion of the robot (see
    ``used``) when it was first seen; shape (capacity, 7).

    A compact field has the first four only: it takes no more returns."""
    used: NDArray[np.int64]
    """Tiles and surfels in use, and the motion of the robot between the scans inserted, in mm and mrad, shape (3,)."""


class SurfelField:
    """Nearest-surfel field around an origin, in the coordinate frame of its submap."""

    _T_field_last: FloatArray | None = None
    """Pose of the last scan inserted, shape (3,)."""

    def __init__(self, origin_xy: FloatArray) -> None:
        self.arrays = FieldArrays(
            corner=np.asarray(origin_xy[:2], dtype=np.float64) - 0.5 * TABLE * TILE * CELL_M,
            table=np.full((TABLE, TABLE), EMPTY, np.int32),
            labels=np.full((64, TILE, TILE), EMPTY, np.int16),
            surfels=np.zeros((1024, 7)),
            used=np.zeros(3, np.int64),
        )

    @classmethod
    def of(cls, arrays: FieldArrays) -> Self:
        """The field with these arrays."""
        field = cls.__new__(cls)
        field.arrays = arrays
        return field

    def copy(self) -> Self:
        """A field that takes further scans of its own; this one was not compacted."""
        copied = self.of(self.arrays._replace(**{name: array.copy() for name, array in self.arrays._asdict().items()}))
        copied._T_field_last = self._T_field_last
        return copied

    def insert(self, scan: PointScan, T_field_base: FloatArray) -> None:
        """Add a scan taken at ``T_field_base``, shape (3,), metres and radians; drop returns outside the table."""
        done = 0
        x, y, turn = se2.motion(T_field_base if self._T_field_last is None else self._T_field_last, T_field_base)
        self._T_field_last = T_field_base
        self.arrays.used[2] += round(1e3 * (math.hypot(x, y) + abs(turn)))
        while (done := _insert(scan.points, scan.normals, scan.solitary, T_field_base, done, self.arrays)) < len(scan):
            self._grow()

    @property
    def points(self) -> FloatArray:
        """Positions of the surfels, shape (N, 2), metres."""
        return self.arrays.surfels[: self.arrays.used[1], :2]

    @property
    def normals(self) -> FloatArray:
        """Unit normals of the surfels, (0, 0) where unknown, shape (N, 2)."""
        return self.arrays.surfels[: self.arrays.used[1], 2:4]

    @property
    def solitary(self) -> NDArray[np.bool_]:
        """Surfels all of whose returns were solitary, shape (N,); of a field that is not compact."""
        return self.arrays.surfels[: self.arrays.used[1], 5] > 0.0

    def nearest(self, points: FloatArray) -> NDArray[np.int32]:
        """Label of the surfel nearest to the cell of each point (N, 2), metres, or ``EMPTY``; shape (N,)."""
        labels: NDArray[np.int32] = _labels_at(points, self.arrays)
        return labels

    @property
    def is_full(self) -> bool:
        """Whether later returns may be left out."""
        return bool(self.arrays.used[1] == MOST_SURFELS)

    def compact(self) -> None:
        """Free unused storage of a complete field, which takes no more scans."""
        corner, table, labels, surfels, used = self.arrays
        filled = table != EMPTY
        (top, bottom), (left, right) = (_ends(filled.any(axis=axis)) for axis in (1, 0))
        self.arrays = FieldArrays(
            corner=corner + TILE * CELL_M * np.array((left, top), dtype=np.float64),
            table=table[top:bottom, left:right].copy(),
            labels=labels[: max(1, used[0])].copy(),
            surfels=surfels[: max(1, used[1]), :MERGED].copy(),
            used=used,
        )

    def _grow(self) -> None:
        _, _, labels, surfels, used = self.arrays
        if len(labels) - used[0] < MOST_NEW_TILES:
            self.arrays = self.arrays._replace(labels=np.concatenate([labels, np.full_like(labels, EMPTY)]))
        if used[1] == len(surfels):
            self.arrays = self.arrays._replace(surfels=np.concatenate([surfels, np.zeros_like(surfels)]))


def _ends(filled: NDArray[np.bool_]) -> tuple[int, int]:
    """The first index and the one after the last where ``filled``, shape (N,), is true; (0, 1) if it never is."""
    where = np.flatnonzero(filled)
    return (int(where[0]), int(where[-1]) + 1) if len(where) else (0, 1)


@njit(allocates=False)
def label_at(x, y, field):  # type: ignore[no-untyped-def]
    """Surfel nearest to the cell of (x, y), or EMPTY."""
    cx = int(np.floor((x - field.corner[0]) / CELL_M))
    cy = int(np.floor((y - field.corner[1]) / CELL_M))
    tx, ty = cx // TILE, cy // TILE
    if tx < 0 or ty < 0 or tx >= field.table.shape[1] or ty >= field.table.shape[0]:
        return EMPTY
    tile = field.table[ty, tx]
    if tile == EMPTY:
        return EMPTY
    return field.labels[tile, cy - ty * TILE, cx - tx * TILE]


@njit
def _labels_at(points, field):  # type: ignore[no-untyped-def]
    result = np.empty(len(points), np.int32)
    for i in range(len(points)):
        result[i] = label_at(points[i, 0], points[i, 1], field)
    return result


@njit(allocates=False)
def _insert(points, normals, solitary, T, start, field):  # type: ignore[no-untyped-def]
    """Insert returns from index ``start`` on, until all are inserted or storage must grow; returns the next index."""
    cos, sin = np.cos(T[2]), np.sin(T[2])
    for i in range(start, len(points)):
        x = T[0] + cos * points[i, 0] - sin * points[i, 1]
        y = T[1] + sin * points[i, 0] + cos * points[i, 1]
        nx = cos * normals[i, 0] - sin * normals[i, 1]
        ny = sin * normals[i, 0] + cos * normals[i, 1]
        if not _within(x, y, field):
            continue
        # The cell may belong to the other side of a thin wall; one step towards the robot it belongs to this side.
        label = label_at(x, y, field)
        ahead = label_at(x + CELL_M * nx, y + CELL_M * ny, field)
        if _merge(x, y, nx, ny, solitary[i], label, field) or _merge(x, y, nx, ny, solitary[i], ahead, field):
            continue
        if field.used[1] == MOST_SURFELS:
            continue
        if field.used[1] == len(field.surfels) or len(field.labels) - field.used[0] < MOST_NEW_TILES:
            return i
        surfel = field.surfels[field.used[1]]
        surfel[0], surfel[1], surfel[2], surfel[3] = x, y, nx, ny
        surfel[4], surfel[5], surfel[FIRST_SEEN] = 1.0, 1.0 if solitary[i] else 0.0, field.used[2]
        _spread(x, y, field.used[1], field)
        field.used[1] += 1
    return len(points)


@njit(allocates=False)
def _within(x, y, field):  # type: ignore[no-untyped-def]
    side = field.table.shape[0] * TILE * CELL_M
    margin = REACH_M + CELL_M
    cx, cy = x - field.corner[0], y - field.corner[1]
    return cx > margin and cy > margin and cx < side - margin and cy < side - margin


@njit(allocates=False)
def _merge(x, y, nx, ny, solitary, label, field):  # type: ignore[no-untyped-def]
    """Merge a return into a surfel that is near and does not face away; returns whether it did.

    A surfel is near as well if the return's own cell would keep its label: a new surfel there would own no cell.
    """
    if label == EMPTY:
        return False
    s = field.surfels[label]
    dx, dy = x - s[0], y - s[1]
    facing = nx * s[2] + ny * s[3]
    if facing < 0.0:
        return False
    if dx * dx + dy * dy > MERGE_M * MERGE_M:
        px = field.corner[0] + (np.floor((x - field.corner[0]) / CELL_M) + 0.5) * CELL_M
        py = field.corner[1] + (np.floor((y - field.corner[1]) / CELL_M) + 0.5) * CELL_M
        if (px - s[0]) ** 2 + (py - s[1]) ** 2 > (px - x) ** 2 + (py - y) ** 2:
            return False
    s[4] = min(s[4] + 1.0, MEAN_OVER)
    if not solitary:
        s[5] = 0.0
    gain = 1.0 / s[4]
    s[0] += gain * dx
    s[1] += gain * dy
    mx, my = s[2] + gain * (nx - s[2]), s[3] + gain * (ny - s[3])
    if s[2] == 0.0 and s[3] == 0.0:
        mx, my = nx, ny
    elif nx == 0.0 and ny == 0.0:
        mx, my = s[2], s[3]
    length = np.hypot(mx, my)
    if length > 0.0:
        s[2] = mx / length
        s[3] = my / length
    return True


@njit(allocates=False)
def _spread(x, y, label, field):  # type: ignore[no-untyped-def]
    corner, labels, surfels = field.corner, field.labels, field.surfels
    cx = int(np.floor((x - corner[0]) / CELL_M))
    cy = int(np.floor((y - corner[1]) / CELL_M))
    for gy in range(cy - _REACH_CELLS, cy + _REACH_CELLS + 1):
        py = corner[1] + (gy + 0.5) * CELL_M
        across = REACH_M * REACH_M - (py - y) ** 2
        if across < 0.0:
            continue
        ty = gy // TILE
        row = gy - ty * TILE
        half = np.sqrt(across)
        low = max(cx - _REACH_CELLS, int(np.ceil((x - half - corner[0]) / CELL_M - 0.5)))
        high = min(cx + _REACH_CELLS, int(np.floor((x + half - corner[0]) / CELL_M - 0.5)))
        for tx in range(low // TILE, high // TILE + 1):
            cells = labels[_tile_at(tx, ty, field), row]
            for k in range(max(low - tx * TILE, 0), min(high - tx * TILE + 1, TILE)):
                px = corner[0] + (tx * TILE + k + 0.5) * CELL_M
                old = cells[k]
                other = surfels[max(old, 0)]
                d2 = (px - x) ** 2 + (py - y) ** 2
                # Without branches, which processors guess wrongly here, this takes three quarters of the time.
                is_nearer = (old == EMPTY) | ((px - other[0]) ** 2 + (py - other[1]) ** 2 > d2)
                cells[k] = label if is_nearer else old


@njit(allocates=False)
def _tile_at(tx, ty, field):  # type: ignore[no-untyped-def]
    tile = field.table[ty, tx]
    if tile == EMPTY:
        tile = field.used[0]
        field.table[ty, tx] = tile
        field.used[0] += 1
    return tile


def field_of(scans: list[tuple[PointScan, FloatArray]]) -> SurfelField:
    """Build a field around the first of several scans, each with its ``T_field_base``, shape (3,)."""
    field = SurfelField(scans[0][1] if scans else se2.IDENTITY)
    for scan, T_field_base in scans:
        field.insert(scan, T_field_base)
    return field

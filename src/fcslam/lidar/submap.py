"""Submaps: surfaces and free space seen by the keyscans around one anchor keyscan, in the base of the anchor."""

import json
import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import njit
from fcslam.lidar.field import CELL_M, EMPTY, TILE, FieldArrays, SurfelField, field_of, label_at
from fcslam.lidar.matching import OPPOSED
from fcslam.lidar.scan import PointScan
from fcslam.records import FloatArray
from fcslam.sources.point_clouds import GAP_M

FREE_CELL_M: Final = 2.0 * CELL_M
FREE_MARGIN_M: Final = 2.0 * FREE_CELL_M
"""A beam clears the cells up to this far before its end."""
RADIUS_M: Final = 30.0
"""Surfaces and free space farther than this from the anchor are left out: distant ones are seen too sparsely."""
SPACING_M: Final = FREE_CELL_M
"""Surfaces are compared at points this far apart."""
SEEN_THROUGH: Final = 2
"""A surfel counts as moving, and is dropped, if the beams of more than this many times the scans with a return in its
cell passed through it: beams at a grazing angle pass walls, too."""
ON_SURFEL_M: Final = GAP_M
"""A point this close to a surfel that faces the same way lies on its surface."""
VIOLATION_M: Final = 2.0 * ON_SURFEL_M
"""A point in free space farther than this from any surfel contradicts the submap."""
LEVER_M: Final = 3.0
"""Lever arm that scales turns to shifts: about that of the points in a submap of a room."""


@dataclass(frozen=True, slots=True)
class Submap:
    """Surfaces and free space around an anchor keyscan, in the anchor's base."""

    field: SurfelField
    surface: PointScan
    """Surfels about 0.1 m apart, without moving ones (people), which beams of other scans passed through."""
    free: NDArray[np.bool_]
    """Cells that beams passed through, shape (H, W), row = y."""
    free_corner: FloatArray
    """Lower left corner of cell (0, 0), shape (2,), metres."""
    rows: NDArray[np.int16]
    """Row of each point of ``surface`` among the surfels of ``field``, shape (N,)."""

    @classmethod
    def of(
        cls,
        field: SurfelField,
        free: NDArray[np.bool_],
        free_corner: FloatArray,
        rows: NDArray[np.int64] | None = None,
    ) -> Self:
        """The submap of a field, which takes no more scans, with the surfels ``rows``; None: all, spaced."""
        rows = _spaced_rows(field.points) if rows is None else rows
        surface = PointScan(field.points, field.normals, field.solitary, np.zeros(2)).only(rows)
        field.compact()
        return cls(field, surface, free, free_corner, rows.astype(np.int16))


Located = tuple[PointScan, FloatArray]
"""A scan and its ``T_anchor_base``, shape (3,)."""


def build_submap(scans: Sequence[Located], radius_m: float = RADIUS_M) -> Submap:
    """Build a submap of scans in the anchor's base, without what is farther than ``radius_m`` from the anchor."""
    near = [(_near(scan, pose, radius_m), pose) for scan, pose in scans]
    field = field_of(near)
    (counts,), corner = _beam_counts([near], field.points[_spaced_rows(field.points)])
    return _without_moving(field, counts, corner)


def build_with_halves(scans: Sequence[Located], radius_m: float) -> tuple[Submap, Submap, Submap]:
    """The submap of at least two scans, as ``build_submap``, and those of the first and the second half of them."""
    near, middle = [(_near(scan, pose, radius_m), pose) for scan, pose in scans], len(scans) // 2
    halves = near[:middle], near[middle:]
    first, second = map(field_of, halves)
    whole = first.copy()
    for scan, pose in halves[1]:
        whole.insert(scan, pose)
    (one, other), corner = _beam_counts(halves, np.concatenate([whole.points, first.points, second.points]))
    parts = _without_moving(first, one, corner), _without_moving(second, other, corner)
    return _without_moving(whole, one + other, corner), *parts


def _without_moving(field: SurfelField, counts: NDArray[np.uint16], corner: FloatArray) -> Submap:
    rows, (passes, hits) = _spaced_rows(field.points), counts
    column, row = np.floor((field.points[rows] - corner) / FREE_CELL_M).astype(np.int64).T
    moved = passes[row, column] > SEEN_THROUGH * np.maximum(hits[row, column], 1)
    return Submap.of(field, passes > 0, corner, rows[~moved])


def _near(scan: PointScan, T_anchor_base: FloatArray, radius_m: float) -> PointScan:
    """Returns a field cell apart, within the radius of the anchor (measured from the robot: the window is short)."""
    radius_m = max(1.0, radius_m - math.hypot(T_anchor_base[0], T_anchor_base[1]))
    return scan.thinned(CELL_M, radius_m=radius_m)


def _beam_counts(parts: Sequence[Sequence[Located]], surface: FloatArray) -> tuple[NDArray[np.uint16], FloatArray]:
    """How many scans of each part passed each cell around a surface, and how many had a return in it.

    Returns the counts, shape (parts, 2, H, W), and the cells' lower left corner.
    """
    poses = np.array([pose for part in parts for _, pose in part]).reshape(-1, 3)
    around = np.concatenate([surface, poses[:, :2]]) if len(surface) else poses[:, :2]
    corner = around.min(axis=0) - FREE_CELL_M
    columns, rows = np.ceil((around.max(axis=0) - corner) / FREE_CELL_M).astype(np.int64) + 1
    counts = np.zeros((len(parts), 2, rows, columns), np.uint16)
    for scans, (passes, hits) in zip(parts, counts, strict=True):
        latest = np.full((2, rows, columns), -1, np.int32)
        for number, (scan, pose) in enumerate(scans):
            _count_beams(scan.points, scan.origin, pose, corner, number, latest, passes, hits)
    return counts, corner


def seen_through(submap: Submap, scans: Sequence[Located]) -> NDArray[np.bool_]:
    """Points of ``submap.surface`` that more of its scans passed than saw, as at a railing, shape (N,)."""
    ((passes, hits),), corner = _beam_counts([scans], submap.surface.points)
    column, row = np.floor((submap.surface.points - corner) / FREE_CELL_M).astype(np.int64).T
    return np.asarray(passes[row, column] > hits[row, column])


@njit(allocates=False)
def _count_beams(points, origin, T, corner, number, latest, passes, hits):  # type: ignore[no-untyped-def]
    """Count a scan once in each cell between the laser and a return, short of the return, and in the return's."""
    cos, sin = np.cos(T[2]), np.sin(T[2])
    x0 = T[0] + cos * origin[0] - sin * origin[1] - corner[0]
    y0 = T[1] + sin * origin[0] + cos * origin[1] - corner[1]
    rows, columns = passes.shape
    for i in range(len(points)):
        px, py = points[i, 0] - origin[0], points[i, 1] - origin[1]
        dx = cos * px - sin * py
        dy = sin * px + cos * py
        x, y = int(np.floor((x0 + dx) / FREE_CELL_M)), int(np.floor((y0 + dy) / FREE_CELL_M))
        if x >= 0 and y >= 0 and x < columns and y < rows and latest[1, y, x] != number:
            latest[1, y, x] = number
            hits[y, x] += 1
        length = np.hypot(dx, dy)
        steps = int((length - FREE_MARGIN_M) / FREE_CELL_M)
        if steps <= 0:
            continue
        ux, uy = dx / length, dy / length
        for k in range(steps + 1):
            x = int(np.floor(x0 / FREE_CELL_M + k * ux))
            y = int(np.floor(y0 / FREE_CELL_M + k * uy))
            if x >= 0 and y >= 0 and x < columns and y < rows:
                passes[y, x] += latest[0, y, x] != number  # a branch here would take as long as all the rest
                latest[0, y, x] = number


def _spaced_rows(points: FloatArray) -> NDArray[np.int64]:
    """Number of the first of the points (N, 2) in each cell of ``SPACING_M``, ascending, shape (K,)."""
    cells = np.floor(points / SPACING_M).astype(np.int64)
    first: NDArray[np.int64] = np.unique(cells[:, 0] * 1_000_003 + cells[:, 1], return_index=True)[1]
    return np.sort(first)


def submap_bytes(submap: Submap) -> bytes:
    """A submap in a third of the memory, without loss: its cells are compressed, its surface refers to the surfels.

    The same bytes for the same submap, on every machine with this byte order. Nothing in them is executed.
    """
    field = submap.field.arrays
    arrays = (
        field.corner,
        field.table,
        _compressed(field.labels),
        field.surfels,
        field.used,
        submap.rows,
        submap.surface.solitary,
        _compressed(np.packbits(submap.free)),
        np.array(submap.free.shape),
        submap.free_corner,
    )
    header = json.dumps([(array.dtype.str, array.shape) for array in arrays]).encode()
    return b"".join((header, b"\n", *(array.tobytes() for array in arrays)))


def read_submap(data: bytes) -> Submap:
    """The submap of ``submap_bytes``. Its arrays are copies: compiled code would be compiled once more for others."""
    begin = data.index(b"\n") + 1
    arrays: list[NDArray[Any]] = []
    for kind, shape in json.loads(data[:begin]):
        arrays.append(np.frombuffer(data, np.dtype(kind), math.prod(shape), begin).reshape(shape).copy())
        begin += arrays[-1].nbytes
    corner, table, packed, surfels, used, rows, solitary, free, free_shape, free_corner = arrays
    labels = np.frombuffer(zlib.decompress(packed.tobytes()), np.int16).reshape(-1, TILE, TILE).copy()
    field = SurfelField.of(FieldArrays(corner, table, labels, surfels, used))
    bits = np.frombuffer(zlib.decompress(free.tobytes()), np.uint8)
    cells = np.unpackbits(bits, count=math.prod(free_shape)).view(np.bool_).reshape(free_shape)
    surface = PointScan(field.points[rows], field.normals[rows], solitary, np.zeros(2))
    return Submap(field, surface, cells, free_corner, rows)


def _compressed(array: NDArray[Any]) -> NDArray[np.uint8]:
    """At the lowest level of zlib: more takes twice as long for a tenth less."""
    return np.frombuffer(zlib.compress(array.tobytes(), 1), np.uint8)


@dataclass(frozen=True, slots=True)
class Agreement:
    """Agreement of one submap with another at a given transform."""

    explained: float
    """Share of the points in known area that lie on a surface facing the same way."""
    violation: float
    """Share of the points in known area that lie in the other's free space, well away from any surface."""
    count: int
    """Explained points."""
    overlap: float
    """Share of all points that fall into known area."""
    normal_tensor: FloatArray
    """Sum of J J^T over the explained points, J = (n_x, n_y, lever / LEVER_M), shape (3, 3).

    Its smallest eigenvalue is small if the match is not fixed: along a corridor, or in heading in a round room.
    """

    @property
    def weakest(self) -> float:
        """Smallest eigenvalue of the normal tensor."""
        return float(np.linalg.eigvalsh(self.normal_tensor)[0])


def agreement(query: Submap, target: Submap, T_target_query: FloatArray) -> Agreement:
    """Measure how well ``query``, whose points are counted, agrees with ``target``, in which it has the pose (3,)."""
    known, explained, violating, tensor = _agreement(
        query.surface.points,
        query.surface.normals,
        np.array(T_target_query),  # a writable copy: code is compiled once
        target.field.arrays,
        target.free,
        target.free_corner,
    )
    total = max(1, len(query.surface))
    return Agreement(explained / max(1, known), violating / max(1, known), explained, known / total, tensor)


def self_violation(scans: Sequence[Located]) -> float:
    """How much a submap contradicts itself: its odd scans against its even ones, the worse of both directions.

    Range errors, mixed pixels and poses that are off all raise it; it is a measure of the scanner's noise on the scale
    of ``Agreement.violation``. The scans are as for ``build_submap``; a single one does not contradict itself.
    """
    if len(scans) < 2:
        return 0.0
    even, odd = build_submap(scans[::2]), build_submap(scans[1::2])
    here = np.zeros(3)  # not se2.IDENTITY: a read-only array would compile the code once more
    return max(agreement(even, odd, here).violation, agreement(odd, even, here).violation)


@njit
def _agreement(points, normals, T, field, free, free_corner):  # type: ignore[no-untyped-def]
    cos, sin = np.cos(T[2]), np.sin(T[2])
    known = explained = violating = 0
    tensor = np.zeros((3, 3))
    jacobian = np.empty(3)
    for i in range(len(points)):
        x = T[0] + cos * points[i, 0] - sin * points[i, 1]
        y = T[1] + sin * points[i, 0] + cos * points[i, 1]
        mx = cos * normals[i, 0] - sin * normals[i, 1]
        my = sin * normals[i, 0] + cos * normals[i, 1]
        label = label_at(x, y, field)
        distance = 10.0
        if label != EMPTY:
            s = field.surfels[label]
            if s[2] * mx + s[3] * my > OPPOSED:
                distance = np.hypot(x - s[0], y - s[1])
        if distance < ON_SURFEL_M:
            known += 1
            explained += 1
            jacobian[0] = mx
            jacobian[1] = my
            jacobian[2] = ((x - T[0]) * my - (y - T[1]) * mx) / LEVER_M
            for r in range(3):
                for c in range(3):
                    tensor[r, c] += jacobian[r] * jacobian[c]
            continue
        cx, cy = int(np.floor((x - free_corner[0]) / FREE_CELL_M)), int(np.floor((y - free_corner[1]) / FREE_CELL_M))
        if cx >= 0 and cy >= 0 and cx < free.shape[1] and cy < free.shape[0] and free[cy, cx]:
            known += 1
            if distance > VIOLATION_M:
                violating += 1
    return known, explained, violating, tensor

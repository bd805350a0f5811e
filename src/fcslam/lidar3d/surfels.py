"""A map of small planes (surfels) around the robot, to which points are registered.

The map has voxels of several sizes. Each accumulates the mean and the covariance of its points. A voxel whose points
lie in a plane is a surfel; a point is registered to the surfel of the largest voxel around it that has one. So large
walls average the noise of many points, and furniture still counts. A voxel has two sides, because a wall between two
rooms is seen from both: rays that hit its surfel from behind belong to the other side.

Only the direction of its normal counts for a point, so that a plain corridor does not fix the position along it.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import njit
from fcslam.records import FloatArray

SIZES_M: Final = (0.8, 0.4, 0.2)
"""Edges of the voxels, from the largest on."""
POINT_SIGMA_M: Final = 0.02
"""Standard deviation of a point along the normal of its surface."""
_THICKEST_M: Final = 2.0 * POINT_SIGMA_M
"""Largest standard deviation of the points of a surfel along its normal."""
_FEWEST_POINTS: Final = 6
"""Least number of points of a surfel."""
_WIDEST_RATIO: Final = 0.06
"""Largest ratio of the two smallest variances of the points of a surfel: along the normal, and across."""
_UNEVEN: Final = 0.02
"""Standard deviation of a normal, in radians, however many points show it: no wall is plane."""
_OFFSET = 1 << 19


class _Table(NamedTuple):
    """Voxels by row, and their rows by hashed keys."""

    keys: NDArray[np.int64]
    """-1: no voxel."""
    rows: NDArray[np.int32]
    row_keys: NDArray[np.int64]
    """Key of each row."""
    stats: FloatArray
    """For each voxel the number of its points, and the sums of points, of their products and of their rays."""
    planes: FloatArray
    """Normal, middle, variance along the normal (0: there is no surfel), and variance of the normal."""
    seen: FloatArray
    """When it was seen last."""


class SurfelMap:
    """Voxels with their points' moments; forgets those that were not seen for a while."""

    def __init__(self) -> None:
        self._table = _table(1 << 10)
        self.count = 0

    def add(self, points: FloatArray, rays: FloatArray, when: float) -> None:
        """Add points (N, 3), and the directions of their rays (N, 3), in the map's frame; ``when`` grows."""
        needed = self.count + 2 * len(SIZES_M) * len(points)
        if needed > len(self._table.seen):
            self._keep(np.arange(self.count), max(needed, 2 * len(self._table.seen)))
        self.count = _add(self._table, self.count, points, rays, when)

    def forget(self, before: float) -> None:
        """Forget voxels that were seen last before this."""
        kept = np.flatnonzero(self._table.seen[: self.count] >= before)
        self._keep(kept, max(1 << 10, len(kept)))

    def _keep(self, rows: NDArray[np.int64], capacity: int) -> None:
        old, self._table, self.count = self._table, _table(capacity), len(rows)
        for before, now in zip(old[2:], self._table[2:], strict=True):
            now[: len(rows)] = before[rows]
        _reindex(self._table, len(rows))

    def normal_equations(
        self,
        points: FloatArray,
        shares: FloatArray,
        rotation: FloatArray,
        position: FloatArray,
        corrections: FloatArray,
        gate_m: float,
    ) -> tuple[FloatArray, FloatArray, FloatArray, int]:
        """Matrix (12, 12) and vector (12,) of least squares from points to surfels, the part of the matrix that errors
        of normals make, for one motion of all points (6, 6), and the number of points.

        Args:
            points: (N, 3), by the predicted motion moved to the frame of the robot at the scan's first point.
            shares: (N,), 0 for a point at the begin of the scan, 1 at its end.
            rotation, position: pose of the robot at the begin in the map.
            corrections: (2, 6), tangents at that pose: of the begin and of the end; between, they are interpolated.
            gate_m: largest distance of a point from its surfel.
        """
        H, b, along, moments, found = _accumulate(self._table, points, shares, rotation, position, corrections, gate_m)
        # errors of a normal are in its plane: those in all directions without those along it
        unit, across, squares = np.eye(3), np.cross(moments[0, 1:], np.eye(3)), moments[1:, 1:]
        every = np.block([[moments[0, 0] * unit, across], [across.T, np.trace(squares) * unit - squares]])
        return H, b, every - along, found


def _table(capacity: int) -> _Table:
    size = 1 << int(2 * capacity).bit_length()
    columns = np.zeros((capacity, 13)), np.zeros((capacity, 8)), np.zeros(capacity)
    return _Table(np.full(size, -1, np.int64), np.zeros(size, np.int32), np.zeros(capacity, np.int64), *columns)


@njit(allocates=False)
def _key(level, x, y, z, side):  # type: ignore[no-untyped-def]
    size = SIZES_M[level]
    # the floor, at height 0, is in the middle of its voxels
    i, j, k = np.int64(np.floor(x / size)), np.int64(np.floor(y / size)), np.int64(np.rint(z / size))
    return ((((i + _OFFSET) << 20 | (j + _OFFSET)) << 20 | (k + _OFFSET)) << 3 | level << 1 | side) & 0x7FFFFFFFFFFFFFFF


@njit(allocates=False)
def _slot(keys, key):  # type: ignore[no-untyped-def]
    mask = len(keys) - 1
    at = ((key * 0x9E3779B97F4A7C1) >> 17) & mask
    while keys[at] != -1 and keys[at] != key:
        at = (at + 1) & mask
    return at


@njit
def _reindex(table, count):  # type: ignore[no-untyped-def]
    for row in range(count):
        at = _slot(table.keys, table.row_keys[row])
        table.keys[at], table.rows[at] = table.row_keys[row], row


@njit
def _add(table, count, points, rays, when):  # type: ignore[no-untyped-def]
    keys, rows, row_keys, stats, planes, seen = table
    touched = np.empty(len(points) * len(SIZES_M), np.int32)
    n_touched = 0
    for p in range(len(points)):
        x, y, z = points[p]
        for level in range(len(SIZES_M)):
            row = -1
            for side in range(2):
                key = _key(level, x, y, z, side)
                at = _slot(keys, key)
                if keys[at] == -1:
                    keys[at], rows[at], row_keys[count] = key, count, key
                    stats[count] = 0.0
                    planes[count] = 0.0
                    row, count = count, count + 1
                    break
                other = rows[at]
                if planes[other, 6] > 0.0:
                    n = planes[other]
                    facing = -(n[0] * rays[p, 0] + n[1] * rays[p, 1] + n[2] * rays[p, 2])
                else:
                    s = stats[other]
                    facing = s[10] * rays[p, 0] + s[11] * rays[p, 1] + s[12] * rays[p, 2]
                if facing > 0.0 or side == 1:
                    row = other
                    break
            s = stats[row]
            s[0] += 1.0
            s[1] += x
            s[2] += y
            s[3] += z
            s[4] += x * x
            s[5] += x * y
            s[6] += x * z
            s[7] += y * y
            s[8] += y * z
            s[9] += z * z
            s[10] += rays[p, 0]
            s[11] += rays[p, 1]
            s[12] += rays[p, 2]
            if seen[row] != when or s[0] == 1.0:
                touched[n_touched] = row
                n_touched += 1
                seen[row] = when
    _fit_planes(stats, planes, touched[:n_touched])
    return count


@njit
def _fit_planes(stats, planes, rows):  # type: ignore[no-untyped-def]
    C = np.empty((3, 3))
    for row in rows:
        s, plane = stats[row], planes[row]
        n = s[0]
        if n < _FEWEST_POINTS:
            continue
        mx, my, mz = s[1] / n, s[2] / n, s[3] / n
        C[0, 0], C[0, 1], C[0, 2] = s[4] / n - mx * mx, s[5] / n - mx * my, s[6] / n - mx * mz
        C[1, 1], C[1, 2], C[2, 2] = s[7] / n - my * my, s[8] / n - my * mz, s[9] / n - mz * mz
        C[1, 0], C[2, 0], C[2, 1] = C[0, 1], C[0, 2], C[1, 2]
        values, vectors = np.linalg.eigh(C)
        measured = max(values[0], 0.0)
        thin = measured * n / (n - 3.0)  # three points always lie in a plane
        is_line = values[1] < POINT_SIGMA_M**2
        if is_line or thin > _THICKEST_M**2 or thin > _WIDEST_RATIO * values[1]:
            plane[6] = 0.0
            continue
        nx, ny, nz = vectors[0, 0], vectors[1, 0], vectors[2, 0]
        if nx * s[10] + ny * s[11] + nz * s[12] > 0.0:
            nx, ny, nz = -nx, -ny, -nz
        plane[0], plane[1], plane[2], plane[3], plane[4], plane[5] = nx, ny, nz, mx, my, mz
        plane[6] = POINT_SIGMA_M**2 + thin / n
        # a few points may lie in a plane by chance: one of the usual noise counts beside them
        plane[7] = (measured * n + POINT_SIGMA_M**2) / (n - 2.0) / (n * values[1]) + _UNEVEN**2


@njit(allocates=False)
def _surfel(table, x, y, z, rx, ry, rz):  # type: ignore[no-untyped-def]
    """Row of the surfel of the largest voxel around a point that faces a ray; -1 without one."""
    keys, rows, _, _, planes, _ = table
    for level in range(len(SIZES_M)):
        for side in range(2):
            key = _key(level, x, y, z, side)
            at = _slot(keys, key)
            if keys[at] == -1:
                break
            row = rows[at]
            if planes[row, 6] > 0.0 and planes[row, 0] * rx + planes[row, 1] * ry + planes[row, 2] * rz < 0.0:
                return row
    return -1


@njit(allocates=False)
def corrected(point, share, corrections):  # type: ignore[no-untyped-def]
    """A point at a share of a turn after the corrections (2, 6) of its begin and its end.

    The exponential of the interpolated correction is taken to second order.
    """
    a, (x, y, z) = share, point
    vx = (1.0 - a) * corrections[0, 0] + a * corrections[1, 0]
    vy = (1.0 - a) * corrections[0, 1] + a * corrections[1, 1]
    vz = (1.0 - a) * corrections[0, 2] + a * corrections[1, 2]
    wx = (1.0 - a) * corrections[0, 3] + a * corrections[1, 3]
    wy = (1.0 - a) * corrections[0, 4] + a * corrections[1, 4]
    wz = (1.0 - a) * corrections[0, 5] + a * corrections[1, 5]
    ux, uy, uz = wy * z - wz * y + vx, wz * x - wx * z + vy, wx * y - wy * x + vz
    return (
        x + ux + 0.5 * (wy * uz - wz * uy),
        y + uy + 0.5 * (wz * ux - wx * uz),
        z + uz + 0.5 * (wx * uy - wy * ux),
    )


@njit
def _accumulate(table, points, shares, R, t, corrections, gate_m):  # type: ignore[no-untyped-def]
    H, b, along, moments = np.zeros((12, 12)), np.zeros(12), np.zeros((6, 6)), np.zeros((4, 4))
    J, q, found = np.empty(6), np.ones(4), 0
    for p in range(len(points)):
        a = shares[p]
        x, y, z = corrected(points[p], a, corrections)
        rx = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z
        ry = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z
        rz = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z
        X, Y, Z = rx + t[0], ry + t[1], rz + t[2]
        row = _surfel(table, X, Y, Z, rx, ry, rz)
        if row < 0:
            continue
        n = table.planes[row]
        r = n[0] * (X - n[3]) + n[1] * (Y - n[4]) + n[2] * (Z - n[5])
        if abs(r) > gate_m:
            continue
        found += 1
        weight = 1.0 / (n[6] + r * r / 6.0)  # Cauchy
        J[0] = R[0, 0] * n[0] + R[1, 0] * n[1] + R[2, 0] * n[2]
        J[1] = R[0, 1] * n[0] + R[1, 1] * n[1] + R[2, 1] * n[2]
        J[2] = R[0, 2] * n[0] + R[1, 2] * n[1] + R[2, 2] * n[2]
        J[3] = y * J[2] - z * J[1]
        J[4] = z * J[0] - x * J[2]
        J[5] = x * J[1] - y * J[0]
        v = weight * n[7]
        q[1], q[2], q[3] = x, y, z
        for i in range(4):
            for j in range(4):
                moments[i, j] += v * q[i] * q[j]
        c0, c1 = 1.0 - a, a
        for i in range(6):
            wi = weight * J[i]
            b[i] += c0 * wi * r
            b[6 + i] += c1 * wi * r
            for j in range(6):
                v = wi * J[j]
                along[i, j] += n[7] * v
                H[i, j] += c0 * c0 * v
                H[i, 6 + j] += c0 * c1 * v
                H[6 + i, j] += c0 * c1 * v
                H[6 + i, 6 + j] += c1 * c1 * v
    return H, b, along, moments, found

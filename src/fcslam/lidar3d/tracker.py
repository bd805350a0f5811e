"""Follows a robot with a 3D LiDAR from turn to turn, in six degrees of freedom.

Each turn is registered to a map of the surfaces around the robot (``surfels``). Two poses are sought, at the begin and
at the end of the turn, since the robot moves meanwhile; the pose of a point between them is interpolated. Wheels and
gyro hold those directions in which the surfaces say little: information about a position that errors of the normals
could make is taken away.
"""

from collections.abc import Sequence
from functools import partial
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import njit
from fcslam.geometry import se3
from fcslam.lidar.odometry import PREDICTED, PRIOR_TAIL, odometry_error
from fcslam.lidar3d.motion import MotionSensors, Prediction
from fcslam.lidar3d.surfels import POINT_SIGMA_M, SIZES_M, SurfelMap, corrected
from fcslam.records import CloudScan, FloatArray
from fcslam.sources.point_clouds import FARTHEST_M

_STEPS: Final = 10
"""Parts of a turn between whose ends the predicted motion is interpolated."""
MOST_POINTS: Final = 3000
"""Points that are registered: one for each of the smallest voxels, or for larger cells if there are more."""
_GATES_M: Final = (0.4, 0.28, 0.2, 0.14, 0.1, 0.1, 0.1, 0.1, 0.1)
"""Largest distance of a point from its surface in each iteration."""
_NEAR_SURFACE_M: Final = 0.5
"""Points nearer to a surface mostly lie on it if the registration is right."""
_CORRELATED: Final = 0.25
"""Information of a point: neighbours have the same error of their surface."""
_POOR_FACTOR, _POOR_LEAST = 3.0, 0.02
"""A registration is poor if more points than the second number, and this many times the usual, miss their surface."""
SETTLED: Final = 20
"""Turns after which it is known what is usual."""
_CONTRADICTION: Final = np.array([_GATES_M[0]] * 3 + [0.1] * 3)
"""Wheels that differ by more from constant velocity may have jumped."""
_JOLT_RAD: Final = 0.08
"""Standard deviation of a sudden tilt, as at the edge of a ramp."""
_JOLTS: Final = np.array([0.75, 1.5, -0.75, -1.5])
"""Sudden tilts about the y axis that are tried, in standard deviations."""
_MAP_SIGMA: Final = np.array([2e-3] * 3 + [1e-3] * 3)
"""Standard deviations of the error of the map."""
_INSERT_M, _TURN_M = 0.1, 0.3
"""Travel after which a turn is added to the map; what a radian counts as travel."""
_REMEMBERED_M: Final = 20.0
"""Travel after which surfaces that were not seen again are forgotten."""


_Start = tuple[FloatArray, FloatArray, Prediction]
"""Pose at the begin of a turn, its covariance (6, 6), and the motion during the turn, as they are predicted."""


class Tracked(NamedTuple):
    """A turn of the LiDAR with its pose."""

    stamp: float
    T_odom_base: FloatArray
    """At the stamp, shape (7,)."""
    points: FloatArray
    """All points in ``base`` at the stamp, shape (N, 3)."""
    origin: FloatArray
    """Position of the sensor in ``base``, shape (3,)."""
    measured: FloatArray
    """Information about the pose at the end of the turn that the surfaces give, in its tangent, shape (6, 6)."""
    motion: FloatArray
    """Motion since the turn before, shape (7,)."""
    motion_sigma: FloatArray
    """Standard deviations of what other sensors say about it, shape (6,)."""
    is_poor: bool
    """Whether the surfaces explain the turn badly."""


class _Fit(NamedTuple):
    corrections: FloatArray
    """Corrections of the first and of the last pose, shape (2, 6)."""
    covariance: FloatArray
    """Shape (12, 12)."""
    measured: FloatArray
    """Information by the surfaces, shape (6, 6), in the tangent at the begin."""
    on_surface: int
    share: float
    """Share of the points near a surface that lie on it."""


class Tracker3d:
    """Gives each turn its pose in ``odom``, the frame of the robot at the stamp of the first."""

    def __init__(self) -> None:
        self.sensors = MotionSensors()
        self._first: CloudScan | None = None
        """The first turn, until the second shows the motion in it."""
        self._begin()

    def _begin(self) -> None:
        self._map = SurfelMap()
        self._end_s = -np.inf
        self._T_odom_end = se3.IDENTITY
        """Pose at the end of the newest turn."""
        self._covariance = np.diag(_MAP_SIGMA**2)
        self._usual, self._turns, self._is_poor = 1.0, 0, False
        self._travel, self._inserted, self._forgotten = 0.0, -np.inf, 0.0
        self._before: FloatArray | None = None
        """Pose of the turn before."""

    def track(self, scan: CloudScan) -> Tracked:
        """Register the next turn."""
        self.sensors.add(scan)
        tracked = self._register(scan)
        if self._turns == 1:
            self._first = scan
        elif self._first is not None:
            first, self._first = self._first, None
            for _ in range(2):  # the second turn shows the motion in the first, better each time
                self._begin()
                self._register(first)
                tracked = self._register(scan)
        return tracked

    def accept(self, turns: Sequence[Tracked]) -> None:
        """Add turns to the map that it explained badly: they are right, but much that they see is new."""
        points = [se3.transform(each.T_odom_base, each.points) for each in turns]
        origins = [se3.transform(each.T_odom_base, each.origin[None]) for each in turns]
        rays = [seen - origin for seen, origin in zip(points, origins, strict=True)]
        self._map.add(np.concatenate(points), np.concatenate(rays), self._travel + 1e-9 * self._turns)
        self._inserted = self._travel

    def _register(self, scan: CloudScan) -> Tracked:
        distances = np.linalg.norm(scan.points_m - scan.origin_m.astype(np.float32), axis=1)
        used = distances < FARTHEST_M
        points, times = scan.points_m[used].astype(np.float64), scan.times_s[used].astype(np.float64)
        first_s, last_s = (float(times.min()), float(times.max())) if len(times) else (0.0, 0.0)
        length_s = max(last_s - first_s, 1e-3)
        begin_s = scan.stamp + first_s
        shares = (times - first_s) / length_s
        start = self._start(begin_s, length_s, points, shares)
        T_odom_begin, self._covariance, predicted = start
        share = -first_s / length_s
        if not self._turns:  # the pose at the stamp is the origin, whatever the motion before
            T_odom_begin = se3.inverse(_interpolated(se3.IDENTITY, np.zeros((2, 6)), predicted.poses, share))
        deskewed = _deskew(points, shares, predicted.poses)
        chosen = thinned(deskewed, SIZES_M[-1], MOST_POINTS)
        fit = self._fitted(deskewed[chosen], shares[chosen], start)
        begin = se3.compose(T_odom_begin, se3.exp(fit.corrections[0]))
        end = se3.compose(T_odom_begin, se3.compose(se3.exp(fit.corrections[1]), predicted.poses[-1]))
        to_end = se3.adjoint(se3.inverse(predicted.poses[-1]))
        self._covariance = to_end @ fit.covariance[6:, 6:] @ to_end.T
        motion = se3.between(begin, end)
        if self._is_poor:
            self._covariance += np.diag([POINT_SIGMA_M**2] * 3 + [_JOLT_RAD**2] * 2 + [POINT_SIGMA_M**2])
        else:
            sigma_rad = float(np.sqrt(np.trace(self._covariance[3:, 3:]) / 3.0))
            is_fixed = bool(np.linalg.eigvalsh(fit.measured[:3, :3])[0] * 9.0 * predicted.sigma[0] ** 2 > 1.0)
            moved = se3.between(T_odom_begin, end) if is_fixed else None
            self.sensors.learn(predicted, motion, moved, length_s, sigma_rad)
            since_s = begin_s + length_s - self._end_s
            if 2.0 * length_s < since_s < np.inf:  # a turn that is much shorter than the time between turns
                self.sensors.velocity = se3.log(se3.between(self._T_odom_end, end)) / since_s
        self._turns += 1
        self._T_odom_end, self._end_s = end, begin_s + length_s
        at_stamp = _interpolated(T_odom_begin, fit.corrections, predicted.poses, share)
        in_odom = se3.transform(T_odom_begin, _corrected(deskewed, shares, fit.corrections))
        self._insert(in_odom, se3.transform(at_stamp, scan.origin_m[None])[0], motion)
        before, self._before = self._before, at_stamp
        since = se3.IDENTITY if before is None else se3.between(before, at_stamp)
        back = np.linalg.inv(to_end)
        return Tracked(
            scan.stamp,
            at_stamp,
            se3.transform(se3.inverse(at_stamp), in_odom),
            scan.origin_m,
            back.T @ fit.measured @ back,
            since,
            self._motion_sigma(predicted, since),
            self._is_poor,
        )

    def _start(self, begin_s: float, length_s: float, points: FloatArray, shares: FloatArray) -> _Start:
        """What is predicted by the wheels, unless constant velocity contradicts them and explains clearly more
        ``points``."""
        starts = by_wheels, other = [self._predicted(begin_s, length_s, by_wheels) for by_wheels in (True, False)]
        ends = (se3.compose(begin, within.poses[-1]) for begin, _, within in starts)
        if not self._turns or (np.abs(se3.log(se3.between(*ends))) < _CONTRADICTION).all():
            return by_wheels
        on_surface = []
        for start in starts:
            deskewed = _deskew(points, shares, start[2].poses)
            chosen = thinned(deskewed, SIZES_M[-1], MOST_POINTS)
            on_surface.append(self._fit(deskewed[chosen], shares[chosen], start).on_surface / max(len(chosen), 1))
        return other if on_surface[1] > on_surface[0] + _POOR_LEAST else by_wheels

    def _predicted(self, begin_s: float, length_s: float, by_wheels: bool) -> _Start:
        """The uncertainty grows from the end of the turn before to the begin of this one."""
        within = self.sensors.predict(begin_s + np.linspace(0.0, length_s, _STEPS + 1), by_wheels)
        gap_s = begin_s - self._end_s
        if not np.isfinite(gap_s):
            return self._T_odom_end, self._covariance, within
        covariance = self._covariance + np.diag(_MAP_SIGMA**2)
        if abs(gap_s) < 1e-4:
            return self._T_odom_end, covariance, within
        between = self.sensors.predict(self._end_s + np.linspace(0.0, gap_s, _STEPS + 1), by_wheels)
        back = se3.adjoint(se3.inverse(between.poses[-1]))
        covariance = back @ covariance @ back.T + np.diag(between.sigma**2)
        return se3.compose(self._T_odom_end, between.poses[-1]), covariance, within

    def _fitted(self, points: FloatArray, shares: FloatArray, start: _Start) -> _Fit:
        if not self._turns:
            return _Fit(np.zeros((2, 6)), np.diag(np.tile(_MAP_SIGMA, 2) ** 2), np.zeros((6, 6)), 0, 1.0)
        fit = partial(self._fit, points, shares)
        tries = [fit(start, tilt) for tilt in (0.0, *(_JOLT_RAD * _JOLTS if self._is_poor else ()))]
        best = max(tries, key=lambda each: each.on_surface)
        self._is_poor = self._turns > SETTLED and 1.0 - best.share > _POOR_FACTOR * (1.0 - self._usual) + _POOR_LEAST
        if self._is_poor:
            T_odom_begin, covariance, predicted = start
            sigma, tilted = predicted.sigma.copy(), covariance.copy()
            sigma[3:5] = np.maximum(sigma[3:5], _JOLT_RAD)
            tilted[4, 4] += _JOLT_RAD**2
            loose = predicted._replace(sigma=sigma)
            tries = [fit((T_odom_begin, tilted, loose), tilt) for tilt in _JOLT_RAD * _JOLTS]
            return max((best, fit((T_odom_begin, covariance, loose)), *tries), key=lambda each: each.on_surface)
        self._usual += 2.0 / SETTLED * (best.share - self._usual)
        return best

    def _fit(self, points: FloatArray, shares: FloatArray, start: _Start, tilt: float = 0.0) -> _Fit:
        T_odom_begin, covariance, predicted = start
        to_end = se3.adjoint(se3.inverse(predicted.poses[-1]))
        motion = to_end.T @ np.diag(predicted.sigma**-2) @ to_end
        first, by_wheels = np.array([0.0, 0.0, 0.0, 0.0, tilt, 0.0]), predicted.planar is not None
        return _fit(self._map, points, shares, T_odom_begin, inverse(covariance), motion, first, by_wheels)

    @staticmethod
    def _motion_sigma(predicted: Prediction, motion: FloatArray) -> FloatArray:
        """Without wheels, the same error of the velocity goes on from turn to turn: it says nothing of the position."""
        if predicted.planar is not None:
            return predicted.sigma
        error = odometry_error(float(np.linalg.norm(motion[:3])), 0.0, PREDICTED)
        return np.concatenate((np.full(3, error.position_m), predicted.sigma[3:]))

    def _insert(self, points: FloatArray, origin: FloatArray, motion: FloatArray) -> None:
        tangent = se3.log(motion)
        self._travel += float(np.linalg.norm(tangent[:3]) + _TURN_M * np.linalg.norm(tangent[3:]))
        if self._turns <= 3 or (self._travel - self._inserted > _INSERT_M and not self._is_poor):
            self._map.add(points, points - origin, self._travel + 1e-9 * self._turns)
            self._inserted = self._travel
        if self._travel - self._forgotten > 0.25 * _REMEMBERED_M:
            self._map.forget(self._travel - _REMEMBERED_M)
            self._forgotten = self._travel


def _fit(
    surfaces: SurfelMap,
    points: FloatArray,
    shares: FloatArray,
    T: FloatArray,
    begin_information: FloatArray,
    motion_information: FloatArray,
    start: FloatArray,
    by_wheels: bool = False,
) -> _Fit:
    """Gauss-Newton for the corrections of the begin and the end of a turn; ``start`` is that of both at first."""
    rotation, position = se3.rotation(T), T[:3].copy()
    corrections = np.concatenate((start, start))
    for gate_m in _GATES_M:
        H, b, noise, _ = surfaces.normal_equations(
            points, shares, rotation, position, corrections.reshape(2, 6), gate_m
        )
        measured, trusted = without_noise(H[:6, :6] + H[6:, 6:] + H[:6, 6:] + H[6:, :6], noise)
        H, b = _CORRELATED * (trusted @ H @ trusted.T), _CORRELATED * (trusted @ trusted @ b)
        begin, motion = begin_information, motion_information
        if by_wheels:
            begin, motion = _unslipped(begin, corrections[:6]), _unslipped(motion, corrections[6:] - corrections[:6])
        prior = np.block([[begin + motion, -motion], [-motion, motion]])
        step = np.linalg.solve(H + prior, -(b + prior @ corrections))
        corrections = corrections + step
        if gate_m == _GATES_M[-1] and np.abs(step).max() < 0.1 * _MAP_SIGMA.min():
            break
    near, on = (
        surfaces.normal_equations(points, shares, rotation, position, corrections.reshape(2, 6), gate_m)[3]
        for gate_m in (_NEAR_SURFACE_M, 3.0 * POINT_SIGMA_M)
    )
    return _Fit(corrections.reshape(2, 6), inverse(H + prior), _CORRELATED * measured, on, on / max(near, 1))


def _unslipped(information: FloatArray, error: FloatArray) -> FloatArray:
    """Information (6, 6) of wheels about an ``error`` (6,), which has a Student t distribution, as they may slip."""
    return (PRIOR_TAIL + 6.0) / (PRIOR_TAIL + max(float(error @ information @ error), 6.0)) * information


def without_noise(information: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Information (6, 6) without the ``noise`` (6, 6) that errors of the normals make, and the factors of the Jacobians
    of two poses that give it, shape (12, 12)."""
    root = np.linalg.cholesky(information + 1e-9 * max(np.trace(information), 1.0) * np.eye(6))  # 0 if nothing is near
    white = np.linalg.inv(root)
    shares, vectors = np.linalg.eigh(white @ noise @ white.T)
    trusted = root @ (vectors * np.sqrt(np.maximum(1.0 - shares, 0.0))) @ vectors.T @ white
    return trusted @ information @ trusted.T, np.kron(np.eye(2), trusted)


def inverse(matrix: FloatArray) -> FloatArray:
    """Inverse of a symmetric matrix, symmetric in spite of rounding."""
    inverted = np.linalg.inv(matrix)
    return np.asarray(0.5 * (inverted + inverted.T), np.float64)


def fit_rigid(surfaces: SurfelMap, points: FloatArray, T: FloatArray) -> tuple[FloatArray, FloatArray, int, int]:
    """Register points that were measured at once, from the pose ``T`` (7,) of their frame on.

    Returns the pose, the information about it in its tangent (6, 6), and the numbers of points on and near a surface.
    """
    free = np.diag(np.array([0.3] * 3 + [0.1] * 3) ** -2.0)
    fit = _fit(surfaces, points, np.zeros(len(points)), T, free, 1e6 * free, np.zeros(6))
    found = se3.exp(fit.corrections[0])
    near = round(fit.on_surface / fit.share) if fit.share else 0
    return se3.compose(T, found), fit.measured, fit.on_surface, near


def _interpolated(T: FloatArray, corrections: FloatArray, poses: FloatArray, share: float) -> FloatArray:
    """Pose at a share of a turn, which may be before or after it."""
    at = min(max(share, 0.0), 1.0) * _STEPS
    before = min(int(at), _STEPS - 1)
    part = se3.exp((at - before) * se3.log(se3.between(poses[before], poses[before + 1])))
    correction = se3.exp((1.0 - share) * corrections[0] + share * corrections[1])
    return se3.compose(se3.compose(T, correction), se3.compose(poses[before], part))


@njit
def _deskew(points, shares, poses):  # type: ignore[no-untyped-def]
    """Points (N, 3) at shares (N,) of a turn, in the frame of its begin; ``poses`` are the robot's at equal steps."""
    moved = np.empty((len(points), 3))
    last = len(poses) - 1
    for p in range(len(points)):
        at = shares[p] * last
        k = min(int(at), last - 1)
        g = at - k
        a, c = poses[k], poses[k + 1]
        sign = 1.0 if a[3] * c[3] + a[4] * c[4] + a[5] * c[5] + a[6] * c[6] >= 0.0 else -1.0
        x, y = (1.0 - g) * a[3] + g * sign * c[3], (1.0 - g) * a[4] + g * sign * c[4]
        z, w = (1.0 - g) * a[5] + g * sign * c[5], (1.0 - g) * a[6] + g * sign * c[6]
        length = np.sqrt(x * x + y * y + z * z + w * w)
        x, y, z, w = x / length, y / length, z / length, w / length
        vx, vy, vz = points[p]
        cx, cy, cz = 2.0 * (y * vz - z * vy), 2.0 * (z * vx - x * vz), 2.0 * (x * vy - y * vx)
        moved[p, 0] = vx + w * cx + y * cz - z * cy + (1.0 - g) * a[0] + g * c[0]
        moved[p, 1] = vy + w * cy + z * cx - x * cz + (1.0 - g) * a[1] + g * c[1]
        moved[p, 2] = vz + w * cz + x * cy - y * cx + (1.0 - g) * a[2] + g * c[2]
    return moved


@njit
def _corrected(points, shares, corrections):  # type: ignore[no-untyped-def]
    """Points (N, 3) with the corrections (2, 6) of the begin and the end of their turn."""
    moved = np.empty((len(points), 3))
    for p in range(len(points)):
        moved[p] = corrected(points[p], shares[p], corrections)
    return moved


def thinned(points: FloatArray, cell_m: float, most: int | None = None) -> NDArray[np.int64]:
    """Rows of the first point in each cell, with larger cells if there are more than ``most``."""
    rows: NDArray[np.int64] = _first_in_cells(points, cell_m)
    while most is not None and len(rows) > most:
        cell_m *= 1.25
        rows = rows[_first_in_cells(points[rows], cell_m)]
    return rows


@njit
def _first_in_cells(points, cell_m):  # type: ignore[no-untyped-def]
    size = 1
    while size < 2 * len(points):
        size *= 2
    table = np.full(size, -1, np.int64)
    rows = np.empty(len(points), np.int64)
    count = 0
    for p in range(len(points)):
        i, j, k = np.floor(points[p] / cell_m)
        key = (np.int64(i) + 100_000) << 42 | (np.int64(j) + 100_000) << 21 | (np.int64(k) + 100_000)
        at = ((key * 0x9E3779B97F4A7C1) >> 17) & (size - 1)
        while table[at] != -1 and table[at] != key:
            at = (at + 1) & (size - 1)
        if table[at] == -1:
            table[at] = key
            rows[count] = p
            count += 1
    return rows[:count].copy()

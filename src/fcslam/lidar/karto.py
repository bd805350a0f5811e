"""Karto's scan matcher (Mapper.cpp, defaults of open_karto): exhaustive search on a smeared likelihood grid.

Only scans that moved on enough are matched, against the keyscans of the running buffer; between them the pose goes on
by odometry. Near chains and loop closing of Karto are not here: the back end is the same as for ``ScanTracker``.
"""

from typing import Final

import numpy as np

from fcslam.geometry import se2
from fcslam.lidar.correlative import LikelihoodPyramid, SearchWindow, likelihood_pyramid, search
from fcslam.lidar.field import SurfelField
from fcslam.lidar.odometry import OdometryModel, odometry_error
from fcslam.lidar.scan import PointScan, point_scan
from fcslam.lidar.tracker import NO_INFORMATION, ScanTracker, TrackedScan, TrackingResult
from fcslam.records import FloatArray, LaserScan

RANGE_M: Final = 12.0
"""Returns farther than this are not matched, metres."""
STEP_M, STEP_RAD = 0.02, np.deg2rad(0.2)
"""Steps of the poses whose likelihoods give the covariance."""
WINDOW: Final = SearchWindow(
    radius_m=0.16,
    angle_rad=float(np.deg2rad(20.0)),
    distance_penalty=0.2 * (0.16 / 0.3) ** 2,
    angle_penalty=0.2,
    cell_m=0.01,
    smear_m=0.03,
)
NEAR_BEST: Final = 0.1
"""Poses whose likelihood is closer to the best one give the covariance."""


class KartoTracker(ScanTracker):
    """Tracks one robot as the front end of Karto does.

    A scan is matched from a distance of ``travel_m``, or a turn of ``turn_rad``, from the last keyscan on. A motion
    that is only predicted passes these gates at every scan.
    """

    def __init__(self, odometry: OdometryModel, travel_m: float, turn_rad: float) -> None:
        super().__init__(odometry)
        self._gate = travel_m, turn_rad
        self._T_local_newest: dict[frozenset[tuple[float, float, float]], FloatArray] = {}

    def localize(self, scan: LaserScan) -> TrackingResult:
        """Find the pose of the next scan; the tracker does not change before ``commit``."""
        # 1. Prediction: the last pose, moved by odometry.
        laser = frozenset((scan.laser.T_base_laser,))
        predicted = self._predicted(scan)._replace(matched_here=laser)
        T_local_guess = predicted.T_local_base
        by_odometry = TrackedScan(T_local_guess, NO_INFORMATION, None, scan.sweep)
        # 2. Gates: a scan near the last keyscan is not matched.
        if self._fields and not self._passes(laser, T_local_guess):
            return TrackingResult(by_odometry, predicted)
        points = point_scan(scan.matched_ranges_m, scan.laser, scan.sweep)
        by_odometry = by_odometry._replace(scan=points)
        if not self._fields:
            return TrackingResult(by_odometry, predicted)
        # 3. Scan matching. Without any response, odometry alone gives the pose.
        near, field = points.only(np.hypot(*(points.points - points.origin).T) < RANGE_M), self._fields[0][0]
        T_field_base, score = search(near, field, T_local_guess, WINDOW, visible_only=True)
        if score == 0.0:
            return TrackingResult(by_odometry, predicted)
        information = np.linalg.inv(match_covariance(near, field, T_field_base))
        tracked = TrackedScan(T_field_base, np.asarray(information), points, scan.sweep)
        error = odometry_error(predicted.moved_m, predicted.turned_rad, self._odometry)
        trust = predicted.trust.learn(se2.motion(T_local_guess, T_field_base), error)
        accepted = predicted._replace(T_local_base=T_field_base, moved_m=0.0, turned_rad=0.0, trust=trust)
        # The grid knows surfaces, but no free space: what is off them lies in unknown area.
        return TrackingResult(tracked, accepted, score, score)

    def insert(self, points: PointScan, T_local_base: FloatArray, laser_count: int = 1) -> None:
        """Add a keyscan to the running buffer (see ``ScanTracker``)."""
        super().insert(points, T_local_base, laser_count)
        self._T_local_newest[self._state.matched_here] = T_local_base

    def empty_buffer(self) -> None:
        """Forget all keyscans: the pose goes on by odometry until the next one is inserted."""
        super().empty_buffer()
        self._T_local_newest.clear()

    def _passes(self, laser: frozenset[tuple[float, float, float]], T_local_guess: FloatArray) -> bool:
        if laser not in self._T_local_newest or not self._odometry.is_measured:
            return True
        x, y, theta = se2.motion(self._T_local_newest[laser], T_local_guess)
        return bool(np.hypot(x, y) >= self._gate[0] or abs(theta) >= self._gate[1])


def match_covariance(scan: PointScan, field: SurfelField, T_field_base: FloatArray) -> FloatArray:
    """Covariance (3, 3) of the best pose (3,) over (x, y) in the field and theta: moments of the likelihoods."""
    half_side_m = float(np.max(np.hypot(*scan.points.T), initial=0.0)) + 2.0 * WINDOW.radius_m
    grid = likelihood_pyramid(field, T_field_base, half_side_m, True, 1, WINDOW.cell_m, WINDOW.smear_m)
    steps = np.arange(-8.0, 9.0)
    x, y = np.meshgrid(STEP_M * steps, STEP_M * steps)
    covariance = _moments(scan, grid, T_field_base, np.column_stack((x.ravel(), y.ravel(), np.zeros(x.size))))
    covariance += _moments(scan, grid, T_field_base, np.outer(STEP_RAD * steps, (0.0, 0.0, 1.0)))
    return covariance + np.diag((0.1 * STEP_M**2, 0.1 * STEP_M**2, 0.1 * STEP_RAD**2))


def _moments(scan: PointScan, grid: LikelihoodPyramid, pose: FloatArray, offsets: FloatArray) -> FloatArray:
    points = se2.transform((pose + offsets)[:, None], scan.points[None])
    column, row = np.floor((points - grid.corner) / grid.cell_m).astype(np.int64).T
    likelihoods = grid.levels[0][row, column].mean(axis=0)
    weights = np.where(likelihoods >= likelihoods.max() - 255.0 * NEAR_BEST, likelihoods, 0.0)
    return np.asarray((weights * offsets.T) @ offsets / weights.sum())

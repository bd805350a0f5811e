"""Karto's scan matcher (Mapper.cpp, defaults of open_karto): exhaustive search on a smeared likelihood grid.

Only scans that moved on enough are matched, against all scans of the running buffer; between them the pose goes on by
odometry. Near chains and loop closing of Karto are not here: the back end is the same as of ``ScanTracker``.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import njit
from fcslam.geometry import se2
from fcslam.lidar.odometry import OdometryModel, odometry_error
from fcslam.lidar.scan import PointScan, point_scan
from fcslam.lidar.tracker import ScanTracker, TrackedScan, TrackingResult
from fcslam.records import FloatArray, LaserScan

BUFFER_SCANS, BUFFER_M = 70, 20.0
"""Scans of one laser in the running buffer, and the largest distance in metres from its first to its last."""
RANGE_M = 12.0
"""Returns farther than this are not matched, metres."""
CELL_M, SMEAR_M = 0.01, 0.03
"""Side of a cell of the grid, and standard deviation of the likelihood around a return, metres."""
ANCHOR_M = 0.1
"""A surface is judged to face a viewpoint over stretches of this length, metres."""
COARSE_CELLS, COARSE_SHIFTS, COARSE_RAD, COARSE_TURNS = 2, 8, np.deg2rad(2.0), 10
"""The coarse search: cells of a step, steps to each side (0.16 m), the angle step, and angle steps to each side."""
FINE_SHIFTS, FINE_RAD, FINE_TURNS = 1, np.deg2rad(0.2), 5
"""The fine search around the coarse best: cells to each side, the angle step, and angle steps to each side."""
PENALTY_GAIN, DISTANCE_VARIANCE, ANGLE_VARIANCE = 0.2, 0.3**2, np.deg2rad(20.0) ** 2
LEAST_DISTANCE_PENALTY, LEAST_ANGLE_PENALTY = 0.5, 0.9
"""Factors of the response fall with the squared distance and turn from the prediction, down to these."""
TIE, NEAR_BEST = 1e-6, 0.1
"""Candidates this close to the best response are averaged; those closer than the second give the covariance."""
OCCUPIED = 100
"""Value of a cell with a return."""
_NO_INFORMATION = np.zeros((3, 3))


@dataclass(frozen=True, slots=True)
class BufferedScan:
    """One scan of the running buffer, in the local frame."""

    points: FloatArray
    """Shape (N, 2), metres, in the order of the beams."""
    origin: FloatArray
    """Position of the laser, shape (2,), metres."""


@dataclass(frozen=True, slots=True)
class KartoMatch:
    """Best pose of a search."""

    T_local_base: FloatArray
    """Shape (3,), metres and radians."""
    response: float
    """Mean likelihood of the points there, in [0, 1], without the penalty; 0: no candidate has a point on a surface."""
    covariance: FloatArray
    """Of (x, y) in the local frame and theta, from the response surface, shape (3, 3)."""


class KartoTracker(ScanTracker):
    """Tracks one robot in a running buffer of its latest keyscans, as the front end of Karto does.

    Args:
        odometry: the error of odometry; a motion that is only predicted passes the gates at every scan.
        travel_m: gate: distance to the last keyscan from which on a scan is matched, metres.
        turn_rad: gate: the same for the heading, radians.
    """

    def __init__(self, odometry: OdometryModel, travel_m: float, turn_rad: float) -> None:
        super().__init__(odometry)
        self._gate = travel_m, turn_rad
        self._buffer: deque[BufferedScan] = deque()
        self._T_local_newest: dict[frozenset[tuple[float, float, float]], FloatArray] = {}
        """Pose of the newest keyscan of each laser."""

    def localize(self, scan: LaserScan) -> TrackingResult:
        """Find the pose of the next scan; the tracker does not change before ``commit``."""
        # 1. Prediction: the last pose, moved by odometry.
        T_local_guess, moved_m, turned_rad = self._predict(scan)
        laser = frozenset((scan.laser.T_base_laser,))
        unmatched = np.nan, np.nan, scan.T_odom_base, moved_m, turned_rad, laser, self._trust, self._usual
        # 2. Gates: a scan near the last keyscan is not matched.
        if self._buffer and not self._passes(laser, T_local_guess):
            return TrackingResult(TrackedScan(T_local_guess, _NO_INFORMATION, None, scan.sweep), *unmatched)
        points = point_scan(scan.matched_ranges_m, scan.laser, scan.sweep)
        by_odometry = TrackedScan(T_local_guess, _NO_INFORMATION, points, scan.sweep)
        if not self._buffer:
            return TrackingResult(by_odometry, *unmatched)
        # 3. Scan matching. Without any response, odometry alone gives the pose.
        match = match_in_buffer(_near(points), list(self._buffer), T_local_guess)
        if match.response == 0.0:
            return TrackingResult(by_odometry, *unmatched)
        tracked = TrackedScan(match.T_local_base, np.asarray(np.linalg.inv(match.covariance)), points, scan.sweep)
        innovation = se2.motion(T_local_guess, match.T_local_base)
        trust = self._trust.learn(innovation, odometry_error(moved_m, turned_rad, self._odometry))
        # The grid knows surfaces, but no free space: what is off them lies in unknown area.
        accepted = match.response, match.response, scan.T_odom_base, 0.0, 0.0, laser, trust, self._usual
        return TrackingResult(tracked, *accepted)

    def insert(self, points: PointScan, T_local_base: FloatArray, laser_count: int = 1) -> None:
        """Add a keyscan to the running buffer, and drop what is too old or too far away (see ``ScanTracker``)."""
        placed = se2.transform(T_local_base, _near(points)), se2.transform(T_local_base, points.origin[None])[0]
        self._buffer.append(BufferedScan(*placed))
        self._T_local_newest[self._matched_here] = T_local_base
        while len(self._buffer) > laser_count * BUFFER_SCANS or self._length_m() > BUFFER_M:
            self._buffer.popleft()

    def empty_buffer(self) -> None:
        """Forget all keyscans: the pose goes on by odometry until the next one is inserted."""
        self._buffer.clear()
        self._T_local_newest.clear()

    def _passes(self, laser: frozenset[tuple[float, float, float]], T_local_guess: FloatArray) -> bool:
        """Whether the robot moved enough since the last keyscan of this laser."""
        if laser not in self._T_local_newest or not self._odometry.is_measured:
            return True
        x, y, theta = se2.motion(self._T_local_newest[laser], T_local_guess)
        return bool(np.hypot(x, y) >= self._gate[0] or abs(theta) >= self._gate[1])

    def _length_m(self) -> float:
        return float(np.hypot(*(self._buffer[-1].origin - self._buffer[0].origin)))


def match_in_buffer(points: FloatArray, buffer: list[BufferedScan], T_local_guess: FloatArray) -> KartoMatch:
    """Find the best pose of a scan near the prediction.

    Args:
        points: the scan in ``base``, shape (N, 2), metres.
        buffer: the scans that it is matched against.
        T_local_guess: the prediction, shape (3,), metres and radians.
    """
    # 1. The grid: what faces the predicted pose (visibility filter), smeared.
    half_m = float(np.max(np.hypot(*points.T), initial=0.0)) + 2.0 * CELL_M * COARSE_CELLS * (COARSE_SHIFTS + 1)
    corner, size = T_local_guess[:2] - half_m, 2 * int(np.ceil(half_m / CELL_M)) + 1
    grid = np.zeros((size, size), np.uint8)
    for scan in buffer:
        _draw(grid, scan.points[_facing(scan.points, scan.origin, T_local_guess[:2])], corner, KERNEL)
    # 2. Coarse search with penalties; its responses give the covariance of the position.
    raw = _responses(grid, corner, points, T_local_guess, COARSE_CELLS, COARSE_SHIFTS, COARSE_RAD, COARSE_TURNS)
    if not raw.any():
        return KartoMatch(T_local_guess, 0.0, np.eye(3))
    coarse = T_local_guess + _best(raw, COARSE_CELLS, COARSE_RAD, np.zeros(3))
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = _position_covariance(raw, coarse - T_local_guess)
    # 3. Fine search; its responses give the variance of the heading.
    raw = _responses(grid, corner, points, coarse, 1, FINE_SHIFTS, FINE_RAD, FINE_TURNS)
    offset = _best(raw, 1, FINE_RAD, coarse - T_local_guess)
    covariance[2, 2] = _heading_variance(raw, offset[2])
    pose = coarse + offset
    pose[2] = se2.wrap_angle(pose[2])
    return KartoMatch(pose, float(raw.max()), covariance)


def _near(points: PointScan) -> FloatArray:
    """The returns within ``RANGE_M`` of the laser, shape (N, 2)."""
    return np.asarray(points.points[np.hypot(*(points.points - points.origin).T) < RANGE_M])


def _offsets(half: int, step: float) -> FloatArray:
    return step * np.arange(-half, half + 1, dtype=np.float64)


def _best(raw: FloatArray, cells: int, step_rad: float, from_guess: FloatArray) -> FloatArray:
    """Offset of the best penalised response, shape (3,); the search is centred ``from_guess``, shape (3,)."""
    turns, shifts = _offsets(raw.shape[0] // 2, step_rad), _offsets(raw.shape[1] // 2, cells * CELL_M)
    distance2 = (shifts[:, None] + from_guess[1]) ** 2 + (shifts + from_guess[0]) ** 2
    by_distance = np.maximum(LEAST_DISTANCE_PENALTY, 1.0 - PENALTY_GAIN * distance2 / DISTANCE_VARIANCE)
    by_turn = np.maximum(LEAST_ANGLE_PENALTY, 1.0 - PENALTY_GAIN * (turns + from_guess[2]) ** 2 / ANGLE_VARIANCE)
    penalised = raw * by_distance * by_turn[:, None, None]
    turn, y, x = np.nonzero(penalised >= penalised.max() - TIE)
    return np.array((shifts[x].mean(), shifts[y].mean(), turns[turn].mean()))


def _position_covariance(raw: FloatArray, best: FloatArray) -> FloatArray:
    """Second moments of the coarse responses near the best about it, shape (2, 2)."""
    shifts, step_m = _offsets(COARSE_SHIFTS, COARSE_CELLS * CELL_M), COARSE_CELLS * CELL_M
    response = raw.max(axis=0)
    weight = np.where(response >= response.max() - NEAR_BEST, response, 0.0)
    y, x = shifts[:, None] - best[1], shifts - best[0]
    xx, xy, yy = (float((weight * m).sum() / weight.sum()) for m in (x * x, x * y, y * y))
    least = 0.1 * step_m**2
    return np.asarray(np.array(((max(xx, least), xy), (xy, max(yy, least)))) / response.max())


def _heading_variance(raw: FloatArray, best_rad: float) -> float:
    """Variance of the fine responses near the best over the turns about it."""
    response = raw.max(axis=(1, 2))
    weight = np.where(response >= response.max() - NEAR_BEST, response, 0.0)
    moment = float((weight * (_offsets(FINE_TURNS, FINE_RAD) - best_rad) ** 2).sum())
    return max(moment, float(FINE_RAD**2)) / float(weight.sum())


def _kernel() -> NDArray[np.uint8]:
    across = np.exp(-0.5 * (_offsets(round(2.0 * SMEAR_M / CELL_M), CELL_M) / SMEAR_M) ** 2)
    return (OCCUPIED * np.outer(across, across)).astype(np.uint8)


KERNEL = _kernel()


@njit
def _facing(points, origin, viewpoint):  # type: ignore[no-untyped-def]
    """Which points lie on stretches that turn to the viewpoint the side that they turned to their own laser."""
    kept = np.zeros(len(points), np.bool_)
    anchor = 0
    for i in range(1, len(points)):
        ax, ay = points[anchor, 0], points[anchor, 1]
        dx, dy = points[i, 0] - ax, points[i, 1] - ay
        if dx * dx + dy * dy <= ANCHOR_M * ANCHOR_M:
            continue
        own = (ax - origin[0]) * dy - (ay - origin[1]) * dx
        other = (ax - viewpoint[0]) * dy - (ay - viewpoint[1]) * dx
        kept[anchor:i] = own * other >= 0.0
        anchor = i
    return kept


@njit
def _draw(grid, points, corner, kernel):  # type: ignore[no-untyped-def]
    """Blend the smeared points into the grid by their maximum."""
    half, size = len(kernel) // 2, len(grid)
    for i in range(len(points)):
        cx, cy = int((points[i, 0] - corner[0]) // CELL_M), int((points[i, 1] - corner[1]) // CELL_M)
        if min(cx, cy) < half or max(cx, cy) >= size - half or grid[cy, cx] == OCCUPIED:
            continue
        for y in range(-half, half + 1):
            for x in range(-half, half + 1):
                grid[cy + y, cx + x] = max(grid[cy + y, cx + x], kernel[y + half, x + half])


@njit
def _responses(grid, corner, points, pose, cells, half, step_rad, half_turns):  # type: ignore[no-untyped-def]
    """Mean likelihood of the points at every turn and shift around a pose, shape (turns, y, x)."""
    side, width, flat = 2 * half + 1, grid.shape[1], grid.ravel()
    responses = np.zeros((2 * half_turns + 1, side, side))
    first = np.empty(len(points), np.int64)
    for k in range(len(responses)):
        theta = pose[2] + (k - half_turns) * step_rad
        cos, sin = np.cos(theta), np.sin(theta)
        for i in range(len(points)):
            x = pose[0] + cos * points[i, 0] - sin * points[i, 1]
            y = pose[1] + sin * points[i, 0] + cos * points[i, 1]
            first[i] = int((y - corner[1]) // CELL_M) * width + int((x - corner[0]) // CELL_M)
        for y in range(side):
            for x in range(side):
                shift = cells * ((y - half) * width + x - half)
                total = 0
                for i in range(len(points)):
                    total += flat[first[i] + shift]
                responses[k, y, x] = total / (OCCUPIED * max(1, len(points)))
    return responses

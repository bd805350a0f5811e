"""Where is the robot in the submap around it? Every scan is matched; odometry only starts and steadies the match."""

from dataclasses import dataclass

import numpy as np
from pydantic import Field

from fcslam.config import Settings
from fcslam.geometry import se2
from fcslam.lidar.correlative import SearchConfig, SearchWindow, search
from fcslam.lidar.field import SurfelField
from fcslam.lidar.matching import MatchingConfig, ScanMatch, match_scan
from fcslam.lidar.scan import PointScan, point_scan
from fcslam.records import FloatArray, LaserScan


class TrackerConfig(Settings):
    """Scan-to-submap tracking."""

    still_m: float = Field(default=0.005, ge=0, description="a robot that moved less since the last match stands still")
    still_rad: float = Field(default=0.003, ge=0, description="and turned less")
    point_spacing_m: float = Field(default=0.05, gt=0, description="points of a scan are matched this far apart")
    point_limit: int = Field(default=180, gt=10, description="at most this many points of a scan are matched")
    buffer_keyscans: int = Field(default=60, ge=4, description="keyscans in a full running buffer")
    supported: float = Field(default=0.30, ge=0, le=1, description="a match that explains less is not believed")
    doubtful: float = Field(default=0.75, ge=0, le=1, description="explaining less of the known area starts a search")
    search_radius_m: float = Field(default=1.0, gt=0, description="half side of that correlative search")
    search_angle_rad: float = Field(default=0.5, gt=0, description="half angle of that correlative search")
    step_m: float = Field(default=0.20, gt=0, description="so does a match this far from odometry")
    step_rad: float = Field(default=0.07, gt=0, description="or turned this much from it")
    matching: MatchingConfig = Field(default=MatchingConfig(), description="Gauss-Newton scan matching")
    search: SearchConfig = Field(default=SearchConfig(), description="correlative search by branch and bound")


@dataclass(frozen=True, slots=True)
class TrackedScan:
    """One scan's pose in the tracker's own smooth frame."""

    T_local_base: FloatArray
    information: FloatArray
    """Of the scan's points, in the local frame; zeros if the pose is odometry's."""
    scan: PointScan | None
    """The scan's points; None if the robot stands still and nothing had to be computed."""


@dataclass(frozen=True, slots=True)
class TrackingResult:
    """One scan as the tracker sees it; it goes on from there once it is told to follow."""

    tracked: TrackedScan
    explained: float
    """Share of the scan's points that lie on a surface of the running buffer, matched or not."""
    known: float
    """Share of them that fall near any surface; NaN, as ``explained``, if the scan was not matched."""
    T_odom_base: FloatArray
    moved_m: float
    """Since the last match that was believed, by odometry; 0 if this is one."""
    turned_rad: float


class ScanTracker:
    """Tracks one robot in a running buffer of keyscans (Karto), kept as two overlapping surfel fields.

    The older field is matched against; when it is full it goes and the younger one, half full, takes its place. So a
    scan always sees between half and a full buffer, and nothing has to be removed from a field.
    """

    def __init__(self, config: TrackerConfig) -> None:
        self._config = config
        self._fields: list[tuple[SurfelField, int]] = []
        self._T_local_base = np.zeros(3)
        self._T_odom_base: FloatArray | None = None
        self._moved_m = 0.0
        self._turned_rad = 0.0

    def track(self, scan: LaserScan) -> TrackedScan:
        """Pose of the next scan."""
        tracking = self.localize(scan)
        self.commit(tracking)
        return tracking.tracked

    def localize(self, scan: LaserScan) -> TrackingResult:
        """The next scan, which leaves no trace before ``follow``."""
        T_local_guess, moved_m, turned_rad = self._predict(scan)
        if self._fields and moved_m < self._config.still_m and turned_rad < self._config.still_rad:
            tracked = TrackedScan(T_local_guess, np.zeros((3, 3)), None)
            return TrackingResult(tracked, np.nan, np.nan, scan.T_odom_base, moved_m, turned_rad)
        points = point_scan(scan.ranges_m, scan.laser)
        if not self._fields:
            tracked = TrackedScan(T_local_guess, np.zeros((3, 3)), points)
            return TrackingResult(tracked, np.nan, np.nan, scan.T_odom_base, moved_m, turned_rad)
        match = self._match(points, T_local_guess, odometry_information(moved_m, turned_rad))
        if match.explained < self._config.supported:
            tracked = TrackedScan(T_local_guess, np.zeros((3, 3)), points)
            return TrackingResult(tracked, match.explained, match.known, scan.T_odom_base, moved_m, turned_rad)
        tracked = TrackedScan(match.T_field_base, match.information, points)
        return TrackingResult(tracked, match.explained, match.known, scan.T_odom_base, 0.0, 0.0)

    def commit(self, tracking: TrackingResult) -> None:
        """The robot is where ``look`` saw it."""
        self._T_local_base = tracking.tracked.T_local_base
        self._T_odom_base = tracking.T_odom_base
        self._moved_m, self._turned_rad = tracking.moved_m, tracking.turned_rad

    def insert(self, points: PointScan, T_local_base: FloatArray) -> None:
        """Add a keyscan to the running buffer."""
        if not self._fields or (len(self._fields) == 1 and self._fields[0][1] >= self._config.buffer_keyscans // 2):
            self._fields.append((SurfelField(T_local_base), 0))
        elif self._fields[0][1] >= self._config.buffer_keyscans:
            self._fields = [self._fields[1], (SurfelField(T_local_base), 0)]
        for field, _ in self._fields:
            field.insert(points, T_local_base)
        self._fields = [(field, count + 1) for field, count in self._fields]

    def _predict(self, scan: LaserScan) -> tuple[FloatArray, float, float]:
        """The last pose carried on by odometry; how far and how much that leads from the last match."""
        last = scan.T_odom_base if self._T_odom_base is None else self._T_odom_base
        motion = se2.between(last, scan.T_odom_base)
        moved_m = self._moved_m + float(np.hypot(motion[0], motion[1]))
        return se2.compose(self._T_local_base, motion), moved_m, self._turned_rad + abs(float(motion[2]))

    def _match(self, points: PointScan, T_local_guess: FloatArray, prior: FloatArray) -> ScanMatch:
        """Gauss-Newton from the guess; correlative search where that is doubtful."""
        config, field = self._config, self._fields[0][0]
        thinned = points.thinned(config.point_spacing_m, config.point_limit)
        match = match_scan(thinned, field, T_local_guess, prior, config.matching)
        if self._is_doubtful(match, T_local_guess):
            window = SearchWindow(config.search_radius_m, config.search_angle_rad)
            found = search(points, field, T_local_guess, window, config.search, visible_only=True)
            other = match_scan(thinned, field, found.T_field_base, np.zeros((3, 3)), config.matching)
            if other.explained > match.explained + 0.05:
                match = other
        return match

    def _is_doubtful(self, match: ScanMatch, T_local_guess: FloatArray) -> bool:
        step = se2.between(T_local_guess, match.T_field_base)
        return bool(
            match.explained < self._config.doubtful * match.known
            or np.hypot(step[0], step[1]) > self._config.step_m
            or abs(step[2]) > self._config.step_rad
        )


def odometry_information(moved_m: float, turned_rad: float) -> FloatArray:
    """Weak trust in wheel odometry over a short motion, shape (3, 3): wheels may slip by a third of the way."""
    sigma_m = 0.02 + 0.3 * moved_m + 0.05 * turned_rad
    sigma_rad = 0.02 + 0.2 * turned_rad + 0.05 * moved_m
    return np.diag((sigma_m**-2, sigma_m**-2, sigma_rad**-2))

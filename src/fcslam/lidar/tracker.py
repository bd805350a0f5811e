"""Scan-to-submap tracking: every scan is matched; odometry only starts the match and steadies it."""

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

SEARCH_GAIN = 0.05
"""A search result replaces the match near odometry only if it explains this much more of the scan (share of points)."""
_NO_INFORMATION = np.zeros((3, 3))


class OdometryConfig(Settings):
    """Error of the wheel odometry since the last match, as the sum of a constant, a share of the travel and a share of
    the turn. The defaults trust it little: wheels may slip by a third of the way."""

    position_m: float = Field(default=0.02, gt=0, description="standard deviation of the position, constant part [m]")
    position_per_travel: float = Field(
        default=0.3, ge=0, description="standard deviation of the position per metre of travel [m/m]"
    )
    position_per_turn_m: float = Field(
        default=0.05, ge=0, description="standard deviation of the position per radian of turn [m/rad]"
    )
    heading_rad: float = Field(default=0.02, gt=0, description="standard deviation of the heading, constant part [rad]")
    heading_per_turn: float = Field(
        default=0.2, ge=0, description="standard deviation of the heading per radian of turn [rad/rad]"
    )
    heading_per_travel_rad: float = Field(
        default=0.05, ge=0, description="standard deviation of the heading per metre of travel [rad/m]"
    )


class TrackerConfig(Settings):
    """Scan-to-submap tracking."""

    still_m: float = Field(
        default=0.005,
        ge=0,
        description="a robot that moved less than this and turned less than `still_rad` since the last match "
        "stands still; its scans are not matched [m]",
    )
    still_rad: float = Field(
        default=0.003,
        ge=0,
        description="a robot that turned less than this and moved less than `still_m` since the last match "
        "stands still; its scans are not matched [rad]",
    )
    point_spacing_m: float = Field(
        default=0.05, gt=0, description="least distance between consecutive points of a scan that are matched [m]"
    )
    point_limit: int = Field(default=180, gt=10, description="largest number of points of a scan that are matched")
    buffer_keyscans: int = Field(default=60, ge=4, description="keyscans of one laser in a full running buffer")
    supported: float = Field(
        default=0.30,
        ge=0,
        le=1,
        description="least share of a scan's points on known surfaces; below it, odometry alone gives the pose",
    )
    doubtful: float = Field(
        default=0.75,
        ge=0,
        le=1,
        description="least share of the points in known area on surfaces; below it, a correlative search starts",
    )
    search_radius_m: float = Field(
        default=1.0, gt=0, description="half side of the window of the correlative search [m]"
    )
    search_angle_rad: float = Field(
        default=0.5, gt=0, description="half angle of the window of the correlative search [rad]"
    )
    step_m: float = Field(
        default=0.20, gt=0, description="a match farther than this from odometry starts a correlative search [m]"
    )
    step_rad: float = Field(
        default=0.07,
        gt=0,
        description="a match turned by more than this from odometry starts a correlative search [rad]",
    )
    odometry: OdometryConfig = Field(default=OdometryConfig(), description="error of the wheel odometry")
    matching: MatchingConfig = Field(default=MatchingConfig(), description="Gauss-Newton scan matching")
    search: SearchConfig = Field(default=SearchConfig(), description="correlative search by branch and bound")


@dataclass(frozen=True, slots=True)
class TrackedScan:
    """One scan's pose in the tracker's own smooth frame."""

    T_local_base: FloatArray
    """Shape (3,), metres and radians."""
    information: FloatArray
    """Information of the scan's points, over (x, y) in the local frame and theta, shape (3, 3); zeros if odometry alone
    gives the pose."""
    scan: PointScan | None
    """The scan's points in ``base``; None if the robot stands still and the points were not computed."""


@dataclass(frozen=True, slots=True)
class TrackingResult:
    """The match of one scan, and the state of the tracker after it (see :meth:`ScanTracker.commit`)."""

    tracked: TrackedScan
    explained: float
    """Share of the scan's points that lie on a surface of the running buffer, also if the match is not accepted."""
    known: float
    """Share of the scan's points near any surface; NaN, as ``explained``, if the scan was not matched."""
    T_odom_base: FloatArray
    """Pose of the scan by wheel odometry, shape (3,)."""
    moved_m: float
    """Travel since the last accepted match, by odometry; 0 if this one is accepted."""
    turned_rad: float
    """Turn since the last accepted match, by odometry; 0 if this one is accepted."""
    matched_here: frozenset[tuple[float, float, float]]
    """Mountings of the lasers whose scans were matched since the robot last moved."""


class ScanTracker:
    """Tracks one robot in a running buffer of keyscans (Karto), kept as two overlapping surfel fields.

    Scans are matched against the older field. When it is full it is dropped, and the younger one, half full, takes its
    place. So a scan always sees between half a buffer and a full one, and nothing is ever removed from a field.
    """

    def __init__(self, config: TrackerConfig) -> None:
        self._config = config
        self._fields: list[tuple[SurfelField, int]] = []
        self._T_local_base = np.zeros(3)
        self._T_odom_base: FloatArray | None = None
        self._moved_m = 0.0
        self._turned_rad = 0.0
        self._matched_here: frozenset[tuple[float, float, float]] = frozenset()

    def track(self, scan: LaserScan) -> TrackedScan:
        """Localize the next scan and continue from there."""
        result = self.localize(scan)
        self.commit(result)
        return result.tracked

    def localize(self, scan: LaserScan) -> TrackingResult:
        """Find the pose of the next scan; the tracker does not change before :meth:`commit`."""
        config = self._config
        # 1. Prediction: the last pose, moved by odometry.
        T_local_guess, moved_m, turned_rad = self._predict(scan)
        is_still = moved_m < config.still_m and turned_rad < config.still_rad
        matched_here = (self._matched_here if is_still else frozenset()) | {scan.laser.T_base_laser}
        if self._fields and is_still and matched_here == self._matched_here:
            tracked = TrackedScan(T_local_guess, _NO_INFORMATION, None)
            return TrackingResult(tracked, np.nan, np.nan, scan.T_odom_base, moved_m, turned_rad, matched_here)
        # 2. Scan to points.
        points = point_scan(scan.ranges_m, scan.laser)
        if not self._fields:
            tracked = TrackedScan(T_local_guess, _NO_INFORMATION, points)
            return TrackingResult(tracked, np.nan, np.nan, scan.T_odom_base, moved_m, turned_rad, matched_here)
        # 3. Scan matching; a doubtful match starts a correlative search.
        prior = odometry_information(moved_m, turned_rad, config.odometry)
        match = self._match(points, T_local_guess, prior)
        # 4. A match that explains too little is not accepted: odometry alone gives the pose.
        if match.explained < config.supported:
            tracked = TrackedScan(T_local_guess, _NO_INFORMATION, points)
            known = match.explained, match.known
            return TrackingResult(tracked, *known, scan.T_odom_base, moved_m, turned_rad, self._matched_here)
        tracked = TrackedScan(match.T_field_base, match.information, points)
        return TrackingResult(tracked, match.explained, match.known, scan.T_odom_base, 0.0, 0.0, matched_here)

    def commit(self, result: TrackingResult) -> None:
        """Continue from the pose that :meth:`localize` found."""
        self._T_local_base = result.tracked.T_local_base
        self._T_odom_base = result.T_odom_base
        self._moved_m, self._turned_rad = result.moved_m, result.turned_rad
        self._matched_here = result.matched_here

    def insert(self, points: PointScan, T_local_base: FloatArray, laser_count: int = 1) -> None:
        """Add a keyscan to the running buffer.

        Args:
            points: returns of the keyscan, in its ``base``.
            T_local_base: pose of the keyscan, shape (3,).
            laser_count: lasers whose keyscans take turns in the buffer.
        """
        capacity = laser_count * self._config.buffer_keyscans
        if not self._fields or (len(self._fields) == 1 and self._fields[0][1] >= capacity // 2):
            self._fields.append((SurfelField(T_local_base), 0))
        elif self._fields[0][1] >= capacity:
            self._fields = [self._fields[1], (SurfelField(T_local_base), 0)]
        for field, _ in self._fields:
            field.insert(points, T_local_base)
        self._fields = [(field, count + 1) for field, count in self._fields]

    def _predict(self, scan: LaserScan) -> tuple[FloatArray, float, float]:
        """The last pose moved by odometry; travel and turn since the last accepted match."""
        last = scan.T_odom_base if self._T_odom_base is None else self._T_odom_base
        motion = se2.between(last, scan.T_odom_base)
        moved_m = self._moved_m + float(np.hypot(motion[0], motion[1]))
        return se2.compose(self._T_local_base, motion), moved_m, self._turned_rad + abs(float(motion[2]))

    def _match(self, points: PointScan, T_local_guess: FloatArray, prior: FloatArray) -> ScanMatch:
        """Gauss-Newton from the guess; a correlative search if the result is doubtful."""
        config, field = self._config, self._fields[0][0]
        thinned = points.thinned(config.point_spacing_m, config.point_limit)
        match = match_scan(thinned, field, T_local_guess, prior, config.matching)
        if self._is_doubtful(match, T_local_guess):
            window = SearchWindow(config.search_radius_m, config.search_angle_rad)
            found = search(points, field, T_local_guess, window, config.search, visible_only=True)
            other = match_scan(thinned, field, found.T_field_base, _NO_INFORMATION, config.matching)
            if other.explained > match.explained + SEARCH_GAIN:
                match = other
        return match

    def _is_doubtful(self, match: ScanMatch, T_local_guess: FloatArray) -> bool:
        step = se2.between(T_local_guess, match.T_field_base)
        return bool(
            match.explained < self._config.doubtful * match.known
            or np.hypot(step[0], step[1]) > self._config.step_m
            or abs(step[2]) > self._config.step_rad
        )


def odometry_information(moved_m: float, turned_rad: float, config: OdometryConfig) -> FloatArray:
    """Information of a motion that only wheel odometry measured.

    Args:
        moved_m: travel, metres.
        turned_rad: turn, radians, not negative.
        config: error of the odometry.

    Returns:
        Diagonal information matrix over (x, y, theta), shape (3, 3); the same in every coordinate frame of the plane.
    """
    sigma_m = config.position_m + config.position_per_travel * moved_m + config.position_per_turn_m * turned_rad
    sigma_rad = config.heading_rad + config.heading_per_turn * turned_rad + config.heading_per_travel_rad * moved_m
    return np.diag((sigma_m**-2, sigma_m**-2, sigma_rad**-2))

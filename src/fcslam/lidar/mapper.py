"""The robot's LiDAR SLAM (Karto class): every scan tracked, keyscans in a pose graph, loops closed between submaps."""

from bisect import bisect_left, bisect_right
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from fcslam.config import Settings
from fcslam.geometry import se2
from fcslam.graph.factors import FactorCache, Loss
from fcslam.graph.optimizer import optimize, optimize_gnc
from fcslam.graph.pose_graph import Edge, PoseGraph
from fcslam.lidar.closing import AnchoredSubmap, ClosingConfig, LocalClosure, LoopCloser
from fcslam.lidar.correlative import SearchConfig
from fcslam.lidar.scan import PointScan, point_scan
from fcslam.lidar.submap import Submap, build_submap
from fcslam.lidar.tracker import ScanTracker, TrackedScan, TrackerConfig, TrackingResult, odometry_information
from fcslam.lidar.verification import VerificationConfig
from fcslam.records import Constraint, ConstraintKind, FloatArray, Keyscan, KeyscanId, LaserScan, Ranges, frozen

SOLVE_AFTER, SOLVE_AFTER_SHARE = 20, 0.08
"""Closures that may wait for a solve when none says that the estimate is off: so many, or this share of the keyscans.
A solve takes as long as the graph is large, so they become rarer as it grows, and a scan's share stays the same."""
TURN_AS_TRAVEL_M = 0.1
"""Progress that one radian of turning counts for: a robot that only turns finishes submaps, too."""


class KeyscanConfig(Settings):
    """Which scans carry the pose graph and the map, and the submaps around them."""

    minimum_travel_distance_m: float = Field(default=0.25, gt=0, description="a keyscan at least this often")
    minimum_travel_heading_rad: float = Field(default=0.25, gt=0, description="or after this turn")
    submap_every_m: float = Field(default=2.0, gt=0, description="travel between the anchors of submaps")
    submap_reach_m: float = Field(default=5.0, gt=0, description="travel before and after the anchor in a submap")


class LidarConfig(Settings):
    """The LiDAR front end."""

    keyscans: KeyscanConfig = Field(default=KeyscanConfig(), description="keyscans and submaps")
    tracker: TrackerConfig = Field(default=TrackerConfig(), description="scan-to-submap tracking")
    closing: ClosingConfig = Field(default=ClosingConfig(), description="loop closing inside one robot")
    search: SearchConfig = Field(default=SearchConfig(), description="correlative search of loop closing")
    verification: VerificationConfig = Field(default=VerificationConfig(), description="verification of closures")


@dataclass(frozen=True, slots=True)
class ScanPose:
    """Where a raw scan was, relative to the keyscan before it."""

    stamp: float
    keyscan: int
    T_keyscan_base: FloatArray


@dataclass(frozen=True, slots=True)
class FinishedSubmap:
    """The submap around a keyscan is complete: what it shows, and the closures that it brought."""

    anchor: int
    first: int
    """First keyscan of the submap."""
    last: int
    """Last one (inclusive)."""
    surface: FloatArray
    """Points of the surfaces in the anchor's base, shape (N, 2)."""
    closures: tuple[Constraint, ...]


@dataclass(frozen=True, slots=True)
class Step:
    """What one scan brought."""

    pose: ScanPose
    keyscan: Keyscan | None = None
    odometry: Constraint | None = None
    submap: FinishedSubmap | None = None


class Mapper:
    """One robot's SLAM on its own; poses are in its ``map``, which starts at its first keyscan's odometry pose."""

    def __init__(self, robot: str, config: LidarConfig) -> None:
        self.robot = robot
        self.config = config
        self._tracker = ScanTracker(config.tracker)
        self._closer = LoopCloser(config.closing, config.search, config.verification)
        self._graph = PoseGraph()
        self._factors = FactorCache(self._graph)
        self._poses: list[FloatArray] = []  # T_map_base of each keyscan, optimised
        self._local: list[FloatArray] = []  # T_local_base of each keyscan, smooth
        self._travel: list[float] = []
        self._points: dict[int, PointScan] = {}
        self._next_anchor_m = 0.0
        self._unsolved = 0

    def localize(self, scan: LaserScan) -> TrackingResult:
        """The next scan, which leaves no trace before it is processed."""
        return self._tracker.localize(scan)

    def process(self, scan: LaserScan, tracking: TrackingResult | None = None) -> Step:
        """Take in the next scan, as it was seen if it was looked at before."""
        tracking = self._tracker.localize(scan) if tracking is None else tracking
        self._tracker.commit(tracking)
        tracked = tracking.tracked
        if not self._is_keyscan(tracked):
            return Step(self._scan_pose(scan.stamp, tracked))
        keyscan, odometry = self._add_keyscan(scan, tracked)  # pose graph grows
        submap = self._finish_submap()  # loops are closed between submaps
        return Step(self._scan_pose(scan.stamp, tracked), keyscan, odometry, submap)

    @property
    def travel_m(self) -> float:
        """Path length up to the newest keyscan; turning counts a little."""
        return self._travel[-1] if self._travel else 0.0

    def recent_submap(self) -> tuple[Submap, FloatArray]:
        """What the robot saw on the last ``submap_reach_m`` of its way, and ``T_local_base`` of the anchor, the newest
        keyscan."""
        anchor = self._local[-1]
        first = bisect_left(self._travel, self._travel[-1] - self.config.keyscans.submap_reach_m)
        numbers = range(first, len(self._local))
        return build_submap([(self._points[k], se2.between(anchor, self._local[k])) for k in numbers]), anchor

    def finish(self) -> list[FinishedSubmap]:
        """The submaps still open at the end of the recording."""
        rest = []
        while submap := self._finish_submap(at_end=True):
            rest.append(submap)
        return rest

    def optimized(self) -> FloatArray:
        """T_map_base of every keyscan after a robust solve (GNC), shape (N, 3)."""
        if self._closer.has_closures:
            self._poses = list(optimize_gnc(self._graph, self._poses, factors=self._factors).poses)
        return np.array(self._poses).reshape(-1, 3)

    def _is_keyscan(self, tracked: TrackedScan) -> bool:
        if tracked.scan is None:
            return False
        if not self._local:
            return True
        motion = se2.between(self._local[-1], tracked.T_local_base)
        gate = self.config.keyscans
        return bool(
            np.hypot(motion[0], motion[1]) >= gate.minimum_travel_distance_m
            or abs(motion[2]) >= gate.minimum_travel_heading_rad
        )

    def _scan_pose(self, stamp: float, tracked: TrackedScan) -> ScanPose:
        number = len(self._local) - 1
        return ScanPose(stamp, number, se2.between(self._local[number], tracked.T_local_base))

    def _add_keyscan(self, scan: LaserScan, tracked: TrackedScan) -> tuple[Keyscan, Constraint | None]:
        """New variable of the pose graph, tied to the keyscan before it."""
        points = tracked.scan or point_scan(scan.ranges_m, scan.laser)
        number = len(self._local)
        self._tracker.insert(points, tracked.T_local_base)
        self._points[number] = points
        keyscan = Keyscan(KeyscanId(self.robot, number), scan.stamp, _clean(scan.ranges_m, scan.laser.max_range_m))
        if number == 0:
            start = np.array(scan.T_odom_base)
            self._local.append(tracked.T_local_base)
            self._poses.append(start)
            self._travel.append(0.0)
            self._graph.add_variable(start)
            return keyscan, None
        motion = se2.between(self._local[-1], tracked.T_local_base)
        constraint = Constraint(
            self.robot, number - 1, number, ConstraintKind.ODOMETRY, frozen(motion),
            frozen(motion_information(motion, tracked)),
        )  # fmt: skip
        self._local.append(tracked.T_local_base)
        self._poses.append(se2.compose(self._poses[-1], motion))
        progress = float(np.hypot(motion[0], motion[1])) + TURN_AS_TRAVEL_M * abs(float(motion[2]))
        self._travel.append(self._travel[-1] + progress)
        self._graph.add_variable(self._poses[-1])
        self._graph.add_edge(Edge(number - 1, number, constraint.T_i_j, constraint.information, robust=False))
        return keyscan, constraint

    def _finish_submap(self, at_end: bool = False) -> FinishedSubmap | None:
        """The next submap, once the robot is far enough past its anchor; closes loops to earlier ones."""
        gate, travel = self.config.keyscans, self._travel
        anchor = bisect_left(travel, self._next_anchor_m)
        if anchor == len(travel) or (not at_end and travel[-1] < travel[anchor] + gate.submap_reach_m):
            return None
        self._next_anchor_m = travel[anchor] + gate.submap_every_m
        first = bisect_left(travel, travel[anchor] - gate.submap_reach_m)
        last = bisect_right(travel, travel[anchor] + gate.submap_reach_m) - 1
        T_anchor = [se2.between(self._local[anchor], self._local[k]) for k in range(first, last + 1)]
        submap = build_submap([(self._points[first + k], pose) for k, pose in enumerate(T_anchor)])
        for number in [k for k in self._points if k < first]:
            del self._points[number]
        closures = self._close_loops(AnchoredSubmap(anchor, travel[anchor], submap))
        return FinishedSubmap(anchor, first, last, submap.surface.points, closures)

    def _close_loops(self, place: AnchoredSubmap) -> tuple[Constraint, ...]:
        """Compare the new submap with earlier ones; what holds becomes constraints."""
        closures = self._closer.add(place, self._poses)
        constraints = tuple(self._constraint(closure) for closure in closures)
        for c in constraints:
            self._graph.add_edge(Edge(c.i, c.j, c.T_i_j, c.information, robust=True))
        self._optimize_if_needed(closures)
        return constraints

    def _constraint(self, closure: LocalClosure) -> Constraint:
        places = self._closer.places
        return Constraint(
            self.robot, places[closure.earlier].keyscan, places[closure.later].keyscan, ConstraintKind.CLOSURE,
            frozen(closure.check.T_a_b), frozen(closure.check.information),
        )  # fmt: skip

    def _optimize_if_needed(self, closures: list[LocalClosure]) -> None:
        """Solve at once when a closure says that the estimate is off, else only now and then."""
        self._unsolved += len(closures)
        enough = max(SOLVE_AFTER, SOLVE_AFTER_SHARE * len(self._local))
        if self._unsolved >= enough or any(c.is_surprising for c in closures):
            self._poses = list(optimize(self._graph, self._poses, loss=Loss.CAUCHY, factors=self._factors).poses)
            self._unsolved = 0


def motion_information(motion: FloatArray, tracked: TrackedScan) -> FloatArray:
    """Information of the motion between two keyscans, in the coordinates of the later one, shape (3, 3).

    Neighbouring points err together, so they count a tenth; odometry holds what they leave open (along a corridor).
    """
    moved, turned = float(np.hypot(motion[0], motion[1])), abs(float(motion[2]))
    cos, sin = np.cos(tracked.T_local_base[2]), np.sin(tracked.T_local_base[2])
    turn = np.array(((cos, -sin, 0.0), (sin, cos, 0.0), (0.0, 0.0, 1.0)))
    odometry = np.diag(((0.01 + 0.1 * moved) ** -2, (0.01 + 0.1 * moved) ** -2, (0.005 + 0.1 * turned) ** -2))
    if not tracked.information.any():  # nothing but odometry, which may have slipped
        odometry = odometry_information(moved, turned)
    covariance = np.linalg.inv(0.1 * turn.T @ tracked.information @ turn + odometry)
    floor = np.diag(((0.003 + 0.01 * moved) ** 2, (0.003 + 0.01 * moved) ** 2, (0.001 + 0.01 * turned) ** 2))
    information = np.linalg.inv(covariance + floor)
    return np.asarray(0.5 * (information + information.T))


def _clean(ranges_m: Ranges, max_range_m: float) -> Ranges:
    """Ranges of a keyscan: what is no return becomes 0."""
    valid = np.isfinite(ranges_m) & (ranges_m > 0.0) & (ranges_m < max_range_m)
    return frozen(np.where(valid, ranges_m, 0.0), np.float32)
